"""Fit the deterministic parts of readings at rest together with the noise: ramp, temperature, sinusoids.

    reading = c + R t + k temperature + sum_i (a_i cos(2 pi f_i t) + b_i sin(2 pi f_i t)) + noise

Ramp and temperature are part of the model if they lower its BIC (``noise_search``). A sinusoid is found as a line of
the periodogram with a Hann window, with a power of ``LINE_POWER ln(n)`` times the level around it. A column of its
derivative by f refines f and gives its uncertainty. The sinusoid is retained if it raises twice the log-likelihood by
``3 ln(n)``, the penalty of its three parameters.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.estimation.noise_search import ONE_SIDED, QUANTILE, Search
from pipeline.estimation.noise_terms import STOCHASTIC, Trial, evaluate, solved, spectrum_of, unit_of
from pipeline.records import median

if TYPE_CHECKING:
    from pipeline.estimation.noise_search import Candidate
    from pipeline.estimation.noise_terms import Spectrum
    from pipeline.records import Values

STEADY_DEGC = 0.1  # a temperature that changes less is not a regressor: the noise of thermometers on the chip
RAMP_TOLERANCE = 0.03  # share of a temperature's change that is no ramp, below which it is not separable from a ramp
MOST_SINUSOIDS = 5
# Power of a line over the level around it, in ln(n): of n independent exponential values one exceeds it with a
# probability of 1 / sqrt(n).
LINE_POWER = 1.5
FEWEST_PERIODS = 16  # periods in the recording: slower sinusoids look like the slow terms
BIN_RATIO = 1.1  # ratio of the edges of the bins over which the level is a median
FEWEST_OF_LEVEL = 16  # values of such a bin
LINE_WIDTH = 4  # lines of the periodogram over which a Hann window spreads a sinusoid
# Change of a frequency, in widths of a line, at which it has converged, and at which its power is right to 2 %.
FREQUENCY_PRECISION, POWER_PRECISION = 0.01, 0.1
MOST_ROUNDS = 6


@dataclass(frozen=True)
class Stretch:
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
        self, unit: str, stretches: list[Stretch], column: int, interval: float, steps: Values, *, single: bool
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
            fit = solved(spectrum, Search(spectrum, 0).run(self.required())).fit
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

    def names(self, candidate: Candidate) -> list[str]:
        """Return the names of the terms of a composition."""
        names = [*self.optional, *["sinusoid", "", ""] * len(self.lines)]
        deterministic = [names[c - 1] for c in sorted(candidate.columns)]
        return [STOCHASTIC[k] for k in candidate.kinds] + [name for name in deterministic if name]

    def terms(self, best: Candidate, spectrum: Spectrum) -> dict[str, Any]:
        """Return ramp, temperature and sinusoids, as published."""
        ramp_unit, temperature_unit = unit_of("ramp", self.unit), f"{self.unit}/degC"
        beta, covariance = best.fit.beta[0], best.fit.beta_covariance[0]
        sinusoids = []
        for j, line in zip(range(len(self.optional), len(beta), 3), self.lines, strict=False):
            size = float(np.hypot(line.a, line.b))
            direction = np.array([line.a, line.b]) / size
            spread = float(np.sqrt(direction @ covariance[j : j + 2, j : j + 2] @ direction))
            amplitude = _with_interval(self.scale * float(np.hypot(*beta[j : j + 2])), self.scale * spread)
            of_frequency = float(np.sqrt(covariance[j + 2, j + 2])) / (self.span * size)
            frequency = _with_interval(line.frequency, of_frequency)
            sinusoids.append(amplitude | {"unit": self.unit, "frequency_hz": frequency})
        return {
            "ramp": {"unit": ramp_unit} | self._slope(best, spectrum, "ramp", self.span),
            "temperature": {"unit": temperature_unit} | self._slope(best, spectrum, "temperature", 1.0),
            "sinusoid": sinusoids,
        }

    def _slope(self, best: Candidate, spectrum: Spectrum, name: str, per: float) -> dict[str, Any]:
        """Return the coefficient of a column as published; the column is ``per`` times its unit."""
        absent = {"value": None, "interval": None, "upper_limit": None}
        if name not in self.optional:
            cause = "only a static recording shows it", "the temperature did not change, or only as a ramp"
            return absent | {"reason": cause[name == "temperature"]}
        column = 1 + self.optional.index(name)
        columns = tuple(sorted({*best.columns, column}))
        fit = evaluate(spectrum, [Trial(int(best.fit.axis[0]), best.kinds, columns, best.parameters)])
        value = self.scale / per * float(fit.beta[0, column - 1])
        spread = self.scale / per * float(np.sqrt(fit.beta_covariance[0, column - 1, column - 1]))
        if column in best.columns:
            return _with_interval(value, spread)
        return absent | {"reason": "not seen", "upper_limit": abs(value) + ONE_SIDED * spread}

    def columns(self, stretch: Stretch) -> Values:
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


def _with_interval(value: float, spread: float) -> dict[str, Any]:
    """Return a value with its 95 % interval as published."""
    return {"value": value, "interval": [value - QUANTILE * spread, value + QUANTILE * spread]}


def _level(power: Values) -> Values:
    """Return the level around each line of a periodogram, from ``FEWEST_PERIODS`` on, by medians of bins."""
    number = np.floor(np.log1p(np.arange(len(power)) / FEWEST_PERIODS) / np.log(BIN_RATIO))
    ends = np.append(np.flatnonzero(np.diff(number)) + 1, len(power)).tolist()
    edges = [0]
    for end in ends:  # bins of few lines join the next
        if end - edges[-1] >= FEWEST_OF_LEVEL or end == ends[-1]:
            edges.append(end)
    middle = [median(part) for part in np.split(power, edges[1:-1])]
    return np.asarray(np.repeat(middle, np.diff(edges)) / np.log(2.0))
