"""Select the samples of every recording of a unit for a fit against a table's motion.

Of the samples whose readings and log are valid, a fit uses

* those of settled rests, as means over at most 1 s. The motion does not change in a rest, so that only white noise is
  averaged; its sum of squares is stored.
* those at which the log describes the motion, as means over at most 0.5 deg, 1 s and 1/30 of the fastest rate: the rows
  follow duration and motion, and not the sampling rate. In a recording that would have more than 2,000 rows they are
  means over at most 1.5 deg and 1/15 of the fastest rate, which keep 99 % of the information on each effect. The change
  of the motion within a row is subtracted before the sum of squares. Where the log is too coarse for a ramp or a step,
  its angular acceleration is wrong, which would bias a lever arm or a delay.

If the readings were filtered, the motion is filtered, too. If the log has no rate, samples of a gyroscope are not used
while the output of the filter depends on unknown rates.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import Any, TypeVar
from weakref import ReferenceType, ref

import numpy as np

from pipeline.core.records import Mask, Motion, Noise, Quantities, Recording, Same, Values, once_of_log
from pipeline.core.settings import Table
from pipeline.estimation.gauss_markov import Blocks, constant_bias_s, information
from pipeline.estimation.table_errors import errors_of_stops
from pipeline.estimation.turns import RowGroups, reference_valid, rows_of
from pipeline.physics.effects import stated_priors
from pipeline.physics.effects.base import truth, turning_direction
from pipeline.physics.kinematics import earth_of, table_motion
from pipeline.physics.signal.encoder_rate import rate_by_angle
from pipeline.physics.signal.filters import filtered, impulse_response

Result = TypeVar("Result")

ROLES = ("accelerometer", "gyroscope", "static")
BIAS_BLOCKS = 300  # of the bias: their length is below a tenth of the shortest correlation time of the grid
SHORTEST_BLOCK_S = 4.0  # a fraction of the shortest correlation time of the grid
MAX_BIAS_BLOCKS = 600  # if the bias changes within longer ones: as many as give the right answers in the blind study
# error by unknown rates in the filter's output: share of the largest rate; deg/s
FORGOTTEN_RATE_SHARE, FORGOTTEN_DPS = 1e-5, 1e-4
LONGEST_RESPONSE = 400  # samples of a filter's impulse response on each side
# Variance of the angle's errors at a stop over that of noise, below which they count as noise: gains in 2 log L by
# chance are then a tenth larger, and the gates of ``selection`` require 10 and more.
HIDDEN_ANGLE = 0.1
UNUSED_ROW_WEIGHT = 1e-9  # factor on the weight of rows that are not used: not 0, so that no block is empty


@dataclass(frozen=True, eq=False)
class RecordingRows:
    """The rows of one recording."""

    name: str
    motion: Motion
    reading: Values  # (m, 3), g or deg/s
    weight: Values  # (m,); effective number of independent samples of each row
    scatter: Values  # (3,); sum of squares about the means, weighted
    clock_shared: bool
    interval: float  # s; between the recording's samples
    rounding: Values | None = None  # (m,); variance of the rate by a coarse encoder, (deg/s)^2; None: a fine one
    # motion by names and values of effects of timing
    moved: dict[tuple[tuple[str, bytes], ...], Motion] = field(default_factory=dict, repr=False)


@dataclass(frozen=True, eq=False)
class Observations:
    """The data of one sensor for a fit."""

    sensor: str
    parts: tuple[RecordingRows, ...]  # in the order of time if the clock is shared
    earth: bool  # whether Earth's rotation is in the motion
    bench: Mapping[str, float] = field(default_factory=dict)  # standard deviations by effect (``bench_priors``)
    mounting_in_doubt: bool = False  # whether one mounting does not explain all turns (note ``N-SEATS``)
    angle_deg: float = 0.0  # standard uncertainty of the angle at each stop; 0 if noise hides it
    levelling_deg: float = 0.0  # standard uncertainty of the table's level; 0: not stated
    white: float = 0.0  # standard deviation of a sample's white noise, mean of the axes; 0: not known
    steady: float = float("inf")  # s; time over which the bias is constant against white noise
    kept: ReferenceType[Quantities] | None = field(default=None, repr=False)  # results, with the first recording
    reduced: bool = False  # whether the weights are those of ``weighted``

    def once(self, key: Hashable, compute: Callable[[], Result]) -> Result:
        """Return a result that steps and methods of a unit share; ``key``: all that it depends on beside these data.

        It is kept with the recordings.
        """
        kept = None if self.kept is None else self.kept()
        return compute() if kept is None else kept.once((self, key), compute)

    def forget(self) -> None:
        """Release the results that were computed ``once`` from observations of this sensor."""
        kept = Quantities() if self.kept is None else self.kept() or Quantities()
        for key in [key for key in kept if getattr(key[0], "sensor", None) == self.sensor]:
            del kept[key]

    @cached_property
    def reading(self) -> Values:
        """All readings: (n, 3) array."""
        return np.concatenate([part.reading for part in self.parts])

    @cached_property
    def weight(self) -> Values:
        """All weights: (n,) array."""
        return np.concatenate([part.weight for part in self.parts])

    @property
    def less_stop_errors(self) -> Observations:
        """The observations with smaller weights at the stops, for sums in which errors of the angle count as noise."""
        return self._less_stop_errors if self.angle_deg > 0.0 else self

    @cached_property
    def _less_stop_errors(self) -> Observations:
        parts = []
        for part in self.parts:
            weight, rests = part.weight / (1.0 + _lost_at_stops(part, self)), part.motion.still
            share = float(weight[rests].sum() / part.weight[rests].sum()) if rests.any() else 1.0
            parts.append(replace(part, weight=weight, scatter=share * part.scatter))
        return replace(self, parts=tuple(parts), angle_deg=0.0)

    @cached_property
    def scatter(self) -> Values:
        """Sum of squares within the rows: (3,) array."""
        return np.asarray(np.sum([np.zeros(3), *(part.scatter for part in self.parts)], axis=0))

    @cached_property
    def samples(self) -> float:
        """Effective number of independent samples."""
        return float(sum(part.weight.sum() for part in self.parts))

    @cached_property
    def expected_square(self) -> float:
        """Mean square of the residual over that of white noise s: 1 plus the noise of a coarse encoder's rate."""
        if self.white <= 0.0:
            return 1.0
        added = [float(part.weight @ part.rounding) for part in self.parts if part.rounding is not None]
        return 1.0 + sum(added) / (3.0 * self.white**2 * self.samples)

    def noise_square(self, noise: Noise, gain: float = 1.0) -> float:
        """Return the mean square of the residual that noise alone leaves; ``gain``: of a filter, for white noise."""
        white = self.less_stop_errors.expected_square * (gain * noise.white) ** 2
        return float(np.mean(white + noise.wander**2))

    @cached_property
    def blocks(self) -> Blocks:
        """Short stretches of time in which the bias is assumed constant."""
        return self.in_blocks(self.steady)

    def in_blocks(self, longest: float) -> Blocks:
        """Return stretches in which the bias is assumed constant, of at most ``longest``, s, unless too many."""
        span = sum(float(np.ptp(part.motion.time)) for part in self.parts)
        length = min(longest, max(SHORTEST_BLOCK_S, span / BIAS_BLOCKS))
        apart = [not _follows(before, part) for before, part in pairwise(self.parts)]
        rows = [(part.motion.time, part.weight) for part in self.parts]
        return Blocks.of_rows(rows, np.cumsum([0, *apart]).tolist(), max(length, span / MAX_BIAS_BLOCKS))

    @property
    def clock_shared(self) -> bool:
        """Whether the time between the recordings is known."""
        return all(part.clock_shared for part in self.parts) or len(self.parts) == 1


