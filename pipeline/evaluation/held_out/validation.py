"""Held-out errors: the errors of a calibration on samples that no fit used, and the error by noise alone.

The recordings of role ``validation`` are held out; without one, every third rest (``procedure.holdout_every``). Where
nothing is held out, the samples of the fit are used, and the result says so. With the truth t, the matrix M, and the
noise n of a sample with its diagonal covariance V (``Samples.variance``: white noise after the filter, bias wander,
resolution of the encoder, uncertainty of the creep at rest; not the uncertainty of the calibration or the table),

    noise_floor = sqrt(mean E[(|t + M n| - |t|)^2]),    vector_noise_floor = sqrt(mean tr(M V M^T))

Where no attitude is logged, |t| is the reference's magnitude, and the calibrated reading gives the direction of t.

A calibration is worse than the raw readings where its error is above its expected interval
(``pipeline.evaluation.held_out.error_breakdown``) and a t-test confirms it. The test compares the mean squared error of
each stretch of the recordings with that of the raw readings: B stretches, B - 1 degrees of freedom, and the probability
``FALSE_REFUSALS``.

A small error of the matrix does not show in the magnitude of a held-out error, because the noise of single samples
covers it. It shows in calibrated readings v of held-out motion whose reference u is a vector: with the error E of the
matrix, and noise e,

    v = e + (1 + E) u,    T = E^T C^-1 E,    C = C_held + S C_fit S^T

E is fitted in the same way as a calibration (``pipeline.estimation.reference_least_squares``). C_held is the covariance
of its nine elements by this fit, C_fit the covariance of the calibration's parameters, and S their effect on E. T / 9
has Fisher's distribution with 9 degrees of freedom and the effective degrees of freedom of the less certain fit. Errors
of local gravity and of the time base are the same in calibration and reference.

Formats of other programs can hold a part of the matrix, and none or some of the effects (``reduced``). The truth t of
the full calibration at the samples of the fit is their reference. With the readings r without the effects
that a format holds, the accelerometer's matrix S and bias b minimise

    sum |t - S (r - b)|^2,    S: full, diagonal, or 1

S is that of the calibration where the attitudes do not determine it. A gyroscope turns to one side more than to the
other, so that a fitted bias would not be that at rest: its diagonal is ``s_i = K_ii / |K_i|^2``, with K the inverse of
the full matrix, and its bias contains the mean of the effects that are not held and do not depend on the rate, as the
bias of a fit without them does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.core.errors import CannotCalibrateError, NotObservableError
from pipeline.core.records import (
    AXES,
    MATRIX,
    Agreement,
    LimitCheck,
    Noise,
    OverTemperature,
    Recording,
    Reduced,
    SensorCalibration,
    SensorValidation,
    StepErrors,
    TemperatureBin,
    UnitRecordings,
    Values,
    finite_rows,
)
from pipeline.core.settings import SensorLimits, Settings, Uncertainty
from pipeline.estimation import reference_least_squares
from pipeline.estimation.accelerometer.nonlinear_least_squares import PARAMETER_NAMES
from pipeline.estimation.rest_means import count_of_rests
from pipeline.estimation.stages import StageInput
from pipeline.estimation.uncertainty_budget import covariance_without_reference
from pipeline.evaluation.held_out import error_breakdown as breakdown
from pipeline.evaluation.held_out.error_breakdown import LinearizedSamples
from pipeline.evaluation.held_out.samples import HeldOutCase, Samples, reference_vector, squared_norm_errors
from pipeline.ingest.quality_flags import STUCK
from pipeline.physics.effects import bench_priors, effect_of, owner_of
from pipeline.physics.effects.base import OF_THE_BIAS, Owner, length, unit_of
from pipeline.physics.kinematics import EARTH_RATE_DPS
from pipeline.physics.signal.rests import Rest

FALSE_REFUSALS = 1e-3  # probability that a calibration as good as the raw readings is refused
STRETCHES = 20  # a stretch of a recording of minutes is longer than the correlation time of most wander
MIN_T_TEST_SAMPLES = 5  # of the t-test
BIN_DEGC = 5.0  # a bias that follows the temperature by 1 mg/degC (MPU-6050) changes by 5 mg within it
SWEEP_DEGC = 2 * BIN_DEGC  # fills two bins; a unit that warms up on the bench changes by less
FEWEST_IN_BIN = 10  # samples of a bin that is shown
EARTH_LEFT_OUT = (
    "the held-out recording logs no attitude: Earth's rotation is left out of its reference, and the expected error "
    f"allows for its {EARTH_RATE_DPS:.2g} deg/s"
)
# part of the matrix, and effects, of the formats in ``pipeline/output/exports/templates``
HELD: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("full", ()),
    ("full", ("g_sensitivity",)),
    ("full", OF_THE_BIAS),
    ("full", (*OF_THE_BIAS, "scale_factor_temperature")),
    ("diagonal", ()),
    ("diagonal", OF_THE_BIAS),
    ("none", ()),
    ("none", OF_THE_BIAS),
)
LEAST_SPREAD_G = 0.1  # rms in each direction; in one attitude, effects alone would determine a matrix
FEWEST_ROWS = 6  # orientations, of which an axis has an offset and three factors
OF_MATRIX = {"temperature", "angular_rate"}  # signals of an effect that changes a gyroscope's matrix
AT_REST_TOO = {"time", "temperature", "specific_force"}  # signals


@dataclass(frozen=True)
class HeldOutError:
    """A held-out rms error and the interval in which it is expected, g or deg/s."""

    error: float
    low: float
    high: float

    @property
    def above(self) -> bool:
        """Whether the error is larger than noise and stated uncertainties explain."""
        return self.error > self.high

    @property
    def below(self) -> bool:
        """Whether the error is smaller than the noise estimate explains."""
        return self.error < self.low


def validate(
    calibration: SensorCalibration,
    recordings: Sequence[Recording],
    noise: Noise,
    settings: Settings,
    *,
    other: SensorCalibration | None = None,
) -> SensorValidation:
    """Return the errors of a sensor on held-out motion; see ``HeldOutCase`` for the arguments."""
    case, sensor = HeldOutCase(calibration, recordings, noise, settings, other), calibration.sensor
    samples, reason = case.held_out_samples(), None
    if not samples:
        reason = _why_not_held_out(case)
        if count := _fitted_exactly(calibration):
            exactly = f"the fit passes through its {count} rests exactly"
            reason += f"; {exactly}, so that their error does not test it: record more"
        elif samples := case.fit_samples():
            reason += "; judged on the samples of the fit"
    count = int(sum(s.known.sum() for s in samples))
    held_out, limits = reason is None, settings.limits.of(sensor)
    about: dict[str, Any] = {"unit": unit_of(sensor), "held_out": held_out, "reason": reason, "samples": count}
    if not count:
        nothing = StepErrors("raw"), StepErrors("calibrated")
        checked = _check_limits(calibration, nothing[-1], limits)
        return SensorValidation(**about, noise=noise, steps=nothing, limits=checked)
    steps, notes = breakdown.error_breakdown(calibration, samples)
    expected, agreement, worse = None, None, None
    known = [s for s in samples if s.known.any()]
    if names := breakdown.left_out(calibration, known):
        verb = "is" if len(names) == 1 else "are"
        notes.append(
            f"the expected error is not stated, because {', '.join(names)} {verb} left out of the held-out error"
        )
    else:
        parts = [breakdown.linearized(calibration, s) for s in known]
        expected = _expected(case, parts)
        notes += [EARTH_LEFT_OUT] if any(s.earth_left_out for s in samples) else []
        if held_out:
            agreement, worse = _agreement(case, parts), _worse_than_raw(case, known, steps, expected[1])
    return SensorValidation(
        **about,
        noise=noise,
        noise_floor=noise_floor(calibration, samples),
        vector_noise_floor=vector_noise_floor(calibration, samples),
        reference_rms=float(np.sqrt(np.nanmean(np.concatenate([s.magnitude for s in samples]) ** 2))),
        steps=tuple(steps),
        notes=tuple(notes),
        expected_rms_error=expected,
        worse_than_raw=worse,
        agreement=agreement,
        over_temperature=_over_temperature(case, samples, held_out=held_out),
        reduced=tuple(reduced(case, samples, held_out=held_out)),
        limits=_check_limits(calibration, steps[-1], limits),
    )


def _over_temperature(case: HeldOutCase, samples: Sequence[Samples], *, held_out: bool) -> OverTemperature | None:
    """Return the errors over temperature, of the fit's samples if the held-out ones (``held_out``) sweep none."""
    bins, of_fit = residuals_over_temperature(case.calibration, samples), not held_out
    if bins is None and held_out:
        warmth = np.concatenate([np.zeros(0), *(r.temperature for r in case.recordings if r.temperature is not None)])
        warmth = warmth[np.isfinite(warmth)]
        if len(warmth) and np.ptp(warmth) >= SWEEP_DEGC:
            bins, of_fit = residuals_over_temperature(case.calibration, case.fit_samples()), True
    return (
        OverTemperature("the samples of the fit" if of_fit else "the held-out samples", tuple(bins)) if bins else None
    )


