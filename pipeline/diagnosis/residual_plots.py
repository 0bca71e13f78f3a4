"""Plots of a diagnosis: its evidence, binned to a few points.

Added-variable plot of one coefficient gamma of an effect with the column x, on one axis (Frisch, Waugh and Lovell):

    x~ = x - X delta,    delta = (X^T C^-1 X)^-1 X^T C^-1 x,    y~ = gamma x~ + r - w

X are all other columns of the model, C white noise plus bias wander, r the residual of the fit and w the wander that it
implies, ``E[w | r]``; the least-squares line through (x~, y~) has the slope gamma, as ``x~^T C^-1 r = 0``. Of rests by
hand, x and r are whitened, a point is a rest, and both are shown times the median white error of a rest.

The plot of what is unexplained is the residual against the covariate on which it depends; where a functional form g
is suggested, that of a fit of base and g, to which g is added again: the points scatter about the curve.

Source: R. D. Cook and S. Weisberg, Residuals and Influence in Regression, 1982, section 2.3.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.diagnosis.functional_forms import columns_of, signals_of
from pipeline.estimation.design import BASE, Term, placed
from pipeline.estimation.gauss_markov import Blocks, Products, Setting
from pipeline.estimation.generalized_least_squares import design_at
from pipeline.estimation.multi_position.fit import solve
from pipeline.estimation.ranking import projection
from pipeline.model.effects.base import Layout, truth, unit_of
from pipeline.model.formula import parse

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.estimation.multi_position import selection as by_hand
    from pipeline.estimation.selection import Selection
    from pipeline.records import Index, Noise, Values

    JSON = dict[str, Any]

OWN = 4  # columns of the base on each axis
RANK_OF_RESTS = 1e-8  # of singular values: columns that are the same to rounding
BINS = 40  # points that a plot shows apart
DIGITS = 5  # more than a plot shows
CURVE = 60  # points of a suggested form
LEAST_SHARE = 0.01  # of the information on a coefficient that the axes share, for an axis to be shown
AT_REST = 0.9  # share of a column's power that rests must have, for a point a rest to show it
MOST = 3  # plots of what is unexplained
SIGNALS = {"rate": "speed", "specific_force": "u"}  # against which a covariate is drawn where no form names a signal


def plots(
    selection: Selection, unexplained: Sequence[Mapping[str, Any]], noise: Noise | None, reported: Selection
) -> JSON:
    """Return the points of a diagnosis's plots, few enough to be kept in its document.

    ``unexplained``: entries of the diagnosis, of ``selection``: ``covariate``, and ``axes, formulas, coefficients`` of
    the form. ``reported``: the selection that the diagnosis reports: with the suggested form in its base where there is
    one. Returns ``added_variable`` (of the first selected effect, or None) and ``unexplained``, a list. Each has
    ``panels``, one an axis, with the binned ``x, mean, standard_error``; those of an added variable the ``parameter``
    that is the slope, with ``unit, value, standard_uncertainty``; those of the unexplained, where a form is suggested,
    ``curve_x, curve``.
    """
    shown = [entry for entry in unexplained if not entry.get("explained_by")][:MOST]
    regression = _Columns(selection) if shown else None
    return {
        "added_variable": _added_variable(_Columns(reported), reported) if reported.names else None,
        "unexplained": [_unexplained(regression, selection, entry, noise) for entry in shown if regression],
    }


def _added_variable(regression: _Columns, selection: Selection) -> JSON:
    """Return the added-variable plot of the first selected effect: its clearest coefficient on each axis."""
    sensor, fit = selection.observations.sensor, selection.fit
    term, own = placed(fit.terms)[selection.names[0]]
    uncertainty = np.sqrt(np.clip(np.diag(fit.covariance)[own], 1e-300, None))
    white = regression.residual - regression.wander(fit.setting)
    sigma = regression.white_noise(white)
    products = regression.design.products([fit.setting])[0][0][:-1, :-1]
    columns = [regression.columns[c][:, own.start - BASE + OWN :] for c in range(3)]
    clearest = _clearest(term, sensor, np.abs(term.values) / uncertainty)
    chosen = [(c, j) for c, j in enumerate(clearest) if j is not None and np.any(columns[c][:, j])]
    left_of = [regression.left_of_column(c, own.start + j, products) for c, j in chosen]
    information = np.array(
        [regression.weight @ x**2 / sigma[c] ** 2 for (c, _), x in zip(chosen, left_of, strict=True)]
    )
    panels = []
    for (c, j), left, share in zip(chosen, left_of, information / information.sum(), strict=True):
        if term.effect.layout == Layout.SHARED and share < LEAST_SHARE:
            continue
        bins = Bins.of(left, regression.weight)
        points = bins.document(term.values[j] * left + white[:, c], sigma[c] ** 2 / bins.weight)
        panels.append({"axis": "xyz"[c], **_coefficient(term, sensor, j, uncertainty[j]), **points})
    return {"effect": selection.names[0], "unit": unit_of(sensor), "panels": panels}


def added_variable_of_rests(selection: by_hand.Selection) -> JSON | None:
    """Return the same of rests by hand, a point a rest; None where the first effect shows mostly in the moves."""
    model, found = selection.model, selection.fits[-1]
    term, own = placed(found.state.terms, model.directions.shape[1])[selection.names[0]]
    equations = model.equations(found.state)
    columns = equations.columns
    white, _ = equations.whitened(found.noise, np.column_stack([columns, equations.residual]))
    scale = solve(equations, found.noise, *np.zeros((2, columns.shape[1]))).scale
    rests = slice(0, model.rests_equations)
    size = float(np.median(equations.error[rests]))
    uncertainty = np.sqrt(np.diag(found.covariance))[own]
    panels = []
    for c, j in enumerate(_clearest(term, model.sensor, np.abs(term.values) / uncertainty)):
        if j is None or (c and term.effect.layout == Layout.SHARED):
            continue
        others, column = np.delete(white[:, :-1], own.start + j, axis=1), white[:, own.start + j]
        norm = np.linalg.norm(others, axis=0)
        others = others / np.where(norm > 0.0, norm, 1.0)
        left = column - others @ np.linalg.lstsq(others, column, rcond=RANK_OF_RESTS)[0]
        if np.sum(left[rests] ** 2) < AT_REST * np.sum(left**2):
            return None
        points = (term.values[j] * left + white[:, -1])[rests] * size
        shown = np.argsort(left[rests], kind="stable")
        panels.append(
            {
                "axis": "xyz"[c],
                **_coefficient(term, model.sensor, j, uncertainty[j]),
                "x": (left[rests] * size)[shown].tolist(),
                "mean": points[shown].tolist(),
                "standard_error": [size * float(np.sqrt(scale))] * len(shown),
            }
        )
    return {"effect": selection.names[0], "unit": unit_of(model.sensor), "panels": panels}


def _coefficient(term: Term, sensor: str, j: int, uncertainty: float) -> JSON:
    described = term.effect.parameters(sensor)[j]
    known = {"parameter": described.name, "unit": described.unit, "value": float(term.values[j])}
    return known | {"standard_uncertainty": float(uncertainty)}


def _clearest(term: Term, sensor: str, clear: Values) -> list[int | None]:
    """Return which coefficient to show on each axis: the clearest, of one unit, and linear where there is one."""
    described = term.effect.parameters(sensor)
    linear = np.array([p.name not in term.effect.nonlinear for p in described])
    clear = np.where(linear | (not linear.any()), clear, -1.0)
    best = int(np.argmax(clear))
    if term.effect.layout == Layout.SHARED:
        return [best] * 3
    clear = np.where([p.unit == described[best].unit for p in described], clear, -1.0)
    of_axis = np.flatnonzero(linear).reshape(3, -1)
    found = [int(own[np.argmax(clear[own])]) for own in of_axis]
    return [j if clear[j] >= 0.0 else None for j in found]


def _unexplained(regression: _Columns, selection: Selection, entry: Mapping[str, Any], noise: Noise | None) -> JSON:
    """Return the residual against a covariate, and the suggested form."""
    signal, given = _signal_and_shape(selection, entry)
    setting, values = _expected(noise), _values(selection, signal)
    sigma = regression.white_noise(regression.residual - regression.wander(selection.fit.setting))
    panels = []
    for c, (shape, coefficients) in enumerate(given):
        bins = Bins.of(values[:, c], regression.weight)
        residual = regression.left_of(c, regression.residual[:, c] - shape, setting) + shape
        variance = sigma[c] ** 2 / bins.weight
        if noise is not None and noise.wander[c] > 0.0:
            blocks = selection.observations.blocks
            variance += noise.wander[c] ** 2 * bins.bias_of_means(blocks, noise.correlation_time)
        panels.append({"axis": "xyz"[c]} | bins.document(residual, variance))
        if coefficients is not None:
            panels[-1] |= _curve(entry["formulas"], coefficients, signal, values[:, c])
    unit = unit_of(selection.observations.sensor)
    return {"covariate": entry["covariate"], "signal": signal, "unit": unit, "panels": panels}


def _expected(noise: Noise | None) -> Setting:
    """Return the noise that is expected of the sensor: a wander that a fit takes may hold what is to be seen."""
    if noise is None or not np.any(noise.wander > 0):
        return Setting(0.0, 1.0)
    return Setting(float(np.sqrt(np.mean((noise.wander / noise.white) ** 2))), noise.correlation_time)


def _signal_and_shape(
    selection: Selection, entry: Mapping[str, Any]
) -> tuple[str, list[tuple[Values, Sequence[float] | None]]]:
    """Return the signal of a covariate, and on each axis what the shape adds and its coefficients."""
    observations, formulas = selection.observations, entry.get("formulas") or []
    named = sorted({name for text in formulas for name in parse(text).signals})
    signal = named[0] if named else SIGNALS.get(entry["covariate"], entry["covariate"])
    given: list[tuple[Values, Sequence[float] | None]] = [(np.zeros(len(observations.weight)), None)] * 3
    if len(named) != 1:
        return signal, given
    of = columns_of(formulas, observations.sensor)
    columns = np.concatenate([of(part.motion) for part in observations.parts])
    for axis, coefficients in zip(entry["axes"], entry["coefficients"], strict=True):
        c = "xyz".index(axis)
        given[c] = (columns if columns.ndim == 2 else columns[:, c]) @ np.asarray(coefficients, float), coefficients
    return signal, given


def _values(selection: Selection, signal: str) -> Values:
    """Return a signal at all rows, for each axis: (n, 3) array, NaN where a recording does not hold it."""
    found = []
    for part in selection.observations.parts:
        if signal == "u":
            found.append(truth(selection.observations.sensor, part.motion))
            continue
        value = signals_of(part.motion)[signal]
        column = np.full(len(part.weight), np.nan) if value is None else value
        found.append(np.repeat(column[:, None], 3, axis=1))
    values = np.concatenate(found)
    return np.mod(values, 360.0) if signal == "angle" else values


def _curve(formulas: Sequence[str], coefficients: Sequence[float], signal: str, values: Values) -> JSON:
    """Return the suggested form at even steps of its signal."""
    grid = np.linspace(float(np.nanmin(values)), float(np.nanmax(values)), CURVE)
    columns = np.stack([np.broadcast_to(parse(text)({signal: grid}), grid.shape) for text in formulas], axis=1)
    return {"curve_x": _rounded(grid), "curve": _rounded(columns @ np.asarray(coefficients, float))}


class _Columns:
    """The columns of each axis and the residual of a selection's fit, with their products."""

    def __init__(self, selection: Selection) -> None:
        self.observations = selection.observations.weakened
        self.weight = self.observations.weight
        self.design = design_at(self.observations, selection.fit)
        of_axis = [self.design.of_axis(c) for c in range(3)]
        self.columns = [found[:, :-1] for found in of_axis]
        self.residual = np.stack([found[:, -1] for found in of_axis], axis=1)

    def wander(self, setting: Setting) -> Values:
        """Return the bias wander that the residual implies under a noise: (n, 3) array."""
        return Products(self.observations.blocks, self.weight, self.residual).bias(setting)

    def white_noise(self, white: Values) -> Values:
        """Return the standard deviation of a sample on each axis, of a residual without its wander: (3,) array."""
        squares = np.einsum("i,ij->j", self.weight, white**2) + self.observations.scatter
        return np.asarray(np.sqrt(squares / self.observations.samples), np.float64)

    def left_of_column(self, c: int, own: int, products: Values) -> Values:
        """Return x~ on axis c of a parameter, from the products of all parameters' columns: (n,) array."""
        places = self.design.places(c)[1][:-1]
        others, delta = np.flatnonzero(np.arange(len(products)) != own), np.zeros(len(products))
        delta[others] = projection(products[None], others)[0][:, own]
        left: Values = self.columns[c][:, own - BASE + OWN] - self.columns[c] @ delta[places]
        return left

    def left_of(self, c: int, values: Values, setting: Setting) -> Values:
        """Return what base and effects, free on this axis, leave of values of (n,): (n,) array."""
        columns = np.column_stack([self.columns[c], values])
        products = Products(self.observations.blocks, self.weight, columns).products([setting])[0]
        known = projection(products, np.arange(columns.shape[1] - 1))[0]
        return np.asarray(values - self.columns[c] @ known[:, -1])


