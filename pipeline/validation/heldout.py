"""Held-out errors: what a calibration leaves on samples that no fit has seen, and what noise alone would leave.

Held out are the recordings of role ``validation``; without one, every third rest (``procedure.holdout_every``). Where
nothing is held out, the samples of the fit are judged, and the result says so. With t the truth, M the matrix, n the
noise of a sample (white noise after the filter, and bias wander) and V its covariance, which is diagonal,

    noise_floor = sqrt(mean E[(|t + M n| - |t|)^2]),    vector_noise_floor = sqrt(mean tr(M V M^T))

A calibration is worse than the raw readings where its error is above its expected interval
(``pipeline.validation.expected_error``) and a t-test says so: per stretch of the recordings, the mean of its squared
errors minus that of the raw readings' squared errors, over B stretches, with B - 1 degrees of freedom and the
probability ``FALSE_REFUSALS``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import ConfigurationError
from pipeline.estimation.accelerometer.nonlinear_least_squares import NAMES
from pipeline.estimation.multi_position.accelerometer import KNOWN_BY_LIMIT
from pipeline.estimation.rest_means import count_of_rests, held_out_rests, split_rests
from pipeline.model.effects.base import truth, unit_of
from pipeline.model.kinematics import EARTH_RATE_DPS
from pipeline.model.measurement import linear_truth
from pipeline.signal.rests import Rest
from pipeline.validation.agreement import agreement
from pipeline.validation.error_breakdown import direction_known, error_breakdown, last_error_of_magnitude, left_out
from pipeline.validation.expected_error import expected_rms_error, linearized
from pipeline.validation.samples import Samples, samples_of_motion, samples_of_rests, squared_norm_errors

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.records import Noise, Recording, SensorCalibration, Values

FALSE_REFUSALS = 1e-3  # probability that a calibration as good as the raw readings is refused
STRETCHES = 20  # a stretch of a recording of minutes is longer than the correlation time of most wander
FEWEST_SAMPLES = 5  # of the t-test
BIN_DEGC = 5.0  # a bias that follows the temperature by 1 mg/degC (MPU-6050) changes by 5 mg within it
SWEEP_DEGC = 2 * BIN_DEGC  # fills two bins; a unit that warms up on the bench changes by less
FEWEST_IN_BIN = 10  # samples of a bin that is shown
FIGURES = ("mean_abs_error", "sum_abs_error", "max_error", "min_error", "rms_error", "change_percent")


def validate(
    calibration: SensorCalibration,
    recordings: Sequence[Recording],
    noise: Noise,
    settings: Mapping[str, Any],
    *,
    other: SensorCalibration | None = None,
) -> dict[str, Any]:
    """Return a sensor's part of ``validations/<unit>.json``.

    ``recordings``: all of the unit, filtered as for the fit; ``settings``: sections ``table``, ``procedure``,
    ``limits`` and, for the expected error, ``sensor``; ``other``: that of the unit's other sensor. Only where no
    attitude is logged: effects that look at the other sensor's signal then take it calibrated; without it, as it was
    read.

    The part has ``unit, samples, expected_rms_error`` (None where an effect is left out), ``noise_floor,
    vector_noise_floor, steps`` of the published file, and ``held_out`` (false: judged on the samples of the fit),
    ``reason`` (why), ``reference_rms`` (of the reference's magnitude), ``noise``, ``notes``, ``worse_than_raw`` (why
    the calibration must not be used, or None), ``agreement`` (``pipeline.validation.agreement``),
    ``over_temperature`` (``residuals_over_temperature``; only where the temperature was swept), ``limits``, ``pass``.
    ``vector_rms_error`` is the root of the mean squared length of the difference to the reference. Raises
    ``ConfigurationError`` if a limit's name is unknown.
    """
    sensor = calibration.sensor
    samples, reason = _choose(sensor, recordings, noise, settings)
    if reason and (count := _fitted_exactly(calibration)):
        samples = []
        reason += f"; the fit passes through its {count} rests exactly, so that their error says nothing: record more"
    elif reason and samples:
        reason += "; judged on the samples of the fit"
    count = int(sum(s.known.sum() for s in samples))
    no_figures: dict[str, Any] = dict.fromkeys((*FIGURES, "vector_rms_error"))
    part: dict[str, Any] = {
        "unit": unit_of(sensor),
        "held_out": reason is None,
        "reason": reason,
        "samples": count,
        "noise": {
            "white": noise.white.tolist(),
            "wander": noise.wander.tolist(),
            "correlation_time_s": noise.correlation_time,
            "source": noise.source,
            "wander_source": noise.wander_source,
            "correlation_time_source": noise.time_source,
        },
        "noise_floor": None,
        "vector_noise_floor": None,
        "reference_rms": None,
        "steps": [{"name": name, **no_figures} for name in ("raw", "calibrated")],
        "notes": [],
        "expected_rms_error": None,
        "worse_than_raw": None,
        "agreement": None,
    }
    if count:
        part["noise_floor"], part["vector_noise_floor"] = noise_floors(calibration, samples)
        part["reference_rms"] = float(np.sqrt(np.nanmean(np.concatenate([s.magnitude for s in samples]) ** 2)))
        part["steps"], part["notes"] = error_breakdown(calibration, samples, other)
        expected, notes = _expected(calibration, recordings, samples, noise, settings, other=other)
        part["expected_rms_error"] = expected
        part["notes"] += notes
        if part["held_out"] and expected is not None:
            part["agreement"] = agreement(calibration, recordings, samples, noise, settings, other)
            part["worse_than_raw"] = _worse_than_raw(
                calibration, samples, expected[1], other, on_table=settings["table"].get("motion") != "none"
            )
        bins = residuals_over_temperature(calibration, samples, other)
        samples_of = "the held-out samples" if part["held_out"] else "the samples of the fit"
        if bins is None and part["held_out"] and _is_swept(recordings):
            fitted, _ = _choose(sensor, recordings, noise, settings, of_fit=True)
            bins, samples_of = residuals_over_temperature(calibration, fitted, other), "the samples of the fit"
        if bins:
            part["over_temperature"] = {"samples_of": samples_of, "bins": bins}
    limits = (settings.get("limits") or {}).get(sensor) or {}
    part["limits"], part["pass"] = _check_limits(calibration, part["steps"][-1], limits)
    return part


def residuals_over_temperature(
    calibration: SensorCalibration, samples: Sequence[Samples], other: SensorCalibration | None
) -> list[dict[str, Any]] | None:
    """Return the errors of the magnitude after the last step, in bins of the temperature of the sensor.

    The mean of a bin (``mean_error``, g or deg/s) shows what still depends on the temperature, ``rms_error`` what noise
    adds; ``temperature_degc`` is a mean. None where the temperature is not recorded, or its range is below
    ``SWEEP_DEGC``.
    """
    temperatures, errors = [np.zeros(0)], [np.zeros(0)]
    for each in samples:
        error = last_error_of_magnitude(calibration, each, other)
        if error is None or each.temperature is None:
            return None
        known = each.known & np.isfinite(error) & np.isfinite(each.temperature)
        temperatures.append(each.temperature[known])
        errors.append(error[known])
    warmth, error = np.concatenate(temperatures), np.concatenate(errors)
    if len(warmth) == 0 or np.ptp(warmth) < SWEEP_DEGC:
        return None
    number = np.floor(warmth / BIN_DEGC)
    return [
        {
            "temperature_degc": float(warmth[in_bin].mean()),
            "mean_error": float(error[in_bin].mean()),
            "rms_error": float(np.sqrt(np.mean(error[in_bin] ** 2))),
            "samples": int(in_bin.sum()),
        }
        for each in np.unique(number)
        if (in_bin := number == each).sum() >= FEWEST_IN_BIN
    ]


def _is_swept(recordings: Sequence[Recording]) -> bool:
    """Return whether the temperature of the recordings may have been swept: it spans ``SWEEP_DEGC`` in all of them."""
    warmth = [r.temperature[np.isfinite(r.temperature)] for r in recordings if r.temperature is not None]
    return bool(np.ptp(np.concatenate([np.zeros(0), *warmth])) >= SWEEP_DEGC) if any(map(len, warmth)) else False


def _expected(
    calibration: SensorCalibration,
    recordings: Sequence[Recording],
    samples: Sequence[Samples],
    noise: Noise,
    settings: Mapping[str, Any],
    *,
    other: SensorCalibration | None,
) -> tuple[list[float] | None, list[str]]:
    """Return the interval of the last step's rms error (None where an effect is left out), and notes on it or why not.

    Earth's rotation, where it is left out of a magnitude, changes the rms error by its rate at most.
    """
    parts = [linearized(calibration, s, _truth(calibration, s), other) for s in samples if s.known.any()]
    complete = [p for p in parts if p is not None]
    if len(complete) < len(parts):
        effects = left_out(calibration, samples)
        return None, [f"the expected error is not stated, because {effects} left out of the held-out error"]
    fitted = [r for r in recordings if r.role in {calibration.sensor, "rests"} and r.samples]
    fitted_s = sum(float(r.time[-1] - r.time[0]) for r in fitted if r.reading(calibration.sensor) is not None)
    low, high = expected_rms_error(calibration, complete, noise, settings, fitted_s)
    if not any(s.earth_left_out for s in samples):
        return [low, high], []
    note = (
        "the held-out recording logs no attitude: Earth's rotation is left out of its reference, and the expected "
        f"error allows for its {EARTH_RATE_DPS:.2g} deg/s"
    )
    return [max(low - EARTH_RATE_DPS, 0.0), high + EARTH_RATE_DPS], [note]


def last_error(
    calibration: SensorCalibration,
    recordings: Sequence[Recording],
    noise: Noise,
    settings: Mapping[str, Any],
    *,
    other: SensorCalibration | None = None,
    smoothed: bool = False,
) -> tuple[float, list[float]] | None:
    """Return the rms error after the last step and its interval; None without held-out motion or interval.

    With ``smoothed``, the reference of a filtered recording goes through its filter, too: the filter leaves no error.
    """
    samples, reason = _choose(calibration.sensor, recordings, noise, settings, smoothed=smoothed)
    if reason is not None:
        return None
    return _error_and_interval(calibration, recordings, samples, noise, settings, other=other)


def static_error(
    calibration: SensorCalibration,
    recordings: Sequence[Recording],
    noise: Noise,
    settings: Mapping[str, Any],
    other: SensorCalibration | None = None,
) -> tuple[float, list[float]] | None:
    """Return the error of the mean of the static recording, and its interval as of a held-out rest; None without one.

    The heading is not known, so Earth's rotation widens the interval of a gyroscope: once by what the bias holds of it,
    once by what the recording shows.
    """
    static = [r for r in recordings if r.role == "static" and r.reading(calibration.sensor) is not None and r.samples]
    found = [samples_of_rests(calibration.sensor, r, [Rest(0, r.samples)], noise, settings["table"]) for r in static]
    samples = [s for s in found if s is not None and s.known.any()]
    judged = _error_and_interval(calibration, recordings, samples, noise, settings, other=other) if samples else None
    if judged is None:
        return None
    error, (low, high) = judged
    turning = 2.0 * EARTH_RATE_DPS if calibration.sensor == "gyroscope" else 0.0
    return error, [max(low - turning, 0.0), high + turning]


def _error_and_interval(
    calibration: SensorCalibration,
    recordings: Sequence[Recording],
    samples: Sequence[Samples],
    noise: Noise,
    settings: Mapping[str, Any],
    *,
    other: SensorCalibration | None,
) -> tuple[float, list[float]] | None:
    """Return the rms error of samples after the last step and its interval; None where either is not known."""
    expected, _ = _expected(calibration, recordings, samples, noise, settings, other=other)
    errors = [error for s in samples if (error := last_error_of_magnitude(calibration, s, other)) is not None]
    if expected is None or not errors:
        return None
    return float(np.sqrt(np.nanmean(np.concatenate(errors) ** 2))), expected


def noise_floors(calibration: SensorCalibration, samples: Sequence[Samples]) -> tuple[float, float | None]:
    """Return the rms error, and where an attitude is known the vector rms error, that noise alone would give."""
    squares = [
        squared_norm_errors(_truth(calibration, s)[s.known], calibration.matrix, s.variance[s.known]) for s in samples
    ]
    floor = float(np.sqrt(np.mean(np.concatenate(squares))))
    if not all(direction_known(calibration, s) for s in samples):
        return floor, None
    vectors = np.concatenate([s.variance[s.known] @ np.sum(calibration.matrix**2, axis=0) for s in samples])
    return floor, float(np.sqrt(np.mean(vectors)))


def _truth(calibration: SensorCalibration, samples: Samples) -> Values:
    """Return the reference's magnitude along its direction, or along that of the calibrated reading: (n, 3) array."""
    reading = linear_truth(calibration, samples.reading)
    direction = reading
    if samples.motion is not None:
        reference = truth(samples.sensor, samples.motion)
        direction = np.where(np.isfinite(reference).all(axis=1, keepdims=True), reference, reading)
    size = np.linalg.norm(direction, axis=1, keepdims=True)
    unit = np.where(size > 0, direction / np.where(size > 0, size, 1.0), [1.0, 0.0, 0.0])
    return np.asarray(samples.magnitude[:, None] * unit)


