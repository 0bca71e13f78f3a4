"""Residuals of a calibration: what the reading has beyond the model, and what it depends on.

    e[n] = reading[n] - predicted reading[n],    predicted = bias + matrix^-1 truth + effects

The prediction passes the filter that the readings passed, so that its lag is no residual.

Binned means: e is averaged in bins of a covariate (angle, rate, temperature ...), with the standard error of white
noise, ``s / sqrt(n)``. A covariate that matters pulls the means out of that band; ``excess`` is the mean of
``(mean / standard error)^2``, which is 1 where nothing is there (wander makes it larger), and orders the charts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.model.kinematics import earth_rate, reference_motion
from pipeline.model.measurement import predicted_reading
from pipeline.records import FittedEffect, SensorCalibration

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from pipeline.records import Motion, Recording

BINS = 36
FEWEST = 5


@dataclass(frozen=True)
class Residual:
    """Reading, prediction and their difference for one recording.

    Attributes
    ----------
    recording : Recording
    motion : Motion
    reading, predicted : (n, 3) array, g or deg/s
    """

    recording: Recording
    motion: Motion
    reading: NDArray[np.float64]
    predicted: NDArray[np.float64]

    @cached_property
    def error(self) -> NDArray[np.float64]:
        """Reading minus prediction: (n, 3) array, g or deg/s."""
        return self.reading - self.predicted


def sensor_calibration(sensor: str, part: dict[str, Any]) -> SensorCalibration:
    """Return bias, matrix and effects of one sensor's part of a calibration file."""
    return SensorCalibration(
        sensor=sensor,
        bias=np.array(part["bias"], float),
        matrix=np.array(part["matrix"], float),
        effects=tuple(FittedEffect(**e) for e in part.get("effects", [])),
    )


def residuals(sensor: str, part: dict[str, Any], recordings: list[Recording], table: dict[str, Any]) -> list[Residual]:
    """Return the residuals of the recordings that were made for a sensor and whose motion is known.

    Parameters
    ----------
    sensor : str
    part : dict
        The sensor's part of the calibration.
    recordings : list of Recording
    table : dict
        The section ``table`` of the unit's configuration.
    """
    calibration = sensor_calibration(sensor, part)
    latitude, azimuth = table.get("latitude_deg"), table.get("azimuth_deg")
    earth = None if latitude is None or azimuth is None else earth_rate(latitude, azimuth)
    out = []
    for recording in recordings:
        reading = recording.reading(sensor)
        if recording.role != sensor or reading is None:
            continue
        motion = reference_motion(recording, table.get("gravity_g") or 1.0, earth)
        if motion is not None:
            predicted = _filtered(recording, predicted_reading(calibration, motion))
            out.append(Residual(recording, motion, reading, predicted))
    return out


def _filtered(recording: Recording, predicted: NDArray[np.float64]) -> NDArray[np.float64]:
    settings = {k: v for k, v in recording.filter.items() if k not in ("delay_s", "noise_gain")}
    if settings.get("name", "none") == "none":
        return predicted
    from pipeline.signal.filters import apply_filter  # noqa: PLC0415  (only filtered recordings pay for it)

    ideal = replace(recording, accelerometer=predicted, gyroscope=None, filter={"name": "none"}, encodings={})
    passed = apply_filter(ideal, settings).accelerometer
    return predicted if passed is None else passed


