"""Compute the effective noise in motion: white noise whose averages scatter as much as those of the error in motion.

    n_e(t)^2 = t var(mean of the error over t),    over_white = n_e / n,   n^2 = white^2 dt

The error is that of the calibrated readings on held-out motion, of the vector or, without a logged attitude, of the
magnitude. Its mean is subtracted, since an estimator takes it as bias. The variance is over consecutive stretches of
length t and the axes. White noise alone gives n at every t. Effects that are not compensated add errors that last as
long as the motion, so an estimator needs several times the noise at rest. The share of an effect that the diagnosis
found is n_e of the effect's own error, by the parameters of the diagnosis.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.core.records import FittedEffect, Noise, Recording, SensorCalibration, SensorDiagnosis, Values
from pipeline.evaluation.held_out.error_breakdown import last_step
from pipeline.evaluation.held_out.samples import Samples, samples_of_motion
from pipeline.physics.effects import effect_of
from pipeline.physics.effects.base import truth, unit_of
from pipeline.physics.measurement import linear_truth

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.core.settings import Table


AVERAGING_TIMES_S = (0.1, 1.0, 10.0)  # between two images, between key frames, between fixes of a position
MIN_STRETCHES = 8  # stretches, which determine a standard deviation to a quarter


def effective_noise(
    calibration: SensorCalibration,
    recordings: Sequence[Recording],
    noise: Noise,
    table: Table,
    found: SensorDiagnosis,
    *,
    other: SensorCalibration | None = None,
) -> dict[str, Any] | None:
    """Return the effective noise of a sensor; None without held-out motion.

    ``found``: the sensor's diagnosis. ``other``: calibration of the other sensor. The result has ``unit``,
    ``recordings``, ``motion`` (rms rate in deg/s, rms change of the specific force in g, duration in s), ``white`` (n)
    and ``densities``: for each averaging time ``density``, ``over_white`` and the share of each effect.
    """
    held_out = [r for r in recordings if r.role == "validation"]
    of_motion = ((r, samples_of_motion(calibration.sensor, r, noise, table, other=other)) for r in held_out)
    samples = [(r, s) for r, s in of_motion if s is not None]
    errors = [(r, (s.time, e)) for r, s in samples if (e := _error(calibration, s)) is not None]
    if not errors:
        return None
    of_effects = {}
    for name in found.selected:
        of_effect = [(s.time, _of_effect(calibration, s, found, name)) for _, s in samples]
        if all(error is not None for _, error in of_effect):
            of_effects[name] = of_effect
    interval = errors[0][0].interval
    white = float(np.sqrt(np.mean(noise.white**2) * interval))
    densities = []
    for time in dict.fromkeys(max(1, round(t / interval)) * interval for t in AVERAGING_TIMES_S):  # whole samples
        density = _density([error for _, error in errors], time)
        if density is None:
            continue
        shares = [{"effect": name, "density": _density(error, time)} for name, error in of_effects.items()]
        ratio = density / white if white > 0 else None
        densities.append(
            {"averaging_time_s": round(time, 9), "density": density, "over_white": ratio, "effects": shares}
        )
    if not densities:
        return None
    return {
        "unit": f"{unit_of(calibration.sensor)}/sqrt(Hz)",
        "recordings": [r.name for r, _ in errors],
        "motion": _motion([r for r, _ in errors]),
        "white": white,
        "densities": densities,
    }


def _error(calibration: SensorCalibration, samples: Samples) -> Values | None:
    """Return the error of calibrated readings, (n, 3), or of their magnitude, (n, 1); None if an effect is left out."""
    corrected = last_step(calibration, samples)
    if corrected is None:
        return None
    vector, magnitude, true = corrected
    return (np.linalg.norm(vector, axis=1) - magnitude)[:, None] if true is None else vector - true


def _of_effect(calibration: SensorCalibration, samples: Samples, found: SensorDiagnosis, name: str) -> Values | None:
    """Return the error by an effect of the diagnosis: (n, 3); None if motion or parameters are unknown."""
    entry = next((e for e in found.ranking if e.effect == name), None)
    motion = samples.motion
    if entry is None or motion is None or not entry.parameters:
        return None
    fitted = FittedEffect(name, {n: {"value": p.value, "unit": p.unit} for n, p in entry.parameters.items()})
    this = effect_of(fitted)
    if any(getattr(motion, need) is None for need in this.needs):
        return None
    if this.moves:
        return np.asarray(truth(samples.sensor, this.moved(motion, fitted.values)) - truth(samples.sensor, motion))
    K = np.asarray(np.linalg.inv(calibration.matrix), np.float64)
    reading = this.reading(samples.sensor, motion, K, fitted.values)
    return np.asarray(linear_truth(calibration, calibration.bias + reading))


def _density(parts: Sequence[tuple[Values, Values | None]], time: float) -> float | None:
    """Return n_e from the times and errors of recordings; None for too few stretches or samples in a stretch."""
    squares, count = 0.0, 0
    for times, error in parts:
        if error is None or len(times) < 2:
            continue
        size = round(time / float(np.median(np.diff(times))))
        values = error[np.isfinite(error).all(axis=1)]
        stretches = len(values) // size if size else 0
        if not stretches:
            continue
        means = (values - values.mean(axis=0))[: stretches * size].reshape(stretches, size, -1).mean(axis=1)
        squares += float(np.sum(means**2)) / means.shape[1]
        count += stretches
    return float(np.sqrt(time * squares / count)) if count >= MIN_STRETCHES else None


def _motion(recordings: Sequence[Recording]) -> dict[str, float | None]:
    """Return the extent of held-out motion by the readings."""
    rates = [r.gyroscope - np.nanmedian(r.gyroscope, axis=0) for r in recordings if r.gyroscope is not None]
    forces = [r.accelerometer - np.nanmean(r.accelerometer, axis=0) for r in recordings if r.accelerometer is not None]
    rms = [float(np.sqrt(np.nanmean(np.sum(np.concatenate(v) ** 2, axis=1)))) if v else None for v in (rates, forces)]
    duration = float(sum(r.time[-1] - r.time[0] for r in recordings))
    return {"rate_dps": rms[0], "force_change_g": rms[1], "duration_s": duration}
