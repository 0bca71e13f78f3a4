"""Whether the reference contradicts itself or the sensor: table angle, rate, attitude, gravity, gyroscope and time.

First the scales (``pipeline.preprocessing.reference_scale``), then delays, then single samples and stretches
(``pipeline.preprocessing.reference_rows``). The gyroscope's gain and bias for this are those of the unit's turns,
where they agree. What no effect of the catalogue explains within its configured limit is refused; what exceeds noise
and the table's stated accuracy but not these limits gets the note ``N-REFERENCE``.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.preprocessing.evidence import (
    Limits,
    alike,
    axis_index,
    gravity_turned,
    of_gravity,
    of_rate,
    of_table,
    quantiles,
    rate_of_turn,
    refusal,
    slopes_of,
    spin,
)
from pipeline.preprocessing.reference_delay import check_delays, delay_of
from pipeline.preprocessing.reference_rows import Comparison
from pipeline.preprocessing.reference_scale import (
    check_intervals,
    check_scale_of_motion,
    check_scale_of_turn,
    doubt_of_scale,
)
from pipeline.records import Note

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.preprocessing.evidence import Channel
    from pipeline.preprocessing.reference_delay import Delay
    from pipeline.records import Recording

    Array = NDArray[np.float64]

FEWEST = 32  # samples, two short stretches
HALF = 0.5  # of the usual gain, which the axis turned about shows at least
SAME = 0.1  # relative: gains of two turns that are of one gyroscope


def check_turns(
    recordings: Sequence[Recording], settings: Mapping[str, Any]
) -> tuple[list[Recording], dict[str, Delay]]:
    """Return the recordings of a unit with notes on the reference of their turns, and how late the sensor is in each.

    Signs and directions do not count: this goes before the mounting, which wrong units would hide. ``IngestError``:
    channels of a turn contradict each other beyond what an effect of the catalogue explains.
    """
    limits, turns = Limits.of(settings), _turns(recordings)
    for recording in turns:
        check_scale_of_turn(recording, limits)
    check_intervals([r for r in recordings if r.samples >= FEWEST], limits)
    gyroscope = _Gyroscope(turns)
    found = {r.name: _check_turn(r, gyroscope, limits) for r in turns}
    return _with_notes(recordings, found), {name: delay for name, (_, delay) in found.items() if delay is not None}


def _turns(recordings: Sequence[Recording]) -> list[Recording]:
    logged = [r for r in recordings if r.samples >= FEWEST and r.role != "static"]
    return [r for r in logged if r.axis is not None and not (r.table_rate is None and r.table_angle is None)]


def check_motion(
    recordings: Sequence[Recording], delays: Mapping[str, Delay], settings: Mapping[str, Any]
) -> list[Recording]:
    """Return the recordings of a unit with notes on the reference of held-out motion.

    The turns are as they are mounted, with their ``delays``. ``IngestError``: channels of held-out motion contradict
    each other, or a recording is late otherwise than all others.
    """
    limits, gyroscope = Limits.of(settings), _Gyroscope(_turns(recordings))
    moved = [r for r in recordings if r.samples >= FEWEST and r.role != "static" and r.axis is None]
    moved = [r for r in moved if not (r.table_rate is None and r.table_attitude is None)]
    found = {r.name: _check_motion(r, gyroscope, limits) for r in moved}
    late = {**delays, **{name: delay for name, (_, delay) in found.items() if delay is not None}}
    check_delays([(r, late[r.name]) for r in recordings if r.name in late], limits)
    return _with_notes(recordings, found)


def _with_notes(
    recordings: Sequence[Recording], found: Mapping[str, tuple[list[Note], Delay | None]]
) -> list[Recording]:
    notes = {name: notes for name, (notes, _) in found.items() if notes}
    return [replace(r, notes=(*r.notes, *notes[r.name])) if r.name in notes else r for r in recordings]


class _Gyroscope:
    """Gain matrix and bias of a gyroscope, roughly, by the turns of a unit."""

    def __init__(self, turns: Sequence[Recording]) -> None:
        self.slopes: dict[str, list[tuple[float, float] | None]] = {}  # of each turn: gain and bias of each axis
        found: list[tuple[int, float, Array, Array]] = []  # axis, usual fastest rate, gain and bias
        for recording in turns:
            rate = rate_of_turn(recording)
            if rate is None or recording.gyroscope is None:
                continue
            slopes = self.slopes[recording.name] = slopes_of(recording.gyroscope, rate)
            if None not in slopes:
                gain, bias = np.array(slopes, np.float64).T
                found.append((axis_index(recording), float(quantiles(np.abs(rate), 0.9)[0]), gain, bias))
        gains = [abs(gain[axis]) for axis, _, gain, _ in found]
        self.usual = float(np.median(gains)) if len(gains) > 2 else 1.0
        self.matrix = self.usual * np.eye(3)
        for axis in range(3):
            fitting = [f for f in found if f[0] == axis and abs(abs(f[2][axis]) / self.usual - 1.0) <= SAME]
            if fitting:
                self.matrix[:, axis] = max(fitting, key=lambda f: f[1])[2]
        self.bias = np.median([bias for *_, bias in found], axis=0) if found else None

    def along(self, recording: Recording, axis: int) -> Array | None:
        """Return the rate about a turn axis: (n,) array, deg/s; its bias is that of this recording."""
        rate, slopes = rate_of_turn(recording), self.slopes.get(recording.name)
        if recording.gyroscope is None or rate is None or slopes is None:
            return None
        reading, slope = recording.gyroscope[:, axis], slopes[axis]
        gains = [0.0 if s is None else abs(s[0]) / self.usual for s in slopes]
        if slope is not None and abs(gains[axis] - 1.0) <= SAME:
            return np.asarray((reading - slope[1]) / slope[0])
        if max(gains) > HALF > gains[axis]:
            return None  # another axis turns: a matter of the mounting
        gain = self.matrix[axis, axis]
        bias = np.median(reading - gain * rate) if self.bias is None else self.bias[axis]
        return np.asarray((reading - float(bias)) / gain)

    def vector(self, recording: Recording) -> Array | None:
        """Return the angular rate: (n, 3) array, deg/s; None where no turn tells the bias."""
        if recording.gyroscope is None or self.bias is None:
            return None
        return np.asarray(np.linalg.solve(self.matrix, (recording.gyroscope - self.bias).T).T)


def _check_turn(recording: Recording, gyroscope: _Gyroscope, limits: Limits) -> tuple[list[Note], Delay | None]:
    channels, axis = alike(of_table(recording)), axis_index(recording)
    seen = gyroscope.along(recording, axis)
    if seen is not None:
        channels.append(of_rate(recording, "gyroscope", seen, recording.valid))
    phase = gravity_turned(recording)
    if phase is not None and recording.table_angle is not None:
        channels.append(of_gravity(recording, phase, channels))
    notes, delay = _compare(recording, channels, limits)
    doubt = doubt_of_scale(recording, limits)
    if doubt is not None:
        ends = float(recording.time[0]), float(recording.time[-1])
        notes.append(Note("N-REFERENCE", recording.samples, 0, 0, doubt, *ends))
    return notes, delay


def _check_motion(recording: Recording, gyroscope: _Gyroscope, limits: Limits) -> tuple[list[Note], Delay | None]:
    vector = gyroscope.vector(recording)
    size = None if vector is None else np.linalg.norm(vector, axis=1)
    check_scale_of_motion(recording, size, limits)
    channels = of_table(recording)
    if size is not None:
        channels.append(of_rate(recording, "gyroscope", size, recording.valid))
    found = _compare(recording, channels, limits)
    if vector is not None and recording.table_attitude is not None:
        _check_directions(recording, recording.table_attitude, vector, limits)
    return found


def _compare(recording: Recording, channels: Sequence[Channel], limits: Limits) -> tuple[list[Note], Delay | None]:
    """Compare each channel of the table's log with all others."""
    if len([c for c in channels if c.name != "gravity"]) < 2:
        return [], None
    delay = delay_of(recording, channels, limits)
    late = abs(delay.nearest(0.0)) if delay else 0.0
    if late > limits.late_s:  # a clock that runs off: what it adds is about the same all through the recording
        limits = replace(limits, late_s=late + limits.late_s)
    notes = []
    for gross, note in filter(None, map(Comparison(recording, channels, limits).find, channels)):
        if gross:
            hint = "correct or leave out these rows of the table's log, or record again"
            raise refusal(recording, "reference_contradiction", note.detail, hint)
        notes.append(note)
    return notes, delay


def _check_directions(recording: Recording, attitude: Array, vector: Array, limits: Limits) -> None:
    """Refuse an attitude whose rotation has another direction in the body than the gyroscope's."""
    turned = spin(attitude) / np.diff(recording.time)[:, None]
    seen = 0.5 * (vector[1:] + vector[:-1])
    off, size = np.linalg.norm(turned - seen, axis=1), np.linalg.norm(seen, axis=1)
    change = np.linalg.norm(np.diff(vector, axis=0), axis=1) / recording.interval
    allowed = (limits.gain + limits.rate) * size + limits.late_s * change + limits.offset_dps
    usual_off, usual_size = float(np.median(off)), float(np.median(size))
    if usual_off > float(np.median(allowed)) + 0.5 * usual_size:
        raise refusal(
            recording,
            "reference_contradiction",
            f"{limits.column(recording, 'table_attitude')} turns about other body axes than the gyroscope reads: their "
            f"angular rates differ by {usual_off:.3g} deg/s at the median, at {usual_size:.3g} deg/s",
            "is it the attitude of this recording, from body to level, in the order w, x, y, z?",
        )
