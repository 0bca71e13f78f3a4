"""Least-squares problems of arrays by the steps of every fit by hand; derivatives by a complex step."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.estimation.least_squares import LeastSquaresResult, ScaledColumns, gauss_newton

if TYPE_CHECKING:
    from collections.abc import Callable

    Function = Callable[[np.ndarray[Any, Any]], np.ndarray[Any, Any]]

STEP = 1e-30  # there is no difference, so that nothing cancels (Squire & Trapp, SIAM Review 40, 1998)


def jacobian_of(function: Function) -> Function:
    """Return the derivative of an analytic function (no abs, no comparison), ``Im f(x + i h e_j) / h``."""

    def jacobian(x: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        return np.stack([np.imag(function(x + 1j * STEP * e)) / STEP for e in np.eye(len(x))], axis=1)

    return jacobian


def solve_nonlinear(residuals: Function, start: np.ndarray, jacobian: Function, steps: int = 50) -> LeastSquaresResult:
    """Return the minimum of ``|residuals(x)|`` near a start, and what it determines."""
    with np.errstate(all="ignore"):  # steps that overflow do not lower the sum of squares
        x, (r, J), _ = gauss_newton(
            lambda x: (residuals(x), jacobian(x)), np.array(start, float), lambda x, step: (x + step, step), None, steps
        )
    factors = ScaledColumns.of(J)
    factors.require_full_rank()
    return LeastSquaresResult.of(x, r, J, factors, None)
