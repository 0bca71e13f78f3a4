"""Compute the likelihood of a sum of noise terms (``noise_terms``) by the cosine transform of evenly sampled readings.

The orthonormal cosine transform (DCT-II) of n samples diagonalises the covariance of white noise plus a random walk of
unknown start exactly. For the other terms it does so approximately, with errors from the ends of the recording. With
the coefficients y_k, k > 0,

    y_k = sum_d beta_d z_dk + sqrt(S(w_k)) e_k,   w_k = pi k / n,   S = sum_j exp(theta_j) s_j(w)
    -2 log L = sum_k (log S_k + (y_k - z_k beta)^2 / S_k) + log det(sum_k z_k z_k^T / S_k)

where s_j is the spectrum of term j, exp(theta_j) its squared coefficient, e unit white noise, and z the transforms of
the deterministic columns (ramp, sinusoids, temperature). beta follows by generalised least squares, and the last term
makes the likelihood a restricted one. k = 0, the mean, is not used. Sums over the coefficients are computed once, in
bins whose edges have the ratio ``BIN_RATIO``.

A *composition* is a set of terms. Fits of all axes, compositions and columns run together, by Fisher scoring with the
damping of Levenberg and Marquardt: a search is a generator that yields the ``Trial``s it needs next and receives their
``Fits``; ``at_once`` joins the trials of several searches.

Sources: Strang, SIAM Review 41, 1999 (the transform); Whittle 1953; Patterson & Thompson, Biometrika 58, 1971.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np
import scipy

from pipeline.estimation.noise_terms import MARKOV, fixed_shapes, markov_shape

if TYPE_CHECKING:
    from collections.abc import Generator, Sequence

    from pipeline.records import Integers, Mask, Values

BIN_RATIO = 1.05  # of the edges of a bin: the spectrum of a random walk changes by a tenth, its mean by 0.2 %
LONGEST_TIME = 0.5  # correlation time, in lengths of the recording, above which a process is a random walk
STEP_LIMITS = (-4.0, 1.5)  # largest changes of a logarithm in one iteration; a term that is not there falls fast
ITERATIONS, PRECISION = 40, 1e-2  # of -2 log L, promised or gained by the last step; 3.84 is 95 %
LARGEST_DAMPING = 1e4
LOG_LEAST = -690.0  # of a squared coefficient: above the smallest double

Composition = tuple[int, ...]  # kinds of the stochastic terms, in rising order


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
        """Spectra of the terms without a correlation time, and zeros for the others and for none: (6, b) array."""
        return np.pad(fixed_shapes(self.omega, self.interval), ((0, 2), (0, 0)))

    @property
    def size(self) -> float:
        """Number of coefficients of an axis."""
        return float(self.count.sum())


def spectrum_of(stretches: Sequence[Values], interval: float) -> Spectrum:
    """Return the spectrum of stretches of samples: (a, n, c) arrays, readings first, then deterministic columns."""
    rows = [
        scipy.fft.dct(values - values.mean(axis=1, keepdims=True), axis=1, norm="ortho", overwrite_x=True)[:, 1:]
        for values in stretches
    ]
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


class Trial(NamedTuple):
    """A sum of terms to be fitted: axis, terms, numbers of its deterministic columns from 1, and the start."""

    axis: int
    kinds: Composition
    columns: tuple[int, ...]
    parameters: Values  # (2 k,); of k terms the logarithms of the squared coefficients, then of the correlation times
    held: int | None = None  # parameter that keeps its start


@dataclass(frozen=True)
class Fits:
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
    # (g, d) and (g, d, d); of the deterministic columns, zeros of those that are not fitted
    beta: Values
    beta_covariance: Values

    def rows(self, index: Integers | Mask | slice) -> Fits:
        """Return some of the fits."""
        return Fits(*(getattr(self, name)[index] for name in NAMES))

    def replace(self, index: Integers | Mask, others: Fits) -> None:
        """Put other fits in the place of some."""
        for name in NAMES[3:]:
            getattr(self, name)[index] = getattr(others, name)

    def own(self, row: int = 0) -> Values:
        """Return the parameters of one fit as of ``Trial.parameters``."""
        k, terms = int(np.sum(self.kinds[row] >= 0)), self.kinds.shape[1]
        return self.parameters[row, [*range(k), *range(terms, terms + k)]]

    def information(self, count: Values) -> Values:
        """Return the Fisher information of the parameters: (g, 2 J, 2 J) array; 1 on the diagonal for absent ones."""
        found = 0.5 * (self.slopes * count) @ self.slopes.transpose(0, 2, 1)
        absent = ~active(self.kinds)
        found[:, range(found.shape[1]), range(found.shape[1])] += np.where(absent, 1.0, 1e-12)
        return found

    def covariance(self, count: Values) -> Values:
        """Return the covariance of the parameters: (g, 2 J, 2 J) array."""
        return np.asarray(np.linalg.inv(self.information(count)), np.float64)


NAMES = tuple(f.name for f in fields(Fits))
Result = TypeVar("Result")
if TYPE_CHECKING:
    Reply = tuple[Fits, int]  # fits, and the row of the first of one's own
    Work = Generator[list[Trial], Reply, Result]  # yields trials, receives their fits, returns a result


def active(kinds: Integers) -> Mask:
    """Return which parameters (g, J) terms have: (g, 2 J) array."""
    return np.concatenate([kinds >= 0, kinds == MARKOV], axis=1)


def at_once(works: Sequence[Work[Result]]) -> Work[list[Result]]:
    """Join the trials of several generators and yield them; return the results of the generators."""
    results: dict[int, Result] = {}
    replies: dict[int, Reply | None] = dict.fromkeys(range(len(works)))
    while True:
        asked: dict[int, list[Trial]] = {}
        for i, reply in replies.items():
            try:
                asked[i] = works[i].send(reply)  # type: ignore[arg-type]
            except StopIteration as end:
                results[i] = end.value
        if not asked:
            return [results[i] for i in range(len(works))]
        fits, at = yield [trial for trials in asked.values() for trial in trials]
        replies = {}
        for i, trials in asked.items():
            replies[i] = fits, at
            at += len(trials)


def solved(spectrum: Spectrum, work: Work[Result]) -> Result:
    """Maximise the likelihood of all trials that a generator yields; return its result."""
    reply: Reply | None = None
    while True:
        try:
            reply = maximised(spectrum, work.send(reply)), 0  # type: ignore[arg-type]
        except StopIteration as end:
            found: Result = end.value
            return found


def evaluate(spectrum: Spectrum, trials: Sequence[Trial]) -> Fits:
    """Return likelihood and derivatives at the parameters of trials."""
    axis, kinds, columns, parameters, _ = _packed(spectrum, trials)
    return _evaluated(spectrum, axis, kinds, columns, parameters)


def _packed(spectrum: Spectrum, trials: Sequence[Trial]) -> tuple[Integers, Integers, Mask, Values, Mask]:
    """Return axis, kinds, columns and parameters of trials as of ``Fits``, and which parameters are free."""
    g, terms = len(trials), max(len(trial.kinds) for trial in trials)
    kinds, parameters = np.full((g, terms), -1), np.zeros((g, 2 * terms))
    columns = np.zeros((g, spectrum.products.shape[2]), bool)
    for i, trial in enumerate(trials):
        k = len(trial.kinds)
        kinds[i, :k] = trial.kinds
        parameters[i, :k], parameters[i, terms : terms + k] = trial.parameters[:k], trial.parameters[k:]
        columns[i, list(trial.columns)] = True
    free = active(kinds)
    for i, trial in enumerate(trials):
        if trial.held is not None:
            k = len(trial.kinds)
            free[i, trial.held if trial.held < k else terms + trial.held - k] = False
    return np.array([trial.axis for trial in trials]), kinds, columns[:, 1:], parameters, free


def _evaluated(
    spectrum: Spectrum,
    axis: Integers,
    kinds: Integers,
    columns: Mask,
    parameters: Values,
) -> Fits:
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
        gone = ~columns[:, used]
        absent = gone[:, :, None] * np.eye(n)
        inner = np.where(gone[:, :, None] | gone[:, None, :], absent, sums[:, 1:, 1:])
        inverse, determinant = np.linalg.inv(inner) - absent, np.linalg.slogdet(inner)[1]
        signed = np.concatenate([np.ones((g, 1)), -np.einsum("gij,gj->gi", inverse, sums[:, 1:, 0])], axis=1)
        outer = signed[:, :, None] * signed[:, None, :]
        power = np.maximum(products @ outer.reshape(g, -1, 1), 0.0)[:, :, 0]
        outer[:, 1:, 1:] += inverse
        restricted = (products @ outer.reshape(g, -1, 1))[:, :, 0]
        beta[:, used], covariance[:, used[:, None], used] = -signed[:, 1:], inverse
    unrestricted = np.log(total) @ spectrum.count + np.sum(power * weight, axis=1)
    return Fits(
        axis, kinds, columns, parameters, unrestricted + determinant, unrestricted, total, restricted, slopes, beta,
        covariance,
    )  # fmt: skip


def maximised(spectrum: Spectrum, trials: Sequence[Trial]) -> Fits:
    """Maximise the restricted likelihood of trials."""
    axis, kinds, columns, start, free = _packed(spectrum, trials)
    terms = kinds.shape[1]
    low = np.log(spectrum.interval)
    high = max(np.log(LONGEST_TIME * spectrum.length), low + 1e-6)
    bounds = np.repeat([[LOG_LEAST, low], [np.inf, high]], terms, axis=1)
    now = best = _evaluated(spectrum, axis, kinds, columns, start)
    damping, running = np.full(len(kinds), 1e-2), np.arange(len(kinds))  # those of ``now``
    diagonal = np.arange(2 * terms)
    for _ in range(ITERATIONS):
        gradient = 0.5 * np.sum(now.slopes * (spectrum.count - now.power / now.total)[:, None, :], axis=2)
        pushed = np.where(gradient > 0.0, now.parameters <= bounds[0], now.parameters >= bounds[1])
        here = free & ~pushed  # a parameter that is pushed against its bound stays there
        information = 0.5 * (now.slopes * spectrum.count) @ now.slopes.transpose(0, 2, 1)
        information *= here[:, :, None] & here[:, None, :]
        own = information[:, diagonal, diagonal]
        information[:, diagonal, diagonal] += np.where(here, damping[:, None] * own + 1e-9, 1.0)
        gradient = np.where(here, gradient, 0.0)
        step = np.clip(-np.linalg.solve(information, gradient[:, :, None])[:, :, 0], *STEP_LIMITS)
        tried = np.where(here, np.clip(now.parameters + step, *bounds), now.parameters)
        new = _evaluated(spectrum, now.axis, now.kinds, now.columns, tried)
        gain = now.deviance - new.deviance
        better = gain > 0
        if better.all():
            now = new
        else:
            now.replace(better, new.rows(better))
        damping *= np.where(better, 0.2, 8.0)
        promised = -np.sum(gradient * step, axis=1)
        slow = better & (gain < PRECISION) & (damping < 1.0)
        going = (promised > PRECISION) & ~slow & (damping < LARGEST_DAMPING)
        if not going.all():
            best.replace(running[~going], now.rows(~going))
            running, now, free, damping = running[going], now.rows(going), free[going], damping[going]
            if not running.size:
                return best
    best.replace(running, now)
    return best
