"""Compute the times of a text log's rows: integer nanoseconds, increasing.

    time = round(t * 10^9), from the decimal digits where doubles are too coarse (beyond 10^6 s)

A counter that overflows restarts at 0: a time that falls from within 2.5 intervals of M to within 2.5 intervals of 0
continues at M, where M is 2^32 us or ms, or 2^16, 2^24 or 2^32 of the column's unit. A block of rows that directly
follows an exact copy of it is dropped. Rows displaced by at most five rows are sorted, and rows that repeat the row
before them are dropped, within the limit of ``ingest.checks.repaired_rows``. Rows that arrive in bursts without times
of their own get a regular clock (``pipeline.io.bursts``). Any other time that goes back begins another session of the
logger.
"""

from __future__ import annotations

from dataclasses import replace
from decimal import Decimal
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa

from pipeline.errors import IngestError
from pipeline.io.bursts import bursts_error, with_regular_clock
from pipeline.io.csv_layout import PARTS
from pipeline.io.quality_flags import REPAIRED
from pipeline.io.timestamps import counted, sorted_once
from pipeline.io.units import UNITS

if TYPE_CHECKING:
    from fractions import Fraction

    from pipeline.io.channel_table import ChannelTable
    from pipeline.io.csv_layout import TextLayout
    from pipeline.io.csv_read import TextRows
    from pipeline.io.ingest_settings import Checks, Column
    from pipeline.records import Index, Integers, Values

EXACT_BELOW_S = 1e6  # half a nanosecond is 2^-53 of 4.5e6 s
MAX_TIME_S = 9.2e9  # int64 nanoseconds end at 292 years
DECIMAL_DIGITS = {"s": 9, "ms": 6, "us": 3, "ns": 0}  # of whole nanoseconds
MAX_TIME_RESOLUTION = 0.01  # of the median interval
NEAR_INTERVALS = 2.5  # intervals
LARGEST_DISPLACEMENT = 5  # rows
MOST_LISTED = 5  # parts of a log, in a refusal
SHORTEST_PART = 10  # rows; a shorter part is rows with a wrong time
RESET_INTERVALS = 5  # a time that goes back by more begins another session


def time_column(layout: TextLayout) -> tuple[Column, int]:
    """Return the column of the time and its index; the log must have one."""
    return next((c, i) for c, i in layout.columns if c.channel == "time")


def seconds_per_unit(unit: str) -> float:
    """Return the length of a unit of time, s."""
    return UNITS["time"][unit][0] / 1e9


def exact_times(layout: TextLayout, body: bytes) -> Integers:
    """Return the times of rows in ns from their decimal digits."""
    column, index = time_column(layout)
    digits = DECIMAL_DIGITS[column.unit]
    try:
        table = layout.parse(body, {index: pa.decimal128(38, digits)})
    except pa.ArrowInvalid:  # more digits than whole ns have
        strings = layout.parse(body, {index: pa.string()}).column(0).to_pylist()
        texts = (s.strip().replace(",", ".") for s in strings)
        return np.array([int(Decimal(s).scaleb(digits).to_integral_value()) for s in texts], np.int64)
    decimals = table.column(0).combine_chunks()
    words = np.frombuffer(decimals.buffers()[1], np.int64)
    return words[2 * decimals.offset : 2 * (decimals.offset + len(decimals)) : 2].copy()  # low words of 128 bits


def whole_times(values: Values, unit: str, tick_ns: Fraction | None = None) -> Integers:
    """Convert numbers in a unit, or counts of a tick, to times in ns."""
    if tick_ns is not None and tick_ns.denominator == 1 and bool(np.all(values == np.rint(values))):
        return np.asarray(values.astype(np.int64) * int(tick_ns))
    scale = UNITS["time"][unit][0] if tick_ns is None else float(tick_ns)
    return np.asarray(np.rint(values * scale).astype(np.int64))


