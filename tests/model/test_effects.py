"""What effects add is what physics says, by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bench_session import K, Session, record
from scipy.spatial.transform import Rotation

from pipeline.core.errors import ConfigurationError, InputError
from pipeline.core.records import Coefficient, FittedEffect, Motion, Recording, SensorCalibration
from pipeline.physics.effects import effect
from pipeline.physics.effects.base import parameter_limits, turning_direction
from pipeline.physics.kinematics import reference_motion
from pipeline.physics.measurement import predicted_reading

ONE = np.eye(3)


def turn(axis: str = "z", rate: float = 90.0, temperature: float | None = None) -> Recording:
    time = np.arange(0.0, 4.0, 0.01)
    return Recording(
        "turn",
        "gyroscope",
        axis,
        np.round(time * 1e9).astype(np.int64),
        table_angle=rate * time,
        table_rate=np.full(len(time), rate),
        temperature=None if temperature is None else np.full(len(time), temperature),
    )


def test_lever_arm_across_the_axis_is_a_centripetal_pull_toward_it() -> None:
    added = effect("lever_arm").reading("accelerometer", reference_motion(turn()), ONE, np.array([0.05, 0.0, 0.0]))
    pull = np.radians(90.0) ** 2 * 0.05 / 9.80665
    np.testing.assert_allclose(added, np.tile([-pull, 0.0, 0.0], (len(added), 1)), atol=1e-12)


def test_lever_arm_along_the_axis_adds_nothing() -> None:
    added = effect("lever_arm").reading("accelerometer", reference_motion(turn()), ONE, np.array([0.0, 0.0, 0.3]))
    np.testing.assert_allclose(added, 0.0, atol=1e-12)


def test_a_common_inner_lever_arm_is_the_lever_arm_of_the_unit() -> None:
    motion, r = reference_motion(turn("x")), np.array([0.02, -0.01, 0.03])
    inner = effect("inner_lever_arms").reading("accelerometer", motion, ONE, np.tile(r, 3))
    np.testing.assert_allclose(inner, effect("lever_arm").reading("accelerometer", motion, ONE, r), atol=1e-15)


def test_asymmetry_makes_the_scale_factor_of_both_signs_differ_by_twice_its_size() -> None:
    motion = reference_motion(turn("x"))
    u = motion.specific_force
    reading = u + effect("scale_factor_asymmetry").reading("accelerometer", motion, ONE, np.full(3, 0.01))
    np.testing.assert_allclose(reading[u > 0.1] / u[u > 0.1], 1.01)
    np.testing.assert_allclose(reading[u < -0.1] / u[u < -0.1], 0.99)


def test_temperature_effects_vanish_at_25_degrees() -> None:
    motion = reference_motion(turn(temperature=25.0))
    for name, count in (("bias_temperature", 3), ("bias_temperature_quadratic", 6), ("scale_factor_temperature", 3)):
        np.testing.assert_allclose(effect(name).reading("gyroscope", motion, ONE, np.ones(count)), 0.0, atol=1e-10)


def test_an_effect_of_temperature_says_so_where_the_recording_holds_none() -> None:
    with pytest.raises(InputError, match="depends on the temperature, but the recording turn holds none"):
        effect("bias_temperature").reading("gyroscope", reference_motion(turn()), ONE, np.ones(3))


def test_time_offset_shows_the_motion_of_a_later_time() -> None:
    motion = reference_motion(turn("x", rate=50.0))
    added = effect("time_offset").reading("accelerometer", motion, ONE, np.array([0.02]))
    angle = np.radians(50.0 * (motion.time + 0.02))
    expected = np.column_stack([np.zeros_like(angle), np.sin(angle), np.cos(angle)]) - motion.specific_force
    np.testing.assert_allclose(added, expected, atol=1e-12)


def test_time_offset_and_clock_rate_add_up() -> None:
    motion, sensor = reference_motion(turn("x", rate=50.0)), "accelerometer"
    both = effect("clock_rate").moved(effect("time_offset").moved(motion, np.array([0.02])), np.array([5000.0]))
    np.testing.assert_allclose(both.angle, 50.0 * (motion.time + 0.02 + 0.005 * motion.time), atol=1e-9)
    assert effect("clock_rate").parameters(sensor)[0].unit == "ppm"


def test_lag_of_a_steady_turn_is_a_delay_and_an_attenuation() -> None:
    motion, tau = reference_motion(turn("x", rate=50.0)), 0.019
    shown = effect("low_pass_lag").moved(motion, np.array([tau])).specific_force[100:]
    angle, w = np.radians(50.0 * motion.time[100:]), np.radians(50.0) * tau
    gain, delay = 1 / np.sqrt(1 + w**2), np.arctan(w)
    np.testing.assert_allclose(shown[:, 1], gain * np.sin(angle - delay), atol=1e-9)
    np.testing.assert_allclose(shown[:, 2], gain * np.cos(angle - delay), atol=1e-9)


def test_backlash_puts_the_angle_behind_in_the_direction_of_the_turn() -> None:
    for rate in (30.0, -30.0):
        motion = reference_motion(turn("x", rate=rate))
        added = effect("table_backlash").reading("accelerometer", motion, ONE, np.array([0.1, 0.0, 0.0]))
        angle = np.radians(motion.angle - 0.1 * np.sign(rate))
        np.testing.assert_allclose((motion.specific_force + added)[:, 1], np.sin(angle), atol=2e-6)


@pytest.mark.parametrize("up", ["", "+z", "-z"])
def test_a_leaning_turn_axis_turns_gravity_about_itself(up: str) -> None:
    recording, lean = replace(turn("z"), up=up), np.array([0.05, -0.03])
    motion, values = reference_motion(recording), np.concatenate([np.zeros(4), lean])
    added = effect("table_axis_nonorthogonality").reading("accelerometer", motion, ONE, values)
    axis = np.append(np.radians(lean), 1.0)  # what the two body axes after z, x and y, add to it
    back = Rotation.from_rotvec(np.outer(-np.radians(motion.angle), axis / np.linalg.norm(axis)))
    expected = back.apply(motion.specific_force[0])
    np.testing.assert_allclose(motion.specific_force + added, expected, atol=3e-6)  # of second order


@pytest.mark.parametrize("name", ["validation", "gyro_x"])
def test_the_rate_of_the_specific_force_is_its_derivative(name: str) -> None:
    recording = next(r for r in record(Session(1)) if r.name == name)
    motion = reference_motion(recording)
    assert motion is not None
    slope = np.gradient(motion.specific_force, motion.time, axis=0)
    assert np.abs(slope).max() > 0.3
    assert np.percentile(np.abs(motion.specific_force_rate - slope), 90.0) < 0.01 * np.abs(slope).max()


def test_direction_of_a_step_between_samples_is_kept_at_rest() -> None:
    time = np.arange(0.0, 6.0, 0.12)
    angle = np.select([time < 2, time < 4], [0.0, 5.0], 2.0)
    motion = reference_motion(
        Recording(
            "steps",
            "accelerometer",
            "y",
            np.round(time * 1e9).astype(np.int64),
            table_angle=angle,
            table_rate=np.zeros_like(time),
        )
    )
    np.testing.assert_array_equal(turning_direction(motion)[:, 1], np.select([time < 2, time < 4], [0.0, 1.0], -1.0))


def test_earth_rotation_at_rest_is_its_part_along_each_axis() -> None:
    motion = reference_motion(turn("z", rate=0.0))
    added = effect("earth_rotation").reading("gyroscope", motion, ONE, np.array([0.001, 0.002, 0.003]))
    np.testing.assert_allclose(added[0], [0.003, 0.002, -0.001])  # body x is up, y level y, z level -x


def test_timing_moves_the_motion_that_other_effects_see() -> None:
    motion = reference_motion(turn("x", rate=50.0))
    fitted = tuple(
        FittedEffect(
            n,
            {
                p.name: Coefficient(v, p.unit, 0.0)
                for p, v in zip(effect(n).parameters("accelerometer"), values, strict=True)
            },
        )
        for n, values in (("quadratic_nonlinearity", [0.01] * 3), ("time_offset", [0.1]))
    )
    calibration = SensorCalibration("accelerometer", effects=fitted)
    u = effect("time_offset").moved(motion, np.array([0.1])).specific_force
    np.testing.assert_allclose(predicted_reading(calibration, motion), u + 0.01 * u**2, atol=1e-12)


def test_an_unknown_effect_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ConfigurationError, match="no effect is called 'magic'; known: bias_drift"):
        effect("magic")


def test_effects_of_single_turn_axes_leave_other_motion_alone() -> None:
    validation = next(r for r in record(Session(1)) if r.role == "validation")
    motion = reference_motion(validation)
    assert isinstance(motion, Motion)
    for name in ("table_encoder_error", "table_rate_ripple", "table_axis_nonorthogonality"):
        assert not np.any(effect(name).reading("accelerometer", motion, K["accelerometer"], np.ones(6)))


def test_parameters_of_another_unit_have_a_limit_of_their_own() -> None:
    limits = {"warm_up": 0.01, "warm_up_time_constant": 600.0}
    assert parameter_limits(effect("warm_up"), "accelerometer", limits).tolist() == [0.01, 0.01, 0.01, 600.0]
    limits = {"bias_temperature_quadratic": 1e-3, "bias_temperature_quadratic_b_T2": 1e-5}
    found = parameter_limits(effect("bias_temperature_quadratic"), "gyroscope", limits)
    assert found.tolist() == [1e-3, 1e-5] * 3


def test_an_effect_without_a_limit_has_none() -> None:
    assert np.all(np.isinf(parameter_limits(effect("g_sensitivity"), "gyroscope", {})))
