"""A Monte Carlo run beside the uncertainty budget of a fit to rests and moves, to second order of the model.

The errors of the equations are drawn under every noise that is believed, by its weight, and solved for with the weights
of that noise, as the fit averages over them; what is believed of the parameters stands beside them as equations of its
own, ``sqrt(P) p = 0 +- 1``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.estimation.engine import draw_normal
from pipeline.estimation.monte_carlo import beside_trials, quadratic_results
from pipeline.estimation.multi_position.model import stepped

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from pipeline.estimation.multi_position.fit import HandFit
    from pipeline.estimation.multi_position.model import Model
    from pipeline.records import Contribution, SensorCalibration

    Values = NDArray[np.float64]

STEP = 0.1  # of a standard uncertainty: the columns are differentiated where they are used


def tried_by_hand(
    calibration: SensorCalibration, model: Model, found: HandFit, trials: int, direct: Sequence[Contribution]
) -> SensorCalibration:
    """Return a calibration by hand whose budget also holds a Monte Carlo run.

    Parameters
    ----------
    calibration : SensorCalibration
        With its budget.
    model : Model
    found : HandFit
    trials : int
    direct : sequence of Contribution
        Sources of type B.
    """
    equations = model.equations(found.state)
    X, base = equations.columns, model.directions.shape[1]
    n, p = X.shape
    believed = np.flatnonzero(found.precision > 0.0)
    rows = np.zeros((len(believed), p))
    rows[np.arange(len(believed)), believed] = np.sqrt(found.precision[believed])
    X, H = np.concatenate([X, rows]), np.zeros((n + len(believed), p, p))
    H[:n] = _curvature(model, found, p)
    candidates = [np.eye(len(X)) for _ in found.candidates]
    for covariance, (noise, _, scale) in zip(candidates, found.candidates, strict=True):
        covariance[:n, :n] = scale * equations.covariance(noise)
    solvers = [quadratic_results(X, H, np.asarray(np.linalg.pinv(c, hermitian=True), float)) for c in candidates]
    weight = np.array([w for _, w, _ in found.candidates])
    place = np.zeros((12 + p - base, p))
    place[:12, :base], place[12:, base:] = model.directions, np.eye(p - base)
    effects = [value for term in found.state.terms for value in term.values]
    estimate = np.concatenate([found.state.bias, found.state.matrix.ravel(), effects])

    def draw(rng: np.random.Generator, count: int) -> Values:
        chosen, steps = rng.choice(len(weight), count, p=weight), np.empty((count, p))
        for k in np.unique(chosen):
            own = chosen == k
            steps[own] = solvers[k](draw_normal(rng, candidates[k], int(np.count_nonzero(own))))
        return np.asarray(estimate + steps @ place.T)

    return beside_trials(calibration, draw, trials, direct)


def _curvature(model: Model, found: HandFit, parameters: int) -> Values:
    """Return the derivative of the columns with respect to the parameters: (n, p, p) array, symmetric."""
    slopes = []
    for j, u in enumerate(np.sqrt(np.diag(found.covariance))):
        step = np.zeros(parameters)
        step[j] = STEP * u
        (up, more), (down, less) = (stepped(model, found.state, sign * step) for sign in (1.0, -1.0))
        change = model.equations(up).columns - model.equations(down).columns
        slopes.append(change / (more[j] - less[j]) if step[j] > 0.0 else np.zeros_like(change))
    H = np.stack(slopes, axis=2)
    return np.asarray(0.5 * (H + H.transpose(0, 2, 1)))
