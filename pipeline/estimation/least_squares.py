"""Solve linear and nonlinear least squares, with a certificate of the minimum.

    x = argmin |r(x)|^2,    covariance = sigma^2 (J^T J)^-1

where

    r     : (n,) residuals; for the linear problem r = y - A x
    J     : (n, p) derivative of r with respect to x
    sigma : standard deviation of one residual: given, or sqrt(|r|^2 / (n - p))

Columns are scaled to unit norm d, so that units do not matter, and factorised as ``A = Q U diag(s) V^T diag(d)``; the
singular values s show which combinations the data determine. The nonlinear problem is solved by Gauss-Newton steps,
halved while they do not lower ``|r|``. The certificate of a minimum is the largest cosine between the residual and a
column of the Jacobian, which is zero at a minimum (Bates & Watts, Nonlinear Regression Analysis, 1988, section 2.2.3).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from pipeline.core.errors import NotObservableError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from pipeline.core.records import Values

FitState = TypeVar("FitState")
MAX_STEP_HALVINGS = 30  # of a step; a smaller one is rounding
RANK_TOLERANCE = 1e-11  # of the largest singular value of unit columns: 1e5 times the rounding of a double
PART_OF_NULL_SPACE = 1e-3  # component of a unit vector of it, above which a parameter is named as not determined
COSINE_AT_MINIMUM = 1e-7  # the root of rounding, about 1e-8, times a factor for sums over many residuals
STEP_AT_MINIMUM = 1e-10  # relative; well below any uncertainty, well above rounding
ROW_SUM_RIDGE = 1e-9  # 1e7 times the rounding of a double, for sums over many rows; 3e-5 of a standard deviation
SUM_OF_SQUARES_ROUNDING = 1e-10  # relative, of a sum of squares of small differences of large values


@dataclass(frozen=True)
class ScaledColumns:
    """The factors of (n, p) columns: ``basis`` Q U, ``singular`` s (falling), ``Vt`` V^T and ``scale`` d."""

    basis: Values
    singular: Values
    Vt: Values
    scale: Values
    tolerance: float  # share of the largest singular value, below which a combination is not determined

    @classmethod
    def of(cls, A: Values, tolerance: float = RANK_TOLERANCE) -> ScaledColumns:
        """Factorise (n, p) columns; n may be smaller than p."""
        n, p = A.shape
        scale = np.linalg.norm(A, axis=0)
        scale[scale == 0] = 1.0
        Q, R = np.linalg.qr(A / scale)
        U, s, Vt = np.linalg.svd(R, full_matrices=n < p)
        singular, basis = np.zeros(p), np.zeros((n, p))
        singular[: len(s)] = s
        basis[:, : len(s)] = Q @ U
        return cls(basis, singular, Vt, scale, tolerance)

    @property
    def rank(self) -> int:
        """Number of determined combinations of parameters."""
        return int(np.sum(self.singular > self.tolerance * self.singular[0]))

    @property
    def condition(self) -> float:
        """Condition number of the scaled columns."""
        return float(self.singular[0] / self.singular[-1]) if self.singular[-1] > 0 else float("inf")

    def solve(self, y: Values) -> Values:
        """Return the x of least norm that minimises ``|y - A x|``: (n,) or (n, m) to (p,) or (p, m)."""
        keep = slice(self.rank)
        x: Values = ((self.Vt[keep].T / self.singular[keep]) @ (self.basis.T @ y)[keep]).T / self.scale
        return x.T

    def weights(self) -> Values:
        """Return the pseudo-inverse for full rank, ``solve(y) = weights @ y``: (p, n) array."""
        return (self.Vt.T / self.singular / self.scale[:, None]) @ self.basis.T

    def covariance(self) -> Values:
        """Return ``(A^T A)^-1`` of the determined combinations: (p, p) array."""
        keep = slice(self.rank)
        half: Values = self.Vt[keep].T / self.singular[keep] / self.scale[:, None]
        return half @ half.T

    def undetermined(self, names: Sequence[str], share: float = PART_OF_NULL_SPACE) -> list[str]:
        """Return the names of the parameters with at least ``share`` in undetermined combinations."""
        parts = np.linalg.norm(self.Vt[self.rank :], axis=0)
        return [name for name, part in zip(names, parts, strict=True) if part > share]

    def require_full_rank(self, names: Sequence[str]) -> None:
        """Raise ``NotObservableError``, with the names of the parameters, if the data do not determine some."""
        if self.rank < len(self.scale):
            raise NotObservableError(
                f"the data determine {self.rank} of {len(self.scale)} parameters; not determined, or only in "
                f"combination with each other: {', '.join(self.undetermined(names))}. Record motion that changes these "
                "independently, or fix some of them"
            )


def cholesky(matrix: Values) -> Values:
    """Return the lower Cholesky factor of covariance matrices: (..., n, n) array.

    Their elements may differ by more than the digits of a double, as those of stated errors and tiny white noise do.
    Where rounding leaves no positive definite matrix, the diagonal is increased by the share ``ROW_SUM_RIDGE`` of
    itself.
    """
    try:
        return np.asarray(np.linalg.cholesky(matrix), np.float64)
    except np.linalg.LinAlgError:
        diagonal = np.einsum("...kk->...k", matrix)[..., None] * np.eye(matrix.shape[-1])
        return np.asarray(np.linalg.cholesky(matrix + ROW_SUM_RIDGE * diagonal), np.float64)


def gauss_newton(  # noqa: PLR0917  (what an iteration is)
    residual_at: Callable[[FitState], tuple[Values, Values]],
    start: FitState,
    moved: Callable[[FitState, Values], tuple[FitState, Values]],
    small: Callable[[Values, ScaledColumns], bool] | None,
    iterations: int,
    tolerance: float = RANK_TOLERANCE,
) -> tuple[FitState, tuple[Values, Values], int]:
    """Minimise ``|r|`` by Gauss-Newton steps, each halved while it does not lower ``|r|``.

    ``residual_at``: state to its residuals (n,) and their derivative (n, p). ``moved``: state and step (p,) to the new
    state, and the step taken. ``small``: whether a step, with the factors of the derivative, is the last; by default a
    step of the size of rounding. ``tolerance``: see ``ScaledColumns``. Returns the final state, its residuals and
    derivative, and the number of steps. Raises ``NotObservableError`` if the start is not finite.
    """
    state, (r, J), size = start, residual_at(start), np.inf
    if not (np.all(np.isfinite(r)) and np.all(np.isfinite(J))):
        raise NotObservableError(
            "residuals or their derivatives are not finite at the start: give a start nearer the solution, or "
            "check the readings for values that are not finite"
        )
    for count in range(iterations):
        factors = ScaledColumns.of(J, tolerance)
        step, before = -factors.solve(r), r @ r
        for halving in range(MAX_STEP_HALVINGS):
            new, taken = moved(state, step * 0.5**halving)
            r_new, J_new = residual_at(new)
            # Near the minimum the sum of squares is flat to rounding while the step is still larger than rounding.
            if r_new @ r_new < before * (1.0 + (SUM_OF_SQUARES_ROUNDING if halving == 0 else 0.0)) and np.all(
                np.isfinite(J_new)
            ):
                break
        else:
            return state, (r, J), count
        size, last = float(np.linalg.norm(taken * factors.scale)), size
        stalled = size >= last and r_new @ r_new >= (1.0 - SUM_OF_SQUARES_ROUNDING) * before
        state, r, J = new, r_new, J_new
        if small(taken, factors) if small else stalled or size <= STEP_AT_MINIMUM * np.linalg.norm(r):
            return state, (r, J), count + 1
    return state, (r, J), iterations


def linear_convergence_evidence(A: Values, residual: Values, condition: float, rank: int) -> dict[str, Any]:
    """Return the evidence that a linear estimate is a minimum, for ``SensorCalibration.convergence``.

    ``A``: (n, p), columns, the same for each channel. ``residual``: (n,) or (n, m), of m channels. ``condition``: of
    the scaled columns.
    """
    products = np.abs(A.T @ residual)
    size = np.multiply.outer(np.linalg.norm(A, axis=0), np.linalg.norm(residual, axis=0))
    cosine = np.divide(products, size, out=np.zeros_like(products), where=size > 0.0)
    return convergence_evidence(float(cosine.max()), condition, rank, A.shape[1])


def convergence_evidence(
    cosine: float, condition: float, rank: int, parameters: int, *, at_minimum: float = COSINE_AT_MINIMUM
) -> dict[str, Any]:
    """Return the evidence that a fit is at its minimum, for ``SensorCalibration.convergence``."""
    return {
        "cosine": cosine,
        "cosine_at_minimum": at_minimum,
        "condition": condition if np.isfinite(condition) else None,
        "rank": rank,
        "parameters": parameters,
    }