def times_of(rows: TextRows) -> Integers:
    """Return the time of each row, ns; raise ``IngestError`` for times out of range or too coarse."""
    settings = rows.settings
    if settings.rate_hz is not None:
        return counted(len(rows.lines), settings.rate_hz)
    column, index = time_column(rows.layout)
    values, name, tick_ns = rows.numbers[index], rows.layout.names[index], settings.tick_ns
    unit_s = float(tick_ns) / 1e9 if tick_ns is not None else seconds_per_unit(column.unit)
    row = int(np.argmax(np.abs(values)))
    if abs(values[row]) * unit_s >= MAX_TIME_S:
        message = f"time {values[row] * unit_s:g} s is out of range; is {column.unit} the unit of column {name}?"
        raise IngestError(message, f"{rows.layout.path}:{rows.lines[row]}", code="wrong_rate")
    if rows.exact_ns is None:
        return whole_times(values, column.unit, tick_ns)
    _refuse_coarse(values, rows.exact_ns, column.unit, name, rows.layout.path)
    return rows.exact_ns


def _refuse_coarse(values: Values, exact_ns: Integers, unit: str, name: str, path: str) -> None:
    """Refuse times that were stored as doubles and lost digits by that, such as nanoseconds since 1970.

    Such times are equal to doubles, or end in zeros where the digits of a double end.
    """
    scale = int(UNITS["time"][unit][0])
    spacing = float(np.spacing(np.abs(values).max())) * scale
    step = float(np.median(np.abs(np.diff(exact_ns)))) if len(exact_ns) > 1 else 0.0
    if spacing < 2 * scale or step == 0:
        return
    zeros = next(z for z in range(18, -1, -1) if not np.any(exact_ns % 10**z))
    resolution = spacing if np.array_equal(exact_ns, values.astype(np.int64) * scale) else 10.0**zeros
    if resolution >= spacing / 10 and resolution > MAX_TIME_RESOLUTION * step:
        message = (
            f"the times in column {name} have passed through floating-point numbers, which are {spacing:g} ns apart "
            f"at {values[0]:.3g} {unit}: more than {MAX_TIME_RESOLUTION:.0%} of the median interval of {step:g} ns"
        )
        raise IngestError(message, path, code="coarse_time", hint="log them as integers")


def in_order(table: ChannelTable, rows: TextRows, checks: Checks) -> ChannelTable:
    """Sort a log by its times, with each time once.

    Raises ``IngestError`` for a time that goes back for another reason than an overflow or displaced rows, for two
    different rows of one time, and for more repairs than ``checks`` allows.
    """
    tick_ns, restarts, session = _tick_ns(rows), rows.restarts, rows.settings.session
    if session is not None:
        starts, count = _starts(table.time_ns, restarts, tick_ns), len(table.time_ns)
        index = rows_of_session(rows, table.time_ns)
        note = table.note("N-SESSION", index, "")
        detail = f"session {session} of {len(starts)}: lines {note.first} to {note.last} were read"
        table = table.select(index, replace(note, count=count - index.size, detail=detail))
        restarts = []
    if bool(np.all(np.diff(table.time_ns) > 0)):
        return with_regular_clock(table)
    table = _once(with_regular_clock(_counted_on(table, tick_ns)))
    time_ns = table.time_ns
    back = np.flatnonzero(np.diff(time_ns) <= 0)
    if back.size == 0:
        return table
    error = _refusal(table, int(back[0]) + 1, _starts(time_ns, restarts, tick_ns))
    order, twice, same = sorted_once(time_ns, table.values.values())
    displaced = np.abs(order - np.arange(len(order)))
    if displaced.max() > LARGEST_DISPLACEMENT:
        raise error
    moved = np.flatnonzero(displaced)
    if not same.all():
        if error.code != "duplicate_time":
            raise error
        place = twice[np.argmin(same)]
        row = int(max(order[place], order[place - 1]))
        message = f"time repeats {time_ns[row] / 1e9:.9g} s in rows that differ ({twice.size} such times)"
        hint = "time has to increase; has the time enough digits, or were two logs merged?"
        repeated = IngestError(message, table.place(row), code="duplicate_time", hint=hint)
        raise bursts_error(table) or repeated from error
    touched = rows.repaired + moved.size + twice.size
    if touched > checks.repaired_rows * len(time_ns):
        raise over_budget(error, touched, len(time_ns), checks)
    table, notes = table.select(order), []
    for code, places, detail in (
        (
            "N-SORT",
            moved,
            f"rows out of order were sorted by their times, displaced by {displaced.max()} rows at most",
        ),
        ("N-DUP", twice, "rows that repeat the row before them, including the time, were dropped"),
    ):
        if places.size:
            note = table.note(code, places, detail)
            notes.append(replace(note, first=min(note.first, note.last), last=max(note.first, note.last)))
    flags = np.zeros(len(order), np.uint16)
    flags[moved] = REPAIRED
    return replace(table, flags=flags if moved.size else None).select(np.delete(np.arange(len(order)), twice), *notes)


