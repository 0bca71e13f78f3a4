"""The interval in which the held-out rms error lies with 99 % probability, if model, noise and uncertainties are right.

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
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import permutations
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.records import BASE_COUNT, BIAS, MATRIX_ROWS
from pipeline.estimation.gauss_markov import DEFAULT_TIME_S, SHARPEST_WIDTH, STATED_WIDTH, block_covariance
from pipeline.estimation.selection import INFLATED
from pipeline.estimation.uncertainty_budget import DITHERED, covariance_without_reference
from pipeline.evaluation.held_out.error_breakdown import last_step
from pipeline.evaluation.held_out.samples import Samples, mean_squares, reference_vector
from pipeline.physics.measurement import inverse_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.core.records import Noise, SensorCalibration, Values
    from pipeline.core.settings import Settings, Table


LACK_OF_FIT = "lack of fit"  # the part of a line of the budget that noise does not explain: 0 in a correct model
TAIL = 0.005  # probability on each side of a 99 % interval
# Probabilities at which the factors are computed; the weight of each is the probability between the middles.
LEVELS = np.array([0.0005, 0.004, 0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.98, 0.996, 0.9995])
WEIGHTS = np.diff(np.concatenate([[0.0], 0.5 * (LEVELS[1:] + LEVELS[:-1]), [1.0]]))
HELD_OUT_BLOCKS = 40  # of all held-out recordings; wander within a block counts as noise with its correlation time
SMALLEST_WIDTH = 0.5  # s of a wander of minutes, which may be a random walk (blind study, family null_random_walk)
REST_SAMPLES = 300  # that determine the white noise without a static recording: a few rests of seconds
EXACT_FREEDOM = 1e4  # degrees of freedom beyond which nu / chi^2(nu) is 1 to 1.4 %
NORMAL_FREEDOM = 1e6  # beyond which a chi-square is normal to 1e-3


@dataclass(frozen=True)
class LinearizedSamples:
    """Representative held-out samples of one recording, with the derivative of their calibrated readings."""

    time: Values  # (n,), s
    white_variance: Values  # (n, 3), of white noise per reading axis
    wander_variance: Values  # (n, 3)
    truth: Values  # (n, 3), g or deg/s
    derivative: Values  # (n, 3, p): J, with respect to the parameters of the calibration's covariance
    number: int  # known samples of the recording
    correlated_samples: float = 1.0  # as in ``Samples``


def linearized(calibration: SensorCalibration, samples: Samples) -> LinearizedSamples | None:
    """Return representative held-out samples with their derivative; None where an effect is left out of them.

    ``calibrated = M (reading - b - z)`` gives ``d/db = -M`` and ``d/dM_ij = e_i (M^-1 calibrated)_j``. The derivative
    with respect to a parameter of an effect is a difference quotient over one standard uncertainty. Where an effect
    moves the reference in time, the change of its magnitude counts along the truth with the opposite sign.
    """
    found = last_step(calibration, samples)
    if found is None:
        return None
    vector, magnitude, _ = found
    chosen = samples.representative
    truth = reference_vector(calibration, samples)[chosen]
    along = truth / np.maximum(np.linalg.norm(truth, axis=1, keepdims=True), 1e-300)
    steps = calibration.parameters.standard_uncertainty.tolist()
    J = np.zeros((len(chosen), 3, len(steps)))
    J[:, :, BIAS] = -calibration.matrix
    before = vector[chosen] @ inverse_of(calibration).T
    for i, row in enumerate(MATRIX_ROWS):
        J[:, i, row] = before
    names = [(n, name) for n, effect in enumerate(calibration.effects) for name in effect.parameters]
    for column, (n, name) in enumerate(names, BASE_COUNT):
        if (step := steps[column]) > 0.0:
            moved = last_step(_changed(calibration, n, name, step), samples)
            assert moved is not None  # noqa: S101  (the same effects)
            shift = along * (moved[1] - magnitude)[chosen, None]
            J[:, :, column] = (moved[0][chosen] - vector[chosen] - shift) / step
    return LinearizedSamples(
        samples.time[chosen],
        samples.white_variance[chosen],
        samples.wander_variance[chosen],
        truth,
        np.nan_to_num(J),
        int(np.count_nonzero(samples.known)),
        samples.correlated_samples,
    )


def _changed(calibration: SensorCalibration, number: int, name: str, step: float) -> SensorCalibration:
    """Return a calibration with a parameter of one of its effects changed by a step."""
    effects = list(calibration.effects)
    parameters = effects[number].parameters
    changed = {**parameters[name], "value": parameters[name]["value"] + step}
    effects[number] = replace(effects[number], parameters={**parameters, name: changed})
    return replace(calibration, effects=tuple(effects))


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
    wanders = [s.details["bias_wander"] for s in calibration.stages if "bias_wander" in s.details]
    residual_wander = np.array(wanders[-1]) if wanders else None  # of the residuals of the fit: (3,)
    time = data_sheet.wander_time_s
    drift = _drift(residual_wander, noise, data_sheet.bias_wander, time)
    coarse = np.where(noise.white < DITHERED * step, step**2 / 12.0, 0.0)  # rounding that is not in the white noise
    covariance, freedom = _of_parameters(calibration, settings.table)
    form = _form(calibration.matrix, held_out, covariance, noise, coarse=coarse, drift=drift, drift_time=time)
    if form.cumulants(np.ones((4, 1)))[0, 0] <= 0.0:
        return 0.0, 0.0
    observed_s = noise.length + (fitted_s if residual_wander is not None else 0.0)
    nu = form.freedom(freedom)
    factors = [_factors(nu, noise, observed_s, upper=upper) for upper in (False, True)]
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
        of_lines = [line.parts for line in calibration.lines]
        total, remaining = np.diag(calibration.covariance), np.diag(covariance)
        lack = np.sum([np.square(parts[LACK_OF_FIT]) for parts in of_lines if LACK_OF_FIT in parts], axis=0)
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
        n, share = len(each.truth), each.number / total
        count = max(1, min(n, round(HELD_OUT_BLOCKS * share)))
        label = np.arange(n) * count // n
        first = np.searchsorted(label, np.arange(count))
        interval = (each.time[-1] - each.time[0]) / max(n - 1, 1) if n > 1 else 1.0
        start = each.time[first]
        length = np.maximum(np.diff(start, append=each.time[-1] + interval), 1e-6)
        B = block_covariance(start, length, noise.correlation_time)
        W = _weights(M, each, covariance[:-1, :-1], drift + coarse)
        J = np.concatenate([each.derivative, -each.truth[:, :, None]], axis=2)
        WJ, MWM = W @ J, M.T @ W @ M
        of_parameters += share / n * np.tensordot(J, WJ, ([0, 1], [0, 1]))
        of_wander = np.add.reduceat(MWM, first, axis=0) * share / n
        across = np.swapaxes(np.add.reduceat(WJ, first, axis=0), 1, 2) @ M * share / n
        of_blocks.append((of_wander, across, B, block_covariance(start, length, drift_time)))
        size += 3 * count
        Q = MWM * (each.white_variance + coarse)[:, None, :]
        white = white + _traces_of(Q) * [share, share**2 * each.correlated_samples / each.number]
        within_block = np.clip(each.wander_variance - np.diag(B)[label, None] * noise.wander**2, 0.0, None)
        correlated = np.clip(noise.correlation_time / interval, 1.0, n / count) / n
        within = within + _traces_of(MWM * within_block[:, None, :]) * [share, share**2 * correlated]
    A, Q = np.zeros((size, size)), np.zeros((3, size, size))
    A[:q, :q], at = of_parameters, q
    for of_wander, across, _, _ in of_blocks:
        for form, mixed in zip(of_wander, across, strict=True):
            block = slice(at, at + 3)
            A[block, block], A[:q, block], A[block, :q] = form, mixed, mixed.T
            at = block.stop
    Q[0, :, :q], at = A[:, :q] @ covariance, q
    for of_wander, _, B, slow in of_blocks:  # the blocks of a recording have the covariance in time, on each axis
        blocks = slice(at, at + 3 * len(of_wander))
        of_axes = A[:, blocks].reshape(size, -1, 3).swapaxes(1, 2)
        for k, in_time, of_axis in ((1, B, noise.wander**2), (2, slow, drift)):
            Q[k, :, blocks] = ((of_axes @ in_time).swapaxes(1, 2) * of_axis).reshape(size, -1)
        at = blocks.stop
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
    return np.array([np.trace(Q, axis1=1, axis2=2).mean(), np.sum(Q * np.swapaxes(Q, 1, 2), axis=(1, 2)).mean()])


def _weights(M: Values, each: LinearizedSamples, C: Values, slow: Values) -> Values:
    """Return W of each sample, (n, 3, 3); ``C``: covariance of the parameters, ``slow``: (3,), further variance."""
    J, noise = each.derivative, each.white_variance + each.wander_variance + slow
    of_parameters = np.einsum("nip,pq,njq->ij", J, C, J, optimize=True) / len(J)
    mean = np.einsum("ij,j,kj->ik", M, noise.mean(axis=0), M) + of_parameters
    size = np.linalg.norm(each.truth, axis=1)
    u = each.truth / np.where(size > 0.0, size, 1.0)[:, None]
    g = mean_squares(each.truth, mean)[1][:, None, None]
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
    from scipy.optimize import brentq  # noqa: PLC0415  (as in _factors)
    from scipy.special import gammainc, ndtr  # noqa: PLC0415

    one, two, three = form.cumulants(factor)
    spread = np.sqrt(two)
    h = np.minimum(8.0 * two**3 / np.maximum(three, 1e-300) ** 2, NORMAL_FREEDOM)

    def excess(logarithm: float) -> float:
        z = (np.exp(logarithm) - one) / spread
        chi_square = gammainc(0.5 * h, np.clip(0.5 * (h + z * np.sqrt(2.0 * h)), 0.0, None))
        return float(weight @ np.where(h < NORMAL_FREEDOM, chi_square, ndtr(z))) - probability

    low, high = np.log(1e-6 * one.min()), np.log(float(np.max(one + 60.0 * spread)))
    if excess(low) >= 0.0:
        return float(np.exp(low))
    return float(np.exp(brentq(excess, low, high, xtol=1e-12)))
