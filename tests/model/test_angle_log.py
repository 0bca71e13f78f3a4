"""A table that logs its angle alone: the rate is known where the angle tells it, and said to be vague where not."""

from itertools import product

import numpy as np
import pytest

from pipeline.core.records import Motion, Recording
from pipeline.ingest.clock_alignment import Program
from pipeline.physics.kinematics import reference_motion
from pipeline.simulation.trajectory import rest, turn, turn_with_plateau

INTERVAL = 0.12


def motion(program: Program, *, decimals: int = 4) -> tuple[Motion, np.ndarray]:
    time_ns = np.arange(int(program.duration / INTERVAL)) * round(INTERVAL * 1e9)
    angle, rate, _, _ = program.at(time_ns * 1e-9)
    found = reference_motion(Recording("turn", "gyroscope", "x", time_ns, table_angle=angle.round(decimals)))
    assert found is not None
    assert found.reference_valid is not None
    return found, rate


def stop_and_go() -> Program:
    return Program([rest(2.0), *[turn(10.0, 20.0, 100.0), rest(1.0)] * 36])


def turns() -> Program:
    steps = [rest(10.0)]
    for rate, angle in product((60.0, 100.0), (360.0, -360.0)):
        steps += [turn_with_plateau(angle, rate, 100.0), rest(5.0)]
    return Program(steps)


@pytest.mark.parametrize("program", [stop_and_go(), turns()], ids=["stop-and-go", "turns"])
def test_the_rate_is_right_wherever_it_is_said_to_be_followed(program: Program) -> None:
    found, rate = motion(program)
    assert found.rate is not None
    assert found.reference_valid is not None
    assert np.abs(found.rate - rate)[found.reference_valid].max() < 0.01
    assert found.reference_valid[found.still].mean() > 0.7  # not the last sample before a move


@pytest.mark.parametrize("program", [stop_and_go(), turns()], ids=["stop-and-go", "turns"])
def test_rests_are_seen_in_the_angle_alone(program: Program) -> None:
    found, rate = motion(program)
    assert (rate[found.still] == 0).all()
    assert found.still.sum() > 0.4 * (rate == 0).sum()  # 0.3 s of each 1 s settle


def test_corners_of_ramps_are_said_to_be_vague() -> None:
    found, rate = motion(turns())
    assert found.rate is not None
    assert found.reference_valid is not None
    wrong = np.abs(found.rate - rate) > 0.1
    assert wrong.sum() >= 8
    assert not found.reference_valid[wrong].any()


def test_the_rate_of_an_attitude_log_with_a_clock_of_its_own_is_by_that_clock() -> None:
    """The table turns by 40 deg a second of its clock, which gains 5000 ppm on that of the sensor."""
    time_ns = np.arange(400) * round(INTERVAL * 1e9)
    half = np.radians(40.0) * 1.005 * time_ns * 1e-9 / 2.0
    q = np.stack([np.cos(half), np.zeros(400), np.zeros(400), np.sin(half)], axis=1)
    source = {"table_clock": {"drift_ppm": 5000.0}}
    found = reference_motion(Recording("held_out", "validation", None, time_ns, table_attitude=q, source=source))
    assert found is not None
    assert found.timed_by == "table"
    assert found.angular_rate[5:-5] == pytest.approx(np.tile([0.0, 0.0, 40.0], (390, 1)), abs=1e-6)