@dataclass(frozen=True)
class Bins:
    """Those of 40 equal bins of a covariate that hold something."""

    cell: Index  # (n,), bin of each row; one beyond the last where the covariate is not known
    row_weight: Values  # (n,)
    weight: Values  # (b,), of the rows in a bin together
    centre: Values  # (b,), weighted mean of the covariate

    @classmethod
    def of(cls, values: Values, weight: Values) -> Bins:
        """Return the bins of a covariate, (n,) values that are not finite where it is not known."""
        known = np.isfinite(values)
        low, high = (float(values[known].min()), float(values[known].max())) if known.any() else (0.0, 0.0)
        place = np.full(len(values), BINS)
        place[known] = np.minimum((values[known] - low) * (BINS / max(high - low, 1e-300)), BINS - 1)
        filled, cell = np.unique(np.append(place, BINS), return_inverse=True)
        total: Values = np.bincount(cell[:-1], weight, len(filled))[:-1].astype(float)
        first = cls(cell[:-1], weight, total, np.zeros(0))
        return cls(first.cell, weight, total, first.mean(np.where(known, values, 0.0)))

    def mean(self, values: Values) -> Values:
        """Return the weighted means of (n,) values: (b,) array."""
        sums = np.bincount(self.cell, self.row_weight * values, len(self.weight) + 1)
        means: Values = sums[: len(self.weight)] / self.weight
        return means

    def bias_of_means(self, blocks: Blocks, time: float) -> Values:
        """Return the variance that a Gauss-Markov bias of unit variance gives the means: (b,) array.

        ``a^T B a``, with a the shares of a bin in the blocks and B the covariance of the bias of that correlation time.
        """
        bins, count = len(self.weight), len(blocks.first)
        index = self.cell * count + blocks.label(len(self.cell))
        sums = np.bincount(index, self.row_weight, (bins + 1) * count)
        share: Values = sums.reshape(bins + 1, count)[:bins] / self.weight[:, None]
        variance: Values = np.einsum("bi,bi->b", share @ blocks.covariance(time), share)
        return variance

    def document(self, values: Values, variance: Values) -> dict[str, list[float]]:
        """Return covariate, means of (n,) values and their standard errors as lists."""
        return {
            "x": _rounded(self.centre),
            "mean": _rounded(self.mean(values)),
            "standard_error": _rounded(np.sqrt(variance)),
        }


def _rounded(values: Values) -> list[float]:
    """Return values to five digits, which is more than a picture shows."""
    return [float(f"{v:.{DIGITS}g}") for v in values.tolist()]
