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

Compute the plots of a diagnosis, binned to a few points.

The added-variable plot shows one coefficient gamma of an effect with the column x, on one axis (Frisch, Waugh, Lovell):

    x~ = x - X delta,    delta = (X^T C^-1 X)^-1 X^T C^-1 x,    y~ = gamma x~ + r - w

with all other columns X of the model, white noise plus bias wander C, the residual r of the fit and the wander w that
it implies, ``E[w | r]``. The least-squares line through (x~, y~) has the slope gamma, since ``x~^T C^-1 r = 0``. For
rests by hand, x and r are whitened, a point is a rest, and both are multiplied by the median white error of a rest.

The other plot shows the residual against the covariate on which it depends. If a functional form g is suggested, the
residual is that of a fit of base and g, to which g is added again: the points scatter about the curve.

Source: R. D. Cook and S. Weisberg, Residuals and Influence in Regression, 1982, section 2.3.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from copy import copy
from typing import Any

import numpy as np
import scipy
from numpy.polynomial.chebyshev import chebvander

from pipeline.core.files import JSON
from pipeline.core.records import BASE_COUNT, Dependence, Index, Motion, Noise, Values
from pipeline.estimation.design import EffectColumns, placed
from pipeline.estimation.gates import MAX_FALSE_DEPENDENCE, MIN_DELTA_BIC
from pipeline.estimation.gauss_markov import Blocks, Products, Setting, selection_grid
from pipeline.estimation.multi_position import selection as by_hand
from pipeline.estimation.multi_position.fit import solve
from pipeline.estimation.observations import Observations
from pipeline.estimation.ranking import by_size, projection
from pipeline.estimation.selection import Selection
from pipeline.evaluation.diagnosis.form_scan import ProjectedCurves, Scan, Whitened, each_explains
from pipeline.evaluation.diagnosis.functional_forms import Curves, Span, available_signals, columns_of, signals_of
from pipeline.physics.effects import effect
from pipeline.physics.effects.base import Layout, unit_of
from pipeline.physics.effects.equations import CURVE_DEGREE, MAX_CURVE_CYCLES
from pipeline.physics.formula import parse

Block = tuple[Sequence[int], int]  # curves that are tried together: the first so many of them, and each further one
Basis = tuple[str, Callable[[Motion], Values], list[Block]]  # covariate, its curves by motion: (n, q), and blocks
Tests = tuple[list[str], Values, Index]  # covariate, delta BIC and number of parameters of each test

MIN_CYCLES = 3  # periods a turn: one and two look like base and catalogue
LEAST_RIPPLE = 2  # periods a turn; the catalogue contains one
STEP_POSITIONS = 16  # of steps: the nearest one is within 1/32 of the span
# of the gain by effects of time or temperature: less may be the error of a smoothed temperature
MAX_SHARE_OF_LINEARISATION = 0.05
RESIDUAL_OVER_NOISE = 1.1  # times the white noise: a larger residual may contain a step
# of covariates, for steps and polynomials
SIGNAL_OF_COVARIATE = {"time": "time", "temperature": "temperature", "rate": "speed"}
SIMULATIONS = 199  # standard error of the share: 3.5 % at most
NO_CHANCE = 1e-40  # p of the readings, below that of any simulation: the smallest of 3,781 was 5e-14
OWN_BASE_COLUMNS = 4  # columns of the base on each axis
RANK_OF_RESTS = 1e-8  # of singular values: columns that are the same to rounding
PLOT_BINS = 40  # points that are distinct in a plot
PLOT_DIGITS = 5  # more than a plot shows
CURVE = 60  # points of the curve of a suggested form
MIN_INFORMATION_SHARE = 0.01  # of the information on a shared coefficient; an axis with less is not shown
# least share of a column's power in the rests; below it, a plot of rests does not show the effect
MIN_REST_POWER_SHARE = 0.9
MAX_PLOTS = 3  # plots of dependences
ABSCISSA_SIGNALS = {"rate": "speed", "specific_force": "u"}  # abscissa of a covariate without a form, if not itself


