"""The interval of the expected error, against many simulated units whose noise and calibration errors are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from unit_settings import settings_of

from pipeline.core.records import Noise, SensorCalibration
from pipeline.evaluation.held_out.error_breakdown import LinearizedSamples, expected_rms_error
from pipeline.evaluation.held_out.samples import Samples

UNITS, SAMPLES, INTERVAL = 2000, 300, 0.2
WHITE, TAU = 0.01, 20.0
IDEAL = settings_of()
EXACT = {s: IDEAL.sensor.of(s).replaced(counts_per_unit=np.inf) for s in ("accelerometer", "gyroscope")}
UNROUNDED = IDEAL.sensor.replaced(**EXACT)  # without quantisation


def truth_of(size: float) -> np.ndarray:
    turning = np.random.default_rng(3).standard_normal((30, 3)).repeat(SAMPLES // 30, axis=0)
    return size * turning / np.linalg.norm(turning, axis=1, keepdims=True)


def wander_of(rng: np.random.Generator, size: float) -> np.ndarray:
    """Return Gauss-Markov paths: (units, n, 3) array."""
    decay = np.exp(-INTERVAL / TAU)
    drive = rng.standard_normal((UNITS, SAMPLES, 3))
    out = np.empty_like(drive)
    out[:, 0] = drive[:, 0]
    for n in range(1, SAMPLES):
        out[:, n] = decay * out[:, n - 1] + np.sqrt(1.0 - decay**2) * drive[:, n]
    return size * out


@pytest.mark.parametrize(
    ("size", "wander", "bias"),
    [(1.0, 0.0, 0.0), (1.0, 0.01, 0.0), (1.0, 0.002, 0.015), (0.0, 0.0, 0.003), (0.012, 0.004, 0.0)],
    ids=["white", "wander", "bias", "at rest", "near rest"],
)
def test_the_interval_holds_99_percent_of_units_whose_noise_is_known(size: float, wander: float, bias: float) -> None:
    rng = np.random.default_rng(5)
    truth = truth_of(size)
    error = WHITE * rng.standard_normal((UNITS, SAMPLES, 3)) + wander_of(rng, wander)
    error += bias * rng.standard_normal((UNITS, 1, 3))
    rms = np.sqrt(np.mean((np.linalg.norm(truth + error, axis=2) - np.linalg.norm(truth, axis=1)) ** 2, axis=1))
    low, high = interval(truth, Noise(np.full(3, WHITE), np.full(3, wander), TAU, "static", length=1e9), bias)
    assert np.mean(rms > high) < 0.01
    assert np.mean(rms < low) < 0.01
    assert high < 1.35 * np.quantile(rms, 0.995)  # what is known needs no wide interval


def interval(
    truth: np.ndarray,
    noise: Noise,
    bias: float,
    freedom: float = np.inf,
    *,
    scale: float = 0.0,
    of_scale: float = np.inf,
    correlated: float = 1.0,
) -> tuple[float, float]:
    """Return the interval; ``bias, scale``: standard uncertainties, of ``freedom`` and ``of_scale``.

    ``correlated``: samples of the noise that count as one.
    """
    covariance, J = np.zeros((12, 12)), np.zeros((SAMPLES, 3, 12))
    covariance[:3, :3] = bias**2 * np.eye(3)
    J[:, :, :3] = -np.eye(3)
    for axis in range(3):
        covariance[3 + 4 * axis, 3 + 4 * axis] = scale**2
        J[:, axis, 3 + 4 * axis] = truth[:, axis]
    each = np.repeat([freedom, of_scale], [3, 9])
    smallest = min(freedom, of_scale)
    found = SensorCalibration("gyroscope", covariance=covariance, degrees_of_freedom=smallest, freedom=each)
    spread = [np.broadcast_to(v**2, (SAMPLES, 3)) for v in (noise.white, noise.wander)]
    reference = truth, np.linalg.norm(truth, axis=1)
    samples = Samples("gyroscope", INTERVAL * np.arange(SAMPLES), *reference, *spread, None, None, None)
    held_out = LinearizedSamples(replace(samples, correlated_samples=correlated), truth, J, SAMPLES)
    return expected_rms_error(found, [held_out], noise, IDEAL.replaced(sensor=UNROUNDED))


def test_the_interval_holds_99_percent_of_units_whose_noise_a_filter_has_correlated() -> None:
    rng, truth, keep = np.random.default_rng(6), truth_of(1.0), 0.9
    drive = np.sqrt(1.0 - keep**2) * rng.standard_normal((UNITS, SAMPLES + 100, 3))
    error = WHITE * lfilter([1.0], [1.0, -keep], drive, axis=1)[:, 100:]
    rms = np.sqrt(np.mean((np.linalg.norm(truth + error, axis=2) - 1.0) ** 2, axis=1))
    noise = Noise(np.full(3, WHITE), np.zeros(3), TAU, "static", length=1e9)
    low, high = interval(truth, noise, 0.0, correlated=(1.0 + keep**2) / (1.0 - keep**2))  # sum of squared correlations
    assert np.mean(rms > high) < 0.015
    assert np.mean(rms < low) < 0.015
    assert high < 1.35 * np.quantile(rms, 0.995)


def test_what_is_less_known_widens_the_interval() -> None:
    truth = truth_of(1.0)
    noise = Noise(np.full(3, WHITE), np.full(3, 0.5 * WHITE), TAU, "static", length=1e9)
    known = interval(truth, noise, 0.0)
    for less in (replace(noise, length=60.0), replace(noise, source="rests", length=0.0)):
        low, high = interval(truth, less, 0.0)
        assert low <= known[0] * 1.001
        assert high > 1.05 * known[1]
    few, many = interval(truth, noise, WHITE, freedom=3.0), interval(truth, noise, WHITE)
    assert few[1] > 1.2 * many[1]


def test_degrees_of_freedom_are_those_of_the_parameters_that_the_samples_show() -> None:
    """Few moves say little of the noise of a matrix, and a rest of a gyroscope shows the bias alone."""
    rng, freedom = np.random.default_rng(7), 22.0
    scatter = np.sqrt(rng.chisquare(freedom, UNITS) / freedom)  # the uncertainty that a fit states over the true one
    rms = np.linalg.norm(rng.standard_normal((UNITS, 3)), axis=1) / scatter
    nothing = Noise(np.full(3, 1e-6), np.zeros(3), TAU, "static", length=1e9)
    _, high = interval(truth_of(0.0), nothing, 1.0, freedom, scale=0.1, of_scale=1.9)
    assert np.mean(rms > high) < 0.01
    assert high < 1.35 * np.quantile(rms, 0.995)
    _, turning = interval(truth_of(10.0), nothing, 1e-6, freedom, scale=0.1, of_scale=1.9)
    assert turning > 3.0 * interval(truth_of(10.0), nothing, 1e-6, freedom, scale=0.1, of_scale=freedom)[1]


def test_without_noise_or_uncertainty_nothing_is_expected() -> None:
    assert interval(truth_of(1.0), Noise(np.zeros(3), np.zeros(3), TAU, "none"), 0.0) == (0.0, 0.0)