def _follows(before: RecordingRows, part: RecordingRows) -> bool:
    """Return whether the time between two recordings is known: one clock for all, or one session in order."""
    in_session = before.motion.setup == part.motion.setup != "" and before.motion.time[-1] < part.motion.time[0]
    return (before.clock_shared and part.clock_shared) or bool(in_session)


def without_rows(observations: Observations, left_out: Sequence[Mask]) -> Observations:
    """Return observations with zero weight for rows, one mask for each recording."""
    parts = []
    for part, out in zip(observations.parts, left_out, strict=True):
        weight = np.where(out, UNUSED_ROW_WEIGHT, 1.0) * part.weight
        share = float(weight.sum() / part.weight.sum())
        parts.append(replace(part, weight=weight, scatter=share * part.scatter))
    return replace(observations, parts=tuple(parts))


def without_each_recording(observations: Observations) -> Iterator[Observations]:
    """Yield observations with zero weight for each recording in turn; none if there is only one recording."""
    lengths = [len(part.weight) for part in observations.parts]
    for out in range(len(lengths) if len(lengths) > 1 else 0):
        yield without_rows(observations, [np.full(n, k == out) for k, n in enumerate(lengths)])


def weighted(observations: Observations, noise: Noise | None) -> Observations:
    """Return observations with weights reduced for correlated noise and for a coarse encoder.

    Errors of the angle are not modelled if they are small against the noise. Reduced weights stay as they are.
    """
    if observations.reduced:
        return observations
    key = noise and (noise.source, noise.correlation_time, noise.length, noise.white.tobytes(), noise.wander.tobytes())
    return observations.once((weighted, key), lambda: _weighted(observations, noise))


