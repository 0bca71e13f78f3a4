"""Read text logs to channels in the units of the package.

    value = (count - offset) / counts_per_unit

The rows are read in blocks of whole lines. A line that is no row of numbers is refused with its number, or dropped with
a note where the profile allows it. Files of one recording that were logged at the same times are joined row by row.

The times of the rows are integer nanoseconds, increasing:

    time = round(t * 10^9), from the decimal digits where doubles are too coarse (beyond 10^6 s)

A counter that overflows restarts at 0: a time that falls from within 2.5 intervals of M to within 2.5 intervals of 0
continues at M, where M is 2^32 us or ms, or 2^16, 2^24 or 2^32 of the column's unit. A block of rows that directly
follows an exact copy of it is dropped. Rows displaced by at most five rows are sorted, and rows that repeat the row
before them are dropped, within the limit of ``ingest.checks.repaired_rows``. Rows that arrive in bursts without times
of their own get a regular clock (``imu_logs.clocks``). Any other time that goes back begins another session of the
logger.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import replace
from decimal import Decimal
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from imu_logs.clocks import bursts_error, counted, sorted_once, with_regular_clock
from imu_logs.errors import IngestError
from imu_logs.files import archive_of, member, unchanged
from imu_logs.log import REPAIRED, Index, Integers, Log, Note, Values, in_house_unit, joined
from imu_logs.profile import AUTO, DROP, GAP, Checks, Column, CsvFormat
from imu_logs.text_layout import PARTS, Fault, TextLayout, column_notes, find_columns, find_faults, gcsv_format, refusal
from imu_logs.text_lines import TextLog
from imu_logs.units import COUNTS, TRIADS, UNITS

LINES_BELOW, SEARCHED_BELOW = 60, 10_000  # lines, bytes after a header without the columns, searched for another
LINES, EXACT = -1, -2  # instead of a column's index: numbers of the lines, times in ns
MOST_REFUSED = 10_000  # bad lines after which the rest of the file is not searched for more
EXACT_BELOW_S = 1e6  # half a nanosecond is 2^-53 of 4.5e6 s
MAX_TIME_S = 9.2e9  # int64 nanoseconds end at 292 years
DECIMAL_DIGITS = {"s": 9, "ms": 6, "us": 3, "ns": 0}  # of whole nanoseconds
MAX_TIME_RESOLUTION = 0.01  # of the median interval
NEAR_INTERVALS = 2.5  # intervals
LARGEST_DISPLACEMENT = 5  # rows
MOST_LISTED = 5  # parts of a log, in a refusal
SHORTEST_PART = 10  # rows; a shorter part is rows with a wrong time
MANY_ROWS = 100_000  # whose memory is worth the 0.2 ms of returning it
RESET_INTERVALS = 5  # a time that goes back by more begins another session


def read_csv(paths: Sequence[Path], formats: Sequence[CsvFormat], checks: Checks | None = None) -> Log:
    """Read the channels of a text log, or of all files of one recording."""
    tables = [_read_one(path, layout, checks or Checks()) for path, layout in zip(paths, formats, strict=True)]
    same = [t for t, layout in zip(tables, formats, strict=True) if not layout.own_clock]
    others = [t for t, layout in zip(tables, formats, strict=True) if layout.own_clock]
    log = replace(joined(same), apart=tuple(others))
    if len(log.time_ns) > MANY_ROWS:
        pa.default_memory_pool().release_unused()  # of an hour at 1 kHz it kept 90 MB
    return log


def _read_one(path: Path, settings: CsvFormat, checks: Checks) -> Log:
    """Read the channels of one file; an ``IngestError`` names the line."""
    archive = archive_of(path)
    if archive is not None:
        with unchanged(archive):
            return read_stream(io.BytesIO(member(archive, path.name)), str(path), settings, checks)
    with unchanged(path), path.open("rb") as stream:
        return read_stream(stream, str(path), settings, checks)


def read_stream(stream: BinaryIO, name: str, settings: CsvFormat, checks: Checks) -> Log:
    """Read the channels of an open text log; ``name`` stands for it in errors and notes."""
    log = TextLog(stream, name, settings)
    rows = TextRows(log)
    for body, lines in log:
        rows.add(body, lines)
    rows.finish(checks)
    values, count_sizes = {}, {}
    for column, index in rows.layout.columns:
        if column.channel != "time":
            numbers = rows.numbers[index]
            values[column.channel] = in_house_unit(column, numbers)
            if column.unit == COUNTS and bool(np.all(numbers == np.rint(numbers))):
                count_sizes[column.channel] = 1.0 / abs(column.counts_per_unit)
    source: dict[str, Any] = {"file": log.path, "sha256": log.sha256}
    if not any(channel in values for triad in TRIADS.values() for channel in triad):
        source["table_only"] = True
    try:
        table = Log(log.path, times_of(rows), values, source, rows.lines, count_sizes, tuple(rows.notes))
        table = in_order(table, rows, checks)
    except IngestError as error:
        raise also(rows.refusal, error) if rows.refusal else error from None
    if rows.refusal:
        raise rows.refusal
    table.source["rows"] = len(table.time_ns)
    if settings.rate_hz is None:
        return table
    detail = f"no time column: rows counted at {settings.rate_hz:g} Hz"
    return replace(table, notes=(*table.notes, Note("N-SYNTHTIME", len(table.time_ns), 0, 0, detail)))


def also(first: IngestError, second: IngestError) -> IngestError:
    """Return one error for two faults of a file."""
    line = (second.file or "").rpartition(":")[2]
    place = f"line {line}: " if line.isdigit() else ""
    both = IngestError(f"{first.message}. Also {place}{second.message}", first.file, code=first.code)
    both.sessions = second.sessions
    return both


class TextRows:
    """The rows of a text log as numbers, gathered block by block."""

    def __init__(self, log: TextLog) -> None:
        self.log, self.path, self.settings = log, log.path, log.settings
        self.numbers: dict[int, Values] = {}  # the columns in use, by index
        self.lines: Integers = np.zeros(0, np.int64)  # of each row, counted from 1
        self.exact_ns: Integers | None = None  # times from their decimal digits, where doubles are too coarse
        self.notes: list[Note] = []
        self.repaired = 0  # rows that were dropped, which count against ``repaired_rows``
        self.restarts: list[int] = []  # rows before which the header was repeated
        self.refusal: IngestError | None = None  # of lines that are no rows, raised once the times are read as well
        self._allowed = {"not_finite"} if self.settings.nan == GAP else set()
        if self.settings.bad_rows == DROP:
            self._allowed |= {"bad_row", "nul", "not_a_number", "decimal_comma"}
        if self.settings.session is not None:
            self._allowed.add("restarted")
        self._layout: TextLayout | None = None
        self._row_count = 0  # bad ones as well
        self._blocks: list[dict[int, NDArray[Any]]] = []  # columns of the valid rows
        self._faults: list[Fault] = []
        self._refused: list[Fault] = []
        self._last_row: tuple[int, str] | None = None

    @property
    def layout(self) -> TextLayout:
        """The columns of the channels; raises ``IngestError`` for a log without rows."""
        if self._layout is None:
            raise self.log.no_rows()
        return self._layout

    def add(self, body: bytes, lines: Integers) -> None:
        """Add a block of rows; ``lines``: their line numbers."""
        layout = self._layout = self._layout or self._find_layout(body, lines)
        numbers = layout.numbers(body, len(lines))
        self._row_count += len(lines)
        if numbers is None:
            body, lines, numbers = self._valid_rows(layout, body, lines)
        else:
            self._last_row = int(lines[-1]), body[body.rfind(b"\n", 0, -1) + 1 : -1].decode("utf-8", "replace")
        if numbers:
            self._blocks.append(numbers | {LINES: lines} | self._exact_times(layout, body, numbers))

    def finish(self, checks: Checks) -> None:
        """Join the blocks, and drop rows where the profile allows it."""
        layout, blocks = self.layout, self._blocks
        if len(blocks) > 1:
            blocks[:] = [{k: np.concatenate([b.pop(k) for b in blocks]) for k in list(blocks[0])}]
        columns: dict[int, NDArray[Any]] = dict(*blocks)
        parted = [f.line for f in self._faults if f.parted_before]
        if parted and columns:
            keep = ~np.isin(columns[LINES], parted)
            columns = {k: values[keep] for k, values in columns.items()}
        if not columns or not columns[LINES].size:
            raise refusal(layout, self._faults)
        self.lines, self.exact_ns, self.numbers = columns.pop(LINES), columns.pop(EXACT, None), columns
        self.restarts = np.searchsorted(self.lines, [f.line for f in self._faults if f.kind == "restarted"]).tolist()
        if self._faults and self.settings.session is not None:
            part = self.lines[rows_of_session(self, times_of(self))]
            within = range(int(part[0]), int(part[-1]) + 1)
            self._faults, self._refused = (
                [f for f in found if f.line in within] for found in (self._faults, self._refused)
            )
        self.notes = [*self.log.notes, *self.notes]
        if self._faults:
            self._drop_faults(layout, checks)

    def _find_layout(self, body: bytes, lines: Integers) -> TextLayout:
        """Find the columns of the channels, by the head and the first rows."""
        head, settings = self.log.head, self.settings
        assert head is not None  # noqa: S101  (rows follow it)

        def below() -> dict[int, str]:
            text = body[:SEARCHED_BELOW].decode("utf-8", "replace").split("\n")[:LINES_BELOW]
            return dict(zip(lines.tolist(), text, strict=False))

        columns = find_columns(head.names, settings, f"{self.path}:{head.line}", below)
        if settings.delimiter == AUTO:
            self.notes.append(Note("N-DELIM", 1, 0, 0, f"the separator is {head.delimiter!r}, by the header"))
        self.notes += column_notes(head.names, columns, head.line if settings.header is True else 0)
        return TextLayout(self.path, head.names, columns, head.delimiter, settings.decimal)

    def _valid_rows(
        self, layout: TextLayout, body: bytes, lines: Integers
    ) -> tuple[bytes, Integers, dict[int, Values]]:
        """Return the valid rows of a block, and store the faults of the others."""
        found = []
        for fault in find_faults(layout, body, lines, self._last_row):
            found.append(fault)
            self._refused += [fault] if fault.kind not in self._allowed else []
            if len(self._refused) > MOST_REFUSED:
                raise refusal(layout, self._refused, more=True)
        self._faults += found
        bad = np.isin(lines, [f.line for f in found if not f.parted_before])
        parts = body.split(b"\n")
        self._last_row = None if bad[-1] else (int(lines[-1]), parts[-2].decode("utf-8", "replace"))
        body = b"".join(part + b"\n" for part, other in zip(parts, bad.tolist(), strict=False) if not other)
        lines = lines[~bad]
        numbers = layout.numbers(body, len(lines)) if len(lines) else {}
        if not bad.any() or numbers is None:
            place = f"{self.path}:{lines[0]}"
            raise IngestError("cannot be read as numbers: its rows cannot be separated", place, code="not_a_number")
        return body, lines, numbers

    def _exact_times(self, layout: TextLayout, body: bytes, numbers: dict[int, Values]) -> dict[int, Integers]:
        """Return the times from their digits, once a double does not resolve half a nanosecond."""
        if self.settings.rate_hz is not None or self.settings.tick_ns is not None:
            return {}
        column, index = time_column(layout)
        largest = float(np.abs(numbers[index]).max()) * seconds_per_unit(column.unit)
        if not (self._blocks and EXACT in self._blocks[0]):
            if largest < EXACT_BELOW_S:
                return {}
            for block in self._blocks:
                block[EXACT] = whole_times(block[index], column.unit)
        out_of_range = largest >= MAX_TIME_S  # refused later
        return {EXACT: np.zeros(len(numbers[index]), np.int64) if out_of_range else exact_times(layout, body)}

    def _drop_faults(self, layout: TextLayout, checks: Checks) -> None:
        """Note the dropped lines and count the repaired ones, or store the refusal."""
        final = self._faults[-1]
        end = max(final.line, int(self.lines[-1]))
        cut = {final.line} if final.short and final.line == end else set()
        tail = [f for f in self._faults if f.line in cut or f.parted_before in cut]
        others = [f for f in self._faults if f not in tail and f.kind != "restarted"]
        refused = [f for f in self._refused if f not in tail]
        if refused:
            self.refusal = refusal(layout, refused)
            return
        if len(others) > checks.repaired_rows * self._row_count:
            raise over_budget(refusal(layout, others), len(others), self._row_count, checks)
        self.repaired = len(others)
        self.notes += [
            Note("N-TAIL", 1, f.line, f.line, f"the last line is cut, so it was dropped: {f.text[:200]!r}")
            for f in tail
        ]
        for code, finite, what in (
            ("N-BADROW", True, "rows that cannot be read were dropped"),
            ("N-NAN", False, "rows without a finite number were dropped"),
        ):
            dropped = [f for f in others if (f.kind != "not_finite") == finite]
            if dropped:
                lines = [f.line for f in dropped]
                ends = np.flatnonzero(np.diff([*lines, lines[-1] + 2]) > 1)
                longest = int(np.diff(ends, prepend=-1).max())  # lines that follow each other directly
                detail = f"{what}, each a gap; the longest run is {longest} long; the first: "
                detail += dropped[0].message
                self.notes.append(Note(code, len(dropped), dropped[0].line, dropped[-1].line, detail))


def read_gcsv(path: Path, checks: Checks) -> Log:
    """Read the channels of a ``.gcsv`` file in the sensor's axes; ``source`` states its orientation."""
    layout, stated = gcsv_format(path)
    table = _read_one(path, layout, checks)
    return replace(table, source={**table.source, "gcsv": stated})


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


