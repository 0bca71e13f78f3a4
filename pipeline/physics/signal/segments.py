"""Divide one long recording into segments: moves of a table, or turns by hand for held-out data.

Moves of one kind about one axis make a segment, with the adjacent rests. Steps that stop in four attitudes or more are
for the accelerometer, turns for the gyroscope. Where an axis has moves of one kind only, they are for both sensors; if
they are turns in two segments, the slower ones are for the accelerometer. Motion about several axes is held-out data. A
rest of a minute or more determines the noise. Where the sensor moves and the table does not, the unit is being mounted:
no segment contains such samples.

A move of the table is

    moving        |r| > 0.02 deg/s, by the table's log
    turn about i  sum_n (w_i[n] - b_i)^2 > 0.8 sum_n |w[n] - b|^2 in a move
    step, turn    a move by less than half a turn, or by more

where r is the rate of the table (logged, or that of its angle or attitude), w the angular rate that the sensor reads,
and b the median of w while the table rests.

Turns by hand are by a stated angle A about one body axis, from rest to rest; every k-th about each axis is held out:

    Y = integral (y - b) dt,   n = round(Y_a / A),   |Y_a - n A| < min(|n A| / 10, A / 4),   |Y - Y_a e_a| < |Y_a| / 4

where

    y, b : reading of the angular rate, and the mean of both rests
    a, A : the axis with the largest |Y_a|, and the stated angle; n is not 0
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np

from pipeline.core.errors import InputError
from pipeline.core.records import AXES, Mask, Note, Recording, Values, rate_of_attitude
from pipeline.core.settings import HandTurns, RecordingFile, Table, Window
from pipeline.physics.signal.rests import (
    RATE_AT_REST_DPS,
    RESTS,
    SETTLING_S,
    SHORTEST_REST_S,
    WINDOW_S,
    Rest,
    find_rests,
    runs,
    still_samples,
)

FEWEST_STOPS = 4  # attitudes about one axis that determine a bias and a row of the matrix
BESIDE_S, BESIDE_FREE_S = 30.0, 1.0  # largest length of the adjacent rest that a segment includes
SHORTEST_STATIC_S, SHORTEST_FREE_S = 60.0, 10.0  # shorter rests determine no bias wander, shorter motion no mean error
SLOWER = 1.2  # rates that differ by less are one rate
FEWEST_OF_A_SPLINE = 6  # samples of a quintic
AGREES = 0.05  # of the mean rate: the rate of one gimbal differs from that of the attitude by far more
SHORT_NAMES = {
    "accelerometer": "accel", "gyroscope": "gyro", "rests": "rests", "validation": "validation", "static": "static",
}  # fmt: skip
ONE_AXIS = 0.8  # share of the energy of a turn about a body axis that is misaligned by 27 deg
ENCODER_AGREES_DEG, ENCODER_AGREES = 5.0, 0.1  # one sample of 50 ms at 100 deg/s; a coarse log of the rate
HALF_A_TURN_DEG = 180.0
LEAST_TURNED_DEG, LEAST_ERROR_DEG = 10.0, 1e-4  # of a table's turn that counts; of an angle that is stated as exact
# in the source of a recording on a table (of a sheet)
LOGGED_TURNS, AXIS_ACCURACY = "table_turns", "table_axis_accuracy_deg"
HANDLED_DPS, NEAR_A_MOVE_S = 3.0, 0.5  # above bias and vibration of a resting unit; the logs' clocks may differ
SCALE = 0.1  # relative: three times the largest scale factor error of the shipped data sheets (MPU-6050: 3 %)
# 15 deg between the turn and a body axis: misalignment of the chip in its case, and error of the hand
MAX_AXIS_SINE = 0.25
HALF_S = WINDOW_S + SHORTEST_REST_S  # shortest half of a divided rest that is found again: a window is trimmed


class Segment(NamedTuple):
    """Samples ``start <= n < stop`` of a recording, the role and axis of a recording of them, and a description."""

    start: int
    stop: int
    role: str
    axis: str | None
    what: str


class Move(NamedTuple):
    """One move of the table: its samples, axis (None for several), angle (deg) and largest rate (deg/s)."""

    start: int
    stop: int
    axis: int | None
    angle: float
    rate: float

    @property
    def kind(self) -> tuple[int | None, str]:
        """Its axis, and whether it is a step, a turn or free motion."""
        if self.axis is None:
            return None, "free"
        return self.axis, "turn" if self.angle >= HALF_A_TURN_DEG else "step"


def cut(recording: Recording, windows: Sequence[Window] | None = None, *, found: bool = False) -> list[Recording]:
    """Return the segments of one long recording as separate recordings.

    ``windows``: the segments, instead of finding them here. ``found``: whether the windows were computed from the
    recording, for the notes. Raises ``InputError`` if no segment is found, or a window contains no samples.
    """
    segments = _find_segments(recording) if windows is None else [_segment_of_window(recording, w) for w in windows]
    how = "found" if found or windows is None else "given by a window"
    out: list[Recording] = []
    count: Counter[str] = Counter()
    for start, stop, role, axis, what in segments:
        name = SHORT_NAMES[role] + (f"_{axis}" if axis else "")
        count[name] += 1
        first, last = float(recording.time[start]), float(recording.time[stop - 1])
        since = first - recording.time[0], last - recording.time[0]
        detail = f"{what}, from {since[0]:.2f} to {since[1]:.2f} s of {recording.name}: {how}"
        part = recording.select(slice(start, stop))
        rate = part.table_rate if axis is not None else _size_of_rate(part)
        notes = (*(() if out else recording.notes), Note("N-SEGMENT", stop - start, 0, 0, detail, first, last))
        unique = name if count[name] == 1 else f"{name}_{count[name]}"
        out.append(replace(part, name=unique, role=role, axis=axis, table_rate=rate, notes=notes))
    return out


def logged_turns(recording: Recording, table: Table, entry: RecordingFile, turns: HandTurns) -> Recording:
    """Return a recording on a table (of a sheet) with its turns and rests in its source, instead of the table's log.

    A turn is a move in one direction, with up to ``SETTLING_S`` of the rests beside it, in which the sensor settles.
    Each has its samples, its total angle by the log and the standard uncertainty of that, deg. Raises ``InputError``
    without a log, or without a turn in it.
    """
    rate, angle, time = recording.logged_rate, recording.table_angle, recording.time
    if rate is None or recording.table_attitude is not None:
        raise InputError(
            "kind table: the file holds neither the angle nor the rate of a table about one axis; a turn by a known "
            "angle is of kind turn, a table that logs its attitude needs procedure three_axis_turns",
            recording.source.get("file"),
        )
    margin = int(SETTLING_S / recording.interval)
    moving = sorted([*runs(rate > RATE_AT_REST_DPS), *runs(rate < -RATE_AT_REST_DPS)])
    edges = [0, *((a[1] + b[0]) // 2 for a, b in pairwise(moving)), len(rate)]
    found = []
    for (start, stop), low, high in zip(moving, edges, edges[1:], strict=False):
        first, last = max(start - margin, low), min(stop + margin, high - 1)
        passed = np.trapezoid(rate[first : last + 1], time[first : last + 1])
        turned = table.sense * float(passed if angle is None else angle[last] - angle[first])
        by_log = table.rate_accuracy * abs(turned) if angle is None else np.sqrt(2.0) * table.angle_accuracy_deg
        error = entry.angle_accuracy_deg or (turns.accuracy_deg if table.motion == "none" else float(by_log))
        if abs(turned) >= LEAST_TURNED_DEG:
            found.append([first, last + 1, turned, max(error, LEAST_ERROR_DEG)])
    if not found:
        raise InputError("kind table: its log shows no turn", recording.source.get("file"))
    seated = float(np.hypot(table.orthogonality_deg, table.seat_deg or 0.0))
    axes = turns.axis_accuracy_deg if table.motion == "none" else max(seated, LEAST_ERROR_DEG)
    still = runs(still_samples(time, rate))
    rests = [[a, b] for a, b in still if (b - a) * recording.interval >= SHORTEST_REST_S]
    source = {**recording.source, LOGGED_TURNS: found, RESTS: rests, AXIS_ACCURACY: axes}
    return replace(recording, table_angle=None, table_rate=None, source=source)


def _size_of_rate(part: Recording) -> Values | None:
    """Return the magnitude of the table's rate: as logged, or from the attitude if the log has one gimbal only."""
    logged = None if part.table_rate is None else np.abs(part.table_rate)
    if part.table_attitude is None or part.samples < FEWEST_OF_A_SPLINE:
        return logged
    turned = rate_of_attitude(part.time, part.table_attitude)
    if logged is not None and np.mean(np.abs(turned - logged)) < AGREES * np.mean(turned) + RATE_AT_REST_DPS:
        return logged
    return turned


