"""Residuals of rests: covariates on which they depend, and the added-variable plot of the first selected effect.

A covariate is tested by curves with coefficients of their own in every axis, given base and selected effects:

    time, temperature : Chebyshev polynomials of degree 1 to d over their span, d = 2 and 3
    specific_force    : those of degree 4 and 5 of the axis' own component; the catalogue has those below

It is named where one of its tests has delta BIC > 10 and m p < 1e-3, m the number of all tests.

The plot shows one coefficient gamma, a point a rest. With x its column and r the residual, both whitened by the most
likely noise, and x~ what all other columns leave of x, the points ``(x~, gamma x~ + r)`` have a line of least squares
with the slope gamma (Frisch, Waugh and Lovell; see ``pipeline.diagnosis.residual_plots``). Both are shown times the
median white error of a rest, in the sensor's unit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.estimation.design import Term
from pipeline.estimation.multi_position.fit import solve
from pipeline.estimation.multi_position.likelihood import project_out
from pipeline.estimation.selection import GATE_BIC
from pipeline.model.effects.base import Effect, Layout, Owner, Parameter, unit_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from pipeline.estimation.multi_position.selection import Selection
    from pipeline.records import Motion

    Values = NDArray[np.float64]

GATE_P = 1e-3
AT_REST = 0.9  # share of a column's power
LEAST_SPAN = 1.0  # s or degC


class Curves(Effect):
    """Curves in a covariate: (n, 3, q) for a motion, an axis' own q."""

    owner = Owner.RECORDING
    layout = Layout.PER_AXIS
    excitation = "recordings in which the covariate changes"
    source = "Chebyshev polynomials"

    def __init__(self, name: str, curves: Callable[[Motion], Values], count: int) -> None:
        self._name, self._curves, self._count = name, curves, count

    @property
    def name(self) -> str:  # type: ignore[override]  # curves are named after their covariate
        """Name of the covariate."""
        return self._name

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return the coefficients."""
        del sensor
        return tuple(Parameter(f"{a}_{j}", "1", "coefficient") for a in "xyz" for j in range(self._count))

    def regressors(self, sensor: str, motion: Motion, K: Values, values: Values) -> Values:
        """Return the curves."""
        del sensor, K, values
        return self._curves(motion)


def dependences(selection: Selection) -> list[dict[str, Any]]:
    """Return the covariates on which the residual still depends, each with its p-value, the likeliest first.

    Parameters
    ----------
    selection : Selection
    """
    from scipy.special import chdtrc  # noqa: PLC0415  (0.1 s that only a diagnosis pays)

    curves = _curves_of(selection)
    terms = [Term(c, np.zeros(len(c.parameters(selection.model.sensor)))) for c in curves]
    equations = selection.model.equations(selection.fits[-1].state, terms)
    found = project_out(equations, selection.hypotheses)
    before, at = found.of_model()
    named: dict[str, tuple[float, float]] = {}
    for j, this in enumerate(curves):
        count = found.count(j, at)
        factor = found.correction(j, at, count, equations.scatter) if count else 0.0
        gain = factor * max(2.0 * (found.with_candidate(j)[0] - before), 0.0)
        delta = gain - count * float(np.log(len(equations.residual)))
        p = float(chdtrc(max(count, 1), gain))
        if delta > GATE_BIC and p * len(curves) < GATE_P and delta > named.get(this.name, (0.0, 1.0))[0]:
            named[this.name] = (delta, p)
    ordered = sorted(named.items(), key=lambda item: -item[1][0])
    return [{"covariate": name, "p_value": p} for name, (_, p) in ordered]


def _curves_of(selection: Selection) -> list[Curves]:
    rests = selection.model.rests
    curves = []
    if np.ptp(rests.time) > LEAST_SPAN and rests.clock_shared:
        curves += [Curves("time", _along(lambda m: m.time, rests.time, d), d) for d in (2, 3)]
    if not np.isnan(rests.temperature).any() and np.ptp(rests.temperature) > LEAST_SPAN:
        curves += [Curves("temperature", _along(lambda m: m.temperature, rests.temperature, d), d) for d in (2, 3)]
    if selection.model.sensor == "accelerometer":
        curves.append(Curves("specific_force", _force, 2))
    return curves


def _along(of: Callable[[Motion], Values | None], values: Values, degree: int) -> Callable[[Motion], Values]:
    low, high = float(values.min()), float(values.max())

    def curves(motion: Motion) -> Values:
        value = of(motion)
        assert value is not None  # noqa: S101
        scaled = np.asarray(2.0 * (value - low) / (high - low) - 1.0)
        powers = np.polynomial.chebyshev.chebvander(scaled, degree)[:, 1:]
        return np.asarray(np.broadcast_to(powers[:, None, :], (len(scaled), 3, degree)), np.float64)

    return curves


def _force(motion: Motion) -> Values:
    return np.asarray(np.polynomial.chebyshev.chebvander(motion.specific_force, 5)[:, :, 4:], np.float64)


def added_variable(selection: Selection) -> dict[str, Any] | None:
    """Return the added-variable plot of the first selected effect: its clearest coefficient on each axis.

    Returns
    -------
    dict or None
        ``effect, unit, panels``, each panel with ``axis, parameter, unit, value, standard_uncertainty`` and, a number
        a rest, ``x, mean, standard_error``; None where nothing is selected or it shows mostly in the moves.
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
