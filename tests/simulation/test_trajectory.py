"""The analytic trajectories against finite differences of themselves, and against hand-made cases."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from pipeline.core.records import attitude_matrix
from pipeline.ingest.clock_alignment import Program
from pipeline.physics.kinematics import UP_AT_ZERO, level_at_zero, turn_about_axis
from pipeline.simulation.description import Course, plan
from pipeline.simulation.trajectory import (
    CommandedTurns,
    RestsAndMoves,
    TurnErrors,
    axis_and_angle,
    directions_of_shaft,
    random_gimbals,
    rest,
    rotation_about,
    turn,
    turn_with_plateau,
)

STEP = 1e-5


def a_program() -> Program:
    there, back = turn_with_plateau(360.0, 60.0, 100.0), turn(-30.0, 60.0, 100.0)
    return Program([rest(1.0), there, rest(2.0), back, rest(1.0)])


def trajectories() -> Iterator[tuple[str, Any]]:
    errors = TurnErrors(
        encoder=np.array([0.3, -0.2]),
        ripple=np.array([0.02, 0.01]),
        stops=np.array([0.1, -9.0, -9.2]),
        direction=np.radians([0.5, -0.3]),
        vibration=0.02,
        vibration_frequency=3.0,
    )
    yield "turn", CommandedTurns(0, a_program())
    yield "turn with errors", CommandedTurns(2, a_program(), errors)
    yield "random motion", random_gimbals(60.0, 40.0, np.random.default_rng(1))
    axes = np.array([[0.6, 0.0, 0.8], [0.0, 1.0, 0.0]])
    yield "moves", RestsAndMoves(a_program(), axes, rotation_about(np.array([1.0, 0, 0]), np.array([20.0]))[0])


@pytest.mark.parametrize(("name", "trajectory"), list(trajectories()))
def test_rates_are_the_derivatives_of_the_attitude(name: str, trajectory: Any) -> None:
    knots = [] if name == "random motion" else trajectory.program.knots[:, 0]
    time = np.arange(0.0131, trajectory.duration, 0.0977)
    time = time[[np.all(np.abs(t - np.asarray(knots)) > 2 * STEP) for t in time]]
    before, now, after = (trajectory.pose(t) for t in (time - STEP, time, time + STEP))
    # omega x: R^T dR/dt of the rotation that takes body to level vectors
    spin = np.einsum("nij,nik->njk", now.level, (after.level - before.level) / (2 * STEP))
    omega = np.degrees(np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], -1))
    alpha = (after.omega - before.omega) / (2 * STEP)
    assert np.abs(now.omega).max() > 20.0
    np.testing.assert_allclose(now.omega, omega, atol=1e-5)
    np.testing.assert_allclose(now.alpha, alpha, atol=1e-4)
    np.testing.assert_allclose(
        now.level @ now.level.transpose(0, 2, 1), np.broadcast_to(np.eye(3), now.level.shape), atol=1e-12
    )


def test_a_program_turns_by_what_was_asked_at_no_more_than_the_rate() -> None:
    program = a_program()
    time = np.linspace(0.0, program.duration, 20001)
    angle, rate, acceleration, _ = program.at(time)
    # 60^2 / 100 = 36 deg of ramps beside the plateau; 30 deg is less than the ramps need: the top is sqrt(30 * 100)
    assert program.stops.tolist() == [0.0, 396.0, 366.0]
    assert angle[-1] == pytest.approx(366.0, abs=1e-9)
    assert rate.max() == pytest.approx(60.0, abs=1e-9)
    assert rate.min() == pytest.approx(-np.sqrt(3000.0), rel=1e-3)
    assert set(np.unique(acceleration)) == {-100.0, 0.0, 100.0}
    plateau = rate == 60.0
    assert np.ptp(angle[plateau]) == pytest.approx(360.0, abs=0.1)


def test_an_angle_may_be_asked_for_at_any_time() -> None:
    program = Program([rest(1.0), turn(90.0, 20.0, 50.0)])
    angle, rate, acceleration, move = program.at(np.array([-5.0, 0.5, 1.2, 3.0, 100.0]))
    np.testing.assert_allclose(angle, [0.0, 0.0, 0.5 * 50.0 * 0.2**2, 4.0 + 20.0 * 1.6, 90.0])
    np.testing.assert_allclose(rate, [0.0, 0.0, 10.0, 20.0, 0.0])
    np.testing.assert_allclose(acceleration, [0.0, 0.0, 50.0, 0.0, 0.0])
    assert move.tolist() == [-1, -1, 0, 0, 0]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_gravity_in_a_turn_is_the_up_vector_turned_back(axis: int) -> None:
    turn = CommandedTurns(axis, a_program())
    time = np.linspace(0.0, turn.duration, 301)
    up = turn.pose(time).level[:, 2, :]
    np.testing.assert_allclose(up, turn_about_axis(UP_AT_ZERO[axis], axis, -turn.program.at(time)[0]), atol=1e-12)


def test_the_quaternion_of_random_motion_is_continuous_and_is_its_attitude() -> None:
    motion = random_gimbals(300.0, 40.0, np.random.default_rng(3))
    time = np.arange(0.0, 300.0, 0.12)
    q = motion.quaternion(time)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, atol=1e-12)
    assert np.sum(q[1:] * q[:-1], axis=1).min() > 0.99
    inner, middle, outer = motion.angles(time)[0]
    product = [
        rotation_about(np.array([0, 0, 1.0]), outer),
        rotation_about(np.array([0, 1.0, 0]), middle),
        rotation_about(np.array([1.0, 0, 0]), inner),
    ]
    np.testing.assert_allclose(attitude_matrix(q), product[0] @ product[1] @ product[2], atol=1e-12)


def test_random_motion_peaks_at_the_rate_asked_for() -> None:
    for seed in range(10):
        pose = random_gimbals(120.0, 40.0, np.random.default_rng(seed)).pose(np.arange(0.0, 120.0, 0.12))
        assert np.linalg.norm(pose.omega, axis=1).max() == pytest.approx(40.0, rel=0.02)


def test_random_motion_shows_all_attitudes_evenly() -> None:
    motion = random_gimbals(6000.0, 40.0, np.random.default_rng(7))
    up = motion.pose(np.arange(0.0, 6000.0, 0.5)).level[:, 2, :]
    np.testing.assert_allclose(np.mean(up**2, axis=0), 1.0 / 3.0, atol=0.03)
    assert np.all(up.max(0) > 0.9)
    assert np.all(up.min(0) < -0.9)


def test_axis_and_angle_are_found_at_half_a_turn_too() -> None:
    for angle in (1e-3, 45.0, 179.999, 180.0):
        u = np.array([0.48, -0.6, 0.64])
        axis, found = axis_and_angle(rotation_about(u, np.array([angle]))[0])
        assert found == pytest.approx(angle, abs=1e-7)
        np.testing.assert_allclose(axis if axis @ u > 0 else -axis, u, atol=1e-9)


def test_the_six_positions_show_each_axis_up_and_down() -> None:
    (recording, *_) = plan("six_positions", Course(validation_s=0.0, static_s=0.0), np.random.default_rng(0))
    moves = recording.trajectory
    assert isinstance(moves, RestsAndMoves)
    ups = np.round(moves.attitudes()[:, 2, :], 9)
    assert {tuple(u) for u in (ups + 0.0)} == {tuple(s * np.eye(3)[a] + 0.0) for a in range(3) for s in (1.0, -1.0)}


def test_the_24_orientations_are_eight_about_each_axis() -> None:
    (recording, *_) = plan("orientations_24", Course(validation_s=0.0, static_s=0.0), np.random.default_rng(0))
    moves = recording.trajectory
    assert isinstance(moves, RestsAndMoves)
    ups = moves.attitudes()[:, 2, :]
    assert len(ups) == 24
    for axis in range(3):
        level = ups[8 * axis : 8 * axis + 8]
        np.testing.assert_allclose(level[:, axis], 0.0, atol=1e-12)
        first, second = level[:, (axis + 1) % 3], level[:, (axis + 2) % 3]
        steps = np.diff(np.unwrap(np.arctan2(second, first)))
        np.testing.assert_allclose(np.abs(np.degrees(steps)), 45.0, atol=1e-9)


@pytest.mark.parametrize("sense", [1, -1])
def test_one_shaft_has_one_direction_in_the_room_in_the_turns_about_all_axes(sense: int) -> None:
    directions = directions_of_shaft(np.array([0.01, -0.02]), sense)
    for axis in range(3):
        shaft = level_at_zero(axis, shaft=sense) @ TurnErrors(direction=directions[axis]).turn_axis(axis)
        np.testing.assert_allclose(sense * shaft, np.array([1.0, 0.01, -0.02]) / np.linalg.norm([1.0, 0.01, -0.02]))
