"""Find the turns by hand of a stated total angle: by the sheet of the recordings, or by multiples of one angle.

    Y = integral (y - b) dt,   |e^T Y - A| < |A| / 10,   |Y - (e^T Y) e| < |e^T Y| / 4

with the readings y, the bias b of the rests, the stated axis e and the angle A. Without a sheet e is a body axis and A
a multiple of the stated angle (``pipeline.physics.signal.segments``).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pipeline.core.errors import CannotCalibrateError, NotObservableError
from pipeline.core.records import AXES
from pipeline.estimation.multi_position.moves import sound_span, spans_between
from pipeline.estimation.rest_means import ROLE
from pipeline.physics.signal.segments import AXIS_ACCURACY, LOGGED_TURNS, MAX_AXIS_SINE, SCALE, multiples

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.core.records import Index, Recording, Values
    from pipeline.core.settings import HandTurns, Procedure, RecordingFile
    from pipeline.estimation.rest_means import Rests

BEGUN_DEG = 2.0  # as ``TURN_LIMIT_DEG`` of a rest: a larger turn before the first rest of a recording is motion


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


def stated_turns(
    recordings: Sequence[Recording], rests: Rests, procedure: Procedure, role: str = ROLE
) -> list[StatedTurn]:
    """Return the turns that the procedure states, or its sheet of recordings; see ``faces_and_turns.turns_of``."""
    turns = procedure.turns
    if turns is None:
        return []
    bias = np.average(rests.reading, axis=0, weights=rests.count)
    if procedure.sheet is not None:
        return _of_sheet(recordings, rests, bias, procedure, role)
    chosen, moves = _multiples(recordings, rests, bias, turns, role)
    if role == ROLE:
        require_turns([(recordings[t.recording].name, name_of_axis(t.direction)) for t in chosen], moves, turns)
    return chosen


def _multiples(
    recordings: Sequence[Recording], rests: Rests, bias: Values, turns: HandTurns, role: str
) -> tuple[list[StatedTurn], list[tuple[Recording, float, Values]]]:
    """Return the moves that are turns by a multiple of the stated angle, and all moves.

    A move is from one rest to the next of its recording, unless it ends at a held-out rest. A recording that the
    procedure states as a turn about an axis is one move if it has no move between two rests. A move is its recording,
    start in s and integrated readings in deg.
    """
    spans = [(int(rests.recording[j]), span) for _, j, span in spans_between(rests) if not rests.held_out[j]]
    bounded = {index for index, _ in spans}
    spans += [
        (index, slice(0, r.samples))
        for index, r in enumerate(recordings)
        if r.axis is not None and r.role == role and r.gyroscope is not None and index not in bounded
    ]
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


def _of_sheet(
    recordings: Sequence[Recording], rests: Rests, bias: Values, procedure: Procedure, role: str
) -> list[StatedTurn]:
    """Return the turns that the sheet states, or a table logged; those without an angle are by whole turns.

    Raises ``NotObservableError`` if the gyroscope shows another axis, sense or angle, with those that would agree.
    """
    chosen: list[StatedTurn] = []
    assert procedure.turns is not None  # noqa: S101
    for index, recording in enumerate(recordings):
        entry = procedure.recordings.get(recording.name)
        if entry is None or entry.direction is None or recording.role != role or recording.gyroscope is None:
            continue
        own = rests.recording == index
        local = np.average(rests.reading[own], axis=0, weights=rests.count[own]) if own.any() else bias
        direction, logged = np.array(entry.direction), recording.source.get(LOGGED_TURNS)
        if logged is None:
            span = _moving(recording, rests.span[own], local)
            chosen.append(_of_row(recording, index, span, local, entry, procedure.turns))
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
    """Return the turn that a row of the sheet states."""
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
    nearest = turns.angle_deg * round(float(angle[axis]) / turns.angle_deg) or float(np.round(angle[axis]))
    agrees = np.copysign(entry.angle_deg, angle[axis]) if entry.angle_deg else nearest
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


def require_turns(
    found: Sequence[tuple[str, str]], moves: Sequence[tuple[Recording, float, Values]], turns: HandTurns
) -> None:
    """Raise ``CannotCalibrateError`` if an axis has no stated turn, or a recording of a turn has another turn.

    ``found``: recording and axis of each turn.
    """
    expected = f"a multiple of {turns.angle_deg:g} deg, within a tenth of it and a quarter of that angle"
    advice = (
        "turn the unit from rest to rest about each body axis, and state the angle in procedure.turns.angle_deg; an "
        "angle that is wrong in all turns shows a wrong unit or range of the gyroscope"
    )

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
