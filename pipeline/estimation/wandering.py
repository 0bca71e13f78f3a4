"""Likelihood of readings whose noise is white plus a bias wander.

The noise of a channel is

    C = s^2 (diag(1/w) + q W R W^T),   R_jk = exp(-|t_j - t_k| / tau)

where

    w   : (n,) weights, samples of each row
    s   : standard deviation of one sample's white noise
    q   : variance of the wander over s^2
    tau : correlation time of the wander, s
    W   : (n, m) marks which of m short cells of time a row lies in; within a cell the wander does not change

The matrix inversion lemma turns every product with ``C^-1`` into one over the rows, formed once, and one over cells,

    A^T C^-1 B s^2 = A^T w B - S_A^T (R^-1/q + W^T w W)^-1 S_B,     S_A = W^T w A

in which ``R^-1`` is tridiagonal, as the wander is a Markov process. So any noise setting costs as little as its cells.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from pipeline.estimation.observations import Part
    from pipeline.records import Noise

    Factor = tuple[NDArray[np.float64], NDArray[np.float64], float]

CELLS = 300
SHORTEST_CELL_S = 4.0
FAST_S = 25.0
WALK = 8.0  # times the correlation time seen, with the same variance of short differences
STATIC_WIDTH = (0.35, 1.1)  # least and most of the logarithm of the ratio that a static rest gives


@dataclass(frozen=True)
class Setting:
    """One noise: ratio of wander to white noise, its correlation time in s, and a prior log weight."""

    ratio: float
    time: float
    prior: float = 0.0


@dataclass(frozen=True)
class Cells:
    """Short stretches of time in which the wander is taken as constant.

    Attributes
    ----------
    first : (m,) array of int
        First row of each; rows are in order.
    time : (m,) array, s
        Mean time of each.
    joined : (m - 1,) array of bool
        Whether the time from each to the next is known.
    weight : (m,) array
        Sum of the weights of its rows.
    factors : dict
        Those that were asked for, by setting: the candidates, the fit and what it leaves ask for the same.
    """

    first: NDArray[np.intp]
    time: NDArray[np.float64]
    joined: NDArray[np.bool_]
    weight: NDArray[np.float64]
    factors: dict[Setting, Factor] = field(default_factory=dict, compare=False, repr=False)

    def factor(self, setting: Setting) -> Factor:
        """Return the tridiagonal factor of ``R^-1/q + W^T w W`` and log det C, up to that of the weights."""
        if setting not in self.factors:
            self.factors[setting] = self._factor(setting)
        return self.factors[setting]

    def _factor(self, setting: Setting) -> Factor:
        from scipy.linalg.lapack import dpttrf  # noqa: PLC0415  (0.1 s that only fits pay)

        q = setting.ratio**2
        step = np.where(self.joined, np.exp(-np.abs(np.diff(self.time)) / setting.time), 0.0)
        gain = 1.0 / -np.expm1(2.0 * np.log(np.clip(step, 1e-300, 1.0 - 1e-9)))
        diagonal = np.ones(len(self.time))
        diagonal[1:] += step**2 * gain
        diagonal[:-1] += step**2 * gain
        d, e, info = dpttrf(diagonal / q + self.weight, -step * gain / q)
        assert info == 0  # noqa: S101
        logarithm = float(np.sum(np.log(d)) + len(d) * np.log(q) - np.sum(np.log(gain)))
        return d, e, logarithm


def cells_of(parts: Sequence[Part]) -> Cells:
    """Cut the rows of recordings into cells, a new one for each recording.

    The time between two recordings is known where all share a clock, or both are of one setup and do not overlap.
    """
    span = sum(float(np.ptp(part.motion.time)) for part in parts)
    length = max(SHORTEST_CELL_S, span / CELLS)
    first, times, weights, joined, row = [], [], [], [], 0
    for before, part in zip([None, *parts], parts, strict=False):
        cell = np.floor((part.motion.time - part.motion.time[0]) / length)
        start = np.flatnonzero(np.concatenate([[True], np.diff(cell) != 0]))
        weight = np.add.reduceat(part.weight, start)
        first.append(start + row)
        times.append(np.add.reduceat(part.weight * part.motion.time, start) / weight)
        weights.append(weight)
        joined.append(np.concatenate([[_follows(before, part)], np.ones(len(start) - 1, bool)]))
        row += len(part.motion.time)
    return Cells(np.concatenate(first), np.concatenate(times), np.concatenate(joined)[1:], np.concatenate(weights))


def _follows(before: Part | None, part: Part) -> bool:
    """Return whether the time from the recording before is known."""
    if before is None:
        return False
    if before.clock_shared and part.clock_shared:
        return True
    one = before.motion.setup == part.motion.setup != ""
    return one and bool(before.motion.time[-1] < part.motion.time[0])


def wanders_fast(noise: Noise | None) -> bool:
    """Return whether the noise is correlated over seconds: then it is taken for white noise with fewer samples."""
    return noise is not None and noise.source == "static" and noise.correlation_time < FAST_S


def information(noise: Noise | None, interval: float) -> float:
    """Return how much a sample tells beside one of white noise alone: ``1 / (1 + 2 q tau / dt)``, at slow change.

    Parameters
    ----------
    noise : Noise or None
    interval : float, s
    """
    if noise is None or not wanders_fast(noise) or not np.all(noise.white > 0):
        return 1.0
    ratio = float(np.mean((noise.wander / noise.white) ** 2))
    return 1.0 / (1.0 + 2.0 * ratio * noise.correlation_time / interval)


def settings_for(
    noise: Noise | None,
    ratios: Sequence[float] = (0.03, 0.1, 0.3, 1.0, 3.0),
    times: Sequence[float] = (60.0, 600.0),
) -> list[Setting]:
    """Return the noise settings over which the likelihood is maximised.

    A static recording pins them: its ratio, halves and doubles of it, by a log-normal weight, and slower wanders with
    the same short differences. Without one, and where
    it wanders so fast that its length says nothing of what is slower, they span what sensors of the field show, and no
    wander at all.

    Parameters
    ----------
    noise : Noise or None
    ratios, times : sequence of float
        The free grid; times in s.
    """
    pinned = noise is not None and noise.source == "static" and not wanders_fast(noise)
    if noise is not None and pinned and np.any(noise.wander > 0) and np.all(noise.white > 0):
        known = float(np.sqrt(np.mean((noise.wander / noise.white) ** 2)))
        factors = np.array([0.5, 1.0, 2.0, 4.0])
        least, most = STATIC_WIDTH
        width = np.clip(np.sqrt(noise.correlation_time / noise.length), least, most) if noise.length > 0 else least
        priors = -0.5 * (np.log(factors) / width) ** 2
        pairs = list(zip(factors, priors, strict=True))
        found = [Setting(known * f, noise.correlation_time * t, p) for f, p in pairs for t in (0.5, 2.0)]
        # A random walk looks like this over the static rest, and goes on to grow after it.
        walk = [Setting(known * f * WALK**0.5, noise.correlation_time * WALK, p - 1.0) for f, p in pairs]
        return found + walk
    return [Setting(0.0, 1.0)] + [Setting(ratio, time) for ratio in ratios for time in times]


class Whitened:
    """Products of columns under every noise setting.

    Parameters
    ----------
    cells : Cells
    weight : (n,) array
    columns : (n, p) array
        Each row is multiplied by the root of its weight in place.
    """

    def __init__(self, cells: Cells, weight: NDArray[np.float64], columns: NDArray[np.float64]) -> None:
        self.cells = cells
        columns *= np.sqrt(weight)[:, None]
        self.white: NDArray[np.float64] = columns.T @ columns
        columns *= np.sqrt(weight)[:, None]
        self.weight, self.weighted = weight, columns
        self.sums: NDArray[np.float64] = np.add.reduceat(columns, cells.first, axis=0)

    def products(self, setting: Setting) -> tuple[NDArray[np.float64], float]:
        """Return ``A^T C^-1 A s^2``, (p, p), and log det C of one channel for s = 1, up to a constant."""
        if setting.ratio == 0.0:
            return self.white, 0.0
        from scipy.linalg.lapack import dpttrs  # noqa: PLC0415  (as in Cells.factor)

        d, e, logarithm = self.cells.factor(setting)
        solved, info = dpttrs(d, e, self.sums)
        assert info == 0  # noqa: S101
        return self.white - self.sums.T @ solved, logarithm

    def influence(self, setting: Setting) -> NDArray[np.float64]:
        """Return ``A^T C^-1 s^2``: (p, n) array."""
        if setting.ratio == 0.0:
            return self.weighted.T
        from scipy.linalg.lapack import dpttrs  # noqa: PLC0415  (as in Cells.factor)

        d, e, _ = self.cells.factor(setting)
        solved, info = dpttrs(d, e, self.sums)
        assert info == 0  # noqa: S101
        rows = np.diff(np.append(self.cells.first, len(self.weight)))
        found: NDArray[np.float64] = (self.weighted - self.weight[:, None] * np.repeat(solved, rows, axis=0)).T
        return found
