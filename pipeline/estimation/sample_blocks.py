"""Blocks of consecutive samples, and the covariance of a bias wander between them.

A first-order Gauss-Markov process seen at times t_b has the correlation ``R_bc = exp(-|t_b - t_c| / tau)``. It is a
Markov process, so R^-1 is tridiagonal: with ``f_b = exp(-(t_(b+1) - t_b) / tau)`` and ``g_b = 1 / (1 - f_b^2)``,

    (R^-1)_b,b+1 = -f_b g_b,   (R^-1)_bb = 1 + f_b^2 g_b + f_(b-1)^2 g_(b-1)

and f_b = 0 where the time between two blocks, of two recordings, is not known.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from pipeline.records import Recording

BLOCKS = 200


@dataclass(frozen=True)
class Blocks:
    """Stretches of consecutive samples, in order of time.

    Attributes
    ----------
    label : (n,) array of int
        Block of each sample.
    count : (b,) array
        Samples of each block.
    time : (b,) array, s
    joined : (b - 1,) array of bool
        Whether the time between a block and the next is known.
    """

    label: NDArray[np.intp]
    count: NDArray[np.float64]
    time: NDArray[np.float64]
    joined: NDArray[np.bool_]

    def sums(self, columns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the sums over each block of the columns of an (n, p) array: (b, p) array."""
        size = len(self.count)
        return np.stack([np.bincount(self.label, column, size) for column in columns.T], axis=1)

    def precision(self, correlation_time: float) -> NDArray[np.float64]:
        """Return R^-1 in upper banded form: (2, b) array."""
        step = np.exp(-np.abs(np.diff(self.time)) / correlation_time) * self.joined
        gain = 1.0 / (1.0 - np.minimum(step, 1.0 - 1e-9) ** 2)
        bands = np.zeros((2, len(self.time)))
        bands[0, 1:] = -step * gain
        bands[1] = 1.0
        bands[1, 1:] += step**2 * gain
        bands[1, :-1] += step**2 * gain
        return bands


def make_blocks(parts: Sequence[tuple[Recording, NDArray[np.bool_]]]) -> Blocks:
    """Cut the chosen samples of some recordings into blocks.

    Parameters
    ----------
    parts : sequence of (Recording, (n,) array of bool)
        Each recording and its samples that are used, in the order in which their samples are stacked.

    Returns
    -------
    Blocks
    """
    used = [int(keep.sum()) for _, keep in parts]
    length = max(1, -(-sum(used) // BLOCKS))
    labels, times, joined, blocks = [], [], [], 0
    end, shared = -np.inf, False
    for (recording, keep), samples in zip(parts, used, strict=True):
        if samples == 0:
            continue
        local = np.arange(samples) // length
        time = recording.time[keep]
        known = shared and recording.clock_shared and time[0] > end
        times.append(np.bincount(local, time) / np.bincount(local))
        joined.append(np.concatenate([[known], np.ones(local[-1], bool)]))
        labels.append(local + blocks)
        blocks += int(local[-1]) + 1
        end, shared = time[-1], recording.clock_shared
    label = np.concatenate(labels)
    return Blocks(label, np.bincount(label).astype(float), np.concatenate(times), np.concatenate(joined)[1:])


def cholesky(bands: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the banded Cholesky factor of a (2, b) precision."""
    from scipy.linalg.lapack import dpbtrf  # noqa: PLC0415  (0.1 s that only fits pay)

    factor: NDArray[np.float64]
    factor, failed = dpbtrf(bands)
    assert failed == 0  # noqa: S101  (the sum of a precision and a positive diagonal)
    return factor


def solve(factor: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
    """Solve with a factor from ``cholesky``: (b, m) to (b, m)."""
    from scipy.linalg.lapack import dpbtrs  # noqa: PLC0415  (see cholesky)

    solution: NDArray[np.float64] = dpbtrs(factor, right)[0]
    return solution
