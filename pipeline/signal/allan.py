"""Allan deviation of a rest, overlapping.

    sigma^2(tau) = sum_i (theta[i + 2m] - 2 theta[i + m] + theta[i])^2 / (2 tau^2 (N - 2m + 1)),   tau = m dt

where theta is the integral of the N values, dt the sampling interval, and m runs over logarithmically spaced lengths.
Of long averages every (m / ``PER_AVERAGE``)th term is summed: terms so close together are nearly the same.
White noise of density D shows as ``D / sqrt(tau)``, a Gauss-Markov wander as a hump near 1.89 times its correlation
time. Source: IEEE Std 952-1997, annex C; Riley, NIST SP 1065, section 5.2.4.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

PER_AVERAGE = 64  # terms of the sum that overlap in one average


def allan_deviation(
    values: NDArray[np.float64], interval: float, points_per_decade: int = 10
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return averaging times, s, and the overlapping Allan deviation of (n,) or (n, k) readings, evenly sampled.

    (m,) and (m,) or (m, k) arrays; both empty where there are fewer than 3 readings.
    """
    n = len(values)
    longest = (n - 1) // 2
    if longest < 1:
        return np.empty(0), np.empty((0, *values.shape[1:]))
    count = 1 + int(points_per_decade * np.log10(longest))
    lengths = np.unique(np.geomspace(1, longest, count).astype(np.int64))
    theta = np.zeros((values[0].size, n + 1))
    np.cumsum((values - values.mean(axis=0)).reshape(n, -1).T, axis=1, out=theta[:, 1:])
    twice = 2.0 * theta
    deviation = np.empty((len(lengths), len(theta)))
    for row, m in enumerate(lengths):
        step = max(1, int(m) // PER_AVERAGE)
        second = theta[:, 2 * m :: step] - twice[:, m:-m:step]
        second += theta[:, : -2 * m : step]
        deviation[row] = np.sqrt(np.einsum("ij,ij->i", second, second) / (2.0 * second.shape[1])) / m
    return lengths.astype(np.float64) * interval, deviation.reshape(-1, *values.shape[1:])
