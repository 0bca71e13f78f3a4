"""Equations of stated faces and turns by hand, in addition to the equations of rests and moves.

    face f      E_f^T mean_k(f_k) / G = 0 +- s_f
    turn k      e_a^T Phi_k = A_k +- s_t,   of a sheet |Phi_k| = |A_k| +- s_t
    axis a      E_a^T sum_k sign(A_k) Phi_k / sum_k |A_k| = 0 +- s_a

where

    f_k   : specific force of the rests with face f up; E_f: two directions across the axis of the face
    Phi_k : integral of the calibrated rate over a turn, in the body's axes; A_k its stated total angle, about e_a
    s     : standard uncertainties: of a face's mean rest, of a turn's angle, and of the mean direction of the turns
            about an axis. They include errors common to all rests on a face, or turns about an axis, which no mean
            reduces

The bias wanders between rests and turns, and differs between recordings: turns have the columns H of ``model``.
For a turn about a fixed axis Phi is angle times axis; a wobble of the axis by w rad changes its length by w^2 / 2. Both
sensors then refer to the case. Source: F. Ferraris, U. Grimaldi & M. Parvis, Procedure for effortless in-field
calibration of three-axial rate gyro and accelerometers, Sensors and Materials 7 (1995), 311-330.

Find the turns by hand of a stated total angle: by the sheet of the recordings, or by multiples of one angle.

    Y = integral (y - b) dt,   |e^T Y - A| < |A| / 10,   |Y - (e^T Y) e| < |e^T Y| / 4

with the readings y, the bias b of the rests, the stated axis e and the angle A. Without a sheet e is a body axis and A
a multiple of the stated angle (``pipeline.physics.signal.segments``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeAlias

import numpy as np

from pipeline.core.errors import CannotCalibrateError, NotObservableError
from pipeline.core.records import AXES, Index, Mask, Motion, Recording, SensorCalibration, TurnAngle, Values
from pipeline.core.settings import FacesByHand as StatedFaces
from pipeline.core.settings import HandTurns, Procedure, RecordingFile
from pipeline.estimation.design import EffectColumns
from pipeline.estimation.multi_position.model import EquationBlock, State, effect_readings, motion_of
from pipeline.estimation.multi_position.moves import padded, sound_span, spans_between, tangents, trapezoids
from pipeline.estimation.rest_means import ROLE, Rests
from pipeline.physics.kinematics import skew
from pipeline.physics.signal.filters import temperature_rate_of
from pipeline.physics.signal.segments import AXIS_ACCURACY, LOGGED_TURNS, MAX_AXIS_SINE, SCALE, multiples

BEGUN_DEG = 2.0  # as ``TURN_LIMIT_DEG`` of a rest: a larger turn before the first rest of a recording is motion
NEAR_DEG = 15.0  # of a face's axis, within which a rest is on that face: a chip askew in its case, and a hand
DEPARTS = 4.5  # standard uncertainties: two angles exceed it with a probability of 4e-5
ONE_LINE = 1.0 - 1e-9  # cosine of the angle between axes that are stated as the same
FACES = [f"{sign}{axis}" for axis in AXES for sign in "+-"]


HandMove: TypeAlias = "tuple[Recording, float, Values]"  # recording, start, s, and integrated readings, deg


class StatedTurn(NamedTuple):
    """A turn of a stated total angle: its recording, samples, axis (3,), angle in deg and standard uncertainty."""

    recording: int
    span: slice
    direction: Values
    angle: float
    error: float
    axis_error: float  # deg, standard uncertainty of each angle between the stated axis and the mean turn about it


def name_of_axis(direction: Values) -> str:
    """Return ``x``, ``-y``, or the three numbers of a direction."""
    axis = int(np.argmax(np.abs(direction)))
    if abs(direction[axis]) < 1.0:
        return " ".join(f"{part:.3g}" for part in direction)
    return f"{'-' if direction[axis] < 0.0 else ''}{AXES[axis]}"


def _multiples(
    recordings: Sequence[Recording], rests: Rests, bias: Values, turns: HandTurns, role: str
) -> tuple[list[StatedTurn], list[HandMove]]:
    """Return the moves that are turns by a multiple of the stated angle, and all moves.

    A move is from one rest to the next of its recording, unless it ends at a held-out rest. A recording that the
    procedure states as a turn about an axis is one move if it has no move between two rests.
    """
    spans = [(int(rests.recording[j]), span) for _, j, span in spans_between(rests) if not rests.held_out[j]]
    bounded = {index for index, _ in spans}
    others = ((i, r) for i, r in enumerate(recordings) if r.axis is not None and r.role == role and i not in bounded)
    spans += [(i, slice(0, r.samples)) for i, r in others if r.gyroscope is not None]
    moves, chosen = [], []
    for index, span in spans:
        recording = recordings[index]
        if sound_span(recording, span):
            angle = _integral(recording, span, bias)
            axis, count = multiples(angle, turns.angle_deg)
            moves.append((recording, float(recording.time[span.start]), angle))
            if count:
                stated = count * turns.angle_deg, turns.accuracy_deg, turns.axis_accuracy_deg
                chosen.append(StatedTurn(index, span, np.eye(3)[axis], *stated))
    return chosen, moves


def _of_sheet(  # noqa: PLR0917  (what a sheet states)
    recordings: Sequence[Recording], rests: Rests, bias: Values, procedure: Procedure, turns: HandTurns, role: str
) -> list[StatedTurn]:
    """Return the turns that the sheet states, or a table logged; those without an angle are by whole turns.

    Raises ``NotObservableError`` if the gyroscope shows another axis, sense or angle, with those that would agree.
    """
    chosen: list[StatedTurn] = []
    for index, recording in enumerate(recordings):
        entry = procedure.recordings.get(recording.name)
        if entry is None or entry.direction is None or recording.role != role or recording.gyroscope is None:
            continue
        own = rests.recording == index
        local = np.average(rests.reading[own], axis=0, weights=rests.count[own]) if own.any() else bias
        direction, logged = np.array(entry.direction), recording.source.get(LOGGED_TURNS)
        if logged is None:
            span = _moving(recording, rests.span[own], local)
            chosen.append(_of_row(recording, index, span, local, entry, turns))
            continue
        for start, stop, stated, error in logged:
            span = slice(int(start), int(stop))
            if sound_span(recording, span, longest=np.inf):
                _require_turned(recording, _integral(recording, span, local), direction, stated, "as the table logged")
                axis_error = float(recording.source[AXIS_ACCURACY])
                chosen.append(StatedTurn(index, span, direction, stated, error, axis_error))
    return chosen


def _of_row(  # noqa: PLR0917  (what a row states)
    recording: Recording, index: int, span: slice, bias: Values, entry: RecordingFile, turns: HandTurns
) -> StatedTurn:
    if not sound_span(recording, span, longest=np.inf):
        raise NotObservableError(
            f"recording {recording.name}: the turn cannot be integrated, as readings of the gyroscope are missing, "
            "clipped or stuck: record it again, slower or with a larger range",
            recording.source.get("file"),
        )
    direction, angle = np.array(entry.direction), _integral(recording, span, bias)
    stated = entry.angle_deg or turns.angle_deg * round(float(angle @ direction) / turns.angle_deg)
    by = f"by {entry.angle_deg:g} deg" if entry.angle_deg else f"by whole turns of {turns.angle_deg:g} deg"
    axis = int(np.argmax(np.abs(angle)))
    seen, whole = float(angle[axis]), turns.angle_deg * round(float(angle[axis]) / turns.angle_deg)
    possible = (np.copysign(entry.angle_deg or 0.0, seen), whole, np.round(seen))
    agrees = next((p for p in possible if abs(seen - p) < SCALE * abs(p)), seen)
    _require_turned(recording, angle, direction, stated, by, f" and angle_deg {agrees:g}")
    error = entry.angle_accuracy_deg or turns.accuracy_deg
    return StatedTurn(index, span, direction, stated, error, turns.axis_accuracy_deg)


def _require_turned(  # noqa: PLR0917  (what a turn is)
    recording: Recording, angle: Values, direction: Values, stated: float, by: str, agrees: str = ""
) -> None:
    """Raise ``NotObservableError`` if the integrated readings, deg, are no turn by the stated angle."""
    along = float(angle @ direction)
    across = float(np.linalg.norm(angle - along * direction))
    if abs(along - stated) >= SCALE * abs(stated) or across >= MAX_AXIS_SINE * abs(along):
        axis = int(np.argmax(np.abs(angle)))
        opposed = "-" if not agrees and stated * angle[axis] < 0.0 else ""
        would = f"axis {opposed}{AXES[axis]}{agrees}"
        raise NotObservableError(
            f"recording {recording.name} is no turn about {name_of_axis(direction)} {by}: the gyroscope shows "
            f"{_in_words(angle)}. Correct the sheet ({would} would agree); or, if the unit turned as stated, "
            "sensor.gyroscope.axis_map or the gyroscope's range",
            recording.source.get("file"),
        )


def _moving(recording: Recording, spans: Index, bias: Values) -> slice:
    """Return the samples from the first to the last motion of a recording; ``spans``: (m, 2), of its rests."""
    if len(spans) == 0:
        return slice(0, recording.samples)
    first, last = slice(0, int(spans[0, 0])), slice(int(spans[-1, 1]), recording.samples)
    turned = [float(np.linalg.norm(_integral(recording, ends, bias))) > BEGUN_DEG for ends in (first, last)]
    return slice(0 if turned[0] else int(spans[0, 1]) - 1, recording.samples if turned[1] else int(spans[-1, 0]) + 1)


def _integral(recording: Recording, span: slice, bias: Values) -> Values:
    """Return the integrated readings less a bias: (3,) array, deg."""
    rate = np.asarray(recording.gyroscope)[span] - bias
    return np.asarray(np.trapezoid(rate, recording.time[span], axis=0), np.float64)


def require_turns(found: Sequence[tuple[str, str]], moves: Sequence[HandMove], turns: HandTurns) -> None:
    """Raise ``CannotCalibrateError`` if an axis has no stated turn, or a recording of a turn has another turn.

    ``found``: recording and axis of each turn.
    """
    expected = f"a multiple of {turns.angle_deg:g} deg, within a tenth of it and a quarter of that angle"
    advice = "turn the unit from rest to rest about each body axis, and state the angle in procedure.turns.angle_deg;"
    advice += " an angle that is wrong in all turns shows a wrong unit or range of the gyroscope"

    for part in {id(r): r for r, _, _ in moves if r.axis is not None}.values():
        if (part.name, str(part.axis)) not in found:
            seen = ", ".join(_in_words(angle) for r, _, angle in moves if r is part)
            raise CannotCalibrateError(
                f"recording {part.name} is no turn about {part.axis} by {expected}: the readings show {seen}; {advice}",
                part.source.get("file"),
            )
    for axis, name in enumerate(AXES):
        if name not in {turned for _, turned in found}:
            about = [m for m in moves if np.linalg.norm(np.delete(m[2], axis)) < MAX_AXIS_SINE * abs(m[2][axis])]
            largest = max(about, key=lambda m: abs(m[2][axis]), default=None)
            seen = f"{_in_words(largest[2])} at {largest[1]:.1f} s of {largest[0].name}" if largest else "none"
            raise CannotCalibrateError(
                f"there is no turn about {name} by {expected}; the largest about {name} is {seen}: {advice}"
            )


def _in_words(angle: Values) -> str:
    return "(" + ", ".join(f"{a:.1f}" for a in angle) + ") deg about x, y, z"


@dataclass(frozen=True)
class Faces:
    """The faces on which a unit rests."""

    face: Index  # (m,); of each rest, an index of ``FACES``; -1 for none
    error: float  # rad; s_f

    def select(self, index: Mask) -> Faces:
        """Return the faces of some of the rests."""
        return replace(self, face=self.face[index])

    def weights(self) -> Values:
        """Return the weights of the rests' forces in the equations: (r, m, 3) array, two rows for each face."""
        rows = []
        for face in np.unique(self.face[self.face >= 0]):
            rests = self.face == face
            rows += [rests[:, None] / rests.sum() * e for i, e in enumerate(np.eye(3)) if i != face // 2]
        return np.array(rows).reshape(-1, len(self.face), 3)


def faces_of(rests: Rests, force: Values, stated: StatedFaces | None) -> Faces | None:
    """Return the face of each rest, by its specific force (m, 3); None if the procedure states no faces.

    Raises ``NotObservableError`` if there is no rest on a face.
    """
    if stated is None:
        return None
    face, axis, along, tilt = face_of(force)
    missing = [name for i, name in enumerate(FACES) if not np.any(face == i)]
    if missing:
        rows = zip(axis, along, rests.start, tilt, strict=True)
        found = ", ".join(f"{FACES[2 * a + (s < 0)]} at {t:.1f} s ({d:.0f} deg off)" for a, s, t, d in rows)
        raise NotObservableError(
            f"there is no rest with body {' or '.join(missing)} up, within {NEAR_DEG:g} deg: rest the unit for 4 s or "
            f"longer on each of its six faces. Nearest to up in the rests found: {found}"
        )
    return Faces(face, float(np.radians(stated.accuracy_deg)))


def face_of(force: Values) -> tuple[Index, Index, Values, Values]:
    """Return for each force (m, 3) its face (-1: none), nearest axis, component along that axis, and tilt, deg."""
    u = force / np.linalg.norm(force, axis=1, keepdims=True)
    axis = np.argmax(np.abs(u), axis=1)
    along = u[np.arange(len(u)), axis]
    tilt = np.degrees(np.arccos(np.clip(np.abs(along), 0.0, 1.0)))
    return np.where(tilt <= NEAR_DEG, 2 * axis + (along < 0.0), -1), axis, along, tilt


@dataclass(frozen=True)
class TurnsByHand:
    """The samples of t turns of a stated total angle, padded to the longest, and their equations."""

    name: tuple[str, ...]  # of each turn's recording
    recording: Index  # (t,); its index
    direction: Values  # (t, 3); stated unit vector of the axis
    group: Index  # (t,); turns about one axis, in either direction, have the same number
    stated: Values  # (t,), deg; total angle about the direction
    # each (t, s, 3), deg/s and g; angular rate as it was read; specific force by the calibrated accelerometer
    reading: Values
    force: Values
    # each (t, s), s, degC and degC/s
    time: Values
    temperature: Values
    temperature_rate: Values
    weight: Values  # (t, s), s; in an integral by the trapezoidal rule; 0 beyond a turn's end
    rows: Values  # (r, t, 3); weights of Phi in the equations
    # each (r,), deg; of the equations, and standard uncertainty
    value: Values
    error: Values
    frame: float  # rad; standard uncertainty of each angle between the frame of the fit and the case
    by_length: bool = False  # whether the angle of a turn is |Phi|, whatever its axis, as a sheet states it

    def equations(self, state: State, white: Values) -> EquationBlock:
        """Return the equations; ``white`` (3,) is the noise of a sample."""
        motion, v = self._samples(state)
        total, length = np.einsum("ts,tsi->ti", self.weight, v), self.weight.sum(axis=1)
        rows = self.rows
        if self.by_length:
            angle = total @ state.matrix.T
            along = angle * (np.sign(self.stated) / np.linalg.norm(angle, axis=1))[:, None]
            number, rows = np.arange(len(along)), rows.copy()
            rows[number, number] = along
        WM = rows @ state.matrix
        noise = np.einsum("rtc,c,t->r", WM**2, white**2, np.sum(self.weight**2, axis=1))
        error = np.sqrt(self.error**2 + noise)
        bias = -np.einsum("rtc,t->rc", WM, length)
        matrix = np.einsum("rti,tj->rij", rows, total).reshape(-1, 9)

        def columns(term: EffectColumns) -> Values:
            Z = term.columns("gyroscope", motion, state.K)
            integrals = self.weight[:, None] @ Z.reshape(*self.weight.shape, -1)  # (t, 1, 3 p)
            return np.asarray(-WM.reshape(len(error), -1) @ integrals.reshape(WM[0].size, -1) / error[:, None])

        residual = (self.value - np.einsum("rtc,tc->r", WM, total)) / error
        about = (self.stated[:, None] * self.direction) @ skew(np.eye(3)).transpose(0, 2, 1)  # (3, t, 3)
        by_frame = -self.frame * np.einsum("rti,kti->rk", self.rows, about)  # by each angle of the frame off the case
        return EquationBlock(
            residual,
            np.concatenate([bias, matrix], axis=1) / error[:, None],
            columns,
            error,
            np.einsum("rtc,t,c->crt", -WM, length, white) / error[:, None],
            (self.time[:, 0], self.time[:, -1] - self.time[:, 0], self.recording),
            frame=by_frame / error[:, None] if self.frame else None,
        )

    def described(self, state: State) -> list[TurnAngle]:
        """Return recording, start in s, axis, stated and calibrated total angle in deg of each turn."""
        Phi = np.einsum("ts,tsi->ti", self.weight, self._samples(state)[1]) @ state.matrix.T
        angles = np.sum(Phi * self.direction, axis=1)
        if self.by_length:
            angles = np.sign(self.stated) * np.linalg.norm(Phi, axis=1)
        figures = np.stack([self.time[:, 0], self.stated, angles], axis=1).tolist()
        turns = zip(self.name, self.direction, figures, strict=True)
        return [TurnAngle(name, start, name_of_axis(axis), *both) for name, axis, (start, *both) in turns]

    def departures(self, residual: Values, deviation: Values) -> list[str]:
        """Describe the turns that differ from what is stated by more than its uncertainty, noise and bias explain.

        ``residual``, ``deviation``: of the equations, and standard deviation, (r,), deg.
        """
        count = len(self.name)
        angle = "angle_accuracy_deg" if self.by_length else "procedure.turns.accuracy_deg"
        turns = [f"the turn at {self.time[t, 0]:.1f} s of {name} is" for t, name in enumerate(self.name)]
        turned = [(what, abs(residual[t]), deviation[t], angle) for t, what in enumerate(turns)]
        across = np.linalg.norm(residual[count:].reshape(-1, 2), axis=1)
        first = [name_of_axis(self.direction[self.group == group][0]) for group in np.unique(self.group)]
        turned += [
            (f"the axis of the turns about {axis} is", off, error, "procedure.turns.axis_accuracy_deg")
            for axis, off, error in zip(first, across, deviation[count::2], strict=True)
        ]
        far = [(what, off, off / error, name) for what, off, error, name in turned if off > DEPARTS * error]
        return [f"{what} {off:.2g} deg off, {n:.1f} times {name} with noise and bias" for what, off, n, name in far]

    def _samples(self, state: State) -> tuple[Motion, Values]:
        """Return the motion of all samples, and ``v = y - b - z``."""
        plain = self.reading - state.bias
        force, rate = self.force.reshape(-1, 3), (plain @ state.matrix.T).reshape(-1, 3)
        motion = motion_of(self, force, rate, still=False)
        return motion, plain - effect_readings("gyroscope", state.terms, motion, state.K).reshape(plain.shape)


def turns_of(
    recordings: Sequence[Recording],
    rests: Rests,
    accelerometer: SensorCalibration | None,
    procedure: Procedure,
    role: str = ROLE,
    *,
    frame_deg: float = 0.0,
) -> TurnsByHand | None:
    """Return the turns that the procedure, or its sheet of recordings, states; None if there are none.

    ``rests``: all rests of the gyroscope. ``role``: of the recordings that may be one turn; empty for none.
    ``frame_deg``: standard uncertainty of each angle between the frame of the fit and the case, deg.
    """
    turns = procedure.turns
    if turns is None:
        return None
    bias = np.average(rests.reading, axis=0, weights=rests.count)
    if procedure.sheet is not None:
        chosen = _of_sheet(recordings, rests, bias, procedure, turns, role)
    else:
        chosen, moves = _multiples(recordings, rests, bias, turns, role)
        if role == ROLE:
            require_turns([(recordings[t.recording].name, name_of_axis(t.direction)) for t in chosen], moves, turns)
    if not chosen:
        return None
    found = _gathered(recordings, chosen, accelerometer, float(np.radians(frame_deg)))
    return replace(found, by_length=procedure.sheet is not None)


def _gathered(
    recordings: Sequence[Recording], chosen: Sequence[StatedTurn], accelerometer: SensorCalibration | None, frame: float
) -> TurnsByHand:
    """Return the samples of turns, and their equations; ``frame``: of ``TurnsByHand``."""
    pairs = [(recordings[t.recording], at) for t, at in zip(chosen, padded([t.span for t in chosen]), strict=True)]
    force = [
        np.zeros((len(at), 3))
        if accelerometer is None or r.accelerometer is None
        else (r.accelerometer[at] - accelerometer.bias) @ accelerometer.matrix.T
        for r, at in pairs
    ]
    unknown = np.full(len(pairs[0][1]), np.nan)
    warmth = [unknown if r.temperature is None else r.temperature[at] for r, at in pairs]
    warming = [unknown if r.temperature is None else temperature_rate_of(r)[at] for r, at in pairs]
    times = np.array([r.time[at] for r, at in pairs])
    direction, stated = np.array([t.direction for t in chosen]), np.array([t.angle for t in chosen])
    cosine = direction @ direction.T
    accuracy = np.array([t.axis_error for t in chosen])
    group = np.argmax((np.abs(cosine) > ONE_LINE) & (accuracy[:, None] == accuracy), axis=1)
    rows = [np.outer(turn, e) for turn, e in zip(np.eye(len(chosen)), direction, strict=True)]
    value, error = stated.tolist(), [t.error for t in chosen]
    for first in np.unique(group):
        signed = np.where(group == first, np.sign(stated * cosine[first]), 0.0)
        share = np.degrees(signed / np.sum(signed * stated * cosine[first]))
        rows += [share[:, None] * e for e in across_axis(direction[first])]
        value += [0.0, 0.0]
        error += 2 * [float(accuracy[first])]
    return TurnsByHand(
        name=tuple(r.name for r, _ in pairs),
        recording=np.array([t.recording for t in chosen]),
        direction=direction,
        group=group,
        stated=stated,
        reading=np.array([np.asarray(r.gyroscope)[at] for r, at in pairs]),
        force=np.array(force),
        time=times,
        temperature=np.array(warmth),
        temperature_rate=np.array(warming),
        weight=trapezoids(times),
        rows=np.array(rows),
        value=np.array(value),
        error=np.array(error),
        frame=frame,
    )


def across_axis(direction: Values) -> Values:
    """Return two unit vectors across a direction, body axes where it is one: (2, 3) array."""
    axis = int(np.argmax(np.abs(direction)))
    return np.delete(np.eye(3), axis, axis=0) if abs(direction[axis]) == 1.0 else tangents(direction[None])[0]