def _segment_of_window(recording: Recording, window: Window) -> Segment:
    since = recording.time - recording.time[0]
    start, stop = np.searchsorted(since, [window.start_s, window.stop_s])
    if stop - start < 2:
        problem = f"the window from {window.start_s:g} to {window.stop_s:g} s holds {stop - start} samples"
        raise InputError(f"{problem}; the recording is {since[-1]:.2f} s long", recording.source.get("file"))
    role, axis = window.role, window.axis
    return Segment(int(start), int(stop), role, axis, f"{role} about {axis}" if axis else role)


def _find_segments(recording: Recording) -> list[Segment]:
    """Find the turns, rests and free motion of one long recording, in order of time."""
    rate, gyro = recording.logged_rate, recording.gyroscope
    if rate is None and recording.table_attitude is not None:
        rate = rate_of_attitude(recording.time, recording.table_attitude)
    if rate is None or gyro is None:
        problem = "the recording is to be cut into its turns, and it holds no gyroscope or no log of the table"
        raise InputError(f"{problem}; give windows in procedure.recordings", recording.source.get("file"))
    session = _Session(recording, rate, gyro)
    segments = [segment for group in session.groups for segment in session.segments(group)]
    segments += session.static(segments)
    if not any(s.axis for s in segments):
        message = f"no turns about one axis were found in {len(session.moves)} moves of the table"
        raise InputError(f"{message}; give windows in procedure.recordings", recording.source.get("file"))
    return sorted(segments, key=lambda s: (s.start, s.role))


