"""A table whose stated errors are many times the noise: its errors count once, against simulated truth."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from unit_settings import settings_of, with_noise

from pipeline.estimation.accelerometer import nonlinear_least_squares
from pipeline.estimation.engine import LinearMap
from pipeline.estimation.gauss_markov import Blocks
from pipeline.estimation.reference_least_squares import fit
from pipeline.estimation.stages import StageInput, fit_stage
from pipeline.estimation.table_errors import Reference, disturbance, table_errors
from pipeline.output.exports.sensors import rotation_times_lower
from pipeline.physics.kinematics import table_motion
from pipeline.simulation.campaign import simulate_unit
from pipeline.simulation.description import UnitDescription

if TYPE_CHECKING:
    from pipeline.core.records import Recording, SensorCalibration

UNITS = 10
COURSE = {"dwell_s": 1.2, "rates_dps": [60.0], "static_s": 0.0, "validation_s": 0.0}
SETTINGS = settings_of(sensor="mpu6050", table="mark2")


@cache
def _unit(number: int) -> tuple[list[Recording], dict[str, Any]]:
    unit = UnitDescription("U", table="mark2", procedure="three_axis_turns", course=COURSE)
    return simulate_unit(unit, 8, number)


def _ratios(found: list[SensorCalibration], true: list[np.ndarray]) -> np.ndarray:
    """Return stated uncertainty over the errors' size for each parameter, over all units."""
    errors = [np.append(f.bias, f.matrix) - t for f, t in zip(found, true, strict=True)]
    stated = [np.diag(f.covariance) for f in found if f.covariance is not None]
    size = np.mean(np.square(errors), axis=0)
    return np.sqrt(np.mean(stated, axis=0)[size > 0.0] / size[size > 0.0])


@pytest.mark.parametrize(("sensor", "shown"), [("accelerometer", 3.0), ("gyroscope", 1.0)])
def test_the_noise_of_the_readings_is_the_sensor_s_and_not_the_table_s(sensor: str, shown: float) -> None:
    found = [fit(StageInput(sensor, with_noise(_unit(n)[0], SETTINGS), None, SETTINGS)) for n in range(UNITS)]
    white = np.array([f.stages[-1].details.white_noise for f in found])
    true = _unit(0)[1][sensor]["noise"]["white"]
    residual = np.array([f.stages[-1].details.residual_rms for f in found])
    assert residual.mean() > shown * true
    assert white.mean() == pytest.approx(true, rel=0.1)
    truths = [_unit(n)[1][sensor] for n in range(UNITS)]
    ratios = _ratios(found, [np.append(t["bias"], t["matrix"]) for t in truths])
    assert ratios.max() < 2.2
    assert np.median(ratios) == pytest.approx(1.0, abs=0.3)


def test_the_length_of_gravity_is_not_charged_with_errors_of_the_attitude() -> None:
    found = [
        nonlinear_least_squares.fit(StageInput("accelerometer", with_noise(_unit(n)[0], SETTINGS), None, SETTINGS))
        for n in range(UNITS)
    ]
    true = []
    for n in range(UNITS):
        hidden = _unit(n)[1]["accelerometer"]
        true.append(np.append(hidden["bias"], rotation_times_lower(np.array(hidden["matrix"]))[1]))
    ratios = _ratios(found, true)
    assert ratios.max() < 2.2
    assert np.median(ratios) == pytest.approx(1.0, abs=0.3)


def test_an_effect_fitted_to_turns_of_different_speed_errors_leaves_the_bias_within_its_uncertainty() -> None:
    course = COURSE | {"step_deg": 15.0, "both_directions": True, "warm_up_rest_s": 10.0, "pause_s": 10.0}
    unit = UnitDescription("U", table="mark2", procedure="three_axis_turns", course=course)
    inside = []
    for n in range(UNITS):
        recordings, hidden = simulate_unit(unit, 1124, n)
        settings = settings_of(SETTINGS, effects={"gyroscope": ["g_sensitivity"]})
        part = fit_stage("gyroscope", "effects", with_noise(recordings, settings), None, settings).to_json()
        error = np.array(part["bias"]) - hidden["gyroscope"]["bias"]
        inside.append(np.abs(error) <= part["expanded_uncertainty"]["bias"])
    assert np.mean(inside) > 0.85  # 95 % by definition; 60 % if all turns about an axis had one error


def test_an_accuracy_that_does_not_touch_the_gyroscope_changes_nothing() -> None:
    plain = SETTINGS.replaced(table=settings_of().table)
    level = settings_of(plain, **{"table.levelling_deg": 5.0})
    first, second = (
        fit(StageInput("gyroscope", with_noise(_unit(0)[0], settings), None, settings)) for settings in (plain, level)
    )
    np.testing.assert_array_equal(np.asarray(first.covariance), np.asarray(second.covariance))


@pytest.mark.parametrize("sensor", ["accelerometer", "gyroscope"])
def test_the_errors_of_block_sums_have_the_covariance_that_an_explicit_matrix_of_the_sums_gives(sensor: str) -> None:
    motions = [m for r in _unit(0)[0][:4] if (m := table_motion(r, SETTINGS.table)) is not None]
    rows, rng = sum(len(motion.time) for motion in motions), np.random.default_rng(3)
    weight, each = rng.uniform(1.0, 4.0, rows), 331
    first = np.arange(0, rows, each)
    blocks = Blocks(first, np.add.reduceat(weight, first), first * 0.1, np.full(len(first), 30.0), first * 0)
    sums = np.zeros((len(first), rows))
    sums[np.arange(rows) // each, np.arange(rows)] = weight
    K = np.eye(3) + 0.02 * rng.standard_normal((3, 3))
    reference = Reference(sensor, motions, K, SETTINGS.table.replaced(rate_accuracy=0.01, wobble_deg=0.3))
    lines, _ = table_errors(reference, LinearMap((sums, sums, sums), ()).first())
    errors = disturbance(reference, np.zeros((rows, 3)), blocks, weight, np.full(3, 1e-6))
    assert errors is not None
    expected = np.sum([line.covariance for line in lines], axis=0)
    np.testing.assert_allclose(errors @ errors.T, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
