"""What the pictures of a diagnosis show: its evidence, binned to a few points.

Added-variable plot of one coefficient gamma of an effect, on the axis c,

    x~ = what all other columns leave of its column,      y~ = gamma x~ + r - w

where r is the residual of the fit of all and w the wander that it tells (``pipeline.diagnosis.regression``). So y~ is
the reading that neither the other columns nor the wander explain (Frisch, Waugh and Lovell), and the line of least
squares through (x~, y~) has the slope gamma: ``x~^T C^-1 r = 0`` is the normal equation, and ``C^-1 r`` is the weight
times ``r - w``.

The picture of what is unexplained is the residual r against the covariate on which it depends. Where a shape g is
suggested, r is that of a fit with g beside the base, and g is added to it again: the points lie about the curve.

Sources: M. C. Lovell, A Simple Proof of the FWL Theorem, J. Economic Education 39, 2008; R. D. Cook and S. Weisberg,
Residuals and Influence in Regression, 1982, section 2.3 (added-variable and partial residual plots).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.diagnosis.bins import Bins, rounded
from pipeline.diagnosis.regression import OWN, Regression
from pipeline.diagnosis.shapes import columns_of, signals_of
from pipeline.estimation.design import BASE
from pipeline.estimation.gauss_markov import Setting
from pipeline.model.effects.base import Layout, truth, unit_of
from pipeline.model.formula import parse

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.estimation.design import Term
    from pipeline.estimation.selection import Selection
    from pipeline.records import Noise

    Values = NDArray[np.float64]
    JSON = dict[str, Any]

CURVE = 60
LEAST_SHARE = 0.01  # of what tells a coefficient that the axes share, for an axis to be shown
MOST = 3  # pictures of what is unexplained
SIGNALS = {"rate": "speed", "specific_force": "u"}  # what a covariate means where no shape names a signal


def pictures(
    selection: Selection, unexplained: Sequence[Mapping[str, Any]], noise: Noise | None, beside: Selection | None = None
) -> JSON:
    """Return what the pictures of a diagnosis show, small enough to be kept in its document.

    Parameters
    ----------
    selection : Selection
        To which ``unexplained`` belongs.
    unexplained : sequence of mapping
        Entries of the diagnosis: ``covariate``, and ``axes, formulas, coefficients`` of the suggested shape.
    noise : Noise or None
    beside : Selection, optional
        The one that the diagnosis reports, where it is another: with the suggested shape in its base.

    Returns
    -------
    dict
        ``added_variable`` (of the first selected effect, or None) and ``unexplained``, a list. Each has ``panels``,
        one an axis, with the binned ``x, mean, standard_error``; those of an added variable the ``parameter`` that is
        the slope, with ``unit, value, standard_uncertainty``; those of the unexplained, where a shape is suggested,
        ``curve_x, curve``.
    """
    reported = beside or selection
    told = [entry for entry in unexplained if not entry.get("explained_by")][:MOST]
    found: JSON = {"added_variable": None, "unexplained": []}
    if reported.names:
        found["added_variable"] = _added_variable(Regression.of(reported), reported)
    if told:
        regression = Regression.of(selection)
        found["unexplained"] = [_unexplained(regression, selection, entry, noise) for entry in told]
    return found


def _added_variable(regression: Regression, selection: Selection) -> JSON:
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
    told = np.array(
        [regression.observations.weight @ x**2 / sigma[c] ** 2 for (c, _), x in zip(chosen, left_of, strict=True)]
    )
    panels = []
    for (c, j), left, share in zip(chosen, left_of, told / told.sum(), strict=True):
        if term.effect.layout == Layout.SHARED and share < LEAST_SHARE:
            continue
        value, bins = float(term.values[j]), Bins.of(left, regression.observations.weight)
        coefficient = {"parameter": described[j].name, "unit": described[j].unit, "value": value}
        panels.append(
            {"axis": "xyz"[c], **coefficient, "standard_uncertainty": float(uncertainty[j])}
            | bins.document(value * left + white[:, c], sigma[c] ** 2 / bins.weight)
        )
    return {"effect": selection.names[0], "unit": unit_of(sensor), "panels": panels}


def _clearest(regression: Regression, term: Term, at: int, clear: Values, sensor: str) -> list[tuple[int, int]]:
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


def _unexplained(regression: Regression, selection: Selection, entry: Mapping[str, Any], noise: Noise | None) -> JSON:
    """Return the residual against a covariate, and the suggested shape."""
    signal, given = _signal_and_shape(selection, entry)
    setting, values = _expected(noise), _values(selection, signal)
    sigma = regression.white_noise(regression.residual - regression.wander(selection.fit.setting))
    bins = Bins.of(values[:, 0], regression.observations.weight)
    wander = _wander_of_means(bins, regression, noise)
    panels = []
    for c, (shape, coefficients) in enumerate(given):
        if c > 0 and signal == "u":
            bins = Bins.of(values[:, c], regression.observations.weight)
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


def _wander_of_means(bins: Bins, regression: Regression, noise: Noise | None) -> Values:
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
    """Return the suggested shape at even steps of its signal."""
    grid = np.linspace(float(np.nanmin(values)), float(np.nanmax(values)), CURVE)
    columns = np.stack([np.broadcast_to(parse(text)({signal: grid}), grid.shape) for text in formulas], axis=1)
    return {"curve_x": rounded(grid), "curve": rounded(columns @ np.asarray(coefficients, float))}
