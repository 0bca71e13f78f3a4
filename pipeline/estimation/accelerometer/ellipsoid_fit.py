"""The ellipsoid that an accelerometer at rest draws: bias and a triangular matrix from the length of gravity.

    u = L (y - b),   L = T S,   minimise  sum_i w_i (|u_i| - G_i)^2

where

    y : (3,) mean reading in one orientation, g
    b : (3,) bias, g
    S : diagonal scale factors
    T : unit lower triangular misalignment
    G : local gravity, g; of a mean of n samples with noise s on each axis sqrt(G^2 + 2 s^2 / n), since noise
        across a vector lengthens it
    w : 1 / (s^2 / n + s_r^2)

``s`` is the scatter within the rests; ``s_r`` is what their means scatter beyond it (tremor, bias wander, what the
model leaves out), so large that the residuals have the size that the weights say (Mandel & Paule 1970).

The start is the ellipsoid ``p . (x^2, y^2, z^2, 2xy, 2xz, 2yz, 2x, 2y, 2z) = 1``, that is ``y^T Q y + 2 h^T y = 1``. It
is linear in p; its centre is ``b = -Q^-1 h``, and ``L^T L = Q G^2 / (1 + b^T Q b)``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import NotObservableError
from pipeline.estimation.least_squares import solve_linear, solve_nonlinear

if TYPE_CHECKING:
    from pipeline.estimation.accelerometer.orientations import Orientations
    from pipeline.estimation.least_squares import LeastSquaresResult
    from pipeline.records import Mask, Values

ROWS, COLUMNS = np.tril_indices(3)
NAMES = [f"bias_{axis}" for axis in "xyz"] + [
    f"scale_factor_{'xyz'[i]}" if i == j else f"misalignment_{'xyz'[i]}{'xyz'[j]}"
    for i, j in zip(ROWS, COLUMNS, strict=True)
]
MISALIGNMENT = np.concatenate([np.zeros(3, bool), ROWS != COLUMNS])
IDEAL = np.concatenate([np.zeros(3), np.eye(3)[ROWS, COLUMNS]])  # the nine values of an ideal sensor
ROUNDS = 20  # of s_r^2 and the fit, one after the other


@dataclass(frozen=True)
class Ellipsoid:
    """Parameters of ``u = L (y - b)`` and how well they fit."""

    values: Values  # (9,); b, then the lower triangle of L row by row
    free: Mask  # (9,); those that were fitted
    fit: LeastSquaresResult  # its residuals are ``weight * error``
    weight: Values  # (m,), 1/g; square root of w
    error: Values  # (m,), g; |u| - G
    between: float  # g; s_r

    @property
    def bias(self) -> Values:
        """Bias: (3,) array, g."""
        return self.values[:3]

    @property
    def matrix(self) -> Values:
        """L = T S: (3, 3) array."""
        return triangle(self.values)

    @property
    def standard_uncertainty(self) -> Values:
        """Standard uncertainty of the values, 0 for those that were not fitted: (9,) array."""
        out = np.zeros(9)
        out[self.free] = self.fit.standard_uncertainty
        return out


def triangle(values: Values) -> Values:
    """Return L of the nine values: (3, 3) array."""
    L = np.zeros((3, 3))
    L[ROWS, COLUMNS] = values[3:]
    return L


def error_of(y: Values, target: Values, values: Values) -> Values:
    """Return |L (y - b)| less its target: (m,) array, g."""
    return np.asarray(np.linalg.norm((y - values[:3]) @ triangle(values).T, axis=1) - target)


def derivative_of(y: Values, values: Values) -> Values:
    """Return the derivative of |L (y - b)| with respect to the nine values: (m, 9) array.

    ``d/db = -L^T n`` and ``d/dL_ij = n_i (y - b)_j``, with ``n = u / |u|``.
    """
    L, centred = triangle(values), y - values[:3]
    u = centred @ L.T
    n = u / np.linalg.norm(u, axis=1, keepdims=True)
    return np.concatenate([-n @ L, n[:, ROWS] * centred[:, COLUMNS]], axis=1)


def fit_ellipsoid(orientations: Orientations, gravity_g: float, free: Mask) -> Ellipsoid:
    """Fit some of the nine values; the others stay those of an ideal sensor.

    ``free``: (9,). Raises ``NotObservableError`` if the orientations do not determine them.
    """
    y, variance = orientations.mean, orientations.variance
    target = np.sqrt(gravity_g**2 + 2.0 * variance)
    values = _start(y, gravity_g, free)
    spare, excess = len(y) - int(free.sum()), 0.0
    for _ in range(ROUNDS):
        weight = 1.0 / np.sqrt(variance + excess)
        found = _weighted_fit(y, target, weight, values, free)
        values = _insert(values, free, found.x)
        error = error_of(y, target, values)
        before, excess = excess, _excess_variance(error, variance, spare)
        if abs(excess - before) <= 1e-6 * (excess + float(variance.min())):
            break
    return Ellipsoid(values, free, found, weight, error, float(np.sqrt(excess)))


def _weighted_fit(y: Values, target: Values, weight: Values, start: Values, free: Mask) -> LeastSquaresResult:
    def residuals(x: Values) -> Values:
        return weight * error_of(y, target, _insert(start, free, x))

    def jacobian(x: Values) -> Values:
        return weight[:, None] * derivative_of(y, _insert(start, free, x))[:, free]

    names = [name for name, is_free in zip(NAMES, free, strict=True) if is_free]
    return solve_nonlinear(residuals, start[free], jacobian, sigma=1.0, names=names)


def _insert(values: Values, free: Mask, x: Values) -> Values:
    out = values.copy()
    out[free] = x
    return out


def _start(y: Values, gravity_g: float, free: Mask) -> Values:
    """Return the values of the ellipsoid through the readings, or those of an ideal sensor where they draw none."""
    tilted = bool(free[MISALIGNMENT].all())
    products = 2.0 * y[:, [0, 0, 1]] * y[:, [1, 2, 2]]
    columns = [y**2, products, 2.0 * y] if tilted else [y**2, 2.0 * y]
    try:
        p = solve_linear(np.concatenate(columns, axis=1), np.ones(len(y)), sigma=1.0).x
    except NotObservableError:
        return IDEAL
    xy, xz, yz = p[3:6] if tilted else np.zeros(3)
    Q = np.array([[p[0], xy, xz], [xy, p[1], yz], [xz, yz, p[2]]])
    if np.min(np.linalg.eigvalsh(Q)) <= 0:
        return IDEAL
    b = -np.linalg.solve(Q, p[-3:])
    scaled = Q * gravity_g**2 / (1.0 + b @ Q @ b)
    reverse = np.linalg.cholesky(scaled[::-1, ::-1])[::-1, ::-1]  # upper triangular U with U U^T = L^T L
    found = np.concatenate([b, reverse.T[ROWS, COLUMNS]])
    return np.where(free, found, IDEAL)


def _excess_variance(error: Values, variance: Values, spare: int) -> float:
    """Return s_r^2 >= 0 so that ``sum error^2 / (variance + s_r^2)`` is its degrees of freedom, ``spare``."""
    if spare < 1 or np.sum(error**2 / variance) <= spare:
        return 0.0
    low, high = 0.0, float(np.sum(error**2)) / spare
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if np.sum(error**2 / (variance + middle)) > spare else (low, middle)
    return high
