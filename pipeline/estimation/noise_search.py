"""Select the terms of the noise of an axis at rest, and estimate their sizes.

Compositions (sets of the terms of ``noise_terms``) are compared by

    BIC = -2 log L + p ln(n),    probability proportional to exp(-BIC / 2)

with p parameters and n coefficients (``noise_likelihood``). The search begins with white noise and adds, drops or swaps
one term at a time until no step lowers the BIC. A term whose gain is certain is not dropped. Terms are tried only if
their score, the derivative of the likelihood at zero, predicts a gain, so that a recording of white noise needs one
fit. A ramp, sinusoids and a dependence on temperature are deterministic columns (``noise_regression``).

Intervals are those of the profile likelihood (of a ramp and a sinusoid: of generalised least squares). The upper limit
of a term that is not in the composition is the coefficient at which -2 log L of the profile rises by 1.645^2: one-sided
95 %.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from pipeline.estimation.noise_likelihood import LONGEST_TIME, Composition, Fits, Trial, active, at_once, evaluate
from pipeline.estimation.noise_terms import MARKOV, SINGLE, WHITE, markov_shape

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from pipeline.estimation.noise_likelihood import Spectrum, Work
    from pipeline.records import Values

MOST_MARKOV = 2  # processes of different correlation times; to distinguish a third takes some 10^6 samples
TIMES_TRIED = 10  # correlation times whose score is computed, in equal steps of their logarithm
TIMES_FITTED = 2  # of them that are fitted
LEAST_PROMISE = 0.25  # of the penalty of a term: a score that predicts less of it is not followed
CERTAIN_GAIN = 10.0  # penalties of a term: what a term gains at least, by its spread, so that it is certainly there
SLIGHT_GAIN = 2.0  # of the gain of one parameter: its penalty is ln(n), 4 and more
QUANTILE, ONE_SIDED = 1.959964, 1.644854  # of the standard normal distribution: 95 % from two sides, from one
MOST_PUBLISHED = 12  # compositions that are published, best first
LARGEST_CHANGE = 14.0  # change of the logarithm of a squared coefficient: a factor of 1000 in the coefficient
PROFILE_STEPS, PROFILE_PRECISE = 9, 0.02  # of the root of the loss: 2 % of half an interval


@dataclass(frozen=True)
class Candidate:
    """One fitted composition: stochastic terms and deterministic columns (by number)."""

    kinds: Composition
    columns: tuple[int, ...]
    parameters: Values  # as ``Trial.parameters``
    bic: float
    fit: Fits  # of one row


def count_of(kinds: Composition, columns: Iterable[int]) -> int:
    """Return the number of parameters."""
    return len(kinds) + kinds.count(MARKOV) + len(tuple(columns))


class Search:
    """The fitted compositions of one axis."""

    def __init__(self, spectrum: Spectrum, axis: int) -> None:
        self.spectrum, self.axis = spectrum, axis
        self.penalty = float(np.log(spectrum.size))
        self.found: dict[tuple[Composition, tuple[int, ...]], Candidate] = {}

    def run(self, columns: tuple[int, ...], start: Candidate | None = None) -> Work[Candidate]:
        """Return the best composition with these deterministic columns.

        ``start``: a composition with other columns, from which the search begins if it is better than white noise.
        """
        power = self.spectrum.products[self.axis, :, 0, 0].sum() / self.spectrum.size
        white = np.array([np.log(max(power * self.spectrum.interval, 1e-300)), 0.0])
        starts = [((WHITE,), white), *([(start.kinds, start.parameters)] if start else [])]
        yield from self.fit(starts, columns)
        best = self._best(columns)
        while True:
            tries = self._added(best)
            if len(best.kinds) > 1:
                dropped = [_without(best, j) for j in self._dispensable(best)]
                yield from self.fit(dropped, columns)
                tries += [new for kinds, _ in dropped for new in self._added(self.found[kinds, columns])]
            yield from self.fit(tries, columns)
            new = self._best(columns)
            if new is best:
                return best
            best = new

    def _dispensable(self, candidate: Candidate) -> list[int]:
        """Return the terms without a certain gain; the gain is at least ``(coefficient^2 / spread)^2``."""
        spread = np.sqrt(np.diag(candidate.fit.covariance(self.spectrum.count)[0])[: len(candidate.kinds)])
        return np.flatnonzero(spread**-2 < CERTAIN_GAIN * self.penalty).tolist()

    def _best(self, columns: tuple[int, ...]) -> Candidate:
        """Return the best composition so far with these columns."""
        return min((c for c in self.found.values() if c.columns == columns), key=lambda c: c.bic)

    def fit(self, tries: Sequence[tuple[Composition, Values]], columns: tuple[int, ...]) -> Work[None]:
        """Fit compositions from their starts, and store the best fit of each."""
        trials = [Trial(self.axis, k, columns, p) for k, p in tries if (k, columns) not in self.found]
        if not trials:
            return
        fits, first = yield trials
        out: dict[Composition, Candidate] = {}
        for g, trial in enumerate(trials, first):
            k = trial.kinds
            bic = float(fits.unrestricted[g]) + count_of(k, columns) * self.penalty
            if k not in out or bic < out[k].bic:
                out[k] = Candidate(k, columns, fits.own(g), bic, fits.rows(slice(g, g + 1)))
        self.found |= {(c.kinds, columns): c for c in out.values()}

    def _added(self, candidate: Candidate) -> list[tuple[Composition, Values]]:
        """Return compositions with one additional term whose score predicts a lower criterion, and their starts."""
        spectrum = self.spectrum
        absent = [k for k in SINGLE if k not in candidate.kinds]
        longest = np.log(LONGEST_TIME * spectrum.length / 1.5)
        times = np.linspace(np.log(2.0 * spectrum.interval), longest, TIMES_TRIED)
        markov = candidate.kinds.count(MARKOV) < MOST_MARKOV and longest > np.log(4.0 * spectrum.interval)
        shapes = [spectrum.shapes[absent]]
        if markov:
            shapes.append(markov_shape(spectrum.omega, spectrum.interval, times)[0])
        gain, size, _ = _scores(spectrum, candidate.fit, np.concatenate(shapes))
        promising = gain > LEAST_PROMISE * self.penalty
        out = [_with_term(candidate, kind, size[i], 0.0) for i, kind in enumerate(absent) if promising[i]]
        if markov:
            chosen: list[int] = []
            for i in np.argsort(gain[len(absent) :])[::-1].tolist():
                if promising[len(absent) + i] and all(abs(i - c) > 1 for c in chosen):
                    chosen.append(i)
            out += [_with_term(candidate, MARKOV, size[len(absent) + i], times[i]) for i in chosen[:TIMES_FITTED]]
        return out


def _without(candidate: Candidate, index: int) -> tuple[Composition, Values]:
    """Return a composition without one term, and its start."""
    n = len(candidate.kinds)
    kinds = candidate.kinds[:index] + candidate.kinds[index + 1 :]
    return kinds, np.delete(candidate.parameters, [index, n + index])


def _with_term(candidate: Candidate, kind: int, size: float, log_time: float) -> tuple[Composition, Values]:
    """Return a composition with one additional term, and its start."""
    kinds = candidate.kinds
    at = sum(k <= kind for k in kinds)
    start = np.insert(candidate.parameters, [at, len(kinds) + at], [np.log(size), log_time])
    return (*kinds[:at], kind, *kinds[at:]), start


def _scores(spectrum: Spectrum, fit: Fits, shapes: Values) -> tuple[Values, Values, Values]:
    """Return for terms the predicted gain of -2 log L, the squared coefficients after one step, and their spread.

    ``fit``: of one row. ``shapes``: (l, b), spectra of the terms.
    """
    ratio = shapes / fit.total[0]
    u = 0.5 * ratio @ (fit.power[0] / fit.total[0] - spectrum.count)
    cross = 0.5 * (ratio * spectrum.count) @ fit.slopes[0].T
    own = 0.5 * (ratio**2) @ spectrum.count
    free = active(fit.kinds)[0]
    inner = fit.information(spectrum.count)[0][np.ix_(free, free)]
    cross = cross[:, free]
    left = np.maximum(own - np.sum(cross @ np.linalg.inv(inner) * cross, axis=1), 1e-9 * own)
    gain = np.where(u > 0, u**2 / left, 0.0)
    spread = 1.0 / np.sqrt(left)
    return gain, np.maximum(u / left, 0.01 * spread), spread


def limits(spectrum: Spectrum, best: Candidate) -> Work[tuple[Values, dict[int, float]]]:
    """Return the 95 % intervals of the parameters, and the upper limits of single terms that are not selected.

    The intervals are a (2, 2 k) array, NaN where there is no parameter; the limits are for squared coefficients.
    """
    trial = Trial(int(best.fit.axis[0]), best.kinds, best.columns, best.parameters)
    spread = np.sqrt(np.diag(best.fit.covariance(spectrum.count)[0]))
    n, terms = len(best.kinds), best.fit.kinds.shape[1]
    spread = spread[[*range(n), *range(terms, terms + n)]]
    sides = [(j, sign) for j in range(2 * n) if j < n or best.kinds[j - n] == MARKOV for sign in (0, 1)]
    works = [_crossing(best, trial, j, (-1.0, 1.0)[sign] * QUANTILE * spread[j]) for j, sign in sides]
    absent = [k for k in SINGLE if k not in best.kinds]
    gain, size, spread = _scores(spectrum, best.fit, spectrum.shapes[absent])
    starts = []
    for i, kind in enumerate(absent):  # from a coefficient that is certainly inside, upwards
        kinds, start = _with_term(best, kind, 1e-3 * spread[i], 0.0)
        step = float(np.log(((size[i] if gain[i] > 0.0 else 0.0) + ONE_SIDED * spread[i]) / (1e-3 * spread[i])))
        starts.append(float(start[kinds.index(kind)]))
        more = trial._replace(kinds=kinds, parameters=start)
        works.append(_crossing(best, more, kinds.index(kind), step, one_sided=True))
    found = yield from at_once(works)
    within = np.full((2, 2 * n), np.nan)
    for (j, sign), offset in zip(sides, found, strict=False):
        within[sign, j] = best.parameters[j] + offset
    upper = np.exp(np.array(starts) + np.array(found[len(sides) :])).tolist()
    return within, dict(zip(absent, upper, strict=True))


def _crossing(best: Candidate, trial: Trial, at: int, step: float, *, one_sided: bool = False) -> Work[float]:
    """Return the change of a parameter at which -2 log L of the profile has risen by a given square.

    ``step``: a first guess.
    """
    quantile, least = ONE_SIDED if one_sided else QUANTILE, float(best.fit.deviance[0])
    start, sign, size = (
        float(trial.parameters[at]),
        float(np.sign(step)),
        float(np.clip(abs(step), 1e-6, LARGEST_CHANGE)),
    )
    parameters, inner, outer = trial.parameters.copy(), 0.0, np.inf
    for _ in range(PROFILE_STEPS):
        parameters[at] = start + sign * size
        fits, row = yield [trial._replace(parameters=parameters, held=at)]
        deviance = float(fits.deviance[row])
        least = min(least, deviance) if one_sided else least
        excess = float(np.sqrt(max(deviance - least, 1e-12))) / quantile
        if abs(excess - 1.0) < PROFILE_PRECISE or (size >= LARGEST_CHANGE and excess < 1.0):
            break
        inner, outer = (size, outer) if excess <= 1.0 else (inner, size)
        secant = size - np.log(excess) if one_sided else size / excess
        guess = float(np.clip(secant, 0.3 * size, 3.0 * size))
        if not inner < guess < outer:
            guess = 0.5 * (inner + outer) if np.isfinite(outer) else min(2.0 * size, size + 2.0)
        size = min(guess, LARGEST_CHANGE)
        parameters = fits.own(row)
    return sign * size


def ranked(search: Search) -> list[tuple[Candidate, float]]:
    """Return the compositions by their criterion, best first, each with its probability."""
    best = sorted(search.found.values(), key=lambda c: c.bic)
    weight = np.exp(-0.5 * (np.array([c.bic for c in best]) - best[0].bic))
    return list(zip(best[:MOST_PUBLISHED], (weight / weight.sum())[:MOST_PUBLISHED].tolist(), strict=True))


def best_of(search: Search, required: tuple[int, ...], optional: Sequence[int]) -> Work[Candidate]:
    """Return the best composition over all choices of the optional deterministic columns.

    With white noise only, a column that gains less than ``SLIGHT_GAIN`` of -2 log L is not used.
    """
    best = yield from search.run(required)
    if optional and len(best.kinds) == 1:
        fit = evaluate(search.spectrum, [Trial(search.axis, best.kinds, (*required, *optional), best.parameters)])
        optional = [c for c in optional if fit.beta[0, c - 1] ** 2 > SLIGHT_GAIN * fit.beta_covariance[0, c - 1, c - 1]]
    for size in range(1, len(optional) + 1):
        for chosen in combinations(optional, size):
            other = yield from search.run((*required, *chosen), best)
            best = min(best, other, key=lambda c: c.bic)
    return best
