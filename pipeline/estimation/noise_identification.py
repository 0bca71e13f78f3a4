"""Identify the noise of a sensor at rest, for the section ``noise`` of ``calibrations/<unit>.json``.

The section states for each axis

- each term of ``noise_terms`` with its 95 % interval, or null with a reason and an upper limit if the recording does
  not show it,
- the sets of terms by probability (``noise_search``),
- the quality of the fit of the most probable set.

The readings are from the static recording before any filter, else from the rests. A ramp, sinusoids and a changing
temperature are regressed out.

A fit is in doubt if the power of the spectrum in bins of frequency differs from the model: the cube root of a
chi-square variable over its degrees of freedom m is normal with mean 1 - 2/(9m) and variance 2/(9m) (Wilson & Hilferty,
PNAS 17, 1931).

A run states N, B and K alone, without intervals: the composition of them with the smallest BIC, where the Allan
variances of octaves are independent and chi-square distributed about ``N^2 / t + (2 ln 2 / pi) B^2 + K^2 t / 3``. They
are in doubt if an Allan variance differs from the sum.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import scipy

from pipeline.core.files import JSON
from pipeline.core.records import AXES, NOISE_OF_ROWS, SENSOR_UNITS, SENSORS, Recording, Values, once_of_log
from pipeline.estimation.noise_search import (
    ONE_SIDED,
    QUANTILE,
    CompositionSearch,
    FittedComposition,
    Regression,
    RestStretch,
    best_of,
    limits,
)
from pipeline.estimation.noise_terms import (
    INSTABILITY,
    MARKOV,
    SINGLE,
    STOCHASTIC,
    WALK,
    WHITE,
    Spectrum,
    TermTrial,
    allan_deviation,
    allan_variance,
    at_once,
    evaluate,
    octave_variances,
    solved,
    spectrum_of,
    unit_of,
)
from pipeline.physics.signal.filters import temperature_of
from pipeline.physics.signal.rests import rest_readings, usable

MIN_SPECTRUM_SAMPLES = 60  # which determine the white noise to a tenth
SHORTEST_STRETCH = 16  # samples
GAP_INTERVALS = 1.5  # sampling intervals; a longer step of time is a gap
MOST_JITTER = 0.5  # rms scatter of the sampling intervals, relative, above which equal counts are not equal times
INTERVAL_TOLERANCE = 0.02  # relative; rests whose sampling interval differs by more are not used
LONGEST_FILL = 10  # missing or flagged samples in a row, up to which a straight line replaces them
LEAST_FIT_PROBABILITY = 1e-4  # probability of the bins under the fit, below which the composition is in doubt
COARSE_COUNTS = 0.4  # standard deviation in counts, below which rounding is not white noise (Widrow & Kollar 2008)
LONGEST_AVERAGE_SHARE = 0.25  # longest averaging time that the Allan deviation determines, in lengths of the recording
AVERAGES_PER_DECADE = 8
MOST_PUBLISHED = 12  # compositions
DERIVATIVE_STEP = 1.01  # of a correlation time, for a derivative
SLOW_TERMS = ("bias_instability", "random_walk", "gauss_markov", "ramp", "temperature")
CONSTANT_READINGS = {"terms": None, "reason": "the readings do not change: the noise is below one count"}
DOUBT_OF_RESTS = "no static recording: what is slower than a rest is not seen, and in rests by hand the unit moves"
NOT_FITTED = {
    "ramp": "only a static recording shows it",
    "temperature": "the temperature did not change, or only as a ramp",
}
N_B_K = (WHITE, INSTABILITY, WALK)
TERM_SETS = np.array([[1, 0, 0], [1, 1, 0], [1, 0, 1], [1, 1, 1]], bool)  # of N, B and K
SCORINGS, LEAST_SHARE = 12, 1e-12  # of the scoring; smallest share of a term in an Allan variance
MOST_DEPARTURE = 6.0  # standard deviations of an Allan variance about the sum of N, B and K
NOT_OF_A_RUN = "a run states N, B and K alone"
NOT_SHOWN = "the Allan deviation does not show it"
OTHER_SPECTRUM = "the Allan deviation is not that of N, B and K: a filter, vibration, drift or a disturbance"


@dataclass(frozen=True)
class Bounded:
    """A value and its 95 % interval."""

    value: float
    interval: list[float] | None  # None: not determined

    @classmethod
    def of(cls, value: float, spread: float) -> Self:
        """Return a value with its interval by the standard uncertainty."""
        return cls(value, [value - QUANTILE * spread, value + QUANTILE * spread])


@dataclass(frozen=True)
class SeenTerm:
    """A noise term that the recording shows."""

    name: str
    coefficient: Bounded
    unit: str
    correlation_time_s: Bounded | None = None  # of a Gauss-Markov process
    frequency_hz: Bounded | None = None  # of a sinusoid

    def allan_variance(self, tau: Values, longer: float = 1.0) -> Values:
        """Return the Allan variance at averaging times in s, with ``longer`` times the correlation time."""
        constant = self.correlation_time_s or self.frequency_hz
        return allan_variance(self.name, self.coefficient.value, tau, longer * constant.value if constant else np.nan)

    def to_json(self) -> JSON:
        """Return the published entry."""
        constants = {"correlation_time_s": self.correlation_time_s, "frequency_hz": self.frequency_hz}
        return {"unit": self.unit, **vars(self.coefficient), **{k: vars(v) for k, v in constants.items() if v}}


def _unseen(unit: str, reason: str, upper_limit: float | None = None) -> JSON:
    """Return the published entry of a term that the recording does not show."""
    return {"value": None, "interval": None, "unit": unit, "reason": reason, "upper_limit": upper_limit}


def identify_noise(recordings: Sequence[Recording], *, full: bool = True) -> dict[str, JSON]:
    """Return the noise of each sensor, from its recordings before any filter: see the schema of calibrations.

    Axes whose readings have the same sampling are fitted together. ``full``: False states N, B and K alone.
    """
    documents: dict[str, JSON] = {}
    same_sampling: dict[tuple[Any, ...], list[tuple[str, Regression]]] = {}
    for sensor in SENSORS:
        document, stretches = _source(sensor, recordings, warm=full)
        documents[sensor] = document
        if not stretches:
            continue
        if not full:
            document["axes"] = _stated(document["unit"], stretches, document["sampling_interval_s"])
            continue
        document["axes"] = dict.fromkeys(AXES, CONSTANT_READINGS)
        single = document["source"] == "static" and len(document["recordings"]) == 1
        for c in range(3):
            steps = np.concatenate([np.abs(np.diff(s.reading[:, c])) for s in stretches])
            if steps.any():
                interval = document["sampling_interval_s"]
                regression = Regression(document["unit"], stretches, c, interval, steps, single=single)
                key = (interval, len(regression.optional), *(len(s.time) for s in stretches))
                same_sampling.setdefault(key, []).append((sensor, regression))
    for pairs in same_sampling.values():
        axes = _axes([regression for _, regression in pairs])
        for (sensor, regression), axis in zip(pairs, axes, strict=True):
            documents[sensor]["axes"][AXES[regression.column]] = axis
    return documents


def _source(sensor: str, recordings: Sequence[Recording], *, warm: bool) -> tuple[JSON, list[RestStretch]]:
    """Return the document of a sensor's noise so far and its stretches, or no stretches and the reason.

    ``warm``: with the temperatures of static recordings, which only intervals need.
    """
    found = [r for r in recordings if r.role != "validation" and r.reading(sensor) is not None and r.samples > 1]
    empty: JSON = {"unit": SENSOR_UNITS[sensor], "source": None, "reason": None, "axes": None}
    known = [r for r in found if NOISE_OF_ROWS not in r.source and r.kind != "slow"]  # attitudes and movement
    if not known:
        return empty | {"reason": f"the recordings hold no readings of the {sensor}{' at rest' * bool(found)}"}, []
    even = [r for r in known if _scatter_of_intervals(r) <= MOST_JITTER]
    if not even:
        reason = f"the sampling intervals scatter by more than {MOST_JITTER:.0%}"
        return empty | {"reason": f"{reason}: equal counts of samples are not equal times"}, []
    static, others = ([r for r in even if (r.role == "static") == is_static] for is_static in (True, False))
    source, chosen, stretches = "static", static, [s for r in static for s in static_stretches(sensor, r, warm=warm)]
    if _samples(stretches) < MIN_SPECTRUM_SAMPLES and others:
        rests = [each for r in others for each in rest_readings(r, sensor, whole_recording=False)]
        stretches = [RestStretch(time, reading) for time, reading in rests if len(time) >= SHORTEST_STRETCH]
        source, chosen = "rests", others
    count = _samples(stretches)
    if count < MIN_SPECTRUM_SAMPLES:
        reason = f"the rests hold {count} evenly sampled readings; {MIN_SPECTRUM_SAMPLES} are needed: record static"
        return empty | {"reason": reason}, []
    intervals = np.array([(s.time[-1] - s.time[0]) / (len(s.time) - 1) for s in stretches])
    interval = float(np.median(intervals))
    even_steps = np.abs(intervals / interval - 1.0) < INTERVAL_TOLERANCE
    stretches = [s for s, used in zip(stretches, even_steps, strict=True) if used]
    document = empty | {
        "source": source,
        "recordings": [r.name for r in chosen],
        "samples": _samples(stretches),
        "sampling_interval_s": interval,
        "length_s": float(interval * max(len(s.time) for s in stretches)),
        "doubts": [DOUBT_OF_RESTS] if source == "rests" else [],
    }
    return document, stretches


@once_of_log
def _scatter_of_intervals(recording: Recording) -> float:
    """Return the rms scatter of the sampling intervals without gaps, relative."""
    steps = np.diff(recording.time_ns) / (1e9 * recording.interval)
    return float(np.sqrt(np.mean((steps[steps <= GAP_INTERVALS] - 1.0) ** 2)))


def _samples(stretches: Sequence[RestStretch]) -> int:
    return sum(len(s.time) for s in stretches)


def static_stretches(sensor: str, recording: Recording, *, warm: bool = True) -> list[RestStretch]:
    """Return the evenly sampled stretches of a static recording; straight lines fill gaps of up to ``LONGEST_FILL``."""
    values = recording.reading(sensor)
    assert values is not None  # noqa: S101
    good = np.flatnonzero(usable(recording, values))
    logged = recording.temperature
    warmth = temperature_of(recording) if warm and logged is not None and np.isfinite(logged).all() else None
    step = np.diff(recording.time[good]) / recording.interval
    steps = np.where(step > GAP_INTERVALS, np.rint(step), 1).astype(int)
    stretches = []
    for index in np.split(np.arange(len(good)), np.flatnonzero(steps > LONGEST_FILL) + 1):
        if len(index) < SHORTEST_STRETCH:
            continue
        place = np.concatenate([[0], np.cumsum(steps[index[:-1]])])
        grid, rows = np.arange(place[-1] + 1), good[index]
        reading = np.stack([np.interp(grid, place, values[rows, c]) for c in range(3)], axis=1)
        time = np.linspace(recording.time[rows[0]], recording.time[rows[-1]], len(grid))
        stretches.append(RestStretch(time, reading, None if warmth is None else np.interp(grid, place, warmth[rows])))
    return stretches


def _axes(regressions: Sequence[Regression]) -> list[JSON]:
    """Return the noise of axes with the same sampling, which are fitted together."""
    columns = [[r.columns(r.stretches[i]) for r in regressions] for i in range(len(regressions[0].stretches))]
    most = max(values.shape[1] for values in columns[0])  # an axis with fewer sinusoids has columns of zeros
    padded = [np.stack([np.pad(v, ((0, 0), (0, most - v.shape[1]))) for v in of_axes]) for of_axes in columns]
    spectrum = spectrum_of(padded, regressions[0].interval)
    searches = [CompositionSearch(spectrum, i) for i in range(len(regressions))]
    pairs = list(zip(searches, regressions, strict=True))
    best = solved(spectrum, at_once([best_of(s, r.required(), range(1, 1 + len(r.optional))) for s, r in pairs]))
    bounds = solved(spectrum, at_once([limits(spectrum, candidate) for candidate in best]))
    longest = [max(r.stretches, key=lambda s: len(s.time)).reading[:, r.column] for r in regressions]
    tau, measured = allan_deviation(np.stack(longest, axis=1), spectrum.interval, AVERAGES_PER_DECADE)
    shown = tau <= LONGEST_AVERAGE_SHARE * len(longest[0]) * spectrum.interval
    curves = [(tau[shown], curve[shown]) for curve in measured.T]
    of_axes = zip(pairs, best, bounds, curves, strict=True)
    return [_axis(r, s, candidate, bound, curve) for (s, r), candidate, bound, curve in of_axes]


def _axis(
    regression: Regression,
    search: CompositionSearch,
    best: FittedComposition,
    bounds: tuple[Values, dict[int, float]],
    measured: tuple[Values, Values],
) -> JSON:
    """Return the noise of one axis as published; ``bounds``: of ``limits``; ``measured``: tau and Allan deviation."""
    spectrum, unit, fit = search.spectrum, regression.unit, best.fit
    spread = 2.0 / (9.0 * spectrum.count)
    z = (np.cbrt(fit.power[0] / fit.total[0] / spectrum.count) - 1.0 + spread) / np.sqrt(spread)
    p_value = float(scipy.special.chdtrc(max(len(z) - len(best.kinds), 1), float(z @ z)))
    doubts = []
    if p_value < LEAST_FIT_PROBABILITY:
        doubts.append(f"no composition fits the spectrum (p = {p_value:.1g}): a filter, vibration or a disturbance")
    doubts += _coarse(regression.scale, regression.count, unit)
    candidates = sorted(search.found.values(), key=lambda c: c.bic)
    weight = np.exp(-0.5 * (np.array([c.bic for c in candidates]) - best.bic))
    probability = (weight / weight.sum()).tolist()
    present = _present(best, bounds[0], regression)
    seen = {term.name: term.to_json() for term in present}
    terms: dict[str, JSON] = {}
    for kind in SINGLE:
        name = STOCHASTIC[kind]
        limit = None if kind in best.kinds else regression.scale * float(np.sqrt(bounds[1][kind]))
        reason = _reason(kind, regression.names(best), spectrum)
        terms[name] = seen.get(name) or _unseen(unit_of(name, unit), reason, limit)
    processes = [(term.correlation_time_s.value, term) for term in present if term.correlation_time_s]
    per = {"ramp": regression.span, "temperature": 1.0}
    slopes = {name: _slope(regression, best, spectrum, name, size) for name, size in per.items()}
    sinusoids = _sinusoids(regression, best)
    ramp, _ = slopes["ramp"]
    others = [*([ramp] if ramp else []), *sinusoids]
    return {
        "terms": {
            **terms,
            STOCHASTIC[MARKOV]: [term.to_json() for _, term in sorted(processes, key=lambda pair: pair[0])],
            **{name: entry for name, (_, entry) in slopes.items()},
            "sinusoid": [term.to_json() for term in sinusoids],
        },
        "reason": None,
        "ranking": [
            {"terms": regression.names(c), "delta_bic": c.bic - best.bic, "probability": p}
            for c, p in list(zip(candidates, probability, strict=True))[:MOST_PUBLISHED]
        ],
        "p_value": p_value,
        "allan": _allan(*measured, best, present, others, spectrum),
        "doubts": doubts,
    }


def _coarse(scale: float, count: float, unit: str) -> list[str]:
    """Return a doubt if the readings are rounded more coarsely than their noise."""
    coarse = scale < COARSE_COUNTS * count
    return [f"the readings are rounded to {count:.3g} {unit}, which is coarser than their noise"] * coarse


def _stated(unit: str, stretches: Sequence[RestStretch], interval: float) -> JSON:
    """Return N, B and K of each axis by the Allan variances of octaves, without intervals."""
    readings = [s.reading for s in stretches]
    steps = np.concatenate([np.abs(np.diff(values, axis=0)) for values in readings])
    scale = np.sqrt(np.mean(steps**2, axis=0) / 2.0)
    counts = np.min(steps, axis=0, initial=np.inf, where=steps > 1e-9 * scale)
    del steps  # before the variances, which take the most memory
    tau, variance, freedom = octave_variances([values / np.maximum(scale, 1e-300) for values in readings], interval)
    squares, limits, sums = _fitted_octaves(tau, variance.T, freedom, sum(map(len, readings)))
    departure = np.abs(variance.T / np.maximum(sums, 1e-300) - 1.0) * np.sqrt(0.5 * freedom)
    axes: JSON = dict.fromkeys(AXES, CONSTANT_READINGS)
    for c in np.flatnonzero(np.isfinite(counts)).tolist():
        terms = {"temperature": _unseen(f"{unit}/degC", NOT_OF_A_RUN)}
        terms |= {name: _unseen(unit_of(name, unit), NOT_OF_A_RUN) for name in ("quantisation", "ramp")}
        for kind, square, limit in zip(N_B_K, squares[c], limits[c], strict=True):
            name, size = STOCHASTIC[kind], float(scale[c] * np.sqrt(square))
            absent = _unseen(unit_of(name, unit), NOT_SHOWN, float(scale[c] * np.sqrt(limit)))
            terms[name] = SeenTerm(name, Bounded(size, None), unit_of(name, unit)).to_json() if size else absent
        doubts = [OTHER_SPECTRUM] if departure[c].max() > MOST_DEPARTURE else []
        curves = {"tau_s": tau, "deviation": scale[c] * np.sqrt(variance[:, c]), "fit": scale[c] * np.sqrt(sums[c])}
        axes[AXES[c]] = {
            "terms": terms | {STOCHASTIC[MARKOV]: [], "sinusoid": []},
            "reason": None,
            "ranking": [],
            "p_value": None,
            "allan": _rounded(curves) | {"low": None, "high": None},
            "doubts": [*doubts, *_coarse(float(scale[c]), float(counts[c]), unit)],
        }
    return axes


def _fitted_octaves(tau: Values, variance: Values, freedom: Values, samples: int) -> tuple[Values, Values, Values]:
    """Return N^2, B^2 and K^2 of each axis, 0 where absent, upper limits of absent ones, and the sums of the terms.

    ``variance``: (a, m). Returns (a, 3), (a, 3) and (a, m) arrays. Each set of terms is fitted by Fisher scoring.
    """
    shapes = np.stack([allan_variance(STOCHASTIC[kind], 1.0, tau) for kind in N_B_K])

    def solved_sets(sums: Values, sets: Values) -> tuple[Values, Values]:
        """Return squares and their covariance, (..., 3) and (..., 3, 3); ``sums``: (..., m), by which to weight."""
        relative = np.where(sets[..., None], shapes, 0.0) / sums[..., None, :]
        information = 0.5 * (relative * freedom) @ relative.swapaxes(-1, -2)
        np.einsum("...jj->...j", information)[...] += np.where(sets, 0.0, 1.0)
        covariance = np.asarray(np.linalg.inv(information), np.float64)
        ratio = variance[:, None] / sums
        return (covariance @ (0.5 * (relative * freedom) @ ratio[..., None]))[..., 0], covariance

    sums = np.repeat(variance[:, None], len(TERM_SETS), axis=1)
    for _ in range(SCORINGS):
        squares, _ = solved_sets(sums, TERM_SETS)
        sums = np.maximum(squares, LEAST_SHARE * variance.min(axis=1)[:, None, None]) @ shapes
    loss = np.sum(freedom * (np.log(sums) + variance[:, None] / sums), axis=2) + np.log(samples) * TERM_SETS.sum(axis=1)
    loss[np.any((squares <= 0.0) & TERM_SETS, axis=2)] = np.inf
    rows, best = np.arange(len(variance)), np.argmin(loss, axis=1)
    squares, sums = np.where(TERM_SETS[best], squares[rows, best], 0.0), sums[rows, best]
    more, covariance = solved_sets(sums[:, None], TERM_SETS[best][:, None] | np.eye(3, dtype=bool))
    spread = np.sqrt(np.einsum("ajkk->ajk", covariance))
    limits = np.einsum("ajj->aj", np.maximum(more, 0.0) + ONE_SIDED * spread)
    return squares, limits, sums


def _present(best: FittedComposition, within: Values, regression: Regression) -> list[SeenTerm]:
    """Return the stochastic terms of a composition; ``within``: intervals of the parameters."""
    n, terms = len(best.kinds), []
    for j, kind in enumerate(best.kinds):
        size = regression.scale * float(np.exp(0.5 * best.parameters[j]))
        coefficient = Bounded(size, (regression.scale * np.exp(0.5 * within[:, j])).tolist())
        time = None
        if kind == MARKOV:
            time = Bounded(float(np.exp(best.parameters[n + j])), np.exp(within[:, n + j]).tolist())
        terms.append(SeenTerm(STOCHASTIC[kind], coefficient, unit_of(STOCHASTIC[kind], regression.unit), time))
    return terms


def _allan(  # noqa: PLR0917  (the curve and its terms)
    tau: Values,
    measured: Values,
    best: FittedComposition,
    present: Sequence[SeenTerm],
    deterministic: Sequence[SeenTerm],
    spectrum: Spectrum,
) -> JSON:
    """Return the Allan deviation of the readings, and that of the terms with its 95 % band.

    The band is that of the logarithm, from the covariance of the terms: the parameters of the stochastic terms are
    logarithms of squared coefficients, and the derivative of the total by such a parameter is the variance of the term.
    """
    by_size, by_time = np.zeros((2, best.fit.kinds.shape[1], len(tau)))
    for j, (kind, term) in enumerate(zip(best.kinds, present, strict=True)):
        by_size[j] = term.allan_variance(tau)
        if kind == MARKOV:
            by_time[j] = (term.allan_variance(tau, DERIVATIVE_STEP) - by_size[j]) / np.log(DERIVATIVE_STEP)
    others = [(term.coefficient, term.allan_variance(tau)) for term in deterministic]
    total = by_size.sum(axis=0) + np.sum([np.zeros(len(tau)), *(part for _, part in others)], axis=0)
    jacobian = np.concatenate([by_size, by_time]) / total
    covariance = best.fit.covariance(spectrum.count)[0]
    variance = np.maximum(np.einsum("it,ij,jt->t", jacobian, covariance, jacobian), 0.0)
    for coefficient, part in others:  # by the interval of the coefficient
        low, high = coefficient.interval or (np.nan, np.nan)
        variance += (part / total * (high - low) / coefficient.value / QUANTILE) ** 2
    half, fit = 0.5 * QUANTILE * np.sqrt(variance), np.sqrt(total)
    band = {"low": fit * np.exp(-half), "high": fit * np.exp(half)}
    return _rounded({"tau_s": tau, "deviation": measured, "fit": fit, **band})


def _rounded(curves: Mapping[str, Values]) -> JSON:
    return {name: [float(f"{v:.5g}") for v in values] for name, values in curves.items()}


def _reason(kind: int, names: Sequence[str], spectrum: Spectrum) -> str:
    """Return why a term is not in a composition of these names."""
    slow = [name for name in names if name in SLOW_TERMS]
    if kind < WHITE or slow:
        others = [name.replace("_", " ") for name in dict.fromkeys(slow if kind > WHITE else names)]
        return f"not detected in the presence of {' and '.join(others)}"
    return (
        f"the recording is too short: over its {spectrum.length:.3g} s the Allan deviation falls like that of white "
        f"noise up to averaging times of {LONGEST_AVERAGE_SHARE * spectrum.length:.3g} s"
    )


def _sinusoids(regression: Regression, best: FittedComposition) -> list[SeenTerm]:
    """Return the sinusoids of the most probable composition."""
    beta, covariance = best.fit.beta[0], best.fit.beta_covariance[0]
    sinusoids = []
    for j, line in zip(range(len(regression.optional), len(beta), 3), regression.lines, strict=False):
        size = float(np.hypot(line.a, line.b))
        direction = np.array([line.a, line.b]) / size
        spread = float(np.sqrt(direction @ covariance[j : j + 2, j : j + 2] @ direction))
        amplitude = Bounded.of(regression.scale * float(np.hypot(*beta[j : j + 2])), regression.scale * spread)
        of_frequency = float(np.sqrt(covariance[j + 2, j + 2])) / (regression.span * size)
        frequency = Bounded.of(line.frequency, of_frequency)
        sinusoids.append(SeenTerm("sinusoid", amplitude, regression.unit, frequency_hz=frequency))
    return sinusoids


def _slope(
    regression: Regression, best: FittedComposition, spectrum: Spectrum, name: str, per: float
) -> tuple[SeenTerm | None, JSON]:
    """Return the term of a deterministic column, if it is seen, and its entry; the column is ``per`` times its unit."""
    unit = f"{regression.unit}/degC" if name == "temperature" else unit_of(name, regression.unit)
    if name not in regression.optional:
        return None, _unseen(unit, NOT_FITTED[name])
    column = 1 + regression.optional.index(name)
    columns = tuple(sorted({*best.columns, column}))
    fit = evaluate(spectrum, [TermTrial(int(best.fit.axis[0]), best.kinds, columns, best.parameters)])
    value = regression.scale / per * float(fit.beta[0, column - 1])
    spread = regression.scale / per * float(np.sqrt(fit.beta_covariance[0, column - 1, column - 1]))
    if column in best.columns:
        term = SeenTerm(name, Bounded.of(value, spread), unit)
        return term, term.to_json()
    return None, _unseen(unit, "not seen", abs(value) + ONE_SIDED * spread)