def _choose(
    sensor: str,
    recordings: Sequence[Recording],
    noise: Noise,
    settings: Mapping[str, Any],
    *,
    smoothed: bool = False,
    of_fit: bool = False,
) -> tuple[list[Samples], str | None]:
    """Return the samples to judge on, and why they are not held out where they are not (``of_fit``: asked for)."""
    table = settings["table"]
    by_rests = any(r.role == "rests" for r in recordings)

    def moving(role: str) -> list[Samples]:
        chosen = [r for r in recordings if r.role == role]
        if by_rests:  # hand-held: between its rests the specific force is not known
            logs = ("table_attitude", "table_rate", "table_angle")
            chosen = [r for r in chosen if any(getattr(r, log) is not None for log in logs)]
        samples = [samples_of_motion(sensor, r, noise, table, smoothed=smoothed) for r in chosen]
        return [s for s in samples if s is not None and np.isfinite(s.reading).all(axis=1).any()]

    def resting(rests: Mapping[str, Sequence[Rest]]) -> list[Samples]:
        chosen = [(r, rests[r.name]) for r in recordings if rests.get(r.name)]
        return [s for s in (samples_of_rests(sensor, r, rs, noise, table) for r, rs in chosen) if s is not None]

    def rests_of(role: str) -> dict[str, Sequence[Rest]]:
        return {r.name: split_rests(r, 0).used for r in recordings if r.role == role}

    held_out = [] if of_fit else moving("validation")
    if not held_out and by_rests and not of_fit:
        held_out = resting(held_out_rests(recordings, settings)) or resting(rests_of("validation"))
    if held_out:
        return held_out, None
    reason = f"no held-out recording holds readings of the {sensor} and a reference for them"
    stated = settings.get("procedure", {})
    if by_rests and stated.get("turns"):
        reason += " (with two turns about each axis between rests of 4 s or longer, the second is held out)"
    elif count_of_rests(recordings) < stated.get("holdout_from", 0) and all(r.role != "validation" for r in recordings):
        count, fewest, every = count_of_rests(recordings), stated["holdout_from"], stated["holdout_every"]
        reason += f" ({count} rests all go to the fit; of {fewest} and more, one of {every} is held out)"
    fitted = moving(sensor) or resting(rests_of("rests")) or resting(rests_of(sensor))
    return fitted, reason


