"""The encoder of an unknown log is found by what its counts do, and no other column is taken for one."""

from __future__ import annotations

import numpy as np
import pytest
from loggers import GRAVITY

from imu_logs.columns import find_layout
from imu_logs.proposal import Proposal, not_found
from pipeline.app.unit_guesses import propose

HZ = 125.0
RATE = np.repeat(
    [0.0, 60.0, 0.0, -60.0, 0.0, 150.0, 0.0, -150.0, 0.0], np.rint(HZ * np.array([5, 7, 5, 7] * 2 + [5])).astype(int)
)


def turned(turn: float, shaft: str, *, still: bool = False, header: str = "om_x,om_y,om_z,ticks") -> str:
    """Return the log of a sensor on a shaft, level or upright: with a bias, leaning axes, and 3 % of scale."""
    generator = np.random.default_rng(7)
    rate = np.zeros_like(RATE) if still else RATE
    angle = np.radians(np.cumsum(rate) / HZ)
    up, beside, along = np.sin(angle), np.cos(angle), np.full(len(angle), 0.02)
    force = np.column_stack([along, up, beside] if shaft == "level" else [0.02 * up, 0.02 * beside, 0 * up + 1.0])
    omega = np.outer(rate, [1.0, 0.01, -0.02] if shaft == "level" else [0.01, -0.02, 1.0])
    force = GRAVITY * (force + [0.02, -0.03, 0.04] + 0.003 * generator.standard_normal(force.shape))
    omega = np.radians(1.03 * omega + [1.0, -2.0, 0.5] + 0.05 * generator.standard_normal(omega.shape))
    ticks = 1000 + np.floor(angle / (2 * np.pi) * turn)
    time = 1e6 * (1.7e9 + np.arange(len(rate)) / HZ)
    rows = np.column_stack([time, force, omega, ticks, np.arange(len(rate)) % 256, np.arange(len(rate)) // 3])
    lines = (f"{t:.0f},{','.join(f'{v:.5f}' for v in r[:6])},{r[6]:.0f},{r[7]:.0f},{r[8]:.0f},A" for t, *r in rows)
    return f"t_us,acc_x,acc_y,acc_z,{header},byte,packet,state\n" + "\n".join(lines) + "\n"


def proposed(*texts: str) -> Proposal:
    (proposal,) = propose([find_layout(text.encode(), f"log{i}.csv") for i, text in enumerate(texts)])
    return proposal


@pytest.mark.parametrize(
    ("turn", "shaft", "header"),
    [
        (8192, "level", "om_x,om_y,om_z,ticks"),
        (4000, "level", "om_x,om_y,om_z,ticks"),
        (7777, "level", "om_x,om_y,om_z,ticks"),
        (8192, "level", "q1,q2,q3,shaft"),
        (8192, "upright", "gyr_x (rad/s),gyr_y (rad/s),gyr_z (rad/s),ticks"),
    ],
)
def test_an_encoder_is_found_by_gravity_or_by_the_gyroscope(turn: int, shaft: str, header: str) -> None:
    proposal = proposed(turned(turn, shaft, header=header))
    found = proposal.columns[0]["table_angle"]
    assert (found["column"], found["unit"]) == (header.rpartition(",")[2], "counts")
    assert found["counts_per_unit"] == pytest.approx(turn / 360, rel=1e-3 if turn == 7777 else 1e-9)
    assert any("check counts and sign, and add offset" in r for r in proposal.remarks)
    assert ("gyro_x" in proposal.columns[0]) == ("q1" not in header)
    if "q1" not in header:
        assert proposal.columns[0]["gyro_x"]["unit"] == "rad/s"


@pytest.mark.parametrize(
    ("name", "turn", "shaft", "unit"),
    [
        ("motor_deg", 360.0, "level", "deg"),
        ("angle", 360, "level", "deg"),  # whole degrees
        ("theta", 2.0 * np.pi, "level", "rad"),
        ("pos", 360.0, "upright", "deg"),
    ],
)
def test_an_angle_that_turns_as_gravity_or_the_gyroscope_does_is_proposed_with_its_unit(
    name: str, turn: float, shaft: str, unit: str
) -> None:
    gyroscope = ",".join(f"gyr_{axis} (rad/s)" for axis in "xyz")
    head, *rows = turned(turn, shaft, header=f"{gyroscope},{name}").splitlines()
    shown = (np.cumsum(RATE) / HZ * turn / 360.0 + 0.7 * turn) % turn
    text = "%d" if isinstance(turn, int) else "%.4f"
    cells = [row.split(",") for row in rows]
    lines = [",".join([*c[:7], text % a, *c[8:]]) for c, a in zip(cells, shown, strict=True)]
    proposal = proposed("\n".join([head, *lines]) + "\n")
    assert proposal.columns[0]["table_angle"] == {"column": name, "unit": unit, "optional": True}
    assert "turns once in" in proposal.evidence["table_angle"]
    assert any(
        f"{name} is taken as the table's encoder by its numbers: check sign and unit" in r for r in proposal.remarks
    )
    assert proposal.columns[0]["gyro_x"]["unit"] == "rad/s"
    estimate = "\n".join([head.replace(name, "roll"), *lines]) + "\n"
    assert "table_angle" not in proposed(estimate).columns[0]


def test_every_other_column_is_listed_with_what_it_holds() -> None:
    proposal = proposed(turned(8192, "level", header="q1,q2,q3,ticks"))
    text = proposal.text("mine")
    assert {w.split()[3] for w in text.splitlines() if "# not used: " in w} == {
        "q1",
        "q2",
        "q3",
        "byte",
        "packet",
        "state",
    }
    assert "# not used: byte (whole numbers 0 to 255)" in text
    assert "grows evenly with the rows" in text
    assert "# not used: state (not all of it is numbers)" in text
    lacking = " ".join(not_found(proposal))
    assert "NOT FOUND: the gyroscope" in lacking
    assert "add gyro_x, gyro_y, gyro_z" in lacking
    assert "the accelerometer" not in lacking
    assert "the angle or rate of a table" not in lacking


def test_a_rest_shows_no_encoder_and_a_turn_of_the_same_logger_does() -> None:
    rest, turn = turned(8192, "level", still=True), turned(8192, "level")
    alone = proposed(rest)
    assert "table_angle" not in alone.columns[0]
    assert "# not used: ticks (1000 throughout)" in alone.text("mine")
    both = proposed(rest, turn)
    assert both.columns[0]["table_angle"]["counts_per_unit"] == pytest.approx(8192 / 360)
    assert both.columns[0]["gyro_x"]["unit"] == "rad/s"
    assert "not used: ticks" not in both.text("mine")
