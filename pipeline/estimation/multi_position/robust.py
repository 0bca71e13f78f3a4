"""Fit rests and moves with less weight of outlying moves.

A move is an outlier if, with its two whitened residuals r_k and the scale s of the median move,

    t_k = |r_k| / s,   s = median |r_k| / sqrt(2 log 2),   t_k^2 > 2 log(k / p)

which one of k valid moves exceeds with the probability p. If there is an outlier, all moves have the weights
``min(1, (v + 2) / (v + t^2))`` of Student's t with v = 4 degrees of freedom: a move of weight w has 1/w times its
variance. Source: Lange, Little & Taylor, JASA 84 (1989), 881-896.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from pipeline.core.records import Recording, Values
    from pipeline.estimation.multi_position.fit import FitByHand
    from pipeline.estimation.multi_position.gyroscope import GyroscopeModel

OUTLIER_FALSE_ALARM, FREEDOM = 1e-3, 4.0  # p and v
ROBUST_ROUNDS, SETTLED_WEIGHT_CHANGE = 6, 0.05  # weights that change by less are final


def fit_robustly(
    model: GyroscopeModel, fit_model: Callable[..., FitByHand], recordings: Sequence[Recording]
) -> tuple[GyroscopeModel, FitByHand, list[dict[str, Any]]]:
    """Fit rests and moves, with weights of Student's t if a move is an outlier.

    ``fit_model``: function that fits a model, from ``start`` and what is ``known`` of it if given (``fit``). Returns
    model and fit with the variance by the weights, and the outliers: ``recording, time_s, error_deg, over_noise,
    weight``.
    """
    fitted, moves = fit_model(model), model.moves
    if moves is None:
        return model, fitted, []
    t, error = _over_noise(model, fitted)
    limit = np.sqrt(2.0 * np.log(len(t) / OUTLIER_FALSE_ALARM))
    if not np.any(t > limit):
        return model, fitted, []
    weight = np.ones(len(t))
    for _ in range(ROBUST_ROUNDS):
        before, weight = weight, np.minimum(1.0, (FREEDOM + 2.0) / (FREEDOM + t**2))
        if np.abs(weight - before).max() < SETTLED_WEIGHT_CHANGE:
            break
        variance = np.where(t > 0.0, (error / np.maximum(t, 1e-12)) ** 2, 0.0)
        model = model.with_excess(variance * (1.0 / weight - 1.0))
        fitted = fit_model(model, start=fitted.state, known=(model.equations(fitted.state), fitted.scores))
        t, error = _over_noise(model, fitted)
    outlying = [
        {
            "recording": recordings[int(model.every.recording[moves.after[k]])].name,
            "time_s": float(moves.time[k, 0]),
            "error_deg": float(error[k]),
            "over_noise": float(t[k]),
            "weight": float(weight[k]),
        }
        for k in np.flatnonzero(t > limit)
    ]
    return model, fitted, outlying


def _over_noise(model: GyroscopeModel, fitted: FitByHand) -> tuple[Values, Values]:
    """Return t of each move, and its residual, deg."""
    C = fitted.equations.covariance(fitted.noise)
    error = fitted.error[model.of_moves].reshape(-1, 2)
    r = fitted.residual[model.of_moves].reshape(-1, 2) * error
    variance = np.diag(C)[model.of_moves].reshape(-1, 2) * error**2 - model.excess[:, None]
    size = np.sqrt(np.sum(r**2 / variance, axis=1))
    scale = float(np.median(size)) / np.sqrt(2.0 * np.log(2.0))
    return size / max(scale, 1e-12), np.linalg.norm(r, axis=1)
