"""Accelerometer and gyroscope in messages of their own, at times and rates of their own, of one clock.

The rows are the messages of the slower sensor, at t_k. The faster one is averaged over the interval about each row:

    mean_k = (A(e_{k+1}) - A(e_k)) / (e_{k+1} - e_k),   A = integral of the reading,   e_k = (t_{k-1} + t_k) / 2

A reading is a straight line between two messages. An average keeps the integral and the density of white noise,
which interpolation does not. It is a low-pass filter over the slower sensor's interval.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import IngestError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Values = NDArray[np.float64]

FEWEST = 3  # messages of a sensor: a row has a neighbour on both sides
LONGEST_GAP = 1.5  # times the median interval, as of a recording's rows


def slower_first(first: NDArray[np.int64], second: NDArray[np.int64]) -> bool:
    """Return whether the first of two sensors, by the times of their messages in ns, is the slower one."""
    return float(np.median(np.diff(first))) >= float(np.median(np.diff(second)))


def rows_covered(slow: NDArray[np.int64], fast: NDArray[np.int64], topic: str, path: str) -> NDArray[np.intp]:
    """Return the messages of the slower sensor whose whole interval the faster one covers without a gap.

    Raises
    ------
    IngestError
        If there are none; ``topic`` is that of the faster sensor.
    """
    found = np.zeros(0, np.intp)
    if len(slow) >= FEWEST and len(fast) >= FEWEST:
        edges, steps = _edges(slow), np.diff(fast)
        inside = (edges[:-1] >= fast[0]) & (edges[1:] <= fast[-1])
        gaps = np.flatnonzero(steps > LONGEST_GAP * np.median(steps))
        begun = np.searchsorted(fast[gaps], edges[1:], side="left")  # gaps that begin before the end of a row
        ended = np.searchsorted(fast[gaps + 1], edges[:-1], side="right")  # and that end before its beginning
        found = np.flatnonzero(inside & (begun == ended)) + 1
    if len(found) < FEWEST:
        message = f"the messages on {topic} do not cover those of the other sensor in time"
        raise IngestError(message, path, code="bad_time", hint="both topics have to bear stamps of one clock")
    return found


def averaged(slow: NDArray[np.int64], rows: NDArray[np.intp], fast: NDArray[np.int64], values: Values) -> Values:
    """Return the mean of a channel of the faster sensor over the interval about each of some rows of the slower one."""
    edges = (_edges(slow) - slow[0]) / 1e9
    time = (fast - slow[0]) / 1e9
    integral = np.concatenate([[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(time))])
    j = np.clip(np.searchsorted(time, edges, side="right") - 1, 0, len(time) - 2)
    step, since = np.diff(time)[j], edges - time[j]
    at_edges = integral[j] + since * (values[j] + 0.5 * (values[j + 1] - values[j]) * since / step)
    means: Values = (np.diff(at_edges) / np.diff(edges))[rows - 1]
    return means


def _edges(slow: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the middles between messages: the beginning and end of each but the first and last."""
    edges: NDArray[np.int64] = slow[:-1] + np.diff(slow) // 2
    return edges
