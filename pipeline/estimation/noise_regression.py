"""Fit the deterministic parts of readings at rest together with the noise: ramp, temperature, sinusoids.

    reading = c + R t + k temperature + sum_i (a_i cos(2 pi f_i t) + b_i sin(2 pi f_i t)) + noise

Ramp and temperature are part of the model if they lower its BIC (``noise_search``). A sinusoid is found as a line of
the periodogram with a Hann window and a power of ``LINE_POWER ln(n)`` times the level around it. A column of its
derivative by f refines f and gives its uncertainty. The sinusoid is retained if it raises twice the log-likelihood by
``3 ln(n)``, the penalty of its three parameters.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.estimation.noise_likelihood import Trial, evaluate, solved, spectrum_of
from pipeline.estimation.noise_search import ONE_SIDED, QUANTILE, Search
from pipeline.estimation.noise_terms import STOCHASTIC, unit_of

if TYPE_CHECKING:
    from pipeline.estimation.noise_likelihood import Spectrum
    from pipeline.estimation.noise_search import Candidate
    from pipeline.records import Values

STEADY_DEGC = 0.1  # a temperature that changes less is not a regressor: the noise of thermometers on the chip
RAMP_TOLERANCE = 0.03  # share of a temperature's change that is no ramp, below which the two are not told apart
MOST_SINUSOIDS = 5  # sinusoids
# Power of a line over the level around it, in ln(n): of n independent exponential values one exceeds it with a
# probability of 1 / sqrt(n).
LINE_POWER = 1.5
FEWEST_PERIODS = 16  # periods in the recording: slower sinusoids look like the slow terms
BIN_RATIO = 1.1  # ratio of the edges of the bins over which the level is a median
FEWEST_OF_LEVEL = 16  # values of such a bin
LINE_WIDTH = 4  # lines of the periodogram that a Hann window spreads a sinusoid over
# Change of a frequency, in widths of a line, at which it is found, and at which its power is right to 2 %.
FREQUENCY_PRECISION, POWER_PRECISION = 0.01, 0.1
MOST_ROUNDS = 6  # at most


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

    ``steps``: sizes of the differences of successive readings. ``single``: one recording, in which a ramp and sinusoids
    show.
    """

    def __init__(
        self, unit: str, stretches: list[Stretch], column: int, interval: float, steps: Values, *, single: bool
    ) -> None:
        self.unit, self.stretches, self.column, self.interval = unit, stretches, column, interval
        self.scale = float(np.sqrt(np.mean(steps**2) / 2.0))  # the standard deviation, if it is white
        self.count = float(steps[steps > 1e-9 * self.scale].min())
        start, end = stretches[0].time[0], stretches[-1].time[-1]
        self.middle, self.span = float(0.5 * (start + end)), float(end - start)
        self.optional = (["ramp"] + ["temperature"] * self._warms()) if single else []
        self.lines = self._found() if single else []
        for _ in range(MOST_ROUNDS if self.lines else 0):
            spectrum = spectrum_of([self.columns(s)[None] for s in stretches], interval)
            fit = solved(spectrum, Search(spectrum, 0).run(self.required())).fit
            if self._settled(fit.beta[0], fit.beta_covariance[0]) or not self.lines:
                break

    def _warms(self) -> bool:
        """Return whether the temperature changes, and not in proportion to time like a ramp."""
        if any(s.temperature is None for s in self.stretches):
            return False
        warm = np.concatenate([s.temperature for s in self.stretches if s.temperature is not None])
        time = np.concatenate([s.time for s in self.stretches]) - self.middle
        left = warm - np.polynomial.Polynomial.fit(time, warm, 1)(time)
        return bool(np.ptp(warm) > STEADY_DEGC and np.std(left) > RAMP_TOLERANCE * np.std(warm))

    def required(self) -> tuple[int, ...]:
        """Return the numbers of the sinusoids' columns."""
        first = 1 + len(self.optional)
        return tuple(range(first, first + 3 * len(self.lines)))

    def names(self, candidate: Candidate) -> list[str]:
        """Return the terms of a composition."""
        known = [*self.optional, *["sinusoid", "", ""] * len(self.lines)]
        deterministic = [known[c - 1] for c in sorted(candidate.columns)]
        return [STOCHASTIC[k] for k in candidate.kinds] + [name for name in deterministic if name]

    def terms(self, best: Candidate, spectrum: Spectrum) -> dict[str, Any]:
        """Return ramp, temperature and sinusoids, as published."""
        unit = self.unit
        beta, covariance = self.scale * best.fit.beta[0], self.scale**2 * best.fit.beta_covariance[0]
        out: dict[str, Any] = {
            "ramp": self._slope(best, spectrum, "ramp", unit_of("ramp", unit), self.span),
            "temperature": self._slope(best, spectrum, "temperature", f"{unit}/degC", 1.0),
            "sinusoid": [],
        }
        for i, line in enumerate(self.lines):
            j = len(self.optional) + 3 * i
            size = float(np.hypot(line.a, line.b))
            direction = np.array([line.a, line.b]) / size
            half = QUANTILE * np.sqrt(
                [direction @ covariance[j : j + 2, j : j + 2] @ direction, covariance[j + 2, j + 2]]
            )
            amplitude = float(np.hypot(*beta[j : j + 2]))
            of_frequency = float(half[1]) / (self.scale * self.span * size)
            out["sinusoid"].append(
                {
                    "value": amplitude,
                    "unit": unit,
                    "interval": [amplitude - float(half[0]), amplitude + float(half[0])],
                    "frequency_hz": {
                        "value": line.frequency,
                        "interval": [line.frequency - of_frequency, line.frequency + of_frequency],
                    },
                }
            )
        return out

    def _slope(self, best: Candidate, spectrum: Spectrum, name: str, unit: str, per: float) -> dict[str, Any]:
        """Return the coefficient of a column as published; the column is ``per`` times its unit."""
        if name not in self.optional:
            reason = (
                "only a static recording shows it"
                if name == "ramp"
                else "the temperature did not change, or only as a ramp"
            )
            return {"value": None, "unit": unit, "interval": None, "reason": reason, "upper_limit": None}
        column = 1 + self.optional.index(name)
        columns = tuple(sorted({*best.columns, column}))
        fit = evaluate(spectrum, [Trial(int(best.fit.axis[0]), best.kinds, columns, best.parameters)])
        value = self.scale / per * float(fit.beta[0, column - 1])
        spread = self.scale / per * float(np.sqrt(fit.beta_covariance[0, column - 1, column - 1]))
        if column in best.columns:
            return {"value": value, "unit": unit, "interval": [value - QUANTILE * spread, value + QUANTILE * spread]}
        limit = abs(value) + ONE_SIDED * spread
        return {"value": None, "unit": unit, "interval": None, "reason": "not seen", "upper_limit": limit}

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
        first = len(self.optional)
        settled, kept = True, []
        penalty = 3.0 * np.log(sum(len(s.time) for s in self.stretches))
        for i, line in enumerate(self.lines):
            at = first + 3 * i
            a, b, change = beta[at : at + 3].tolist()
            shift = change / np.hypot(line.a, line.b)  # in widths of a line, 1 / span
            inner = covariance[at : at + 2, at : at + 2]
            if abs(shift) < POWER_PRECISION and np.array([a, b]) @ np.linalg.solve(inner, [a, b]) < penalty:
                settled = False
                continue
            settled &= bool(abs(shift) < FREQUENCY_PRECISION)
            kept.append(_Sinusoid(line.frequency + float(np.clip(shift, -0.5, 0.5)) / self.span, a, b))
        self.lines = kept
        return settled

    def _found(self) -> list[_Sinusoid]:
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
        found: list[_Sinusoid] = []
        while len(found) < MOST_SINUSOIDS and ratio.max() > LINE_POWER * np.log(n):
            peak = int(np.argmax(ratio))
            ratio[max(peak - LINE_WIDTH, 0) : peak + LINE_WIDTH + 1] = 0.0
            frequency = float(peak / (n * self.interval))
            phase = 2.0 * np.pi * frequency * t
            a, b = (2.0 / n * float(y @ wave) for wave in (np.cos(phase), np.sin(phase)))
            found.append(_Sinusoid(frequency, a, b))
        return found


def _level(power: Values) -> Values:
    """Return the level around each line of a periodogram, from ``FEWEST_PERIODS`` on, by medians of bins."""
    number = np.floor(
        np.log(np.arange(FEWEST_PERIODS, FEWEST_PERIODS + len(power)) / FEWEST_PERIODS) / np.log(BIN_RATIO)
    ).astype(int)
    ends = np.append(np.flatnonzero(np.diff(number)) + 1, len(power)).tolist()
    edges = [0]
    for end in ends:  # bins of few lines join the next
        if end - edges[-1] >= FEWEST_OF_LEVEL or end == ends[-1]:
            edges.append(end)
    size = np.diff(edges)
    label = np.repeat(np.arange(len(size)), size)
    ordered, first = power[np.lexsort((power, label))], np.array(edges[:-1])
    middle = 0.5 * (ordered[first + (size - 1) // 2] + ordered[first + size // 2])
    return np.asarray(middle[label] / np.log(2.0))
