"""Rests in a recording: from a table's log, or from the sensor's own readings."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

RATE_AT_REST_DPS = 0.02
SETTLING_S = 0.3


def runs(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the (start, stop) index pairs of the runs of True in a mask."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def still_samples(
    time: NDArray[np.float64], rate: NDArray[np.float64], settling: float = SETTLING_S
) -> NDArray[np.bool_]:
    """Return which samples rest and have settled, by a table's rate.

    A rest begins where |rate| falls under 0.02 deg/s; its first ``settling`` seconds are left out, unless the recording
    begins with it.

    Parameters
    ----------
    time : (n,) array, s
    rate : (n,) array, deg/s
    settling : float, s

    Returns
    -------
    (n,) array of bool
    """
    still = np.abs(rate) < RATE_AT_REST_DPS
    for start, stop in runs(still):
        if start > 0:
            still[start:stop] &= time[start:stop] >= time[start] + settling
    return still
