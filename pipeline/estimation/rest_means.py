"""The rests that a calibration without a table uses, those that are held out of it, and the mean reading of each.

A rest is one orientation: its mean reading is one equation, ``|matrix @ (mean - bias)| = G``. Where a unit has no
recording for validation, every ``holdout_every``-th rest is kept out of the fit, and the fit is judged by it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.signal.creep import creep_in
from pipeline.signal.rests import find_rests, rests_from_table

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.records import Recording
    from pipeline.signal.rests import Rest


BY_HAND = ("rests", "validation")


@dataclass(frozen=True)
class RestSplit:
    """The rests of one recording, each in order of time."""

    used: tuple[Rest, ...]  # for the fit
    held_out: tuple[Rest, ...]  # for the validation
    left_out: tuple[Rest, ...]  # refused, with the reason


def holdout_interval(recordings: Sequence[Recording], settings: Mapping[str, Any]) -> int:
    """Return k where every k-th rest is held out; 0 where none is, as with a recording for validation."""
    if any(recording.role == "validation" for recording in recordings):
        return 0
    return int(settings["procedure"].get("holdout_every") or 0)


def split_rests(recording: Recording, every: int) -> RestSplit:
    """Find the rests of a recording and hold out every ``every``-th of those that are sound; 0 holds out none.

    The middle one of each group of ``every`` is held out: the first and the last rest stay in the fit.

    ``recording``: by the table's log where it has one, else by its readings.
    """
    rests = rests_from_table(recording) or find_rests(recording)
    sound = [rest for rest in rests if rest.accepted]
    held = set(range(every // 2, len(sound), every)) if every else set()
    return RestSplit(
        used=tuple(rest for i, rest in enumerate(sound) if i not in held),
        held_out=tuple(sound[i] for i in sorted(held)),
        left_out=tuple(rest for rest in rests if not rest.accepted),
    )


def held_out_rests(recordings: Sequence[Recording], settings: Mapping[str, Any]) -> dict[str, list[Rest]]:
    """Return the rests that no fit uses, by the name of their recording.

    ``recordings``: those of role ``rests`` count. ``settings``: section ``procedure``: ``holdout_every``. Returns empty
    where there is a recording for validation. The move before a rest ends with it: it begins where the rest before,
    held out or not, stops.
    """
    every = holdout_interval(recordings, settings)
    if not every:
        return {}
    return {r.name: list(split_rests(r, every).held_out) for r in recordings if r.role == "rests"}


def rests_by_use(recordings: Sequence[Recording], settings: Mapping[str, Any]) -> dict[str, list[dict[str, Any]]]:
    """Return the rests of the recordings of role ``rests``: which a fit would use, and which not, with the reason.

    ``settings``: section ``procedure``: ``holdout_every``. Returns ``rests_used``, ``rests_held_out``,
    ``rests_left_out``, each as of ``describe_rests``; what a fit itself leaves out counts as used here.
    """
    every = holdout_interval(recordings, settings)
    found: dict[str, list[dict[str, Any]]] = {"rests_used": [], "rests_held_out": [], "rests_left_out": []}
    for recording in (r for r in recordings if r.role == "rests"):
        split = split_rests(recording, every)
        for use, rests in zip(found, (split.used, split.held_out, split.left_out), strict=True):
            found[use] += describe_rests([(recording, rest) for rest in rests])
    return found


def describe_rests(pairs: Sequence[tuple[Recording, Rest]]) -> list[dict[str, Any]]:
    """Return each rest's recording, start and duration in s, and why it is refused (empty where it is not)."""
    return [
        {
            "recording": recording.name,
            "time_s": float(recording.time[rest.start]),
            "duration_s": float(recording.time[rest.stop - 1] - recording.time[rest.start]),
            "creep_dps": _creep_rate(recording, rest),
            "reason": rest.reason,
        }
        for recording, rest in pairs
    ]


def _creep_rate(recording: Recording, rest: Rest) -> float:
    """Return the rate at which the unit tilts in a rest, deg/s; 0 where it does not stand out of the noise."""
    if recording.accelerometer is None:
        return 0.0
    return float(np.linalg.norm(creep_in(recording, rest.start, rest.stop).rate))


def rest_means(
    recording: Recording, rests: Sequence[Rest], sensor: str = "accelerometer"
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the mean reading of each rest, without clipped, stuck or missing samples.

    By hand a unit may creep: the mean over its directions is too short, and is made longer by that (see
    ``pipeline.signal.creep``).

    Returns ``means`` (m, 3), g or deg/s: NaN where a rest has no sound sample; ``counts`` (m,): number of samples
    averaged.
    """
    reading = recording.reading(sensor)
    if reading is None or not rests:
        return np.empty((0, 3)), np.empty(0, np.int64)
    good = sound_samples(recording, sensor)
    edges = np.array([[rest.start, rest.stop] for rest in rests])
    centre = np.mean(reading[good], axis=0) if good.any() else np.zeros(3)  # keeps the running sums short
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(np.where(good[:, None], reading - centre, 0.0), axis=0)])
    number = np.concatenate([[0], np.cumsum(good)])
    counts = number[edges[:, 1]] - number[edges[:, 0]]
    sums = total[edges[:, 1]] - total[edges[:, 0]]
    means = np.full((len(rests), 3), np.nan)
    filled = counts > 0
    means[filled] = centre + sums[filled] / counts[filled, None]
    if sensor == "accelerometer" and recording.role in BY_HAND and recording.table_angle is None:
        creeps = [creep_in(recording, rest.start, rest.stop) for rest in rests]
        means *= 1.0 + np.array([creep.shortening for creep in creeps])[:, None]
    return means, counts


def sound_samples(recording: Recording, sensor: str) -> NDArray[np.bool_]:
    """Return which samples of a sensor are neither clipped, stuck nor missing: (n,) array of bool."""
    reading = recording.reading(sensor)
    if reading is None:
        return np.zeros(recording.samples, bool)
    return np.asarray(np.isfinite(reading).all(axis=1) & recording.valid)
