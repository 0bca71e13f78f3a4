"""Bring each turn to the convention of angles: compare the mounting by gravity with the stated one, and apply it.

Turn axis, upward face, sense and zero are applied to the table's angle and rate, so that everything after ingest works
with the convention (``pipeline.checks.bench``). If gravity determines them and they differ from the stated ones
(the zero by more than ``procedure.mounting_tolerance_deg``), those by gravity are applied, with the note ``N-FOUND``. A
difference that only the gyroscope shows, or a turn axis that is not near a body axis, is refused.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import fmean

import numpy as np

from pipeline.checks.bench import (
    UP_AT_QUARTER_TURN,
    TurnMounting,
    as_map,
    bench_of,
    by_convention,
    check_frames,
    check_frames_by_hand,
    fit_turn,
    found_bench,
    nearest_axis,
    nearest_permutation,
    off_at_rest,
    off_axis_deg,
    signed_permutations,
    stated_bench,
    usual_up,
)
from pipeline.checks.seats import TurnRecording, refined_zeros, seat_notes
from pipeline.core.errors import IngestError
from pipeline.core.records import AXES, STRAIGHT, Note, Recording, Values, axis_maps, axis_matrix, level_in_body
from pipeline.core.settings import Procedure, Sensor, Settings, Table
from pipeline.physics.kinematics import UP_AT_ZERO

TOLERANCE_DEG = 5.0  # default of procedure.mounting_tolerance_deg: beyond misalignments and seats of a careful bench
TIME_OFFSET_S = 0.04  # largest plausible one where the sensor's config states none: as in configs/sensor/*.yaml
AGREES_G = 0.7  # of 1 g, within 45 deg of the axis
BIAS_DEG = 6.0  # error of the zero by a bias of 0.1 g where all rests are at one angle
UNLIKE = 0.5  # gain of the stated axis over the largest one, below which the unit turned about another axis


@dataclass(frozen=True)
class _Departure:
    """A difference between the mounting of a turn and the stated one."""

    turn: TurnRecording
    code: str  # of the refusal
    problem: str
    settings: dict[str, str]  # that describe the mounting, by the key below the recording's entry in the procedure
    bench: TurnMounting | None = None  # the mounting by gravity, which is applied; None: the turn is refused


def check_mounting(recordings: Sequence[Recording], settings: Settings) -> list[Recording]:
    """Return the recordings of a unit, in body axes, with the table's angle and rate by the convention.

    ``IngestError``: a mounting differs from the stated one, or accelerometer and gyroscope contradict each other.
    """
    table, sensor = settings.table, settings.sensor
    seated = table.seat_deg is not None
    tolerance = settings.procedure.mounting_tolerance_deg + 3.0 * (table.seat_deg or 0.0)
    turns = _turns(recordings, settings.procedure, table, sensor, tolerance)
    maps, accelerometer = axis_maps(sensor), _accelerometer_axes(turns)
    check_frames([(t.recording, t.fit) for t in turns], accelerometer, maps)
    for recording in recordings:
        if recording.role == "rests":
            check_frames_by_hand(recording, maps)
    # Two cross-axis sensitivities at their limit lean a turn axis in the sensor's own axes.
    lean = tolerance + float(np.degrees(np.arctan(np.sqrt(2.0) * sensor.accelerometer.cross_axis)))
    departures = {t.name: d for t in turns if (d := _departure(t, tolerance, lean)) is not None}
    if not departures:
        doubts = seat_notes(turns, table, sensor)
        conventional = {t.name: _applied(t, doubts.get(t.name), "") for t in turns}
        return [conventional.get(r.name, r) for r in recordings]

    refused = [d for d in departures.values() if d.bench is None]
    found = [replace(t, found=departures[t.name].bench) if t.name in departures else t for t in turns]
    mapped = any(axes != STRAIGHT for axes in maps.values())
    exchanged = any(d.code in {"wrong_axis", "wrong_face"} for d in departures.values())
    if _negated(found, tolerance) or (mapped and exchanged):  # a stated axis map may be wrong
        refused = list(departures.values())
    zeros = refined_zeros(found)
    ways = _ways(refused or list(departures.values()), len(turns), zeros, accelerometer, maps, seated=seated)
    hint = _hint(ways)
    if refused:
        first, *others = refused
        also = f"; likewise refused: {', '.join(d.turn.name for d in others)}" if others else ""
        file = first.turn.recording.source.get("file")
        raise IngestError(first.problem + also, file, code=first.code, hint=hint)
    if seated:  # a zero within the tolerance is a part of the turn's mounting
        near = [t for t in found if t.found is not None and abs(t.found.zero_deg - t.stated.zero_deg) <= tolerance]
        zeros = {t.name: t.stated.zero_deg for t in near}
    used, details = [], {}
    for turn in turns:
        departure = departures.get(turn.name)
        if departure is not None and departure.bench is not None:
            bench = replace(departure.bench, zero_deg=zeros.get(turn.name, departure.bench.zero_deg))
            details[turn.name] = f"{departure.problem}; {hint}; used as found"
            turn = replace(turn, recording=replace(turn.recording, axis=bench.axis), stated=bench)  # noqa: PLW2901
        used.append(turn)
    doubts = seat_notes(used, table, sensor)
    conventional = {t.name: _applied(t, doubts.get(t.name), details.get(t.name, ""), ways) for t in used}
    return [conventional[r.name] if r.name in conventional else _turned_attitude(r) for r in recordings]


def _turns(
    recordings: Sequence[Recording], procedure: Procedure, table: Table, sensor: Sensor, tolerance: float
) -> list[TurnRecording]:
    # Largest plausible time offset, which adds to the zero of turns in one direction.
    offset_s = sensor.accelerometer.effects.get("time_offset", TIME_OFFSET_S)
    # Three relative standard deviations of what a table without encoders loses, over half of the arc.
    lost = 1.5 * table.rate_accuracy if table.motion == "commanded" else 0.0
    turns = []
    for r in recordings:
        if r.axis is not None and not (r.table_angle is None and r.table_rate is None):
            stated, fit = stated_bench(procedure.recordings.get(r.name), table, r.axis), fit_turn(r)
            of_zero = tolerance + offset_s * abs(fit.mean_rate) + lost * fit.arc
            found, own = found_bench(fit, r.axis), r.name in procedure.recordings
            turns.append(TurnRecording(r, stated, fit, found, own, of_zero))
    return turns


def _accelerometer_axes(turns: Sequence[TurnRecording]) -> Values | None:
    """Return M_a, the signed permutation from the stated faces to the accelerometer's readings; None without one."""
    total, count = np.zeros((3, 3)), np.zeros(3)
    pairs = []
    for turn in turns:
        gravity = by_convention(turn.fit, turn.stated)
        if gravity is None:
            continue
        a = AXES.index(turn.stated.axis)
        for reading, true in ((gravity.cosine, UP_AT_ZERO[a]), (gravity.sine, UP_AT_QUARTER_TURN[a])):
            total += np.outer(reading, true)
            count += np.abs(true)
            pairs.append((reading, true))
    nearest = nearest_permutation(total / count) if np.all(count) else None
    if nearest is None or any(reading @ (nearest @ true) < AGREES_G for reading, true in pairs):
        return None
    return nearest


