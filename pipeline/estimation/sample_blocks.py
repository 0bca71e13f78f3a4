"""Blocks of consecutive samples: stretches of recordings whose means tell slow noise from fast.

The correlation of a bias wander, a first-order Gauss-Markov process, between the averages over two blocks is that of
``pipeline.signal.wander.block_covariance``; it is 0 between recordings where the time between them is not known.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.signal.wander import block_covariance

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from pipeline.records import Recording

BLOCKS = 100


@dataclass(frozen=True)
class Blocks:
    """Stretches of consecutive samples.

    Attributes
    ----------
    label : (n,) array of int
        Block of each sample.
    count : (b,) array
        Samples of each block.
    start, length : (b,) array, s
        Its first sample and its duration.
    clock : (b,) array of int
        Blocks with the same number have a known time between them.
    """

    label: NDArray[np.intp]
    count: NDArray[np.float64]
    start: NDArray[np.float64]
    length: NDArray[np.float64]
    clock: NDArray[np.int64]

    def sums(self, columns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the sums over each block of the columns of an (n, p) array: (b, p) array."""
        size = len(self.count)
        return np.stack([np.bincount(self.label, column, size) for column in columns.T], axis=1)

    def correlation(self, correlation_time: float) -> NDArray[np.float64]:
        """Return the covariance of a wander of variance 1 between the blocks: (b, b) array."""
        together = self.clock[:, None] == self.clock
        covariance: NDArray[np.float64] = block_covariance(self.start, self.length, correlation_time) * together
        return covariance


def _clock(recording: Recording, number: int, known: dict[str, tuple[int, float]]) -> int:
    """Return the clock of a recording: its own, or that of its setup's recording before; ``known`` holds those."""
    before, end = known.get(recording.setup, (number, np.inf))
    clock = before if recording.setup and recording.time[0] > end else number
    known[recording.setup] = clock, float(recording.time[-1])
    return clock


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
    size = max(1, -(-sum(used) // BLOCKS))
    labels, starts, lengths, clocks, blocks = [], [], [], [], 0
    known: dict[str, tuple[int, float]] = {}
    for number, ((recording, keep), samples) in enumerate(zip(parts, used, strict=True), start=1):
        if samples == 0:
            continue
        label = np.arange(samples) // size
        time = recording.time[keep]
        first = np.arange(0, samples, size)
        last = np.minimum(first + size, samples) - 1
        labels.append(label + blocks)
        starts.append(time[first])
        lengths.append(time[last] - time[first] + recording.interval)
        clocks.append(np.full(len(first), 0 if recording.clock_shared else _clock(recording, number, known)))
        blocks += len(first)
    label = np.concatenate(labels)
    count = np.bincount(label).astype(float)
    return Blocks(label, count, np.concatenate(starts), np.concatenate(lengths), np.concatenate(clocks))
