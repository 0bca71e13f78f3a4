"""Turns by hand, by a stated angle about one body axis from rest to rest: which they are, and those to hold out.

    Y = integral (y - b) dt,   n = round(Y_a / A),   |Y_a - n A| < min(|n A| / 10, A / 4),   |Y - Y_a e_a| < |Y_a| / 4

where

    y, b : angular rate as it was read, and the mean of both rests
    a, A : the axis with the largest |Y_a|, and the stated angle; n is not 0
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.signal.rests import find_rests

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pipeline.records import Recording, Values

SCALE = 0.1  # relative: three times the largest scale factor error of the shipped data sheets (MPU-6050: 3 %)
ACROSS = 0.25  # 15 deg between the turn and a body axis: a chip askew in its case, and a hand
HALF_S = 2.0  # of a rest that is cut in two: half a second is trimmed, a second is the shortest rest


def multiples(angle: Values, stated_deg: float) -> tuple[int, int]:
    """Return the axis that an integrated rate (3,), deg, is about, and of how many stated angles it is; 0 for none."""
    axis = int(np.argmax(np.abs(angle)))
    along = float(angle[axis])
    count = round(along / stated_deg)
    off, across = abs(along - count * stated_deg), float(np.linalg.norm(np.delete(angle, axis)))
    sound = off < min(SCALE * abs(count) * stated_deg, 0.25 * stated_deg) and across < ACROSS * abs(along)
    return axis, count if sound else 0


def held_out_windows(recording: Recording, turns: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the windows that cut every k-th turn about each axis out of a recording, as role ``validation``.

    Parameters
    ----------
    recording : Recording
    turns : mapping
        ``angle_deg`` and ``holdout_every`` (k; 0: none).

    Returns
    -------
    list of dict
        As of ``pipeline.signal.segments.cut``, from the middle of the rest before a turn to that of the rest after it;
        empty where nothing is held out.
    """
    rate, every = recording.gyroscope, int(turns["holdout_every"])
    if rate is None or not every:
        return []
    since = recording.time - recording.time[0]
    seen, edges = [0, 0, 0], [0.0]
    for before, after in pairwise(r for r in find_rests(recording) if r.accepted):
        move = slice(before.stop - 1, after.start + 1)
        bias = 0.5 * sum(rate[r.start : r.stop].mean(axis=0) for r in (before, after))
        axis, count = multiples(np.trapezoid(rate[move] - bias, since[move], axis=0), float(turns["angle_deg"]))
        seen[axis] += bool(count)
        ends = [(float(since[r.start]), float(since[r.stop - 1])) for r in (before, after)]
        if count and seen[axis] % every == 0 and min(stop - start for start, stop in ends) > 2.0 * HALF_S:
            edges += [0.5 * (start + stop) for start, stop in ends]
    edges.append(float(since[-1]) + recording.interval)
    roles = ["rests", "validation"] * len(edges)
    spans = zip(pairwise(edges), roles, strict=False)
    return [{"role": role, "start_s": a, "stop_s": b} for (a, b), role in spans if b > a] if len(edges) > 2 else []