def dependences(selection: Selection, explained: Curves | None = None) -> list[Dependence]:
    """Return the covariates on which the residual depends, the clearest first.

    ``explained``: curves that are projected out too.
    """
    scan = Scan(selection, explained)
    found = _significant(selection, scan)
    if any(effect(name).uses_time_or_temperature for name in selection.names):
        least = MAX_SHARE_OF_LINEARISATION * 2.0 * (selection.fit.log_likelihood - selection.base.log_likelihood)
        found = {k: v for k, v in found.items() if v[0] > least or k not in ("temperature", "time")}
    least = min(setting.prior for setting in selection_grid(selection.noise))
    if found and least:
        free = [setting._replace(prior=least) for setting in selection_grid(None)]
        unconstrained = _significant(selection, scan.under([*selection.settings, *free]))
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


def _significant(selection: Selection, scan: Scan) -> dict[str, tuple[float, float]]:
    """Return the significant covariates of a selection; see ``significant``."""
    bases = _bases_of(selection)
    curves = ProjectedCurves(scan, scan.values(_curves_of(bases)))
    tests, white = [_tests_of_curves(bases, scan, curves)], float(np.sqrt(np.mean(selection.start.scale**2)))
    if selection.names or selection.fit.residual_rms > RESIDUAL_OVER_NOISE * white:
        tests.append(_tests_of_steps(selection, [covariate for covariate, _, _ in bases], scan))
    names = [name for of_kind, _, _ in tests for name in of_kind]
    delta, parameters = (np.concatenate([test[k] for test in tests]) for k in (1, 2))
    p = scipy.special.chdtrc(parameters, np.maximum(delta + parameters * np.log(scan.samples), 0.0))
    return significant(zip(names, delta.tolist(), p.tolist(), strict=True))


def _tests_of_curves(bases: Sequence[Basis], scan: Scan, projected: ProjectedCurves) -> Tests:
    """Return the tests with the smooth curves, ``projected``."""
    tests = [*_independent(bases, projected)]
    drops = [np.zeros((*scan.left.shape, 0))] * len(tests)
    for of_size in by_size(len(index) for _, index, _ in tests):
        together = projected.drop([tests[k][1] for k in of_size])
        for k, each in zip(of_size, np.moveaxis(together, 2, 0), strict=True):
            drops[k] = each[:, :, tests[k][2] - 1 :]
    names = [covariate for covariate, index, least in tests for _ in range(least, len(index) + 1)]
    parameters = 3 * np.array([count for _, index, least in tests for count in range(least, len(index) + 1)], int)
    return names, scan.gains(np.concatenate([np.zeros((*scan.left.shape, 0)), *drops], axis=2), parameters), parameters


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
    rippled = observations.sensor == "gyroscope" and "angle" in covariates
    ripples = MAX_CURVE_CYCLES - LEAST_RIPPLE + 1 if rippled else 0

    def curves(motion: Motion) -> Values:
        signals, columns = signals_of(motion, observations.sensor), []
        for signal, places in scanned:
            above = signals[signal] - places
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
    """Return ``share_worse``, the share of simulations that fit worse, and ``simulations``, their number.

    Where the readings fit so badly that no draw would be worse, none is made.
    """
    bases, observations, scan = _bases_of(selection), selection.observations.less_stop_errors, Scan(selection)
    fitted = ProjectedCurves(scan, scan.values(_curves_of(bases)))
    _, delta, parameters = _tests_of_curves(bases, scan, fitted)
    if scipy.special.chdtrc(parameters, delta + parameters * np.log(scan.samples)).min(initial=1.0) < NO_CHANCE:
        return {"share_worse": 0.0, "simulations": SIMULATIONS}
    within = np.append(scan.within, np.full(SIMULATIONS, 3.0 * (observations.samples - len(observations.weight))))
    left, cross = np.zeros((len(scan.left), 1 + SIMULATIONS)), []  # of the readings and each simulation
    for c, (drawn, curves, draws) in enumerate(_draws(selection, scan, fitted.columns[0])):
        of_draws, squares = drawn.without_model(c, curves, draws)
        left += np.concatenate([scan.left[:, c, None], squares[1:]], axis=1)
        cross.append(np.concatenate([fitted.cross[:, c, :, None], of_draws[1:]], axis=2))

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


