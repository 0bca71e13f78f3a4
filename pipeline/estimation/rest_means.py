"""The rests that a calibration without a table uses, those that are held out of it, and their mean readings.

A rest is one orientation: its mean reading is one equation, ``|matrix @ (mean - bias)| = G``. Where a unit has no
recording for validation, every ``holdout_every``-th rest is kept out of the fit, and the fit is judged by it. The
gyroscope is fitted to the rests of the accelerometer's method.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from pipeline.signal.filters import filter_autocovariance, smooth_temperature, variance_of_mean
from pipeline.signal.quiet_motion import believed_rates, creep_in
from pipeline.signal.rests import find_rests, rests_from_table, usable

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.records import Index, Integers, Mask, Recording, SensorCalibration, Values
    from pipeline.signal.rests import Rest

ROLE, HELD_OUT = "rests", "validation"


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

    ``recordings``: those of role ``rests`` count. ``settings``: ``procedure.holdout_every``. Empty where there is a
    recording for validation. The move before a rest ends with it: it begins where the rest before, held out or not,
    stops.
    """
    every = holdout_interval(recordings, settings)
    if not every:
        return {}
    return {r.name: list(split_rests(r, every).held_out) for r in recordings if r.role == "rests"}


def rests_by_use(recordings: Sequence[Recording], settings: Mapping[str, Any]) -> dict[str, list[dict[str, Any]]]:
    """Return the rests of the recordings of role ``rests``: which a fit would use, and which not, with the reason.

    ``settings``: ``procedure.holdout_every``. The keys are ``rests_used``, ``rests_held_out`` and ``rests_left_out``,
    the values as of ``describe_rests``; what a fit itself leaves out counts as used here.
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


def rest_means(recording: Recording, rests: Sequence[Rest], sensor: str = "accelerometer") -> tuple[Values, Integers]:
    """Return the mean reading of each rest, without clipped, stuck or missing samples.

    By hand a unit may creep: the mean over its directions is too short, and is made longer by that (see
    ``pipeline.signal.quiet_motion``).

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
    if sensor == "accelerometer" and recording.role in (ROLE, HELD_OUT) and recording.table_angle is None:
        creeps = [creep_in(recording, rest.start, rest.stop) for rest in rests]
        means *= 1.0 + np.array([creep.shortening for creep in creeps])[:, None]
    return means, counts


def sound_samples(recording: Recording, sensor: str) -> Mask:
    """Return which samples of a sensor are neither clipped, stuck nor missing: (n,) array of bool."""
    reading = recording.reading(sensor)
    return np.zeros(recording.samples, bool) if reading is None else usable(recording, reading)


@dataclass(frozen=True)
class Rests:
    """Rests of all recordings, in order."""

    reading: Values  # (m, 3), g or deg/s; means
    count: Integers  # (m,); samples of each
    share: Values  # (m,); variance of each mean by white noise, over that of a raw sample
    scatter: Values  # (m, 3); sums of squares about the means
    # each (m,), s; when each begins, how long it is, and its mean time
    start: Values
    length: Values
    time: Values
    temperature: Values  # (m,), degC; NaN where none was recorded
    recording: Index  # (m,); index of the recording that each belongs to
    held_out: Mask  # (m,)
    span: Index  # (m, 2); its first sample, and the one after its last
    # (m, 3), deg/s; rate across gravity at which the unit tilts, by the readings of the accelerometer; 0 where it
    # stands still
    creep: Values
    creep_error: Values  # (m,), deg/s; standard uncertainty of each of its two components
    creep_about: Values  # (m,), deg/s; standard deviation of the rate about gravity
    clock_shared: bool  # whether the time between the recordings is known

    def select(self, index: Mask) -> Self:
        """Return some of the rests."""
        arrays = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "clock_shared"}
        return replace(self, **{name: values[index] for name, values in arrays.items()})

    @property
    def white(self) -> Values:
        """Standard deviation of a sample about the mean of its rest: (3,) array."""
        return np.asarray(np.sqrt(self.scatter.sum(axis=0) / max(float(np.sum(self.count - 1)), 1.0)))

    @property
    def freedom(self) -> float:
        """Degrees of freedom of the scatter within the rests."""
        return float(3 * np.sum(self.count - 1))

    @property
    def joined(self) -> Mask:
        """Whether the time from each rest to each other is known: (m, m) array."""
        same: Mask = self.recording[:, None] == self.recording
        return np.ones_like(same) if self.clock_shared else same