def residuals_over_temperature(
    calibration: SensorCalibration, samples: Sequence[Samples]
) -> list[TemperatureBin] | None:
    """Return the errors of the magnitude after the last step, in bins of the temperature of the sensor.

    The mean of a bin shows the remaining dependence on the temperature. None where the temperature is not recorded, or
    its range is below ``SWEEP_DEGC``.
    """
    temperatures, errors = [np.zeros(0)], [np.zeros(0)]
    for each in samples:
        if breakdown.left_out(calibration, [each]) or each.temperature is None:
            return None
        error = breakdown.magnitude_errors(calibration, [each])
        known = each.known & np.isfinite(error) & np.isfinite(each.temperature)
        temperatures.append(each.temperature[known])
        errors.append(error[known])
    warmth, error = np.concatenate(temperatures), np.concatenate(errors)
    if len(warmth) == 0 or np.ptp(warmth) < SWEEP_DEGC:
        return None
    number = np.floor(warmth / BIN_DEGC)
    masks = (number == each for each in np.unique(number))
    parts = [(warmth[mask], error[mask]) for mask in masks if mask.sum() >= FEWEST_IN_BIN]
    return [TemperatureBin(float(w.mean()), float(e.mean()), float(np.sqrt(np.mean(e**2))), len(e)) for w, e in parts]


