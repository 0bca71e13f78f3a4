"""Select the samples of every recording of a unit for a fit against a table's motion.

If readings and log are valid, these are used:

* settled rests, as means over at most 1 s. The motion does not change in a rest, so that only white noise is averaged;
  its sum of squares is stored.
* samples at which the log describes the motion. Where the log is too coarse for a ramp or a step, its angular
  acceleration is wrong, which would bias a lever arm or a delay; such samples are not used.

If the readings were filtered, the motion is filtered, too. If the log has no rate, samples of a gyroscope are not used
while the output of the filter depends on unknown rates.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.estimation.gauss_markov import Blocks, information, steady_s
from pipeline.estimation.table_errors import errors_of_stops
from pipeline.estimation.turns import Rows, reference_valid, rows_of
from pipeline.model.effects import stated_priors
from pipeline.model.effects.base import turning_direction
from pipeline.model.kinematics import earth_of, table_motion
from pipeline.signal.encoder_rate import rate_by_angle
from pipeline.signal.filters import filtered, impulse_response

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from pipeline.records import Mask, Motion, Noise, Recording, Values


ROLES = ("accelerometer", "gyroscope", "static")
BLOCKS = 300  # of the bias: their length is below a tenth of the shortest correlation time of the grid
SHORTEST_BLOCK_S = 4.0  # a fraction of the shortest correlation time of the grid
MOST_BLOCKS = 600  # where the bias changes within longer ones: as many as give the right answers (docs/blind_study.md)
FORGOTTEN, FORGOTTEN_DPS = 1e-5, 1e-4  # share of the largest rate that a filter may still hold of a doubtful one
LONGEST_RESPONSE = 400  # samples
# Variance of the angle's errors at a stop over that of noise, below which they stay noise: a gain in 2 log L by chance
# is then a tenth larger, of 10 and more that the gates of ``selection`` ask for.
HIDDEN_ANGLE = 0.1
LEFT_OUT = 1e-9  # weight of rows that are left out: their information vanishes, and no block is empty


@dataclass(frozen=True)
class Part:
    """The rows of one recording."""

    name: str
    motion: Motion
    reading: Values  # (m, 3), g or deg/s
    # (m,); samples of each row, minus what a filter's correlation takes from their information
    weight: Values
    scatter: Values  # (3,); sum of squares about the means, weighted
    clock_shared: bool
    interval: float  # s; between the recording's samples
    rounding: Values | None = None  # (m,); variance of the rate by a coarse encoder, (deg/s)^2; None of a fine one
    moved: dict[tuple[tuple[str, bytes], ...], Motion] = field(default_factory=dict, compare=False, repr=False)


@dataclass(frozen=True)
class Observations:
    """The data of one sensor for a fit."""

    sensor: str
    parts: tuple[Part, ...]  # in the order of time where the clock is shared
    earth: bool  # whether Earth's rotation is in the motion
    # standard deviations of what the bench adds, by effect (``bench_priors``)
    bench: Mapping[str, float] = field(default_factory=dict)
    mounting_in_doubt: bool = False  # whether one mounting does not explain all turns (note ``N-SEATS``)
    angle_deg: float = 0.0  # standard uncertainty of the angle at each stop; 0 where noise hides it
    levelling_deg: float = 0.0  # standard uncertainty of the table's level; 0: not stated
    white: float = 0.0  # standard deviation of a sample's white noise, mean of the axes; 0: not known
    steady: float = float("inf")  # s; how long the bias may be taken as constant by its noise

    @cached_property
    def reading(self) -> Values:
        """All readings: (n, 3) array."""
        return np.concatenate([part.reading for part in self.parts])

    @cached_property
    def weight(self) -> Values:
        """All weights: (n,) array."""
        return np.concatenate([part.weight for part in self.parts])

    @cached_property
    def weakened(self) -> Observations:
        """The same, with weights that allow for the errors of the angle, for sums in which these are noise."""
        parts = []
        for part in self.parts if self.angle_deg > 0.0 else ():
            weight, rests = part.weight / (1.0 + _lost_at_stops(part, self)), part.motion.still
            share = float(weight[rests].sum() / part.weight[rests].sum()) if rests.any() else 1.0
            parts.append(replace(part, weight=weight, scatter=share * part.scatter))
        return replace(self, parts=tuple(parts) or self.parts, angle_deg=0.0)

    @cached_property
    def scatter(self) -> Values:
        """Sum of squares within the rows: (3,) array."""
        total = np.zeros(3)
        for part in self.parts:
            total += part.scatter
        return total

    @cached_property
    def samples(self) -> float:
        """Number of samples, as far as they are independent."""
        return float(sum(part.weight.sum() for part in self.parts))

    @cached_property
    def expected_square(self) -> float:
        """Mean square of the residual over that of white noise s: 1, and what a coarse encoder adds about one axis."""
        if self.white <= 0.0:
            return 1.0
        added = [float(part.weight @ part.rounding) for part in self.parts if part.rounding is not None]
        return 1.0 + sum(added) / (3.0 * self.white**2 * self.samples)

    @cached_property
    def blocks(self) -> Blocks:
        """Short stretches of time in which the bias is taken as constant."""
        return self._blocks(max(self._span / MOST_BLOCKS, min(self.steady, self._length)))

    @cached_property
    def long_blocks(self) -> Blocks:
        """Longer stretches, so few that all three axes can have one dense covariance."""
        return self._blocks(self._length)

    @property
    def _span(self) -> float:
        return sum(float(np.ptp(part.motion.time)) for part in self.parts)

    @property
    def _length(self) -> float:
        return max(SHORTEST_BLOCK_S, self._span / BLOCKS)

    def _blocks(self, length: float) -> Blocks:
        apart = [not _follows(before, part) for before, part in zip([None, *self.parts], self.parts, strict=False)]
        rows = [(part.motion.time, part.weight) for part in self.parts]
        return Blocks.of_rows(rows, np.cumsum(apart).tolist(), length)

    @property
    def clock_shared(self) -> bool:
        """Whether the time between the recordings is known."""
        return all(part.clock_shared for part in self.parts) or len(self.parts) == 1


def _follows(before: Part | None, part: Part) -> bool:
    """Return whether the time from the recording before is known: one clock for all, or one session in order."""
    if before is None:
        return False
    if before.clock_shared and part.clock_shared:
        return True
    return before.motion.setup == part.motion.setup != "" and bool(before.motion.time[-1] < part.motion.time[0])


def without_rows(observations: Observations, left_out: Sequence[Mask]) -> Observations:
    """Return observations with zero weight for rows, one mask for each recording."""
    parts = []
    for part, out in zip(observations.parts, left_out, strict=True):
        weight = np.where(out, LEFT_OUT, 1.0) * part.weight
        share = float(weight.sum() / part.weight.sum())
        parts.append(replace(part, weight=weight, scatter=share * part.scatter))
    return replace(observations, parts=tuple(parts))


def without_each_recording(observations: Observations) -> Iterator[Observations]:
    """Yield observations with zero weight for each recording in turn; none if there is only one recording."""
    lengths = [len(part.weight) for part in observations.parts]
    for out in range(len(lengths) if len(lengths) > 1 else 0):
        yield without_rows(observations, [np.full(n, k == out) for k, n in enumerate(lengths)])


def weighted(observations: Observations, noise: Noise | None) -> Observations:
    """Return observations with weights reduced for correlated noise.

    Errors of the angle are not considered if they are small against the noise.
    """
    parts, white = [], 0.0 if noise is None else float(np.mean(noise.white))
    for part in observations.parts:
        share = information(noise, part.interval)
        fewer = part if share == 1.0 else replace(part, weight=share * part.weight, scatter=share * part.scatter)
        if part.rounding is not None and white > 0.0:  # the noise r of the rate: 1 / (1 + r^2 / s^2) as much
            fewer = replace(fewer, weight=fewer.weight / (1.0 + part.rounding / white**2))  # the scatter is of rests
        parts.append(fewer)
    steady = min((steady_s(noise, part.interval) for part in parts), default=float("inf"))
    found = replace(observations, parts=tuple(parts), white=white, steady=steady)
    lost = [_lost_at_stops(part, found).max(initial=0.0) for part in parts]
    return found if max(lost, default=0.0) > HIDDEN_ANGLE else replace(found, angle_deg=0.0)


def _lost_at_stops(part: Part, observations: Observations) -> Values:
    """Return by how much errors of the angle exceed the noise of the stop of each row, as variances: (m,) array.

    Rows at one stop, or in the turn from it to the next, share an error of the size d. Together they contain the
    information of ``W / (1 + W d^2 / s^2)`` samples of white noise s. W is their weight.
    """
    angle, white = observations.angle_deg, observations.white
    if angle == 0.0 or white <= 0.0:
        return np.zeros(len(part.weight))
    before, after, stop, stops = errors_of_stops(observations.sensor, [part.motion], np.eye(3))
    group = 2 * stop + np.any(after != 0.0, axis=1)
    squares = (angle / white) ** 2 * np.sum(before**2 + after**2, axis=1)
    return np.asarray(np.bincount(group, part.weight * squares, 2 * stops)[group], np.float64)


def observe(sensor: str, recordings: Sequence[Recording], table: Mapping[str, Any]) -> Observations:
    """Return the data of one sensor for a fit: every recording with its readings and a table's motion.

    ``recordings``: held-out ones are not used. ``table``: ``gravity_g``, ``latitude_deg``, ``azimuth_deg``, and the
    settings of ``bench_priors``.
    """
    parts = []
    for recording in recordings:
        if recording.role in ROLES and recording.samples >= 6:
            part = _part(sensor, recording, table)
            if part is not None:
                parts.append(part)
    parts.sort(key=_in_time)
    doubt = any(note.code == "N-SEATS" for recording in recordings for note in recording.notes)
    bench = stated_priors(table)
    angle = float(table.get("angle_accuracy_deg") or 0.0) if table.get("motion") == "logged" else 0.0
    level = float(table.get("levelling_deg") or 0.0)
    return Observations(sensor, tuple(parts), earth_of(table) is not None, bench, doubt, angle, level)


def _in_time(part: Part) -> tuple[bool, str, float]:
    """Return a key that orders recordings in time, within the unit or else within their setup."""
    setup = "" if part.clock_shared else part.motion.setup
    return not part.clock_shared, setup, float(part.motion.time[0]) if part.clock_shared or setup else 0.0


def _part(sensor: str, recording: Recording, table: Mapping[str, Any]) -> Part | None:
    reading = recording.reading(sensor)
    if reading is None:
        return None
    motion = table_motion(recording, table)
    if motion is None:
        return None
    motion = replace(motion, direction=turning_direction(motion))
    filtered = recording.filter["name"] != "none"
    if filtered:
        sure = _filter_settled(motion, recording) if sensor == "gyroscope" else reference_valid(motion)
        motion = replace(filtered_motion(motion, recording), reference_valid=sure)
    valid = np.logical_and(np.all(np.isfinite(reading), axis=1), recording.valid)
    rows = rows_of(motion, valid, together=not filtered).settled(reading)
    if len(rows.first) == 0:
        return None
    seen = rows.motion(motion) if filtered else _shared(recording, motion, rows)
    information = min(float(recording.filter.get("noise_gain", 1.0)) ** 2, 1.0)
    means = rows.means(reading)
    kept = reading[rows.kept]
    squares = (kept - np.repeat(means, rows.count.astype(int), axis=0)) ** 2
    by_angle = rate_by_angle(recording) if sensor == "gyroscope" and recording.axis is not None else None
    rounding = None if by_angle is None or not by_angle.noise.any() else rows.means(by_angle.noise**2)
    within = np.sum(squares, axis=0)
    return Part(
        recording.name,
        seen,
        means,
        rows.count * information,
        within * information,
        recording.clock_shared,
        recording.interval,
        rounding=rounding,
    )


def _shared(recording: Recording, motion: Motion, rows: Rows) -> Motion:
    """Return the motion at the rows; both sensors of a recording mostly have the same."""
    key = "rows", id(motion.specific_force), rows.kept.tobytes(), rows.first.tobytes()  # it is kept as well
    if key not in recording.cache:
        recording.cache[key] = rows.motion(motion)
    found: Motion = recording.cache[key]
    return found


def filtered_motion(motion: Motion, recording: Recording) -> Motion:
    """Return the motion after the filter that the readings went through.

    The filter is linear, so that filtered readings are the model of filtered truth; in effects that are not linear in
    the truth the order matters, but only while the filter's output changes.
    """
    signals = ("specific_force", "angular_rate", "specific_force_rate", "angular_acceleration")
    found: dict[str, Any] = {name: filtered(getattr(motion, name), recording) for name in signals}

    def at(trajectory: Callable[..., Motion | None], **to: Any) -> Motion:  # noqa: ANN401  (an offset or a lag)
        there = trajectory(**to)
        assert there is not None  # noqa: S101
        return filtered_motion(there, recording)

    return replace(
        motion,
        **found,
        at_offset=None if motion.at_offset is None else partial(at, motion.at_offset),
        at_lag=None if motion.at_lag is None else partial(at, motion.at_lag),
    )


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
    answer = np.abs(impulse_response(recording, 2 * min(recording.samples, LONGEST_RESPONSE) + 1))
    left = np.convolve(np.where(sure, 0.0, 0.5 * wide), answer)[len(answer) // 2 :][: len(rate)]
    forgotten = left <= max(FORGOTTEN * float(np.abs(rate).max()), FORGOTTEN_DPS)
    return np.logical_and(sure, forgotten)
