"""Select the samples of a table's turns for a fit, assess their noise, and average them at rest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from typing import Any

import numpy as np

from pipeline.core.errors import CannotCalibrateError
from pipeline.core.records import Index, Mask, Motion, Recording, Values, median
from pipeline.core.settings import Table
from pipeline.estimation.engine import ResidualNoise, ScaledColumns
from pipeline.estimation.gauss_markov import Blocks, WanderPrior
from pipeline.estimation.table_errors import Reference, noise_on_table
from pipeline.physics.effects.base import length
from pipeline.physics.kinematics import table_motion
from pipeline.physics.signal.encoder_rate import Pieces
from pipeline.physics.signal.rests import RATE_AT_REST_DPS, runs

FIT_BLOCKS = 100  # of a fit's samples: enough to resolve correlation times down to a hundredth of the recordings
DISTINCT_DIRECTION_G = 0.01  # attitudes 0.6 deg apart differ
SLOWEST_SHARE = 0.02  # of the largest rate, below which the table is not taken as turning
CHANGE_PER_SECOND = 0.25  # of the rate, above which a turn is not steady
TURN_EDGE_S = 0.15  # excluded at either end of a steady turn, where the table still accelerates
LONGEST_TAIL = 0.4  # of a steady turn
DELAYS_TO_FOLLOW = 5.0  # after which an RC filter holds less than 1 % of a change of rate
MEAN_S = 1.0  # a mean hides no motion at rest, and keeps the readings' change with temperature
# Of a row in motion: the mean over it of a signal of 12 cycles a turn is 1 - (6 deg)^2 / 24 = 0.9995 of that in its
# middle, so that it keeps 99.9 % of the information; a polynomial of the fifth order in the specific force, 0.9999.
ROW_DEG = 0.5
# Rows of a recording that would have more than so many: 12 cycles a turn keep 99.2 % of the information. The change of
# the rate is twice as large: a polynomial of the third order in the rate keeps 99.3 %.
MANY_ROWS, LONG_ROW_DEG, LONG_ROW_RATES = 2000, 1.5, 2.0
ROW_RATE_SHARE = 1.0 / 30.0  # of the fastest rate: the ramps alone tell a nonlinearity from bias and scale factor
# s; longest interval between samples at which means are by integrals: corners of 100 deg/s^2 in a row of four samples
# then change its mean rate by 5e-3 deg/s at most
FINEST_STEP_S = 2.1e-3
ALL_SAMPLES = 3  # of a row, at which a shifted motion is computed: longer rows need three points each
PIECED, PIECES = 64, (1 / 32, 1 / 8, 7 / 8, 31 / 32)  # samples of a row that is divided, at these shares of it
# fields of the motion in a turn that is shifted in time
MOVED_FIELDS = "specific_force", "angular_rate", "angular_acceleration", "specific_force_rate", "level", "angle", "rate"
MEDIAN_OF_DIFFERENCES = 0.9099  # median of (w[n+1] - w[n])^2 of white noise of variance 1: 2 times that of chi-square
SCATTERED = 6.0  # standard deviations of a chi-square above its mean, and half its square for the tail of few samples
MAX_BEND_DPS, MAX_BEND_SHARE = 0.05, 1e-3  # see ``reference_valid``


@dataclass(frozen=True)
class TurnPart:
    """The samples of one recording that a fit uses, and the motion of the table."""

    recording: Recording
    motion: Motion
    keep: Mask  # (n,)

    @property
    def used_motion(self) -> Motion:
        """The motion at the samples that are used."""
        return self.motion.select(self.keep)

    def reading(self, sensor: str) -> Values:
        """Return the readings that are used: (k, 3) array."""
        reading = self.recording.reading(sensor)
        assert reading is not None  # noqa: S101
        return reading.compress(self.keep, axis=0)


def used_motions(parts: Sequence[TurnPart]) -> list[Motion]:
    """Return the motion at the used samples of each part; a part without any is left out."""
    return [part.used_motion for part in parts if part.keep.any()]


def parts_of(recordings: Sequence[Recording], sensor: str, table: Table, method: str) -> list[TurnPart]:
    """Return the recordings made for a sensor with its readings and the table's motion, without invalid samples.

    ``method``: name of the method, for the message. Raises ``CannotCalibrateError`` if there is none.
    """
    usable = [r for r in recordings if r.role == sensor and r.reading(sensor) is not None]
    parts = []
    for recording in usable:
        motion = table_motion(recording, table)
        if motion is not None:
            parts.append(TurnPart(recording, motion, recording.valid))
    if not parts and sensor == "gyroscope" and any(r.role == "rests" and r.gyroscope is not None for r in recordings):
        raise CannotCalibrateError(
            f"{method} needs a table's motion for the gyroscope; where a hand moved the unit between rests in many "
            "attitudes, method=rests_and_moves calibrates it; with a table, record turns about x, y and z"
        )
    if not parts:
        lack = "none of them logs the table's angle" if usable else f"no recording of role {sensor} holds its readings"
        raise CannotCalibrateError(
            f"{method} needs the table's motion for the {sensor}, and {lack}: record turns about x, y and z with "
            "table_angle_deg, or rests in many attitudes, which need no table (procedure=multi_position, "
            "method=rests_and_moves)"
        )
    return parts


def stop_and_go(motion: Motion) -> bool:
    """Return whether a motion has rests at four or more attitudes, so that the rests suffice for a fit."""
    rests = runs(motion.still)
    if len(rests) < 4:
        return False
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(motion.specific_force, axis=0)])
    start, stop = np.array(rests).T
    means = (total[stop] - total[start]) / (stop - start)[:, None]
    return len({tuple(mean) for mean in np.round(means / DISTINCT_DIRECTION_G).tolist()}) >= 4


def settled(part: TurnPart) -> Mask:
    """Return the samples of a part that an accelerometer's fit uses: its rests if it stops and goes, else all."""
    return part.keep & part.motion.still if stop_and_go(part.motion) else part.keep


