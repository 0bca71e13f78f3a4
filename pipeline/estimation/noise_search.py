"""Select the terms of the noise of an axis at rest, and estimate their sizes.

Compositions (sets of the terms of ``noise_terms``) are compared by

    BIC = -2 log L + p ln(n),    probability proportional to exp(-BIC / 2)

with p parameters and n coefficients. The search begins with white noise and adds, drops or swaps one term at a time
until no step lowers the BIC. A term whose gain is certain is not dropped. A term is fitted only if its score, the
derivative of the likelihood at zero, predicts a gain, so that a recording of white noise needs one fit. A ramp,
sinusoids and a dependence on temperature are deterministic columns (``noise_regression``).

Intervals are those of the profile likelihood (of a ramp and a sinusoid: of generalised least squares). The upper limit
of a term that is not in the composition is the coefficient at which -2 log L of the profile rises by 1.645^2: one-sided
95 %.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from pipeline.estimation.noise_terms import (
    LONGEST_TIME,
    MARKOV,
    SINGLE,
    WHITE,
    Composition,
    Fits,
    Trial,
    active,
    at_once,
    evaluate,
    markov_shape,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from pipeline.estimation.noise_terms import Spectrum, Work
    from pipeline.records import Values

MOST_MARKOV = 2  # processes of different correlation times; to distinguish a third takes some 10^6 samples
TIMES_SCORED = 10  # correlation times whose score is computed, in equal steps of their logarithm
TIMES_FITTED = 2  # of them that are fitted
LEAST_PREDICTED_GAIN = 0.25  # of the penalty of a term: a term whose score predicts less is not fitted
CERTAIN_GAIN = 10.0  # penalties of a term: a term that gains more, by its spread, is not dropped
SLIGHT_GAIN = 2.0  # in -2 log L of a deterministic column: its penalty is ln(n), 4 and more
QUANTILE, ONE_SIDED = 1.959964, 1.644854  # of the standard normal distribution: 95 % from two sides, from one
MOST_PUBLISHED = 12  # compositions
LARGEST_CHANGE = 14.0  # change of the logarithm of a squared coefficient: a factor of 1000 in the coefficient
PROFILE_STEPS, PROFILE_PRECISE = 9, 0.02  # of the root of the loss: 2 % of half an interval


@dataclass(frozen=True)
class Candidate:
    """One fitted composition: stochastic terms and deterministic columns (by number)."""

    kinds: Composition
    columns: tuple[int, ...]
    parameters: Values  # as in ``Trial.parameters``
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
            more = self._added(best)
            if len(best.kinds) > 1:
                # a term gains at least (coefficient^2 / spread)^2
                variance = np.diag(best.fit.covariance(self.spectrum.count)[0])[: len(best.kinds)]
                uncertain = np.flatnonzero(1.0 / variance < CERTAIN_GAIN * self.penalty).tolist()
                dropped = [_without(best, j) for j in uncertain]
                yield from self.fit(dropped, columns)
                more += [new for kinds, _ in dropped for new in self._added(self.found[kinds, columns])]
            yield from self.fit(more, columns)
            new = self._best(columns)
            if new is best:
                return best
            best = new

    def _best(self, columns: tuple[int, ...]) -> Candidate:
        """Return the best composition so far with these columns."""
        return min((c for c in self.found.values() if c.columns == columns), key=lambda c: c.bic)

    def fit(self, starts: Sequence[tuple[Composition, Values]], columns: tuple[int, ...]) -> Work[None]:
        """Fit compositions from their starts, and store the best fit of each."""
        trials = [Trial(self.axis, k, columns, p) for k, p in starts if (k, columns) not in self.found]
        if not trials:
            return
        fits = yield trials
        for g, trial in enumerate(trials):
            key, bic = (trial.kinds, columns), float(fits.unrestricted[g])
            bic += count_of(*key) * self.penalty
            if key not in self.found or bic < self.found[key].bic:
                self.found[key] = Candidate(*key, fits.own(g), bic, fits.rows(slice(g, g + 1)))

    def _added(self, candidate: Candidate) -> list[tuple[Composition, Values]]:
        """Return compositions with one additional term whose score predicts a gain, and their starts."""
        spectrum = self.spectrum
        absent = [k for k in SINGLE if k not in candidate.kinds]
        gain, size, _ = _scores(spectrum, candidate.fit, spectrum.shapes[absent])
        least = LEAST_PREDICTED_GAIN * self.penalty
        out = [_with_term(candidate, kind, size[i], 0.0) for i, kind in enumerate(absent) if gain[i] > least]
        longest = np.log(LONGEST_TIME * spectrum.length / 1.5)
        if candidate.kinds.count(MARKOV) < MOST_MARKOV and longest > np.log(4.0 * spectrum.interval):
            times = np.linspace(np.log(2.0 * spectrum.interval), longest, TIMES_SCORED)
            shapes, _ = markov_shape(spectrum.omega, spectrum.interval, times)
            gain, size, _ = _scores(spectrum, candidate.fit, shapes)
            chosen: list[int] = []
            for i in np.argsort(gain)[::-1].tolist():
                if gain[i] > least and all(abs(i - c) > 1 for c in chosen):
                    chosen.append(i)
            out += [_with_term(candidate, MARKOV, size[i], times[i]) for i in chosen[:TIMES_FITTED]]
        return out


def _without(candidate: Candidate, index: int) -> tuple[Composition, Values]:
    """Return a composition without one term, and its start."""
    n = len(candidate.kinds)
    kinds = candidate.kinds[:index] + candidate.kinds[index + 1 :]
    return kinds, np.delete(candidate.parameters, [index, n + index])


def _with_term(candidate: Candidate, kind: int, size: float, log_time: float) -> tuple[Composition, Values]:
    """Return a composition with one additional term, and its start."""
    kinds = candidate.kinds
    place = sum(k <= kind for k in kinds)
    start = np.insert(candidate.parameters, [place, len(kinds) + place], [np.log(size), log_time])
    return (*kinds[:place], kind, *kinds[place:]), start


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
    information = np.maximum(own - np.sum(cross @ np.linalg.inv(inner) * cross, axis=1), 1e-9 * own)
    gain = np.where(u > 0, u**2 / information, 0.0)
    spread = 1.0 / np.sqrt(information)
    return gain, np.maximum(u / information, 0.01 * spread), spread


def limits(spectrum: Spectrum, best: Candidate) -> Work[tuple[Values, dict[int, float]]]:
    """Return the 95 % intervals of the parameters, and the upper limits of absent terms without a correlation time.

    The intervals are a (2, 2 k) array, NaN for terms without a correlation time; the limits are of squared
    coefficients.
    """
    trial = Trial(int(best.fit.axis[0]), best.kinds, best.columns, best.parameters)
    spread = np.sqrt(np.diag(best.fit.covariance(spectrum.count)[0]))
    n, terms = len(best.kinds), best.fit.kinds.shape[1]
    spread = spread[[*range(n), *range(terms, terms + n)]]
    sides = [(j, sign) for j in range(2 * n) if j < n or best.kinds[j - n] == MARKOV for sign in (0, 1)]
    works = [_crossing(best, trial, j, (-1.0, 1.0)[sign] * QUANTILE * spread[j]) for j, sign in sides]
    absent = [k for k in SINGLE if k not in best.kinds]
    gain, size, spread = _scores(spectrum, best.fit, spectrum.shapes[absent])
    least = 1e-3 * spread  # certainly below the limit
    for i, kind in enumerate(absent):
        kinds, start = _with_term(best, kind, least[i], 0.0)
        step = float(np.log(((size[i] if gain[i] > 0.0 else 0.0) + ONE_SIDED * spread[i]) / least[i]))
        more = trial._replace(kinds=kinds, parameters=start)
        works.append(_crossing(best, more, kinds.index(kind), step, one_sided=True))
    offsets = yield from at_once(works)
    within = np.full((2, 2 * n), np.nan)
    for (j, sign), offset in zip(sides, offsets, strict=False):
        within[sign, j] = best.parameters[j] + offset
    upper = least * np.exp(offsets[len(sides) :])
    return within, dict(zip(absent, upper.tolist(), strict=True))


def _crossing(best: Candidate, trial: Trial, j: int, step: float, *, one_sided: bool = False) -> Work[float]:
    """Return the change of parameter j at which -2 log L of the profile rises by the square of the quantile.

    ``step``: a first guess.
    """
    quantile, least = ONE_SIDED if one_sided else QUANTILE, float(best.fit.deviance[0])
    sign, size = float(np.sign(step)), float(np.clip(abs(step), 1e-6, LARGEST_CHANGE))
    start, parameters = float(trial.parameters[j]), trial.parameters.copy()
    inner, outer = 0.0, np.inf
    for _ in range(PROFILE_STEPS):
        parameters[j] = start + sign * size
        fits = yield [trial._replace(parameters=parameters, held=j)]
        deviance = float(fits.deviance[0])
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
        parameters = fits.own()
    return sign * size


def ranked(search: Search) -> list[tuple[Candidate, float]]:
    """Return the compositions by their criterion, best first, each with its probability."""
    candidates = sorted(search.found.values(), key=lambda c: c.bic)
    weight = np.exp(-0.5 * (np.array([c.bic for c in candidates]) - candidates[0].bic))
    return list(zip(candidates, (weight / weight.sum()).tolist(), strict=True))[:MOST_PUBLISHED]


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
