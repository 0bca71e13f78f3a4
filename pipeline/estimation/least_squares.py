"""Least squares, linear and nonlinear, with a certificate.

The estimate minimises the sum of squares of the residuals:

    x = argmin |r(x)|^2,    covariance = sigma^2 (J^T J)^-1

where

    r     : (n,) residuals; for the linear problem r = y - A x
    J     : (n, p) derivative of r with respect to x
    sigma : standard deviation of one residual: given, or sqrt(|r|^2 / (n - p))

Each step is solved by QR of the columns scaled to unit norm (``pipeline.estimation.scaled_columns``). The nonlinear
problem is approached by a trust region (Branch, Coleman & Li, SIAM J. Sci. Comput. 21, 1999) and finished by
Gauss-Newton steps, halved while they do not help.

A success flag proves nothing; the largest cosine between the residual and a column of the Jacobian does: at a minimum
the residual is orthogonal to all of them (Bates & Watts, Nonlinear Regression Analysis, 1988, section 2.2.3).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import NotObservableError
from pipeline.estimation.complex_step import complex_step_jacobian
from pipeline.estimation.scaled_columns import factorise

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from pipeline.estimation.scaled_columns import ScaledColumns

    Function = Callable[[NDArray[np.float64]], NDArray[np.float64]]

COSINE_AT_MINIMUM = 1e-7
STEP_AT_MINIMUM = 1e-10
ROUNDING = 1e-10  # relative, of a sum of squares of small differences of large values


@dataclass(frozen=True)
class LeastSquaresResult:
    """The outcome of a least-squares problem with n residuals and p parameters.

    Attributes
    ----------
    x : (p,) array
    covariance : (p, p) array
    residual : (n,) array
        As minimised, that is weighted where weights were given.
    sigma : float
        Standard deviation of one residual, as used for the covariance.
    degrees_of_freedom : int
        n - p.
    rank : int
    condition : float
        Condition number of the Jacobian with its columns scaled to unit norm.
    cosine : float
        Largest |cosine| between the residual and a column of the Jacobian.
    converged : bool
        Whether the residual is orthogonal to the columns, or the next step is below the rounding of x.
    evaluations : int
        Of the residual function.
    """

    x: NDArray[np.float64]
    covariance: NDArray[np.float64]
    residual: NDArray[np.float64]
    sigma: float
    degrees_of_freedom: int
    rank: int
    condition: float
    cosine: float
    converged: bool
    evaluations: int

    @property
    def standard_uncertainty(self) -> NDArray[np.float64]:
        """Standard uncertainty of each parameter: (p,) array."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def residual_rms(self) -> float:
        """Root mean square of the residuals."""
        return float(np.sqrt(np.mean(self.residual**2)))


def solve_linear(
    A: NDArray[np.float64],
    y: NDArray[np.float64],
    sigma: float | None = None,
    names: Sequence[str] | None = None,
) -> LeastSquaresResult:
    """Solve ``min |y - A x|``.

    Parameters
    ----------
    A : (n, p) array
    y : (n,) array
    sigma : float, optional
        Standard deviation of one residual; None estimates it from the residuals.
    names : sequence of str, optional
        Names of the parameters, for the message where they are not determined.

    Returns
    -------
    LeastSquaresResult

    Raises
    ------
    NotObservableError
        If the columns are linearly dependent or fewer equations than parameters are given.
    """
    factors = factorise(A)
    factors.require_full_rank(names)
    x = factors.solve(y)
    residual = y - A @ x
    x += factors.solve(residual)  # one refinement recovers the digits that ill-conditioned columns cost
    return _result(x, y - A @ x, A, factors, sigma=sigma, evaluations=1)


def solve_nonlinear(
    residuals: Function,
    start: NDArray[np.float64],
    jacobian: Function | None = None,
    *,
    sigma: float | None = None,
    names: Sequence[str] | None = None,
) -> LeastSquaresResult:
    """Minimise ``|residuals(x)|`` from a start that may be far off.

    Parameters
    ----------
    residuals : callable
        (p,) to (n,).
    start : (p,) array
    jacobian : callable, optional
        (p,) to (n, p). None differentiates by a complex step, for which ``residuals`` must be analytic (no abs).
    sigma, names
        As in ``solve_linear``.

    Returns
    -------
    LeastSquaresResult
        ``converged`` is False where the certificate fails; that is an outcome, no exception.

    Raises
    ------
    NotObservableError
        If the data do not determine all parameters.
    """
    from scipy.optimize import least_squares  # noqa: PLC0415  (0.5 s that only starts from far off need)

    jacobian = jacobian or complex_step_jacobian(residuals)
    with np.errstate(all="ignore"):  # steps that overflow are refused by the trust region
        approach = least_squares(
            residuals,
            start,
            jac=jacobian,
            method="trf",
            x_scale="jac",
            ftol=1e-15,
            xtol=1e-15,
            gtol=1e-15,
            max_nfev=5000,
        )
    return refine(residuals, approach.x, jacobian, sigma=sigma, names=names, spent=int(approach.nfev))


