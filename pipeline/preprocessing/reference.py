"""Whether the reference contradicts itself or the sensor: table angle, rate, attitude, gravity, gyroscope and time.

First the scales (``pipeline.preprocessing.reference_scale``), then delays, then single samples and stretches
(``pipeline.preprocessing.reference_rows``). The gyroscope's gain and bias for this are those of the unit's turns
(``pipeline.preprocessing.evidence``), where they agree. What no effect of the catalogue explains within its configured
limit is refused; what exceeds noise and the table's stated accuracy but not these limits gets the note ``N-REFERENCE``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.preprocessing.evidence import (
    Limits,
    alike,
    axis_index,
    column,
    gravity_turned,
    of_angle,
    of_attitude,
    of_gravity,
    of_rate,
    place,
    quantiles,
    rate_of_turn,
    refusal,
    slope_of,
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
    from pipeline.preprocessing.reference_rows import Contradiction
    from pipeline.records import Recording

    Array = NDArray[np.float64]

FEWEST = 32  # samples, two short stretches
MANY = 20  # samples, more than a spike or a jump concerns
HALF = 0.5  # of the usual gain, which the axis turned about shows at least
SAME = 0.1  # relative: gains of two turns that are of one gyroscope


def check_turns(
    recordings: Sequence[Recording], settings: Mapping[str, Any]
) -> tuple[list[Recording], dict[str, Delay]]:
    """Return the recordings with notes on the reference of their turns, and how late the sensor is in each.

    Signs and directions do not count: this goes before the mounting, which wrong units would hide.

    Parameters
    ----------
    recordings : sequence of Recording
        All of a unit.
    settings : mapping
        Sections ``sensor``, ``table`` and ``ingest``.

    Raises
    ------
    IngestError
        If channels of a turn contradict each other beyond what an effect of the catalogue explains.
    """
    limits = Limits.of(settings)
    turns = _turns(recordings)
    for recording in turns:
        check_scale_of_turn(recording, limits, settings)
    check_intervals([r for r in recordings if r.samples >= FEWEST], settings)
    gyroscope = Gyroscope(turns)
    found = {r.name: _check_turn(r, gyroscope, limits, settings) for r in turns}
    delays = {name: f.delay for name, f in found.items() if f.delay is not None}
    return _with_notes(recordings, found), delays


def _turns(recordings: Sequence[Recording]) -> list[Recording]:
    logged = [r for r in recordings if r.samples >= FEWEST and r.role != "static"]
    return [r for r in logged if r.axis is not None and rate_of_turn(r) is not None]


def check_motion(
    recordings: Sequence[Recording], delays: Mapping[str, Delay], settings: Mapping[str, Any]
) -> list[Recording]:
    """Return the recordings with notes on the reference of held-out motion.

    Parameters
    ----------
    recordings : sequence of Recording
        All of a unit, their turns as they are mounted.
    delays : mapping of str to Delay
        Of the turns.
    settings : mapping
        Sections ``sensor``, ``table`` and ``ingest``.

    Raises
    ------
    IngestError
        If its channels contradict each other, or a recording is late otherwise than all others.
    """
    limits = Limits.of(settings)
    gyroscope = Gyroscope(_turns(recordings))
    moved = [r for r in recordings if r.samples >= FEWEST and r.role != "static" and r.axis is None]
    moved = [r for r in moved if not (r.table_rate is None and r.table_attitude is None)]
    found = {r.name: _check_motion(r, gyroscope, limits, settings) for r in moved}
    late = {**delays, **{name: f.delay for name, f in found.items() if f.delay is not None}}
    check_delays([(r, late[r.name]) for r in recordings if r.name in late], limits)
    return _with_notes(recordings, found)


@dataclass(frozen=True)
class Found:
    """What was found on one recording: notes, and how late its sensor is; None where it does not tell."""

    notes: tuple[Note, ...] = ()
    delay: Delay | None = None


class Gyroscope:
    """Gain matrix and bias of a gyroscope, roughly, by the turns of a unit."""

    def __init__(self, turns: Sequence[Recording]) -> None:
        found: dict[int, list[tuple[float, Array, Array]]] = {0: [], 1: [], 2: []}
        for recording in turns:
            rate, axis = rate_of_turn(recording), axis_index(recording)
            if rate is None or recording.gyroscope is None:
                continue
            fits = _slopes(recording, rate)
            known = [f for f in fits if f is not None]
            if len(known) == 3:
                gain, bias = np.array(known).T
                found[axis].append((float(quantiles(np.abs(rate), 0.9)[0]), gain, bias))
        gains = [abs(gain[a]) for a, turned in found.items() for _, gain, _ in turned]
        self.usual = float(np.median(np.array(gains))) if len(gains) > 2 else 1.0
        self.matrix = self.usual * np.eye(3)
        for axis, turned in found.items():
            fitting = [f for f in turned if abs(abs(f[1][axis]) / self.usual - 1.0) <= SAME]
            if fitting:
                self.matrix[:, axis] = max(fitting, key=lambda f: f[0])[1]
        biases = [bias for turned in found.values() for _, _, bias in turned]
        self.bias = np.median(biases, axis=0) if biases else None

    def along(self, recording: Recording, axis: int) -> Array | None:
        """Return the rate about a turn axis: (n,) array, deg/s; its bias is that of this recording."""
        rate = rate_of_turn(recording)
        if recording.gyroscope is None or rate is None:
            return None
        fits = _slopes(recording, rate)
        gains = [0.0 if f is None else abs(f[0]) / self.usual for f in fits]
        fit = fits[axis]
        if fit is not None and abs(gains[axis] - 1.0) <= SAME:
            return np.asarray((recording.gyroscope[:, axis] - fit[1]) / fit[0])
        if max(gains) > HALF > gains[axis]:
            return None  # another axis turns: a matter of the mounting
        gain = self.matrix[axis, axis]
        bias = np.median(recording.gyroscope[:, axis] - gain * rate) if self.bias is None else self.bias[axis]
        return np.asarray((recording.gyroscope[:, axis] - float(bias)) / gain)

    def vector(self, recording: Recording) -> Array | None:
        """Return the angular rate: (n, 3) array, deg/s; None where no turn tells the bias."""
        if recording.gyroscope is None or self.bias is None:
            return None
        return np.asarray(np.linalg.solve(self.matrix, (recording.gyroscope - self.bias).T).T)


def _slopes(recording: Recording, rate: Array) -> list[tuple[float, float] | None]:
    """Return gain and bias of each axis of a turn's gyroscope against the table's rate; kept with the recording."""
    assert recording.gyroscope is not None  # noqa: S101
    if "slopes" not in recording.cache:
        recording.cache["slopes"] = [slope_of(recording.gyroscope[:, i], rate) for i in range(3)]
    found: list[tuple[float, float] | None] = recording.cache["slopes"]
    return found


def _with_notes(recordings: Sequence[Recording], found: Mapping[str, Found]) -> list[Recording]:
    notes = {name: f.notes for name, f in found.items() if f.notes}
    return [replace(r, notes=(*r.notes, *notes[r.name])) if r.name in notes else r for r in recordings]


def _check_turn(recording: Recording, gyroscope: Gyroscope, limits: Limits, settings: Mapping[str, Any]) -> Found:
    channels: list[Channel] = []
    if recording.table_rate is not None:
        channels.append(of_rate(recording, "table_rate", recording.table_rate))
    if recording.table_angle is not None:
        angle = of_angle(recording, recording.table_angle)
        channels.append(alike(angle, channels[0]) if channels else angle)
    seen = gyroscope.along(recording, axis_index(recording))
    if seen is not None:
        channels.append(of_rate(recording, "gyroscope", seen, recording.valid))
    phase = gravity_turned(recording, axis_index(recording))
    if phase is not None and recording.table_angle is not None:
        channels.append(of_gravity(recording, phase, channels))
    found = _compare(recording, channels, limits, settings)
    doubt = doubt_of_scale(recording, limits, settings)
    if doubt is None:
        return found
    ends = float(recording.time[0]), float(recording.time[-1])
    note = Note("N-REFERENCE", recording.samples, 0, 0, doubt[1], *ends)
    return replace(found, notes=(*found.notes, note))


def _check_motion(recording: Recording, gyroscope: Gyroscope, limits: Limits, settings: Mapping[str, Any]) -> Found:
    vector = gyroscope.vector(recording)
    size = None if vector is None else np.linalg.norm(vector, axis=1)
    check_scale_of_motion(recording, size, limits, settings)
    channels: list[Channel] = []
    if recording.table_rate is not None:
        channels.append(of_rate(recording, "table_rate", np.abs(recording.table_rate)))
    if recording.table_attitude is not None:
        channels.append(of_attitude(recording, recording.table_attitude))
    if size is not None:
        channels.append(of_rate(recording, "gyroscope", size, recording.valid))
    found = _compare(recording, channels, limits, settings)
    if vector is not None and recording.table_attitude is not None:
        _check_directions(recording, vector, limits, settings)
    return found


def _compare(recording: Recording, channels: Sequence[Channel], limits: Limits, settings: Mapping[str, Any]) -> Found:
    """Compare each channel of the table's log with all others."""
    if len([c for c in channels if c.name != "gravity"]) < 2:
        return Found()
    delay = delay_of(recording, channels, limits, settings)
    late = abs(delay.nearest(0.0)) if delay else 0.0
    if late > limits.late_s:  # a clock that runs off: what it adds is about the same all through the recording
        limits = replace(limits, late_s=late + limits.late_s)
    comparison = Comparison(channels, np.diff(recording.time), limits)
    notes = []
    for found in filter(None, map(comparison.find, channels)):
        message = _told(recording, found, settings)
        if found.gross:
            raise refusal(
                recording,
                "reference_contradiction",
                message,
                "correct or leave out these rows of the table's log, or record again",
            )
        notes.append(_note(recording, found, message))
    return Found(tuple(notes), delay)