def _ways(
    departures: Sequence[_Departure],
    turns: int,
    zeros: Mapping[str, float],
    accelerometer: Values | None,
    maps: Mapping[str, Sequence[str]],
    *,
    seated: bool,
) -> tuple[tuple[str, ...], ...]:
    """Return the settings that describe the mounting, and the axis map with which it is as stated: one or the other.

    ``seated``: each turn has a separate mounting, which includes the difference of its zero from the common one.
    """
    found = [
        d.settings | {k: f"{zeros[d.turn.name]:.2f}" for k in d.settings if k == "zero_deg" and d.turn.name in zeros}
        for d in departures
    ]
    stated_zeros = [float(f["zero_deg"]) for f in found if "zero_deg" in f]
    if seated and len(stated_zeros) == turns and max(stated_zeros) - min(stated_zeros) < TOLERANCE_DEG:
        found = [f | {"zero_deg": f"{fmean(stated_zeros):.1f}"} for f in found]
    alike = len(departures) == turns > 1 and all(f == found[0] for f in found)
    ways = []
    if alike and found[0] and set(found[0]) <= {"sense", "zero_deg"}:
        ways.append(tuple(f"table.{k}={v}" for k, v in found[0].items()))
    elif all(d.turn.configurable for d in departures) and any(found):
        named = [(d.turn.name, *item) for d, f in zip(departures, found, strict=True) for item in f.items()]
        ways.append(tuple(f"procedure.recordings.{name}.{k}={v}" for name, k, v in named))
    if accelerometer is not None and not np.array_equal(accelerometer, np.eye(3)):
        key = "sensor.accelerometer.axis_map" if np.linalg.det(accelerometer) < 0.0 else "sensor.axis_map"
        ways.append((f"{key}={as_map(accelerometer.T @ axis_matrix(maps['accelerometer']))}",))
    return tuple(ways)


