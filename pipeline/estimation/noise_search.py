"""Select the terms of the noise of an axis at rest, stochastic and deterministic ones, and estimate their sizes.

Compositions (sets of the terms of ``noise_terms``) are compared by

    BIC = -2 log L + p ln(n),    probability proportional to exp(-BIC / 2)

with p parameters and n coefficients. The search begins with white noise and adds, drops or swaps one term at a time
until no step lowers the BIC. A term whose gain is certain is not dropped. A term is fitted only if its score, the
derivative of the likelihood at zero, predicts a gain, so that a recording of white noise needs one fit. A ramp,
sinusoids and a dependence on temperature are deterministic columns:

    reading = c + R t + k temperature + sum_i (a_i cos(2 pi f_i t) + b_i sin(2 pi f_i t)) + noise

Ramp and temperature are part of the model if they lower its BIC. A sinusoid is found as a line of the periodogram with
a Hann window, with a power of ``LINE_POWER ln(n)`` times the level around it. A column of its derivative by f refines f
and gives its uncertainty. The sinusoid is retained if it raises twice the log-likelihood by ``3 ln(n)``, the penalty of
its three parameters.

Intervals are those of the profile likelihood (of a ramp and a sinusoid: of generalised least squares). The upper limit
of a term that is not in the composition is the coefficient at which -2 log L of the profile rises by 1.645^2: one-sided
95 %.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from pipeline.core.records import Values, median
from pipeline.estimation.noise_terms import (
    LONGEST_TIME,
    MARKOV,
    SINGLE,
    STOCHASTIC,
    WHITE,
    Composition,
    Spectrum,
    TermFits,
    TermTrial,
    Work,
    active,
    at_once,
    evaluate,
    markov_shape,
    solved,
    spectrum_of,
)

MOST_MARKOV = 2  # processes of different correlation times; to distinguish a third takes some 10^6 samples
TIMES_SCORED = 10  # correlation times whose score is computed, in equal steps of their logarithm
TIMES_FITTED = 2  # of them that are fitted
LEAST_PREDICTED_GAIN = 0.25  # of the penalty of a term: a term whose score predicts less is not fitted
CERTAIN_GAIN = 10.0  # penalties of a term: a term that gains more, by its spread, is not dropped
SLIGHT_GAIN = 2.0  # in -2 log L of a deterministic column: its penalty is ln(n), 4 and more
QUANTILE, ONE_SIDED = 1.959964, 1.644854  # of the standard normal distribution: 95 % from two sides, from one
LARGEST_CHANGE = 14.0  # change of the logarithm of a squared coefficient: a factor of 1000 in the coefficient
PROFILE_STEPS, PROFILE_PRECISE = 9, 0.02  # of the root of the loss: 2 % of half an interval
STEADY_DEGC = 0.1  # a temperature that changes less is not a regressor: the noise of thermometers on the chip
RAMP_TOLERANCE = 0.03  # share of a temperature's change that is no ramp, below which it is not separable from a ramp
MOST_SINUSOIDS = 5  # a bound of the cost: each has a fit of all terms
# Power of a line over the level around it, in ln(n): of n independent exponential values one exceeds it with a
# probability of 1 / sqrt(n).
LINE_POWER = 1.5
FEWEST_PERIODS = 16  # periods in the recording: slower sinusoids look like the slow terms
LEVEL_BIN_RATIO = 1.1  # ratio of the edges of the bins over which the level is a median
FEWEST_OF_LEVEL = 16  # values of such a bin
LINE_WIDTH = 4  # lines of the periodogram over which a Hann window spreads a sinusoid
# Change of a frequency, in widths of a line, at which it has converged, and at which its power is right to 2 %.
FREQUENCY_PRECISION = 0.01  # widths of a line (1 / span) by which a step moves a frequency that has settled
POWER_PRECISION = 0.1  # the same, below which a line is judged: its power is within 4 % of the largest (sinc)
MOST_ROUNDS = 6  # a step of Gauss and Newton doubles the digits: from half a width to a hundredth in three


@dataclass(frozen=True)
class FittedComposition:
    """One fitted composition: stochastic terms and deterministic columns (by number)."""

    kinds: Composition
    columns: tuple[int, ...]
    parameters: Values  # as in ``TermTrial.parameters``
    bic: float
    fit: TermFits  # of one row


def count_of(kinds: Composition, columns: Iterable[int]) -> int:
    """Return the number of parameters."""
    return len(kinds) + kinds.count(MARKOV) + len(tuple(columns))


class CompositionSearch:
    """The fitted compositions of one axis."""

    def __init__(self, spectrum: Spectrum, axis: int) -> None:
        self.spectrum, self.axis = spectrum, axis
        self.penalty = float(np.log(spectrum.size))
        self.found: dict[tuple[Composition, tuple[int, ...]], FittedComposition] = {}

    def run(self, columns: tuple[int, ...], start: FittedComposition | None = None) -> Work[FittedComposition]:
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

    def _best(self, columns: tuple[int, ...]) -> FittedComposition:
        return min((c for c in self.found.values() if c.columns == columns), key=lambda c: c.bic)

    def fit(self, starts: Sequence[tuple[Composition, Values]], columns: tuple[int, ...]) -> Work[None]:
        """Fit compositions from their starts, and store the best fit of each."""
        trials = [TermTrial(self.axis, k, columns, p) for k, p in starts if (k, columns) not in self.found]
        if not trials:
            return
        fits = yield trials
        for g, trial in enumerate(trials):
            key, bic = (trial.kinds, columns), float(fits.unrestricted[g])
            bic += count_of(*key) * self.penalty
            if key not in self.found or bic < self.found[key].bic:
                self.found[key] = FittedComposition(*key, fits.own(g), bic, fits.rows(slice(g, g + 1)))

    def _added(self, candidate: FittedComposition) -> list[tuple[Composition, Values]]:
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


def _without(candidate: FittedComposition, index: int) -> tuple[Composition, Values]:
    """Return a composition without one term, and its start."""
    n = len(candidate.kinds)
    kinds = candidate.kinds[:index] + candidate.kinds[index + 1 :]
    return kinds, np.delete(candidate.parameters, [index, n + index])


def _with_term(candidate: FittedComposition, kind: int, size: float, log_time: float) -> tuple[Composition, Values]:
    """Return a composition with one additional term, and its start."""
    kinds = candidate.kinds
    place = sum(k <= kind for k in kinds)
    start = np.insert(candidate.parameters, [place, len(kinds) + place], [np.log(size), log_time])
    return (*kinds[:place], kind, *kinds[place:]), start


def _scores(spectrum: Spectrum, fit: TermFits, shapes: Values) -> tuple[Values, Values, Values]:
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


def limits(spectrum: Spectrum, best: FittedComposition) -> Work[tuple[Values, dict[int, float]]]:
    """Return the 95 % intervals of the parameters, and the upper limits of absent terms without a correlation time.

    The intervals are a (2, 2 k) array, NaN for terms without a correlation time; the limits are of squared
    coefficients.
    """
    trial = TermTrial(int(best.fit.axis[0]), best.kinds, best.columns, best.parameters)
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
        works.append(_crossing(best, more, kinds.index(kind), step, upper=True))
    offsets = yield from at_once(works)
    within = np.full((2, 2 * n), np.nan)
    for (j, sign), offset in zip(sides, offsets, strict=False):
        within[sign, j] = best.parameters[j] + offset
    upper = least * np.exp(offsets[len(sides) :])
    return within, dict(zip(absent, upper.tolist(), strict=True))


def _crossing(best: FittedComposition, trial: TermTrial, j: int, step: float, *, upper: bool = False) -> Work[float]:
    """Return the change of parameter j at which -2 log L of the profile rises by the square of the quantile.

    ``step``: a first guess. ``upper``: of an upper limit, from one side.
    """
    quantile, least = ONE_SIDED if upper else QUANTILE, float(best.fit.deviance[0])
    sign, size = float(np.sign(step)), float(np.clip(abs(step), 1e-6, LARGEST_CHANGE))
    start, parameters = float(trial.parameters[j]), trial.parameters.copy()
    inner, outer = 0.0, np.inf
    for _ in range(PROFILE_STEPS):
        parameters[j] = start + sign * size
        fits = yield [trial._replace(parameters=parameters, held=j)]
        deviance = float(fits.deviance[0])
        least = min(least, deviance) if upper else least
        excess = float(np.sqrt(max(deviance - least, 1e-12))) / quantile
        if abs(excess - 1.0) < PROFILE_PRECISE or (size >= LARGEST_CHANGE and excess < 1.0):
            break
        inner, outer = (size, outer) if excess <= 1.0 else (inner, size)
        secant = size - np.log(excess) if upper else size / excess
        guess = float(np.clip(secant, 0.3 * size, 3.0 * size))
        if not inner < guess < outer:
            guess = 0.5 * (inner + outer) if np.isfinite(outer) else min(2.0 * size, size + 2.0)
        size = min(guess, LARGEST_CHANGE)
        parameters = fits.own()
    return sign * size


def best_of(search: CompositionSearch, required: tuple[int, ...], optional: Sequence[int]) -> Work[FittedComposition]:
    """Return the best composition over all choices of the optional deterministic columns.

    With white noise only, a column that gains less than ``SLIGHT_GAIN`` of -2 log L is not used.
    """
    best = yield from search.run(required)
    if optional and len(best.kinds) == 1:
        fit = evaluate(search.spectrum, [TermTrial(search.axis, best.kinds, (*required, *optional), best.parameters)])
        optional = [c for c in optional if fit.beta[0, c - 1] ** 2 > SLIGHT_GAIN * fit.beta_covariance[0, c - 1, c - 1]]
    for size in range(1, len(optional) + 1):
        for chosen in combinations(optional, size):
            other = yield from search.run((*required, *chosen), best)
            best = min(best, other, key=lambda c: c.bic)
    return best


@dataclass(frozen=True)
class RestStretch:
    """Evenly sampled readings at rest: times (n,) in s, readings (n, 3), smoothed temperature (n,) or None."""

    time: Values
    reading: Values
    temperature: Values | None = None


@dataclass
class _Sinusoid:
    """A line: frequency, Hz, and the parts in phase and in quadrature."""

    frequency: float
    a: float
    b: float


class Regression:
    """The deterministic columns of one axis, fitted in units of ``scale``.

    ``steps``: sizes of the differences of successive readings. ``single``: whether the stretches are of one static
    recording, which can show a ramp and sinusoids.
    """

    def __init__(
        self, unit: str, stretches: list[RestStretch], column: int, interval: float, steps: Values, *, single: bool
    ) -> None:
        self.unit, self.stretches, self.column, self.interval = unit, stretches, column, interval
        self.scale = float(np.sqrt(np.mean(steps**2) / 2.0))  # the standard deviation, if it is white
        self.count = float(steps[steps > 1e-9 * self.scale].min())
        start, end = stretches[0].time[0], stretches[-1].time[-1]
        self.middle, self.span = float(0.5 * (start + end)), float(end - start)
        self.optional = (["ramp"] + ["temperature"] * self._has_temperature()) if single else []
        self.lines = self._lines() if single else []
        for _ in range(MOST_ROUNDS if self.lines else 0):
            spectrum = spectrum_of([self.columns(s)[None] for s in stretches], interval)
            fit = solved(spectrum, CompositionSearch(spectrum, 0).run(self.required())).fit
            if self._settled(fit.beta[0], fit.beta_covariance[0]) or not self.lines:
                break

    def _has_temperature(self) -> bool:
        """Return whether the temperature changes, and not in proportion to time like a ramp."""
        known = [s.temperature for s in self.stretches if s.temperature is not None]
        if len(known) < len(self.stretches):
            return False
        temperature, time = np.concatenate(known), np.concatenate([s.time for s in self.stretches]) - self.middle
        bend = temperature - np.polynomial.Polynomial.fit(time, temperature, 1)(time)
        return bool(np.ptp(temperature) > STEADY_DEGC and np.std(bend) > RAMP_TOLERANCE * np.std(temperature))

    def required(self) -> tuple[int, ...]:
        """Return the numbers of the sinusoids' columns."""
        first = 1 + len(self.optional)
        return tuple(range(first, first + 3 * len(self.lines)))

    def names(self, candidate: FittedComposition) -> list[str]:
        """Return the names of the terms of a composition."""
        names = [*self.optional, *["sinusoid", "", ""] * len(self.lines)]
        deterministic = [names[c - 1] for c in sorted(candidate.columns)]
        return [STOCHASTIC[k] for k in candidate.kinds] + [name for name in deterministic if name]

    def columns(self, stretch: RestStretch) -> Values:
        """Return readings and columns of a stretch: (n, 1 + d) array."""
        t = stretch.time - self.middle
        columns = [stretch.reading[:, self.column] / self.scale]
        columns += [t / self.span] if "ramp" in self.optional else []
        columns += [stretch.temperature] if "temperature" in self.optional and stretch.temperature is not None else []
        for line in self.lines:
            phase = 2.0 * np.pi * line.frequency * t
            cosine, sine = np.cos(phase), np.sin(phase)
            size = np.hypot(line.a, line.b)
            slope = 2.0 * np.pi * t / self.span * (line.b * cosine - line.a * sine) / size
            columns += [cosine, sine, slope]
        return np.stack(columns, axis=1)

    def _settled(self, beta: Values, covariance: Values) -> bool:
        """Refine the sinusoids, drop those that are not significant, and return whether nothing changed."""
        settled, kept = True, []
        penalty = 3.0 * np.log(sum(len(s.time) for s in self.stretches))
        for i, line in enumerate(self.lines):
            j = len(self.optional) + 3 * i
            a, b, change = beta[j : j + 3].tolist()
            shift = change / np.hypot(line.a, line.b)  # in widths of a line, 1 / span
            inner = covariance[j : j + 2, j : j + 2]
            if abs(shift) < POWER_PRECISION and np.array([a, b]) @ np.linalg.solve(inner, [a, b]) < penalty:
                settled = False
                continue
            settled &= bool(abs(shift) < FREQUENCY_PRECISION)
            kept.append(_Sinusoid(line.frequency + float(np.clip(shift, -0.5, 0.5)) / self.span, a, b))
        self.lines = kept
        return settled

    def _lines(self) -> list[_Sinusoid]:
        """Return the lines of the longest stretch, strongest first."""
        stretch = max(self.stretches, key=lambda s: len(s.time))
        t, y = stretch.time - self.middle, stretch.reading[:, self.column] / self.scale
        n = len(y)
        y = y - np.polynomial.Polynomial.fit(t, y, 1)(t)
        power = np.abs(np.fft.rfft(y * np.hanning(n))) ** 2
        k = np.arange(len(power))
        usable = (k >= FEWEST_PERIODS) & (k < n // 2)
        if usable.sum() < 2 * FEWEST_OF_LEVEL:
            return []
        ratio = np.zeros(len(power))
        ratio[usable] = power[usable] / np.maximum(_level(power[usable]), 1e-300)
        lines: list[_Sinusoid] = []
        while len(lines) < MOST_SINUSOIDS and ratio.max() > LINE_POWER * np.log(n):
            peak = int(np.argmax(ratio))
            ratio[max(peak - LINE_WIDTH, 0) : peak + LINE_WIDTH + 1] = 0.0
            frequency = float(peak / (n * self.interval))
            phase = 2.0 * np.pi * frequency * t
            a, b = (2.0 / n * float(y @ wave) for wave in (np.cos(phase), np.sin(phase)))
            lines.append(_Sinusoid(frequency, a, b))
        return lines


def _level(power: Values) -> Values:
    """Return the level around each line of a periodogram, from ``FEWEST_PERIODS`` on, by medians of bins."""
    number = np.floor(np.log1p(np.arange(len(power)) / FEWEST_PERIODS) / np.log(LEVEL_BIN_RATIO))
    ends = np.append(np.flatnonzero(np.diff(number)) + 1, len(power)).tolist()
    edges = [0]
    for end in ends:  # bins of few lines join the next
        if end - edges[-1] >= FEWEST_OF_LEVEL or end == ends[-1]:
            edges.append(end)
    middle = [median(part) for part in np.split(power, edges[1:-1])]
    return np.asarray(np.repeat(middle, np.diff(edges)) / np.log(2.0))
