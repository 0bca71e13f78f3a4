"""The noise of one sample, from the noise at rest in ``calibrations/<unit>.json``.

    cov = M diag(N^2 / dt + 2 Q^2 / dt^2 + sum_i G_i^2) M^T

N, Q : white and quantisation noise of an axis, and dt the sampling interval at which they were identified
G_i  : standard deviation of Gauss-Markov processes with a correlation time of less than ``FAST_S``
M    : matrix of the calibration; the bias that wanders more slowly is no part of the noise of a sample
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.records import AXES

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

FAST_S = 0.1  # shorter than what estimators average over between two images or scans: there a process counts as white


def sample_covariance(document: Mapping[str, Any], sensor: str) -> NDArray[np.float64] | None:
    """Return the covariance of a calibrated sample: (3, 3) array, g^2 or (deg/s)^2.

    None where the sensor is not calibrated, or the noise of an axis is not known.
    """
    noise, part = (document.get("noise") or {}).get(sensor) or {}, document.get(sensor)
    axes = noise.get("axes") or {}
    if not part or any((axes.get(axis) or {}).get("terms") is None for axis in AXES):
        return None
    dt, variances = float(noise["sampling_interval_s"]), []
    for axis in AXES:
        terms = axes[axis]["terms"]
        white, quantisation = (terms[name]["value"] or 0.0 for name in ("white", "quantisation"))
        fast = [g["value"] for g in terms["gauss_markov"] if g["correlation_time_s"]["value"] < FAST_S]
        variances.append(white**2 / dt + 2.0 * quantisation**2 / dt**2 + sum(g**2 for g in fast))
    spread = np.array(part["matrix"], np.float64) * np.sqrt(variances)
    return np.asarray(spread @ spread.T)
