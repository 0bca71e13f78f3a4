"""A table without encoders, followed from its program: angles and rates against those of the simulation."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from simulated_logs import as_table

from pipeline.core.errors import IngestError
from pipeline.core.records import Recording
from pipeline.ingest.clock_alignment import Program, follow_program
from pipeline.simulation.campaign import Streams, as_program
from pipeline.simulation.description import Course, plan
from pipeline.simulation.trajectory import CommandedTurns, rest, turn

BIAS, SCALE = np.array([1.3, -0.4, 0.2]), 1.01
COURSE = Course(step_deg=30.0, rates_dps=(30.0, 60.0), both_directions=True, validation_s=0.0, static_s=0.0)


def program_of(name: str) -> Program:
    trajectory = next(p.trajectory for p in plan("three_axis_turns", COURSE, Streams(1, 0)["motion"]) if p.name == name)
    assert isinstance(trajectory, CommandedTurns)
    return trajectory.program


def felt(name: str, begun: float, drift: float, pauses: Any, interval: float = 0.02) -> tuple[Recording, Any]:
    """A recording of a table that began late, by a clock that drifts, and paused before some moves; its angle."""
    program = program_of(name)
    moves = np.append(program.knots[1::4, 0], np.inf)
    time = np.arange(0.0, begun + program.duration + float(np.sum(pauses)) + 3.0, interval)
    own = (time - begun) * (1.0 + drift)
    late = np.zeros_like(own)
    for move, pause in zip(moves, pauses, strict=False):  # the table's own time stands still while it pauses
        late = np.where(own - late > move, np.minimum(late + pause, np.maximum(own - move, late)), late)
    angle, rate = program.at(own - late)[:2]
    rng = np.random.default_rng(5)
    axis = "xyz".index(name[-1])
    gyro = BIAS + 0.03 * rng.standard_normal((len(time), 3))
    gyro[:, axis] += SCALE * rate
    up = np.zeros((len(time), 3))
    a, b = (axis + 1) % 3, (axis + 2) % 3
    up[:, a], up[:, b] = np.sin(np.radians(angle)), np.cos(np.radians(angle))
    up += 1e-3 * rng.standard_normal(up.shape)
    ns = np.rint(time * 1e9).astype(np.int64)
    return Recording(name, "gyroscope", name[-1], ns, accelerometer=up, gyroscope=gyro), (angle, rate)


def test_a_turn_is_a_trapezoid_of_the_rate_whose_ramps_meet_where_it_is_short() -> None:
    program = Program([rest(2.0), turn(90.0, 30.0, 60.0), rest(1.0), turn(-15.0, 60.0, 60.0)])
    # 90 deg at 30 deg/s with ramps of 0.5 s last 3.5 s; 15 deg are turned in two ramps of 0.5 s
    assert program.duration == pytest.approx(2.0 + 3.5 + 1.0 + 1.0)
    angle, rate, *_ = program.at(np.array([2.0, 2.5, 4.0, 5.25, 6.0, 7.0, 9.0]))
    np.testing.assert_allclose(angle, [0.0, 7.5, 52.5, 90.0 - 0.5 * 60.0 * 0.25**2, 90.0, 82.5, 75.0], atol=1e-12)
    np.testing.assert_allclose(rate, [0.0, 30.0, 30.0, 15.0, 0.0, -30.0, 0.0], atol=1e-12)


@pytest.mark.parametrize("name", ["accel_x", "gyro_y"])
@pytest.mark.parametrize(("begun", "drift"), [(0.0, 0.0), (17.3, 2e-4)])
def test_a_program_is_placed_where_it_was_run(name: str, begun: float, drift: float) -> None:
    recording, (angle, rate) = felt(name, begun, drift, [])
    found = follow_program(as_table(recording), as_program(program_of(name)))
    assert float(np.abs(found.values["table_angle"] - angle).max()) < 0.05
    assert float(np.sqrt(np.mean((found.values["table_rate"] - rate) ** 2))) < 0.05
    assert [n.code for n in found.notes] == ["N-PROGRAM"]


def test_a_table_that_pauses_between_moves_is_followed_from_rest_to_rest() -> None:
    pauses = np.tile([0.0, 0.15, 0.05, -0.0], 6)
    recording, (angle, _) = felt("accel_x", 4.0, 1e-5, pauses)
    found = follow_program(as_table(recording), as_program(program_of("accel_x")))
    off = np.abs(found.values["table_angle"] - angle)
    assert float(off.max()) < 0.1
    assert float(np.median(off)) < 1e-6  # at rest the commanded angle itself


def test_a_program_that_was_not_run_is_refused() -> None:
    recording, _ = felt("accel_x", 0.0, 0.0, [])
    with pytest.raises(IngestError, match=r"does not show the motion|fits at"):
        follow_program(as_table(recording), as_program(program_of("gyro_x")))


def test_a_program_needs_a_gyroscope() -> None:
    recording, _ = felt("accel_x", 0.0, 0.0, [])
    with pytest.raises(IngestError, match="gyroscope"):
        follow_program(as_table(replace(recording, gyroscope=None)), as_program(program_of("accel_x")))
