"""Propagation of distributions by a Monte Carlo method, beside the law of propagation (JCGM 101:2008).

    y_r = f(x_r),    x_r drawn from the joint distribution of the inputs,  r = 1 .. M

where the estimate is the mean of the y_r, u their standard deviation, and an interval that holds the share p of them
the coverage interval: between the quantiles (1 - p)/2 and (1 + p)/2, or the shortest one (7.7, 5.3.4).

The law of propagation is borne out where both ends of its interval ``y +- U`` lie within

    delta = 10^l / 2,    u = c 10^l with c an integer of two digits

of those of the Monte Carlo interval (8.1): where it holds to half of the last digit that is stated.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import ArrayLike, NDArray

    Values = NDArray[np.float64]


@dataclass(frozen=True)
class Distribution:
    """What a Monte Carlo run says of n results.

    Attributes
    ----------
    estimate, standard_uncertainty : (n,) array
    symmetric, shortest : (n, 2) array
        Coverage intervals: with as much outside on either side, and the shortest.
    trials : int
    """

    estimate: Values
    standard_uncertainty: Values
    symmetric: Values
    shortest: Values
    trials: int


@dataclass(frozen=True)
class Comparison:
    """Beside each other: the interval by the law of propagation and the one by Monte Carlo.

    Attributes
    ----------
    tolerance : (n,) array
        delta.
    low, high : (n,) array
        By how much the lower and the upper ends differ.
    """

    tolerance: Values
    low: Values
    high: Values

    @property
    def borne_out(self) -> NDArray[np.bool_]:
        """Whether both ends agree within the tolerance: (n,) array of bool."""
        return np.asarray((self.low <= self.tolerance) & (self.high <= self.tolerance))


def distribution_of(results: ArrayLike, probability: float = 0.95) -> Distribution:
    """Return estimate, standard uncertainty and coverage intervals of drawn results.

    Parameters
    ----------
    results : (M, n) array
        A row for each trial.
    probability : float
        p.
    """
    values = np.sort(np.asarray(results, float), axis=0)
    M = len(values)
    inside = round(probability * M)
    low = (M - inside) // 2
    last = np.minimum(np.arange(M - inside) + inside, M - 1)
    widths = values[last] - values[: M - inside]
    at, column = np.argmin(widths, axis=0), np.arange(values.shape[1])
    shortest = np.stack([values[at, column], values[np.minimum(at + inside, M - 1), column]], axis=1)
    symmetric = np.stack([values[low], values[min(low + inside, M - 1)]], axis=1)
    return Distribution(values.mean(axis=0), values.std(axis=0, ddof=1), symmetric, shortest, M)


def propagate_distributions(
    function: Callable[[Values], Values],
    draw: Callable[[np.random.Generator, int], Values],
    *,
    seed: int,
    trials: int = 1_000_000,
    probability: float = 0.95,
) -> Distribution:
    """Propagate the distribution of inputs through a function.

    Parameters
    ----------
    function : callable
        (M, m) drawn inputs to (M, n) results.
    draw : callable
        ``draw(generator, M)`` returns (M, m) inputs.
    seed : int
    trials : int
        M; at least ``1e4 / (1 - p)`` (7.2.1).
    probability : float
        p.
    """
    return distribution_of(function(draw(np.random.default_rng(seed), trials)), probability)


def numerical_tolerance(standard_uncertainty: ArrayLike, digits: int = 2) -> Values:
    """Return delta for a standard uncertainty that is stated to some significant digits: (n,) array (7.9.2)."""
    u = np.atleast_1d(np.asarray(standard_uncertainty, float))
    exponent = np.floor(np.log10(np.maximum(u, np.finfo(float).tiny))) - digits + 1.0
    c = np.round(u / 10.0**exponent)
    exponent += c >= 10.0**digits  # 0.0996 is 10 x 10^-2 to two digits
    delta: Values = 0.5 * 10.0**exponent
    return delta


def compare(
    estimate: ArrayLike,
    expanded_uncertainty: ArrayLike,
    found: Distribution,
    *,
    digits: int = 2,
    shortest: bool = False,
) -> Comparison:
    """Compare ``y +- U`` by the law of propagation with the interval of a Monte Carlo run (8.1).

    Parameters
    ----------
    estimate, expanded_uncertainty : (n,) array
        y and U.
    found : Distribution
        For the same probability.
    digits : int
        Significant digits of the standard uncertainty that are stated.
    shortest : bool
        Take the shortest interval in place of the symmetric one.
    """
    y, U = np.atleast_1d(np.asarray(estimate, float)), np.atleast_1d(np.asarray(expanded_uncertainty, float))
    interval = found.shortest if shortest else found.symmetric
    return Comparison(
        numerical_tolerance(found.standard_uncertainty, digits),
        np.abs(y - U - interval[:, 0]),
        np.abs(y + U - interval[:, 1]),
    )
