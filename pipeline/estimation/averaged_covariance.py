"""The covariance of an estimate whose noise is only known by weighted candidates.

The error of a parameter then is distributed as a mixture, here described by a scaled Student's t that holds as much of
it within one and within two standard uncertainties:

    P(|e| < x) = sum_i p_i (2 Phi(x / sigma_i) - 1),    x_P: P(|e| < x_P) = P
    t_95(nu) / t_68(nu) = x_95 / x_68,    u = x_95 / t_95(nu)

where

    p_i     : weight of candidate i
    sigma_i : standard deviation of the error under it
    nu      : degrees of freedom
    u       : standard uncertainty

A match of variance and kurtosis would do for a spread of sigma_i about one size; but where "no wander at all" has nine
tenths of the weight, a large wander of little weight decides both, and neither end of the interval.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Values = NDArray[np.float64]

ONE_SIGMA, COVERED = 0.6827, 0.95
FEWEST = 2.0  # degrees of freedom
STEPS, SMALL_STEP = 60, 1e-5


def averaged(weight: Values, covariances: Values, spare: float) -> tuple[Values, Values]:
    """Return the covariance under all candidates together, and its degrees of freedom.

    Parameters
    ----------
    weight : (m,) array
        They sum to 1.
    covariances : (m, p, p) array
        Under each candidate.
    spare : float
        Degrees of freedom of each of them.

    Returns
    -------
    covariance : (p, p) array
        Of the parameters; its diagonal holds u^2.
    degrees_of_freedom : (p,) array
        Of each parameter; infinite where nothing is uncertain.
    """
    mean = np.tensordot(weight, covariances, 1)
    average = np.diag(mean)
    known = average > 0.0
    size, inverse = np.ones(len(average)), np.zeros(len(average))
    sigma = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)[:, known] / average[known])
    size[known], inverse[known] = _student(_within(weight, sigma, ONE_SIGMA), _within(weight, sigma, COVERED))
    freedom = np.where(known, 1.0 / np.maximum(1.0 / spare + inverse, 1e-300), np.inf)
    return mean * np.outer(size, size), freedom


def _within(weight: Values, sigma: Values, probability: float) -> Values:
    """Return what so much of each mixture lies within, both signs: (p,) array.

    The probability is concave in x, so that Newton's method from below stays below.
    """
    from scipy.special import ndtr, ndtri  # noqa: PLC0415  (0.1 s that only fits pay)

    quantile = float(ndtri(0.5 + probability / 2.0))
    sigma = np.maximum(sigma, 1e-9)
    x: Values = quantile * sigma.min(axis=0)
    for _ in range(STEPS):
        ratio = x / sigma
        density = weight @ (np.exp(-0.5 * ratio**2) / sigma) * np.sqrt(2.0 / np.pi)
        step = (probability - weight @ (2.0 * ndtr(ratio) - 1.0)) / np.maximum(density, 1e-300)
        x = np.minimum(x + step, quantile * sigma.max(axis=0))
        if np.all(np.abs(step) <= SMALL_STEP * x):
            break
    return x


def _student(inner: Values, outer: Values) -> tuple[Values, Values]:
    """Return scale and inverse degrees of freedom of Student's t of the same ``inner`` and ``outer``: (p,) arrays."""
    inverse, ratio, quantile = _quantiles()
    found = np.interp(outer / inner, ratio, inverse)
    return outer / np.interp(found, inverse, quantile), found


@cache
def _quantiles() -> tuple[Values, Values, Values]:
    """Return 1 / nu, the ratio of both quantiles of Student's t, and the outer one: (k,) arrays."""
    from scipy.special import ndtri, stdtrit  # noqa: PLC0415  (as above)

    inverse = np.linspace(0.0, 1.0 / FEWEST, 101)
    inner, outer = (
        np.append(ndtri(upper), stdtrit(1.0 / inverse[1:], upper))
        for upper in (0.5 + ONE_SIGMA / 2.0, 0.5 + COVERED / 2.0)
    )
    return inverse, np.asarray(outer / inner, np.float64), np.asarray(outer, np.float64)