def _expected(case: HeldOutCase, parts: Sequence[LinearizedSamples]) -> tuple[float, float]:
    """Return the interval of the last step's rms error.

    Earth's rotation, where it is left out of a magnitude, changes the rms error by its rate at most.
    """
    sensor = case.calibration.sensor
    fitted = [r for r in case.recordings if r.role in {sensor, "rests"} and r.samples and r.reading(sensor) is not None]
    fitted_s = sum(float(r.time[-1] - r.time[0]) for r in fitted)
    low, high = breakdown.expected_rms_error(case.calibration, parts, case.noise, case.settings, fitted_s)
    earth = EARTH_RATE_DPS if any(part.samples.earth_left_out for part in parts) else 0.0
    return max(low - earth, 0.0), high + earth


def static_error(case: HeldOutCase) -> HeldOutError | None:
    """Return the error of the mean of the static recording, and its interval as a held-out rest.

    The heading is unknown, so Earth's rotation widens the interval of a gyroscope twice: its component in the bias, and
    its component in the recording are unknown. None without a recording, or where this alone explains the error.
    """
    static = {r.name: [Rest(0, r.samples)] for r in case.recordings if r.role == "static" and r.samples}
    turning = 2.0 * EARTH_RATE_DPS if case.calibration.sensor == "gyroscope" else 0.0
    judged = last_error(case, case.at_rests(static), explained=turning)
    return judged and replace(judged, low=max(judged.low - turning, 0.0), high=judged.high + turning)


def last_error(case: HeldOutCase, samples: Sequence[Samples], *, explained: float = -1.0) -> HeldOutError | None:
    """Return the rms error of samples after the last step and its interval.

    None without samples or interval, or if the error is not larger than ``explained``.
    """
    known = [s for s in samples if s.known.any()]
    if not known or breakdown.left_out(case.calibration, known):
        return None
    error = breakdown.rms_error_of(case.calibration, known)
    parts = [breakdown.linearized(case.calibration, s) for s in known if error > explained]
    return HeldOutError(error, *_expected(case, parts)) if parts else None


