"""Read text logs to channels in the units of the package.

    value = (count - offset) / counts_per_unit

The rows are read in blocks of whole lines. A line that is no row of numbers is refused with its number, or dropped with
a note where the profile allows it. Files of one recording that were logged at the same times are joined row by row; the
log of a table with a separate clock is aligned with the sensor's (``pipeline.io.encoder_log``).

Gyroflow's ``.gcsv`` states scales, orientation and column names (versions 1.0 to 1.3;
docs.gyroflow.xyz/app/technical-details/gcsv-format):

    GYROFLOW IMU LOG            (or CAMERA IMU LOG)
    version,1.3
    orientation,YxZ             the reading along (capital) or against (small letter) the body's x, y and z
    tscale,0.001                time [s]                  = tscale * t
    gscale,0.00122173047        angular rate [rad/s]      = gscale * count
    ascale,0.00048828125        specific force [g]        = ascale * count
    t,gx,gy,gz,ax,ay,az         (a magnetometer is not used; columns with canonical names may follow)
    0,39,86,183,-1137,-15689,-2986
"""

from __future__ import annotations

import re
from dataclasses import replace
from fractions import Fraction
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from pipeline.errors import IngestError
from pipeline.io.channel_table import ChannelTable, in_house_unit, joined
from pipeline.io.csv_layout import Fault, TextLayout, column_notes, find_columns, find_faults, refusal
from pipeline.io.csv_times import (
    EXACT_BELOW_S,
    MAX_TIME_S,
    exact_times,
    in_order,
    over_budget,
    rows_of_session,
    seconds_per_unit,
    time_column,
    times_of,
    whole_times,
)
from pipeline.io.files import refuse_foreign, unchanged
from pipeline.io.ingest_settings import AUTO, DROP, GAP, Checks, Column, CsvFormat
from pipeline.io.text_log import TextLog
from pipeline.io.units import ATTITUDE, CANONICAL, COUNTS, DEGREES, SCALARS, TABLE_TIME, TRIADS, UNITS
from pipeline.records import Note

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from pipeline.records import Integers, Values

FIRST_LINES = (b"GYROFLOW IMU LOG", b"CAMERA IMU LOG")
LONGEST_HEADER = 1 << 16  # bytes that are searched for the line of names
LAST_VERSION = "1.3"
LINES_BELOW, SEARCHED_BELOW = 60, 10_000  # lines, bytes after a header without the columns, searched for another
LINES, EXACT = -1, -2  # instead of a column's index: numbers of the lines, times in ns
MOST_REFUSED = 10_000  # bad lines after which the rest of the file is not searched for more


def read_csv(paths: Sequence[Path], formats: Sequence[CsvFormat], checks: Checks | None = None) -> ChannelTable:
    """Read the channels of a text log, or of all files of one recording."""
    tables = [_read_one(path, layout, checks or Checks()) for path, layout in zip(paths, formats, strict=True)]
    same = [t for t, layout in zip(tables, formats, strict=True) if not layout.own_clock]
    others = [t for t, layout in zip(tables, formats, strict=True) if layout.own_clock]
    whole = joined(same)
    if others or TABLE_TIME in whole.values:
        from pipeline.io.encoder_log import align, own_rows  # noqa: PLC0415  (few logs need it)

        for log in others or [own_rows(whole)]:
            whole = align(whole, log)
    return whole


def _read_one(path: Path, settings: CsvFormat, checks: Checks) -> ChannelTable:
    """Read the channels of one file; an ``IngestError`` names the line."""
    with unchanged(path), path.open("rb") as stream:
        return read_stream(stream, str(path), settings, checks)


def read_stream(stream: BinaryIO, name: str, settings: CsvFormat, checks: Checks) -> ChannelTable:
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
        table = ChannelTable(log.path, times_of(rows), values, source, rows.lines, count_sizes, tuple(rows.notes))
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
        columns = {k: np.concatenate([b.pop(k) for b in blocks]) for k in list(blocks[0] if blocks else ())}
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
        text = body[:SEARCHED_BELOW].decode("utf-8", "replace").split("\n")[:LINES_BELOW]
        below = dict(zip(lines.tolist(), text, strict=False))
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


def read_gcsv(path: Path, checks: Checks) -> ChannelTable:
    """Read the channels of a ``.gcsv`` file in the sensor's axes; ``source`` states its orientation."""
    names, facts, line = _read_head(path)
    text = facts.get("orientation", "XYZ")
    if sorted(text.lower()) != ["x", "y", "z"]:
        message = f"orientation is {text!r}; it names X, Y and Z once each, small where turned round"
        raise IngestError(message, str(path), code="gcsv")
    table = _read_one(path, _format(names, facts, line, path), checks)
    kept = {k: v for k, v in facts.items() if k in ("id", "note", "fwversion", "vendor", "orientation")}
    return replace(table, source={**table.source, "gcsv": kept})


def _read_head(path: Path) -> tuple[list[str], dict[str, str], int]:
    """Return the column names, all other facts of the head, and the number of lines before the column names."""
    with unchanged(path), path.open("rb") as stream:
        start = stream.read(LONGEST_HEADER)
    refuse_foreign(start[:16], str(path))
    lines = start.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").split(b"\n")
    if not any(lines[0].startswith(first) for first in FIRST_LINES):
        message = f"not a .gcsv file: it starts with {lines[0][:40]!r}, GYROFLOW IMU LOG is expected"
        raise IngestError(message, f"{path}:1", code="gcsv")
    facts: dict[str, str] = {}
    for number, line in enumerate(lines[1:], 1):
        cells = [c.strip() for c in line.decode("utf-8", "replace").split(",")]
        if cells[0] in ("t", "time"):
            return cells, facts, number
        if len(cells) > 1:
            facts[cells[0]] = ",".join(cells[1:])
    raise IngestError("the head of the file has no line of column names (t,gx,gy,gz,...)", str(path), code="gcsv")


def _format(names: list[str], facts: dict[str, str], skip: int, path: Path) -> CsvFormat:
    version = facts.get("version", "1")
    if version.split(".")[0] != "1":
        message = f"version {version} of .gcsv is not known; known are 1 to {LAST_VERSION}"
        raise IngestError(message, str(path), code="gcsv")
    rate = 1.0 / float(Fraction(_number(facts, "tscale", path)))
    columns = [Column(channel="time", column=names[0], unit=COUNTS, counts_per_unit=rate)]
    for sensor, letter, scale, factor in (("gyroscope", "g", "gscale", DEGREES), ("accelerometer", "a", "ascale", 1.0)):
        if any(f"{letter}{axis}" in names for axis in "xyz"):
            per_unit = 1.0 / (float(Fraction(_number(facts, scale, path))) * factor)
            columns += [
                Column(channel=channel, column=f"{letter}{channel[-1]}", unit=COUNTS, counts_per_unit=per_unit)
                for channel in TRIADS[sensor]
            ]
    others = [c for c in CANONICAL if c in (*SCALARS, *ATTITUDE)]
    columns += [Column(channel=c, column=CANONICAL[c], unit=next(iter(UNITS[c])), optional=True) for c in others]
    return CsvFormat(skip_lines=skip, columns=tuple(columns))


def _number(facts: dict[str, str], key: str, path: Path) -> str:
    text = facts.get(key, "")
    if not re.fullmatch(r"\+?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", text) or float(text) == 0:
        what = f"is {text!r}" if text else "is missing"
        message = f"{key} {what}; a positive number is expected in the head of the file"
        raise IngestError(message, str(path), code="gcsv")
    return text
