"""Turns that one common mounting does not explain are marked, unless effects of the table explain them."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from benches import Setup, recordings_of, settings_of
from scipy.spatial.transform import Rotation

from imu_research.study.bench import recordings_of as recordings_of_case
from imu_research.study.cases import FAMILIES, draw
from pipeline.checks.bench import fit_turn, signed_axis
from pipeline.checks.mounting import check_mounting

if TYPE_CHECKING:
    from pipeline.core.records import Recording


def doubted(recordings: list[Recording]) -> dict[str, str]:
    """Return recording to the text of its note."""
    checked = check_mounting(recordings, settings_of(recordings))
    return {r.name: n.detail for r in checked for n in r.notes if n.code == "N-SEATS"}


def test_a_common_seat_is_a_part_of_the_matrix() -> None:
    assert not doubted(recordings_of({a: Setup(a, seat=(2.0, -1.0, 1.0)) for a in "xyz"}))


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_a_zero_that_does_not_fit_the_other_turns_is_named_to_a_tenth_of_a_degree(axis: str) -> None:
    found = doubted(recordings_of({axis: Setup(axis, zero=-1.4)}))
    assert set(found) == {"accel_x", "accel_y", "accel_z"}  # the gyroscope's turns need no zero
    assert {f.split("gravity fits with ")[1].split(" (")[0][:-1] for f in found.values()} == {
        f"procedure.recordings.accel_{axis}.zero_deg=-1.4"
    }


def test_a_unit_that_is_seated_anew_for_each_axis_is_told_its_seats() -> None:
    rng = np.random.default_rng(2)
    missed = 0
    for _ in range(20):
        seats = 0.7 * rng.standard_normal((3, 3))
        found = doubted(recordings_of({a: Setup(a, seat=s) for a, s in zip("xyz", seats, strict=True)}))
        missed += len(found) < 4
        if "accel_x" in found and "rotation against" in found["accel_x"]:
            told = found["accel_x"].split("accel_x ")[1].split(";")[0].split(", ")
            stated = [float(part.split()[0]) for part in told]
            right = Rotation.from_rotvec(np.radians(seats - seats.mean(axis=0))[0]).as_rotvec(degrees=True)
            assert np.allclose(stated, right, atol=0.1)
    assert missed <= 1


def test_a_gyroscope_turn_in_another_seat_is_told_by_gravity() -> None:
    usual = recordings_of({})
    askew = recordings_of({"y": Setup("y", seat=(0.6, 0.0, -0.5))})
    found = doubted([*usual[:4], askew[4], usual[5]])
    assert set(found) == {"gyro_y"}
    told = [float(part.split()[0]) for part in found["gyro_y"].split("rotated by ")[1].split(", ")[:3]]
    assert np.allclose(told, (0.6, 0.0, -0.5), atol=0.03)


def test_turns_of_a_setup_each_are_compared_with_each_other() -> None:
    seats = {"x": (0.0, 0.6, -0.5), "y": (-0.4, 0.0, 0.7), "z": (0.5, -0.6, 0.0)}
    each = [replace(r, setup=f"on_{r.axis}") for r in recordings_of({a: Setup(a, seat=s) for a, s in seats.items()})]
    assert set(doubted(each)) == {r.name for r in each}
    assert not doubted([replace(r, setup=f"on_{r.axis}") for r in recordings_of({})])


@pytest.mark.parametrize("size", [0.1, 0.9])
def test_tilt_and_leaning_axes_are_left_to_the_diagnosis(size: float) -> None:
    rng = np.random.default_rng(5)
    for _ in range(10):
        tilt, leans = size * rng.choice([-1, 1], 2), size * rng.uniform(-1.0, 1.0, (3, 2))
        for tilted, leaning in ((tilt, 0.0 * leans), (0.0 * tilt, leans)):
            assert not doubted([_on_a_poor_table(r, tilted, leaning) for r in recordings_of({})])


def _on_a_poor_table(recording: Recording, tilt: np.ndarray, leans: np.ndarray) -> Recording:
    """Return what the accelerometer reads on a tilted table whose axes lean, by rotations and noise of its own."""
    axis = signed_axis(f"+{recording.axis}")
    a = int(np.argmax(axis))
    others = [np.eye(3)[(a + 1) % 3], np.eye(3)[(a + 2) % 3]]
    leaning = axis + np.radians(leans[a, 0]) * others[0] + np.radians(leans[a, 1]) * others[1]
    level = {"x": np.eye(3), "y": np.eye(3), "z": np.array([[0, 0, -1], [0, 1, 0], [1, 0, 0]])}[str(recording.axis)]
    up = level.T @ Rotation.from_rotvec(np.radians([*tilt, 0.0])).apply([0.0, 0.0, 1.0], inverse=True)
    assert recording.table_angle is not None
    turned = Rotation.from_rotvec(-np.radians(recording.table_angle)[:, None] * leaning / np.linalg.norm(leaning))
    noise = 8e-4 * np.random.default_rng(a).standard_normal((recording.samples, 3))
    return replace(recording, accelerometer=turned.apply(up) + noise)


def test_nothing_is_doubted_or_refused_in_cases_of_the_blind_study() -> None:
    for family in FAMILIES[::4]:
        recordings = recordings_of_case(draw(family, 3, 931))
        checked = check_mounting(recordings, settings_of(recordings))
        assert [n for r in checked for n in r.notes] == [n for r in recordings for n in r.notes]


def test_fewer_than_three_turns_say_nothing_of_seats() -> None:
    assert not doubted(recordings_of({"x": Setup("x", seat=(0.0, 2.0, 0.0))})[:2])


def test_what_goes_with_the_rate_does_not_turn_the_axes() -> None:
    recording = Setup("z").recording("gyroscope")
    assert recording.table_rate is not None
    assert recording.accelerometer is not None
    pulled = 0.05 * (recording.table_rate / 60.0)[:, None] ** 2 * [1.0, -0.5, 0.2]  # a lever arm of 0.45 m
    plain, found = (
        fit_turn(r) for r in (recording, replace(recording, accelerometer=recording.accelerometer + pulled))
    )
    assert plain.turn_axis is not None
    assert found.turn_axis is not None
    assert np.allclose(plain.turn_axis, found.turn_axis, atol=1e-4)
