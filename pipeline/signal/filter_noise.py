"""What a filter does to white noise."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.records import Recording
from pipeline.signal.filters import apply_filter

if TYPE_CHECKING:
    from numpy.typing import NDArray

IMPULSE_SAMPLES = 4096


def filter_autocovariance(recording: Recording) -> NDArray[np.float64]:
    """Return the autocovariance of a recording's filter output for white noise of variance 1: (l,) array from lag 0."""
    if recording.filter["name"] == "none" or recording.samples < 2:
        return np.ones(1)
    impulse = np.zeros((IMPULSE_SAMPLES, 3))
    impulse[IMPULSE_SAMPLES // 2] = 1.0
    time_ns = np.arange(IMPULSE_SAMPLES) * round(recording.interval * 1e9)
    settings = {k: v for k, v in recording.filter.items() if k not in ("delay_s", "noise_gain")}
    response = apply_filter(Recording("impulse", "static", None, time_ns, impulse), settings).accelerometer
    assert response is not None  # noqa: S101
    spectrum = np.fft.rfft(response[:, 0], 2 * IMPULSE_SAMPLES)
    covariance: NDArray[np.float64] = np.fft.irfft(np.abs(spectrum) ** 2)[:IMPULSE_SAMPLES]
    far = np.flatnonzero(np.abs(covariance) > 1e-9 * covariance[0])[-1]
    return covariance[: far + 1]


def variance_of_mean(covariance: NDArray[np.float64], count: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the variance of the mean of ``count`` successive samples of a stationary sequence.

    ``v_n = (r_0 + 2 sum_{l<n} (1 - l/n) r_l) / n``.

    Parameters
    ----------
    covariance : (l,) array
        Autocovariance from lag 0; 0 beyond its end.
    count : (b,) array of int
    """
    kinds, which = np.unique(count, return_inverse=True)
    lag = np.arange(len(covariance))
    weight = np.clip(1.0 - lag / kinds[:, None], 0.0, None) * np.where(lag == 0, 1.0, 2.0)
    variance: NDArray[np.float64] = (weight @ covariance / kinds)[which]
    return variance