def _fitted_exactly(calibration: SensorCalibration) -> int:
    """Return the number of rests by hand that a fit passes through, as it has a parameter for each; 0 for others."""
    for details in (stage.details for stage in calibration.stages if stage.details.get("rests_used")):
        if details["orientations_used"] + len(details[KNOWN_BY_LIMIT]) <= len(NAMES):
            return int(details["orientations_used"])
    return 0


def _worse_than_raw(
    calibration: SensorCalibration,
    samples: Sequence[Samples],
    allowed: float,
    other: SensorCalibration | None,
    *,
    on_table: bool,
) -> str | None:
    """Return why a calibration must not be used, as one sentence; None where it may: its error is ``allowed``."""
    errors = [last_error_of_magnitude(calibration, s, other) for s in samples]
    after = [error[s.known] for error, s in zip(errors, samples, strict=True) if error is not None]
    if len(after) < len(samples):
        return None
    raw = np.concatenate([(np.linalg.norm(s.reading, axis=1) - s.magnitude)[s.known] for s in samples])
    calibrated = np.concatenate(after)
    sizes = [float(np.sqrt(np.mean(e**2))) for e in (raw, calibrated)]
    if sizes[1] <= max(sizes[0], allowed) or len(raw) < FEWEST_SAMPLES:
        return None
    pieces = np.array_split(calibrated**2 - raw**2, min(STRETCHES, len(raw)))
    means = np.array([piece.mean() for piece in pieces])
    from scipy.special import stdtrit  # noqa: PLC0415  (only where the calibration seems to be worse)

    limit = stdtrit(len(means) - 1, 1.0 - FALSE_REFUSALS) * float(means.std(ddof=1))
    if means.mean() * np.sqrt(len(means)) <= limit:
        return None
    unit = unit_of(calibration.sensor)
    return (
        f"the calibration makes held-out motion worse: {sizes[0]:.3g} {unit} rms before it, {sizes[1]:.3g} {unit} "
        f"after, where noise and stated uncertainties leave at most {allowed:.3g} {unit}. Check that fit and "
        f"held-out recordings are of this unit in the same mounting{', and what the table logged' * on_table}"
    )


def _check_limits(
    calibration: SensorCalibration, last: Mapping[str, Any], limits: Mapping[str, float | None]
) -> tuple[list[dict[str, Any]], bool | None]:
    """Return each limit with its figure, and whether all are kept (None: there is no limit).

    A limit that is null is not checked; a figure that is not known does not pass.
    """
    extremes = [abs(v) for v in (last["max_error"], last["min_error"]) if v is not None]
    figures = {
        "held_out_rms_error": last["rms_error"],
        "held_out_mean_abs_error": last["mean_abs_error"],
        "held_out_max_abs_error": max(extremes, default=None),
        "bias": float(np.max(np.abs(calibration.bias))),
        "scale_factor": float(np.max(np.abs(np.diag(calibration.matrix) - 1.0))),
    }
    checks = []
    for name, limit in limits.items():
        if name not in figures:
            raise ConfigurationError(f"limits.{calibration.sensor}.{name} is unknown; known: {', '.join(figures)}")
        if limit is not None:
            value = figures[name]
            passes = value is not None and bool(value <= limit)
            checks.append({"name": name, "limit": float(limit), "value": value, "pass": passes})
    return checks, (all(c["pass"] for c in checks) if checks else None)
