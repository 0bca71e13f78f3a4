"""Least squares, linear and nonlinear, with a certificate.

The estimate minimises the sum of squares of the residuals:

    x = argmin |r(x)|^2,    covariance = sigma^2 (J^T J)^-1

where

    r     : (n,) residuals; for the linear problem r = y - A x
    J     : (n, p) derivative of r with respect to x
    sigma : standard deviation of one residual: given, or sqrt(|r|^2 / (n - p))

Each step is solved by QR of the columns scaled to unit norm, followed by the singular values of R: ``J^T J`` is never
formed, so that no digits are lost by squaring the condition number, and the singular values say which parameters the
data do not determine. The nonlinear problem is approached by a trust region (Branch, Coleman & Li, SIAM J. Sci.
Comput. 21, 1999) and finished by Gauss-Newton steps, halved while they do not help.

A success flag proves nothing; the largest cosine between the residual and a column of the Jacobian does: at a minimum
the residual is orthogonal to all of them (Bates & Watts, Nonlinear Regression Analysis, 1988, section 2.2.3).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import NotObservableError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    Function = Callable[[NDArray[np.float64]], NDArray[np.float64]]

COMPLEX_STEP = 1e-30
# A singular value of the scaled columns below this share of the largest says that the data do not determine something.
RANK_TOLERANCE = 1e-11
COSINE_AT_MINIMUM = 1e-7
STEP_AT_MINIMUM = 1e-10


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


@dataclass(frozen=True)
class _Factors:
    """Scaled columns in factors: J = Q U diag(s) Vt diag(scale)."""

    basis: NDArray[np.float64]
    singular: NDArray[np.float64]
    Vt: NDArray[np.float64]
    scale: NDArray[np.float64]

    @property
    def rank(self) -> int:
        return int(np.sum(self.singular > RANK_TOLERANCE * self.singular[0]))

    @property
    def condition(self) -> float:
        return float(self.singular[0] / self.singular[-1]) if self.singular[-1] > 0 else float("inf")

    def solve(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        keep = slice(self.rank)
        x: NDArray[np.float64] = self.Vt[keep].T @ ((self.basis.T @ y)[keep] / self.singular[keep]) / self.scale
        return x

    def covariance(self) -> NDArray[np.float64]:
        half = self.Vt.T / self.singular / self.scale[:, None]
        return half @ half.T


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
    factors = _factorise(A)
    _require_full_rank(factors, names)
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
        factors = _factorise(J)
        for _ in range(iterations):
            step = -factors.solve(r)
            x_new, r_new, tried = _halved(residuals, x, r, step)
            spent += tried
            if x_new is None or r_new is None:
                break
            small = np.all(np.abs(x_new - x) <= STEP_AT_MINIMUM * np.abs(x_new))
            x, r = x_new, r_new
            J = jacobian(x)
            factors = _factorise(J)
            if small:
                break
    _require_full_rank(factors, names)
    return _result(x, r, J, factors, sigma=sigma, evaluations=spent)


def complex_step_jacobian(function: Function) -> Function:
    """Return the derivative of an analytic function, exact to rounding.

    ``df/dx_j = Im f(x + i h e_j) / h`` with h = 1e-30; there is no difference, so nothing cancels
    (Squire & Trapp, SIAM Review 40, 1998).

    Parameters
    ----------
    function : callable
        (p,) to (n,), analytic: no abs, no comparison of its argument.

    Returns
    -------
    callable
        (p,) to (n, p).
    """

    def jacobian(x: NDArray[np.float64]) -> NDArray[np.float64]:
        columns = []
        for j in range(len(x)):
            moved = x.astype(complex)
            moved[j] += 1j * COMPLEX_STEP
            columns.append(np.imag(function(moved)) / COMPLEX_STEP)
        return np.stack(columns, axis=1)

    return jacobian


def undetermined(J: NDArray[np.float64], names: Sequence[str]) -> list[str]:
    """Return the names of the parameters that the columns of a Jacobian do not determine.

    Parameters
    ----------
    J : (n, p) array
    names : sequence of str

    Returns
    -------
    list of str
        Those with a part in the null space of the scaled columns.
    """
    return _undetermined(_factorise(J), names)


def _halved(
    residuals: Function, x: NDArray[np.float64], r: NDArray[np.float64], step: NDArray[np.float64]
) -> tuple[NDArray[np.float64] | None, NDArray[np.float64] | None, int]:
    """Return the first of step, step/2, ... that lowers |r|, or None where none does."""
    before = r @ r
    for tried in range(1, 31):
        x_new = x + step * 0.5 ** (tried - 1)
        r_new = residuals(x_new)
        if r_new @ r_new < before:
            return x_new, r_new, tried
    return None, None, 30


def _require_finite(r: NDArray[np.float64], J: NDArray[np.float64]) -> None:
    if not (np.all(np.isfinite(r)) and np.all(np.isfinite(J))):
        raise NotObservableError(
            "residuals or their derivatives are not finite at the start: give a start nearer the solution, or check "
            "the readings for values that are not finite"
        )


def _factorise(J: NDArray[np.float64]) -> _Factors:
    scale = np.linalg.norm(J, axis=0)
    scale[scale == 0] = 1.0
    Q, R = np.linalg.qr(J / scale)
    U, s, Vt = np.linalg.svd(R, full_matrices=J.shape[0] < J.shape[1])
    singular = np.zeros(J.shape[1])
    singular[: len(s)] = s
    basis = np.zeros((J.shape[0], J.shape[1]))
    basis[:, : len(s)] = Q @ U
    return _Factors(basis, singular, Vt, scale)


def _undetermined(factors: _Factors, names: Sequence[str]) -> list[str]:
    null = factors.Vt[factors.rank :]
    share = np.linalg.norm(null, axis=0) if len(null) else np.zeros(len(factors.scale))
    return [name for name, part in zip(names, share, strict=True) if part > 1e-3]


def _require_full_rank(factors: _Factors, names: Sequence[str] | None) -> None:
    p = len(factors.scale)
    if factors.rank < p:
        missing = _undetermined(factors, names or [f"x[{j}]" for j in range(p)])
        raise NotObservableError(
            f"the data determine {factors.rank} of {p} parameters; not determined, or only in combination with each "
            f"other: {', '.join(missing)}. Record motion that changes these independently, or fix some of them"
        )


def _result(
    x: NDArray[np.float64],
    r: NDArray[np.float64],
    J: NDArray[np.float64],
    factors: _Factors,
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
