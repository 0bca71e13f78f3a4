"""Residuals over temperature show what a calibration leaves of it."""

import numpy as np
import pytest

from pipeline.core.records import Coefficient, FittedEffect, SensorCalibration
from pipeline.evaluation.held_out.samples import Samples
from pipeline.evaluation.held_out.validation import residuals_over_temperature

SLOPE = 2e-3  # g/degC, of z


def samples(low: float, high: float, *, warm: bool = True) -> Samples:
    """Rests with z up while the temperature rises; the truth is 1 g."""
    n, rng = 400, np.random.default_rng(3)
    T = np.linspace(low, high, n)
    reading = np.column_stack([np.zeros(n), np.zeros(n), 1.0 + SLOPE * (T - 25.0)]) + 1e-4 * rng.standard_normal((n, 3))
    noise = np.full((n, 3), 1e-8)
    temperature = T if warm else None
    return Samples("accelerometer", np.arange(n) / 10.0, reading, np.ones(n), noise, noise, None, None, temperature)


def test_a_slope_that_is_not_modelled_is_the_mean_residual_of_the_bins() -> None:
    found = residuals_over_temperature(SensorCalibration("accelerometer"), [samples(10.0, 40.0)])
    assert found is not None
    assert [b.temperature_degc for b in found] == pytest.approx([12.5, 17.5, 22.5, 27.5, 32.5, 37.5], abs=0.1)
    for b in found:
        assert b.mean_error == pytest.approx(SLOPE * (b.temperature_degc - 25.0), abs=4e-5)
        assert b.rms_error >= abs(b.mean_error)
    assert sum(b.samples for b in found) >= 399


def test_a_slope_that_is_modelled_leaves_noise() -> None:
    values = {"b_T_x": 0.0, "b_T_y": 0.0, "b_T_z": SLOPE}
    effect = FittedEffect("bias_temperature", {k: Coefficient(v, "g/degC") for k, v in values.items()})
    found = residuals_over_temperature(SensorCalibration("accelerometer", effects=(effect,)), [samples(10, 40)])
    assert found is not None
    assert max(abs(b.mean_error) for b in found) < 5e-5
    assert [b.rms_error for b in found] == pytest.approx([1e-4] * 6, rel=0.3)


def test_a_temperature_that_was_not_swept_or_not_recorded_gives_none() -> None:
    c = SensorCalibration("accelerometer")
    assert residuals_over_temperature(c, [samples(25.0, 33.0)]) is None
    assert residuals_over_temperature(c, [samples(10.0, 40.0, warm=False)]) is None
    assert residuals_over_temperature(c, []) is None
