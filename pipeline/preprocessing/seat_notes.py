"""Doubts about the seats of a unit, in words: the note ``N-REFERENCE`` on the turns that do not fit together."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.preprocessing.bench import by_convention
from pipeline.preprocessing.seats import (
    SMALLEST_DEG,
    TIMES_STATED,
    Conventional,
    axis_off_deg,
    find_seats,
    letters,
    table_explains,
    zero_of,
)
from pipeline.records import AXES, Note

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.preprocessing.bench import Bench
    from pipeline.preprocessing.departures import Turn
    from pipeline.preprocessing.seats import Seats

# Largest plausible tilt (deg), lean (deg) and time offset (s) where the sensor's config states none.
LIMITS = {"table_tilt": 1.0, "table_axis_nonorthogonality": 1.0, "time_offset": 0.04}


def seat_notes(turns: Sequence[Turn], table: Mapping[str, Any], sensor: Mapping[str, Any]) -> dict[str, list[Note]]:
    """Return the doubts about each recording, by name.

    Parameters
    ----------
    turns : sequence of Turn
        Of one unit; those of one setup are compared.
    table, sensor : mapping
        Sections of the unit's configuration.
    """
    orthogonality, angle = (float(table.get(k) or 0.0) for k in ("orthogonality_deg", "angle_accuracy_deg"))
    allowed = max(SMALLEST_DEG, TIMES_STATED * float(np.hypot(orthogonality, angle)))
    effects = (sensor.get("accelerometer") or {}).get("effects") or {}
    limits = [float(effects.get(name) or limit) for name, limit in LIMITS.items()]
    notes: dict[str, list[Note]] = {}
    for setup in dict.fromkeys(t.recording.setup for t in turns):
        own = {t.name: (t, c) for t in turns if t.recording.setup == setup and (c := _conventional(t)) is not None}
        slow = [pair for pair in own.values() if pair[0].recording.role == "accelerometer"]
        if {c.axis for _, c in slow} != set(range(3)) or any(_in_doubt(t) for t, _ in slow):
            continue
        convention = [c for _, c in slow]
        found = find_seats(convention)
        doubt = found.largest > allowed and not table_explains(convention, found.K, limits)
        if doubt:
            notes |= {t.name: [_note(t, _seats_in_words(slow, found, allowed))] for t, _ in slow}
        for turn, fast in own.values():
            off = axis_off_deg(fast, found.K, [] if doubt else convention)
            if turn.recording.role == "gyroscope" and np.max(np.abs(off)) > allowed:
                notes[turn.name] = [_note(turn, _axis_in_words(turn, off, allowed))]
    return notes


def refined_zeros(turns: Sequence[Turn]) -> dict[str, float]:
    """Return the zero of each turn, deg, by all turns at once; nothing where one seat does not explain them.

    The zero of one turn by itself is uncertain by the misalignment of the axes.
    """
    own = {t.name: (t, t.found, c) for t in turns if t.found and (c := _conventional(t, t.found)) is not None}
    slow = [c for t, _, c in own.values() if t.recording.role == "accelerometer"]
    if {c.axis for c in slow} != set(range(3)):
        return {}
    found = find_seats(slow)
    if found.zeros is None:
        return {}
    return {name: bench.zero_deg + bench.sense * zero_of(c, found.K) for name, (_, bench, c) in own.items()}


def _conventional(turn: Turn, bench: Bench | None = None) -> Conventional | None:
    bench = bench or turn.stated
    both = by_convention(turn.fit, bench)
    if both is None or turn.fit.constant is None:
        return None
    axis = AXES.index(bench.axis)
    return Conventional(turn.name, axis, turn.fit.constant, *both, bench.sense * turn.fit.mean_rate)


def _in_doubt(turn: Turn) -> bool:
    """Return whether the angle of a turn is in doubt already, so that it tells nothing of seats."""
    return any(note.code == "N-REFERENCE" for note in turn.recording.notes)


def _note(turn: Turn, detail: str) -> Note:
    return Note("N-REFERENCE", turn.recording.samples, 0, 0, detail)


def _seats_in_words(slow: Sequence[tuple[Turn, Conventional]], found: Seats, allowed: float) -> str:
    if found.zeros is None:
        seats = "; ".join(f"{t.name} {letters(s)}" for (t, _), s in zip(slow, found.seats, strict=True))
        return (
            f"the unit does not sit alike in the turns, by more than {allowed:.2g} deg; its rotation against the mean "
            f"of the turns: {seats}; seat it alike (docs/mounting.md)"
        )
    settings = ", ".join(
        f"procedure.recordings.{t.name}.zero_deg={t.stated.zero_deg + t.stated.sense * z:.2f}"
        for (t, _), z in zip(slow, found.zeros, strict=True)
        if abs(z) > SMALLEST_DEG / 3.0
    )
    return (
        f"the zeros of the turns do not fit together, by more than {allowed:.2g} deg; gravity fits with {settings} "
        "(docs/mounting.md)"
    )


def _axis_in_words(turn: Turn, off: Any, allowed: float) -> str:  # noqa: ANN401  ((3,) array)
    return (
        f"the unit does not sit in {turn.name} as in the turns for the accelerometer, by more than {allowed:.2g} deg: "
        f"by gravity it is rotated by {letters(off)}, and the gyroscope's matrix is off by as much (docs/mounting.md)"
    )
