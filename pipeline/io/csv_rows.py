"""The rows of a text log as numbers, read in blocks of whole lines.

Lines that are no rows of numbers are refused by their number, or dropped with a note where the profile allows it. Empty
lines and comments are left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import IngestError
from pipeline.io.csv_header import column_notes, fields, find_columns, find_delimiter, single_blanks
from pipeline.io.csv_parse import Fault, Layout, find_faults, refusal
from pipeline.io.csv_times import (
    EXACT_BELOW_S,
    LONGEST_S,
    exact_times,
    over_budget,
    seconds_per_unit,
    time_column,
    whole_times,
)
from pipeline.io.files import unchanged
from pipeline.io.ingest_settings import AUTO, COMMENTED, DROP, GAP, WHITESPACE
from pipeline.io.text_blocks import TextBlocks
from pipeline.records import Note

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from pipeline.io.ingest_settings import Checks, CsvFormat

LINES_BELOW = 60  # after a header that lacks columns, searched for one that has them
LINES, EXACT = -1, -2  # in place of a column's index: numbers of the lines, times in ns
LONGEST_HEAD = 1 << 24  # bytes, before the first row
MOST_REFUSED = 10_000  # bad lines after which the rest of the file is not searched for more


@dataclass(frozen=True)
class Rows:
    """The rows of a text log as numbers.

    Attributes
    ----------
    layout : Layout
    sha256 : str
    numbers : dict of int to (n,) array
        The columns in use, by index.
    lines : (n,) array of int64
        The line of each row, counted from 1.
    exact_ns : (n,) array of int64, ns, or None
        Times from their decimal digits, where doubles are too coarse.
    notes : tuple of Note
    repaired : int
        Rows that were dropped, which count against ``repaired_rows``.
    restarts : tuple of int
        Rows before which the header was repeated.
    flags : (n,) array of uint16, or None
        Rows that were sorted.
    """

    layout: Layout
    sha256: str
    numbers: dict[int, NDArray[np.float64]]
    lines: NDArray[np.int64]
    exact_ns: NDArray[np.int64] | None
    notes: tuple[Note, ...]
    repaired: int = 0
    restarts: tuple[int, ...] = ()
    flags: NDArray[np.uint16] | None = None

    def place(self, row: int) -> str:
        """Return ``path:line`` of a row."""
        return f"{self.layout.path}:{self.lines[row]}"

    def select(self, index: NDArray[np.intp], *notes: Note) -> Rows:
        """Return some rows, in their order, with further notes."""
        numbers = {i: values[index] for i, values in self.numbers.items()}
        return replace(
            self, numbers=numbers, lines=self.lines[index], exact_ns=None, restarts=(), notes=(*self.notes, *notes)
        )


def read_rows(path: Path, settings: CsvFormat, checks: Checks) -> Rows:
    """Return the rows of a file in its own order.

    Raises
    ------
    IngestError
        With ``path:line`` of the line concerned.
    """
    with unchanged(path), path.open("rb") as stream:
        text = TextBlocks(stream, str(path), keep_nul=settings.bad_rows == DROP)
        reader = _RowReader(str(path), settings, path.stat().st_size)
        for data, lines in text:
            reader.add(data, lines)
        return reader.rows(text, checks)


class _Columns:
    """Columns that grow block by block, in memory for as many rows as the file is expected to hold."""

    def __init__(self) -> None:
        self.rows = 0
        self._arrays: dict[int, NDArray[Any]] = {}

    def append(self, columns: dict[int, NDArray[Any]], expected: int) -> None:
        """Append rows to each column; ``expected`` is the number of rows of the file."""
        stop = self.rows + len(next(iter(columns.values())))
        for key, values in columns.items():
            if key not in self._arrays or len(self._arrays[key]) < stop:
                grown = np.empty(max(expected, stop + stop // 2), values.dtype)
                if key in self._arrays:
                    grown[: self.rows] = self[key]
                self._arrays[key] = grown
            self._arrays[key][self.rows : stop] = values
        self.rows = stop

    def insert(self, key: int, values: NDArray[Any]) -> None:
        """Add a column to the rows so far."""
        self._arrays[key] = values

    def __contains__(self, key: int) -> bool:
        return key in self._arrays

    def __getitem__(self, key: int) -> NDArray[Any]:
        return self._arrays[key][: self.rows]


class _RowReader:
    """Numbers of a text log, gathered block by block."""

    def __init__(self, path: str, settings: CsvFormat, size: int) -> None:
        self.path, self.settings, self.size = path, settings, size
        self.allowed = {"not_finite"} if settings.nan == GAP else set()
        if settings.bad_rows == DROP:
            self.allowed |= {"bad_row", "nul", "not_a_number", "decimal_comma"}
        if settings.session is not None:
            self.allowed.add("restarted")
        self.layout: Layout | None = None
        self.notes: list[Note] = []
        self.head = b""  # what was read before the layout is known
        self.comments: list[int] = []  # their lines
        self.row_count = 0  # bad ones as well
        self.columns = _Columns()
        self.faults: list[Fault] = []
        self.refused: list[Fault] = []
        self.last_row: tuple[int, str] | None = None

    def add(self, data: bytes, lines: range) -> None:
        """Take in a block of whole lines with these numbers."""
        if self.layout is not None:
            self._add_rows(self.layout, *self._data_lines(data, lines))
            return
        self.head += data
        found = self._find_layout()
        if found is None and len(self.head) > LONGEST_HEAD:
            raise self._no_rows()
        if found is not None:
            self.layout, self.head = found[0], b""
            self._add_rows(*found)

    def rows(self, text: TextBlocks, checks: Checks) -> Rows:
        """Return all rows, without those that may be dropped.

        Raises
        ------
        IngestError
            If there are no rows, or lines that may not be dropped, or too many of them.
        """
        if self.layout is None:
            raise self._no_rows()
        notes, repaired = self._drop_faults(self.layout, checks)
        if not self.columns.rows:
            raise refusal(self.layout, self.faults)
        keep: slice | NDArray[np.bool_] = slice(None)
        parted = [f.line for f in self.faults if f.parted_before]
        if parted:
            keep = ~np.isin(self.columns[LINES], parted)
        lines = self.columns[LINES][keep]
        if not lines.size:
            raise refusal(self.layout, self.faults)
        restarts = [f.line for f in self.faults if f.kind == "restarted"]
        return Rows(
            layout=self.layout,
            sha256=text.sha256,
            numbers={index: self.columns[index][keep] for _, index in self.layout.columns},
            lines=lines,
            exact_ns=self.columns[EXACT][keep] if EXACT in self.columns else None,
            notes=(*text.notes, *self._comment_note(), *self.notes, *notes),
            repaired=repaired,
            restarts=tuple(np.searchsorted(lines, restarts).tolist()),
        )

    def _data_lines(self, data: bytes, numbers: range) -> tuple[bytes, NDArray[np.int64]]:
        """Return the lines that are no comments, and their numbers."""
        lines = np.arange(numbers.start, numbers.stop)
        comment = self.settings.comment
        if comment is not None and comment.encode() in data:
            parts, mark = data.split(b"\n")[:-1], comment.encode()
            is_comment = np.array([part.lstrip().startswith(mark) for part in parts], bool)
            self.comments += lines[is_comment].tolist()
            data = b"".join(part + b"\n" for part, other in zip(parts, is_comment, strict=True) if not other)
            lines = lines[~is_comment]
        if self.settings.delimiter == WHITESPACE:
            data = single_blanks(data)
        return data, lines

    def _find_layout(self) -> tuple[Layout, bytes, NDArray[np.int64]] | None:
        """Return the layout and the first rows; None where the header or the first row was not read yet."""
        settings, start = self.settings, 0
        for _ in range(settings.skip_lines):
            start = self.head.find(b"\n", start) + 1
            if start == 0:
                return None
        self.comments = []
        rest, begin = self.head[start:], settings.skip_lines + 1
        body, lines = _without_empty_lines(*self._data_lines(rest, range(begin, begin + rest.count(b"\n"))))
        has_names = settings.header is True
        if len(lines) < 1 + has_names:
            return None
        first = body.partition(b"\n")[0].decode("utf-8")
        if settings.header == COMMENTED:
            first = self._last_comment_before(int(lines[0]))
        delimiter = find_delimiter(settings, first)
        names = fields(first, delimiter)
        if not settings.header:
            names = [f"column {i}" for i in range(len(names))]
        at = int(lines[0])
        if has_names:
            body, lines = body.partition(b"\n")[2], lines[1:]
        below = body[:10_000].decode("utf-8", "replace").split("\n")[:LINES_BELOW]
        columns = find_columns(names, settings, f"{self.path}:{at}", dict(zip(lines.tolist(), below, strict=False)))
        if settings.delimiter == AUTO:
            self.notes.append(Note("N-DELIM", 1, 0, 0, f"the separator is {delimiter!r}, by the header"))
        self.notes += column_notes(names, columns, at if has_names else 0)
        return Layout(self.path, names, columns, delimiter, settings.decimal), body, lines

    def _last_comment_before(self, line: int) -> str:
        """Return the text of the last comment before the data."""
        above = [number for number in self.comments if number < line]
        if not above:
            message = (
                f"no line that starts with {self.settings.comment!r} stands before the data, where ingest.csv.header "
                "looks for the column names"
            )
            raise IngestError(message, self.path, code="no_header")
        text = self.head.split(b"\n")[above[-1] - 1].decode("utf-8")
        text = text.lstrip().removeprefix(self.settings.comment or "")
        return " ".join(text.split()) if self.settings.delimiter == WHITESPACE else text

    def _comment_note(self) -> list[Note]:
        if not self.comments:
            return []
        detail = f"lines that start with {self.settings.comment!r} are no data"
        return [Note("N-COMMENT", len(self.comments), self.comments[0], self.comments[-1], detail)]

    def _no_rows(self) -> IngestError:
        """Return the refusal of a file without rows."""
        skipped, count = self.settings.skip_lines, self.head.count(b"\n")
        if count < skipped:
            message = f"the file ends within the {skipped} lines that ingest.csv.skip_lines skips"
            return IngestError(message, self.path, code="no_rows")
        found = f"header on line {skipped + 1}, " if self.settings.header is True and count > skipped else ""
        return IngestError(f"{found}0 data rows; at least 2 are needed", self.path, code="no_rows")

    def _add_rows(self, layout: Layout, body: bytes, lines: NDArray[np.int64]) -> None:
        numbers = layout.numbers(body, len(lines)) if len(lines) else {}
        if numbers is None:
            body, lines = _without_empty_lines(body, lines)
            numbers = layout.numbers(body, len(lines)) if len(lines) else {}
        self.row_count += len(lines)
        if numbers is None:
            body, lines, numbers = self._valid_rows(layout, body, lines)
        elif numbers:
            self.last_row = int(lines[-1]), body[body.rfind(b"\n", 0, -1) + 1 : -1].decode("utf-8", "replace")
        if numbers:
            columns = numbers | {LINES: lines} | self._exact_times(layout, body, numbers)
            self.columns.append(columns, int(1.02 * len(lines) * self.size / len(body)) + 16)

    def _valid_rows(
        self, layout: Layout, body: bytes, lines: NDArray[np.int64]
    ) -> tuple[bytes, NDArray[np.int64], dict[int, NDArray[np.float64]]]:
        """Return the valid rows of a block, and keep the faults of the others."""
        found = []
        for fault in find_faults(layout, body, lines, self.last_row):
            found.append(fault)
            self.refused += [fault] if fault.kind not in self.allowed else []
            if len(self.refused) > MOST_REFUSED:
                raise refusal(layout, self.refused, more=True)
        self.faults += found
        bad = np.isin(lines, [f.line for f in found if not f.parted_before])
        parts = body.split(b"\n")
        self.last_row = None if bad[-1] else (int(lines[-1]), parts[-2].decode("utf-8", "replace"))
        body = b"".join(part + b"\n" for part, other in zip(parts, bad.tolist(), strict=False) if not other)
        lines = lines[~bad]
        numbers = layout.numbers(body, len(lines)) if len(lines) else {}
        if not bad.any() or numbers is None:
            place = f"{self.path}:{lines[0]}"
            raise IngestError("cannot be read as numbers: its rows cannot be told apart", place, code="not_a_number")
        return body, lines, numbers

    def _exact_times(
        self, layout: Layout, body: bytes, numbers: dict[int, NDArray[np.float64]]
    ) -> dict[int, NDArray[np.int64]]:
        """Return the times from their digits, from the first that a double does not hold to half a nanosecond."""
        clock = time_column(layout)
        if clock is None or self.settings.tick_ns is not None:
            return {}
        column, index = clock
        largest = float(np.abs(numbers[index]).max()) * seconds_per_unit(column.unit)
        if EXACT not in self.columns and largest < EXACT_BELOW_S:
            return {}
        if EXACT not in self.columns and self.columns.rows:
            self.columns.insert(EXACT, whole_times(self.columns[index], column.unit))
        out_of_range = largest >= LONGEST_S  # refused later
        return {EXACT: np.zeros(len(numbers[index]), np.int64) if out_of_range else exact_times(layout, body)}

    def _drop_faults(self, layout: Layout, checks: Checks) -> tuple[list[Note], int]:
        """Return notes on the lines that are dropped, and how many count against the limit of repairs."""
        if not self.faults:
            return [], 0
        final = self.faults[-1]
        end = max(final.line, int(self.columns[LINES][-1]) if self.columns.rows else 0)
        cut = {final.line} if final.short and final.line == end else set()
        tail = [f for f in self.faults if f.line in cut or f.parted_before in cut]
        others = [f for f in self.faults if f not in tail and f.kind != "restarted"]
        refused = [f for f in self.refused if f not in tail]
        if refused:
            raise refusal(layout, refused)
        if len(others) > checks.repaired_rows * self.row_count:
            raise over_budget(refusal(layout, others), len(others), self.row_count, checks)
        notes = [
            Note("N-TAIL", 1, f.line, f.line, f"the last line is cut, so it was dropped: {f.text[:200]!r}")
            for f in tail
        ]
        for code, finite, what in (
            ("N-BADROW", True, "rows that cannot be read were dropped"),
            ("N-NAN", False, "rows without a finite number were dropped"),
        ):
            dropped = [f for f in others if (f.kind != "not_finite") == finite]
            if dropped:
                detail = f"{what}, each a gap; the longest run is {_longest_run(dropped)} long; the first: "
                detail += dropped[0].message
                notes.append(Note(code, len(dropped), dropped[0].line, dropped[-1].line, detail))
        return notes, len(others)


def _without_empty_lines(body: bytes, lines: NDArray[np.int64]) -> tuple[bytes, NDArray[np.int64]]:
    if b"\n\n" not in body and not body.startswith(b"\n"):
        return body, lines
    parts = body.split(b"\n")[:-1]
    return b"".join(part + b"\n" for part in parts if part), lines[[bool(part) for part in parts]]


def _longest_run(faults: list[Fault]) -> int:
    """Return how many bad lines follow each other directly at most."""
    lines = [f.line for f in faults]
    ends = np.flatnonzero(np.diff([*lines, lines[-1] + 2]) > 1)
    return int(np.diff(ends, prepend=-1).max())