def _weighted(observations: Observations, noise: Noise | None) -> Observations:
    parts, white = [], 0.0 if noise is None else float(np.mean(noise.white))
    for part in observations.parts:
        share = information(noise, part.interval)
        weight = share * part.weight
        if part.rounding is not None and white > 0.0:  # the scatter is of rests: their rate has no such noise
            weight = weight / (1.0 + part.rounding / white**2)
        parts.append(replace(part, weight=weight, scatter=share * part.scatter))
    steady = min((constant_bias_s(noise, part.interval) for part in parts), default=float("inf"))
    reduced = replace(observations, parts=tuple(parts), white=white, steady=steady, reduced=True)
    lost = [_lost_at_stops(part, reduced).max(initial=0.0) for part in parts]
    return reduced if max(lost, default=0.0) > HIDDEN_ANGLE else replace(reduced, angle_deg=0.0)


def _lost_at_stops(part: RecordingRows, observations: Observations) -> Values:
    """Return the variance of the angle's error over that of the noise, ``W d^2 / s^2``, of each row's stop: (m,) array.

    Rows at one stop, or in the turn from it to the next, have a common error of the size d. With the total weight W,
    they contain the information of ``W / (1 + W d^2 / s^2)`` samples of white noise s.
    """
    angle, white = observations.angle_deg, observations.white
    if angle == 0.0 or white <= 0.0:
        return np.zeros(len(part.weight))
    before, after, stop, stops = errors_of_stops(observations.sensor, [part.motion], np.eye(3))
    group = 2 * stop + np.any(after != 0.0, axis=1)
    squares = (angle / white) ** 2 * np.sum(before**2 + after**2, axis=1)
    return np.asarray(np.bincount(group, part.weight * squares, 2 * stops)[group], np.float64)


def observe(sensor: str, recordings: Sequence[Recording], table: Table) -> Observations:
    """Return the data of one sensor for a fit: every recording with its readings and a table's motion.

    ``recordings``: held-out ones are not used.
    """
    used = [r for r in recordings if r.role in ROLES and r.samples >= 6]
    logged = [(r, table_motion(r, table)) for r in used if r.reading(sensor) is not None]
    parts = [part for r, motion in logged if motion is not None and (part := _rows(r, sensor, motion)) is not None]

    def in_time(part: RecordingRows) -> tuple[bool, str, float]:
        """Order recordings in time, within the unit or else within their setup."""
        setup = "" if part.clock_shared else part.motion.setup
        return not part.clock_shared, setup, float(part.motion.time[0]) if part.clock_shared or setup else 0.0

    doubt = any(note.code == "N-SEATS" for recording in recordings for note in recording.notes)
    found = Observations(
        sensor,
        tuple(sorted(parts, key=in_time)),
        earth=earth_of(table) is not None,
        bench=stated_priors(table),
        mounting_in_doubt=doubt,
        angle_deg=table.angle_accuracy_deg if table.motion == "logged" else 0.0,
        levelling_deg=table.levelling_deg or 0.0,
        kept=ref(recordings[0].of_log) if recordings else None,
    )
    return recordings[0].of_log.once((found.parts, table, doubt), lambda: found) if parts else found


def _rows(recording: Recording, sensor: str, motion: Motion) -> RecordingRows | None:
    """Return the rows of one sensor, computed once where the readings of the other are corrected."""
    arrays = Same(recording.reading(sensor)), Same(recording.flags), Same(recording.filter)
    return _part(recording, sensor, motion, *arrays)