def _hint(ways: Sequence[Sequence[str]]) -> str:
    if not ways:
        return "mount the unit as docs/mounting.md says, or correct the columns and sensor.axis_map"
    settings = ", or ".join(map(", ".join, ways))
    return f"if the bench is so, set {settings} (docs/mounting.md); else correct the columns or the mounting"


def _turned_attitude(recording: Recording) -> Recording:
    """Return held-out motion whose logged attitude, that of the stated axes, is turned to the axes of the unit.

    The unit's attitude is ``R(q) F``. F is the rotation by multiples of 90 deg with which the predicted specific force
    is nearest to the accelerometer's.
    """
    q, force = recording.table_attitude, recording.accelerometer
    if q is None or force is None or not recording.valid.any():
        return recording
    products = level_in_body(q)[recording.valid].T @ force[recording.valid]
    rotations = [F for F in signed_permutations() if np.linalg.det(F) > 0.0]
    F = max(rotations, key=lambda rotation: float(np.sum(rotation * products)))
    if np.array_equal(F, np.eye(3)):
        return recording
    from scipy.spatial.transform import Rotation  # noqa: PLC0415  (0.1 s that only remounted units pay)

    attitude = (Rotation.from_quat(q, scalar_first=True) * Rotation.from_matrix(F)).as_quat(scalar_first=True)
    names = ", ".join(nearest_axis(row) for row in F)
    detail = f"the attitude is turned to the axes of the unit: the table's x, y and z are body {names}"
    note = Note("N-FOUND", recording.samples, 0, 0, detail)
    return replace(recording.noted(note), table_attitude=np.asarray(attitude, np.float64))


def _negated(turns: Sequence[TurnRecording], tolerance: float) -> bool:
    """Return whether each turn shows the opposite face at the stated zero, as with a negated accelerometer.

    A unit that is turned over shows the opposite sense about one or two of the three axes; with a negated accelerometer
    no turn shows it or, on a table that counts left-handed, all do.
    """
    found = [(t.found, t.stated) for t in turns if t.recording.role == "accelerometer"]
    opposite = bool(found) and all(
        f is not None
        and (f.axis, f.up[1]) == (s.axis, s.up[1])
        and f.up[0] != s.up[0]
        and abs(f.zero_deg - s.zero_deg) <= tolerance
        for f, s in found
    )
    return opposite and len({f.sense * s.sense for f, s in found if f is not None}) == 1


def _applied(
    turn: TurnRecording, doubt: Note | None, as_found: str, ways: tuple[tuple[str, ...], ...] = ()
) -> Recording:
    """Return the recording with angle and rate by the convention, with notes on that and its doubt.

    ``as_found``: the difference from the stated mounting and the hint; empty where the stated one is applied.
    """
    recording, bench = turn.recording, turn.stated
    angle, rate = recording.table_angle, recording.table_rate
    notes = [doubt] if doubt else []
    logged = angle is not None and recording.accelerometer is not None
    if turn.fit.unknown and logged and recording.role != "gyroscope":  # that needs neither face nor zero
        detail = f"upward face, turn axis and zero are taken as stated: {turn.fit.unknown}"
        notes.append(Note("N-MOUNTING", 1, 0, 0, detail))
    if bench.conventional and not as_found:
        return recording.noted(*notes) if notes else recording
    detail = f"{as_found or 'as stated'}, {words(bench)}:"
    detail += f" the angle used is {bench.sense:+d} times the logged one, {bench.offset:+.6g} deg"
    if bench.vertical:
        detail = f"as stated, body {bench.up} always points up; the angle used is {bench.sense:+d} times the logged one"
    code, settings = ("N-FOUND", ways) if as_found else ("N-MOUNTING", ())
    notes.append(Note(code, recording.samples, 0, 0, detail, settings=settings))
    angle = None if angle is None else bench.sense * angle + bench.offset
    rate, up = None if rate is None else bench.sense * rate, bench.up if bench.vertical else ""
    return replace(recording.noted(*notes), up=up, sense=bench.sense, table_angle=angle, table_rate=rate)


def words(bench: TurnMounting) -> str:
    """Return a mounting in words."""
    hand = "right" if bench.sense > 0 else "left"
    text = f"body {bench.up} up at a table angle of {bench.zero_deg:.1f} deg"
    return f"{text}, the angle counted {hand}-handed about {bench.axis}"


def _departure(turn: TurnRecording, tolerance: float, lean: float) -> _Departure | None:
    """Return the difference of a turn; ``lean``: deg, most by which the readings may show its axis off a body axis."""
    if turn.fit.vertical is not None or turn.stated.vertical:
        return _vertical(turn) or _gyroscope_sense(turn)
    return _axis(turn, tolerance, lean) or (
        _gyroscope_sense(turn) if turn.found is None else _face(turn, turn.found, tolerance)
    )


