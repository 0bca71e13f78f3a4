"""Readings in steps that hide their noise: errors stay within U."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hand_session import METHODS
from unit_settings import settings_of, with_noise

from pipeline.core.records import BIAS, base_values
from pipeline.estimation.stages import StageInput
from pipeline.estimation.stated_lines import with_stated
from pipeline.physics.signal.quiet_motion import rounding_of
from pipeline.simulation.campaign import simulate_unit
from pipeline.simulation.description import UnitDescription

SETTINGS = settings_of(sensor="mpu6050", table="hand", procedure="multi_position")


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize(("sensor", "step"), [("gyroscope", 0.125), ("gyroscope", 0.5), ("accelerometer", 0.01)])
def test_the_bias_is_within_an_uncertainty_that_holds_the_rounding(sensor: str, step: float, seed: int) -> None:
    unit = UnitDescription("U", sensor="mpu6050", table="hand", procedure="multi_position", interval_s=0.02)
    recordings, truth = simulate_unit(unit, seed, 0)
    coarse = [replace(r, **{sensor: step * np.round(r.reading(sensor) / step)}) for r in recordings]
    with_noises = with_noise(coarse, SETTINGS)
    found = with_stated(METHODS[sensor].fit(StageInput(sensor, with_noises, None, SETTINGS)), with_noises, SETTINGS)
    U = found.parameters.expanded_uncertainty[BIAS]
    error = base_values(found.bias, found.matrix)[BIAS] - truth[sensor]["bias"]
    assert np.all(np.abs(error) < 2.0 * U)
    if sensor == "accelerometer":  # the gyroscope's moves cross the steps, and determine its bias better than its rests
        assert np.all(step / np.sqrt(12.0) < U)


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.2, 0.3, 0.4])
def test_the_rounding_error_of_a_mean_is_that_of_values_anywhere_in_a_step(noise: float) -> None:
    step, rng = 0.5, np.random.default_rng(1)
    value = step * (np.arange(50) + 0.5) / 50  # evenly within a step
    noisy = value[:, None] + noise * step * rng.standard_normal((50, 40_000))
    error = (step * np.round(noisy / step)).mean(axis=1) - value
    scatter = np.hypot(noise * step, step / np.sqrt(12.0))  # of the readings, over all values
    _, u = rounding_of([(np.full(3, step), np.full(3, scatter))])
    allowance = 0.002 * step  # the mean of 40,000 readings with noise of 0.4 steps scatters by as much
    assert np.sqrt(np.mean(error**2)) == pytest.approx(u[0], rel=0.03, abs=allowance)
