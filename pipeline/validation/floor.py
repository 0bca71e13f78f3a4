"""The error that noise alone leaves, after a calibration without fault.

With the truth t of a held-out sample, the calibration matrix M and noise n of covariance D,

    noise_floor = sqrt(mean over samples of E(|t + M n| - |t|)^2)
    vector_noise_floor = sqrt(mean over samples of tr S),            S = M D M^T

where D is diagonal: white noise behind the filter, and bias wander. Far from zero, ``E(...)^2 = u^T S u`` with
``u = t/|t|``. Near zero (a gyroscope at rest) the norm is not linear in the noise, and

    E(|x| - |t|)^2 = 2 |t|^2 + tr S - 2 |t| E|x|,     x ~ N(t, S)
    E|x| = 1/sqrt(pi) int_0^inf (1 - phi(v^2)) / v^2 dv,   phi(s) = E exp(-s |x|^2)
         = prod_i (1 + 2 s l_i)^(-1/2) exp(-s t_i^2 / (1 + 2 s l_i))

where l_i are the eigenvalues of S and t_i the components of t along its eigenvectors: exact, by Gauss-Legendre
quadrature after ``v = c tan(theta)``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

NODES, WEIGHTS = np.polynomial.legendre.leggauss(48)
THETA, STEP = np.pi / 4.0 * (NODES + 1.0), np.pi / 4.0 * WEIGHTS
FAR = 30.0  # standard deviations; beyond, the first order is right to 1e-3


def squared_norm_errors(
    truth: NDArray[np.float64], matrix: NDArray[np.float64], variance: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return ``E(|t + M n| - |t|)^2`` for each sample: (n,) array.

    Parameters
    ----------
    truth : (n, 3) array, g or deg/s
    matrix : (3, 3) array
    variance : (n, 3) array
        Of the noise of each sample, per reading axis.
    """
    if np.all(variance == variance[:1]):  # of samples, not of means over rests
        kinds, which = variance[:1], np.zeros(len(truth), int)
    else:
        kinds, which = np.unique(variance, axis=0, return_inverse=True)
        which = which.reshape(-1)
    size = np.linalg.norm(truth, axis=1)
    out = np.empty(len(truth))
    for kind, var in enumerate(kinds):
        mine = which == kind
        S = (matrix * var) @ matrix.T
        near = mine & (size <= FAR * np.sqrt(np.trace(S)))
        far = mine & ~near
        u = truth[far] / size[far, None]
        out[far] = np.einsum("ni,ij,nj->n", u, S, u)
        out[near] = _near_zero(truth[near], size[near], S)
    return out


def _near_zero(truth: NDArray[np.float64], size: NDArray[np.float64], S: NDArray[np.float64]) -> NDArray[np.float64]:
    l, V = np.linalg.eigh(S)
    total = float(np.sum(np.clip(l, 0.0, None)))
    if total == 0.0:
        return np.zeros(len(truth))
    t = (truth @ V) ** 2
    c = 1.0 / np.sqrt(total + size**2)
    s = (c[:, None] * np.tan(THETA)) ** 2
    spread = 1.0 + 2.0 * s[:, :, None] * np.clip(l, 0.0, None)
    phi = np.exp(-np.sum(s[:, :, None] * t[:, None, :] / spread, axis=2)) / np.sqrt(np.prod(spread, axis=2))
    mean_norm = np.sum(STEP * (1.0 - phi) / np.sin(THETA) ** 2, axis=1) / (c * np.sqrt(np.pi))
    squared: NDArray[np.float64] = 2.0 * size**2 + total - 2.0 * size * mean_norm
    return squared


def norm_weight(truth: NDArray[np.float64], covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return g with ``E(|t + x| - |t|)^2 = tr(W S)``, ``W = u u^T + g (1 - u u^T)``: 0 far from zero, 1 at rest.

    Parameters
    ----------
    truth : (n, 3) array, g or deg/s
    covariance : (3, 3) array
        S, of the error x.

    Returns
    -------
    (n,) array
    """
    size, total = np.linalg.norm(truth, axis=1), float(np.trace(covariance))
    near = size <= FAR * np.sqrt(total)
    g = np.zeros(len(truth))
    if total > 0.0 and near.any():
        u = truth[near] / np.where(size[near] > 0.0, size[near], 1.0)[:, None]
        along = np.einsum("ni,ij,nj->n", u, covariance, u)
        squares = _near_zero(truth[near], size[near], covariance)
        g[near] = np.clip((squares - along) / np.maximum(total - along, 1e-12 * total), 0.0, 1.0)
    return g


def squared_vector_errors(matrix: NDArray[np.float64], variance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``tr(M D M^T)`` for each sample: (n,) array; parameters as of ``squared_norm_errors``."""
    errors: NDArray[np.float64] = variance @ np.sum(matrix**2, axis=0)
    return errors