def _told(recording: Recording, found: Contradiction, settings: Mapping[str, Any]) -> str:
    claim = found.claim
    name = column(recording, claim.name, settings)
    names = " and ".join(column(recording, o.name, settings) for o in found.others)
    where = place(recording, found.first, found.last)
    part = getattr(recording, claim.name)[found.first : found.last + 1]
    if found.stretch:
        stays = " stays the same and" if len(part) and np.all(part == part[0]) else ""
        return (
            f"{name}{stays} contradicts {names} in {where}: it turns by {found.claimed:.4g} deg and they by "
            f"{found.seen:.4g} deg in one of {found.count} such stretches"
        )
    looks = "it looks like a spike or a jump"
    if found.count > MANY:
        looks = "does it follow this motion, or is it frozen, reversed in time, or of another recording?"
    what = "turns at" if claim.of_intervals else "is"
    return (
        f"{name} {what} {found.claimed:.4g} deg/s in {where}, while {names} show {found.seen:.4g} deg/s "
        f"({found.count} such {'place' if found.count == 1 else 'places'}): {looks}"
    )


def _note(recording: Recording, found: Contradiction, message: str) -> Note:
    t = recording.time
    return Note("N-REFERENCE", found.count, 0, 0, message, float(t[found.first]), float(t[found.last]))


def _check_directions(recording: Recording, vector: Array, limits: Limits, settings: Mapping[str, Any]) -> None:
    """Refuse an attitude whose rotation has another direction in the body than the gyroscope's."""
    assert recording.table_attitude is not None  # noqa: S101
    turned = spin(recording.table_attitude) / np.diff(recording.time)[:, None]
    seen = 0.5 * (vector[1:] + vector[:-1])
    off, size = np.linalg.norm(turned - seen, axis=1), np.linalg.norm(seen, axis=1)
    change = np.linalg.norm(np.diff(vector, axis=0), axis=1) / recording.interval
    allowed = (limits.gain + limits.rate) * size + limits.late_s * change + limits.offset_dps
    usual_off, usual_size = float(np.median(off)), float(np.median(size))
    if usual_off <= float(np.median(allowed)) + 0.5 * usual_size:
        return
    raise refusal(
        recording,
        "reference_contradiction",
        f"{column(recording, 'table_attitude', settings)} turns about other body axes than the gyroscope reads: their "
        f"angular rates differ by {usual_off:.3g} deg/s at the median, at {usual_size:.3g} deg/s",
        "is it the attitude of this recording, from body to level, in the order w, x, y, z?",
    )
