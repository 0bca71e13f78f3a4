"""Plots of a diagnosis: its evidence, binned to a few points.

Added-variable plot of one coefficient gamma of an effect, on the axis c,

    x~ = x - X delta,    delta = (X^T C^-1 X)^-1 X^T C^-1 x,    y~ = gamma x~ + r - w

where

    x : the effect's column, X all other columns of the model (``pipeline.diagnosis.residual_regression``)
    r : residual of the fit;  w : the bias wander that it implies, ``E[w | r] = wander covariance C^-1 r``
    C : white noise plus bias wander

So y~ is the part of the reading that neither the other columns nor the wander explain (Frisch, Waugh and Lovell), and
the least-squares line through (x~, y~) has the slope gamma: ``x~^T C^-1 r = 0`` is the normal equation, and
``C^-1 r`` is the weight times ``r - w``.

The plot of what is unexplained is the residual r against the covariate on which it depends. Where a functional form g
is suggested, r is that of a fit with g beside the base, and g is added to it again: the points scatter about the curve.

Sources: M. C. Lovell, A Simple Proof of the FWL Theorem, J. Economic Education 39, 2008; R. D. Cook and S. Weisberg,
Residuals and Influence in Regression, 1982, section 2.3 (added-variable and partial residual plots).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.diagnosis.functional_forms import columns_of, signals_of
from pipeline.diagnosis.residual_regression import FittedModel
from pipeline.estimation.design import BASE
from pipeline.estimation.gauss_markov import Products, Setting
from pipeline.model.effects.base import Layout, truth, unit_of
from pipeline.model.formula import parse

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.estimation.design import Term
    from pipeline.estimation.gauss_markov import Blocks
    from pipeline.estimation.selection import Selection
    from pipeline.records import Noise

    Values = NDArray[np.float64]
    JSON = dict[str, Any]

OWN = 4  # columns of the base on each axis
RANK = 1e-11  # of singular values: columns that are the same to rounding
BINS = 40  # points that a plot shows apart
DIGITS = 5  # more than a plot shows
CURVE = 60  # points of a suggested form
LEAST_SHARE = 0.01  # of the information on a coefficient that the axes share, for an axis to be shown
MOST = 3  # plots of what is unexplained
SIGNALS = {"rate": "speed", "specific_force": "u"}  # against which a covariate is drawn where no form names a signal


def plots(
    selection: Selection,
    unexplained: Sequence[Mapping[str, Any]],
    noise: Noise | None,
    reported: Selection | None = None,
) -> JSON:
    """Return the points of a diagnosis's plots, few enough to be kept in its document.

    Parameters
    ----------
    selection : Selection
        To which ``unexplained`` belongs.
    unexplained : sequence of mapping
        Entries of the diagnosis: ``covariate``, and ``axes, formulas, coefficients`` of the suggested form.
    noise : Noise or None
    reported : Selection, optional
        The one that the diagnosis reports, where it is another: with the suggested form in its base.

    Returns
    -------
    dict
        ``added_variable`` (of the first selected effect, or None) and ``unexplained``, a list. Each has ``panels``,
        one an axis, with the binned ``x, mean, standard_error``; those of an added variable the ``parameter`` that is
        the slope, with ``unit, value, standard_uncertainty``; those of the unexplained, where a form is suggested,
        ``curve_x, curve``.
    """
    reported = reported or selection
    shown = [entry for entry in unexplained if not entry.get("explained_by")][:MOST]
    found: JSON = {"added_variable": None, "unexplained": []}
    if reported.names:
        found["added_variable"] = _added_variable(_Columns(reported), reported)
    if shown:
        regression = _Columns(selection)
        found["unexplained"] = [_unexplained(regression, selection, entry, noise) for entry in shown]
    return found


def _added_variable(regression: _Columns, selection: Selection) -> JSON:
    """Return the added-variable plot of the first selected effect: its clearest coefficient on each axis."""
    sensor, fit = selection.observations.sensor, selection.fit
    sizes = [len(term.values) for term in fit.terms]
    order = [term.effect.name for term in fit.terms].index(selection.names[0])
    term, at = fit.terms[order], sum(sizes[:order])
    uncertainty = np.sqrt(np.clip(np.diag(fit.covariance)[BASE + at :][: sizes[order]], 1e-300, None))
    described = term.effect.parameters(sensor)
    white = regression.residual - regression.wander(fit.setting)
    sigma = regression.white_noise(white)
    products = regression.all_products(selection.start.scale, fit.setting)
    chosen = _clearest(regression, term, at, np.abs(term.values) / uncertainty, sensor)
    left_of = [regression.left_of_column(c, at + j, products) for c, j in chosen]
    information = np.array(
        [regression.weight @ x**2 / sigma[c] ** 2 for (c, _), x in zip(chosen, left_of, strict=True)]
    )
    panels = []
    for (c, j), left, share in zip(chosen, left_of, information / information.sum(), strict=True):
        if term.effect.layout == Layout.SHARED and share < LEAST_SHARE:
            continue
        value, bins = float(term.values[j]), Bins.of(left, regression.weight)
        coefficient = {"parameter": described[j].name, "unit": described[j].unit, "value": value}
        panels.append(
            {"axis": "xyz"[c], **coefficient, "standard_uncertainty": float(uncertainty[j])}
            | bins.document(value * left + white[:, c], sigma[c] ** 2 / bins.weight)
        )
    return {"effect": selection.names[0], "unit": unit_of(sensor), "panels": panels}


def _clearest(regression: _Columns, term: Term, at: int, clear: Values, sensor: str) -> list[tuple[int, int]]:
    """Return axes, and which coefficient to show on each: the clearest one, of one unit and linear where there is."""
    described = term.effect.parameters(sensor)
    linear = np.array([p.name not in term.effect.nonlinear for p in described])
    clear = np.where(linear | (not linear.any()), clear, -1.0)
    unit = described[int(np.argmax(clear))].unit
    clear = np.where([p.unit == unit for p in described], clear, -1.0)
    if term.effect.layout == Layout.SHARED:
        clear[np.arange(len(clear)) != int(np.argmax(clear))] = -1.0
    found = []
    for c in range(3):
        columns = regression.columns[c][:, OWN + at : OWN + at + len(clear)]
        seen = np.where(np.any(columns != 0.0, axis=0), clear, -1.0)
        if seen.max() >= 0.0:
            found.append((c, int(np.argmax(seen))))
    return found


def _unexplained(regression: _Columns, selection: Selection, entry: Mapping[str, Any], noise: Noise | None) -> JSON:
    """Return the residual against a covariate, and the suggested form."""
    signal, given = _signal_and_shape(selection, entry)
    setting, values = _expected(noise), _values(selection, signal)
    sigma = regression.white_noise(regression.residual - regression.wander(selection.fit.setting))
    bins = Bins.of(values[:, 0], regression.weight)
    wander = _wander_of_means(bins, regression, noise)
    panels = []
    for c, (shape, coefficients) in enumerate(given):
        if c > 0 and signal == "u":
            bins = Bins.of(values[:, c], regression.weight)
            wander = _wander_of_means(bins, regression, noise)
        residual = regression.left_of(c, regression.residual[:, c] - shape, setting) + shape
        panels.append({"axis": "xyz"[c]} | bins.document(residual, sigma[c] ** 2 / bins.weight + wander[c]))
        if coefficients is not None:
            panels[-1] |= _curve(entry["formulas"], coefficients, signal, values[:, c])
    unit = unit_of(selection.observations.sensor)
    return {"covariate": entry["covariate"], "signal": signal, "unit": unit, "panels": panels}


def _expected(noise: Noise | None) -> Setting:
    """Return the noise that is expected of the sensor: a wander that a fit takes may hold what is to be seen."""
    if noise is None or not np.any(noise.wander > 0):
        return Setting(0.0, 1.0)
    return Setting(float(np.sqrt(np.mean((noise.wander / noise.white) ** 2))), noise.correlation_time)


def _wander_of_means(bins: Bins, regression: _Columns, noise: Noise | None) -> Values:
    """Return the variance of binned means by the expected bias wander: (3, b) array."""
    if noise is None or not np.any(noise.wander > 0):
        return np.zeros((3, len(bins.weight)))
    unit = bins.bias_of_means(regression.observations.blocks, noise.correlation_time)
    return np.outer(noise.wander**2, unit)


def _signal_and_shape(
    selection: Selection, entry: Mapping[str, Any]
) -> tuple[str, list[tuple[Values, Sequence[float] | None]]]:
    """Return the signal of a covariate, and on each axis what the shape adds and its coefficients."""
    observations, formulas = selection.observations, entry.get("formulas") or []
    named = sorted({name for text in formulas for name in parse(text).signals})
    signal = named[0] if named else SIGNALS.get(entry["covariate"], entry["covariate"])
    given: list[tuple[Values, Sequence[float] | None]] = [(np.zeros(len(observations.weight)), None)] * 3
    if len(named) != 1 or "coefficients" not in entry:
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
    """The columns and the residual of a selection's fit, with their products."""

    def __init__(self, selection: Selection) -> None:
        model, observations = FittedModel.of(selection), selection.observations
        self.columns = [model.columns(c) for c in range(3)]
        self.residual = model.residual
        self.observations, self.weight = observations, observations.weight

    def _of(self, columns: Values) -> Products:
        return Products(self.observations.blocks, self.weight, columns)

    def all_products(self, scale: Values, setting: Setting) -> Values:
        """Return the products of all parameters' columns: 12 of the base, then those of the effects."""
        count = BASE + self.columns[0].shape[1] - OWN
        total = np.zeros((count, count))
        for c in range(3):
            index = _places(c, count)
            total[np.ix_(index, index)] += self._of(self.columns[c]).products([setting])[0][0] / scale[c] ** 2
        return total

    def wander(self, setting: Setting) -> Values:
        """Return the bias wander that the residual implies under a noise: (n, 3) array."""
        return self._of(self.residual).bias(setting)

    def white_noise(self, white: Values) -> Values:
        """Return the standard deviation of a sample on each axis, of a residual without its wander: (3,) array."""
        squares = np.einsum("i,ij->j", self.weight, white**2) + self.observations.scatter
        return np.asarray(np.sqrt(squares / self.observations.samples), np.float64)

    def left_of_column(self, c: int, j: int, products: Values) -> Values:
        """Return x~ on axis c of effect parameter j, from ``all_products``: (n,) array."""
        count, own = len(products), BASE + j
        others = np.arange(count) != own
        delta = np.zeros(count)
        delta[others] = _solved(products[np.ix_(others, others)], products[others, own])
        left: Values = self.columns[c][:, OWN + j] - self.columns[c] @ delta[_places(c, count)]
        return left

    def left_of(self, c: int, values: Values, setting: Setting) -> Values:
        """Return what base and effects, free on this axis, leave of values of (n,): (n,) array."""
        products = self._of(np.column_stack([self.columns[c], values])).products([setting])[0][0]
        left: Values = values - self.columns[c] @ _solved(products[:-1, :-1], products[:-1, -1])
        return left


