"""Least-squares problems of arrays by the steps of every fit by hand; derivatives by a complex step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.core.records.calibration import COSINE_AT_MINIMUM
from pipeline.estimation.engine import ScaledColumns, linear_convergence
from pipeline.estimation.multi_position.fit import MAX_STEP_HALVINGS

if TYPE_CHECKING:
    from collections.abc import Callable

    Function = Callable[[np.ndarray[Any, Any]], np.ndarray[Any, Any]]

STEP_AT_MINIMUM = 1e-10  # relative; well below any uncertainty, well above rounding
SUM_OF_SQUARES_ROUNDING = 1e-10  # relative, of a sum of squares of small differences of large values
STEP = 1e-30  # there is no difference, so that nothing cancels (Squire & Trapp, SIAM Review 40, 1998)


def jacobian_of(function: Function) -> Function:
    """Return the derivative of an analytic function (no abs, no comparison), ``Im f(x + i h e_j) / h``."""

    def jacobian(x: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        return np.stack([np.imag(function(x + 1j * STEP * e)) / STEP for e in np.eye(len(x))], axis=1)

    return jacobian


@dataclass(frozen=True)
class Solved:
    """Parameters, the columns and residuals there, and what these say."""

    x: np.ndarray[Any, Any]
    columns: np.ndarray[Any, Any]
    residual: np.ndarray[Any, Any]

    @property
    def degrees_of_freedom(self) -> int:
        return len(self.residual) - len(self.x)

    @property
    def covariance(self) -> np.ndarray[Any, Any]:
        """Covariance of the parameters by the scatter of the residuals."""
        variance = self.residual @ self.residual / self.degrees_of_freedom
        weights = ScaledColumns.of(self.columns).weights()
        return np.asarray(variance * weights @ weights.T)

    @property
    def standard_uncertainty(self) -> np.ndarray[Any, Any]:
        return np.sqrt(np.diag(self.covariance))

    @property
    def cosine(self) -> float:
        """Largest cosine between the residual and a column."""
        return float(linear_convergence(self.columns, self.residual, 1.0, len(self.x)).cosine)

    @property
    def converged(self) -> bool:
        """Whether the residual is orthogonal to the columns, or the next step below the rounding of x."""
        step = ScaledColumns.of(self.columns).solve(self.residual)
        return self.cosine <= COSINE_AT_MINIMUM or bool(np.all(np.abs(step) <= STEP_AT_MINIMUM * np.abs(self.x)))


def solve_linear(A: np.ndarray[Any, Any], y: np.ndarray[Any, Any]) -> Solved:
    """Return the minimum of ``|y - A x|``."""
    x = ScaledColumns.of(A).solve(y)
    return Solved(x, A, y - A @ x)


def solve_nonlinear(residuals: Function, start: np.ndarray, jacobian: Function, steps: int = 50) -> Solved:
    """Return the minimum of ``|residuals(x)|`` near a start, by halved Gauss-Newton steps."""
    with np.errstate(all="ignore"):  # steps that overflow do not lower the sum of squares
        x, size = np.array(start, float), np.inf
        r, J = residuals(x), jacobian(x)
        for _ in range(steps):
            factors = ScaledColumns.of(J)
            step, before = -factors.solve(r), r @ r
            for halving in range(MAX_STEP_HALVINGS):
                taken = step * 0.5**halving
                r_new, J_new = residuals(x + taken), jacobian(x + taken)
                allowed = before * (1.0 + (SUM_OF_SQUARES_ROUNDING if halving == 0 else 0.0))
                if r_new @ r_new < allowed and np.all(np.isfinite(J_new)):
                    break
            else:
                break
            size, last = float(np.linalg.norm(taken * factors.scale)), size
            stalled = size >= last and r_new @ r_new >= (1.0 - SUM_OF_SQUARES_ROUNDING) * before
            x, r, J = x + taken, r_new, J_new
            if stalled or size <= STEP_AT_MINIMUM * np.linalg.norm(r):
                break
    return Solved(x, J, r)