class _Session:
    """The moves in a long recording, and their groups; rates of table and sensor in deg/s."""

    def __init__(self, recording: Recording, rate: Values, gyro: Values) -> None:
        self.recording, self.rate, self.gyro = recording, rate, gyro
        self.moving = np.abs(rate) > RATE_AT_REST_DPS
        self.bias = np.median(gyro if self.moving.all() else gyro[~self.moving], axis=0)
        self.margin = int(np.ceil(NEAR_A_MOVE_S / recording.interval))
        self.handled = self._handled()
        step = np.gradient(recording.time)
        self.moves = [self._move(start, stop, step) for start, stop in runs(self.moving)]
        self.groups = self._groups()

    def _handled(self) -> Mask:
        """Return at which samples the sensor turns and the table does not."""
        if self.moving.all():
            return np.zeros(len(self.moving), bool)
        near = np.convolve(self.moving, np.ones(2 * self.margin + 1), "same") > 0.5
        off = np.linalg.norm(self.gyro - self.bias, axis=1)
        noise = float(np.median(off[~self.moving]))
        return np.asarray((off > max(HANDLED_DPS, 10.0 * noise)) & ~near)

    def _move(self, start: int, stop: int, step: Values) -> Move:
        energy = np.sum((self.gyro[start:stop] - self.bias) ** 2, axis=0)
        axis = int(np.argmax(energy))
        rate = np.abs(self.rate[start:stop])
        angle = float(np.sum(rate * step[start:stop]))
        alone, logged = energy[axis] > ONE_AXIS * energy.sum(), self.recording.table_angle
        if logged is not None:  # if its change is not the integrated rate, it is the angle of another gimbal
            passed = float(np.sum(np.abs(np.diff(logged[max(start - 1, 0) : stop + 1]))))
            alone &= abs(passed - angle) < ENCODER_AGREES_DEG + ENCODER_AGREES * angle
        return Move(start, stop, axis if alone else None, angle, float(rate.max()))

    def _groups(self) -> list[list[Move]]:
        """Group successive moves of one kind; a new mounting of the sensor begins a new group."""
        groups = [[move] for move in self.moves[:1]]
        for last, move in pairwise(self.moves):
            if last.kind != move.kind or self.handled[last.stop : move.start].any():
                groups.append([])
            groups[-1].append(move)
        return groups

    def segments(self, group: list[Move]) -> list[Segment]:
        """Return the segments of a group of moves: two where it is for both sensors, none for a transit."""
        first = group[0]
        if first.axis is None:  # without short moves before and after it, in which the table approaches and returns
            lasting = [k for k, move in enumerate(group) if self._seconds(move.start, move.stop) >= SHORTEST_FREE_S]
            group = group[lasting[0] : lasting[-1] + 1] if lasting else group
            if self._seconds(group[0].start, group[-1].stop) < SHORTEST_FREE_S:
                return []
            return [Segment(*self._extent(group), "validation", None, "motion about several axes")]
        if not _is_useful(group):
            return []
        axis = AXES[first.axis]
        rates = sorted({round(m.rate, 1) for m in group})
        listed = f"{rates[0]:g}" if len(rates) == 1 else f"{rates[0]:g} to {rates[-1]:g}"
        what = f"{len(group)} {first.kind[1]}{'s'[: len(group) > 1]} about {axis} at {listed} deg/s"
        return [Segment(*self._extent(group), role, axis, what) for role in self._roles(group)]

    def _seconds(self, start: int, stop: int) -> float:
        return float(self.recording.time[stop - 1] - self.recording.time[start])

    def _roles(self, group: list[Move]) -> list[str]:
        """Return the sensors that a group of moves about one axis is for."""
        others = [g for g in self.groups if g[0].axis == group[0].axis and g is not group and _is_useful(g)]
        if any(g[0].kind != group[0].kind for g in others):
            return ["accelerometer" if group[0].kind[1] == "step" else "gyroscope"]
        rate, rates = max(m.rate for m in group), [max(m.rate for m in g) for g in others]
        if not rates or max(rate, *rates) < SLOWER * min(rate, *rates):
            return ["accelerometer", "gyroscope"]
        return ["accelerometer"] if rate < min(rates) else ["gyroscope"]

    def _extent(self, group: list[Move]) -> tuple[int, int]:
        """Return the samples of a group with half of each adjacent rest, 30 s at most, without handled samples."""
        first, last = group[0].start, group[-1].stop
        margin = int((BESIDE_S if group[0].axis is not None else BESIDE_FREE_S) / self.recording.interval)
        # without a move before: from the first sample; without one after: to the last
        before = max((m.stop for m in self.moves if m.stop <= first), default=-first)
        after = min((m.start for m in self.moves if m.start >= last), default=2 * self.recording.samples - last)
        start, stop = max((before + first) // 2, first - margin), min((last + after) // 2, last + margin)
        early = np.flatnonzero(self.handled[start:first])
        late = np.flatnonzero(self.handled[last:stop])
        start = start + int(early[-1]) + 1 + self.margin if early.size else start
        stop = last + int(late[0]) - self.margin if late.size else stop
        return min(start, first), max(stop, last)

    def static(self, others: Sequence[Segment]) -> list[Segment]:
        """Return the longest rest outside the other segments, if it is long enough."""
        still = ~self.moving & ~self.handled
        for other in others:
            still[other.start : other.stop] = False
        last = self.recording.samples
        spans = [(a + self.margin * (a > 0), b - self.margin * (b < last)) for a, b in runs(still)]
        start, stop = max(spans, key=lambda s: s[1] - s[0], default=(0, 0))
        if (stop - start) * self.recording.interval < SHORTEST_STATIC_S:
            return []
        return [Segment(start, stop, "static", None, "a long rest")]


def _is_useful(group: Sequence[Move]) -> bool:
    return group[0].kind[1] == "turn" or (group[0].kind[1] == "step" and len(group) >= FEWEST_STOPS - 1)


def multiples(angle: Values, stated_deg: float) -> tuple[int, int]:
    """Return the axis of an integrated rate (3,), deg, and the number of stated angles in it; 0: not a multiple."""
    axis = int(np.argmax(np.abs(angle)))
    along = float(angle[axis])
    count = round(along / stated_deg)
    off, across = abs(along - count * stated_deg), float(np.linalg.norm(np.delete(angle, axis)))
    agrees = off < min(SCALE * abs(count) * stated_deg, 0.25 * stated_deg) and across < MAX_AXIS_SINE * abs(along)
    return axis, count if agrees else 0


class TurnByHand(NamedTuple):
    """A turn by the stated angle about one body axis, and the rests before and after it, s from the first sample."""

    axis: int
    before: tuple[float, float]
    after: tuple[float, float]
    held_out: bool


def turns_by_hand(recording: Recording, rests: Sequence[Rest], turns: HandTurns) -> list[TurnByHand]:
    """Return the turns by a multiple of the stated angle between accepted rests.

    Every ``holdout_every``-th about an axis is held out, or the next one whose rests are long enough to be cut into
    two rests each.
    """
    rate, every = recording.gyroscope, turns.holdout_every
    if rate is None:
        return []
    since, seen, found = recording.time - recording.time[0], [0, 0, 0], []
    for before, after in pairwise(r for r in rests if r.accepted):
        move = slice(before.stop - 1, after.start + 1)
        bias = 0.5 * sum(rate[r.start : r.stop].mean(axis=0) for r in (before, after))
        axis, count = multiples(np.trapezoid(rate[move] - bias, since[move], axis=0), turns.angle_deg)
        if not count:
            continue
        seen[axis] += 1
        first, last = ((float(since[r.start]), float(since[r.stop - 1])) for r in (before, after))
        held = 0 < every <= seen[axis] and min(stop - start for start, stop in (first, last)) > 2.0 * HALF_S
        seen[axis] -= every * held
        found.append(TurnByHand(axis, first, last, held))
    return found


def held_out_windows(recording: Recording, turns: HandTurns) -> list[Window]:
    """Return the windows that make every ``holdout_every``-th turn about each axis a recording for validation.

    The windows, for ``cut``, are from the middle of the
    rest before a turn to the middle of the rest after it; there are none where nothing is held out.
    """
    edges = [0.0]
    for turn in turns_by_hand(recording, find_rests(recording), turns):
        if turn.held_out:
            edges += [0.5 * (start + stop) for start, stop in (turn.before, turn.after)]
    edges.append(float(recording.time[-1] - recording.time[0]) + recording.interval)
    roles: list[Literal["rests", "validation"]] = ["rests", "validation"] * len(edges)
    spans = zip(pairwise(edges), roles, strict=False)
    return [Window(role=role, start_s=a, stop_s=b) for (a, b), role in spans if b > a] if len(edges) > 2 else []
