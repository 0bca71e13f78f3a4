"""The picture of what rests by hand say of the first selected effect: an added-variable plot, a point a rest.

For one coefficient gamma, with x its column and r the residual, both whitened by the most likely noise,

    x~ = what all other columns leave of x,      y~ = gamma x~ + r

so that the line of least squares through the points has the slope gamma (Frisch, Waugh and Lovell; see
``pipeline.diagnosis.pictures``). Both are shown times the error that white noise typically gives a rest, which brings
them back to the sensor's unit. An effect that mostly shows in the moves has no such picture.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.estimation.multi_position.fit import solve
from pipeline.model.effects.base import Layout, unit_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from pipeline.estimation.multi_position.selection import Selection
    from pipeline.model.effects.base import Effect

    Values = NDArray[np.float64]

AT_REST = 0.9  # share of a column's power


def added_variable(selection: Selection) -> dict[str, Any] | None:
    """Return the added-variable plot of the first selected effect: its clearest coefficient on each axis.

    Parameters
    ----------
    selection : Selection

    Returns
    -------
    dict or None
        ``effect, unit, panels``, each panel with ``axis, parameter, unit, value, standard_uncertainty`` and, a number
        a rest, ``x, mean, standard_error``; None where nothing is selected or it does not show at rest.
    """
    if not selection.names:
        return None
    model, found = selection.model, selection.fits[-1]
    order = [term.effect.name for term in found.state.terms].index(selection.names[0])
    term = found.state.terms[order]
    first = model.directions.shape[1] + sum(len(t.values) for t in found.state.terms[:order])
    equations = model.equations(found.state)
    columns = equations.columns
    white, _ = equations.whitened(found.noise, np.column_stack([columns, equations.residual]))
    scale = solve(equations, found.noise, *np.zeros((2, columns.shape[1]))).scale
    rests = slice(0, model.rests_equations)
    size = float(np.median(equations.error[rests]))
    uncertainty = np.sqrt(np.diag(found.covariance))[first : first + len(term.values)]
    described = term.effect.parameters(model.sensor)
    panels = []
    for axis, j in _clearest(term.effect, model.sensor, np.abs(term.values) / uncertainty):
        left = _left(white[:, :-1], first + j)
        if np.sum(left[rests] ** 2) < AT_REST * np.sum(left**2):
            return None
        points = (term.values[j] * left + white[:, -1])[rests] * size
        shown = np.argsort(left[rests], kind="stable")
        panels.append(
            {
                "axis": axis,
                "parameter": described[j].name,
                "unit": described[j].unit,
                "value": float(term.values[j]),
                "standard_uncertainty": float(uncertainty[j]),
                "x": (left[rests] * size)[shown].tolist(),
                "mean": points[shown].tolist(),
                "standard_error": [size * float(np.sqrt(scale))] * len(shown),
            }
        )
    return {"effect": selection.names[0], "unit": unit_of(model.sensor), "panels": panels}


def _left(columns: Values, j: int) -> Values:
    """Return what the other columns leave of column j: (n,) array."""
    others = np.delete(columns, j, axis=1)
    size = np.linalg.norm(others, axis=0)
    found = np.linalg.lstsq(others / np.where(size > 0.0, size, 1.0), columns[:, j], rcond=1e-8)[0]
    return np.asarray(columns[:, j] - others / np.where(size > 0.0, size, 1.0) @ found)


def _clearest(effect: Effect, sensor: str, clear: Values) -> Sequence[tuple[str, int]]:
    """Return the clearest linear coefficient on each axis, all of one unit; one alone where the axes share them."""
    described = effect.parameters(sensor)
    clear = np.where([p.name in effect.nonlinear for p in described], -1.0, clear)
    best = int(np.argmax(clear))
    if effect.layout == Layout.SHARED:
        return [("x", best)]
    clear = np.where([p.unit == described[best].unit for p in described], clear, -1.0)
    of_axis = np.flatnonzero([p.name not in effect.nonlinear for p in described]).reshape(3, -1)
    return [(axis, int(own[np.argmax(clear[own])])) for axis, own in zip("xyz", of_axis, strict=True)]
