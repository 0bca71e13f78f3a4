"""Test on which covariates the residual depends, given base, configured and selected effects.

    temperature, time, |omega| : Chebyshev polynomials of degree 1 to d over their span, d = 2 to 5
    angle                      : cos and sin of n periods a turn, n = 3 to 8, one n and all of them
    specific_force             : Chebyshev polynomials of degree 3 to 5 of one component, and of all

If effects were selected or the residual exceeds white noise, further tests are a step at one of 16 places of the span
of temperature, time and |omega|, sharp or soft, and for a gyroscope n = 2 to 8 periods in proportion to the rate. The
residual depends on a covariate if one of its tests has delta BIC > 10 and m p < 1e-3, with m the number of all tests,
also without the constraint of the noise by a static recording. The curves take no part in a selection, since a flexible
curve would win against physics in its first round.

Goodness of fit is the share of simulations from the fitted model that fit worse than the readings by

    T = min over the smooth curves above of p(2 log L' - 2 log L)

The whitened linear model is fitted to the residual and to draws from the noise of the fit, under every noise setting.
So the share allows for the number of tests and for the noise estimate of each fit (a parametric bootstrap: Davison and
Hinkley, Bootstrap Methods and their Application, 1997, section 4.2).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
from numpy.polynomial.chebyshev import chebvander

from pipeline.core.records import Dependence
from pipeline.estimation.design import CURVE_DEGREE, MAX_CURVE_CYCLES
from pipeline.estimation.gates import MAX_FALSE_DEPENDENCE, MIN_DELTA_BIC
from pipeline.estimation.gauss_markov import GaussMarkov, selection_grid
from pipeline.evaluation.diagnosis.functional_forms import Span, available_signals, signals_of
from pipeline.evaluation.diagnosis.residual_regression import Curves, ProjectedCurves, Scan, each_explains
from pipeline.physics.effects import effect

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from pipeline.core.records import Index, Motion, Values
    from pipeline.estimation.selection import Selection

    Block = tuple[Sequence[int], int]  # curves that are tried together: the first so many of them, and each further one
    Basis = tuple[str, Callable[[Motion], Values], list[Block]]  # covariate, its curves by motion: (n, q), and blocks
    Tests = tuple[list[str], Values, Index]  # covariate, delta BIC and number of parameters of each test

MIN_CYCLES = 3  # periods a turn: one and two look like base and catalogue
LEAST_RIPPLE = 2  # periods a turn; the catalogue contains one
STEP_POSITIONS = 16  # of steps: the nearest one is within 1/32 of the span
# of the gain by effects of time or temperature: less may be the error of a smoothed temperature
MAX_SHARE_OF_LINEARISATION = 0.05
RESIDUAL_OVER_NOISE = 1.1  # times the white noise: a larger residual may contain a step
SIGNAL_OF_COVARIATE = {
    "time": "time",
    "temperature": "temperature",
    "rate": "speed",
}  # of covariates, for steps and polynomials
SIMULATIONS = 199  # standard error of the share: 3.5 % at most


def dependences(selection: Selection, explained: Curves | None = None) -> list[Dependence]:
    """Return the covariates on which the residual depends, the clearest first.

    ``explained``: curves that are projected out too.
    """
    found = _significant(selection, explained)
    if any(effect(name).uses_time_or_temperature for name in selection.names):
        least = MAX_SHARE_OF_LINEARISATION * 2.0 * (selection.fit.log_likelihood - selection.base.log_likelihood)
        found = {k: v for k, v in found.items() if v[0] > least or k not in ("temperature", "time")}
    if found and any(setting.prior for setting in selection.settings):
        least = min(setting.prior for setting in selection.settings)
        free = [setting._replace(prior=least) for setting in selection_grid(None)]
        unconstrained = _significant(replace(selection, settings=[*selection.settings, *free]), explained)
        found = {name: values for name, values in unconstrained.items() if name in found}
    return [Dependence(name, p, delta) for name, (delta, p) in found.items()]


def significant(tests: Iterable[tuple[str, float, float]]) -> dict[str, tuple[float, float]]:
    """Return delta BIC and p-value of the best test in each covariate that passes the gate, the clearest first.

    ``tests``: covariate, delta BIC and p-value of each.
    """
    tests = sorted(tests, key=lambda test: -test[1])
    best: dict[str, tuple[float, float]] = {}
    for covariate, delta, p in tests:
        if delta > MIN_DELTA_BIC and p * len(tests) < MAX_FALSE_DEPENDENCE:
            best.setdefault(covariate, (delta, p))
    return best


def _significant(selection: Selection, explained: Curves | None) -> dict[str, tuple[float, float]]:
    """Return the significant covariates of a selection; see ``significant``."""
    scan, bases = Scan(selection, explained), _bases_of(selection)
    tests = [_tests_of_curves(bases, scan)]
    if selection.names or selection.fit.residual_rms > RESIDUAL_OVER_NOISE * float(
        np.sqrt(np.mean(selection.start.scale**2))
    ):
        tests.append(_tests_of_steps(selection, [covariate for covariate, _, _ in bases], scan))
    names = [name for of_kind, _, _ in tests for name in of_kind]
    delta, parameters = (np.concatenate([test[k] for test in tests]) for k in (1, 2))
    p = scipy.special.chdtrc(parameters, np.maximum(delta + parameters * np.log(scan.samples), 0.0))
    return significant(zip(names, delta.tolist(), p.tolist(), strict=True))


def _tests_of_curves(bases: Sequence[Basis], scan: Scan) -> Tests:
    projected = ProjectedCurves(scan, _curves_of(bases))
    names: list[str] = []
    counts: list[int] = []
    drops = [np.zeros((*scan.left.shape, 0))]
    for covariate, independent, least in _independent(bases, projected):
        drops.append(projected.drop(independent)[:, :, least - 1 :])
        counts += range(least, len(independent) + 1)
        names += [covariate] * (len(independent) + 1 - least)
    parameters = 3 * np.array(counts, int)
    return names, scan.gains(np.concatenate(drops, axis=2), parameters), parameters


def _tests_of_steps(selection: Selection, covariates: Sequence[str], scan: Scan) -> Tests:
    """Return the tests with steps and with periods in proportion to the rate."""
    observations = selection.observations
    names: list[str] = []
    scanned: list[tuple[str, Values]] = []
    for covariate, signal in SIGNAL_OF_COVARIATE.items():
        if covariate in covariates:
            places = Span.of(observations, signal).places()
            every = max(1, len(places) // STEP_POSITIONS)
            scanned.append((signal, places[every // 2 :: every]))
            names += [covariate] * 2 * len(scanned[-1][1])
    steps = len(names)
    ripples = (
        (MAX_CURVE_CYCLES - LEAST_RIPPLE + 1) if observations.sensor == "gyroscope" and "angle" in covariates else 0
    )

    def curves(motion: Motion) -> Values:
        signals, columns = signals_of(motion), []
        for signal, places in scanned:
            above = np.asarray(signals[signal])[:, None] - places
            columns += [(above >= 0).astype(float), np.tanh(above / (np.ptp(places) / STEP_POSITIONS + 1e-12))]
        if ripples:
            rate = np.zeros(len(motion.time)) if motion.rate is None else motion.rate
            columns.append(rate[:, None] * _harmonics(motion, LEAST_RIPPLE))
        return np.concatenate(columns, axis=1)[:, None]

    values = scan.values(curves)
    pairs = values[:, :, steps:].reshape(len(values), 1, 2, ripples).swapaxes(2, 3)  # cosine and sine of each
    of_pairs = scan.drops(pairs)
    of_pairs = of_pairs[:, :, np.any(of_pairs, axis=(0, 1))]
    drops = np.concatenate([scan.drops(values[:, :, :steps, None]), of_pairs], axis=2)
    parameters = np.repeat([4, 6], [steps, of_pairs.shape[2]])
    return names + ["angle"] * of_pairs.shape[2], scan.gains(drops, parameters), parameters


def goodness_of_fit(selection: Selection) -> dict[str, Any]:
    """Return ``share_worse``, the share of simulations that fit worse, and ``simulations``, their number."""
    bases, observations, scan = _bases_of(selection), selection.observations.less_stop_errors, Scan(selection)
    fitted = ProjectedCurves(scan, _curves_of(bases))
    within = np.append(scan.within, np.full(SIMULATIONS, 3.0 * (observations.samples - len(observations.weight))))
    left, cross = np.zeros((len(scan.left), 1 + SIMULATIONS)), []  # of the readings and each simulation
    for c, drawn in enumerate(_draws(selection)):
        draws = scan.whitened(scan.scale[c] * drawn)
        left[:, 0] += scan.left[:, c]
        left[:, 1:] += np.einsum("tss->ts", scan.without_model(c, draws, draws))[1:]
        of_draws = scan.without_model(c, fitted.columns[0], draws)[1:]
        cross.append(np.concatenate([fitted.cross[:, c, :, None], of_draws], axis=2))

    def likelihood(rss: Values) -> Values:
        return np.asarray(scan.log_likelihood(rss, within).max(axis=0))

    before, smallest_p = likelihood(left), np.ones(1 + SIMULATIONS)
    for _, index, least in _independent(bases, fitted):
        drop = np.zeros((len(left), len(index), 1 + SIMULATIONS))
        for c, products in enumerate(cross):
            inner, error = fitted.inner[:, c, index][:, :, index], fitted.error[:, c, index]
            drop += np.cumsum(each_explains(inner, products[:, index], error)[0], axis=1)
        gain = np.maximum(2.0 * (likelihood(left[:, None] - drop) - before), 0.0)
        p = scipy.special.chdtrc(3 * np.arange(1, len(index) + 1)[:, None], gain)
        smallest_p = np.minimum(smallest_p, p[least - 1 :].min(axis=0))
    return {"share_worse": float(np.mean(smallest_p[1:] <= smallest_p[0])), "simulations": SIMULATIONS}


def _draws(selection: Selection) -> Values:
    """Return draws from the noise of the fit, in units of the white noise of one sample: (3, n, s) array."""
    observations, rng = selection.observations.less_stop_errors, np.random.default_rng(0)
    blocks, weight = observations.blocks, observations.weight
    label, noise = blocks.label(len(weight)), GaussMarkov(blocks, [selection.fit.setting])
    found = []
    for _ in range(3):
        white = rng.standard_normal((len(weight), SIMULATIONS)) / np.sqrt(weight)[:, None]
        mean = blocks.sums(weight[:, None] * white) / blocks.weight[:, None]
        found.append(white + (noise.draw(rng, SIMULATIONS) - mean)[label])
    return np.stack(found)


def _curves_of(bases: Sequence[Basis]) -> Curves:
    """Return the curves of all covariates together."""
    return lambda motion: np.concatenate([curves(motion) for _, curves, _ in bases], axis=1)[:, None]


def _independent(bases: Sequence[Basis], projected: ProjectedCurves) -> Iterator[tuple[str, list[int], int]]:
    """Yield covariate, independent curves and least number of each block with at least as many independent curves.

    ``projected`` holds ``_curves_of(bases)``.
    """
    first = 0
    for covariate, _, blocks in bases:
        for block, least in blocks:
            independent = projected.independent(first + np.asarray(block))
            if len(independent) >= least:
                yield covariate, independent, least
        first += 1 + max(max(block) for block, _ in blocks)


def _bases_of(selection: Selection) -> list[Basis]:
    """Return the covariates that the recordings hold, with the curves and blocks of each."""
    observations = selection.observations
    components: list[Block] = [(range(3 * i, 3 * i + 3), 3) for i in range(3)]
    bases: list[Basis] = [("specific_force", _force, [*components, (range(9), 9)])]
    available = available_signals(observations)
    for covariate, signal in SIGNAL_OF_COVARIATE.items():
        if signal in available:
            bases.append((covariate, _chebyshev(Span.of(observations, signal)), [(range(CURVE_DEGREE), 2)]))
    if any(part.motion.axis is not None for part in observations.parts):
        count = MAX_CURVE_CYCLES - MIN_CYCLES + 1
        single: list[Block] = [((j, count + j), 2) for j in range(count)]
        bases.append(("angle", _harmonics, [*single, (range(2 * count), 2 * count)]))
    return bases


def _chebyshev(span: Span) -> Callable[[Motion], Values]:
    """Return the function from motion to Chebyshev polynomials of degree 1 to 5 of a signal over its span."""

    def curves(motion: Motion) -> Values:
        x = 2.0 * (np.asarray(signals_of(motion)[span.signal]) - span.low) / span.size - 1.0
        return np.asarray(chebvander(x, CURVE_DEGREE)[:, 1:], np.float64)

    return curves


def _harmonics(motion: Motion, fewest: int = MIN_CYCLES) -> Values:
    """Return cos and sin of the table's angle times ``fewest`` to 8: (n, 2 m) array."""
    if motion.angle is None:
        return np.zeros((len(motion.time), 2 * (MAX_CURVE_CYCLES - fewest + 1)))
    turns = np.radians(motion.angle)[:, None] * np.arange(fewest, MAX_CURVE_CYCLES + 1)
    return np.concatenate([np.cos(turns), np.sin(turns)], axis=1)


def _force(motion: Motion) -> Values:
    """Return Chebyshev polynomials of degree 3 to 5 of each component of the specific force: (n, 9) array."""
    scaled = motion.specific_force / max(float(np.abs(motion.specific_force).max()), 1.0)
    return np.concatenate([chebvander(scaled[:, i], CURVE_DEGREE)[:, 3:] for i in range(3)], axis=1)
