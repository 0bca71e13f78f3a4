"""The columns of a least-squares problem in factors, scaled to unit norm.

    A = Q R diag(d) = (Q U) diag(s) V^T diag(d),   R = U diag(s) V^T

where

    A : (n, p) columns: a design matrix or a Jacobian
    d : their norms, so that no unit counts for more than another
    s : singular values: those near zero belong to combinations of parameters that the data do not determine

``A^T A`` is never formed: it would square the condition number and lose half the digits (Golub & Van Loan, Matrix
Computations, section 5.3).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import NotObservableError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

# A singular value of the scaled columns below this share of the largest says that the data do not determine something.
RANK_TOLERANCE = 1e-11
PART_OF_NULL_SPACE = 1e-3


@dataclass(frozen=True)
class ScaledColumns:
    """Columns in factors.

    Attributes
    ----------
    basis : (n, p) array
        Q U.
    singular : (p,) array
        s, falling.
    Vt : (p, p) array
        V^T.
    scale : (p,) array
        d; 1 for a column of zeros.
    """

    basis: NDArray[np.float64]
    singular: NDArray[np.float64]
    Vt: NDArray[np.float64]
    scale: NDArray[np.float64]

    @property
    def rank(self) -> int:
        """Number of parameters, or combinations of them, that are determined."""
        return int(np.sum(self.singular > RANK_TOLERANCE * self.singular[0]))

    @property
    def condition(self) -> float:
        """Condition number of the scaled columns."""
        return float(self.singular[0] / self.singular[-1]) if self.singular[-1] > 0 else float("inf")

    def solve(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return x that minimises |y - A x|, of least norm where several do: (n,) to (p,)."""
        keep = slice(self.rank)
        x: NDArray[np.float64] = self.Vt[keep].T @ ((self.basis.T @ y)[keep] / self.singular[keep]) / self.scale
        return x

    def covariance(self) -> NDArray[np.float64]:
        """Return ``(A^T A)^-1``, for full rank: (p, p) array."""
        half: NDArray[np.float64] = self.Vt.T / self.singular / self.scale[:, None]
        return half @ half.T

    def undetermined(self, names: Sequence[str]) -> list[str]:
        """Return the names of the parameters with a part in the null space."""
        null = self.Vt[self.rank :]
        share = np.linalg.norm(null, axis=0) if len(null) else np.zeros(len(self.scale))
        return [name for name, part in zip(names, share, strict=True) if part > PART_OF_NULL_SPACE]

    def require_full_rank(self, names: Sequence[str] | None = None) -> None:
        """Raise ``NotObservableError`` with the names of the parameters that the data do not determine."""
        p = len(self.scale)
        if self.rank < p:
            missing = self.undetermined(names or [f"x[{j}]" for j in range(p)])
            raise NotObservableError(
                f"the data determine {self.rank} of {p} parameters; not determined, or only in combination with each "
                f"other: {', '.join(missing)}. Record motion that changes these independently, or fix some of them"
            )


def factorise(A: NDArray[np.float64]) -> ScaledColumns:
    """Factorise (n, p) columns; n may be smaller than p."""
    n, p = A.shape
    scale = np.linalg.norm(A, axis=0)
    scale[scale == 0] = 1.0
    Q, R = np.linalg.qr(A / scale)
    U, s, Vt = np.linalg.svd(R, full_matrices=n < p)
    singular, basis = np.zeros(p), np.zeros((n, p))
    singular[: len(s)] = s
    basis[:, : len(s)] = Q @ U
    return ScaledColumns(basis, singular, Vt, scale)


def estimate_weights(A: NDArray[np.float64], weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrix that turns readings into the estimate, ``(A^T W A)^-1 A^T W`` with W = diag(weight^2).

    Parameters
    ----------
    A : (n, p) array
    weight : (n,) array

    Returns
    -------
    (p, n) array

    Raises
    ------
    NotObservableError
        If the columns are linearly dependent.
    """
    factors = factorise(weight[:, None] * A)
    factors.require_full_rank()
    inverse = factors.Vt.T / factors.singular / factors.scale[:, None]
    weights: NDArray[np.float64] = (inverse @ factors.basis.T) * weight
    return weights