def _draws(selection: Selection, scan: Scan, curves: Whitened) -> Iterator[tuple[Scan, Whitened, Whitened]]:
    """Yield scan, curves and s draws from the noise of the fit for each axis, all with rotated rows.

    Of white noise within the blocks the products with q columns A and the square are drawn, not every row: ``A = Q R``,
    ``Q^T e`` is white noise, and the square of the rest is chi-squared.
    """
    rng, drawn, p = np.random.default_rng(0), copy(scan), scan.columns.shape[1]
    columns = np.concatenate([scan.every.inside, curves.inside], axis=1)
    size, free = np.maximum(np.linalg.norm(columns, axis=0), 1e-150), len(columns) - len(scan.blocks.first)
    squares, directions = np.linalg.eigh(columns.T @ columns / np.outer(size, size))
    rotated = (np.sqrt(np.maximum(squares, 0.0)) * directions).T[-free:] * size if free else columns[:0]
    rest = 0.5 * (free - len(rotated))
    rotated = np.concatenate([rotated, np.zeros((1, len(size)))])
    drawn.every, noise = Whitened(rotated[:, :p], scan.every.means), scan.blocks.model((selection.fit.setting,))
    for scale in scan.scale:
        white = rng.standard_normal((len(rotated), SIMULATIONS))
        white[-1] = np.sqrt(2.0 * rng.standard_gamma(rest, SIMULATIONS))
        means = scan.noise.whitened(scale * noise.draw(rng, SIMULATIONS))
        yield drawn, Whitened(rotated[:, p:], curves.means), Whitened(scale * white, means)


def _curves_of(bases: Sequence[Basis]) -> Curves:
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
            bases.append((covariate, _chebyshev(observations, signal), [(range(CURVE_DEGREE), 2)]))
    if any(part.motion.axis is not None for part in observations.parts):
        count = MAX_CURVE_CYCLES - MIN_CYCLES + 1
        single: list[Block] = [((j, count + j), 2) for j in range(count)]
        bases.append(("angle", _harmonics, [*single, (range(2 * count), 2 * count)]))
    return bases


def _chebyshev(observations: Observations, signal: str) -> Callable[[Motion], Values]:
    """Return the function from motion to Chebyshev polynomials of degree 1 to 5 of a signal over its span."""
    span = Span.of(observations, signal)

    def curves(motion: Motion) -> Values:
        x = 2.0 * (signals_of(motion, observations.sensor)[signal][:, 0] - span.low) / span.size - 1.0
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


def plots(selection: Selection, unexplained: Sequence[Dependence], noise: Noise, reported: Selection) -> JSON:
    """Return the points of the plots of a diagnosis.

    ``unexplained``: the dependences for ``selection``. ``reported``: the selection that the diagnosis reports, with a
    suggested form in its base.
    Returns ``added_variable`` (of the first selected effect, or None) and ``unexplained``, a list. Each has ``panels``,
    one for each axis, with the binned ``x, mean, standard_error``. Panels of an added variable also have the slope:
    ``parameter, unit, value, standard_uncertainty``. Panels of a suggested form also have ``curve_x, curve``.
    """
    shown = [entry for entry in unexplained if not entry.explained_by][:MAX_PLOTS]
    return {
        "added_variable": _added_variable(_Columns(reported), reported) if reported.names else None,
        "unexplained": _unexplained(selection, shown, noise) if shown else [],
    }


