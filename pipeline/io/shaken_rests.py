"""Rests of a table in which the readings were not at rest: someone leant on it, or bumped it, for a part of a dwell.

A rest by the table's log, without its first and last 0.3 s, in which a late or early sensor reads the move, is cut into
pieces of at most 2 s. A piece is shaken where

    chi^2 = sum over its n samples and the 3 axes of (x - m)^2 / s^2 > 4 nu  and  > nu + 6 sqrt(2 nu) + 18

with ``nu = 3 (n - 1)``, where

    m : mean of the piece
    s : scatter of an axis about m in most pieces of the recording, so that what a bench does in every rest, and what a
        late sensor still reads of every move, is none; half a count at least

without the one sample that is farthest off, which may be a glitch. The piece is left out as a whole: which half of it
was at rest would have to be guessed. Rests by hand have tests of their own (``pipeline.signal.rests``).
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np

from pipeline.io.disturbances import without_rows
from pipeline.io.quality_flags import UNIT_NAMES

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from pipeline.records import Note, Recording

    Array = NDArray[np.float64]
    Index = NDArray[np.intp]

PIECE_S, SETTLING_S = 2.0, 0.3
AT_REST_DPS = 0.02
FEWEST = 4  # samples of a piece
FEWEST_PIECES = 8  # by which the usual scatter is known
RATIO = 4.0
SIGNIFICANT, TAIL = 6.0, 18.0
LARGEST_SHARE = 0.1  # of the pieces


def leave_out_shaken_rests(recording: Recording, note: Callable[[str, Index, str], Note]) -> Recording:
    """Return a recording without the pieces of its rests that were shaken, noted as ``N-SHAKEN``.

    Parameters
    ----------
    recording : Recording
        Others than those that log a table's rate or angle are returned as they are.
    note : callable
        ``ChannelTable.note`` of its file.
    """
    pieces = _pieces(recording)
    if len(pieces) < FEWEST_PIECES:
        return recording
    found = {s: r for s in UNIT_NAMES if (r := recording.reading(s)) is not None and np.isfinite(r).all()}
    worst: tuple[float, str] = (0.0, "")
    shaken = np.zeros(len(pieces), bool)
    for sensor, reading in found.items():
        excess, scatter = _excess(reading, pieces[:, :2])
        shaken |= excess > 0.0
        first = int(np.argmax(excess))
        if excess[first] > worst[0]:
            times = recording.time[pieces[first, 0]]
            worst = float(excess[first]), f"the {sensor} scatters {scatter[first]:.1f} times as usual at {times:.6g} s"
    count = int(shaken.sum())
    if count == 0 or count > max(1.0, LARGEST_SHARE * len(pieces)):
        return recording
    rows = np.concatenate([np.arange(a, b) for a, b in pieces[shaken, 2:]])
    detail = f"{count} of {len(pieces)} pieces of rests left out, in which the unit was shaken or leant on; {worst[1]}"
    return without_rows(recording, rows, note("N-SHAKEN", rows, detail))


def _pieces(recording: Recording) -> Index:
    """Return first sample and end of each piece of a rest, and of what goes with it: (p, 4) array."""
    none = np.zeros((0, 4), np.intp)
    if recording.samples < FEWEST * FEWEST_PIECES or recording.role in ("rests", "static"):
        return none
    if recording.table_rate is not None:
        still = np.abs(recording.table_rate) < AT_REST_DPS
    elif recording.table_angle is not None:
        step = np.abs(np.diff(recording.table_angle, prepend=recording.table_angle[0]))
        still = np.maximum(step, np.append(step[1:], 0.0)) < AT_REST_DPS * recording.interval
    else:
        return none
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(np.int8)))
    size = max(FEWEST, round(PIECE_S / recording.interval))
    out = []
    settling = int(np.ceil(SETTLING_S / recording.interval))
    for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        start, stop = begin + settling, end - settling
        if stop - start < FEWEST:
            continue
        parts = -(-(stop - start) // size)
        cuts = [start + (stop - start) * k // parts for k in range(parts + 1)]
        whole = [begin, *cuts[1:-1], end]
        spans = zip(itertools.pairwise(cuts), itertools.pairwise(whole), strict=True)
        out += [(*inner, *outer) for inner, outer in spans if inner[1] - inner[0] >= FEWEST]
    return np.array(out, np.intp).reshape(-1, 4)


def _excess(reading: Array, pieces: Index) -> tuple[Array, Array]:
    """Return by how much the chi^2 of each piece exceeds its limit, and its scatter over the usual one: (p,) arrays."""
    count = np.diff(pieces, axis=1)[:, 0].astype(float)
    bounds = pieces.ravel()
    centred = np.append(reading - reading.mean(axis=0), np.zeros((1, 3)), axis=0)
    sums, squares = (np.add.reduceat(v, bounds, axis=0)[::2] for v in (centred, centred**2))
    left = np.maximum(squares - sums**2 / count[:, None], 0.0)
    step = np.abs(np.diff(reading, axis=0))
    rounding = np.where(step > 0.0, step, np.inf).min(axis=0) ** 2 / 4.0  # between two counts
    usual = np.maximum(np.median(left / (count - 1.0)[:, None], axis=0), rounding)
    chi = np.sum(left / usual, axis=1)
    freedom = 3.0 * (count - 1.0)
    most = np.maximum(RATIO * freedom, freedom + SIGNIFICANT * np.sqrt(2.0 * freedom) + TAIL)
    for piece in np.flatnonzero(chi > most):
        start, stop = pieces[piece]
        own = reading[start:stop]
        alone = np.sum((own - own.mean(axis=0)) ** 2 / usual, axis=1) * count[piece] / (count[piece] - 1.0)
        chi[piece] -= float(alone.max())
    return np.maximum(chi - most, 0.0), np.sqrt(chi / freedom)
