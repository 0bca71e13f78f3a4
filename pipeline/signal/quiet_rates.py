"""Where the gyroscope turns although the accelerometer is quiet: turns about the vertical, and the ends of moves.

With the mean rate m and the variance v of a short window about each sample, the unit turns where

    max_c |m_c - r_c| > max(q s_c / sqrt(n), q d_c)    or    sum_c v_c > q^2 V

where

    n   : samples of the window, 0.2 s and at least 3
    r   : median of m in the stretch that the accelerometer calls quiet, which contains bias, g-sensitivity and a steady
          creep; where it departs from the median of the stretches around it by more than the limit of a rest's rate,
          the stretch is mostly a turn, and that median replaces it; of one or two stretches, where it departs from the
          mean of their first and last window, which agree, that mean
    s_c : white noise of a sample, by the differences of successive samples
    d_c : 1.4826 times the median of |m_c - r_c| in the stretch: the standard deviation of m, tremor of a hand included,
          where the unit rests for more than half of the stretch; q d_c is limited to a hand's largest tremor
    V   : median of sum_c v_c in the stretch: noise and tremor
    q   : 6: of 10^5 windows of three axes, noise alone passes in 6e-4

Readings that are coarse against their noise repeat their value: the limit of a mean is at least one count, and V at
least the variance of rounding, ``sum_c count_c^2 / 12``, in which a single flip of a count stays below the limit.

Of a stretch that is mostly a turn, d and V are the medians of all stretches. A stretch is cut where the unit turns. Of
pieces between which it turned by less than the limit of a rest, the longest is kept.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.records import median, noise_of_steps

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.records import Mask, Values

    Spans = list[tuple[int, int]]

WINDOW_S, FEWEST = 0.2, 3  # shorter than a move; samples that have a variance
SIGNIFICANT = 6.0  # q above
NEIGHBOURS = 5  # stretches: their median withstands two that turned
RATE_LIMIT_DPS = 0.7  # of a stretch against those around it: hand-held rests differ by g-sensitivity and creep
# Of a window's mean, however much the stretch trembles. The rests of a published MPU-6050 recording in a hand reach 1.7
# but for the ends of moves; its moves reach 60 (see tests/signal/test_rests.py).
TREMOR_LIMIT_DPS = 2.5
SAME_DEG = 2.0  # the limit of a rest in ``pipeline.signal.rests``
ROUNDING = 1e-6  # relative, of a difference of decimals
NORMAL = 1.4826  # standard deviation over median absolute deviation of a normal distribution


def quiet_pieces(rate: Values, stretches: Sequence[tuple[int, int]], interval: float, shortest: int) -> Spans:
    """Cut stretches in which the accelerometer is quiet where the gyroscope turns.

    Parameters
    ----------
    rate : (n, 3) array, deg/s
        Finite in the stretches.
    stretches : sequence of (int, int)
        Start and stop of each, in order.
    interval : float, s
        Mean time between samples.
    shortest : int
        Samples of the shortest piece that is a rest.
    """
    size = max(FEWEST, round(WINDOW_S / interval))
    if not stretches or min(stop - start for start, stop in stretches) < size:
        return list(stretches)
    parts = [rate[start:stop] for start, stop in stretches]
    of_parts = [windows(part, size) for part in parts]
    medians = np.array([median(mean) for mean, _ in of_parts])
    reference, resting = _references(medians, np.array([mean[[0, -1]] for mean, _ in of_parts]))
    off = [np.abs(mean - r) for (mean, _), r in zip(of_parts, reference, strict=True)]
    differences = np.concatenate([np.abs(np.diff(part, axis=0)) for part in parts])
    white = noise_of_steps(differences) / np.sqrt(size)
    spread = NORMAL * np.array([median(own) for own in off])
    noise = np.array([median(variance) for _, variance in of_parts])
    spread = np.where(resting[:, None], spread, np.median(spread, axis=0))
    count = counts_of(differences)
    limit = np.minimum(SIGNIFICANT * np.maximum(white, spread), np.maximum(SIGNIFICANT * white, TREMOR_LIMIT_DPS))
    limit = np.maximum(limit, count * (1.0 + ROUNDING))
    loud = SIGNIFICANT**2 * np.maximum(np.where(resting, noise, np.median(noise)), np.sum(count**2) / 12.0)
    pieces: Spans = []
    for i, (start, stop) in enumerate(stretches):
        turns = np.any(off[i] > limit[i], axis=1) | (of_parts[i][1] > loud[i])
        quiet = ~_widened(turns, size // 2, stop - start)
        turned = np.vstack([np.zeros(3), np.cumsum((parts[i] - reference[i]) * interval, axis=0)])
        found = _rests(quiet, turned, shortest)
        if not (found or resting[i]):
            found = [(0, stop - start)]  # for the caller to refuse, with the reason
        pieces += [(start + a, start + b) for a, b in found]
    return pieces


def counts_of(differences: Values) -> Values:
    """Return the smallest step between successive readings of each axis, (k,), by their absolute differences (n, k).

    Of coarse readings it is one count, of fine ones nothing beside their noise.
    """
    smallest = np.min(differences, axis=0, where=differences > 0.0, initial=np.inf)
    return np.asarray(np.where(np.isfinite(smallest), smallest, 0.0))


def windows(values: Values, size: int) -> tuple[Values, Values]:
    """Return the mean of each window of ``size`` rows, (m, k), and its variance summed over the columns, (m,)."""
    middle = median(values)
    centred = values - middle
    sums = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(centred, axis=0)])
    squares = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(centred**2, axis=0)])
    total, power = sums[size:] - sums[:-size], squares[size:] - squares[:-size]
    variance = np.maximum((power - total**2 / size).sum(axis=1), 0.0) / (size - 1)
    return total / size + middle, variance


def _references(medians: Values, ends: Values) -> tuple[Values, Mask]:
    """Return the rate at rest of each stretch, and which of them mostly rest; ``ends`` are (m, 2, 3)."""
    out, resting = medians.copy(), np.ones(len(medians), bool)
    if len(medians) <= 2:
        middle = ends.mean(axis=1)
        still = np.abs(ends[:, 0] - ends[:, 1]).max(axis=1) < RATE_LIMIT_DPS
        resting = ~(still & (np.abs(medians - middle).max(axis=1) > RATE_LIMIT_DPS))
        return np.where(resting[:, None], medians, middle), resting
    for i, own in enumerate(medians):
        first = int(np.clip(i - NEIGHBOURS // 2, 0, max(len(medians) - NEIGHBOURS, 0)))
        around = median(medians[first : first + NEIGHBOURS])
        if np.abs(own - around).max() > RATE_LIMIT_DPS:
            out[i], resting[i] = around, False
    return out, resting


def _widened(turns: Mask, half: int, samples: int) -> Mask:
    """Return which samples lie within half a window of the middle of a window in which the unit turns."""
    near = np.zeros(samples, bool)
    for start in np.flatnonzero(turns):
        near[start : start + 2 * half + 1] = True
    return near


def _rests(quiet: Mask, turned: Values, shortest: int) -> Spans:
    """Return the quiet runs, of those between which the unit did not turn the longest alone."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], quiet, [False]]).astype(np.int8)))
    found = [(a, b) for a, b in edges.reshape(-1, 2).tolist() if b - a >= shortest]
    out: Spans = []
    for a, b in found:
        if out and np.linalg.norm(turned[a] - turned[out[-1][1]]) < SAME_DEG:
            if b - a > out[-1][1] - out[-1][0]:
                out[-1] = (a, b)
        else:
            out.append((a, b))
    return out
