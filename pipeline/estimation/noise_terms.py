"""Noise terms of a sensor at rest: spectra, Allan variances, and the likelihood of a sum of terms.

With ``w = 2 pi f dt`` and ``s = 2 sin(w / 2)``, each term adds to the variance of a coefficient of the cosine transform
(first column) and to the Allan variance at the averaging time t (second column):

    quantisation Q     : Q^2 s^2 / dt^2                                   3 Q^2 / t^2
    white N            : N^2 / dt                                         N^2 / t
    bias_instability B : B^2 / s        (two-sided B^2 / (2 pi f))        (2 ln 2 / pi) B^2
    random_walk K      : K^2 dt / s^2                                     K^2 t / 3
    gauss_markov G, T  : G^2 (1 - p^2) / ((1 - p)^2 + p s^2)              2 G^2 / x (1 - (3 - 4 e^-x + e^-2x) / (2 x))
    ramp R             : deterministic, R t                               R^2 t^2 / 2
    sinusoid A, f      : deterministic, A cos(2 pi f t + phase)           A^2 sin^4(pi f t) / (pi f t)^2

where p = exp(-dt / T), x = t / T, and G is the standard deviation of the process. N^2 is the two-sided spectral density
of white noise: ``N = sigma sqrt(dt)``, and the Allan deviation at 1 s is N. A density of a data sheet that is one-sided
is ``sqrt(2) N``. The overlapping Allan deviation of N readings with the integral theta, over m intervals dt, is

    sigma^2(tau) = sum_i (theta[i + 2m] - 2 theta[i + m] + theta[i])^2 / (2 tau^2 (N - 2m + 1)),   tau = m dt

For long averages only every (m / ``PER_AVERAGE``)th term is summed, because neighbouring terms are nearly equal.

The orthonormal cosine transform (DCT-II) of n samples diagonalises the covariance of white noise plus a random walk of
unknown start exactly. For the other terms it does so approximately, with errors from the ends of the recording. The
mean, k = 0, is not used. With the other coefficients y_k,

    y_k = sum_d beta_d z_dk + sqrt(S(w_k)) e_k,   w_k = pi k / n,   S = sum_j exp(theta_j) s_j(w)
    -2 log L = sum_k (log S_k + (y_k - z_k beta)^2 / S_k) + log det(sum_k z_k z_k^T / S_k)

where s_j is the spectrum of term j, exp(theta_j) its squared coefficient, e unit white noise, and z the transforms of
the deterministic columns (ramp, sinusoids, temperature). beta follows by generalised least squares, and the last term
makes the likelihood a restricted one. Sums over the coefficients are computed once, in bins whose edges have the ratio
``BIN_RATIO``. Fits of all axes, compositions and columns run together, by Fisher scoring with the damping of Levenberg
and Marquardt. A search is a generator: it yields the ``TermTrial``s that it needs next and receives their ``TermFits``;
``at_once`` joins the trials of several searches.

Sources: IEEE Std 952-1997, annex C; Riley, NIST SP 1065, section 5.2.4; Strang, SIAM Review 41, 1999 (the transform);
Whittle 1953; Patterson & Thompson, Biometrika 58, 1971.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import accumulate
from typing import NamedTuple, TypeVar

import numpy as np
import scipy

from pipeline.core.records import Integers, Mask, Values

QUANTISATION, WHITE, INSTABILITY, WALK, MARKOV = range(5)
PER_AVERAGE = 64  # overlapping terms of the sum in one average
SINGLE = (QUANTISATION, WHITE, INSTABILITY, WALK)
STOCHASTIC = ("quantisation", "white", "bias_instability", "random_walk", "gauss_markov")
TERM_UNITS = {
    "quantisation": "{0} s", "white": "{0}/sqrt(Hz)", "bias_instability": "{0}", "random_walk": "{0}/sqrt(s)",
    "gauss_markov": "{0}", "ramp": "{0}/s", "sinusoid": "{0}",
}  # fmt: skip
BIN_RATIO = 1.05  # of the edges of a bin: the spectrum of a random walk changes by a tenth, its mean by 0.2 %
LONGEST_TIME = 0.5  # correlation time, in lengths of the recording, above which a process is a random walk
STEP_LIMITS = (-4.0, 1.5)  # largest changes of a logarithm in one iteration; an absent term falls fast
ITERATIONS, PRECISION = 40, 1e-2  # gain in -2 log L, predicted or of the last step, that ends them; 3.84 is 95 %
LARGEST_DAMPING = 1e4  # of Levenberg and Marquardt: steps of 1e-4 of the gradient are no progress
LOG_LEAST = -690.0  # of a squared coefficient: above the smallest double

Composition = tuple[int, ...]  # a set of stochastic terms: their kinds, in rising order
Result = TypeVar("Result")


def unit_of(term: str, unit: str) -> str:
    """Return the unit of a term's coefficient for a sensor's unit."""
    return TERM_UNITS[term].format(unit)


def fixed_shapes(omega: Values, interval: float) -> Values:
    """Return the spectra of Q, N, B and K with unit coefficients: (4, b) array. ``omega``: w, rad per sample."""
    s = 2.0 * np.sin(omega / 2.0)
    return np.stack([s**2 / interval**2, np.full_like(s, 1.0 / interval), 1.0 / s, interval / s**2])


def markov_shape(omega: Values, interval: float, log_time: Values) -> tuple[Values, Values]:
    """Return the spectrum of Gauss-Markov processes of unit variance, and its derivative by the log of T."""
    squares = 4.0 * np.sin(omega / 2.0) ** 2
    rate = interval * np.exp(-log_time)[..., None]
    p, q = np.exp(-rate), -np.expm1(-rate)
    denominator = q**2 + p * squares
    shape = q * (1.0 + p) / denominator
    slope = (-2.0 * p - shape * (squares - 2.0 * q)) / denominator * p * rate
    return shape, slope


def allan_variance(name: str, value: float, tau: Values, constant: float = np.nan) -> Values:
    """Return the Allan variance of a term with this coefficient at averaging times in s.

    ``constant``: of a Gauss-Markov process the correlation time, s; of a sinusoid the frequency, Hz.
    """
    if name == "gauss_markov":
        x = tau / constant
        series = x < 1e-3  # the closed form cancels there; its error is x^2, relative
        y = np.where(series, 1.0, x)
        bend = 1.0 - (3.0 - 4.0 * np.exp(-y) + np.exp(-2.0 * y)) / (2.0 * y)
        return np.asarray(value**2 * np.where(series, 2.0 * x / 3.0, 2.0 / y * bend))
    if name == "sinusoid":
        x = np.pi * constant * tau
        return np.asarray(value**2 * np.sin(x) ** 4 / x**2)
    instability = np.full_like(tau, 2.0 * np.log(2.0) / np.pi)
    power = {"quantisation": 3.0 / tau**2, "white": 1.0 / tau, "bias_instability": instability}
    power |= {"random_walk": tau / 3.0, "ramp": tau**2 / 2.0}
    return np.asarray(value**2 * power[name])


def allan_deviation(values: Values, interval: float, points_per_decade: int = 10) -> tuple[Values, Values]:
    """Return averaging times, s, and the overlapping Allan deviation of (n,) or (n, k) readings, evenly sampled.

    (m,) and (m,) or (m, k) arrays; both are empty for fewer than 3 readings.
    """
    n = len(values)
    longest = (n - 1) // 2
    if longest < 1:
        return np.empty(0), np.empty((0, *values.shape[1:]))
    count = 1 + int(points_per_decade * np.log10(longest))
    lengths = np.unique(np.geomspace(1, longest, count).astype(np.int64))
    theta = np.zeros((values[0].size, n + 1))
    np.cumsum((values - values.mean(axis=0)).reshape(n, -1).T, axis=1, out=theta[:, 1:])
    twice = 2.0 * theta
    deviation = np.empty((len(lengths), len(theta)))
    for row, m in enumerate(lengths):
        step = max(1, int(m) // PER_AVERAGE)
        second = theta[:, 2 * m :: step] - twice[:, m:-m:step]
        second += theta[:, : -2 * m : step]
        deviation[row] = np.sqrt(np.einsum("ij,ij->i", second, second) / (2.0 * second.shape[1])) / m
    return lengths.astype(np.float64) * interval, deviation.reshape(-1, *values.shape[1:])


def octave_variances(stretches: Sequence[Values], interval: float) -> tuple[Values, Values, Values]:
    """Return averaging times of octaves, s, Allan variances of all (n, k) stretches together, and degrees of freedom.

    (m,), (m, k) and (m,) arrays. The longest time is a quarter of the longest stretch. The degrees of freedom are those
    of white noise (Riley, NIST SP 1065, table 5).
    """
    longest = max(len(values) for values in stretches) // 4
    lengths = 2 ** np.arange(int(np.log2(longest)) + 1)
    squares, (terms, freedom) = np.zeros((len(lengths), stretches[0].shape[1])), np.zeros((2, len(lengths)))
    for values in stretches:
        n = len(values)
        theta = np.zeros((n + 1, values.shape[1]))
        np.cumsum(values - values.mean(axis=0), axis=0, out=theta[1:])
        for row, m in enumerate(lengths[: int(np.log2(n // 4)) + 1].tolist()):
            step = max(1, m // PER_AVERAGE)
            second = 2.0 * theta[m:-m:step]
            second = np.add(np.subtract(theta[2 * m :: step], second, out=second), theta[: -2 * m : step], out=second)
            squares[row] += np.einsum("ik,ik->k", second, second)
            terms[row] += len(second)
            freedom[row] += (1.5 * n / m - 2.0 * (n - 1) / (n + 1)) * 4.0 * m**2 / (4.0 * m**2 + 5.0)
    return lengths.astype(np.float64) * interval, squares / (2.0 * lengths**2 * terms)[:, None], freedom


@dataclass(frozen=True)
class Spectrum:
    """Coefficients of the axes in b bins of frequency."""

    # each (b,); mean of w in rad a sample, and coefficients, of each bin
    omega: Values
    count: Values
    products: Values  # (a, b, c, c); sums over each bin of y and the deterministic columns, in this order, of a axes
    interval: float  # s; between samples
    length: float  # s; of the longest stretch without a gap

    @cached_property
    def shapes(self) -> Values:
        """Spectra of the terms without a correlation time, and zeros for Gauss-Markov (4) and none (-1): (6, b)."""
        return np.pad(fixed_shapes(self.omega, self.interval), ((0, 2), (0, 0)))

    @property
    def size(self) -> float:
        """Number of coefficients of an axis."""
        return float(self.count.sum())


def spectrum_of(stretches: Sequence[Values], interval: float) -> Spectrum:
    """Return the spectrum of stretches of samples: (a, n, c) arrays, readings first, then deterministic columns."""
    centred = (values - values.mean(axis=1, keepdims=True) for values in stretches)
    rows = [scipy.fft.dct(values, axis=1, norm="ortho", overwrite_x=True)[:, 1:] for values in centred]
    w = np.concatenate([np.pi * np.arange(1, values.shape[1]) / values.shape[1] for values in stretches])
    y = rows[0] if len(rows) == 1 else np.concatenate(rows, axis=1)
    if len(stretches) > 1:
        order = np.argsort(w, kind="stable")
        w, y = w[order], y[:, order]
    bins = np.floor(np.log(w / w[0]) / np.log(BIN_RATIO) + 1e-9)
    first = np.flatnonzero(np.diff(bins, prepend=-1.0))
    count = np.diff(np.append(first, len(w))).astype(np.float64)
    parts = np.split(y, first[1:], axis=1)
    products = np.stack([part.transpose(0, 2, 1) @ part for part in parts], axis=1)
    length = interval * max(values.shape[1] for values in stretches)
    return Spectrum(np.add.reduceat(w, first) / count, count, products, interval, length)


class TermTrial(NamedTuple):
    """A sum of terms to be fitted: axis, terms, numbers of its deterministic columns from 1, and the start."""

    axis: int
    kinds: Composition
    columns: tuple[int, ...]
    parameters: Values  # (2 k,); of k terms the logarithms of the squared coefficients, then of the correlation times
    held: int | None = None  # index of a parameter that is fixed at its start


@dataclass(frozen=True)
class TermFits:
    """g sums of up to J terms, fitted together."""

    axis: Integers  # (g,)
    kinds: Integers  # (g, J); of ``noise_terms.STOCHASTIC``, -1 for none
    columns: Mask  # (g, d); which of the deterministic columns are fitted
    parameters: Values  # (g, 2 J); logarithms of the squared coefficients, then of the correlation times
    # each (g,); -2 log L with and without the determinant of the deterministic columns
    deviance: Values
    unrestricted: Values
    total: Values  # (g, b), S
    power: Values  # (g, b), its estimate by the data times ``count``
    slopes: Values  # (g, 2 J, b), of log S by each parameter
    # of the deterministic columns; zeros for those that are not fitted
    beta: Values  # (g, d)
    beta_covariance: Values  # (g, d, d)

    def rows(self, index: Integers | Mask | slice) -> TermFits:
        """Return some of the fits."""
        return TermFits(*(getattr(self, name)[index] for name in FIT_FIELDS))

    def replace(self, index: Integers | Mask, others: TermFits) -> None:
        """Replace some of the fits."""
        for name in FIT_FIELDS[3:]:
            getattr(self, name)[index] = getattr(others, name)

    def own(self, row: int = 0) -> Values:
        """Return the parameters of one fit, as in ``TermTrial.parameters``."""
        k, terms = int(np.sum(self.kinds[row] >= 0)), self.kinds.shape[1]
        return self.parameters[row, [*range(k), *range(terms, terms + k)]]

    def information(self, count: Values) -> Values:
        """Return the Fisher information of the parameters: (g, 2 J, 2 J) array; 1 on the diagonal for absent ones."""
        information = 0.5 * (self.slopes * count) @ self.slopes.transpose(0, 2, 1)
        np.einsum("gpp->gp", information)[...] += np.where(active(self.kinds), 1e-12, 1.0)
        return information

    def covariance(self, count: Values) -> Values:
        """Return the covariance of the parameters: (g, 2 J, 2 J) array."""
        return np.asarray(np.linalg.inv(self.information(count)), np.float64)


FIT_FIELDS = tuple(f.name for f in fields(TermFits))
Work = Generator[list[TermTrial], TermFits, Result]  # yields trials, receives their fits, returns a result


def active(kinds: Integers) -> Mask:
    """Return which parameters (g, J) terms have: (g, 2 J) array."""
    return np.concatenate([kinds >= 0, kinds == MARKOV], axis=1)


def at_once(works: Sequence[Work[Result]]) -> Work[list[Result]]:
    """Join the trials of several generators and yield them; return the results of the generators."""
    results: dict[int, Result] = {}
    replies: dict[int, TermFits | None] = dict.fromkeys(range(len(works)))
    while True:
        wanted: dict[int, list[TermTrial]] = {}
        for i, reply in replies.items():
            try:
                wanted[i] = works[i].send(reply)  # type: ignore[arg-type]
            except StopIteration as end:
                results[i] = end.value
        if not wanted:
            return [results[i] for i in range(len(works))]
        fits = yield [trial for trials in wanted.values() for trial in trials]
        ends = accumulate(len(trials) for trials in wanted.values())
        replies = {i: fits.rows(slice(end - len(wanted[i]), end)) for i, end in zip(wanted, ends, strict=True)}


def solved(spectrum: Spectrum, work: Work[Result]) -> Result:
    """Maximise the likelihood of all trials that a generator yields; return its result."""
    fits: TermFits | None = None
    while True:
        try:
            fits = maximised(spectrum, work.send(fits))  # type: ignore[arg-type]
        except StopIteration as end:
            result: Result = end.value
            return result


def evaluate(spectrum: Spectrum, trials: Sequence[TermTrial]) -> TermFits:
    """Return likelihood and derivatives at the parameters of trials."""
    return _evaluated(spectrum, *_packed(spectrum, trials)[:4])


def _packed(spectrum: Spectrum, trials: Sequence[TermTrial]) -> tuple[Integers, Integers, Mask, Values, Mask]:
    """Return axis, kinds, columns and parameters of trials, as in ``TermFits``, and which parameters are free."""
    g, terms = len(trials), max(len(trial.kinds) for trial in trials)
    kinds, parameters = np.full((g, terms), -1), np.zeros((g, 2 * terms))
    columns, held = np.zeros((g, spectrum.products.shape[2]), bool), np.zeros((g, 2 * terms), bool)
    for i, trial in enumerate(trials):
        k = len(trial.kinds)
        kinds[i, :k] = trial.kinds
        parameters[i, :k], parameters[i, terms : terms + k] = trial.parameters[:k], trial.parameters[k:]
        columns[i, list(trial.columns)] = True
        if trial.held is not None:
            held[i, trial.held if trial.held < k else terms + trial.held - k] = True
    return np.array([trial.axis for trial in trials]), kinds, columns[:, 1:], parameters, active(kinds) & ~held


def _evaluated(spectrum: Spectrum, axis: Integers, kinds: Integers, columns: Mask, parameters: Values) -> TermFits:
    terms = kinds.shape[1]
    theta, log_time = parameters[:, :terms], parameters[:, terms:]
    shapes = spectrum.shapes[kinds]
    slopes = np.zeros((len(kinds), 2 * terms, len(spectrum.omega)))
    markov = kinds == MARKOV
    size = np.exp(theta)[:, :, None]
    if markov.any():
        shapes[markov], by_time = markov_shape(spectrum.omega, spectrum.interval, log_time[markov])
        slopes[:, terms:][markov] = size[markov] * by_time
    shapes *= size
    total = shapes.sum(axis=1)
    slopes[:, :terms] = shapes
    slopes /= total[:, None, :]
    weight, (g, d) = 1.0 / total, columns.shape
    power, determinant = spectrum.products[axis, :, 0, 0], np.zeros(g)
    beta, covariance, restricted = np.zeros((g, d)), np.zeros((g, d, d)), power
    used = np.flatnonzero(columns.any(axis=0))
    if used.size:
        index, n = np.append(0, used + 1), len(used)
        products = spectrum.products[:, :, index[:, None], index].reshape(*spectrum.products.shape[:2], -1)[axis]
        sums = (weight[:, None, :] @ products).reshape(g, n + 1, n + 1)
        inner, unused = sums[:, 1:, 1:], ~columns[:, used]
        if unused.any():  # 1 on the diagonal for a column that is not fitted
            absent = unused[:, :, None] * np.eye(n)
            inner = np.where(unused[:, :, None] | unused[:, None, :], absent, inner)
        inverse, determinant = np.linalg.inv(inner), np.linalg.slogdet(inner)[1]
        if unused.any():
            inverse -= absent
        signed = np.ones((g, n + 1))
        signed[:, 1:] = -(inverse @ sums[:, 1:, :1])[:, :, 0]
        outer = signed[:, :, None] * signed[:, None, :]
        power = np.maximum(products @ outer.reshape(g, -1, 1), 0.0)[:, :, 0]
        outer[:, 1:, 1:] += inverse
        restricted = (products @ outer.reshape(g, -1, 1))[:, :, 0]
        beta[:, used], covariance[:, used[:, None], used] = -signed[:, 1:], inverse
    unrestricted = np.log(total) @ spectrum.count + (power * weight).sum(axis=1)
    return TermFits(
        axis, kinds, columns, parameters, unrestricted + determinant, unrestricted, total, restricted, slopes, beta,
        covariance,
    )  # fmt: skip


def maximised(spectrum: Spectrum, trials: Sequence[TermTrial]) -> TermFits:
    """Maximise the restricted likelihood of trials."""
    axis, kinds, columns, start, free = _packed(spectrum, trials)
    low = np.log(spectrum.interval)
    high = max(np.log(LONGEST_TIME * spectrum.length), low + 1e-6)
    bounds = np.repeat([[LOG_LEAST, low], [np.inf, high]], kinds.shape[1], axis=1)
    now = best = _evaluated(spectrum, axis, kinds, columns, start)
    damping, running = np.full(len(trials), 1e-2), np.arange(len(trials))  # of the fits in ``now``
    for _ in range(ITERATIONS):
        gradient = 0.5 * (now.slopes @ (spectrum.count - now.power / now.total)[:, :, None])[:, :, 0]
        at_bound = np.where(gradient > 0.0, now.parameters <= bounds[0], now.parameters >= bounds[1])
        moving = free & ~at_bound
        information = 0.5 * (now.slopes * spectrum.count) @ now.slopes.transpose(0, 2, 1)
        information *= moving[:, :, None] & moving[:, None, :]
        diagonal = np.einsum("gpp->gp", information)  # a view
        diagonal += np.where(moving, damping[:, None] * diagonal + 1e-9, 1.0)
        gradient = np.where(moving, gradient, 0.0)
        step = -np.linalg.solve(information, gradient[:, :, None])[:, :, 0]
        step = np.minimum(np.maximum(step, STEP_LIMITS[0]), STEP_LIMITS[1])
        inside = np.minimum(np.maximum(now.parameters + step, bounds[0]), bounds[1])
        stepped = np.where(moving, inside, now.parameters)
        new = _evaluated(spectrum, now.axis, now.kinds, now.columns, stepped)
        gain = now.deviance - new.deviance
        better = gain > 0
        if better.all():
            now = new
        else:
            now.replace(better, new.rows(better))
        damping *= np.where(better, 0.2, 8.0)
        predicted = -np.sum(gradient * step, axis=1)
        slow = better & (gain < PRECISION) & (damping < 1.0)
        unfinished = (predicted > PRECISION) & ~slow & (damping < LARGEST_DAMPING)
        if not unfinished.all():
            best.replace(running[~unfinished], now.rows(~unfinished))
            running, now = running[unfinished], now.rows(unfinished)
            free, damping = free[unfinished], damping[unfinished]
        if not running.size:
            break
    best.replace(running, now)
    return best
