"""Held-out errors after each step of a calibration: raw, after each stage, calibrated, with each effect added.

    accelerometer: e_n = |a_n| - gravity_g,    gyroscope: e_n = |g_n| - I_n        (Sudsanguan 2019, eqs 5.1 to 5.4)
    corrected = matrix @ (reading - bias - sum of effects)

with the error e_n of sample n, its corrected readings a_n and g_n, and the rate I_n of the table. Where the attitude is
logged, effects are computed from the motion of the reference, effects of timing shift the reference in time, and the
vector error is ``sqrt(mean |corrected - truth|^2)``. Without an attitude, effects are computed from the calibrated
readings of the log by fixed point, and effects of timing shift the logged rate.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.errors import ConfigurationError
from pipeline.core.records import FittedEffect, Motion, SensorCalibration, StepErrors, Values, corrected
from pipeline.evaluation.held_out.samples import OTHER_SENSOR, Samples
from pipeline.physics.effects import effect_of
from pipeline.physics.effects.base import truth
from pipeline.physics.effects.mounting import SEPARATOR, Mounting
from pipeline.physics.log_motion import LogEnd, fields_used, log_motion
from pipeline.physics.measurement import SensorEffects, linear_truth, solve

if TYPE_CHECKING:
    from collections.abc import Sequence

    Corrected = tuple[Values, Values, Values | None]  # vector, magnitude, truth

SPLINE_DEGREE = 3  # of the spline through a rate: 40 deg/s that change in 5 s are followed to 1e-4 deg/s at 0.12 s


def error_breakdown(calibration: SensorCalibration, samples: Sequence[Samples]) -> tuple[list[StepErrors], list[str]]:
    """Return the errors after each step, and notes on effects that the samples cannot show."""
    stages = [(f"stage:{stage.name}", stage.correction) for stage in calibration.stages if stage.correction is not None]
    figures = [
        _figures(name, [_uncorrected(s, corrected(correction or (), s.reading)) for s in samples])
        for name, correction in [("raw", None), *stages]
    ]
    figures.append(_figures("calibrated", [_with_effects(calibration, (), s) for s in samples]))
    shown: list[FittedEffect] = []
    notes = []
    for fitted in calibration.effects:
        lack = next(filter(None, (_lack(fitted, s) for s in samples)), None)
        if lack:
            notes.append(f"{fitted.name} is left out: {lack}")
        else:
            shown.append(fitted)
        figures.append(_figures(f"+ {fitted.name}", [_with_effects(calibration, shown, s) for s in samples]))
    raw, directed = figures[0][0], all(direction_known(calibration, s) for s in samples)
    rows = [replace(row, change_percent=100.0 * (raw - mean) / raw if raw else None) for mean, row in figures]
    return rows if directed else [replace(row, vector_rms_error=None) for row in rows], notes


def last_step(calibration: SensorCalibration, samples: Samples) -> Corrected | None:
    """Return calibrated readings, magnitude and vector of the reference with all effects; None if one is left out."""
    if left_out(calibration, [samples]):
        return None
    return _with_effects(calibration, calibration.effects, samples)


def left_out(calibration: SensorCalibration, samples: Sequence[Samples]) -> list[str]:
    """Return the names of the effects that cannot be subtracted from some of the samples."""
    return [fitted.name for fitted in calibration.effects if any(_lack(fitted, s) for s in samples)]


def last_error_of_magnitude(calibration: SensorCalibration, samples: Samples) -> Values | None:
    """Return the error of the magnitude after the last step, (n,); None if an effect is left out."""
    found = last_step(calibration, samples)
    return None if found is None else np.linalg.norm(found[0], axis=1) - found[1]


def with_known_effects(calibration: SensorCalibration, samples: Samples) -> Corrected:
    """Return the same as ``last_step``, with the effects that can be subtracted from the samples."""
    return _with_effects(calibration, [fitted for fitted in calibration.effects if not _lack(fitted, samples)], samples)


def _uncorrected(samples: Samples, readings: Values) -> Corrected:
    """Return readings, and the magnitude and vector of the reference without effects."""
    return readings, samples.magnitude, None if samples.motion is None else truth(samples.sensor, samples.motion)


def _figures(name: str, corrected: Sequence[Corrected]) -> tuple[float, StepErrors]:
    """Return the mean absolute error of the magnitude, and all errors."""
    error = np.concatenate([np.linalg.norm(vector, axis=1) - magnitude for vector, magnitude, _ in corrected])
    known = np.isfinite(error)
    differences = [vector - true for vector, _, true in corrected if true is not None]
    off = np.concatenate(differences)[known] if len(differences) == len(corrected) else None
    error = error[known]
    mean = float(np.mean(np.abs(error)))
    return mean, StepErrors(
        name,
        mean,
        float(np.sum(np.abs(error))),
        float(np.max(error)),
        float(np.min(error)),
        float(np.sqrt(np.mean(error**2))),
        vector_rms_error=None if off is None else float(np.sqrt(np.mean(np.sum(off**2, axis=1)))),
    )


def _lack(fitted: FittedEffect, samples: Samples) -> str | None:
    """Return what the held-out recording lacks to subtract an effect, or None."""
    found = effect_of(fitted)
    if samples.motion is not None or _elsewhere(fitted, samples):
        missing = [need for need in found.needs if samples.motion and getattr(samples.motion, need) is None]
        return f"the held-out recording holds no {' and no '.join(missing)}" if missing else None
    if found.moves:
        few = not samples.resting and len(samples.time) <= SPLINE_DEGREE
        return f"the held-out recording has {len(samples.time)} samples, too few to follow its rate" if few else None
    try:
        used = fields_used(samples.sensor, [fitted])
    except ConfigurationError as error:
        return f"the held-out recording logs no attitude ({error})"
    if "temperature" in used and samples.temperature is None:
        return "the held-out recording holds no temperature"
    signal_of_other = "angular_rate" if samples.sensor == "accelerometer" else "specific_force"
    if signal_of_other in used and samples.other is None and not samples.resting:
        return f"the held-out recording holds no {OTHER_SENSOR[samples.sensor]}"
    return None


def _elsewhere(fitted: FittedEffect, samples: Samples) -> bool:
    """Return whether an effect is absent: it is of another session, or a tilt, which changes no magnitude."""
    name, separator, session = fitted.name.partition(SEPARATOR)
    return (samples.motion is None and name == "table_tilt") or (bool(separator) and session != samples.setup)


def _with_effects(calibration: SensorCalibration, effects: Sequence[FittedEffect], samples: Samples) -> Corrected:
    """Return calibrated readings, magnitude and vector of the reference with some effects."""
    effects = [fitted for fitted in effects if not _elsewhere(fitted, samples)]
    if not effects:
        return _uncorrected(samples, linear_truth(calibration, samples.reading))
    of_reading = [fitted for fitted in effects if not effect_of(fitted).moves]
    if samples.motion is None:
        moves = [fitted for fitted in effects if fitted not in of_reading]
        return _by_calibrated_log(calibration, of_reading, samples), _moved_magnitude(samples, moves), None
    motion = _moved(samples.motion, effects)
    rest = SensorEffects.of(calibration, of_reading).take_off(samples.reading, motion)
    moved, logged = truth(samples.sensor, motion), truth(samples.sensor, samples.motion)
    change = np.linalg.norm(moved, axis=1) - np.linalg.norm(logged, axis=1)
    direction = moved if direction_known(calibration, samples) else None
    return linear_truth(calibration, rest), samples.magnitude + change, direction


def direction_known(calibration: SensorCalibration, samples: Samples) -> bool:
    """Return whether the reference has a direction: an attitude log, and no mounting that is unknown here."""
    mountings = [e for fitted in calibration.effects if isinstance(e := effect_of(fitted), Mounting)]
    return samples.motion is not None and all(e.covers(samples.motion) for e in mountings)


def _moved(motion: Motion, effects: Sequence[FittedEffect]) -> Motion:
    """Return the motion after the effects of timing."""
    for fitted in effects:
        motion = effect_of(fitted).moved(motion, fitted.values)
    return motion


def _moved_magnitude(samples: Samples, effects: Sequence[FittedEffect]) -> Values:
    """Return the reference's magnitude with effects that move the motion in time.

    The magnitude of a specific force is gravity at any time, the rate of a rest is 0. A rate is interpolated by a cubic
    spline; from one interval beyond the log on, it is constant.
    """
    if not effects or samples.sensor == "accelerometer" or samples.resting:
        return samples.magnitude
    from scipy.interpolate import make_interp_spline  # noqa: PLC0415  (0.3 s, needed without an attitude log alone)

    time, spline = samples.time, make_interp_spline(samples.time, samples.magnitude, k=SPLINE_DEGREE)
    interval = float(np.median(np.diff(time)))

    def motion(offset: float | Values = 0.0) -> Motion:
        at = np.clip(time + offset, time[0] - interval, time[-1] + interval)
        rate, nothing = np.zeros((2, len(time), 3))
        rate[:, 0] = spline(at)
        still = np.zeros(len(time), bool)
        later = partial(moved_on, offset)
        return Motion(time, nothing, rate, nothing, nothing, None, None, None, None, still, at_offset=later)

    def moved_on(before: float | Values, offset: float | Values) -> Motion:
        return motion(before + offset)

    return np.asarray(np.abs(_moved(motion(), effects).angular_rate[:, 0]))


def _by_calibrated_log(calibration: SensorCalibration, effects: Sequence[FittedEffect], samples: Samples) -> Values:
    """Return calibrated readings, with effects by the calibrated signals of the log itself."""
    sensor = calibration.sensor
    readings = {sensor: samples.reading}
    if samples.other is not None:
        readings[OTHER_SENSOR[sensor]] = samples.other
    used = fields_used(sensor, effects)
    nothing = np.zeros_like(samples.reading)

    def motion_of(truths: dict[str, Values], _number: int) -> Motion:
        found = log_motion(
            samples.time,
            specific_force=truths.get("accelerometer", nothing),
            angular_rate=nothing if samples.resting else truths.get("gyroscope", nothing),
            temperature=samples.temperature,
            used=used,
            end=LogEnd(),
        )
        return replace(found, specific_force_rate=nothing, angular_acceleration=nothing) if samples.resting else found

    return solve({sensor: SensorEffects.of(calibration, effects)}, readings, motion_of)[sensor]
