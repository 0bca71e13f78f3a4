"""The readings of the rests of a recording: those samples that tell the noise."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from pipeline.records import noise_of_steps
from pipeline.signal.filter_noise import filter_autocovariance
from pipeline.signal.rests import find_rests, rests_from_table, runs

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.records import Recording

    Rest = tuple[NDArray[np.float64], NDArray[np.float64]]

GAP = 1.5
EDGE_S, FEWEST_TO_SETTLE, SETTLED = 0.5, 6, 8.0


def stretches_of(recording: Recording, mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the runs of a mask, cut at gaps in time."""
    cuts = np.flatnonzero(np.diff(recording.time_ns) > GAP * recording.interval * 1e9) + 1
    if len(cuts) == 0:
        return runs(mask)
    pieces: list[tuple[int, int]] = []
    for start, stop in runs(mask):
        edges = [start, *cuts[(cuts > start) & (cuts < stop)].tolist(), stop]
        pieces += pairwise(edges)
    return pieces


def usable(recording: Recording, values: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which samples are neither missing nor marked by ingest: (n,) array."""
    return np.asarray(np.isfinite(values).all(axis=1) & recording.valid)


def rest_readings(recording: Recording, sensor: str, *, everything: bool) -> list[Rest]:
    """Return the times and readings of each rest of a recording."""
    values = recording.reading(sensor)
    assert values is not None  # noqa: S101
    still = usable(recording, values)
    if not everything:
        found = rests_from_table(recording)
        if not found and recording.role == "rests":
            found = find_rests(recording)
        resting = np.zeros(recording.samples, bool)
        memory = len(filter_autocovariance(recording)) - 1  # so long a filter's output holds what was before the rest
        ahead = memory if recording.filter.get("zero_phase") else 0
        for rest in found:
            first = rest.start + memory * (rest.start > 0)
            resting[first : rest.stop - ahead * (rest.stop < recording.samples)] = rest.accepted
        still &= resting
    if everything:  # a gap does not end a static rest: the likelihood knows the times
        return [(recording.time[still], values[still])] if still.any() else []
    settled = _settled(recording, values, stretches_of(recording, still))
    return [(recording.time[a:b], values[a:b]) for a, b in settled if b - a > 2]


def _settled(
    recording: Recording, values: NDArray[np.float64], stretches: list[tuple[int, int]]
) -> list[tuple[int, int]]:
    """Return rests without the samples at their edges that still move; the sensor's clock may be off the table's."""
    ends = np.array(stretches, int).reshape(-1, 2)
    lengths = ends[:, 1] - ends[:, 0]
    edges = np.minimum(int(EDGE_S / recording.interval) + 1, lengths // 3)
    for edge in np.unique(edges[lengths >= FEWEST_TO_SETTLE]).tolist():
        alike = np.flatnonzero((edges == edge) & (lengths >= FEWEST_TO_SETTLE))
        length = int(lengths[alike].min())
        inside = values[ends[alike, :1] + np.arange(length)]
        spread = noise_of_steps(np.abs(np.diff(inside, axis=1)), axis=1, keepdims=True)
        for side in (1, -1):
            ordered = inside if side == 1 else values[ends[alike, 1:] - 1 - np.arange(3 * edge)]
            middle = np.median(ordered[:, edge : 3 * edge], axis=1, keepdims=True)
            off = np.abs(ordered[:, :edge] - middle) > SETTLED * spread
            moving = np.any(off & (spread > 0), axis=2)
            cut = np.where(moving, np.arange(1, edge + 1), 0).max(axis=1)
            ends[alike, 0 if side == 1 else 1] += side * cut
    return [(a, b) for a, b in ends.tolist()]