def in_order(table: Log, rows: TextRows, checks: Checks) -> Log:
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
        ("N-SORT", moved, f"rows out of order were sorted by their times, displaced by {displaced.max()} rows at most"),
        ("N-DUP", twice, "rows that repeat the row before them, including the time, were dropped"),
    ):
        if places.size:
            note = table.note(code, places, detail)
            notes.append(replace(note, first=min(note.first, note.last), last=max(note.first, note.last)))
    flags = np.zeros(len(order), np.uint16)
    flags[moved] = REPAIRED
    return replace(table, flags=flags if moved.size else None).select(np.delete(np.arange(len(order)), twice), *notes)


def _refusal(table: Log, row: int, starts: list[int]) -> IngestError:
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
    error = IngestError(message, table.place(row), code="duplicate_time" if repeats else "time_back", hint=hint)
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


def _repeats(table: Log) -> list[tuple[int, int, int]]:
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


def _once(table: Log) -> Log:
    """Drop exact copies of a block that directly follow it: no information is lost."""
    keep, notes = np.ones(len(table.time_ns), np.bool_), []
    for row, start, count in _repeats(table):
        if start + count == row and count > 0:
            rows = np.arange(row, row + count)
            keep[rows] = False
            twin, note = table.note("", rows - count, ""), table.note("N-REPEAT", rows, "")
            lines = f"lines {note.first} to {note.last} repeat lines {twin.first} to {twin.last} exactly"
            notes.append(replace(note, detail=f"{lines}, including the time, and were dropped"))
    return table.select(np.flatnonzero(keep), *notes) if notes else table


def over_budget(error: IngestError, touched: int, rows: int, checks: Checks) -> IngestError:
    """Return the error for more repairs than the profile allows."""
    hint = (
        f"{touched} of {rows} rows would have to be repaired, more than the share of {checks.repaired_rows:g} that "
        "ingest.checks.repaired_rows allows"
    )
    return IngestError(error.fact, error.file, code=error.code, hint=hint)


def _counted_on(table: Log, tick_ns: float) -> Log:
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
