"""On which covariates the residual still depends, given base, configured and selected effects.

    temperature, time, |omega| : Chebyshev polynomials of degree 1 to d over their span, d = 2 to 5
    angle                      : cos and sin of n periods a turn, n = 3 to 8, one n and all of them
    specific_force             : Chebyshev polynomials of degree 3 to 5 of one component, and of all

are tried; where effects were selected or the residual is above white noise, a step at one of 16 places of the span of
temperature, time and |omega|, sharp or soft, and for a gyroscope n = 2 to 8 periods in proportion to the rate. A
covariate is named where one of its tests has delta BIC > 10 and m p < 1e-3, m the number of all tests, and has it too
where the noise is not constrained by a static recording. A flexible curve would win against physics in the first round
of a selection, so the curves never take part in it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.polynomial.chebyshev import chebvander

from pipeline.diagnosis.functional_forms import Span, signals_of
from pipeline.diagnosis.residual_regression import Curves, ProjectedCurves, Scan
from pipeline.estimation.gauss_markov import selection_grid
from pipeline.estimation.selection import GATE_BIC
from pipeline.model.effects import effect

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from pipeline.estimation.selection import Selection
    from pipeline.records import Index, Motion, Values

    Block = tuple[Sequence[int], int]
    Basis = tuple[str, Curves, list[Block]]
    Tests = tuple[list[str], Values, Index]

GATE_P = 1e-3  # probability of naming a covariate of a complete model, over all tests (Bonferroni)
DEGREE = 5  # up to four turning points over the span; faster changes are steps
FEWEST, MOST = 3, 8  # periods a turn: one and two look like base and catalogue
LEAST_RIPPLE = 2  # one is an effect of the catalogue
PLACES = 16  # of a test for a step: the nearest one is within 1/32 of the span
EQUATION = 0.05  # of what effects of time or temperature gain: less may be due to a smoothed temperature where it turns
ABOVE = 1.1  # times the white noise: a residual that may hold something sudden
SIGNALS = {"temperature": "temperature", "time": "time", "rate": "speed"}  # of covariates in which steps are tried


def dependences(selection: Selection, explained: Curves | None = None) -> list[tuple[str, float, float]]:
    """Return the covariates on which the residual depends, with p-value and delta BIC, the likeliest first.

    Curves ``explained`` (motion to (n, m) values) count as explained.
    """
    found = _significant(selection, explained)
    if any(effect(name).uses_time_or_temperature for name in selection.names):
        least = EQUATION * 2.0 * (selection.fit.log_likelihood - selection.base.log_likelihood)
        found = {k: v for k, v in found.items() if v[0] > least or k not in ("temperature", "time")}
    if found and any(setting.prior for setting in selection.settings):
        least = min(setting.prior for setting in selection.settings)
        free = [replace(setting, prior=least) for setting in selection_grid(None)]
        freely = _significant(replace(selection, settings=[*selection.settings, *free]), explained)
        found = {name: values for name, values in freely.items() if name in found}
    return [(name, p, delta) for name, (delta, p) in sorted(found.items(), key=lambda item: -item[1][0])]


def _significant(selection: Selection, explained: Curves | None) -> dict[str, tuple[float, float]]:
    """Return delta BIC and p-value of the best test in each covariate that passes the gate."""
    scan = Scan(selection, explained)
    tests = [_smooth_tests(selection, scan)]
    if selection.names or selection.fit.residual_rms > ABOVE * float(np.sqrt(np.mean(selection.start.scale**2))):
        tests.append(_step_tests(selection, scan))
    count = sum(len(names) for names, _, _ in tests)
    found: dict[str, tuple[float, float]] = {}
    for names, delta, parameters in tests:
        p = scipy.special.chdtrc(parameters, np.maximum(delta + parameters * np.log(scan.samples), 0.0))
        for k in np.argsort(delta):
            if delta[k] > GATE_BIC and p[k] * count < GATE_P and delta[k] > found.get(names[k], (0.0, 0.0))[0]:
                found[names[k]] = (float(delta[k]), float(p[k]))
    return found


def _smooth_tests(selection: Selection, scan: Scan) -> Tests:
    """Return covariate, delta BIC and number of parameters of each test with smooth curves."""
    bases = bases_of(selection)
    projected = ProjectedCurves(scan, curves_of(bases))
    names: list[str] = []
    counts: list[int] = []
    drops = [np.zeros((*scan.left.shape, 0))]
    for covariate, kept, least in smooth_tests(bases, projected):
        drops.append(projected.drop(kept)[:, :, least - 1 :])
        counts += range(least, len(kept) + 1)
        names += [covariate] * (len(kept) + 1 - least)
    parameters = 3 * np.array(counts, int)
    return names, scan.gains(np.concatenate(drops, axis=2), parameters), parameters


def _step_tests(selection: Selection, scan: Scan) -> Tests:
    """Return the same of the tests with steps and ripples."""
    observations = selection.observations
    held = [name for name, _, _ in bases_of(selection)]
    names: list[str] = []
    scanned: list[tuple[str, Values]] = []
    for covariate, signal in SIGNALS.items():
        if covariate in held:
            places = Span.of(observations, signal).places()
            every = max(1, len(places) // PLACES)
            scanned.append((signal, places[every // 2 :: every]))
            names += [covariate] * 2 * len(scanned[-1][1])
    steps = len(names)
    ripples = (MOST - LEAST_RIPPLE + 1) if observations.sensor == "gyroscope" and "angle" in held else 0

    def curves(motion: Motion) -> Values:
        signals, columns = signals_of(motion), []
        for signal, places in scanned:
            above = np.asarray(signals[signal])[:, None] - places
            columns += [(above >= 0).astype(float), np.tanh(above / (np.ptp(places) / PLACES + 1e-12))]
        if ripples:
            rate = np.zeros(len(motion.time)) if motion.rate is None else motion.rate
            columns.append(rate[:, None] * _harmonics(motion, LEAST_RIPPLE))
        return np.concatenate(columns, axis=1)

    values = scan.values(curves)[:, 0]
    pairs = values[:, steps:].reshape(len(values), 2, ripples).swapaxes(1, 2)  # cosine and sine of each
    of_pairs = scan.drops(pairs)
    of_pairs = of_pairs[:, :, np.any(of_pairs, axis=(0, 1))]
    drops = np.concatenate([scan.drops(values[:, :steps, None]), of_pairs], axis=2)
    parameters = np.repeat([4, 6], [steps, of_pairs.shape[2]])
    return names + ["angle"] * of_pairs.shape[2], scan.gains(drops, parameters), parameters


def curves_of(bases: Sequence[Basis]) -> Curves:
    """Return what evaluates the curves of all covariates, those of each after those of the one before."""
    return lambda motion: np.concatenate([curves(motion) for _, curves, _ in bases], axis=1)


def smooth_tests(bases: Sequence[Basis], projected: ProjectedCurves) -> Iterator[tuple[str, list[int], int]]:
    """Yield covariate, independent curves and ``least`` of each block in which as many as that are independent.

    ``projected`` holds ``curves_of(bases)``.
    """
    at = 0
    for covariate, _, blocks in bases:
        for block, least in blocks:
            kept = projected.independent(at + np.asarray(block))
            if len(kept) >= least:
                yield covariate, kept, least
        at += 1 + max(max(block) for block, _ in blocks)


def bases_of(selection: Selection) -> list[Basis]:
    """Return covariates that the recordings hold, the curves of each, and which of these are tried together.

    A block is tried with its first ``least`` curves, and with each further one.
    """
    observations = selection.observations
    motions = [part.motion for part in observations.parts]
    degrees: list[Block] = [(range(DEGREE), 2)]
    components: list[Block] = [(range(3 * i, 3 * i + 3), 3) for i in range(3)]
    bases: list[Basis] = [("specific_force", _force, [*components, (range(9), 9)])]
    if observations.clock_shared:
        bases.append(("time", _chebyshev(Span.of(observations, "time")), degrees))
    if all(m.temperature is not None for m in motions):
        bases.append(("temperature", _chebyshev(Span.of(observations, "temperature")), degrees))
    if any(np.any(~m.still) for m in motions):
        bases.append(("rate", _chebyshev(Span.of(observations, "speed")), degrees))
    if any(m.axis is not None for m in motions):
        count = MOST - FEWEST + 1
        single: list[Block] = [((j, count + j), 2) for j in range(count)]
        bases.append(("angle", _harmonics, [*single, (range(2 * count), 2 * count)]))
    return bases


def _chebyshev(span: Span) -> Curves:
    """Return what evaluates Chebyshev polynomials of degree 1 to 5 of a signal over its span."""

    def curves(motion: Motion) -> Values:
        x = 2.0 * (np.asarray(signals_of(motion)[span.signal]) - span.low) / span.size - 1.0
        return np.asarray(chebvander(x, DEGREE)[:, 1:], np.float64)

    return curves


def _harmonics(motion: Motion, fewest: int = FEWEST) -> Values:
    """Return cos and sin of the table's angle times ``fewest`` to 8: (n, 2 m) array."""
    if motion.angle is None:
        return np.zeros((len(motion.time), 2 * (MOST - fewest + 1)))
    turns = np.radians(motion.angle)[:, None] * np.arange(fewest, MOST + 1)
    return np.concatenate([np.cos(turns), np.sin(turns)], axis=1)


def _force(motion: Motion) -> Values:
    """Return Chebyshev polynomials of degree 3 to 5 of each component of the specific force: (n, 9) array."""
    scaled = motion.specific_force / max(float(np.abs(motion.specific_force).max()), 1.0)
    return np.concatenate([chebvander(scaled[:, i], DEGREE)[:, 3:] for i in range(3)], axis=1)
