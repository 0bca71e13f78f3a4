"""Moves whose error is many times their noise: found, told, and weighted as errors of Student's t distribution.

With r_k the two whitened residuals of move k and s the scale by which half of all moves lie within the median of the
chi distribution with two degrees of freedom,

    t_k = |r_k| / s,    s = median |r_k| / sqrt(2 log 2)

a move is outlying where ``t_k^2 > 2 log(k / p)``, which one of k sound moves exceeds with the probability p. Where one
is, all moves are weighted by ``w = min(1, (v + 2) / (v + t^2))``: a move of weight w has 1/w times its variance. These
are the weights of the t distribution with v = 4 degrees of freedom (Lange, Little & Taylor, Robust statistical modeling
using the t distribution, JASA 84 (1989), 881-896).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from pipeline.estimation.multi_position.fit import HandFit
    from pipeline.estimation.multi_position.gyroscope import HandHeldGyroscope
    from pipeline.records import Recording

    Values = NDArray[np.float64]

FALSE_ALARM = 1e-3
FREEDOM = 4.0
ROUNDS = 6
SETTLED = 0.05  # of a weight


@dataclass(frozen=True)
class Outlying:
    """Moves off the others: index, how many times their noise each is off, its error in deg, and its weight."""

    index: NDArray[np.intp]
    times: Values
    error: Values
    weight: Values


def fit_robustly(
    model: HandHeldGyroscope, fitted: Callable[[HandHeldGyroscope], HandFit]
) -> tuple[HandHeldGyroscope, HandFit, Outlying]:
    """Fit moves, those that contradict the others with less weight.

    Parameters
    ----------
    model : HandHeldGyroscope
        With moves.
    fitted : callable
        Fits a model.
    """
    found = fitted(model)
    t, error = _off(model, found)
    outlying = np.flatnonzero(t**2 > 2.0 * np.log(len(t) / FALSE_ALARM))
    excess, weight = np.zeros(len(t)), np.ones(len(t))
    for _ in range(ROUNDS if len(outlying) else 0):
        before, weight = weight, np.minimum(1.0, (FREEDOM + 2.0) / (FREEDOM + t**2))
        if np.abs(weight - before).max() < SETTLED:
            break
        variance = np.where(t > 0.0, (error / np.maximum(t, 1e-12)) ** 2, 0.0)
        excess = variance * (1.0 / weight - 1.0)
        model = model.with_excess(excess)
        found = fitted(model)
        t, error = _off(model, found, excess)
    outlying = np.flatnonzero(t**2 > 2.0 * np.log(len(t) / FALSE_ALARM)) if len(outlying) else outlying
    return model, found, Outlying(outlying, t[outlying], error[outlying], weight[outlying])


def _off(model: HandHeldGyroscope, found: HandFit, excess: Values | float = 0.0) -> tuple[Values, Values]:
    """Return t of each move, and by how much it misses gravity, deg."""
    first = model.rests_equations
    own = np.asarray(excess) * np.ones((len(found.residual) - first) // 2)
    C = model.equations(found.state).covariance(found.noise)
    error = found.error[first:].reshape(-1, 2)
    r = (found.residual[first:].reshape(-1, 2)) * error
    variance = np.diag(C)[first:].reshape(-1, 2) * error**2 - own[:, None]
    size = np.sqrt(np.sum(r**2 / variance, axis=1))
    scale = float(np.median(size)) / np.sqrt(2.0 * np.log(2.0))
    return size / max(scale, 1e-12), np.linalg.norm(r, axis=1)


def described(outlying: Outlying, model: HandHeldGyroscope, recordings: Sequence[Recording]) -> list[dict[str, Any]]:
    """Return the moves that were found outlying, as JSON."""
    moves = model.moves
    assert moves is not None  # noqa: S101
    return [
        {
            "recording": recordings[int(model.every.recording[moves.after[k]])].name,
            "time_s": float(moves.time[k, 0]),
            "error_deg": float(error),
            "over_noise": float(times),
            "weight": float(weight),
        }
        for k, times, error, weight in zip(outlying.index, outlying.times, outlying.error, outlying.weight, strict=True)
    ]