def _added_variable(regression: _Columns, selection: Selection) -> JSON:
    """Return the added-variable plot of the first selected effect: its most significant coefficient on each axis."""
    sensor, fit = selection.observations.sensor, selection.fit
    term, block = placed(fit.terms)[selection.names[0]]
    uncertainty = np.sqrt(np.clip(np.diag(fit.covariance)[block], 1e-300, None))
    white = regression.residual - regression.wander(fit.setting)
    sigma = regression.white_noise(white)
    products = regression.design.products([fit.setting])[0][0][:-1, :-1]
    significant = _most_significant(term, sensor, np.abs(term.values) / uncertainty)
    chosen = []
    for c, j in enumerate(significant):
        if j is not None and np.any(regression.columns[c][:, block.start - BASE_COUNT + OWN_BASE_COLUMNS + j]):
            x = regression.left_of_column(c, block.start + j, products)
            chosen.append((c, j, x, regression.weight @ x**2 / sigma[c] ** 2))
    information = sum(each for *_, each in chosen)
    panels = []
    for c, j, x, of_axis in chosen:
        if term.effect.layout == Layout.SHARED and of_axis < MIN_INFORMATION_SHARE * information:
            continue
        bins = Bins(x, regression.weight)
        points = bins.document(term.values[j] * x + white[:, c], sigma[c] ** 2 / bins.weight)
        panels.append({"axis": "xyz"[c], **_coefficient(term, sensor, j, uncertainty[j]), **points})
    return {"effect": selection.names[0], "unit": unit_of(sensor), "panels": panels}


def added_variable_of_rests(selection: by_hand.SelectionByHand) -> JSON | None:
    """Return the same for rests by hand; None if the first selected effect shows mostly in the moves."""
    model, fit = selection.model, selection.fits[-1]
    term, block = placed(fit.state.terms, model.directions.shape[1])[selection.names[0]]
    equations = fit.equations
    columns = equations.columns
    white, _ = equations.whitened(fit.noise, np.column_stack([columns, equations.residual]))
    scale = solve(equations, fit.noise, *np.zeros((2, columns.shape[1]))).scale
    rests = slice(0, model.rests_equations)
    size = float(np.median(equations.error[rests]))
    uncertainty = np.sqrt(np.diag(fit.covariance))[block]
    panels = []
    for c, j in enumerate(_most_significant(term, model.sensor, np.abs(term.values) / uncertainty)):
        if j is None or (c and term.effect.layout == Layout.SHARED):
            continue
        others, column = np.delete(white[:, :-1], block.start + j, axis=1), white[:, block.start + j]
        norm = np.linalg.norm(others, axis=0)
        others = others / np.where(norm > 0.0, norm, 1.0)
        x = column - others @ np.linalg.lstsq(others, column, rcond=RANK_OF_RESTS)[0]
        if np.sum(x[rests] ** 2) < MIN_REST_POWER_SHARE * np.sum(x**2):
            return None
        order = np.argsort(x[rests], kind="stable")
        panels.append({
            "axis": "xyz"[c],
            **_coefficient(term, model.sensor, j, uncertainty[j]),
            "x": (x[rests] * size)[order].tolist(),
            "mean": ((term.values[j] * x + white[:, -1])[rests] * size)[order].tolist(),
            "standard_error": [size * float(np.sqrt(scale))] * len(order),
        })  # fmt: skip
    return {"effect": selection.names[0], "unit": unit_of(model.sensor), "panels": panels}


def _coefficient(term: EffectColumns, sensor: str, j: int, uncertainty: float) -> JSON:
    described = term.effect.parameters(sensor)[j]
    known = {"parameter": described.name, "unit": described.unit, "value": float(term.values[j])}
    return known | {"standard_uncertainty": float(uncertainty)}


