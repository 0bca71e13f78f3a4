"""The law of propagation of uncertainty, and how many degrees of freedom the result has (JCGM 100:2008, GUM).

    y = f(x),    U_y = C U_x C^T,    C_ij = df_i / dx_j                           (5.2, annex H)
    nu_eff = u^4 / sum_i (u_i^4 / nu_i)                                           (G.4, Welch-Satterthwaite)
    U = k u,    k from Student's t with nu_eff degrees of freedom                 (G.3)

where

    x, U_x    : (m,) estimates of the inputs and (m, m) their covariance
    C         : (n, m) sensitivity coefficients
    u_i, nu_i : contributions to the standard uncertainty u of one result, and their degrees of freedom

Its Monte Carlo counterpart is ``pipeline.estimation.monte_carlo``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import ArrayLike, NDArray

    Values = NDArray[np.float64]

SMALLEST_STEP = 6e-6  # about the cube root of the rounding of a double, of central differences


def means(observations: ArrayLike) -> tuple[Values, Values, float]:
    """Return means of repeated observations that were made together, their covariance and degrees of freedom.

    ``cov(q_i, q_j) = sum_k (q_ik - q_i) (q_jk - q_j) / (n (n - 1))`` (JCGM 100:2008, 4.2.3 and 5.2.3).

    Parameters
    ----------
    observations : (n, m) array
        A row for each time that all m quantities were observed.

    Returns
    -------
    mean : (m,) array
    covariance : (m, m) array
    degrees_of_freedom : float
        n - 1.
    """
    values = np.asarray(observations, float)
    n = len(values)
    off = values - values.mean(axis=0)
    return values.mean(axis=0), off.T @ off / (n * (n - 1.0)), n - 1.0


def propagate(
    function: Callable[[Values], Values], inputs: ArrayLike, covariance: ArrayLike
) -> tuple[Values, Values, Values]:
    """Propagate the covariance of inputs through a function.

    Parameters
    ----------
    function : callable
        (m,) to (n,).
    inputs : (m,) array
    covariance : (m, m) array

    Returns
    -------
    value : (n,) array
    covariance : (n, n) array
    sensitivity : (n, m) array
        By central differences of a ten-thousandth of each input's uncertainty, or of what rounding allows.
    """
    x, U = np.asarray(inputs, float), np.asarray(covariance, float)
    step = np.maximum(1e-4 * np.sqrt(np.diag(U)), SMALLEST_STEP * np.maximum(np.abs(x), 1e-300))
    columns = [
        (np.asarray(function(x + h * e)) - np.asarray(function(x - h * e))) / (2.0 * h)
        for h, e in zip(step, np.eye(len(x)), strict=True)
    ]
    C = np.stack(columns, axis=-1)
    return np.asarray(function(x), float), C @ U @ C.T, C


def correlation(covariance: ArrayLike) -> Values:
    """Return the correlation coefficients of a covariance; 0 beside a quantity without uncertainty."""
    U = np.asarray(covariance, float)
    u = np.sqrt(np.diag(U))
    product = np.outer(u, u)
    return np.asarray(np.divide(U, product, out=np.zeros_like(U), where=product > 0.0), float)


def effective_degrees_of_freedom(contributions: ArrayLike, degrees_of_freedom: ArrayLike) -> Values:
    """Return ``nu_eff`` by Welch and Satterthwaite: (n,) array, infinite where no finite one contributes.

    Parameters
    ----------
    contributions : (m, n) array
        Standard uncertainty that each of m inputs contributes to each of n results; the inputs are independent.
    degrees_of_freedom : (m,) or (m, n) array
        Of each; may be infinite.
    """
    u = np.atleast_2d(np.asarray(contributions, float))
    nu = np.asarray(degrees_of_freedom, float)
    nu = np.broadcast_to(nu[:, None] if nu.ndim == 1 else nu, u.shape)
    share = np.sum(u**4 / nu, axis=0)
    total = np.sum(u**2, axis=0) ** 2
    nu_eff: Values = np.divide(total, share, out=np.full(u.shape[1], np.inf), where=share > 0.0)
    return nu_eff