@once_of_log
def _part(recording: Recording, sensor: str, motion: Motion, *_: Same) -> RecordingRows | None:
    reading = recording.reading(sensor)
    assert reading is not None  # noqa: S101
    filtered = recording.filter["name"] != "none"
    if filtered:
        sure = _filter_settled(motion, recording) if sensor == "gyroscope" else reference_valid(motion)
        motion = replace(filtered_motion(_with_direction(motion), recording), reference_valid=sure)
    x, y, z = np.isfinite(reading).T
    valid = x & y & z & recording.valid
    rows = rows_of(motion, valid, together=False) if filtered else _rows_at(recording, motion, valid.tobytes())
    at_rest = _as_at_rest(sensor, motion, reading, rows)
    rows = rows.settled(at_rest)
    if len(rows.first) == 0:
        return None
    independent = min(float(recording.filter.get("noise_gain", 1.0)) ** 2, 1.0)  # share of a filter's output
    means = rows.means(reading)
    resting = means if at_rest is reading else rows.means(at_rest)
    squares = (at_rest[rows.kept] - np.repeat(resting, rows.count.astype(int), axis=0)) ** 2
    by_angle = rate_by_angle(recording) if sensor == "gyroscope" and recording.axis is not None else None
    return RecordingRows(
        recording.name,
        rows.motion(motion) if filtered else _motion_at(recording, motion, rows),
        means,
        weight=rows.count * independent,
        scatter=np.sum(squares, axis=0) * independent,
        clock_shared=recording.clock_shared,
        interval=recording.interval,
        rounding=None if by_angle is None or not by_angle.noise.any() else rows.means(by_angle.noise**2),
    )


@once_of_log
def _rows_at(recording: Recording, motion: Motion, valid: bytes) -> RowGroups:  # noqa: ARG001  (which keeps the result)
    """Return ``rows_of``, which are mostly the same for both sensors of a recording."""
    return rows_of(motion, np.frombuffer(valid, bool))


def _as_at_rest(sensor: str, motion: Motion, reading: Values, rows: RowGroups) -> Values:
    """Return readings without their change by the motion within rows in motion, by a first fit."""
    if np.all(rows.count[~motion.still[rows.kept[rows.first]]] == 1.0):
        return reading
    moving = np.flatnonzero(~motion.still)
    u = np.column_stack([np.ones(len(moving)), truth(sensor, motion)[moving]])
    used = np.isin(moving, rows.kept, assume_unique=True)
    out = reading.copy()
    out[moving] -= u @ np.linalg.lstsq(u[used], reading[moving[used]], rcond=None)[0]
    return out


@once_of_log
def _motion_at(recording: Recording, motion: Motion, rows: RowGroups) -> Motion:  # noqa: ARG001  (which keeps the result)
    """Return the motion at the rows, which is mostly the same for both sensors of a recording."""
    return rows.motion(_with_direction(motion))


def _with_direction(motion: Motion) -> Motion:
    return motion.changed(direction=partial(turning_direction, motion))


def filtered_motion(motion: Motion, recording: Recording) -> Motion:
    """Return the motion after the filter that the readings went through.

    The filter is linear, so that the model of the filtered truth gives the filtered readings; for effects that are not
    linear in the truth this holds only while the filter's output does not change.
    """
    names = ("specific_force", "angular_rate", "specific_force_rate", "angular_acceleration")
    signals: dict[str, Any] = {name: filtered(getattr(motion, name), recording) for name in names}

    def at(trajectory: Callable[..., Motion | None], **to: Any) -> Motion:  # noqa: ANN401  (an offset or a lag)
        moved = trajectory(**to)
        assert moved is not None  # noqa: S101
        return filtered_motion(moved, recording)

    offset, lag = motion.at_offset and partial(at, motion.at_offset), motion.at_lag and partial(at, motion.at_lag)
    return replace(motion, **signals, at_offset=offset, at_lag=lag)


def _filter_settled(motion: Motion, recording: Recording) -> Mask:
    """Return at which samples the filtered rate is known from the log: (n,) array of bool.

    If no rate is logged, the rate of a sample at which the log does not describe the motion is wrong by up to half of
    the rate's bend there, and the filter propagates this error to later samples. A sample is not used if the bends,
    convolved with the filter's absolute impulse response, exceed 1e-5 of the largest rate.
    """
    sure = reference_valid(motion)
    if (recording.table_rate is not None and motion.axis is not None) or sure.all():
        return sure
    rate = motion.angular_rate
    bend = np.zeros(len(rate))
    bend[1:-1] = np.linalg.norm(rate[2:] - 2.0 * rate[1:-1] + rate[:-2], axis=1)
    wide = np.max([bend, np.append(bend[1:], 0.0), np.append(0.0, bend[:-1])], axis=0)
    response = np.abs(impulse_response(recording, 2 * min(recording.samples, LONGEST_RESPONSE) + 1))
    error = np.convolve(np.where(sure, 0.0, 0.5 * wide), response)[len(response) // 2 :][: len(rate)]
    return np.logical_and(sure, error <= max(FORGOTTEN_RATE_SHARE * float(np.abs(rate).max()), FORGOTTEN_DPS))