def steady_turns(part: TurnPart, memory: float) -> Mask:
    """Return the samples in the steady parts of a turn about one axis, without the settling of a filter.

    ``memory``: the settling time, s. Of a shorter turn the middle is used, where the filter's error is small.
    """
    motion = part.motion
    if motion.axis is None or motion.rate is None:
        return np.zeros(len(motion.time), bool)
    rate, change = np.abs(motion.rate), np.abs(motion.angular_acceleration[:, motion.axis])
    steady: Mask = (rate > SLOWEST_SHARE * np.max(rate)) & (change <= CHANGE_PER_SECOND * rate)
    steady &= ~motion.still
    both_ways = bool(part.recording.filter.get("zero_phase"))
    for start, stop in runs(steady):
        time = motion.time[start:stop]
        tail = min(memory, LONGEST_TAIL * (time[-1] - time[0]))
        since, until = (TURN_EDGE_S + tail if start else 0.0), TURN_EDGE_S + both_ways * tail
        steady[start:stop] = (time >= time[0] + since) & (time <= time[-1] - until)
    return steady


def filtered_alike(part: TurnPart) -> Mask:
    """Return the samples of ``settled`` that a filter changes equally.

    Without a filter, and for rests, these are all samples. In a continuous turn with a filter they are the samples in
    which the table turns steadily and the filter has settled.
    """
    keep, applied = settled(part), part.recording.filter
    if applied["name"] == "none" or part.motion.rate is None or stop_and_go(part.motion):
        return keep
    return keep & steady_turns(part, DELAYS_TO_FOLLOW * float(applied["delay_s"]))


def noise_of_turns(
    parts: Sequence[TurnPart], prior: WanderPrior, table: Table, *, two_sided: bool = False
) -> ResidualNoise:
    """Return the noise of an accelerometer on a table, from the residuals of ``y = b + K u``, or ``+ C |u|`` too."""
    motions = used_motions(parts)
    u = np.concatenate([motion.specific_force for motion in motions])
    reading = np.concatenate([part.reading("accelerometer") for part in parts])
    X = np.column_stack([np.ones(len(u)), u, np.abs(u)] if two_sided else [np.ones(len(u)), u])
    beta = ScaledColumns.of(X).solve(reading)
    reference = Reference("accelerometer", motions, beta[1:4].T, table)
    return noise_on_table(reference, reading - X @ beta, X, blocks_of_samples(parts), prior)


