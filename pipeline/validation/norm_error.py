"""The mean squared error of the magnitude of a vector t, given the covariance S of the vector's error x.

    E(|t + x| - |t|)^2 = tr(W S),    W = u u' + g (1 - u u'),    u = t/|t|,    g = 0 far from zero

Near zero (a gyroscope at rest) the norm is not linear in x, and the mean is ``2 |t|^2 + tr S - 2 |t| E|t + x|``,

    E|t + x| = 1/sqrt(pi) int_0^inf (1 - phi(v^2)) / v^2 dv
    phi(s) = prod_i (1 + 2 s l_i)^(-1/2) exp(-s t_i^2 / (1 + 2 s l_i))

with the eigenvalues l_i of S and the components t_i of t along its eigenvectors, by Gauss-Legendre quadrature after
``v = c tan(theta)``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from pipeline.records import Values


NODES, NODE_WEIGHTS = np.polynomial.legendre.leggauss(48)  # enough for the 0.4 % of a simulation (test_norm_error)
THETA, STEP = np.pi / 4.0 * (NODES + 1.0), np.pi / 4.0 * NODE_WEIGHTS
FAR = 30.0  # standard deviations from zero, beyond which the norm is linear to 1e-3


def squared_norm_errors(truth: Values, matrix: Values, variance: Values) -> Values:
    """Return ``E(|t + M n| - |t|)^2`` of each sample, unit squared: (n,) array.

    ``truth``: (n, 3), g or deg/s; ``matrix``: M; ``variance``: (n, 3), of the noise n of each reading axis.
    """
    if np.all(variance == variance[:1]):  # of samples, not of means over rests
        return mean_squares(truth, (matrix * variance[0]) @ matrix.T)[0]
    kinds, which = np.unique(variance, axis=0, return_inverse=True)
    out = np.empty(len(truth))
    for kind, var in enumerate(kinds):
        mine = which.reshape(-1) == kind
        out[mine] = mean_squares(truth[mine], (matrix * var) @ matrix.T)[0]
    return out


def mean_squares(truth: Values, S: Values) -> tuple[Values, Values]:
    """Return ``E(|t + x| - |t|)^2`` and its weight g, for (n, 3) truths and errors x of covariance S: (n,) arrays."""
    size, total = np.linalg.norm(truth, axis=1), float(np.trace(S))
    u = truth / np.where(size > 0.0, size, 1.0)[:, None]
    along = np.einsum("ni,ij,nj->n", u, S, u)
    squares, g = along.copy(), np.zeros(len(truth))
    near = (size <= FAR * np.sqrt(total)) & (total > 0.0)
    if near.any():
        squares[near] = _near_zero(truth[near], size[near], S)
        g[near] = np.clip((squares - along)[near] / np.maximum(total - along[near], 1e-12 * total), 0.0, 1.0)
    return squares, g


def _near_zero(truth: Values, size: Values, S: Values) -> Values:
    """Return ``E(|t + x| - |t|)^2`` by quadrature: (n,) array."""
    l, V = np.linalg.eigh(S)
    l = np.clip(l, 0.0, None)
    t = (truth @ V) ** 2
    c = 1.0 / np.sqrt(l.sum() + size**2)
    s = (c[:, None] * np.tan(THETA)) ** 2
    spread = 1.0 + 2.0 * s[:, :, None] * l
    phi = np.exp(-np.sum(s[:, :, None] * t[:, None, :] / spread, axis=2)) / np.sqrt(np.prod(spread, axis=2))
    mean_norm = np.sum(STEP * (1.0 - phi) / np.sin(THETA) ** 2, axis=1) / (c * np.sqrt(np.pi))
    squared: Values = 2.0 * size**2 + l.sum() - 2.0 * size * mean_norm
    return squared