def _refusal(table: ChannelTable, row: int, starts: list[int]) -> IngestError:
    """Return the error of a row whose time does not increase, with the earlier rows that are repeated from there.

    Where the time goes back permanently, the error lists the parts of the log.
    """
    time_ns = table.time_ns
    repeats = time_ns[row] == time_ns[row - 1]
    what, count = "repeats" if repeats else "goes back to", int(np.count_nonzero(np.diff(time_ns) <= 0))
    message = (
        f"time {what} {time_ns[row] / 1e9:.9g} s after {time_ns[row - 1] / 1e9:.9g} s ({count} such samples); time has "
        "to increase"
    )
    hint = "" if repeats else "a log that was restarted belongs in two files"
    code = "duplicate_time" if repeats else "time_back"
    error = IngestError(message, table.place(row), code=code, hint=hint)
    lines = np.arange(1, len(table.time_ns) + 1) if table.lines is None else table.lines
    start, count = next(((a, n) for at, a, n in _repeats(table) if at == row), (row, 0))
    if count > 1:
        ends = lines[[row, row + count - 1, start, start + count - 1]].tolist()
        hint = "lines {} to {} repeat lines {} to {} exactly: delete them".format(*ends)
        error = IngestError(error.fact, error.file, code=error.code, hint=hint)
    bounds = [*starts, len(lines)]
    if len(starts) > 1 and min(np.diff(bounds)) >= SHORTEST_PART:
        parts = "; ".join(f"{lines[a]} to {lines[b - 1]}" for a, b in list(pairwise(bounds))[:MOST_LISTED])
        parts += " .." * (len(starts) > MOST_LISTED)
        fact = f"{error.message if count > 1 else error.fact}; the log has {len(starts)} parts, lines {parts}"
        error = IngestError(fact, error.file, code=error.code, hint=PARTS)
        error.sessions = len(starts)
    return error


def _repeats(table: ChannelTable) -> list[tuple[int, int, int]]:
    """Return each row where the time goes back to that of an earlier row, the earlier row, and the number of repeats.

    A row repeats another if its time and all used columns are equal; only rows before the one where the time goes back
    are compared.
    """
    time_ns = table.time_ns
    order = np.argsort(time_ns, kind="stable")
    again = np.flatnonzero(np.diff(time_ns[order]) == 0)
    before = dict(zip(order[again + 1].tolist(), order[again].tolist(), strict=True))
    found = []
    for row in (np.flatnonzero(np.diff(time_ns) < 0) + 1).tolist():
        start = before.get(row, row)
        length = min(row - start, len(time_ns) - row)
        same = np.ones(length, np.bool_)
        for column in (time_ns, *table.values.values()):
            same &= column[start : start + length] == column[row : row + length]
        found.append((row, start, length if same.all() else int(np.argmin(same))))
    return found


