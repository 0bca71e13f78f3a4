"""Smoothing takes the thermometer's noise off and leaves the temperature as it was, corners of a ramp too."""

import numpy as np
import pytest

from pipeline.signal.filters import smooth_temperature

TIME = np.arange(0.0, 120.0, 0.12)
NOISE = 0.03


def read(truth: np.ndarray, seed: int) -> np.ndarray:
    return truth + NOISE * np.random.default_rng(seed).standard_normal(len(truth))


@pytest.mark.parametrize("slope", [0.0, 0.12, -2.0])
def test_a_straight_ramp_loses_most_of_its_noise_at_the_ends_too(slope: float) -> None:
    truth = 25.0 + slope * TIME
    errors = [smooth_temperature(TIME, read(truth, seed)) - truth for seed in range(30)]
    assert np.sqrt(np.mean(np.square(errors))) < NOISE / 8.0  # of 1/sqrt(2 sqrt(pi) 10 s / 0.12 s) = 1/17 in the middle
    assert np.sqrt(np.mean(np.square(np.array(errors)[:, [0, -1]]))) < NOISE / 4.0


def test_a_corner_is_rounded_by_no_more_than_the_noise_hides() -> None:
    truth = 25.0 + 0.12 * np.minimum(TIME, 120.0 - TIME)  # 10 s wide, the kernel would round it by 0.96 degC
    for seed in range(30):
        assert np.abs(smooth_temperature(TIME, read(truth, seed)) - truth).max() < 0.2


def test_without_noise_a_slow_curve_is_followed() -> None:
    truth = 25.0 + 3.0 * np.sin(TIME / 60.0)
    assert np.abs(smooth_temperature(TIME, truth) - truth).max() < 3e-3


def test_coarse_counts_are_not_taken_for_corners() -> None:
    truth = 25.0 + 0.01 * TIME
    coarse = np.round(truth / 0.0625) * 0.0625
    assert np.abs(smooth_temperature(TIME, coarse) - truth).max() < 0.05
    constant = np.full_like(TIME, 21.5)
    np.testing.assert_allclose(smooth_temperature(TIME, constant), constant, rtol=1e-12)