def _most_significant(term: EffectColumns, sensor: str, ratio: Values) -> list[int | None]:
    """Return the coefficient to show on each axis, all of one unit, and linear if possible.

    ``ratio``: of each value to its uncertainty.
    """
    described = term.effect.parameters(sensor)
    linear = np.array([p.name not in term.effect.nonlinear for p in described])
    ratio = np.where(linear | (not linear.any()), ratio, -1.0)
    best = int(np.argmax(ratio))
    if term.effect.layout == Layout.SHARED:
        return [best] * 3
    ratio = np.where([p.unit == described[best].unit for p in described], ratio, -1.0)
    largest = [int(index[np.argmax(ratio[index])]) for index in np.flatnonzero(linear).reshape(3, -1)]
    return [j if ratio[j] >= 0.0 else None for j in largest]


def _unexplained(selection: Selection, shown: Sequence[Dependence], noise: Noise) -> list[JSON]:
    """Return the plots of the residual against covariates, with the curve of a suggested form."""
    regression, plots, blocks = _Columns(selection), [], selection.observations.blocks
    # as expected: the fitted wander may contain the dependence
    setting = Setting(float(np.sqrt(np.mean((noise.wander / noise.white) ** 2))), noise.correlation_time)
    covariance = blocks.covariance(setting.time)
    sigma = regression.white_noise(regression.residual - regression.wander(selection.fit.setting))
    for entry in shown:
        signal, forms = _signal_forms(selection, entry)
        values, panels = _values(selection, signal), []
        for c, (form, coefficients) in enumerate(forms):
            bins = Bins(values[:, c], regression.weight)
            residual = regression.left_of(c, regression.residual[:, c] - form, setting) + form
            variance = sigma[c] ** 2 / bins.weight + noise.wander[c] ** 2 * bins.bias_of_means(blocks, covariance)
            panels.append({"axis": "xyz"[c]} | bins.document(residual, variance))
            if entry.form and coefficients is not None:
                grid = np.linspace(float(np.nanmin(values[:, c])), float(np.nanmax(values[:, c])), CURVE)
                columns = [np.broadcast_to(parse(text)({signal: grid}), grid.shape) for text in entry.form.formulas]
                curve = np.stack(columns, axis=1) @ np.asarray(coefficients, float)
                panels[-1] |= {"curve_x": _rounded(grid), "curve": _rounded(curve)}
        unit = unit_of(selection.observations.sensor)
        plots.append({"covariate": entry.covariate, "signal": signal, "unit": unit, "panels": panels})
    return plots


def _signal_forms(selection: Selection, entry: Dependence) -> tuple[str, list[tuple[Values, Sequence[float] | None]]]:
    """Return the signal of a covariate, and the values and coefficients of the form on each axis."""
    observations, formulas = selection.observations, entry.form.formulas if entry.form else ()
    named = sorted({name for text in formulas for name in parse(text).signals})
    signal = named[0] if named else ABSCISSA_SIGNALS.get(entry.covariate, entry.covariate)
    forms: list[tuple[Values, Sequence[float] | None]] = [(np.zeros(len(observations.weight)), None)] * 3
    if entry.form is None or len(named) != 1:
        return signal, forms
    evaluate = columns_of(formulas, observations.sensor)
    columns = np.concatenate([evaluate(part.motion) for part in observations.parts])
    for axis, coefficients in zip(entry.form.axes, entry.form.coefficients, strict=True):
        c = "xyz".index(axis)
        forms[c] = columns[:, c % columns.shape[1]] @ np.asarray(coefficients, float), coefficients
    return signal, forms


def _values(selection: Selection, signal: str) -> Values:
    """Return a signal in all rows for each axis, NaN in recordings without it: (n, 3) array."""
    known = (signals_of(part.motion, selection.observations.sensor) for part in selection.observations.parts)
    of_parts = [np.broadcast_to(each.get(signal, np.nan), each["u"].shape) for each in known]
    values = np.concatenate(of_parts)
    return np.mod(values, 360.0) if signal == "angle" else values