def _agreement(case: HeldOutCase, parts: Sequence[LinearizedSamples]) -> Agreement | None:
    """Return how the matrix agrees with held-out motion; ``parts``: of the held-out recordings.

    None where no held-out motion has a vector reference, the method fixes elements of the matrix, a filter was applied,
    or an effect moves the motion in time.
    """
    calibration, settings = case.calibration, case.settings
    sensor = calibration.sensor
    of_method = any(stage.name == reference_least_squares.NAME for stage in calibration.stages)
    recordings = [r for r in case.recordings if r.role == "validation" and r.reading(sensor) is not None]
    vectors = all(r.table_attitude is not None and r.filter["name"] == "none" for r in recordings)
    moved = any(effect_of(fitted).moves for fitted in calibration.effects)
    if not (of_method and recordings and vectors and calibration.covariance is not None) or moved:
        return None
    if len(parts) < len(recordings) or any(part.samples.resting for part in parts):
        return None
    calibrated, slopes = [], np.zeros((9, len(calibration.covariance)))
    for recording, part in zip(recordings, parts, strict=True):
        samples = part.samples
        reading, _, truth = breakdown.with_known_effects(calibration, samples)
        if truth is None or not breakdown.direction_known(calibration, samples):
            return None
        known = samples.known & finite_rows(reading + truth)
        chosen = truth[samples.representative]
        rows = finite_rows(chosen)
        columns = np.column_stack([np.ones(np.count_nonzero(rows)), chosen[rows]])
        products = columns.T @ part.derivative[rows].reshape(len(columns), -1)
        per_parameter = (np.linalg.pinv(columns.T @ columns, hermitian=True) @ products)[1:].reshape(3, 3, -1)
        slopes += part.number * per_parameter.swapaxes(0, 1).reshape(9, -1)
        flags = np.zeros(len(known), np.uint16) if recording.flags is None else recording.flags
        values: dict[str, Any] = {"role": sensor, sensor: np.nan_to_num(reading)}
        calibrated.append(recording.with_readings(flags=np.where(known, flags, flags | STUCK), **values))
    at_rest = [r for r in case.recordings if r.role == "static"]
    table = settings.table.replaced(**dict.fromkeys(bench_priors().values()))
    plain = settings.replaced(table=table, uncertainty=Uncertainty(monte_carlo=0))
    held_out_and_static = UnitRecordings([*calibrated, *at_rest], {sensor: case.noise})
    try:
        fit = reference_least_squares.fit(StageInput(sensor, held_out_and_static, None, plain), details=False)
    except (CannotCalibrateError, NotObservableError):
        return None
    slopes /= sum(part.number for part in parts)
    error = np.linalg.inv(fit.matrix).ravel() - np.eye(3).ravel()
    C = covariance_without_reference(fit)[MATRIX, MATRIX]
    C += slopes @ covariance_without_reference(calibration) @ slopes.T
    freedom = min(float(np.min(each.parameters.degrees_of_freedom[MATRIX])) for each in (fit, calibration))
    from scipy.special import fdtrc  # noqa: PLC0415  (only held-out motion with a vector reference needs it)

    p_value = float(fdtrc(9, min(freedom, 1e9), float(error @ np.linalg.solve(C, error)) / 9.0))
    u = np.sqrt(np.diag(C))
    worst = int(np.argmax(np.abs(error) / u))
    return Agreement(p_value, AXES[worst // 3], AXES[worst % 3], float(error[worst]), 2.0 * float(u[worst]))


def noise_floor(calibration: SensorCalibration, samples: Sequence[Samples]) -> float:
    """Return the rms error by noise alone."""
    known = [(reference_vector(calibration, s, s.known), s.variance[s.known]) for s in samples]
    squares = [squared_norm_errors(truth, calibration.matrix, variance) for truth, variance in known]
    return float(np.sqrt(np.mean(np.concatenate(squares))))


def vector_noise_floor(calibration: SensorCalibration, samples: Sequence[Samples]) -> float | None:
    """Return the vector rms error by noise alone where an attitude is known."""
    if not all(breakdown.direction_known(calibration, s) for s in samples):
        return None
    vectors = np.concatenate([(s.variance @ np.sum(calibration.matrix**2, axis=0))[s.known] for s in samples])
    return float(np.sqrt(np.mean(vectors)))


def _why_not_held_out(case: HeldOutCase) -> str:
    reason = f"no held-out recording holds readings of the {case.calibration.sensor} and a reference for them"
    procedure = case.settings.procedure
    if procedure.sheet is not None:
        return reason + f" (column held_out of {procedure.sheet})"
    if case.by_hand and procedure.turns is not None:
        return reason + " (with two turns about each axis between rests of 4 s or longer, the second is held out)"
    count, fewest = count_of_rests(case.recordings), procedure.holdout_from
    if count < fewest and all(r.role != "validation" for r in case.recordings):
        every = procedure.holdout_every
        return reason + f" ({count} rests all go to the fit; of {fewest} and more, one of {every} is held out)"
    return reason


def _fitted_exactly(calibration: SensorCalibration) -> int:
    """Return the number of rests by hand if the fit has a parameter for each, and so no residual; 0 otherwise."""
    for stage in calibration.stages:
        count, known = stage.details.orientations_used, stage.details.known_by_limit or {}
        if stage.details.rests_used and count is not None and count + len(known) <= len(PARAMETER_NAMES):
            return count
    return 0


def _worse_than_raw(
    case: HeldOutCase, samples: Sequence[Samples], steps: Sequence[StepErrors], allowed: float
) -> str | None:
    """Return why a calibration must not be used, as one sentence; None where it may be used."""
    sizes = [step.rms_error or 0.0 for step in (steps[0], steps[-1])]
    if sizes[1] <= max(sizes[0], allowed):
        return None
    known = np.concatenate([s.known for s in samples])
    raw = np.concatenate([length(s.reading) - s.magnitude for s in samples])[known]
    calibrated = breakdown.magnitude_errors(case.calibration, samples)[known]
    if len(raw) < MIN_T_TEST_SAMPLES:
        return None
    pieces = np.array_split(calibrated**2 - raw**2, min(STRETCHES, len(raw)))
    means = np.array([piece.mean() for piece in pieces])
    from scipy.special import stdtrit  # noqa: PLC0415  (only where the calibration seems to be worse)

    limit = stdtrit(len(means) - 1, 1.0 - FALSE_REFUSALS) * float(means.std(ddof=1))
    if means.mean() * np.sqrt(len(means)) <= limit:
        return None
    unit, on_table = unit_of(case.calibration.sensor), case.settings.table.motion != "none"
    return (
        f"the calibration makes held-out motion worse: {sizes[0]:.3g} {unit} rms before it, {sizes[1]:.3g} {unit} "
        f"after, where noise and stated uncertainties explain at most {allowed:.3g} {unit}. Check that fit and "
        f"held-out recordings are of this unit in the same mounting{', and what the table logged' * on_table}"
    )


def _check_limits(calibration: SensorCalibration, last: StepErrors, limits: SensorLimits) -> tuple[LimitCheck, ...]:
    """Return each limit with its figure.

    A limit that is null is not checked; a figure that is not known does not pass.
    """
    extremes = [abs(v) for v in (last.max_error, last.min_error) if v is not None]
    figures = {
        "held_out_rms_error": last.rms_error,
        "held_out_mean_abs_error": last.mean_abs_error,
        "held_out_max_abs_error": max(extremes, default=None),
        "bias": float(np.max(np.abs(calibration.bias))),
        "scale_factor": float(np.max(np.abs(np.diag(calibration.matrix) - 1.0))),
    }
    checks = []
    for name, value in figures.items():
        limit: float | None = getattr(limits, name)
        if limit is not None:
            checks.append(LimitCheck(name, limit, value, value is not None and bool(value <= limit)))
    return tuple(checks)


def reduced(case: HeldOutCase, samples: Sequence[Samples], *, held_out: bool) -> list[Reduced]:
    """Return the best that each kind of format holds, with its error on samples; ``held_out``: no fit used them.

    Kinds that hold all of the calibration are left out, and all where the samples of the fit are too few. On a table,
    a calibration without effects needs no motion, and that of a gyroscope no samples: its bias remains.
    """
    calibration = case.calibration
    own = {e.name for e in calibration.effects if owner_of(e) == Owner.SENSOR}
    plain = held_out and not calibration.effects and not case.by_hand
    fitted, truth = samples, np.empty((0, 3))
    if not plain or calibration.sensor != "gyroscope":
        fitted = case.fit_samples(followed=not plain) if held_out else samples
        if sum(int(s.known.sum()) for s in fitted) < FEWEST_ROWS:
            return []
        truth = _calibrated(calibration, fitted)
    sloping, at_mean = _at_mean_temperature(calibration, fitted, truth)
    found: dict[tuple[str, frozenset[str]], Reduced] = {}
    for part, names in HELD:
        kept = frozenset(names) & own
        if (part, kept) in found or (part == "full" and kept == own):
            continue
        effects = tuple(e for e in calibration.effects if e.name in kept or e.name not in own)
        partial = replace(calibration, effects=effects)
        if calibration.sensor == "gyroscope":  # effects of the rate have no mean that a rest would have
            moving = [e for e in calibration.effects if not effect_of(e).fields("gyroscope", e.values) <= AT_REST_TOO]
            partial = replace(calibration, effects=tuple(e for e in calibration.effects if e in effects or e in moving))
        left = truth if partial.effects == calibration.effects else _calibrated(partial, fitted)
        bias, matrix = _fitted(calibration if kept >= sloping else at_mean, part, left, truth)
        partial = replace(partial, effects=effects)
        error = breakdown.rms_error_of(replace(partial, bias=bias, matrix=matrix), samples)
        found[part, kept] = Reduced(part, sorted(kept), bias.tolist(), matrix.tolist(), error)
    return list(found.values())


def _calibrated(calibration: SensorCalibration, samples: Sequence[Samples]) -> Values:
    """Return calibrated readings at samples that represent the recordings: (n, 3) array."""
    return np.concatenate([breakdown.with_known_effects(calibration, s)[0][s.representative] for s in samples])


def _at_mean_temperature(
    calibration: SensorCalibration, fitted: Sequence[Samples], truth: Values
) -> tuple[set[str], SensorCalibration]:
    """Return effects that change a gyroscope's matrix over temperature, and a calibration with the best fixed one."""
    found = {e.name for e in calibration.effects if effect_of(e).fields(calibration.sensor, e.values) == OF_MATRIX}
    if not found:
        return found, calibration
    others = tuple(e for e in calibration.effects if e.name not in found)
    left = _calibrated(replace(calibration, effects=others), fitted)
    known = finite_rows(left + truth)
    factor = np.linalg.lstsq(left[known], truth[known], rcond=None)[0].T
    return found, replace(calibration, matrix=factor @ calibration.matrix)


def _fitted(calibration: SensorCalibration, part: str, left: Values, truth: Values) -> tuple[Values, Values]:
    """Return bias and matrix; ``left``: calibrated readings without the effects that are not held, (n, 3)."""
    K = np.linalg.inv(calibration.matrix)
    diagonal = np.diag(np.diag(K) / np.sum(K**2, axis=1))
    matrix: Values = {"full": calibration.matrix, "diagonal": diagonal, "none": np.eye(3)}[part]
    if calibration.sensor == "gyroscope":
        if left is truth:
            return calibration.bias, matrix
        change = left - truth
        change = change[finite_rows(change)]
        return calibration.bias + K @ np.einsum("ij->j", change) / len(change), matrix
    known = finite_rows(left + truth)
    left, truth = left[known], truth[known]
    reading = left @ K.T  # minus the bias
    mean, mean_truth = (np.einsum("ij->j", v) / len(v) for v in (reading, truth))
    off, change = reading - mean, truth - mean_truth
    if part != "none" and _spread(off) >= LEAST_SPREAD_G:
        diagonal = np.diag(np.einsum("ij,ij->j", off, change) / np.einsum("ij,ij->j", off, off))
        matrix = np.linalg.lstsq(off, change, rcond=None)[0].T if part == "full" else diagonal
    return calibration.bias + mean - np.linalg.solve(matrix, mean_truth), matrix


def _spread(off: Values) -> float:
    """Return the least rms deviation along any direction, of (n, 3) deviations from the mean."""
    return float(np.sqrt(max(np.linalg.eigvalsh(off.T @ off)[0], 0.0) / len(off)))
