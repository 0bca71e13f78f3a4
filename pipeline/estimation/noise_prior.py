"""Prior of a sensor's noise before a fit: from an earlier stage, a static recording and the sensor file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import ConfigurationError, InputError
from pipeline.estimation.gauss_markov import FARTHEST, SHARPEST_WIDTH, STATED_WIDTH, Prior, fast
from pipeline.estimation.noise import estimate_noise, stated_time

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.records import Noise, Recording


def noise_of(sensor: str, recordings: Sequence[Recording], settings: Mapping[str, Any]) -> Noise | None:
    """Return the noise from an earlier stage, else estimate it; None if it cannot be estimated.

    ``settings``: ``noise`` by sensor, if an earlier stage has estimated it; ``sensor``, the sensor file.
    """
    if "noise" in settings:
        noise: Noise | None = settings["noise"][sensor]
        return noise
    try:
        return estimate_noise(sensor, list(recordings), dict(settings.get("sensor", {}).get(sensor) or {}))
    except (ConfigurationError, InputError):
        return None


def prior_of(sensor: str, recordings: Sequence[Recording], settings: Mapping[str, Any]) -> Prior:
    """Return the prior of the bias wander from the sensor file and a static recording.

    It is the prior of the sensor file times the likelihood of the static recording at each wander and correlation time.
    A standard deviation from a rest of length T, about ``T / (2 tau)`` independent values, has the relative uncertainty
    ``sqrt(tau / T)``. If that is below ``SHARPEST_WIDTH``, the likelihood is widened to that of a shorter rest, because
    no sensor is exactly a Gauss-Markov process. Above the likeliest wander, the likelihood is at least
    ``exp(-FARTHEST**2)`` of its maximum: the residuals of turns can show more wander than the rest (lack of fit). Noise
    that is correlated over seconds (a filter in the sensor, values repeated between samples, chance in a short rest)
    does not determine a slow wander, and is white noise in the means of the blocks of a fit: then the prior is that of
    the sensor file.

    ``settings``: section ``sensor``.
    """
    sensor_file = settings.get("sensor", {}).get(sensor) or {}
    static = any(r.role == "static" and r.reading(sensor) is not None and r.samples > 1 for r in recordings)
    return wander_prior(noise_of(sensor, recordings, settings) if static and sensor_file else None, sensor_file)


def wander_prior(noise: Noise | None, sensor_file: Mapping[str, Any]) -> Prior:
    """Return the prior by the sensor file, and by the noise of a static recording (``prior_of``)."""
    stated = Prior(float(sensor_file.get("bias_wander") or 0.0), stated_time(sensor_file))
    if noise is None or noise.source != "static" or noise.likelihood is None or fast(noise):
        return stated
    width = np.sqrt(noise.correlation_time / noise.length)
    log_likelihood = noise.likelihood.log_likelihood * min(1.0, float(width / SHARPEST_WIDTH) ** 2)
    largest = int(np.argmax(log_likelihood.max(axis=0)))  # turns may show more than a rest, never less
    log_likelihood[:, largest:] = np.maximum(log_likelihood[:, largest:], log_likelihood.max() - FARTHEST**2)
    return Prior(
        float(np.sqrt(np.mean(noise.wander**2))),
        noise.correlation_time,
        float(np.clip(width, SHARPEST_WIDTH, STATED_WIDTH)),
        stated,
        (noise.likelihood.wander, log_likelihood),
    )