def white_noise(error: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the noise of one sample from the differences of neighbours: (3,) array.

    ``1.4826 median |e[n+1] - e[n]| / sqrt(2)``; slow errors and outliers do not move it.
    """
    sigma: NDArray[np.float64] = 1.4826 * np.median(np.abs(np.diff(error, axis=0)), axis=0) / np.sqrt(2.0)
    return sigma


@dataclass(frozen=True)
class BinnedMean:
    """Means of a residual in bins of a covariate: centres (m,), means and standard errors (m, 3); NaN in empty bins."""

    centre: NDArray[np.float64]
    mean: NDArray[np.float64]
    error: NDArray[np.float64]

    def excess(self, wander: NDArray[np.float64] | None = None) -> float:
        """Return the mean square of the means over that of noise and a wander of (3,) deviations, of the worst axis."""
        filled = np.isfinite(self.mean[:, 0])
        variance = self.error[filled] ** 2 + (0.0 if wander is None else wander**2)
        return float(np.max(np.add.reduce(self.mean[filled] ** 2 / variance, axis=0)) / np.count_nonzero(filled))


def binned_mean(covariate: NDArray[np.float64], error: NDArray[np.float64], bins: int = BINS) -> BinnedMean | None:
    """Return means of ``error`` in equal bins of the covariate, None where it does not vary.

    Bins with fewer than 5 samples count as empty.

    Parameters
    ----------
    covariate : (n,) array
    error : (n, 3) array
    bins : int
    """
    if not (np.isfinite(covariate).all() and np.isfinite(error).all()):
        known = np.isfinite(covariate) & np.isfinite(error).all(axis=1)
        covariate, error = covariate[known], error[known]
    low, high = (float(covariate.min()), float(covariate.max())) if len(covariate) else (0.0, 0.0)
    if not high - low > 1e-9 * max(1.0, abs(low)):
        return None
    cell = np.minimum(((covariate - low) * (bins / (high - low))).astype(np.int64), bins - 1)
    count = np.bincount(cell, minlength=bins).astype(float)
    count[count < FEWEST] = np.nan
    if np.isfinite(count).sum() < 2:
        return None
    mean = np.stack([np.bincount(cell, e, bins) / count for e in error.T], 1)
    filled = np.isfinite(count)
    squares = np.einsum("ij,ij->j", error, error) / len(error)
    between = np.sum(mean[filled] ** 2 * count[filled, None], axis=0) / count[filled].sum()
    scatter = np.sqrt(np.maximum(squares - between, 0.0)) + 1e-300
    centre = low + (np.arange(bins) + 0.5) * (high - low) / bins
    return BinnedMean(centre, mean, scatter / np.sqrt(count)[:, None])


COVARIATES: dict[str, Callable[[Residual], NDArray[np.float64] | None]] = {
    "angle, deg": lambda r: None if r.motion.angle is None else np.mod(r.motion.angle, 360.0),
    "rate, deg/s": lambda r: r.motion.rate,
    "specific force x, g": lambda r: r.motion.specific_force[:, 0],
    "specific force y, g": lambda r: r.motion.specific_force[:, 1],
    "specific force z, g": lambda r: r.motion.specific_force[:, 2],
    "temperature, degC": lambda r: r.motion.temperature,
    "time, s": lambda r: r.motion.time if r.recording.clock_shared else r.motion.time - r.motion.time[0],
}


def covariates(found: list[Residual], wander: NDArray[np.float64] | None = None) -> dict[str, BinnedMean]:
    """Return binned means over all recordings by covariate, the largest excess first.

    Of the three components of the specific force the one with the largest excess stands for all.

    Parameters
    ----------
    found : list of Residual
    wander : (3,) array, optional
        Standard deviation of the bias wander.
    """
    out: dict[str, BinnedMean] = {}
    errors = [r.error for r in found]
    everything = np.asfortranarray(np.concatenate(errors)) if errors else np.zeros((0, 3))  # read axis by axis
    for label, value in COVARIATES.items():
        values = [value(r) for r in found]
        pairs = [(v, e) for v, e in zip(values, errors, strict=True) if v is not None]
        if not pairs:
            continue
        together = everything if len(pairs) == len(found) else np.concatenate([e for _, e in pairs])
        binned = binned_mean(np.concatenate([v for v, _ in pairs]), together)
        if binned is not None:
            out[label] = binned
    excess = {label: mean.excess(wander) for label, mean in out.items()}
    order = sorted(out, key=lambda label: -excess[label])
    forces = [label for label in order if label.startswith("specific force")]
    return {label: out[label] for label in order if label not in forces[1:]}