def blocks_of_samples(parts: Sequence[TurnPart]) -> Blocks:
    """Divide the used samples of parts, stacked in their order, into about ``FIT_BLOCKS`` blocks of equal size.

    Recordings of one session, one after the other, share a clock.
    """
    used = [int(part.keep.sum()) for part in parts]
    size = max(1, -(-sum(used) // FIT_BLOCKS))
    rows = []
    sessions: dict[str, tuple[int, float]] = {}  # clock and end of the last recording of each session
    for number, (part, samples) in enumerate(zip(parts, used, strict=True), start=1):
        if samples == 0:
            continue
        recording = part.recording
        before, end = sessions.get(recording.setup, (number, np.inf))
        clock = before if recording.setup and recording.time[0] > end else number
        sessions[recording.setup] = clock, float(recording.time[-1])
        time, first = recording.time[part.keep], np.arange(0, samples, size)
        length = time[np.minimum(first + size, samples) - 1] - time[first] + recording.interval
        weight = np.diff(np.append(first, samples)).astype(float)
        rows.append((weight, time[first], length, np.full(len(first), 0 if recording.clock_shared else clock)))
    weights, start, length, clocks = (np.concatenate(column) for column in zip(*rows, strict=True))
    firsts = np.cumsum(np.append(0, weights[:-1])).astype(np.intp)
    return Blocks(firsts, weights, start, length, clocks)


def rows_of_parts(parts: Sequence[TurnPart]) -> tuple[list[RowGroups], Blocks]:
    """Group the used samples of parts to rows that lie within the blocks of ``blocks_of_samples``; and these of rows.

    A linear fit to the rows' means, weighted by their samples, loses no more than the changes of the motion within
    rows, a ten-thousandth of the information; sums over blocks are those of the samples.
    """
    blocks, rows, edge = blocks_of_samples(parts), [], 0
    for part in parts:
        found = _grouped(part.motion, np.flatnonzero(part.keep), part.recording.filter["name"] == "none")
        used = len(found.kept)
        starts = np.zeros(used, bool)
        starts[blocks.first[(blocks.first >= edge) & (blocks.first < edge + used)] - edge] = True
        starts[found.first] = True
        rows.append(replace(found, first=np.flatnonzero(starts)))
        edge += used
    starts = np.cumsum(np.concatenate([each.count for each in rows]))  # of the next row
    return rows, replace(blocks, first=np.searchsorted(starts, blocks.first, side="right"))


@dataclass(frozen=True, eq=False)
class RowGroups:
    """Groups of a recording's samples whose means are the rows of a fit; equal ones are one argument of ``once``."""

    kept: Index  # (k,); indices of the samples
    first: Index  # (m,); where in ``kept`` each group starts
    total: int  # samples of the recording

    @cached_property
    def count(self) -> Values:
        """Samples of each group: (m,) array."""
        return np.diff(np.append(self.first, len(self.kept))).astype(float)

    @cached_property
    def _key(self) -> tuple[bytes, bytes, int]:
        return self.kept.tobytes(), self.first.tobytes(), self.total

    def __eq__(self, other: object) -> bool:
        return isinstance(other, RowGroups) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    def settled(self, reading: Values) -> RowGroups:
        """Split groups whose readings, (n, 3), scatter too much into single samples.

        They are at rest by the table's log; with an error of the sensor's clock, the sensor still moves at their edges.
        """
        size = self.count.astype(int)
        if np.all(size < 2):
            return self
        kept = reading.take(self.kept, axis=0)
        inside = np.ones(len(kept) - 1, bool)
        inside[self.first[1:] - 1] = False
        white = median(np.diff(kept, axis=0)[inside] ** 2) / MEDIAN_OF_DIFFERENCES
        deviation = (kept - np.repeat(self.means(reading), size, axis=0)) ** 2
        scatter = np.add.reduceat(deviation, self.first, axis=0)
        freedom = np.maximum(self.count - 1.0, 0.0)
        most = freedom + SCATTERED * np.sqrt(2.0 * freedom) + SCATTERED**2 / 2.0
        moving = np.any((scatter > most[:, None] * white) & (white > 0), axis=1) & (size > 1)
        starts = np.repeat(moving, size)
        starts[self.first] = True
        return replace(self, first=np.flatnonzero(starts))

    def means(self, values: Values) -> Values:
        """Return the group means of (n, ...) values: (m, ...) array."""
        kept = values if len(self.kept) == len(values) else values.take(self.kept, axis=0)
        if len(self.first) == len(kept):
            return kept
        shape = (-1,) + (1,) * (values.ndim - 1)
        return np.add.reduceat(kept, self.first, axis=0) / self.count.reshape(shape)

    def all(self, mask: Mask | None) -> Mask | None:
        """Return for which groups an (n,) mask is true at all samples: (m,) array; None for None."""
        return None if mask is None else np.logical_and.reduceat(mask[self.kept], self.first)

    def motion(self, motion: Motion) -> Motion:
        """Return the motion at the rows."""
        known = (lambda: self.all(motion.reference_valid)) if motion.has("reference_valid") else None
        found = motion.mapped(self.means, still=motion.still[self.kept[self.first]], reference_valid=known)
        logged, long = motion.at_offset, self.count.max(initial=0.0) > ALL_SAMPLES
        step = float(np.ptp(motion.time)) / max(len(motion.time) - 1, 1)
        if motion.axis is not None and logged and long and step <= FINEST_STEP_S:
            still = cache(lambda: logged(rows=self._pieces))  # the same integrals of the motion that is not shifted
            return self._with_trajectory(found, motion, partial(self._mean_at, found, still))
        return self._with_trajectory(found, motion, self._at)

    def _at(self, trajectory: Callable[..., Motion], offset: float | Values = 0.0, **lag: float) -> Motion:
        """Return the motion at the rows' samples shifted in time; ``offset``: of the rows."""
        if isinstance(offset, np.ndarray):
            samples = np.zeros(self.total)
            samples[self.kept] = np.repeat(offset, self.count.astype(int))
            offset = samples
        return self.motion(trajectory(offset=offset, **lag))

    @staticmethod
    def _with_trajectory(rows: Motion, motion: Motion, at: Callable[..., Motion]) -> Motion:
        """Return the motion at the rows with the trajectories of a motion, seen by ``at``."""
        offset, lag = (None if to is None else partial(at, to) for to in (motion.at_offset, motion.at_lag))
        return rows.changed(at_offset=offset, at_lag=lag)

    @cached_property
    def _pieces(self) -> Pieces:
        """The pieces of all rows: each sample of a short row, a longer row, parts of a long one.

        Parts are shorter towards its ends: the motion next to a rest enters it by a shift.
        """
        size = self.count.astype(int)
        starts = np.repeat(size <= ALL_SAMPLES, size)
        starts[self.first] = True
        many = size > PIECED
        starts[(self.first[many] + np.outer(PIECES, size[many]).astype(int)).ravel()] = True
        begin = np.flatnonzero(starts)
        samples, of_row = np.diff(np.append(begin, len(self.kept))), np.searchsorted(begin, self.first)
        share = samples / np.repeat(self.count, np.diff(np.append(of_row, len(begin))))
        return Pieces(self.kept[begin], self.kept[begin + samples - 1], share, of_row)

    def _mean_at(
        self,
        here: Motion,
        logged: Callable[[], Motion],
        trajectory: Callable[..., Motion],
        offset: float | Values = 0.0,
        **lag: float,
    ) -> Motion:
        """Return the motion at the rows shifted in time by the integrals of a turn; ``here``: that not shifted.

        The means of long rows change as the integrals do from ``logged``, those of the motion that is not shifted.
        """
        pieces = self._pieces
        if isinstance(offset, np.ndarray):
            offset = np.repeat(offset, np.diff(np.append(pieces.of_row, len(pieces.first))))
        moved = trajectory(offset=offset, rows=pieces, **lag)

        def later(name: str) -> Values:
            values, mean = getattr(moved, name), getattr(here, name)
            long = self.count.reshape(-1, *[1] * (mean.ndim - 1)) > ALL_SAMPLES
            return np.asarray(values + np.where(long, mean - getattr(logged(), name), 0.0))

        found: dict[str, Any] = {name: partial(later, name) for name in MOVED_FIELDS}
        found["reference_valid"] = lambda: moved.reference_valid
        return self._with_trajectory(here.changed(**found), moved, partial(self._mean_at, here, logged))


def rows_of(motion: Motion, valid: Mask, *, together: bool = True) -> RowGroups:
    """Select the samples of a fit, and group those of each rest, and those in which the table turns by little.

    ``valid``: (n,), samples with valid readings. ``together``: whether the samples of a rest are equivalent, which they
    are not after a filter.
    """
    moving = length(motion.angular_rate) > RATE_AT_REST_DPS
    if motion.rate is not None:
        moving = np.abs(motion.rate) > RATE_AT_REST_DPS
    return _grouped(motion, np.flatnonzero(valid & (motion.still | moving) & reference_valid(motion)), together)


def _grouped(motion: Motion, kept: Index, together: bool) -> RowGroups:  # noqa: FBT001
    """Group samples of a motion as ``rows_of`` does; ``kept``: their indices, (k,)."""
    if len(kept) == 0:
        return RowGroups(kept, kept, len(motion.time))
    still, time = motion.still[kept], motion.time[kept]
    sense = np.where(still, 0.0, 1.0 if motion.rate is None else np.sign(motion.rate[kept]))
    alike = (still[1:] == still[:-1]) & (sense[1:] == sense[:-1]) & (np.diff(kept) == 1) & together
    run = np.concatenate([[0], np.cumsum(~alike)])
    begin = np.flatnonzero(np.concatenate([[True], ~alike]))[run]
    speed = np.where(still, 0.0, length(motion.angular_rate.take(kept, axis=0)))
    turned = np.cumsum(speed * np.diff(time, append=time[-1]))  # at the end of the interval after each sample
    step = max(ROW_RATE_SHARE * float(speed.max()), RATE_AT_REST_DPS)
    for deg, times in ((ROW_DEG, 1.0), (LONG_ROW_DEG, LONG_ROW_RATES)):
        changed = (speed - speed[begin]) / (times * step) + 0.5
        pieces = (time - time[begin]) / MEAN_S, (turned - turned[begin]) / deg, changed
        piece = np.floor(np.stack(pieces) + 1e-9)
        first = np.flatnonzero(np.concatenate([[True], ~alike | np.any(np.diff(piece, axis=1) != 0, axis=0)]))
        if len(first) <= MANY_ROWS:
            break
    return RowGroups(kept, first, len(motion.time))


def reference_valid(motion: Motion) -> Mask:
    """Return at which samples the log describes the motion of the table: (n,) array of bool.

    In a turn, the log must describe both intervals next to a sample. With an attitude log, the rate at the sample and
    at its neighbours must agree with the cubic through the four nearest samples, to 0.05 deg/s and 0.1 %.
    """
    if motion.reference_valid is not None:
        return motion.reference_valid
    rate, time = motion.angular_rate, motion.time
    bend = np.full(len(time), np.inf)
    if len(time) >= 5:
        t = [time[k : len(time) - 4 + k] for k in range(5)]
        guess = np.zeros((len(t[0]), rate.shape[1]))
        for j in (0, 1, 3, 4):  # Lagrange's cubic through the four neighbours, at the middle sample
            others = [k for k in (0, 1, 3, 4) if k != j]
            weight = np.prod([(t[2] - t[k]) / (t[j] - t[k]) for k in others], axis=0)
            guess += weight[:, None] * rate[j : len(time) - 4 + j]
        bend[2:-2] = np.abs(guess - rate[2:-2]).max(axis=1)
    bends = bend > np.maximum(MAX_BEND_DPS, MAX_BEND_SHARE * np.abs(rate).max(axis=1))
    return np.asarray(np.convolve(bends, np.ones(3), "same") < 0.5)
