"""Which terms make up the noise of a sensor at rest, and how large each is: for every axis by itself.

Compositions of the terms of ``noise_terms`` are compared by

    BIC = -2 log L + p ln(n),    probability proportional to exp(-BIC / 2)

with p parameters and n coefficients (``noise_likelihood``). From white noise alone the search adds, drops and swaps
one term at a time until no step lowers the criterion. What may be added is screened by its score, the derivative of
the likelihood at zero, so that a recording of white noise costs one fit. A ramp, sinusoids and a dependence on
temperature are deterministic columns beside the noise. Sinusoids are found as lines of a Hann-windowed periodogram.

Intervals are those of the profile likelihood (of a ramp and a sinusoid: of generalised least squares). Of a term that
is not in the composition the upper limit is the coefficient at which the profile loses 1.645^2, one-sided 95 %.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from pipeline.estimation.noise_likelihood import LONGEST_TIME, Fits, Spectrum, active, evaluate, maximised
from pipeline.estimation.noise_terms import MARKOV, SINGLE, WHITE, markov_shape

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    Values = NDArray[np.float64]

Composition = tuple[int, ...]  # kinds of the stochastic terms, in rising order
MOST_MARKOV = 2  # processes of different correlation times; a third is not told apart by less than some 10^6 samples
TIMES = 10  # correlation times whose score is looked at, in equal steps of their logarithm
STARTS = 2  # of them that are fitted
PROMISING = 0.25  # of the penalty of a term: a score that predicts less of it is not followed
SLIGHT = 2.0  # of the gain of one parameter: its penalty is ln(n), 4 and more
QUANTILE, ONE_SIDED = 1.959964, 1.644854  # of the standard normal distribution: 95 % from two sides, from one
NEAREST = 12  # compositions that are published, best first
FARTHEST = 14.0  # change of the logarithm of a squared coefficient: a factor of 1000 in the coefficient
PROFILE_STEPS, PROFILE_PRECISE, LIMIT_PRECISE = 9, 0.02, 0.02  # of the root of the loss: 2 % of half an interval


@dataclass(frozen=True)
class Candidate:
    """One fitted composition: stochastic terms and deterministic columns (by number)."""

    kinds: Composition
    columns: tuple[int, ...]
    parameters: Values  # as ``Fits.parameters``
    bic: float
    deviance: float


def _packed(kinds: Sequence[Composition]) -> NDArray[np.int64]:
    """Return compositions as an array, filled with -1."""
    out = np.full((len(kinds), max(len(k) for k in kinds)), -1)
    for row, k in zip(out, kinds, strict=True):
        row[: len(k)] = k
    return out


def count_of(kinds: Composition, columns: Iterable[int]) -> int:
    """Return the number of parameters."""
    return len(kinds) + kinds.count(MARKOV) + len(tuple(columns))


class Search:
    """The compositions of one axis that have been fitted."""

    def __init__(self, spectrum: Spectrum) -> None:
        self.spectrum = spectrum
        self.penalty = float(np.log(spectrum.size))
        self.found: dict[tuple[Composition, tuple[int, ...]], Candidate] = {}

    def run(self, columns: tuple[int, ...], start: Candidate | None = None) -> Candidate:
        """Return the best composition beside these deterministic columns.

        ``start``: a composition beside other columns, with which the search begins where it is better than white noise.
        """
        spectrum = self.spectrum.with_columns(columns)
        power = spectrum.products[:, 0, 0].sum() / spectrum.size
        white = np.array([np.log(max(power * spectrum.interval, 1e-300)), 0.0])
        self.fit(spectrum, [((WHITE,), white), *([(start.kinds, start.parameters)] if start else [])], columns)
        best = self._best(columns)
        while True:
            tries = self._added(spectrum, best)
            if len(best.kinds) > 1:
                dropped = [_without(best, j) for j in range(len(best.kinds))]
                self.fit(spectrum, dropped, columns)
                lower = [self.found[kinds, columns] for kinds, _ in dropped]
                tries += [new for c in lower for new in self._added(spectrum, c)]
            self.fit(spectrum, tries, columns)
            new = self._best(columns)
            if new is best:
                return best
            best = new

    def _best(self, columns: tuple[int, ...]) -> Candidate:
        """Return the best composition so far beside these columns."""
        return min((c for c in self.found.values() if c.columns == columns), key=lambda c: c.bic)

    def fit(self, spectrum: Spectrum, tries: Sequence[tuple[Composition, Values]], columns: tuple[int, ...]) -> None:
        """Fit compositions from their starts, in one batch; each is kept at its best."""
        tries = [t for t in tries if (t[0], columns) not in self.found]
        if not tries:
            return
        kinds = _packed([k for k, _ in tries])
        terms = kinds.shape[1]
        start = np.zeros((len(tries), 2 * terms))
        for row, (k, p) in zip(start, tries, strict=True):
            row[: len(k)], row[terms : terms + len(k)] = p[: len(k)], p[len(k) :]
        fits = maximised(spectrum, kinds, start)
        out: dict[Composition, Candidate] = {}
        for g, (k, _) in enumerate(tries):
            parameters = np.concatenate([fits.parameters[g, : len(k)], fits.parameters[g, terms : terms + len(k)]])
            bic = float(fits.unrestricted[g]) + count_of(k, columns) * self.penalty
            if k not in out or bic < out[k].bic:
                out[k] = Candidate(k, columns, parameters, bic, float(fits.deviance[g]))
        self.found |= {(c.kinds, columns): c for c in out.values()}

    def _added(self, spectrum: Spectrum, candidate: Candidate) -> list[tuple[Composition, Values]]:
        """Return the compositions of one term more whose score promises a lower criterion, and their starts."""
        fits = fitted(spectrum, candidate)
        absent = [k for k in SINGLE if k not in candidate.kinds]
        longest = np.log(LONGEST_TIME * spectrum.length / 1.5)
        times = np.linspace(np.log(2.0 * spectrum.interval), longest, TIMES)
        markov = candidate.kinds.count(MARKOV) < MOST_MARKOV and longest > np.log(4.0 * spectrum.interval)
        shapes = [spectrum.shapes[absent]]
        if markov:
            shapes.append(markov_shape(spectrum.omega, spectrum.interval, times)[0])
        ratio = np.concatenate(shapes) / fits.total[0]
        gain, size, _ = _scores(spectrum, fits, ratio)
        out = [
            with_term(candidate, kind, size[i], 0.0)
            for i, kind in enumerate(absent)
            if gain[i] > PROMISING * self.penalty
        ]
        if markov:
            of_times = gain[len(absent) :]
            order = np.argsort(of_times)[::-1]
            chosen: list[int] = []
            for i in order:
                if of_times[i] > PROMISING * self.penalty and all(abs(i - c) > 1 for c in chosen):
                    chosen.append(int(i))
            out += [with_term(candidate, MARKOV, size[len(absent) + i], times[i]) for i in chosen[:STARTS]]
        return out


def _without(candidate: Candidate, index: int) -> tuple[Composition, Values]:
    """Return a composition without one term, and its start."""
    kinds = candidate.kinds[:index] + candidate.kinds[index + 1 :]
    keep = [j for j in range(len(candidate.kinds)) if j != index]
    return kinds, candidate.parameters[keep + [len(candidate.kinds) + j for j in keep]]


def with_term(candidate: Candidate, kind: int, size: float, log_time: float) -> tuple[Composition, Values]:
    """Return a composition with one term more, and its start."""
    kinds = candidate.kinds
    at = sum(k <= kind for k in kinds)
    p, n = candidate.parameters, len(kinds)
    start = np.concatenate([p[:at], [np.log(size)], p[at:n], p[n : n + at], [log_time], p[n + at :]])
    return (*kinds[:at], kind, *kinds[at:]), start


def fitted(spectrum: Spectrum, candidate: Candidate) -> Fits:
    """Return the fit of a candidate."""
    return evaluate(spectrum, _packed([candidate.kinds]), candidate.parameters[None])


def _scores(spectrum: Spectrum, fits: Fits, ratio: Values) -> tuple[Values, Values, Values]:
    """Return the gain of -2 log L that terms promise, their squared coefficients by one step, and the spread of these.

    ``ratio``: (l, b), spectra of the terms over that of the fit.
    """
    u = 0.5 * ratio @ (fits.power[0] / fits.total[0] - spectrum.count)
    cross = 0.5 * (ratio * spectrum.count) @ fits.slopes[0].T
    own = 0.5 * (ratio**2) @ spectrum.count
    free = active(fits.kinds)[0]
    inner = fits.information(spectrum.count)[0][np.ix_(free, free)]
    cross = cross[:, free]
    left = np.maximum(own - np.sum(cross @ np.linalg.inv(inner) * cross, axis=1), 1e-9 * own)
    gain = np.where(u > 0, u**2 / left, 0.0)
    spread = 1.0 / np.sqrt(left)
    return gain, np.maximum(u / left, 0.01 * spread), spread


def intervals(spectrum: Spectrum, candidate: Candidate) -> Values:
    """Return the 95 % intervals of the parameters: (2, 2 J) array, NaN where there is no parameter."""
    kinds = _packed([candidate.kinds])
    index = np.repeat(np.flatnonzero(active(kinds)[0]), 2)
    sign = np.tile([-1.0, 1.0], len(index) // 2)
    spread = np.sqrt(np.diag(fitted(spectrum, candidate).covariance(spectrum.count)[0]))
    step = sign * QUANTILE * spread[index]
    starts = np.repeat(candidate.parameters[None], len(index), axis=0)
    offset = _profile(
        spectrum, np.repeat(kinds, len(index), axis=0), starts, index=index, step=step, level=(candidate, QUANTILE)
    )
    out = np.full((2, 2 * kinds.shape[1]), np.nan)
    out[(sign > 0).astype(int), index] = candidate.parameters[index] + offset
    return out


def upper_limits(spectrum: Spectrum, candidate: Candidate) -> dict[int, float]:
    """Return the 95 % upper limits of the squared coefficients of the single terms that are absent."""
    absent = [k for k in SINGLE if k not in candidate.kinds]
    if not absent:
        return {}
    fits = fitted(spectrum, candidate)
    gain, size, spread = _scores(spectrum, fits, spectrum.shapes[absent] / fits.total[0])
    likely = np.where(gain > 0, size, 0.0)
    # from a coefficient that is certainly inside, upwards
    tries = [with_term(candidate, k, 1e-3 * s, 0.0) for k, s in zip(absent, spread, strict=True)]
    kinds, starts = _packed([k for k, _ in tries]), np.array([start for _, start in tries])
    index = np.array([k.index(kind) for (k, _), kind in zip(tries, absent, strict=True)])
    step = np.log((likely + ONE_SIDED * spread) / (1e-3 * spread))
    offset = _profile(spectrum, kinds, starts, index=index, step=step, level=(candidate, ONE_SIDED), one_sided=True)
    limit = np.exp(starts[np.arange(len(index)), index] + offset)
    return dict(zip(absent, limit.tolist(), strict=True))


def _profile(
    spectrum: Spectrum,
    kinds: NDArray[np.int64],
    starts: Values,
    *,
    index: NDArray[np.int64],
    step: Values,
    level: tuple[Candidate, float],
    one_sided: bool = False,
) -> Values:
    """Return by how much one parameter of each fit departs from its start where -2 log L is lost by a given square.

    ``index``: (g,), the parameter; ``step``: (g,), a first guess; ``level``: the candidate that the loss is against,
    and the root of the loss.
    """
    candidate, quantile = level
    rows, sign = np.arange(len(index)), np.sign(step)
    held = np.zeros(starts.shape, bool)
    held[rows, index] = True
    size = np.clip(np.abs(step), 1e-6, FARTHEST)
    inner, outer = np.zeros(len(index)), np.full(len(index), np.inf)
    best, warm = np.full(len(index), candidate.deviance), starts.copy()
    for _ in range(PROFILE_STEPS):
        warm[rows, index] = starts[rows, index] + sign * size
        fits = maximised(spectrum, kinds, warm, held)
        best = np.minimum(best, fits.deviance) if one_sided else best
        excess = np.sqrt(np.maximum(fits.deviance - best, 1e-12)) / quantile
        done = (np.abs(excess - 1.0) < (LIMIT_PRECISE if one_sided else PROFILE_PRECISE)) | (
            (size >= FARTHEST) & (excess < 1.0)
        )
        if done.all():
            break
        inner, outer = np.where(excess <= 1.0, size, inner), np.where(excess > 1.0, size, outer)
        secant = np.clip(
            size + (np.log(1.0 / excess) if one_sided else size * (1.0 / excess - 1.0)), 0.3 * size, 3.0 * size
        )
        bounded = np.isfinite(outer)
        between = 0.5 * (inner + np.where(bounded, outer, inner))
        beyond = np.where(bounded, between, np.minimum(2.0 * size, size + 2.0))
        size = np.where(done, size, np.where((secant > inner) & (secant < outer), secant, beyond))
        size = np.minimum(size, FARTHEST)
        warm = fits.parameters.copy()
    return np.asarray(sign * size)


def ranked(search: Search) -> list[tuple[Candidate, float]]:
    """Return the compositions by their criterion, best first, each with its probability."""
    best = sorted(search.found.values(), key=lambda c: c.bic)
    weight = np.exp(-0.5 * (np.array([c.bic for c in best]) - best[0].bic))
    return list(zip(best[:NEAREST], (weight / weight.sum())[:NEAREST].tolist(), strict=True))


def best_of(search: Search, required: tuple[int, ...], optional: Sequence[int]) -> Candidate:
    """Return the best composition over all choices of the optional deterministic columns.

    Beside white noise alone, a column is left out where it gains less than ``SLIGHT`` of -2 log L.
    """
    best = search.run(required)
    if optional and len(best.kinds) == 1:
        fits = fitted(search.spectrum.with_columns((*required, *optional)), best)
        last = range(len(required), len(required) + len(optional))
        optional = [c for c, j in zip(optional, last, strict=True)
                    if fits.beta[0, j] ** 2 > SLIGHT * fits.beta_covariance[0, j, j]]  # fmt: skip
    for size in range(1, len(optional) + 1):
        for chosen in combinations(optional, size):
            best = min(best, search.run((*required, *chosen), best), key=lambda c: c.bic)
    return best