def refine(
    residuals: Function,
    start: NDArray[np.float64],
    jacobian: Function | None = None,
    *,
    sigma: float | None = None,
    names: Sequence[str] | None = None,
    iterations: int = 50,
    spent: int = 0,
) -> LeastSquaresResult:
    """Minimise ``|residuals(x)|`` from a good start by Gauss-Newton steps, each halved while it does not help.

    Parameters
    ----------
    residuals, start, jacobian, sigma, names
        As in ``solve_nonlinear``.
    iterations : int
        Limit on the number of steps.
    spent : int
        Evaluations already used, for the record.

    Returns
    -------
    LeastSquaresResult

    Raises
    ------
    NotObservableError
        If the data do not determine all parameters.
    """
    jacobian = jacobian or complex_step_jacobian(residuals)
    x = np.array(start, float)
    with np.errstate(all="ignore"):
        r = residuals(x)
        J = jacobian(x)
        _require_finite(r, J)
        factors = factorise(J)
        size = np.inf
        for _ in range(iterations):
            step = -factors.solve(r)
            x_new, r_new, tried = _halved(residuals, x, r, step)
            spent += tried
            if x_new is None or r_new is None:
                break
            small = bool(np.all(np.abs(x_new - x) <= STEP_AT_MINIMUM * np.abs(x_new)))
            size, before = float(np.linalg.norm(step * factors.scale)), size
            stalled = size > 0.5 * before and r_new @ r_new >= (1.0 - ROUNDING) * (r @ r)
            x, r = x_new, r_new
            J = jacobian(x)
            factors = factorise(J)
            if small or stalled:
                break
    factors.require_full_rank(names)
    return _result(x, r, J, factors, sigma=sigma, evaluations=spent)


def certificate(A: NDArray[np.float64], residual: NDArray[np.float64], condition: float, rank: int) -> dict[str, Any]:
    """Return what shows that a linear estimate is a minimum, as ``SensorCalibration.convergence`` holds it.

    Parameters
    ----------
    A : (n, p) array
        Columns, the same for each channel.
    residual : (n,) or (n, m) array
        Of m channels.
    condition : float
        Of the scaled columns.
    rank : int
    """
    products = np.abs(A.T @ residual)
    size = np.multiply.outer(np.linalg.norm(A, axis=0), np.linalg.norm(residual, axis=0))
    cosine = np.divide(products, size, out=np.zeros_like(products), where=size > 0.0)
    return certified(float(cosine.max()), condition, rank, A.shape[1])


def certified(cosine: float, condition: float, rank: int, parameters: int) -> dict[str, Any]:
    """Return the certificate of a fit as ``SensorCalibration.convergence`` holds it."""
    return {
        "cosine": cosine,
        "cosine_at_minimum": COSINE_AT_MINIMUM,
        "condition": condition if np.isfinite(condition) else None,
        "rank": rank,
        "parameters": parameters,
    }


def _halved(
    residuals: Function, x: NDArray[np.float64], r: NDArray[np.float64], step: NDArray[np.float64]
) -> tuple[NDArray[np.float64] | None, NDArray[np.float64] | None, int]:
    """Return the first of step, step/2, ... that lowers |r|, or None where none does.

    Near the minimum the sum of squares is flat to rounding while the step still has digits: there it may stay the same.
    """
    before = r @ r
    for tried in range(1, 31):
        x_new = x + step * 0.5 ** (tried - 1)
        r_new = residuals(x_new)
        if r_new @ r_new < before * (1.0 + (ROUNDING if tried == 1 else 0.0)):
            return x_new, r_new, tried
    return None, None, 30


def _require_finite(r: NDArray[np.float64], J: NDArray[np.float64]) -> None:
    if not (np.all(np.isfinite(r)) and np.all(np.isfinite(J))):
        raise NotObservableError(
            "residuals or their derivatives are not finite at the start: give a start nearer the solution, or check "
            "the readings for values that are not finite"
        )


def _result(
    x: NDArray[np.float64],
    r: NDArray[np.float64],
    J: NDArray[np.float64],
    factors: ScaledColumns,
    *,
    sigma: float | None,
    evaluations: int,
) -> LeastSquaresResult:
    dof = len(r) - len(x)
    norm = float(np.linalg.norm(r))
    if sigma is None:
        sigma = norm / np.sqrt(dof) if dof > 0 else 0.0
    cosine = float(np.max(np.abs(J.T @ r) / factors.scale) / norm) if norm > 0 else 0.0
    step = np.abs(factors.solve(r))
    settled = bool(np.all(step <= STEP_AT_MINIMUM * np.abs(x)))
    return LeastSquaresResult(
        x=x,
        covariance=sigma**2 * factors.covariance(),
        residual=r,
        sigma=float(sigma),
        degrees_of_freedom=dof,
        rank=factors.rank,
        condition=factors.condition,
        cosine=cosine,
        converged=cosine <= COSINE_AT_MINIMUM or settled,
        evaluations=evaluations,
    )
