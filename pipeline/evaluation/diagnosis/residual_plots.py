"""Compute the plots of a diagnosis, binned to a few points.

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

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.records import BASE_COUNT
from pipeline.estimation.design import EffectColumns, placed
from pipeline.estimation.gauss_markov import WHITE_SETTING, Blocks, Products, Setting
from pipeline.estimation.multi_position.fit import solve
from pipeline.estimation.ranking import projection
from pipeline.evaluation.diagnosis.functional_forms import columns_of, signals_of
from pipeline.physics.effects.base import Layout, truth, unit_of
from pipeline.physics.formula import parse

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.core.files import JSON
    from pipeline.core.records import Dependence, Index, Noise, Values
    from pipeline.estimation.multi_position import selection as by_hand
    from pipeline.estimation.selection import Selection


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


def plots(selection: Selection, unexplained: Sequence[Dependence], noise: Noise | None, reported: Selection) -> JSON:
    """Return the points of the plots of a diagnosis.

    ``unexplained``: the dependences for ``selection``. ``reported``: the selection that the diagnosis reports, with a
    suggested form in its base.
    Returns ``added_variable`` (of the first selected effect, or None) and ``unexplained``, a list. Each has ``panels``,
    one for each axis, with the binned ``x, mean, standard_error``. Panels of an added variable also have the slope:
    ``parameter, unit, value, standard_uncertainty``. Panels of a suggested form also have ``curve_x, curve``.
    """
    shown = [entry for entry in unexplained if not entry.explained_by][:MAX_PLOTS]
    regression = _Columns(selection) if shown else None
    return {
        "added_variable": _added_variable(_Columns(reported), reported) if reported.names else None,
        "unexplained": [_unexplained(regression, selection, entry, noise) for entry in shown if regression],
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
        bins = Bins.of(x, regression.weight)
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
        panels.append(
            {
                "axis": "xyz"[c],
                **_coefficient(term, model.sensor, j, uncertainty[j]),
                "x": (x[rests] * size)[order].tolist(),
                "mean": ((term.values[j] * x + white[:, -1])[rests] * size)[order].tolist(),
                "standard_error": [size * float(np.sqrt(scale))] * len(order),
            }
        )
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


def _unexplained(regression: _Columns, selection: Selection, entry: Dependence, noise: Noise | None) -> JSON:
    """Return the plot of the residual against a covariate, with the curve of the suggested form."""
    signal, forms = _signal_and_forms(selection, entry)
    setting, values = WHITE_SETTING, _values(selection, signal)
    if noise is not None and np.any(noise.wander > 0):  # as expected: the fitted wander may contain the dependence
        setting = Setting(float(np.sqrt(np.mean((noise.wander / noise.white) ** 2))), noise.correlation_time)
    sigma = regression.white_noise(regression.residual - regression.wander(selection.fit.setting))
    panels = []
    for c, (form, coefficients) in enumerate(forms):
        bins = Bins.of(values[:, c], regression.weight)
        residual = regression.left_of(c, regression.residual[:, c] - form, setting) + form
        variance = sigma[c] ** 2 / bins.weight
        if noise is not None and noise.wander[c] > 0.0:
            blocks = selection.observations.blocks
            variance += noise.wander[c] ** 2 * bins.bias_of_means(blocks, noise.correlation_time)
        panels.append({"axis": "xyz"[c]} | bins.document(residual, variance))
        if entry.form and coefficients is not None:
            grid = np.linspace(float(np.nanmin(values[:, c])), float(np.nanmax(values[:, c])), CURVE)
            columns = [np.broadcast_to(parse(text)({signal: grid}), grid.shape) for text in entry.form.formulas]
            curve = np.stack(columns, axis=1) @ np.asarray(coefficients, float)
            panels[-1] |= {"curve_x": _rounded(grid), "curve": _rounded(curve)}
    unit = unit_of(selection.observations.sensor)
    return {"covariate": entry.covariate, "signal": signal, "unit": unit, "panels": panels}


def _signal_and_forms(
    selection: Selection, entry: Dependence
) -> tuple[str, list[tuple[Values, Sequence[float] | None]]]:
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
    sensor, found = selection.observations.sensor, []
    for part in selection.observations.parts:
        value = truth(sensor, part.motion) if signal == "u" else signals_of(part.motion)[signal]
        value = np.full(len(part.weight), np.nan) if value is None else value
        found.append(value if value.ndim == 2 else np.repeat(value[:, None], 3, axis=1))
    values = np.concatenate(found)
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


@dataclass(frozen=True)
class Bins:
    """The filled ones of 40 equal bins of a covariate."""

    cell: Index  # (n,), bin of each row; one beyond the last if the covariate is unknown
    row_weight: Values  # (n,)
    weight: Values  # (b,), sum over the rows of a bin
    centre: Values  # (b,), weighted mean of the covariate

    @classmethod
    def of(cls, values: Values, weight: Values) -> Bins:
        """Return the bins of a covariate; its (n,) values are not finite if unknown."""
        known = np.isfinite(values)
        low, high = (float(values[known].min()), float(values[known].max())) if known.any() else (0.0, 0.0)
        place = np.full(len(values), PLOT_BINS)
        place[known] = np.minimum((values[known] - low) * (PLOT_BINS / max(high - low, 1e-300)), PLOT_BINS - 1)
        filled, cell = np.unique(np.append(place, PLOT_BINS), return_inverse=True)
        total: Values = np.bincount(cell[:-1], weight, len(filled))[:-1].astype(float)
        first = cls(cell[:-1], weight, total, np.zeros(0))
        return cls(first.cell, weight, total, first.mean(np.where(known, values, 0.0)))

    def mean(self, values: Values) -> Values:
        """Return the weighted means of (n,) values: (b,) array."""
        sums = np.bincount(self.cell, self.row_weight * values, len(self.weight) + 1)
        return np.asarray(sums[: len(self.weight)] / self.weight)

    def bias_of_means(self, blocks: Blocks, time: float) -> Values:
        """Return the variance of the means by a Gauss-Markov bias of unit variance: (b,) array.

        ``a^T B a``, with the shares a of a bin in the blocks and the covariance B of a bias with this correlation time.
        """
        bins, count = len(self.weight), len(blocks.first)
        index = self.cell * count + blocks.label(len(self.cell))
        sums = np.bincount(index, self.row_weight, (bins + 1) * count)
        share: Values = sums.reshape(bins + 1, count)[:bins] / self.weight[:, None]
        return np.asarray(np.einsum("bi,bi->b", share @ blocks.covariance(time), share))

    def document(self, values: Values, variance: Values) -> dict[str, list[float]]:
        """Return covariate, means of (n,) values and their standard errors as lists."""
        return {
            "x": _rounded(self.centre),
            "mean": _rounded(self.mean(values)),
            "standard_error": _rounded(np.sqrt(variance)),
        }


def _rounded(values: Values) -> list[float]:
    return [float(f"{v:.{PLOT_DIGITS}g}") for v in values.tolist()]