def _axis(turn: TurnRecording, tolerance: float, lean: float) -> _Departure | None:
    axis, fit, name = turn.stated.axis, turn.fit, turn.name
    direction = fit.turn_axis if fit.turn_axis is not None else fit.gain
    if direction is None:
        return None
    nearest, off = nearest_axis(direction), off_axis_deg(direction)
    if nearest[1] != axis and abs(direction[AXES.index(axis)]) < UNLIKE * np.max(np.abs(direction)):
        who = "gravity turns" if fit.turn_axis is not None else "the gyroscope turns"
        listed = ", ".join(f"{b} {g:+.3g}" for b, g in zip(AXES, direction, strict=True))
        problem = f"in {name} the table is said to turn about {axis}, and {who} about {nearest[1]} ({listed})"
        bench = found_bench(fit, nearest[1]) if off <= tolerance else None
        renamed = replace(turn.stated, axis=nearest[1], up=usual_up(nearest[1]))
        settings = {} if bench is None else _differing(bench, renamed, tolerance)
        return _Departure(turn, "wrong_axis", problem, {"axis": nearest[1], **settings}, bench)
    if fit.turn_axis is not None and off > lean:
        problem = f"in {name} gravity turns about an axis that is {off:.1f} deg off body {axis}; {lean:.3g} deg are"
        problem += " allowed (procedure.mounting_tolerance_deg and what sensor.accelerometer.cross_axis leans)"
        return _Departure(turn, "wrong_axis", problem, {})
    return None


def _gyroscope_sense(turn: TurnRecording) -> _Departure | None:
    axis, gain = turn.stated.axis, turn.fit.gain
    if gain is None or gain[AXES.index(axis)] * turn.stated.sense > 0.0:
        return None
    problem = f"in {turn.name} the readings about {axis} have the sign opposite to the table's rate"
    return _Departure(turn, "wrong_sense", problem, {"sense": str(-turn.stated.sense)})


def _face(turn: TurnRecording, found: TurnMounting, tolerance: float) -> _Departure | None:
    stated, allowed = turn.stated, turn.tolerance_deg
    off = (found.offset - stated.offset + 180.0) % 360.0 - 180.0
    if found.sense == stated.sense:
        if turn.recording.role == "gyroscope":  # it needs no zero, and in fast turns a clock's error adds to the zero
            at_rest = off_at_rest(turn.recording, stated)
            allowed += BIAS_DEG
            found = found if abs(off) > allowed else bench_of(stated.axis, stated.sense, stated.offset + at_rest)
            off = at_rest
        if abs(off) <= allowed:
            return None
    code = "wrong_sense" if found.sense != stated.sense else "wrong_face" if found.up != stated.up else "wrong_zero"
    problem = f"{turn.name} is mounted otherwise than stated,"
    problem += f" by more than {allowed:.2g} deg (procedure.mounting_tolerance_deg); stated is {words(stated)}"
    return _Departure(turn, code, problem, _differing(found, stated, tolerance), found)


def _differing(found: TurnMounting, stated: TurnMounting, tolerance: float) -> dict[str, str]:
    """Return the settings by which the mounting by gravity differs from the stated one."""
    settings = {} if found.up == stated.up else {"up": found.up}
    settings |= {} if found.sense == stated.sense else {"sense": f"{found.sense}"}
    off = abs(found.zero_deg - stated.zero_deg) > tolerance
    return settings | ({"zero_deg": f"{found.zero_deg:.1f}"} if off else {})


def _vertical(turn: TurnRecording) -> _Departure | None:
    """Return the difference of a turn whose axis is vertical or stated to be vertical."""
    stated, fit, name = turn.stated, turn.fit, turn.name
    if fit.gravity is None:
        return None
    if fit.vertical is None:
        problem = f"in {name} the turn axis is stated to be vertical ({stated.up} up), but gravity turns"
        return _Departure(turn, "wrong_face", problem, {"up": usual_up(stated.axis)})
    up = nearest_axis(fit.vertical)
    if up[1] != stated.axis:
        problem = f"in {name} the table is said to turn about {stated.axis}, but gravity stays along body {up}"
        return _Departure(turn, "wrong_axis", problem, {"axis": up[1], "up": up})
    if up != stated.up:
        problem = f"in {name} gravity stays along body {up} while the table turns:"
        problem += f" the turn axis is vertical, and {stated.up} is stated to point up"
        return _Departure(turn, "wrong_face", problem, {"up": up})
    if turn.recording.role == "accelerometer":
        problem = f"{name} is for the accelerometer, and about a vertical axis gravity does not turn"
        return _Departure(turn, "wrong_face", problem, {})
    return None
