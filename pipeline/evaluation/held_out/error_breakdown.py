"""Held-out errors after each step of a calibration, and the interval in which the last lies with 99 % probability.

The error of the calibrated reading of held-out sample n is ``M w_n + M m_n + J_n d``, with

    M  the matrix of the calibration
    w  white noise after the filter
    m  bias wander: a Gauss-Markov process, and the slower drift that the sensor file and the residuals of the fit allow
    d  errors of the parameters of the calibration, and of the scale of the table's rate (in the covariance where the
       uncertainty budget has such a line, else as an additional parameter)
    J  the derivative with respect to d

An error of local gravity or of the time base is the same in calibration and reference, and is left out.

The squared error of the magnitude has the mean ``tr(W S)`` (``pipeline.evaluation.held_out.samples``). Its mean over
samples is a quadratic form A in Gaussians w, m and d of covariance C. It is replaced by a shifted chi-square with the
same cumulants (J. P. Imhof, Biometrika 48 (1961), 419-426, section 4):

    k_1 = tr Q,   k_2 = 2 tr Q^2,   k_3 = 8 tr Q^3,      Q = A C

Wander and parameters are summed over blocks of samples, which bounds the size of Q. A finite recording does not
determine the noise exactly, so the interval is that of a mixture over factors of the variances:

    wander      exp(2 s z), z standard normal, s = sqrt(correlation time / length of static rest and fit)
    drift       z^2: its size is hardly known
    parameters  nu / chi^2(nu),   1 / sqrt(nu) = sum_i s_i / sqrt(nu_i)

with the degrees of freedom nu_i of each parameter, and its share s_i of the mean squared error by all parameters: the
error of a gyroscope at rest depends on the bias only, whose degrees of freedom are not those of the matrix. The
estimated variances have the relative uncertainty ``sqrt(2 / nu_i)``. They count as fully correlated, which makes the
interval rather too wide. The variance of white noise has the relative uncertainty ``sqrt(2 / n)``, where n samples
determined it.

Held-out errors after each step of a calibration: raw, after each stage, calibrated, with each effect added.

    accelerometer: e_n = |a_n| - gravity_g,    gyroscope: e_n = |g_n| - I_n        (Sudsanguan 2019, eqs 5.1 to 5.4)
    corrected = matrix @ (reading - bias - sum of effects)

with the error e_n of sample n, its corrected readings a_n and g_n, and the rate I_n of the table. Where the attitude is
logged, effects are computed from the motion of the reference, effects of timing shift the reference in time, and the
vector error is ``sqrt(mean |corrected - truth|^2)``. Without an attitude, effects are computed from the calibrated
readings of the log by fixed point, and effects of timing shift the logged rate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import permutations
from typing import TypeAlias

import numpy as np

from pipeline.core.errors import ConfigurationError
from pipeline.core.records import (
    BASE_COUNT,
    BIAS,
    MATRIX_ROWS,
    FittedEffect,
    Motion,
    Noise,
    SensorCalibration,
    StepErrors,
    Values,
    corrected,
    finite_rows,
    motion_at_rest,
)
from pipeline.core.settings import Settings, Table
from pipeline.estimation.gauss_markov import DEFAULT_TIME_S, SHARPEST_WIDTH, STATED_WIDTH, block_covariance
from pipeline.estimation.harm import InPieces
from pipeline.estimation.selection import INFLATED
from pipeline.estimation.uncertainty_budget import DITHERED, covariance_without_reference
from pipeline.evaluation.held_out.samples import OTHER_SENSOR, Samples, mean_squares, reference_vector
from pipeline.physics.effects import effect_of
from pipeline.physics.effects.base import length, truth
from pipeline.physics.effects.mounting import SEPARATOR, Mounting
from pipeline.physics.measurement import LogEnd, SensorEffects, fields_used, inverse_of, linear_truth, log_motion, solve

Corrected: TypeAlias = "tuple[Values, Values, Values | None]"  # vector, magnitude, truth


SPLINE_DEGREE = 3  # of the spline through a rate: 40 deg/s that change in 5 s are followed to 1e-4 deg/s at 0.12 s
TAIL = 0.005  # probability on each side of a 99 % interval
# Probabilities at which the factors are computed; the weight of each is the probability between the middles.
LEVELS = np.array([0.0005, 0.004, 0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.98, 0.996, 0.9995])
WEIGHTS = np.diff(np.concatenate([[0.0], 0.5 * (LEVELS[1:] + LEVELS[:-1]), [1.0]]))
FORM_SAMPLES = 500  # of a recording, in its quadratic form: intervals of 1,938 samples change by 1.1e-4 at most
HELD_OUT_BLOCKS = 40  # of all held-out recordings; wander within a block counts as noise with its correlation time
SMALLEST_WIDTH = 0.5  # s of a wander of minutes, which may be a random walk (blind study, family null_random_walk)
REST_SAMPLES = 300  # that determine the white noise without a static recording: a few rests of seconds
EXACT_FREEDOM = 1e4  # degrees of freedom beyond which nu / chi^2(nu) is 1 to 1.4 %
NORMAL_FREEDOM = 1e6  # beyond which a chi-square is normal to 1e-3
QUANTILE_STEP, MAX_QUANTILE_STEPS = 1e-6, 100  # relative; a bracket of 1e-6 to 60 deviations is halved 30 times


def error_breakdown(calibration: SensorCalibration, samples: Sequence[Samples]) -> tuple[list[StepErrors], list[str]]:
    """Return the errors after each step, and notes on effects that the samples cannot show."""
    stages = [(f"stage:{stage.name}", stage.correction) for stage in calibration.stages if stage.correction is not None]
    steps = [("raw", ()), *stages]
    figures = [_figures(name, [_uncorrected(s, corrected(c, s.reading)) for s in samples]) for name, c in steps]
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


def left_out(calibration: SensorCalibration, samples: Sequence[Samples]) -> list[str]:
    """Return the names of the effects that cannot be subtracted from some of the samples."""
    return [fitted.name for fitted in calibration.effects if any(_lack(fitted, s) for s in samples)]


def errors_of(calibrations: Sequence[SensorCalibration], samples: Sequence[Samples]) -> tuple[list[InPieces], Values]:
    """Return the errors of calibrations, with the effects that can be subtracted, in pieces of the samples.

    They are of the vector, if all samples have its direction for all calibrations, else of the magnitude. Also the
    times of the n samples at which all are known: (n,) array, s.
    """

    def of(calibration: SensorCalibration) -> Values:
        found = [with_known_effects(calibration, each) for each in samples]
        return vector_errors(found, directed=directed and all(true is not None for _, _, true in found))

    directed, known = True, np.concatenate([each.known for each in samples])
    while True:
        found, remaining = [], known.copy()
        for calibration in calibrations:  # one by one: the errors of a long recording have 100 MB each
            error = of(calibration)
            remaining &= finite_rows(error)
            found.append(InPieces.of(error if known.all() else error[known]))
        alike = len({each.mean.shape[1] for each in found}) == 1
        if alike and np.array_equal(remaining, known):
            return found, np.concatenate([each.time for each in samples])[known]
        directed, known = directed and alike, remaining


def vector_errors(corrected: Sequence[Corrected], *, directed: bool) -> Values:
    """Return the errors of vectors, (n, 3), or, unless the direction is known, of their magnitudes, (n, 1)."""
    parts = [v - true if directed and true is not None else (length(v) - m)[:, None] for v, m, true in corrected]
    return parts[0] if len(parts) == 1 else np.concatenate(parts)  # a copy of a long recording would have 18 MB


def with_known_effects(calibration: SensorCalibration, samples: Samples) -> Corrected:
    """Return calibrated readings, magnitude and vector of the reference, with the effects that can be subtracted."""
    return _with_effects(calibration, [fitted for fitted in calibration.effects if not _lack(fitted, samples)], samples)


def magnitude_errors(calibration: SensorCalibration, samples: Sequence[Samples]) -> Values:
    """Return the errors of the magnitude with the effects that can be subtracted: (n,) array."""
    return vector_errors([with_known_effects(calibration, s) for s in samples], directed=False)[:, 0]


def rms_error_of(calibration: SensorCalibration, samples: Sequence[Samples]) -> float:
    """Return the root mean square of the ``magnitude_errors`` that are known."""
    error = magnitude_errors(calibration, samples)
    return float(np.sqrt(np.mean(error[np.isfinite(error)] ** 2)))


def _uncorrected(samples: Samples, readings: Values) -> Corrected:
    """Return readings, and the magnitude and vector of the reference without effects."""
    return readings, samples.magnitude, None if samples.motion is None else truth(samples.sensor, samples.motion)


def _figures(name: str, corrected: Sequence[Corrected]) -> tuple[float, StepErrors]:
    """Return the mean absolute error of the magnitude, and all errors."""
    error = vector_errors(corrected, directed=False)[:, 0]
    known = np.isfinite(error)
    directed = all(true is not None for _, _, true in corrected)
    off = vector_errors(corrected, directed=True)[known] if directed else None
    error = error[known]
    mean, total, rms = float(np.mean(np.abs(error))), float(np.sum(np.abs(error))), float(np.sqrt(np.mean(error**2)))
    vector = None if off is None else float(np.sqrt(np.vdot(off, off) / len(off)))
    return mean, StepErrors(name, mean, total, float(error.max()), float(error.min()), rms, vector_rms_error=vector)


def _lack(fitted: FittedEffect, samples: Samples) -> str | None:
    """Return what the held-out recording lacks to subtract an effect, or None."""
    found = effect_of(fitted)
    if samples.motion is not None or _elsewhere(fitted, samples):
        missing = [need for need in found.needs if samples.motion and not samples.motion.has(need)]
        return f"the held-out recording holds no {' and no '.join(missing)}" if missing else None
    if found.moves:
        few = not samples.resting and len(samples.time) <= SPLINE_DEGREE
        return f"the held-out recording has {len(samples.time)} samples, too few to follow its rate" if few else None
    try:
        used = fields_used(samples.sensor, [fitted])
    except ConfigurationError as error:
        return f"the held-out recording logs no attitude ({error})"
    if "temperature" in found.needs and samples.temperature is None:
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
    effects = [fitted for fitted in effects if not _elsewhere(fitted, samples)]
    if not effects:
        return _uncorrected(samples, linear_truth(calibration, samples.reading))
    of_reading = [fitted for fitted in effects if not effect_of(fitted).moves]
    if samples.motion is None:
        moves = [fitted for fitted in effects if fitted not in of_reading]
        return _by_calibrated_log(calibration, of_reading, samples), _moved_magnitude(samples, moves), None
    motion, magnitude = _moved(samples.motion, effects), samples.magnitude
    found = linear_truth(calibration, SensorEffects.of(calibration, of_reading).take_off(samples.reading, motion))
    moved = truth(samples.sensor, motion)
    if motion is not samples.motion:
        magnitude = magnitude + (length(moved) - length(truth(samples.sensor, samples.motion)))
    return found, magnitude, moved if direction_known(calibration, samples) else None


def direction_known(calibration: SensorCalibration, samples: Samples) -> bool:
    """Return whether the reference has a direction: an attitude log, and no mounting that is unknown here."""
    mountings = [e for fitted in calibration.effects if isinstance(e := effect_of(fitted), Mounting)]
    return samples.motion is not None and all(e.covers(samples.motion) for e in mountings)


def _moved(motion: Motion, effects: Sequence[FittedEffect]) -> Motion:
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

    def motion(before: float | Values = 0.0, offset: float | Values = 0.0) -> Motion:
        later, rate = before + offset, np.zeros((len(time), 3))
        rate[:, 0] = spline(np.clip(time + later, time[0] - interval, time[-1] + interval))
        return motion_at_rest(time).changed(angular_rate=rate, at_offset=partial(motion, later))

    return np.asarray(np.abs(_moved(motion(), effects).angular_rate[:, 0]))


def _by_calibrated_log(calibration: SensorCalibration, effects: Sequence[FittedEffect], samples: Samples) -> Values:
    """Return calibrated readings, with effects by the calibrated signals of the log itself."""
    sensor = calibration.sensor
    readings = {sensor: samples.reading}
    if samples.other is not None:
        readings[OTHER_SENSOR[sensor]] = samples.other
    used = fields_used(sensor, effects)
    nothing, warming = np.zeros_like(samples.reading), samples.temperature_rate

    def motion_of(truths: dict[str, Values], _number: int) -> Motion:
        found = log_motion(
            samples.time,
            specific_force=truths.get("accelerometer", nothing),
            angular_rate=nothing if samples.resting else truths.get("gyroscope", nothing),
            temperature=samples.temperature,
            temperature_rate=warming() if warming and "temperature_rate" in used else None,
            used=used,
            end=LogEnd(),
        )
        return replace(found, specific_force_rate=nothing, angular_acceleration=nothing) if samples.resting else found

    return solve({sensor: SensorEffects.of(calibration, effects)}, readings, motion_of)[sensor]


@dataclass(frozen=True)
class LinearizedSamples:
    """Representative held-out samples of one recording, with the derivative of their calibrated readings."""

    samples: Samples
    truth: Values  # (n, 3), g or deg/s
    derivative: Values  # (n, 3, p): J, with respect to the parameters of the calibration's covariance
    number: int  # known samples of the recording


def linearized(calibration: SensorCalibration, samples: Samples) -> LinearizedSamples:
    """Return representative held-out samples with their derivative, for a calibration of which no effect is left out.

    ``calibrated = M (reading - b - z)`` gives ``d/db = -M`` and ``d/dM_ij = e_i (M^-1 calibrated)_j``. The derivative
    with respect to a parameter of an effect is a difference quotient over one standard uncertainty. Where an effect
    moves the reference in time, the change of its magnitude counts along the truth with the opposite sign.
    """
    vector, magnitude, _ = _with_effects(calibration, calibration.effects, samples)
    chosen = samples.representative
    truth = reference_vector(calibration, samples, chosen)
    along = truth / np.maximum(length(truth), 1e-300)[:, None]
    steps = calibration.parameters.standard_uncertainty.tolist()
    J = np.zeros((len(chosen), 3, len(steps)))
    J[:, :, BIAS] = -calibration.matrix
    before = vector[chosen] @ inverse_of(calibration).T
    for i, row in enumerate(MATRIX_ROWS):
        J[:, i, row] = before
    places = [(n, k) for n, effect in enumerate(calibration.effects) for k in range(len(effect.parameters))]
    for column, (n, k) in enumerate(places, BASE_COUNT):
        if (step := steps[column]) > 0.0:
            effects = list(calibration.effects)
            values = effects[n].values
            values[k] += step
            effects[n] = effects[n].at(values.tolist())
            moved = _with_effects(replace(calibration, effects=tuple(effects)), effects, samples)
            shift = along * (moved[1] - magnitude)[chosen, None]
            J[:, :, column] = (moved[0][chosen] - vector[chosen] - shift) / step
    number = int(np.count_nonzero(samples.known))
    return LinearizedSamples(samples, truth, J if np.isfinite(J).all() else np.nan_to_num(J), number)


def expected_rms_error(
    calibration: SensorCalibration,
    held_out: Sequence[LinearizedSamples],
    noise: Noise,
    settings: Settings,
    fitted_s: float = 0.0,
) -> tuple[float, float]:
    """Return the interval in which the rms error lies with 99 % probability, g or deg/s.

    Without a covariance, the parameters of the calibration count as exact. ``fitted_s``: length of the recordings of
    the fit, s.
    """
    data_sheet = settings.sensor.of(calibration.sensor)
    step = 1.0 / data_sheet.counts_per_unit
    wanders = [s.details.bias_wander for s in calibration.stages if s.details.bias_wander is not None]
    residual_wander = np.array(wanders[-1]) if wanders else None  # of the residuals of the fit: (3,)
    time = data_sheet.wander_time_s
    drift = _drift(residual_wander, noise, data_sheet.bias_wander, time)
    coarse = np.where(noise.white < DITHERED * step, step**2 / 12.0, 0.0)  # rounding that is not in the white noise
    covariance, freedom = _of_parameters(calibration, settings.table)
    form = _form(calibration.matrix, held_out, covariance, noise, coarse=coarse, drift=drift, drift_time=time)
    if form.cumulants(np.ones((4, 1)))[0, 0] <= 0.0:
        return 0.0, 0.0
    observed_s = noise.length + (fitted_s if residual_wander is not None else 0.0)
    factors = [_factors(form.freedom(freedom), noise, observed_s, upper=upper) for upper in (False, True)]
    low, high = (_quantile(form, *f, p) for f, p in zip(factors, (TAIL, 1.0 - TAIL), strict=True))
    return float(np.sqrt(low)), float(np.sqrt(high))


def _drift(residual_wander: Values | None, noise: Noise, size: float, time: float) -> Values:
    """Return the variance of a drift in addition to the wander: (3,) array.

    It is the amount by which the wander of the sensor file (``size``, ``time``), and that of the residuals of the fit,
    which last longer than a rest, exceed the wander of the noise model. A residual may contain a missing effect, so at
    most ``INFLATED`` times the expected wander counts.
    """
    slow = noise.wander**2 * min(1.0, noise.correlation_time / time)
    limit = INFLATED**2 * np.maximum(noise.wander**2, size**2)
    fitted = noise.wander**2 if residual_wander is None else np.minimum(residual_wander**2, limit)
    return np.asarray(np.maximum(size**2 - slow, 0.0) + np.maximum(fitted - noise.wander**2, 0.0))


def _of_parameters(calibration: SensorCalibration, table: Table) -> tuple[Values, Values]:
    """Return covariance and degrees of freedom of the parameters and of the scale of the table's rate.

    The covariance is without lack of fit. Errors that calibration and reference share are left out. Their size is
    exact, so that the degrees of freedom of the remaining variance follow by Welch and Satterthwaite.
    """
    parameters, size = calibration.parameters, len(calibration.parameters)
    out, nu = np.zeros((size + 1, size + 1)), np.full(size + 1, np.inf)
    if calibration.covariance is not None:
        covariance = covariance_without_reference(calibration)
        of_lines = [line.parts.lack_of_fit for line in calibration.lines]
        total, remaining = np.diag(calibration.covariance), np.diag(covariance)
        lack = np.sum([np.square(part) for part in of_lines if part is not None], axis=0)
        scale = np.sqrt(np.clip(1.0 - lack / np.where(remaining > 0.0, remaining, 1.0), 0.0, 1.0)) * np.ones(size)
        out[:size, :size] = covariance * scale[:, None] * scale
        share = np.clip(remaining / np.where(total > 0.0, total, 1.0), 0.0, 1.0)
        with np.errstate(invalid="ignore"):  # of a parameter without variance
            nu[:size] = np.where(share > 0.0, np.maximum(parameters.degrees_of_freedom * share**2, 1.0), np.inf)
    if calibration.sensor == "gyroscope" and not any(line.source == "table rate" for line in calibration.lines):
        out[size, size] = table.rate_accuracy**2
    return out, nu


@dataclass(frozen=True)
class _QuadraticForm:
    """Traces of the form of the mean squared error."""

    by_parameter: Values  # (p + 1,): mean squared error by the uncertainty of each parameter alone
    white: Values  # (2,): tr Q and tr Q^2 of white noise
    within: Values  # (2,): the same of wander within blocks
    doubt: float  # one over the number of samples that determined the white noise
    first: Values  # (3,): tr Q of parameters, of wander and of drift
    second: Values  # (3, 3): traces of products of two of them
    third: Values  # (3, 3, 3): traces of products of three

    def freedom(self, each: Values) -> float:
        """Return the degrees of freedom of the error by all parameters, from those of each parameter: (p + 1,)."""
        uncertain = float(self.by_parameter @ each**-0.5)
        return (float(self.by_parameter.sum()) / uncertain) ** 2 if uncertain > 0.0 else float("inf")

    def cumulants(self, factor: Values) -> Values:
        """Return k_1 to k_3, (3, k), for factors of the variances of parameters, wander, drift, white noise: (4, k)."""
        f, white, within = factor[:3], factor[3] * self.white[0], factor[1] * self.within[0]
        one = self.first @ f
        two = np.einsum("ij,ik,jk->k", self.second, f, f)
        three = np.einsum("ijl,ik,jk,lk->k", self.third, f, f, f)
        share, share_within = (t[1] / t[0] ** 2 if t[0] > 0.0 else 0.0 for t in (self.white, self.within))
        w, v = white * share, within * share_within  # eigenvalues of one independent value
        squares = two + 2.0 * w * one + white**2 * (share + self.doubt) + within**2 * share_within
        cubes = three + 3.0 * w * two + 3.0 * w**2 * one + white * w**2 + within * v**2
        return np.stack([one + white + within, 2.0 * squares, 8.0 * cubes])


def _form(
    M: Values,
    held_out: Sequence[LinearizedSamples],
    covariance: Values,
    noise: Noise,
    *,
    coarse: Values,
    drift: Values,
    drift_time: float,
) -> _QuadraticForm:
    """Return the form of the mean squared error; ``coarse, drift``: (3,) variances in addition to noise and wander."""
    q = len(covariance)
    total = sum(each.number for each in held_out)
    white, within, size = np.zeros(2), np.zeros(2), q
    of_parameters, of_blocks = np.zeros((q, q)), []
    for each in held_out:
        samples, rows = each.samples, each.samples.representative
        time, whole, share = samples.time[rows], len(rows), each.number / total
        thin = slice(None, None, -(-whole // FORM_SAMPLES))
        truth, derivative = each.truth[thin], each.derivative[thin]
        of_white, of_wander = samples.white_variance[rows[thin]], samples.wander_variance[rows[thin]]
        n = len(truth)
        count = max(1, min(n, round(HELD_OUT_BLOCKS * share)))
        label = np.arange(n) * count // n
        first = np.searchsorted(label, np.arange(count))
        interval = (time[-1] - time[0]) / max(whole - 1, 1) if whole > 1 else 1.0
        start = time[thin][first]
        length = np.maximum(np.diff(start, append=time[-1] + interval), 1e-6)
        B = block_covariance(start, length, noise.correlation_time)
        W = _weights(M, truth, derivative, of_white + of_wander + (drift + coarse), covariance[:-1, :-1])
        J = np.concatenate([derivative, -truth[:, :, None]], axis=2)
        WJ, MWM = W @ J, M.T @ W @ M
        of_parameters += share / n * (J.reshape(-1, q).T @ WJ.reshape(-1, q))
        inner = np.add.reduceat(MWM, first, axis=0) * share / n
        across = np.swapaxes(np.add.reduceat(WJ, first, axis=0), 1, 2) @ M * share / n
        of_blocks.append((inner, across, B, block_covariance(start, length, drift_time)))
        size += 3 * count
        Q = MWM * (of_white + coarse)[:, None, :]
        white = white + _traces_of(Q) * [share, share**2 * samples.correlated_samples / each.number]
        within_block = np.clip(of_wander - np.diag(B)[label, None] * noise.wander**2, 0.0, None)
        correlated = np.clip(noise.correlation_time / interval, 1.0, whole / count) / whole
        within = within + _traces_of(MWM * within_block[:, None, :]) * [share, share**2 * correlated]
    A, Q = np.zeros((size, size)), np.zeros((3, size, size))
    A[:q, :q], at = of_parameters, q
    for inner, across, B, slow in of_blocks:  # the blocks of a recording have the covariance in time, on each axis
        count = len(inner)
        blocks, own = slice(at, at + 3 * count), np.zeros((count, 3, count, 3))
        own[range(count), :, range(count)] = inner
        A[blocks, blocks], A[blocks, :q] = own.reshape(3 * count, -1), across.swapaxes(1, 2).reshape(-1, q)
        A[:q, blocks], at = A[blocks, :q].T, blocks.stop
        for k, in_time, of_axis in ((1, B, noise.wander**2), (2, slow, drift)):
            mixed = (in_time @ A[blocks].reshape(count, -1)).reshape(count, 3, size)
            Q[k, :, blocks] = (mixed * of_axis[:, None]).reshape(-1, size).T
    Q[0, :, :q] = A[:, :q] @ covariance
    transposed = np.swapaxes(Q, 1, 2).reshape(3, -1)
    determined = noise.length / interval if noise.length > 0.0 else REST_SAMPLES
    first_order, second_order = np.trace(Q, axis1=1, axis2=2), Q.reshape(3, -1) @ transposed.T
    third_order = np.empty((3, 3, 3))
    for i, j in ((0, 0), (0, 1), (1, 1), (2, 2)):  # with each of the three: the trace is the same in every order
        filled = slice(q, None) if i else slice(q)  # the columns that are not zero
        for l, trace in enumerate(transposed @ (Q[i, :, filled] @ Q[j, filled]).ravel()):
            for order in permutations((i, j, l)):
                third_order[order] = trace
    by_parameter = np.diag(of_parameters) * np.diag(covariance)
    return _QuadraticForm(by_parameter, white, within, 1.0 / determined, first_order, second_order, third_order)


def _traces_of(Q: Values) -> Values:
    """Return the means of ``tr Q`` and ``tr Q^2`` over samples: (2,) array."""
    return np.array([np.einsum("nii->", Q), np.einsum("nij,nji->", Q, Q)]) / len(Q)


def _weights(M: Values, truth: Values, J: Values, variance: Values, C: Values) -> Values:
    """Return W of each sample, (n, 3, 3); ``variance``: (n, 3), of the noise; ``C``: covariance of the parameters."""
    by_axis, of_axis = (v.swapaxes(0, 1).reshape(3, -1) for v in (J, (J.reshape(-1, len(C)) @ C).reshape(J.shape)))
    mean = M * variance.mean(axis=0) @ M.T + of_axis @ by_axis.T / len(J)
    size = length(truth)
    u = truth / np.where(size > 0.0, size, 1.0)[:, None]
    g = mean_squares(truth, mean)[1][:, None, None]
    return np.asarray((1.0 - g) * u[:, :, None] * u[:, None, :] + g * np.eye(3))


def _factors(nu: float, noise: Noise, observed_s: float, *, upper: bool) -> tuple[Values, Values]:
    """Return the factors of the mixture, (4, k), and their probabilities (k,).

    The lower end leaves out drift and errors of parameters, which need not occur in this recording. It assumes that the
    wander is known no better than by a data sheet.
    """
    from scipy.special import gammaincinv, ndtri  # noqa: PLC0415  (0.1 s that other stages do not pay)

    z = ndtri(LEVELS)
    width = STATED_WIDTH
    if upper and observed_s > 0.0:
        minutes = min(1.0, noise.correlation_time / DEFAULT_TIME_S)
        width = np.sqrt(max(noise.correlation_time / observed_s, SMALLEST_WIDTH**2 * minutes))
        width = float(np.clip(width, SHARPEST_WIDTH, STATED_WIDTH))
    wander = np.exp(2.0 * width * z)
    drift = 2.0 * gammaincinv(0.5, LEVELS) if upper else np.zeros(len(z))
    white = np.ones(len(z)) if noise.source != "data_sheet" else np.exp(2.0 * STATED_WIDTH * z)
    parameters, weights = np.full(1, float(upper)), np.ones(1)
    if upper and nu < EXACT_FREEDOM:
        parameters, weights = 0.5 * nu / gammaincinv(0.5 * nu, 1.0 - LEVELS), WEIGHTS
    shape = (len(parameters), len(z))
    slow = [np.broadcast_to(values, shape).ravel() for values in (wander, drift, white)]
    return np.stack([np.repeat(parameters, len(z)), *slow]), np.outer(weights, WEIGHTS).ravel()


def _quantile(form: _QuadraticForm, factor: Values, weight: Values, probability: float) -> float:
    """Return a quantile of the mean squared error, mixed over factors (4, k) of probabilities (k,)."""
    from scipy.special import gammainc, ndtr, ndtri  # noqa: PLC0415  (as in _factors)

    one, two, three = form.cumulants(factor)
    spread, goal = np.sqrt(two), float(ndtri(probability))
    h = np.minimum(8.0 * two**3 / np.maximum(three, 1e-300) ** 2, NORMAL_FREEDOM)
    half, root, normal = 0.5 * h, np.sqrt(2.0 * h), h >= NORMAL_FREEDOM
    some_normal = bool(normal.any())

    def excess(logarithm: float) -> float:
        z = (np.exp(logarithm) - one) / spread
        below = gammainc(half, np.maximum(0.5 * (h + z * root), 0.0))
        if some_normal:
            below = np.where(normal, ndtr(z), below)
        return float(ndtri(min(max(float(weight @ below), 1e-300), 1.0 - 1e-16))) - goal

    # As a quantile of the normal distribution, the probability is nearly linear in the logarithm: the secant method,
    # from the lognormal distribution of the same mean and variance; a step out of the bracket halves it.
    low, high = float(np.log(1e-6 * one.min())), float(np.log(np.max(one + 60.0 * spread)))
    mean = float(weight @ one)
    width = float(np.sqrt(np.log(float(weight @ (two + one**2)) / mean**2)))
    at, slope = float(np.log(mean)) + width * (goal - 0.5 * width), 1.0 / width
    last, last_off = at, 0.0
    for step in range(MAX_QUANTILE_STEPS):
        off = excess(at)
        low, high = (low, at) if off > 0.0 else (at, high)
        slope = (off - last_off) / (at - last) if step and off != last_off else slope
        last, last_off, at = at, off, at - off / slope
        if not low - QUANTILE_STEP < at < high + QUANTILE_STEP:
            at = 0.5 * (low + high)
        if abs(at - last) < QUANTILE_STEP:
            break
    return float(np.exp(at))