def _once(table: ChannelTable) -> ChannelTable:
    """Drop exact copies of a block that directly follow it: no information is lost."""
    keep, notes = np.ones(len(table.time_ns), np.bool_), []
    for row, start, count in _repeats(table):
        if start + count == row and count > 0:
            rows = np.arange(row, row + count)
            keep[rows] = False
            twin, note = table.note("", rows - count, ""), table.note("N-REPEAT", rows, "")
            lines = f"lines {note.first} to {note.last} repeat lines {twin.first} to {twin.last} exactly"
            detail = f"{lines}, including the time, and were dropped"
            notes.append(replace(note, detail=detail))
    return table.select(np.flatnonzero(keep), *notes) if notes else table


def over_budget(error: IngestError, touched: int, rows: int, checks: Checks) -> IngestError:
    """Return the error for more repairs than the profile allows."""
    hint = (
        f"{touched} of {rows} rows would have to be repaired, more than the share of {checks.repaired_rows:g} that "
        "ingest.checks.repaired_rows allows"
    )
    return IngestError(error.fact, error.file, code=error.code, hint=hint)


def _counted_on(table: ChannelTable, tick_ns: float) -> ChannelTable:
    time_ns, wraps = _unwrap(table.time_ns, tick_ns)
    if not wraps:
        return table
    modulus = wraps[0][1]
    bits = next((b for b in (16, 24, 32) if round(2**b * tick_ns) == modulus), 32)
    what = f"the time counter of {bits} bits restarted at 0 (every {modulus / 1e9:.9g} s) and was continued"
    note = replace(table.note("N-WRAP", np.array([row for row, _ in wraps]), what), start_s=None, end_s=None)
    return replace(table, time_ns=time_ns, notes=(*table.notes, note))


def _unwrap(time_ns: Integers, tick_ns: float) -> tuple[Integers, list[tuple[int, int]]]:
    """Undo overflows of the time counter; return the times, and the row after each overflow with its modulus, ns."""
    steps = np.diff(time_ns)
    back = np.flatnonzero(steps < 0)
    forward = steps[steps > 0]
    if back.size == 0 or forward.size == 0 or time_ns.min() < 0:
        return time_ns, []
    near = NEAR_INTERVALS * float(np.median(forward))
    moduli = sorted({2**32 * 1000, 2**32 * 1_000_000} | {round(2**bits * tick_ns) for bits in (16, 24, 32)})
    largest = int(time_ns.max())
    for modulus in (m for m in moduli if m > largest >= m - near):
        rows = back[(time_ns[back] >= modulus - near) & (time_ns[back + 1] < near)]
        if rows.size:
            added = np.zeros(len(time_ns), np.int64)
            added[rows + 1] = modulus
            return time_ns + np.cumsum(added), [(int(r) + 1, modulus) for r in rows]
    return time_ns, []


def _starts(time_ns: Integers, restarts: list[int], tick_ns: float) -> list[int]:
    """Return the rows where the logger was started: at a repeated header, or where time goes back permanently."""
    steps = np.diff(time_ns)
    forward = steps[steps > 0]
    longest = RESET_INTERVALS * float(np.median(forward)) if forward.size else 0.0
    wrapped = {row for row, _ in _unwrap(time_ns, tick_ns)[1]} if not restarts else set()
    resets = {int(r) + 1 for r in np.flatnonzero(steps < -longest)} - wrapped
    return sorted({0, *resets, *restarts} - {len(time_ns)})


def _tick_ns(rows: TextRows) -> float:
    unit = "s" if rows.settings.rate_hz is not None else time_column(rows.layout)[0].unit
    return float(rows.settings.tick_ns or UNITS["time"][unit][0])


def rows_of_session(rows: TextRows, time_ns: Integers) -> Index:
    """Return the rows of the selected session of a log that was restarted."""
    starts, session = _starts(time_ns, rows.restarts, _tick_ns(rows)), rows.settings.session or 1
    if session > len(starts):
        message = f"session is {session}, and the log was started {len(starts)} times"
        raise IngestError(message, rows.layout.path, code="session")
    return np.arange(*[*starts, len(time_ns)][session - 1 : session + 1])
