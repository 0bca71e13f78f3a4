"""The distribution of a mean squared error: a quadratic form in Gaussians, known by its first three cumulants.

With eigenvalues l of its matrix times the covariance, ``sum l z^2`` has the cumulants ``2^(r-1) (r-1)! sum l^r``; see
``pipeline.validation.expected``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Values = NDArray[np.float64]

NORMAL = 1e6  # degrees of freedom from which on a chi-square is normal
HALVINGS = 40  # of the logarithm of what brackets a quantile


@dataclass(frozen=True)
class Form:
    """Traces of the mean squared error's form.

    Attributes
    ----------
    white, within : (2,) arrays
        ``tr Q`` and ``tr Q^2`` of white noise, and of wander within blocks.
    doubt : float
        One over the number of samples that told the white noise.
    first, second, third : (3,), (3, 3) and (3, 3, 3) arrays
        Traces of products of the Q of parameters, of wander and of drift.
    """

    white: Values
    within: Values
    doubt: float
    first: Values
    second: Values
    third: Values

    def cumulants(self, level: Values) -> Values:
        """Return k_1 to k_3: (3, k) array.

        Parameters
        ----------
        level : (4, k) array
            Factors of the variances of parameters, wander, drift and white noise.
        """
        f, white, within = level[:3], level[3] * self.white[0], level[1] * self.within[0]
        one = self.first @ f
        two = np.einsum("ij,ik,jk->k", self.second, f, f)
        three = np.einsum("ijl,ik,jk,lk->k", self.third, f, f, f)
        w = white * _each(self.white)  # eigenvalue of a white sample, which all other products meet
        v = within * _each(self.within)
        squares = two + 2.0 * w * one + white**2 * (_each(self.white) + self.doubt) + within**2 * _each(self.within)
        cubes = three + 3.0 * w * two + 3.0 * w**2 * one
        cubes = cubes + white * w**2 + within * v**2
        return np.stack([one + white + within, 2.0 * squares, 8.0 * cubes])


def _each(traces: Values) -> float:
    """Return ``tr Q^2 / (tr Q)^2``: one over the number of independent values."""
    return float(traces[1] / traces[0] ** 2) if traces[0] > 0.0 else 0.0


def quantile(form: Form, level: Values, weight: Values, probability: float) -> float:
    """Return a quantile of the mean squared error, by halving the logarithm of what brackets it.

    Parameters
    ----------
    form : Form
    level : (4, k) array
        Levels that are mixed, as of ``Form.cumulants``.
    weight : (k,) array
        Their probabilities.
    probability : float
    """
    from scipy.special import gammainc, ndtr  # noqa: PLC0415

    one, two, three = form.cumulants(level)
    spread = np.sqrt(two)
    h = np.minimum(8.0 * two**3 / np.maximum(three, 1e-300) ** 2, NORMAL)
    a, b = np.log(1e-6 * one.min()), np.log(float(np.max(one + 60.0 * spread)))
    for _ in range(HALVINGS):
        middle = 0.5 * (a + b)
        z = (np.exp(middle) - one) / spread
        below = np.where(h < NORMAL, gammainc(0.5 * h, np.clip(0.5 * (h + z * np.sqrt(2.0 * h)), 0.0, None)), ndtr(z))
        a, b = (middle, b) if weight @ below < probability else (a, middle)
    return float(np.exp(0.5 * (a + b)))
