"""The mounting of the unit in each turn: found, compared with what is stated, and brought into the convention.

Turn axis, upward face, sense and zero are applied to the table's angle and rate, so that everything after ingest works
with the convention (``pipeline.preprocessing.bench``). Where gravity determines them and they differ from what is
stated (the zero by more than ``procedure.mounting_tolerance_deg``), those that are found are applied, with the note
``N-FOUND``. What the gyroscope alone shows, or what is not near a body axis, is refused.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from statistics import fmean
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import IngestError
from pipeline.io.channel_table import STRAIGHT, axis_maps, axis_matrix
from pipeline.model.kinematics import UP_AT_ZERO
from pipeline.preprocessing.bench import (
    ACROSS,
    bench_of,
    by_convention,
    fit_turn,
    found_bench,
    nearest_axis,
    off_at_rest,
    off_axis_deg,
    stated_bench,
    usual_up,
)
from pipeline.preprocessing.frames import (
    as_map,
    check_frames,
    check_frames_by_hand,
    nearest_permutation,
    signed_permutations,
)
from pipeline.preprocessing.seats import refined_zeros, seat_notes
from pipeline.records import AXES, Note, level_in_body

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.preprocessing.bench import Bench, TurnFit
    from pipeline.records import Recording, Values

TOLERANCE_DEG = 5.0  # default of procedure.mounting_tolerance_deg: beyond misalignments and seats of a careful bench
TIME_OFFSET_S = 0.04  # largest plausible one where the sensor's config states none: as in configs/sensor/*.yaml
AGREES_G = 0.7  # of 1 g, within 45 deg of the axis
BIAS_DEG = 6.0  # zero that a bias of 0.1 g feigns where all rests are at one angle
UNLIKE = 0.5  # gain of the stated axis over that of another one, below which the other one turned


def check_mounting(recordings: Sequence[Recording], settings: Mapping[str, Any]) -> list[Recording]:
    """Return the recordings of a unit, in body axes, with the table's angle and rate by the convention.

    ``settings``: sections ``procedure``, ``table`` and ``sensor``. ``IngestError``: a turn is mounted otherwise
    than stated, or accelerometer and gyroscope contradict each other.
    """
    procedure, table, sensor = (settings.get(key) or {} for key in ("procedure", "table", "sensor"))
    turns = [_turn(r, procedure.get("recordings") or {}, table) for r in recordings]
    known = [t for t in turns if t is not None]
    maps, accelerometer = axis_maps(sensor), _accelerometer_axes(known)
    check_frames([(t.recording, t.fit) for t in known], accelerometer, maps)
    for recording in recordings:
        if recording.role == "rests":
            check_frames_by_hand(recording, maps)
    effects = (sensor.get("accelerometer") or {}).get("effects") or {}
    tolerance = _Tolerance(
        float(procedure.get("mounting_tolerance_deg") or TOLERANCE_DEG) + 3.0 * float(table.get("seat_deg") or 0.0),
        float(effects.get("time_offset") or TIME_OFFSET_S),
        float(table.get("rate_accuracy") or 0.0) if table.get("motion") == "commanded" else 0.0,
    )
    departures = {t.name: d for t in known if (d := _departure(t, tolerance)) is not None}
    refused = [d for d in departures.values() if d.bench is None]
    found = [replace(t, found=departures[t.name].bench) if t.name in departures else t for t in known]
    mapped = any(axes != STRAIGHT for axes in maps.values())
    turned = any(d.code in {"wrong_axis", "wrong_face"} for d in departures.values())
    if _negated(found, tolerance.angle_deg) or (mapped and turned):  # an axis map that is stated may be wrong
        refused = list(departures.values())
    zeros = refined_zeros(found) if departures else {}
    seated = table.get("seat_deg") is not None
    hint = (
        _hint(refused or list(departures.values()), len(known), zeros, accelerometer, maps, seated=seated)
        if departures
        else ""
    )
    if refused:
        first, *others = refused
        also = f"; likewise refused: {', '.join(d.turn.name for d in others)}" if others else ""
        file = first.turn.recording.source.get("file")
        raise IngestError(first.problem + also, file, code=first.code, hint=hint)
    stated = {t.name: t.stated.zero_deg for t in found if tolerance.same_zero(t)}  # the rest is the mounting's
    applied = stated if seated else zeros
    used = {t.name: _as_found(t, departures.get(t.name), applied) for t in known}
    recordings = [_turned_attitude(r) if departures else r for r in recordings]
    doubts = seat_notes(list(used.values()), table, sensor) if table.get("seat_deg") is None else {}
    return [
        r if t is None else _applied(used[t.name], doubts.get(r.name), departures.get(t.name), hint)
        for r, t in zip(recordings, turns, strict=True)
    ]


def _turn(recording: Recording, entries: Mapping[str, Any], table: Mapping[str, Any]) -> Turn | None:
    if recording.axis is None or (recording.table_angle is None and recording.table_rate is None):
        return None
    stated = stated_bench(entries.get(recording.name) or {}, table, recording.axis)
    fit = fit_turn(recording)
    return Turn(recording, stated, fit, found_bench(fit, recording.axis), recording.name in entries)


def _accelerometer_axes(turns: Sequence[Turn]) -> Values | None:
    """Return the signed permutation that takes the stated faces to what the accelerometer reads, if one does."""
    total, count = np.zeros((3, 3)), np.zeros(3)
    seen = []
    for turn in turns:
        gravity = by_convention(turn.fit, turn.stated)
        if gravity is None:
            continue
        a = AXES.index(turn.stated.axis)
        for reading, true in ((gravity.cosine, UP_AT_ZERO[a]), (gravity.sine, ACROSS[a])):
            total += np.outer(reading, true)
            count += np.abs(true)
            seen.append((reading, true))
    found = nearest_permutation(total / count) if np.all(count) else None
    if found is None or any(reading @ (found @ true) < AGREES_G for reading, true in seen):
        return None
    return found


def _hint(
    departures: Sequence[_Departure],
    turns: int,
    zeros: Mapping[str, float],
    accelerometer: Values | None,
    maps: Mapping[str, Sequence[str]],
    *,
    seated: bool,
) -> str:
    """Return the settings that describe the bench as it is found, or the axis map under which it is as stated.

    ``seated``: each turn has a mounting of its own, which contains what its zero differs from a common one.
    """
    found = [
        d.settings | {k: f"{zeros[d.turn.name]:.2f}" for k in d.settings if k == "zero_deg" and d.turn.name in zeros}
        for d in departures
    ]
    own = [float(f["zero_deg"]) for f in found if "zero_deg" in f]
    if seated and len(own) == turns and max(own) - min(own) < TOLERANCE_DEG:
        found = [f | {"zero_deg": f"{fmean(own):.1f}"} for f in found]
    alike = len(departures) == turns > 1 and all(f == found[0] for f in found)
    ways = []
    if alike and found[0] and set(found[0]) <= {"sense", "zero_deg"}:
        ways.append(", ".join(f"table.{k}={v}" for k, v in found[0].items()))
    elif all(d.turn.configurable for d in departures) and any(found):
        ways.append(
            ", ".join(
                f"procedure.recordings.{d.turn.name}.{k}={v}"
                for d, settings in zip(departures, found, strict=True)
                for k, v in settings.items()
            )
        )
    if accelerometer is not None and not np.array_equal(accelerometer, np.eye(3)):
        mirrored = np.linalg.det(accelerometer) < 0.0
        now = axis_matrix(maps["accelerometer"])
        key = "sensor.accelerometer.axis_map" if mirrored else "sensor.axis_map"
        ways.append(f"{key}={as_map(accelerometer.T @ now)}")
    if not ways:
        return "mount the unit as docs/mounting.md says, or correct the columns and sensor.axis_map"
    return f"if the bench is so, set {', or '.join(ways)} (docs/mounting.md); else correct the columns or the mounting"


def _turned_attitude(recording: Recording) -> Recording:
    """Return held-out motion whose attitude log is turned to the body axes that gravity shows.

    The table's attitude is that of the stated axes. ``R(q) F`` is that of the unit, with the rotation F by multiples of
    90 deg under which the predicted specific force is nearest to the accelerometer's.
    """
    q, force = recording.table_attitude, recording.accelerometer
    if q is None or force is None or not recording.valid.any():
        return recording
    predicted = level_in_body(q)[recording.valid]
    agreement = predicted.T @ force[recording.valid]
    turns = [F for F in signed_permutations() if np.linalg.det(F) > 0.0]
    F = max(turns, key=lambda turn: float(np.sum(turn * agreement)))
    if np.array_equal(F, np.eye(3)):
        return recording
    from scipy.spatial.transform import Rotation  # noqa: PLC0415  (0.1 s that only remounted units pay)

    about = Rotation.from_quat(q, scalar_first=True) * Rotation.from_matrix(F)
    names = [nearest_axis(row) for row in F]
    detail = f"the attitude is turned to the axes of the unit: the table's x, y and z are body {', '.join(names)}"
    note = Note("N-FOUND", recording.samples, 0, 0, detail)
    attitude = np.asarray(about.as_quat(scalar_first=True), np.float64)
    return replace(recording, table_attitude=attitude, notes=(*recording.notes, note))


def _negated(turns: Sequence[Turn], tolerance: float) -> bool:
    """Return whether each turn shows the opposite face at the stated zero: rather a negated accelerometer.

    A unit that is turned over shows the opposite sense about one axis or two of the three; a negated accelerometer
    shows none of them so, or, on a table that counts left-handed, all.
    """
    found = [(t.found, t.stated) for t in turns if t.recording.role == "accelerometer"]
    signs = {"+": "-", "-": "+"}
    opposite = bool(found) and all(
        f is not None
        and (f.axis, f.up) == (s.axis, signs[s.up[0]] + s.up[1])
        and abs(f.zero_deg - s.zero_deg) <= tolerance
        for f, s in found
    )
    return opposite and len({f.sense * s.sense for f, s in found if f is not None}) == 1


def _as_found(turn: Turn, departure: _Departure | None, zeros: Mapping[str, float]) -> Turn:
    """Return a turn with the mounting that is found instead of the stated one, its zero by all turns together."""
    if departure is None or departure.bench is None:
        return turn
    bench = replace(departure.bench, zero_deg=zeros.get(turn.name, departure.bench.zero_deg))
    return replace(turn, recording=replace(turn.recording, axis=bench.axis), stated=bench)


def _applied(turn: Turn, doubt: Note | None, departure: _Departure | None, hint: str) -> Recording:
    """Return the recording with angle and rate by the convention, a note where that changes them, and its doubt."""
    recording, bench = turn.recording, turn.stated
    notes = [*recording.notes, *([doubt] if doubt else [])]
    logged = recording.table_angle is not None and recording.accelerometer is not None
    if turn.fit.unknown and logged and recording.role != "gyroscope":  # that needs neither face nor zero
        detail = f"upward face, turn axis and zero are taken as stated: {turn.fit.unknown}"
        notes.append(Note("N-MOUNTING", 1, 0, 0, detail))
    if bench.conventional and departure is None:
        return replace(recording, notes=tuple(notes))
    angle, rate = recording.table_angle, recording.table_rate
    how = "as stated" if departure is None else f"{departure.problem}; {hint}; used as found"
    detail = f"{how}, {words(bench)}: the angle is taken {bench.sense:+d} times and {bench.offset:+.6g} deg"
    if bench.vertical:
        detail = f"as stated, body {bench.up} points up throughout; the angle is taken {bench.sense:+d} times"
    notes.append(Note("N-MOUNTING" if departure is None else "N-FOUND", recording.samples, 0, 0, detail))
    return replace(
        recording,
        up=bench.up if bench.vertical else "",
        sense=bench.sense,
        table_angle=None if angle is None else bench.sense * angle + bench.offset,
        table_rate=None if rate is None else bench.sense * rate,
        notes=tuple(notes),
    )


@dataclass(frozen=True)
class Turn:
    """A turn recording, what its configuration says and what its rows tell."""

    recording: Recording
    stated: Bench
    fit: TurnFit
    found: Bench | None  # None where gravity does not tell
    configurable: bool  # whether the procedure has an entry of the recording's name

    @property
    def name(self) -> str:
        """Name of the recording."""
        return self.recording.name


@dataclass(frozen=True)
class _Departure:
    """What is otherwise than stated."""

    turn: Turn
    code: str  # of the refusal
    problem: str
    settings: dict[str, str]  # what describes it, by the key below the recording's entry in the procedure
    bench: Bench | None = None  # the mounting by gravity, which is used; None: the turn is refused


@dataclass(frozen=True)
class _Tolerance:
    """What a turn may be off."""

    angle_deg: float  # of the zero and of the direction of the turn axis
    offset_s: float  # largest plausible time offset: in turns one way it is a part of the zero
    lost: float  # relative standard deviation of what a table without encoders loses; three of them, over half of it

    def same_zero(self, turn: Turn) -> bool:
        """Return whether the zero that is found may be the stated one."""
        return turn.found is not None and abs(turn.found.zero_deg - turn.stated.zero_deg) <= self.angle_deg

    def of_zero(self, fit: TurnFit) -> float:
        """Return how far the zero of a turn may be off, deg."""
        return self.angle_deg + self.offset_s * abs(fit.mean_rate) + 1.5 * self.lost * fit.arc


def _departure(turn: Turn, tolerance: _Tolerance) -> _Departure | None:
    """Return what is otherwise than stated, or None."""
    if turn.fit.vertical is not None or turn.stated.vertical:
        return _upright(turn) or _gyroscope_sense(turn)
    by_gravity = _gyroscope_sense(turn) if turn.found is None else _face(turn, turn.found, tolerance)
    return _axis(turn, tolerance.angle_deg) or by_gravity


def words(bench: Bench) -> str:
    """Return how a bench holds the unit, in words."""
    hand = "right" if bench.sense > 0 else "left"
    return (
        f"body {bench.up} up at a table angle of {bench.zero_deg:.1f} deg, the angle counted {hand}-handed about "
        f"{bench.axis}"
    )


def _axis(turn: Turn, tolerance: float) -> _Departure | None:
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
        as_before = replace(turn.stated, axis=nearest[1], up=usual_up(nearest[1]))
        more = {} if bench is None else _differing(bench, as_before, tolerance)
        return _Departure(turn, "wrong_axis", problem, {"axis": nearest[1], **more}, bench)
    if fit.turn_axis is not None and off > tolerance:
        problem = (
            f"in {name} gravity turns about an axis that is {off:.1f} deg off body {axis}; {tolerance:g} deg are "
            "allowed (procedure.mounting_tolerance_deg)"
        )
        return _Departure(turn, "wrong_axis", problem, {})
    return None


def _gyroscope_sense(turn: Turn) -> _Departure | None:
    axis, gain = turn.stated.axis, turn.fit.gain
    if gain is None or gain[AXES.index(axis)] * turn.stated.sense > 0.0:
        return None
    problem = f"in {turn.name} the readings about {axis} have the sign opposite to the table's rate"
    return _Departure(turn, "wrong_sense", problem, {"sense": str(-turn.stated.sense)})


def _face(turn: Turn, found: Bench, tolerance: _Tolerance) -> _Departure | None:
    stated = turn.stated
    off = (found.offset - stated.offset + 180.0) % 360.0 - 180.0
    allowed = tolerance.of_zero(turn.fit)
    if found.sense == stated.sense:
        if turn.recording.role == "gyroscope":  # it needs no zero, and fast turns show a clock's error as one
            at_rest = off_at_rest(turn.recording, stated) or 0.0
            allowed += BIAS_DEG
            found = found if abs(off) > allowed else bench_of(stated.axis, stated.sense, stated.offset + at_rest)
            off = at_rest
        if abs(off) <= allowed:
            return None
    code = "wrong_sense" if found.sense != stated.sense else "wrong_face" if found.up != stated.up else "wrong_zero"
    problem = (
        f"{turn.name} is mounted otherwise than stated, which is {words(stated)}, to {allowed:.2g} deg "
        "(procedure.mounting_tolerance_deg)"
    )
    return _Departure(turn, code, problem, _differing(found, stated, tolerance.angle_deg), found)


def _differing(found: Bench, stated: Bench, tolerance: float) -> dict[str, str]:
    """Return the settings in which the bench that is found differs from the stated one."""
    differing = {
        "up": (found.up != stated.up, found.up),
        "sense": (found.sense != stated.sense, f"{found.sense}"),
        "zero_deg": (abs(found.zero_deg - stated.zero_deg) > tolerance, f"{found.zero_deg:.1f}"),
    }
    return {k: text for k, (differs, text) in differing.items() if differs}


def _upright(turn: Turn) -> _Departure | None:
    """Return what is otherwise than stated of a turn whose axis stands, or should stand, vertical."""
    stated, fit, name = turn.stated, turn.fit, turn.name
    if fit.gravity is None:
        return None
    if fit.vertical is None:
        problem = f"in {name} the turn axis is stated to stand vertical ({stated.up} up), and gravity turns"
        return _Departure(turn, "wrong_face", problem, {"up": usual_up(stated.axis)})
    up = nearest_axis(fit.vertical)
    if up[1] != stated.axis:
        problem = f"in {name} the table is said to turn about {stated.axis}, and gravity stays along body {up}"
        return _Departure(turn, "wrong_axis", problem, {"axis": up[1], "up": up})
    if up != stated.up:
        problem = (
            f"in {name} gravity stays along body {up} while the table turns: the turn axis stands vertical, and stated "
            f"is {stated.up} up"
        )
        return _Departure(turn, "wrong_face", problem, {"up": up})
    if turn.recording.role == "accelerometer":
        problem = f"{name} is to calibrate the accelerometer, and about a vertical axis gravity does not turn"
        return _Departure(turn, "wrong_face", problem, {})
    return None
