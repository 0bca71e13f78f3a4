"""Select the rests for a calibration without a table, and the held-out rests; compute their mean readings.

A rest is one orientation: its mean reading is one equation, ``|matrix @ (mean - bias)| = G``. If a unit has no
recording for validation, every ``holdout_every``-th rest is held out of the fit for validation. The gyroscope is fitted
to the rests of the accelerometer's method. ``Orientations`` are the rows of a fit to the length of gravity, also on a
table: dwells of stop-and-go turns, or single samples of continuous turns.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from pipeline.core.errors import CannotCalibrateError
from pipeline.core.records import (
    NOISE_OF_ROWS,
    Index,
    Integers,
    Mask,
    Recording,
    RestUse,
    SensorCalibration,
    Values,
    once,
)
from pipeline.core.settings import Procedure, Settings, Table
from pipeline.estimation.turns import stop_and_go
from pipeline.physics.effects.base import REFERENCE_TEMPERATURE
from pipeline.physics.kinematics import table_motion
from pipeline.physics.signal.filters import (
    filter_autocovariance,
    heats_and_cools,
    temperature_of,
    temperature_rate_of,
    variance_of_mean,
)
from pipeline.physics.signal.quiet_motion import creep_of_rest, posterior_creep_rates, rounding_of_readings
from pipeline.physics.signal.rests import Rest, find_rests, rests_from_table, usable

ROLE, HELD_OUT = "rests", "validation"
SOAK, ATTITUDES = "soak", "attitudes"  # kinds of recordings in the sheet; times of attitudes do not count
BY_HAND = ("", "moves")  # kinds with rests and moves by hand, of which some are held out; "": without a sheet
PASSED, MOST = 20, 0.5  # temperatures between the ends of a soak; the share of them that makes a second cycle


@dataclass(frozen=True)
class RestSplit:
    """The rests of one recording, each in order of time."""

    used: tuple[Rest, ...]  # for the fit
    held_out: tuple[Rest, ...]  # for the validation
    left_out: tuple[Rest, ...]  # refused, each with its reason


def holdout_interval(recordings: Sequence[Recording], procedure: Procedure) -> int:
    """Return k if every k-th rest is held out; 0 with held-out motion or fewer rests than ``holdout_from``."""
    every, fewest = procedure.holdout_every, procedure.holdout_from
    if not every or any(recording.role == HELD_OUT for recording in recordings):
        return 0
    return every if not fewest or count_of_rests(recordings) >= fewest else 0


def count_of_rests(recordings: Sequence[Recording]) -> int:
    """Return the number of accepted rests in the recordings of role ``rests``; with a sheet, in those of moves."""
    return sum(len(split_rests(r, 0).used) for r in recordings if r.role == ROLE and r.kind in BY_HAND)


def split_rests(recording: Recording, every: int) -> RestSplit:
    """Find the rests of a recording, by the table's log or else by its readings, and hold out some.

    ``every``: the middle one of so many accepted rests is held out, so that the first and the last rest are in the fit;
    0 holds out none. A sheet's recordings of other kinds than moves are used whole.
    """
    rests = rests_from_table(recording) or find_rests(recording)
    accepted = [rest for rest in rests if rest.accepted]
    held = range(every // 2, len(accepted), every) if every and recording.kind in BY_HAND else range(0)
    used = tuple(rest for i, rest in enumerate(accepted) if i not in held)
    left_out = tuple(rest for rest in rests if not rest.accepted)
    return RestSplit(used=used, held_out=tuple(accepted[i] for i in held), left_out=left_out)


def held_out_rests(recordings: Sequence[Recording], procedure: Procedure) -> dict[str, list[Rest]]:
    """Return the held-out rests of role ``rests`` by recording; the move before each of them is held out, too."""
    every = holdout_interval(recordings, procedure)
    return {r.name: list(split_rests(r, every).held_out) for r in recordings if every and r.role == ROLE}


def advice_on_held_out(recordings: Sequence[Recording], procedure: Procedure) -> str:
    """Return advice, as a clause, on how to use the held-out rests in the fit; empty if none are held out."""
    held = sum(map(len, held_out_rests(recordings, procedure).values()))
    if not held:
        return ""
    text = f". There is no recording for validation, so {held} rests, each with the move before it"
    return f"{text}, are held out of the fit: record validation, or use them by procedure.holdout_every=0"


def rests_by_use(recordings: Sequence[Recording], procedure: Procedure) -> dict[str, list[dict[str, Any]]]:
    """Describe the rests of the recordings of role ``rests`` by their use in a fit, for a document: see ``RestUse``.

    The keys are ``rests_used``, ``rests_held_out`` and ``rests_left_out``. Rests that the fit itself excludes later are
    listed as used.
    """
    every = holdout_interval(recordings, procedure)
    splits = [(r, split_rests(r, every)) for r in recordings if r.role == ROLE]
    return {
        f"rests_{use}": [vars(u) for u in rest_uses((r, rest) for r, split in splits for rest in getattr(split, use))]
        for use in ("used", "held_out", "left_out")
    }


def rest_uses(pairs: Iterable[tuple[Recording, Rest]]) -> list[RestUse]:
    """Return the descriptions of rests."""
    uses = []
    for recording, rest in pairs:
        start, last = recording.time[[rest.start, rest.stop - 1]].tolist()
        known = recording.accelerometer is not None
        creep = float(np.linalg.norm(creep_of_rest(recording, rest.start, rest.stop).rate)) if known else 0.0
        about = {"recording": recording.name, "reason": rest.reason}
        uses.append(RestUse(**about, time_s=start, duration_s=last - start, creep_dps=creep))
    return uses


def rest_means(recording: Recording, rests: Sequence[Rest], sensor: str = "accelerometer") -> tuple[Values, Integers]:
    """Return the mean reading of each rest, (m, 3), g or deg/s, and the number of valid samples in it, (m,).

    The mean is NaN where a rest has no valid sample. By hand a unit may creep: the mean over its directions is too
    short, which is corrected (see ``pipeline.physics.signal.quiet_motion``).
    """
    reading = recording.reading(sensor)
    if reading is None or not rests:
        return np.empty((0, 3)), np.empty(0, np.int64)
    good = sound_samples(recording, sensor)
    edges = np.array([[rest.start, rest.stop] for rest in rests])
    centre = np.mean(reading[good], axis=0) if good.any() else np.zeros(3)  # keeps the running sums small
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(np.where(good[:, None], reading - centre, 0.0), axis=0)])
    number = np.concatenate([[0], np.cumsum(good)])
    counts = number[edges[:, 1]] - number[edges[:, 0]]
    sums = total[edges[:, 1]] - total[edges[:, 0]]
    means = np.full((len(rests), 3), np.nan)
    filled = counts > 0
    means[filled] = centre + sums[filled] / counts[filled, None]
    moved = recording.role in (ROLE, HELD_OUT) and recording.table_angle is None and recording.kind != SOAK
    if sensor == "accelerometer" and moved:
        creeps = [creep_of_rest(recording, rest.start, rest.stop) for rest in rests]
        means *= 1.0 + np.array([creep.shortening for creep in creeps])[:, None]
    return means, counts


def nearest_to_reference(temperature: Values) -> int:
    """Return the part of a soak, (k,) degC, nearest to 25 degC; the middle one without a temperature."""
    off = np.abs(temperature - REFERENCE_TEMPERATURE)
    return len(off) // 2 if np.isnan(off).all() else int(np.nanargmin(off))


def _warmth(recording: Recording, rests: Sequence[Rest]) -> tuple[Values, Values]:
    """Return the mean temperature of each rest and its mean rate: (m,) arrays, degC and degC/s; NaN for none."""
    if recording.temperature is None:
        return np.full(len(rests), np.nan), np.full(len(rests), np.nan)
    warmth, rate = temperature_of(recording), temperature_rate_of(recording) * (recording.kind != ATTITUDES)
    warmth, rate = (np.array([v[rest.start : rest.stop].mean() for rest in rests]) for v in (warmth, rate))
    return warmth, rate


def variances_of_means(recording: Recording, counts: Integers, sensor: str) -> tuple[Values, Values]:
    """Return the variances of means by white noise: over that of a sample, and of means that were recorded as such.

    Both are (m,) arrays, one of them zeros. ``counts``: (m,), samples of each.
    """
    none = np.zeros(len(counts))
    stated = recording.source.get(NOISE_OF_ROWS)
    if stated is not None:
        return none, none + float(stated[sensor]) ** 2
    return variance_of_mean(filter_autocovariance(recording), counts) if len(counts) else none, none


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
    own: Values  # (m,), g^2 or (deg/s)^2; variance of a mean that was recorded as such, whose share is 0
    scatter: Values  # (m, 3); sums of squares about the means
    before: Values  # (m, 3); of the accelerometer, mean of the rest before, also of an unused one; NaN for none
    # each (m,), s; start, length and mean time
    start: Values
    length: Values
    time: Values
    # each (m,), degC and degC/s; NaN where none was recorded
    temperature: Values
    temperature_rate: Values
    recording: Index  # (m,); index of the recording that each belongs to
    held_out: Mask  # (m,)
    soaked: Mask  # (m,); whether each is a part of a soak
    span: Index  # (m, 2); its first sample, and the one after its last
    rounding: Values  # (m, 3), g or deg/s; standard uncertainty by steps of the readings that hide their noise
    # (m, 3), deg/s; rate across gravity at which the unit tilts, by the readings of the accelerometer; 0 where it
    # stands still
    creep: Values
    creep_error: Values  # (m,), deg/s; standard uncertainty of each of its two components
    creep_about: Values  # (m,), deg/s; standard deviation of the rate about gravity
    clock_shared: bool  # whether the time between the recordings is known
    kinds: frozenset[str] = frozenset()  # of the recordings, in the sheet
    swings: bool = False  # whether the temperature rises and falls in the recordings
    scatter_time: float = 0.0  # s; correlation time of their scatter beyond white noise, in slow movement
    repeats: bool = True  # whether soaks, if any, pass most temperatures twice in one direction

    def select(self, index: Mask | slice) -> Self:
        """Return some of the rests."""
        arrays: dict[str, Any] = {name: v[index] for name, v in vars(self).items() if isinstance(v, np.ndarray)}
        return replace(self, **arrays)

    def variance(self, white: Values) -> Values:
        """Return the variance of each mean by white noise, (3,), of a sample and by rounding: (m, 3) array.

        Readings in steps that hide their noise have a rounding error, however many a mean has.
        """
        return np.asarray(self.share[:, None] * white**2 + self.rounding**2 + self.own[:, None])

    @property
    def white(self) -> Values:
        """Standard deviation of a sample about the mean of its rest: (3,) array."""
        return np.asarray(np.sqrt(self.scatter.sum(axis=0) / max(float(np.sum(self.count - 1)), 1.0)))

    @property
    def freedom(self) -> float:
        """Degrees of freedom of the scatter within the rests."""
        return float(3 * np.sum(self.count - 1))


def is_multi_position(sensor: str, recordings: Sequence[Recording]) -> bool:
    """Return whether a sensor was recorded in rests and moves, without the motion of a table."""
    used = [r for r in recordings if r.reading(sensor) is not None and r.role != HELD_OUT]
    logged = any(r.table_angle is not None or r.table_attitude is not None for r in used)
    return any(r.role == ROLE for r in used) and not logged


def rests_of(
    sensor: str,
    recordings: Sequence[Recording],
    procedure: Procedure,
    accelerometer: SensorCalibration | None = None,
    role: str = ROLE,
) -> Rests | None:
    """Return the rests of the recordings of a role, or None where there are none.

    ``accelerometer``: rests that its method left out are left out here. ``role``: ``rests``, of which some may be held
    out; ``static``; or ``validation``, whose rests are all held out.
    """
    every = holdout_interval(recordings, procedure) if role == ROLE else 0
    left_out = [stage.details.rests_left_out or () for stage in (accelerometer.stages if accelerometer else ())]
    refused = {(rest.recording, rest.time_s) for rests in left_out for rest in rests}
    chosen: dict[int, list[Rest]] = {}
    held: set[tuple[int, int]] = set()
    for index, recording in enumerate(recordings):
        moving = sensor == "gyroscope" and recording.kind == "slow"  # it shows the length of gravity alone
        if recording.role == role and recording.reading(sensor) is not None and not moving:
            split = split_rests(recording, every)
            rests = sorted([*split.used, *split.held_out], key=lambda rest: rest.start)
            chosen[index] = [r for r in rests if (recording.name, float(recording.time[r.start])) not in refused]
            held |= {(index, rest.start) for rest in (rests if role == HELD_OUT else split.held_out)}
    if not chosen:
        return None
    found = gathered(sensor, recordings, chosen)
    keys = zip(found.recording.tolist(), found.span[:, 0].tolist(), strict=True)
    return replace(found, held_out=np.array([key in held for key in keys], bool)) if len(found.time) else None


def readings_in(sensor: str, recordings: Sequence[Recording], rests: Rests) -> Values:
    """Return the mean readings of a sensor in rests of the other one: (m, 3), NaN where it has none."""
    found = np.full((len(rests.time), 3), np.nan)
    for index in np.unique(rests.recording).tolist():
        of_recording = rests.recording == index
        means, _ = rest_means(recordings[index], [Rest(*ends) for ends in rests.span[of_recording].tolist()], sensor)
        if len(means):
            found[of_recording] = means
    return found


def gathered(sensor: str, recordings: Sequence[Recording], chosen: Mapping[int, Sequence[Rest]]) -> Rests:
    """Gather rests of some recordings, which ``chosen`` has by their index; none is held out."""
    parts = {index: _of_recording(recordings[index], sensor, tuple(rests)) for index, rests in chosen.items()}
    columns = {name: np.concatenate([part[name] for part in parts.values()]) for name in next(iter(parts.values()))}
    columns["recording"] = np.repeat([*parts], [len(part["time"]) for part in parts.values()])
    _, rounding = rounding_of_readings(recordings, sensor)
    columns["rounding"] = np.tile(rounding, (len(columns["time"]), 1))
    shared = len(np.unique(columns["recording"])) == 1 or all(recordings[index].clock_shared for index in chosen)
    used = [recordings[index] for index in chosen]
    swings = heats_and_cools(temperature_of(r) for r in used if r.temperature is not None and r.kind != ATTITUDES)
    kinds, repeats = frozenset(r.kind for r in used), passed_again(columns["temperature"][columns["soaked"]])
    return Rests(**columns, clock_shared=shared, kinds=kinds, swings=swings, repeats=repeats, scatter_time=0.0)


def passed_again(temperature: Values) -> bool:
    """Return whether a soak passes ``MOST`` temperatures twice in one direction; (k,) array, degC, in order of time.

    If not, heating differs from cooling by hysteresis as by a drift. True without a soak or a temperature.
    """
    if not len(temperature) or np.isnan(temperature).any():
        return True
    levels = np.linspace(temperature.min(), temperature.max(), PASSED + 2)[1:-1]
    steps = np.diff((temperature[:, None] > levels).astype(int), axis=0)
    again = np.maximum((steps > 0).sum(axis=0), (steps < 0).sum(axis=0)) > 1
    return bool(again.mean() > MOST)


@dataclass(frozen=True)
class Orientations:
    """The rows of a fit to the length of gravity, and the rests that are not in them."""

    recordings: Sequence[Recording]
    rests: Rests
    held_out: tuple[tuple[Recording, Rest], ...]
    left_out: tuple[tuple[Recording, Rest], ...]
    by_hand: bool  # whether no row is of a table

    @property
    def used(self) -> list[tuple[Recording, Rest]]:
        """The samples of each row."""
        spans = zip(self.rests.recording.tolist(), self.rests.span.tolist(), strict=True)
        return [(self.recordings[i], Rest(start, stop)) for i, (start, stop) in spans]

    @property
    def white(self) -> Values:
        """Standard deviation of a raw sample about the mean of its row: (3,) array, g; 0 where no row has two."""
        gains = [float(self.recordings[i].filter["noise_gain"]) for i in self.rests.recording[:1]]
        return self.rests.white / (gains[0] if gains else 1.0)


def orientations_of(recordings: Sequence[Recording], settings: Settings) -> Orientations:
    """Return the rows of all recordings of role ``rests`` and ``accelerometer``.

    Raises ``CannotCalibrateError`` if no such recording holds readings of the accelerometer.
    """
    every = holdout_interval(recordings, settings.procedure)
    used: dict[int, Sequence[Rest]] = {}
    held_out: list[tuple[Recording, Rest]] = []
    left_out: list[tuple[Recording, Rest]] = []
    by_hand = True
    for i, recording in enumerate(recordings):
        if recording.role not in {ROLE, "accelerometer"} or recording.accelerometer is None:
            continue
        on_table = _rests_on_table(recording, settings.table)
        if on_table is None:
            split, soaked = split_rests(recording, every if recording.role == ROLE else 0), recording.kind == SOAK
            used[i] = [split.used[nearest_to_reference(_warmth(recording, split.used)[0])]] if soaked else split.used
            held_out += [(recording, rest) for rest in split.held_out]
            left_out += [(recording, rest) for rest in split.left_out]
        else:
            by_hand, used[i] = False, on_table
    if not used:
        raise CannotCalibrateError(
            "nonlinear least squares needs the accelerometer at rest in many orientations, and no recording of role "
            "rests or accelerometer holds its readings: record some 24 rests, each in another orientation"
        )
    rests = gathered("accelerometer", recordings, used)
    return Orientations(recordings, rests, tuple(held_out), tuple(left_out), by_hand)


def _rests_on_table(recording: Recording, table: Table) -> list[Rest] | None:
    """Return the dwells of a recording on a table, single samples of a continuous one, or None without a table."""
    motion = table_motion(recording, table) if recording.role == "accelerometer" else None
    if motion is None:
        return None
    if stop_and_go(motion):
        return rests_from_table(recording)
    return [Rest(i, i + 1) for i in np.flatnonzero(sound_samples(recording, "accelerometer")).tolist()]


def _before(recording: Recording, sensor: str, span: Index) -> Values:
    """Return the mean reading of the rest before each rest, (m, 3) from its (m, 2) ends; NaN where there is none."""
    found = np.full((len(span), 3), np.nan)
    if sensor != "accelerometer" or recording.role not in {ROLE, HELD_OUT} or recording.kind in {ATTITUDES, SOAK}:
        return found  # hysteresis is the accelerometer's
    split = split_rests(recording, 0)
    every = sorted([*split.used, *split.left_out], key=lambda rest: rest.start)
    means, counts = rest_means(recording, every, sensor)
    earlier = np.searchsorted([rest.start for rest in every], span[:, 0]) - 1
    known = (earlier >= 0) & (counts[earlier] > 0) if every else np.zeros(len(span), bool)
    found[known] = means[earlier[known]]
    return found


@once
def _of_recording(recording: Recording, sensor: str, rests: tuple[Rest, ...]) -> dict[str, Any]:
    """Return the columns of ``Rests``, but for ``recording``, without rests that have no valid sample."""
    means, counts = rest_means(recording, rests, sensor)
    kept = counts > 0
    span = np.array([[rest.start, rest.stop] for rest in rests], np.intp).reshape(-1, 2)[kept]
    means, counts, time = means[kept], counts[kept], recording.time
    reading, good = np.asarray(recording.reading(sensor)), sound_samples(recording, sensor)
    inside = [slice(a, b) for a, b in span]
    scatter = [np.sum((reading[s][good[s]] - mean) ** 2, axis=0) for s, mean in zip(inside, means, strict=True)]
    by_hand = recording.accelerometer is not None and recording.table_angle is None and recording.kind != SOAK
    creeps = [creep_of_rest(recording, a, b) for a, b in span.tolist()] if by_hand else []
    none = np.zeros((len(span), 3)), np.zeros(len(span)), 0.0
    rate, error, about = posterior_creep_rates(creeps) if creeps else none
    if sensor == "accelerometer" and by_hand:  # without the tilt of a unit that creeps
        scatter = [c.squares * max(n - 1, 1) / max(c.freedom, 1) for c, n in zip(creeps, counts, strict=True)]
    start = time[span[:, 0]]
    temperature, warming = _warmth(recording, [Rest(a, b) for a, b in span.tolist()])
    share, own = variances_of_means(recording, counts, sensor)
    return {
        "reading": means,
        "count": counts,
        "share": share,
        "own": own,
        "scatter": np.array(scatter).reshape(-1, 3),
        "before": _before(recording, sensor, span),
        "start": start,
        "length": time[span[:, 1] - 1] - start + recording.interval,
        "time": np.array([time[s].mean() for s in inside]),
        "temperature": temperature,
        "temperature_rate": warming,
        "held_out": np.zeros(len(span), bool),
        "soaked": np.full(len(span), recording.kind == SOAK),
        "span": span,
        "creep": rate,
        "creep_error": error,
        "creep_about": np.full(len(span), about),
    }
