"""Exact geometry and simulated readings against physics worked out by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from pipeline.ingest.clock_alignment import Program
from pipeline.physics.effects import catalogue, effect
from pipeline.physics.effects.base import Owner, truth
from pipeline.physics.effects.formula_effect import FormulaEffect
from pipeline.physics.kinematics import earth_rate
from pipeline.simulation.description import shipped_settings
from pipeline.simulation.sensor import (
    ALTERATIONS,
    STANDARD_GRAVITY,
    Scene,
    SimulatedSensor,
    alter,
    bias_wander,
    decimals_of,
)
from pipeline.simulation.trajectory import (
    CommandedTurns,
    TurnErrors,
    random_gimbals,
    rest,
    rotation_by,
    turn_with_plateau,
)

if TYPE_CHECKING:
    from pipeline.core.records import Motion

SIZES = {
    "lever_arm": 0.05, "time_offset": 1e-4, "clock_rate": 1.0, "low_pass_lag": 1e-4, "earth_rotation": 4e-3,
    "table_tilt": 1e-3, "table_axis_nonorthogonality": 1e-3, "table_encoder_error": 1e-3, "table_rate_ripple": 1e-5,
    "table_backlash": 1e-3,
}  # fmt: skip


def turn_scene(axis: int = 2, rate: float = 200.0, acceleration: float = 100.0) -> Scene:
    there, back = (turn_with_plateau(angle, rate, acceleration) for angle in (360.0, -360.0))
    return Scene(CommandedTurns(axis, Program([rest(1.0), there, rest(1.0), back, rest(1.0)])), axis=axis)


def test_a_lever_arm_of_5_cm_at_200_deg_s_reads_omega_squared_r() -> None:
    scene = alter(turn_scene(), {"lever_arm": np.array([0.05, 0.0, 0.0])})
    time = np.array([3.3])  # on the plateau: 1 s rest, 2 s ramp, 1.8 s plateau
    added = scene.motion(time).specific_force - turn_scene().motion(time).specific_force
    expected = -(np.radians(200.0) ** 2) * 0.05 / 9.80665  # toward the axis
    np.testing.assert_allclose(added, [[expected, 0.0, 0.0]], atol=1e-12)
    assert -expected == pytest.approx(0.0621, abs=1e-4)


def test_a_lever_arm_reads_the_tangential_acceleration_of_a_ramp() -> None:
    scene = alter(turn_scene(), {"lever_arm": np.array([0.05, 0.0, 0.0])})
    time = np.array([1.0])  # the ramp begins: no rate yet
    added = scene.motion(time).specific_force - turn_scene().motion(time).specific_force
    np.testing.assert_allclose(added, [[0.0, np.radians(100.0) * 0.05 / STANDARD_GRAVITY, 0.0]], atol=1e-12)


@pytest.mark.parametrize("offset", [-0.02, 0.013])
def test_a_time_offset_shows_the_motion_of_another_time_exactly(offset: float) -> None:
    scene = turn_scene()
    time = np.arange(0.0, 12.0, 0.12)
    late = alter(scene, {"time_offset": np.array([offset])}).motion(time)
    there = scene.motion(time + offset)
    assert np.array_equal(late.time, time)
    for name in ("specific_force", "angular_rate", "angular_acceleration", "specific_force_rate"):
        assert np.array_equal(getattr(late, name), getattr(there, name))


def test_a_lag_of_a_steady_ramp_is_a_delay_by_its_time_constant() -> None:
    scene = alter(turn_scene(), {"low_pass_lag": np.array([0.02])})
    time = np.array([2.5])  # 1.5 s into the ramp of 100 deg/s^2
    assert scene.motion(time).angular_rate[0, 2] == pytest.approx(100.0 * (1.5 - 0.02), abs=1e-5)


def test_a_lag_turns_gravity_by_the_gain_and_phase_of_a_first_order_filter() -> None:
    tau, rate = 0.05, np.radians(200.0)
    scene = alter(turn_scene(axis=0), {"low_pass_lag": np.array([tau])})
    time = np.array([4.7])  # 1.7 s after the ramp: the transient is gone
    y, z = scene.motion(time).specific_force[0, 1:]
    plain_y, plain_z = turn_scene(axis=0).motion(time).specific_force[0, 1:]
    answer = complex(z, y) / complex(plain_z, plain_y)
    assert abs(answer) == pytest.approx(1.0 / np.hypot(1.0, rate * tau), abs=1e-6)
    assert np.angle(answer) == pytest.approx(-np.arctan(rate * tau), abs=1e-6)


def test_a_lag_rounds_the_corner_of_a_ramp_as_a_first_order_filter_does() -> None:
    tau = 0.02
    scene = alter(turn_scene(), {"low_pass_lag": np.array([tau])})
    time = np.linspace(1.0, 1.3, 200)  # the ramp of 100 deg/s^2 begins at 1 s
    s = time - 1.0
    expected = 100.0 * (s - tau * (1.0 - np.exp(-s / tau)))
    np.testing.assert_allclose(scene.motion(time).angular_rate[:, 2], expected, atol=5e-4)


def test_earth_rotation_is_sensed_along_the_body_axes() -> None:
    level = earth_rate(13.7, 30.0)
    scene = alter(Scene(random_gimbals(60.0, 40.0, np.random.default_rng(2))), {"earth_rotation": level})
    time = np.linspace(0.0, 60.0, 50)
    plain = Scene(scene.trajectory).motion(time)
    added = scene.motion(time).angular_rate - plain.angular_rate
    np.testing.assert_allclose(np.linalg.norm(added, axis=1), 360.0 / 86164.0905, rtol=1e-9)
    # the vertical part is what is sensed along gravity
    np.testing.assert_allclose(np.sum(added * plain.specific_force, axis=1), level[2], atol=1e-12)


def test_effects_of_timing_and_of_the_table_in_python_have_exact_geometry() -> None:
    physical = {name: kind for name, kind in catalogue().items() if kind.owner in (Owner.MOUNTING, Owner.TABLE)}
    in_python = {name for name, kind in physical.items() if not isinstance(kind, FormulaEffect) and not kind.of_turns}
    assert in_python <= set(ALTERATIONS) <= set(physical)
    assert set(ALTERATIONS) == set(SIZES)
    assert {name for name, kind in physical.items() if kind.of_turns} == {"mounting", "encoder_zero"}  # tested below


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_mounting_and_a_zero_of_one_recording_are_the_rotations_of_their_effects(axis: int) -> None:
    time, plain = np.arange(0.03, 12.0, 0.12), turn_scene(axis=axis)
    theta, zero = np.array([1.5, -2.0, 0.7]), 3.0
    program = plain.trajectory.program
    ahead = Program(program.steps)
    ahead.knots[:, 1] += zero
    turned = replace(plain, trajectory=CommandedTurns(axis, ahead))
    for name, values, log, true in (
        ("mounting", theta, plain, replace(plain, mounting=rotation_by(theta))),
        ("encoder_zero", np.array([zero]), turned, plain),
    ):
        kind = effect(name).of_recordings({"turn": ""})
        moved = kind.moved(replace(log.motion(time), recording="turn"), values)
        exact = true.motion(time)
        for vector in ("specific_force", "angular_rate", "angular_acceleration", "specific_force_rate"):
            np.testing.assert_allclose(getattr(moved, vector), getattr(exact, vector), atol=1e-11)


@pytest.mark.parametrize("name", sorted(ALTERATIONS))
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_exact_geometry_agrees_with_the_columns_of_the_catalogue_at_small_sizes(name: str, axis: int) -> None:
    kind, scene = effect(name), turn_scene(axis=axis)
    time = np.arange(0.03, 12.0, 0.12)
    knots = scene.trajectory.program.knots
    # a lag remembers the corners of the ramps for some time constants; elsewhere its column holds
    time = time[np.array([np.all((t - knots < -1e-2) | (t - knots > 1e-2)) for t in time])]
    plain = scene.motion(time)
    values = SIZES[name] * np.random.default_rng(5).uniform(0.3, 1.0, len(kind.parameters(kind.sensors[0])))
    for sensor in kind.sensors:
        exact = truth(sensor, alter(scene, {name: values}).motion(time)) - truth(sensor, plain)
        linear = kind.columns(sensor, plain, np.eye(3), np.zeros(len(values))) @ values
        scale = max(np.abs(exact).max(), 1e-12)
        np.testing.assert_allclose(linear, exact, atol=2e-3 * scale)


def test_errors_of_a_turn_leave_other_motions_alone() -> None:
    scene = Scene(random_gimbals(60.0, 40.0, np.random.default_rng(2)))
    assert alter(scene, {"table_encoder_error": np.ones(6), "table_backlash": np.ones(3)}) is scene


def test_a_shaking_plate_is_felt_while_it_turns_only() -> None:
    scene = turn_scene()
    shaken = replace(
        scene, trajectory=replace(scene.trajectory, errors=TurnErrors(shaking=0.05, vibration_frequency=7.3))
    )
    time = np.arange(0.0, 12.0, 0.01)
    plain, motion = scene.motion(time), shaken.motion(time)
    added = motion.specific_force - plain.specific_force
    moving = plain.rate != 0.0
    assert np.all(added[~moving] == 0.0)
    np.testing.assert_allclose(np.std(added[moving], axis=0), 0.05 / np.sqrt(2.0), rtol=0.02)
    np.testing.assert_array_equal(motion.angular_rate, plain.angular_rate)


SHEETS = shipped_settings(sensor="mpu6050").sensor

# Sudsanguan 2019, tables 5.1 to 5.6 (biases, medians) and 5.23 (scale factors), as restated with the before-errors
# that random attitudes give with them, g; the thesis prints 0.069, 0.023, 0.021 for its own motion.
DEVICES = {
    "MPU6050 (1)": ((0.049, -0.013, -0.1285), (1.001, 0.994, 0.980), 0.071),
    "MPU6050 (2)": ((0.041, -0.017, -0.001), (0.993, 0.996, 0.986), 0.024),
    "STIM300": ((-0.009, -0.0455, -0.009), (1.002, 1.003, 0.998), 0.023),
}


def a_motion() -> Motion:
    return Scene(random_gimbals(60.0, 40.0, np.random.default_rng(4))).motion(np.linspace(0.0, 60.0, 200))


def test_a_reading_is_bias_plus_the_inverse_matrix_times_the_truth_plus_effects() -> None:
    matrix = np.array([[1.02, 0.01, 0.0], [-0.02, 0.98, 0.03], [0.0, 0.01, 1.01]])
    sensitivity = np.random.default_rng(1).normal(0.0, 0.1, 9)
    sensor = SimulatedSensor(
        "gyroscope",
        SHEETS.gyroscope,
        np.array([1.0, -2.0, 0.5]),
        matrix,
        {"g_sensitivity": (effect("g_sensitivity"), sensitivity)},
    )
    motion = a_motion()
    added = motion.specific_force @ sensitivity.reshape(3, 3).T
    restored = (sensor.exact(motion) - sensor.bias - added) @ matrix.T
    np.testing.assert_allclose(restored, motion.angular_rate, atol=1e-12)


def test_white_noise_has_the_density_of_the_data_sheet_up_to_the_nyquist_frequency() -> None:
    sensor = SimulatedSensor("gyroscope", SHEETS.gyroscope, np.zeros(3), np.eye(3))
    assert sensor.data_sheet.white(0.01) == pytest.approx(0.005 * np.sqrt(50.0))
    assert sensor.data_sheet.white(0.12) == pytest.approx(0.0102062, abs=1e-7)


def test_readings_are_whole_counts_and_stop_at_full_scale() -> None:
    sensor = SimulatedSensor("accelerometer", SHEETS.accelerometer, np.zeros(3), np.eye(3))
    counts = sensor.quantised(np.array([[0.1, -5.0, 5.0]])) * 16384.0
    assert counts.tolist() == [[1638.0, -32768.0, 32767.0]]
    assert decimals_of(sensor.data_sheet) == 6  # half a unit of the last digit is 0.008 counts


def test_wander_has_unit_variance_and_its_correlation_time_within_recordings_and_across_pauses() -> None:
    rng = np.random.default_rng(11)
    values, later, across = [], [], []
    sessions = [np.arange(0.0, 60.0, 1.0), np.arange(110.0, 170.0, 1.0)]
    for _ in range(1500):
        first, second = bias_wander(sessions, 100.0, rng)
        values.append(first[0])
        later.append(first[50])
        across.append(second[0])
    start = np.ravel(values)
    # 4500 draws: the standard error of a variance is sqrt(2/4500) = 0.021, that of a correlation about 0.015
    for sample in (start, np.ravel(later), np.ravel(across)):
        assert np.var(sample) == pytest.approx(1.0, abs=0.063)
    assert np.mean(start * np.ravel(later)) == pytest.approx(np.exp(-0.5), abs=0.045)
    assert np.mean(start * np.ravel(across)) == pytest.approx(np.exp(-1.1), abs=0.045)


def test_wander_of_a_long_rest_has_the_allan_variance_of_a_gauss_markov_process() -> None:
    tau, step = 20.0, 0.5
    (process,) = bias_wander([np.arange(0.0, 40000.0, step)], tau, np.random.default_rng(3))
    for window in (5.0, 20.0, 80.0):
        m = round(window / step)
        means = process[: len(process) // m * m].reshape(-1, m, 3).mean(1)
        allan = 0.5 * np.mean(np.diff(means, axis=0) ** 2)
        x = window / tau  # IEEE Std 952-2020, annex C: exponentially correlated noise of unit variance
        expected = (2.0 / x) * (1.0 - (1.0 / (2.0 * x)) * (3.0 - 4.0 * np.exp(-x) + np.exp(-2.0 * x)))
        assert allan == pytest.approx(expected, rel=4.0 * np.sqrt(1.5 / means.size) + 0.01)


@pytest.mark.parametrize("device", DEVICES)
def test_random_attitudes_with_the_published_parameters_give_the_published_error(device: str) -> None:
    bias, scale, published = DEVICES[device]
    sensor = SimulatedSensor("accelerometer", SHEETS.accelerometer, np.array(bias), np.diag(scale))
    attitudes = np.random.default_rng(8).normal(size=(40000, 3))
    attitudes /= np.linalg.norm(attitudes, axis=1, keepdims=True)
    motion = replace(a_motion(), specific_force=attitudes)
    error = np.mean(np.abs(np.linalg.norm(sensor.exact(motion), axis=1) - 1.0))
    assert error == pytest.approx(published, abs=0.0011)
