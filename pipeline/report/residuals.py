"""Residuals of a calibration: what the reading has beyond the model, and what it depends on.

    e[n] = reading[n] - predicted reading[n],    predicted = bias + matrix^-1 truth + effects

The prediction passes the filter that the readings passed, so that its lag is no residual.

Binned means: e is averaged in bins of a covariate (angle, rate, temperature ...), with the standard error of white
noise, ``s / sqrt(n)``. A covariate that matters pulls the means out of that band; ``excess`` is the mean of
``(mean / standard error)^2``, which is 1 where nothing is there (wander makes it larger), and orders the charts.

Harmonics: amplitudes of ``e = sum_k a_k cos k A + b_k sin k A`` over turns by the angle A. 1 cycle a turn is
misalignment, tilt or encoder, 2 and 4 quadratic nonlinearity or asymmetry, 3 cubic nonlinearity.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
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
HARMONICS = 6


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

    @property
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

    @property
    def excess(self) -> float:
        """Mean square of the means in standard errors, of the worst axis."""
        return float(np.max(np.nanmean((self.mean / self.error) ** 2, axis=0)))


def binned_mean(covariate: NDArray[np.float64], error: NDArray[np.float64], bins: int = BINS) -> BinnedMean | None:
    """Return means of ``error`` in equal bins of the covariate, None where it does not vary.

    Bins with fewer than 5 samples count as empty.

    Parameters
    ----------
    covariate : (n,) array
    error : (n, 3) array
    bins : int
    """
    known = np.isfinite(covariate) & np.isfinite(error).all(1)
    covariate, error = covariate[known], error[known]
    low, high = (float(covariate.min()), float(covariate.max())) if len(covariate) else (0.0, 0.0)
    if not high - low > 1e-9 * max(1.0, abs(low)):
        return None
    cell = np.minimum(((covariate - low) * (bins / (high - low))).astype(np.int64), bins - 1)
    count = np.bincount(cell, minlength=bins).astype(float)
    count[count < 5] = np.nan
    if np.isfinite(count).sum() < 2:
        return None
    mean = np.stack([np.bincount(cell, e, bins) / count for e in error.T], 1)
    square = np.stack([np.bincount(cell, e * e, bins) / count for e in error.T], 1)
    scatter = np.sqrt(np.nanmean(np.maximum(square - mean**2, 0.0), axis=0)) + 1e-300
    centre = low + (np.arange(bins) + 0.5) * (high - low) / bins
    return BinnedMean(centre, mean, scatter / np.sqrt(count)[:, None])


COVARIATES: dict[str, Callable[[Residual], NDArray[np.float64] | None]] = {
    "angle, deg": lambda r: None if r.motion.angle is None else np.mod(r.motion.angle, 360.0),
    "rate, deg/s": lambda r: r.motion.rate,
    "temperature, degC": lambda r: r.motion.temperature,
    "time, s": lambda r: r.motion.time if r.recording.clock_shared else r.motion.time - r.motion.time[0],
}


def covariates(found: list[Residual]) -> dict[str, BinnedMean]:
    """Return binned means over all recordings by covariate, the largest excess first."""
    out = {}
    for label, value in COVARIATES.items():
        pairs = [(v, r.error) for r in found if (v := value(r)) is not None]
        if pairs:
            binned = binned_mean(np.concatenate([v for v, _ in pairs]), np.concatenate([e for _, e in pairs]))
            if binned is not None:
                out[label] = binned
    return dict(sorted(out.items(), key=lambda item: -item[1].excess))


def harmonics(residual: Residual) -> NDArray[np.float64] | None:
    """Return the amplitudes of 0 to 6 cycles a turn: (7, 3) array, None where not all angles of a turn were visited.

    From means in 36 bins of the angle; ``sinc`` undoes what averaging over a bin takes away.
    """
    angle = residual.motion.angle
    if angle is None:
        return None
    cell = (np.mod(angle, 360.0) * (BINS / 360.0)).astype(np.int64) % BINS
    count = np.bincount(cell, minlength=BINS)
    if not count.all():
        return None
    mean = np.stack([np.bincount(cell, e, BINS) / count for e in residual.error.T], 1)
    amplitude = np.abs(np.fft.rfft(mean, axis=0))[: HARMONICS + 1] * (2.0 / BINS)
    amplitude[0] /= 2.0
    scaled: NDArray[np.float64] = amplitude / np.sinc(np.arange(HARMONICS + 1) / BINS)[:, None]
    return scaled
