"""Segmentation of one long recording into turns, rests and free motion.

Moves of one kind about one axis make a segment, with the rests beside them. Steps that stop in four attitudes or more
are for the accelerometer, turns for the gyroscope; where an axis has one kind only it serves both, and of turns about
one axis in two segments the slower ones are for the accelerometer. Motion about several axes is held out, a rest of a
minute or more determines the noise. Where the sensor moves and the table does not, the unit is being mounted: no
segment contains such samples.

A move of the table is

    moving        |r| > 0.02 deg/s, by the table's log
    turn about i  sum_n (w_i[n] - b_i)^2 > 0.8 sum_n |w[n] - b|^2 in a move
    step, turn    a move by less than half a turn, or by more

where

    r    : rate of the table: logged, or that of its angle or attitude
    w, b : angular rate read by the sensor, and its median while the table rests
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import InputError
from pipeline.records import AXES, Note, rate_of_attitude
from pipeline.signal.rests import RATE_AT_REST_DPS, runs

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.records import Recording

FEWEST_STOPS = 4
BESIDE_S, BESIDE_FREE_S = 30.0, 1.0  # of rest that a segment takes with it
SHORTEST_STATIC_S, SHORTEST_FREE_S = 60.0, 10.0
SLOWER = 1.2
FEWEST_OF_A_SPLINE, AGREES = 6, 0.05
SHORT_NAMES = {"accelerometer": "accel", "gyroscope": "gyro", "validation": "validation", "static": "static"}
ONE_AXIS = 0.8
ENCODER_AGREES_DEG, ENCODER_AGREES = 5.0, 0.1
HALF_A_TURN_DEG = 180.0
HANDLED_DPS, NEAR_A_MOVE_S = 3.0, 0.5


@dataclass(frozen=True)
class Segment:
    """Samples ``start <= n < stop`` of a recording, and what they are for.

    Attributes
    ----------
    start, stop : int
    role : str
        As of ``Recording``.
    axis : str or None
    what : str
        In words.
    """

    start: int
    stop: int
    role: str
    axis: str | None
    what: str


def cut(recording: Recording, windows: Sequence[Mapping[str, Any]] | None = None) -> list[Recording]:
    """Return the segments of one long recording as recordings of their own.

    Parameters
    ----------
    recording : Recording
    windows : sequence of mapping, optional
        ``role``, ``axis``, ``start_s`` and ``stop_s`` (in the recording's own time, from its first sample), in place of
        what is found.

    Raises
    ------
    InputError
        If nothing is found, or a window holds no samples.
    """
    segments = find_segments(recording) if windows is None else [_of_window(recording, w) for w in windows]
    out: list[Recording] = []
    count: dict[str, int] = {}
    for segment in segments:
        name = SHORT_NAMES[segment.role] + (f"_{segment.axis}" if segment.axis else "")
        count[name] = count.get(name, 0) + 1
        part = recording.select(slice(segment.start, segment.stop))
        rate = part.table_rate if segment.axis is not None else _size_of_rate(part)
        out.append(
            replace(
                part,
                name=name if count[name] == 1 else f"{name}_{count[name]}",
                role=segment.role,
                axis=segment.axis,
                table_rate=rate,
                notes=(*(recording.notes if not out else ()), _note(recording, segment, found=windows is None)),
            )
        )
    return out


def _size_of_rate(part: Recording) -> NDArray[np.float64] | None:
    """Return the size of the table's rate: the logged one, unless by the attitude it is of one gimbal alone."""
    logged = None if part.table_rate is None else np.abs(part.table_rate)
    if part.table_attitude is None or part.samples < FEWEST_OF_A_SPLINE:
        return logged
    turned = rate_of_attitude(part.time, part.table_attitude)
    if logged is not None and np.mean(np.abs(turned - logged)) < AGREES * np.mean(turned) + RATE_AT_REST_DPS:
        return logged
    return turned


def _note(recording: Recording, segment: Segment, *, found: bool) -> Note:
    first = recording.time[0]
    start, end = float(recording.time[segment.start]), float(recording.time[segment.stop - 1])
    how = "found" if found else "given by a window"
    detail = f"{segment.what}, from {start - first:.2f} to {end - first:.2f} s of {recording.name}: {how}"
    return Note("N-SEGMENT", segment.stop - segment.start, 0, 0, detail, start, end)


def _of_window(recording: Recording, window: Mapping[str, Any]) -> Segment:
    since = recording.time - recording.time[0]
    start, stop = np.searchsorted(since, [float(window["start_s"]), float(window["stop_s"])])
    if stop - start < 2:
        raise InputError(
            f"the window from {window['start_s']:g} to {window['stop_s']:g} s holds {stop - start} samples; the "
            f"recording is {since[-1]:.2f} s long",
            recording.source.get("file"),
        )
    role, axis = str(window["role"]), window.get("axis")
    return Segment(int(start), int(stop), role, axis, f"{role} about {axis}" if axis else role)


def find_segments(recording: Recording) -> list[Segment]:
    """Find the turns, rests and free motion of one long recording, in order of time.

    Raises
    ------
    InputError
        If the log shows no table, no gyroscope or no turn.
    """
    rate, gyro = rate_of_table(recording), recording.gyroscope
    if rate is None or gyro is None:
        raise InputError(
            "the recording is to be cut into its turns, and it holds no gyroscope or no log of the table; give windows "
            "in procedure.recordings",
            recording.source.get("file"),
        )
    moves = find_moves(recording, rate, gyro)
    handled = handled_samples(recording, rate, gyro)
    groups = groups_of(moves, handled)
    segments = [s for group in groups for s in _segments(recording, group, moves, handled, groups)]
    segments += _static(recording, rate, handled, segments)
    if not any(s.axis for s in segments):
        raise InputError(
            f"no turns about one axis were found in {len(moves)} moves of the table; give windows in "
            "procedure.recordings",
            recording.source.get("file"),
        )
    return sorted(segments, key=lambda s: (s.start, s.role))


def _segments(
    recording: Recording, group: list[Move], moves: Sequence[Move], handled: NDArray[np.bool_],
    groups: Sequence[list[Move]],
) -> list[Segment]:  # fmt: skip
    """Return what a group of moves is for: one segment, two where an axis has no other, none for a mere transit."""
    if group[0].axis is None:
        group = _without_transits(recording, group)
    start, stop = _extent(recording, group, moves, handled)
    first = group[0]
    if first.axis is None:
        long = _seconds(recording, group[0].start, group[-1].stop) >= SHORTEST_FREE_S
        return [Segment(start, stop, "validation", None, "motion about several axes")] if long else []
    if not _useful(group):
        return []
    axis = AXES[first.axis]
    rates = sorted({round(m.rate, 1) for m in group})
    listed = f"{rates[0]:g}" if len(rates) == 1 else f"{rates[0]:g} to {rates[-1]:g}"
    what = f"{len(group)} {first.kind}{'s'[: len(group) > 1]} about {axis} at {listed} deg/s"
    return [Segment(start, stop, role, axis, what) for role in _roles(group, groups)]


def _without_transits(recording: Recording, group: list[Move]) -> list[Move]:
    """Return a group without the short moves around motion that lasts: they bring the table there and back."""
    lasting = [k for k, m in enumerate(group) if _seconds(recording, m.start, m.stop) >= SHORTEST_FREE_S]
    return group[lasting[0] : lasting[-1] + 1] if lasting else group


def _seconds(recording: Recording, start: int, stop: int) -> float:
    return float(recording.time[stop - 1] - recording.time[start])


def _useful(group: Sequence[Move]) -> bool:
    return group[0].kind == "turn" or (group[0].kind == "step" and len(group) >= FEWEST_STOPS - 1)


def _roles(group: list[Move], groups: Sequence[list[Move]]) -> list[str]:
    """Return the sensors that a group of moves about one axis is for."""
    others = [g for g in groups if g[0].axis == group[0].axis and g is not group and _useful(g)]
    if any(g[0].kind != group[0].kind for g in others):
        return ["accelerometer" if group[0].kind == "step" else "gyroscope"]
    rate = max(m.rate for m in group)
    slowest = min((max(m.rate for m in g) for g in others), default=None)
    fastest = max((max(m.rate for m in g) for g in others), default=0.0)
    if slowest is None or max(rate, fastest) < SLOWER * min(rate, slowest):
        return ["accelerometer", "gyroscope"]
    return ["accelerometer"] if rate < slowest else ["gyroscope"]


def _extent(
    recording: Recording, group: list[Move], moves: Sequence[Move], handled: NDArray[np.bool_]
) -> tuple[int, int]:
    """Return the samples of a group with half of the rests beside it, 30 s at most, and nothing handled."""
    beside = int((BESIDE_S if group[0].axis is not None else BESIDE_FREE_S) / recording.interval)
    before = max((m.stop for m in moves if m.stop <= group[0].start), default=None)
    after = min((m.start for m in moves if m.start >= group[-1].stop), default=None)
    start = 0 if before is None else (before + group[0].start) // 2
    stop = recording.samples if after is None else (group[-1].stop + after) // 2
    start, stop = max(start, group[0].start - beside), min(stop, group[-1].stop + beside)
    early = np.flatnonzero(handled[start : group[0].start])
    late = np.flatnonzero(handled[group[-1].stop : stop])
    margin = int(np.ceil(NEAR_A_MOVE_S / recording.interval))
    start = start + int(early[-1]) + 1 + margin if early.size else start
    stop = group[-1].stop + int(late[0]) - margin if late.size else stop
    return min(start, group[0].start), max(stop, group[-1].stop)


def _static(
    recording: Recording, rate: NDArray[np.float64], handled: NDArray[np.bool_], others: Sequence[Segment]
) -> list[Segment]:
    """Return the longest rest that no other segment has taken, if it is long enough."""
    still = (np.abs(rate) <= RATE_AT_REST_DPS) & ~handled
    for other in others:
        still[other.start : other.stop] = False
    margin = int(np.ceil(NEAR_A_MOVE_S / recording.interval))
    spans = [(a + margin * (a > 0), b - margin * (b < recording.samples)) for a, b in runs(still)]
    longest = max(spans, key=lambda s: s[1] - s[0], default=(0, 0))
    if (longest[1] - longest[0]) * recording.interval < SHORTEST_STATIC_S:
        return []
    return [Segment(*longest, "static", None, "a long rest")]


@dataclass(frozen=True)
class Move:
    """One move of the table: its samples, axis (None for several), angle (deg) and largest rate (deg/s)."""

    start: int
    stop: int
    axis: int | None
    angle: float
    rate: float

    @property
    def kind(self) -> str:
        """What it is a part of."""
        if self.axis is None:
            return "free"
        return "turn" if self.angle >= HALF_A_TURN_DEG else "step"


def rate_of_table(recording: Recording) -> NDArray[np.float64] | None:
    """Return the rate of the table, its size where only that is known: (n,) array, deg/s."""
    if recording.table_rate is not None:
        return recording.table_rate
    if recording.table_angle is not None:
        return np.asarray(np.gradient(recording.table_angle, recording.time))
    if recording.table_attitude is None:
        return None
    return rate_of_attitude(recording.time, recording.table_attitude)


def find_moves(recording: Recording, rate: NDArray[np.float64], gyro: NDArray[np.float64]) -> list[Move]:
    """Return the moves of the table, in order of time.

    Parameters
    ----------
    recording : Recording
    rate : (n,) array, deg/s
        Of the table.
    gyro : (n, 3) array, deg/s
        Read by the sensor.
    """
    moving = np.abs(rate) > RATE_AT_REST_DPS
    bias = np.median(gyro[~moving], axis=0) if np.any(~moving) else np.median(gyro, axis=0)
    step = np.gradient(recording.time)
    found = []
    for start, stop in runs(moving):
        energy = np.sum((gyro[start:stop] - bias) ** 2, axis=0)
        axis = int(np.argmax(energy))
        angle = float(np.sum(np.abs(rate[start:stop]) * step[start:stop]))
        alone = energy[axis] > ONE_AXIS * energy.sum() and _encoder_agrees(recording, start, stop, angle)
        found.append(Move(start, stop, axis if alone else None, angle, float(np.abs(rate[start:stop]).max())))
    return found


def _encoder_agrees(recording: Recording, start: int, stop: int, angle: float) -> bool:
    """Return whether the logged angle moves as the rate says: else another gimbal turns than the one that is logged."""
    if recording.table_angle is None:
        return True
    passed = float(np.sum(np.abs(np.diff(recording.table_angle[max(start - 1, 0) : stop + 1]))))
    return abs(passed - angle) < ENCODER_AGREES_DEG + ENCODER_AGREES * angle


def handled_samples(recording: Recording, rate: NDArray[np.float64], gyro: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return the samples at which the sensor turns and the table does not."""
    moving = np.abs(rate) > RATE_AT_REST_DPS
    if moving.all():
        return np.zeros(len(moving), bool)
    width = 2 * int(np.ceil(NEAR_A_MOVE_S / recording.interval)) + 1
    near = np.convolve(moving, np.ones(width), "same") > 0.5
    resting = gyro[~moving]
    off = np.linalg.norm(gyro - np.median(resting, axis=0), axis=1)
    noise = float(np.median(np.linalg.norm(resting - np.median(resting, axis=0), axis=1)))
    return np.asarray((off > max(HANDLED_DPS, 10.0 * noise)) & ~near)


def groups_of(moves: Sequence[Move], handled: NDArray[np.bool_]) -> list[list[Move]]:
    """Return moves of one kind about one axis that follow each other, unless the sensor was mounted anew between."""
    groups: list[list[Move]] = []
    for move in moves:
        last = groups[-1][-1] if groups else None
        same = last is not None and (last.axis, last.kind) == (move.axis, move.kind)
        if same and last is not None and not handled[last.stop : move.start].any():
            groups[-1].append(move)
        else:
            groups.append([move])
    return groups
