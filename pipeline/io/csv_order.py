"""The rows of a text log brought into the order of their times: sessions, overflows, displaced and doubled rows."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import IngestError
from pipeline.io.csv_careful import over_budget
from pipeline.io.csv_time import LARGEST_DISPLACEMENT, order_of, unwrap, wrap_note
from pipeline.io.timestamps import time_error
from pipeline.records import Note

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.io.csv_rows import Rows
    from pipeline.io.ingest_settings import Checks

REPAIRED = np.uint16(8)
RESET_INTERVALS = 5


@dataclass(frozen=True)
class Ordered:
    """Rows in the order of their times.

    Attributes
    ----------
    rows : Rows
    time_ns : (n,) array of int64, ns
        Increasing.
    flags : (n,) array of uint16, or None
        Rows that changed places.
    """

    rows: Rows
    time_ns: NDArray[np.int64]
    flags: NDArray[np.uint16] | None = None


def in_order(rows: Rows, time_ns: NDArray[np.int64], session: int | None, checks: Checks, tick_ns: float) -> Ordered:
    """Bring rows into the order of their times, each time once.

    Parameters
    ----------
    rows : Rows
    time_ns : (n,) array of int64, ns
    session : int or None
        Which part, counted from 1, of a log that was restarted.
    checks : Checks
    tick_ns : float, ns
        Length of the unit of the time column.

    Raises
    ------
    IngestError
        If time runs backwards otherwise than by an overflow or by rows that changed places, if two rows of one time
        differ, or if more would have to be repaired than the budget allows.
    """
    if session is not None:
        rows, time_ns = _one_session(rows, time_ns, session, tick_ns)
    if len(time_ns) < 2 or bool(np.all(np.diff(time_ns) > 0)):
        return Ordered(rows, time_ns)
    time_ns, wraps = unwrap(time_ns, tick_ns)
    if wraps:
        rows = _with_note(rows, wrap_note(wraps, [rows.line_of(r) for r, _ in wraps], tick_ns))
    steps = np.diff(time_ns)
    bad = np.flatnonzero(steps <= 0)
    if bad.size == 0:
        return Ordered(rows, time_ns)
    first = int(bad[0]) + 1
    error = time_error(time_ns, f"{rows.path}:{rows.line_of(first)}", first)
    order, displacement = order_of(time_ns)
    if displacement > LARGEST_DISPLACEMENT:
        raise error
    moved = np.zeros(0, np.intp) if order is None else np.flatnonzero(order != np.arange(len(order)))
    index = np.arange(len(time_ns)) if order is None else order
    twice = _doubled(rows, time_ns, index, error)
    touched = rows.repaired + moved.size + twice.size
    if touched > checks.repaired_rows * rows.count:
        raise over_budget(error, touched, rows.count, checks)
    sorted_rows = f"rows out of order were put in the order of their times, by {displacement} rows at most"
    dropped = "rows that repeat the one before them, time and all, were dropped"
    notes = _notes(rows, time_ns, index, {"N-SORT": (moved, sorted_rows), "N-DUP": (twice, dropped)})
    flags = np.zeros(len(time_ns), np.uint16)
    flags[moved] = REPAIRED
    keep = np.setdiff1d(np.arange(len(index)), twice)
    for note in notes:
        rows = _with_note(rows, note)
    return Ordered(select(rows, index[keep]), time_ns[index[keep]], flags[keep] if moved.size else None)


def select(rows: Rows, index: NDArray[np.intp]) -> Rows:
    """Return some rows, in their order."""
    numbers = {i: values[index] for i, values in rows.numbers.items()}
    return replace(rows, numbers=numbers, line_of=rows.line_of.select(index), exact_ns=None, restarts=())


def _with_note(rows: Rows, note: Note) -> Rows:
    return replace(rows, notes=(*rows.notes, note))


def _doubled(rows: Rows, time_ns: NDArray[np.int64], index: NDArray[np.intp], error: Exception) -> NDArray[np.intp]:
    """Return the places, in order, of rows that repeat the one before them; differing rows of one time are refused."""
    twice = np.flatnonzero(np.diff(time_ns[index]) == 0) + 1
    here, before = index[twice], index[twice - 1]
    for values in rows.numbers.values():
        if not np.array_equal(values[here], values[before]):
            if isinstance(error, IngestError) and error.code != "duplicate_time":
                raise error
            place = int(twice[np.flatnonzero(values[here] != values[before])[0]])
            row = int(max(index[place], index[place - 1]))
            raise IngestError(
                f"time repeats {time_ns[row] / 1e9:.9g} s in rows that differ ({twice.size} such times)",
                f"{rows.path}:{rows.line_of(row)}",
                fault="duplicate_time",
                hint="time has to increase; has the time enough digits, or were two logs merged?",
            ) from error
    return np.asarray(twice, np.intp)


def _notes(
    rows: Rows, times: NDArray[np.int64], index: NDArray[np.intp], found: dict[str, tuple[NDArray[np.intp], str]]
) -> list[Note]:
    """Return a note on each kind of repair, ``found`` being code to places in order and what was done."""
    out = []
    for code, (places, detail) in found.items():
        if places.size:
            lines = sorted(rows.line_of(int(r)) for r in index[places[[0, -1]]])
            start, end = (float(times[index[p]]) / 1e9 for p in places[[0, -1]])
            out.append(Note(code, int(places.size), lines[0], lines[-1], detail, start, end))
    return out


def _one_session(
    rows: Rows, time_ns: NDArray[np.int64], session: int, tick_ns: float
) -> tuple[Rows, NDArray[np.int64]]:
    """Return one part of a log that was restarted: where a header stands again, or time falls back for good."""
    steps = np.diff(time_ns)
    forward = steps[steps > 0]
    longest = RESET_INTERVALS * float(np.median(forward)) if forward.size else 0.0
    wrapped = {row for row, _ in unwrap(time_ns, tick_ns)[1]} if not rows.restarts else set()
    resets = {int(r) + 1 for r in np.flatnonzero(steps < -longest)} - wrapped
    starts = sorted({0, *resets, *rows.restarts} - {len(time_ns)})
    if session > len(starts):
        raise IngestError(
            f"ingest.csv.session is {session}, and the log was started {len(starts)} times", rows.path, fault="session"
        )
    start, stop = [*starts, len(time_ns)][session - 1 : session + 1]
    index = np.arange(start, stop)
    detail = f"session {session} of {len(starts)}: lines {rows.line_of(start)} to {rows.line_of(stop - 1)} were read"
    note = Note(
        "N-SESSION", rows.count - index.size, rows.line_of(start), rows.line_of(stop - 1), detail,
        float(time_ns[start]) / 1e9, float(time_ns[stop - 1]) / 1e9,
    )  # fmt: skip
    return select(_with_note(rows, note), index), time_ns[start:stop]