def _solved(gram: Values, cross: Values) -> Values:
    """Return the smallest solution of the normal equations, columns scaled to unit norm."""
    size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    found: Values = np.linalg.lstsq(gram / np.outer(size, size), cross / size, rcond=RANK)[0] / size
    return found


def _places(c: int, count: int) -> NDArray[np.intp]:
    """Return to which parameters the columns of an axis belong."""
    return np.concatenate([[c], 3 + 3 * c + np.arange(3), np.arange(BASE, count)])


@dataclass(frozen=True)
class Bins:
    """Those of 40 equal bins of a covariate that hold something."""

    cell: NDArray[np.intp]  # (n,), bin of each row; one beyond the last where the covariate is not known
    row_weight: Values  # (n,)
    weight: Values  # (b,), of the rows in a bin together
    centre: Values  # (b,), weighted mean of the covariate

    @classmethod
    def of(cls, values: Values, weight: Values) -> Bins:
        """Return the bins of a covariate.

        Parameters
        ----------
        values : (n,) array
            Not finite where it is not known.
        weight : (n,) array
        """
        known = np.isfinite(values)
        low, high = (float(values[known].min()), float(values[known].max())) if known.any() else (0.0, 0.0)
        place = np.full(len(values), BINS)
        place[known] = np.minimum((values[known] - low) * (BINS / max(high - low, 1e-300)), BINS - 1)
        total: Values = np.bincount(place, weight, BINS + 1).astype(float)
        filled = np.flatnonzero(total[:BINS] > 0)
        number = np.full(BINS + 1, len(filled))
        number[filled] = np.arange(len(filled))
        sums: Values = np.bincount(place, weight * np.where(known, values, 0.0), BINS + 1).astype(float)
        return cls(number[place], weight, total[filled], sums[filled] / total[filled])

    def mean(self, values: Values) -> Values:
        """Return the weighted means of (n,) values: (b,) array."""
        sums = np.bincount(self.cell, self.row_weight * values, len(self.weight) + 1)
        means: Values = sums[: len(self.weight)] / self.weight
        return means

    def bias_of_means(self, blocks: Blocks, time: float) -> Values:
        """Return the variance that a Gauss-Markov bias of unit variance gives the means: (b,) array.

        ``a^T B a``, with a the shares of a bin in the blocks and B the covariance of the bias.

        Parameters
        ----------
        blocks : Blocks
        time : float, s
            Its correlation time.
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