def is_multi_position(sensor: str, recordings: Sequence[Recording]) -> bool:
    """Return whether a sensor was recorded in rests and moves, without the motion of a table."""
    own = [r for r in recordings if r.reading(sensor) is not None and r.role != HELD_OUT]
    logged = any(r.table_angle is not None or r.table_attitude is not None for r in own)
    return any(r.role == ROLE for r in own) and not logged


def rests_of(
    sensor: str,
    recordings: Sequence[Recording],
    settings: Mapping[str, Any],
    accelerometer: SensorCalibration | None = None,
    role: str = ROLE,
) -> Rests | None:
    """Return the rests of the recordings of a role, or None where there are none.

    ``settings``: section ``procedure``: ``holdout_every``. ``accelerometer``: rests that its method left out are left
    out here. ``role``: ``rests``, or ``validation``, whose rests are all held out.
    """
    every = holdout_interval(recordings, settings) if role == ROLE else 0
    refused = _left_out(accelerometer)
    chosen = [(i, r) for i, r in enumerate(recordings) if r.role == role and r.reading(sensor) is not None]
    columns: dict[str, list[Any]] = {}
    for index, recording in chosen:
        split = split_rests(recording, every)
        rests = sorted([*split.used, *split.held_out], key=lambda rest: rest.start)
        rests = [r for r in rests if (recording.name, float(recording.time[r.start])) not in refused]
        found = _of_recording(sensor, recording, rests)
        out = [rest.start for rest in split.held_out]
        found["held_out"] = np.isin(found["span"][:, 0], out) | (role == HELD_OUT)
        found["recording"] = np.full(len(found["count"]), index)
        for name, values in found.items():
            columns.setdefault(name, []).append(values)
    if not columns or sum(len(c) for c in columns["count"]) == 0:
        return None
    alone = len(np.unique(np.concatenate(columns["recording"]))) == 1
    shared = alone or all(recording.clock_shared for _, recording in chosen)
    return Rests(**{name: np.concatenate(values) for name, values in columns.items()}, clock_shared=shared)


def _left_out(accelerometer: SensorCalibration | None) -> set[tuple[str, float]]:
    return {
        (rest["recording"], float(rest["time_s"]))
        for stage in (accelerometer.stages if accelerometer else ())
        for rest in stage.details.get("rests_left_out", ())
    }


def _of_recording(sensor: str, recording: Recording, rests: Sequence[Rest]) -> dict[str, Any]:
    """Return the columns of ``Rests`` for one recording; rests without a sound sample are left out."""
    means, counts = rest_means(recording, rests, sensor)
    kept = counts > 0
    span = np.array([[rest.start, rest.stop] for rest in rests], np.intp).reshape(-1, 2)[kept]
    means, counts, time = means[kept], counts[kept], recording.time
    reading, good = recording.reading(sensor), sound_samples(recording, sensor)
    assert reading is not None  # noqa: S101
    inside = [slice(a, b) for a, b in span]
    scatter = [np.sum((reading[s][good[s]] - mean) ** 2, axis=0) for s, mean in zip(inside, means, strict=True)]
    creeps = [creep_in(recording, a, b) for a, b in span.tolist()] if recording.accelerometer is not None else []
    rate, error, about = believed_rates(creeps) if creeps else (np.zeros((len(span), 3)), np.zeros(len(span)), 0.0)
    if sensor == "accelerometer":  # less the tilt of a unit that creeps
        scatter = [c.squares * max(n - 1, 1) / max(c.freedom, 1) for c, n in zip(creeps, counts, strict=True)]
    warmth = np.full(recording.samples, np.nan)
    if recording.temperature is not None:
        warmth = smooth_temperature(time, recording.temperature)
    start = time[span[:, 0]]
    return {
        "reading": means,
        "count": counts,
        "share": variance_of_mean(filter_autocovariance(recording), counts) if len(counts) else np.zeros(0),
        "scatter": np.array(scatter).reshape(-1, 3),
        "start": start,
        "length": time[span[:, 1] - 1] - start + recording.interval,
        "time": np.array([time[s].mean() for s in inside]),
        "temperature": np.array([warmth[s].mean() for s in inside]),
        "span": span,
        "creep": rate,
        "creep_error": error,
        "creep_about": np.full(len(span), about),
    }