class _Columns:
    """The columns of each axis and the residual of a selection's fit."""

    def __init__(self, selection: Selection) -> None:
        self.observations = selection.observations.less_stop_errors
        self.weight = self.observations.weight
        self.design = selection.fit.design(self.observations)
        of_axis = [self.design.of_axis(c) for c in range(3)]
        self.columns = [found[:, :-1] for found in of_axis]
        self.residual = np.stack([found[:, -1] for found in of_axis], axis=1)

    def wander(self, setting: Setting) -> Values:
        """Return the bias wander that the residual implies under a noise setting: (n, 3) array."""
        return Products(self.observations.blocks, self.weight, self.residual).bias(setting)

    def white_noise(self, white: Values) -> Values:
        """Return the standard deviation of a sample on each axis from a residual without its wander: (3,) array."""
        squares = np.einsum("i,ij->j", self.weight, white**2) + self.observations.scatter
        return np.asarray(np.sqrt(squares / self.observations.samples), np.float64)

    def left_of_column(self, c: int, index: int, products: Values) -> Values:
        """Return x~ of a parameter on axis c from the products of the columns of all parameters: (n,) array."""
        places = self.design.places(c)[1][:-1]
        others, delta = np.flatnonzero(np.arange(len(products)) != index), np.zeros(len(products))
        delta[others] = projection(products[None], others)[0][:, index]
        return np.asarray(self.columns[c][:, index - BASE_COUNT + OWN_BASE_COLUMNS] - self.columns[c] @ delta[places])

    def left_of(self, c: int, values: Values, setting: Setting) -> Values:
        """Return the residual of (n,) values after a fit of base and effects, free on this axis: (n,) array."""
        columns = np.column_stack([self.columns[c], values])
        products = Products(self.observations.blocks, self.weight, columns).products([setting])[0]
        known = projection(products, np.arange(columns.shape[1] - 1))[0]
        return np.asarray(values - self.columns[c] @ known[:, -1])


class Bins:
    """The filled ones of 40 equal bins of a covariate, whose (n,) values are not finite where it is unknown.

    ``cell``: (n,), bin of each row; one beyond the last where the covariate is unknown. ``weight``: (b,), sum over the
    rows of a bin. ``centre``: (b,), weighted mean of the covariate.
    """

    def __init__(self, values: Values, weight: Values) -> None:
        known = np.isfinite(values)
        low, high = (float(values[known].min()), float(values[known].max())) if known.any() else (0.0, 0.0)
        place = np.full(len(values), PLOT_BINS)
        place[known] = np.minimum((values[known] - low) * (PLOT_BINS / max(high - low, 1e-300)), PLOT_BINS - 1)
        filled, cell = np.unique(np.append(place, PLOT_BINS), return_inverse=True)
        self.cell, self.row_weight = cell[:-1], weight
        self.weight: Values = np.bincount(self.cell, weight, len(filled))[:-1].astype(float)
        self.centre = self.mean(np.where(known, values, 0.0))

    def mean(self, values: Values) -> Values:
        """Return the weighted means of (n,) values: (b,) array."""
        sums = np.bincount(self.cell, self.row_weight * values, len(self.weight) + 1)
        return np.asarray(sums[: len(self.weight)] / self.weight)

    def bias_of_means(self, blocks: Blocks, covariance: Values) -> Values:
        """Return the variance of the means by a bias: (b,) array.

        ``a^T B a``, with the shares a of a bin in the blocks and the ``covariance`` B of the bias in them.
        """
        bins, count = len(self.weight), len(blocks.first)
        index = self.cell * count + blocks.label(len(self.cell))
        sums = np.bincount(index, self.row_weight, (bins + 1) * count)
        share: Values = sums.reshape(bins + 1, count)[:bins] / self.weight[:, None]
        return np.asarray(np.einsum("bi,bi->b", share @ covariance, share))

    def document(self, values: Values, variance: Values) -> dict[str, list[float]]:
        """Return covariate, means of (n,) values and their standard errors as lists."""
        columns = {"x": self.centre, "mean": self.mean(values), "standard_error": np.sqrt(variance)}
        return {name: _rounded(column) for name, column in columns.items()}


def _rounded(values: Values) -> list[float]:
    return [float(f"{v:.{PLOT_DIGITS}g}") for v in values.tolist()]
