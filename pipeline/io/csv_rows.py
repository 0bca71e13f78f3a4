"""The rows of a text log as numbers, read in blocks of whole lines.

Lines that are no rows of numbers are refused by their number, or dropped with a note where the profile allows it. Empty
lines and comments are left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import IngestError
from pipeline.io.csv_layout import Fault, Layout, column_notes, find_columns, find_faults, refusal
from pipeline.io.csv_times import (
    EXACT_BELOW_S,
    LONGEST_S,
    exact_times,
    lines_of_session,
    over_budget,
    seconds_per_unit,
    time_column,
    whole_times,
)
from pipeline.io.files import unchanged
from pipeline.io.ingest_settings import AUTO, DROP, GAP
from pipeline.io.text_log import TextLog
from pipeline.records import Note

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from pipeline.io.ingest_settings import Checks, CsvFormat
    from pipeline.records import Index, Integers, Values

LINES_BELOW, SEARCHED_BELOW = 60, 10_000  # lines, bytes after a header without the columns, searched for another
LINES, EXACT = -1, -2  # in place of a column's index: numbers of the lines, times in ns
MOST_REFUSED = 10_000  # bad lines after which the rest of the file is not searched for more


@dataclass(frozen=True)
class Rows:
    """The rows of a text log as numbers.

    Attributes
    ----------
    numbers : dict of int to (n,) array
        The columns in use, by index.
    lines : (n,) array of int64
        The line of each row, counted from 1.
    exact_ns : (n,) array of int64, ns, or None
        Times from their decimal digits, where doubles are too coarse.
    repaired : int
        Rows that were dropped, which count against ``repaired_rows``.
    restarts : tuple of int
        Rows before which the header was repeated.
    flags : (n,) array of uint16, or None
        Rows that were sorted.
    refused : IngestError, or None
        The refusal of lines that are no rows; it is raised once the times are read, to name their faults as well.
    """

    layout: Layout
    sha256: str
    numbers: dict[int, Values]
    lines: Integers
    exact_ns: Integers | None
    notes: tuple[Note, ...]
    repaired: int = 0
    restarts: tuple[int, ...] = ()
    flags: NDArray[np.uint16] | None = None
    refused: IngestError | None = None

    def place(self, row: int) -> str:
        """Return ``path:line`` of a row."""
        return f"{self.layout.path}:{self.lines[row]}"

    def select(self, index: Index, *notes: Note) -> Rows:
        """Return some rows, in their order, with further notes."""
        numbers = {i: values[index] for i, values in self.numbers.items()}
        return replace(
            self, numbers=numbers, lines=self.lines[index], exact_ns=None, restarts=(), notes=(*self.notes, *notes)
        )


def read_rows(path: Path, settings: CsvFormat, checks: Checks) -> Rows:
    """Return the rows of a file in its own order; an ``IngestError`` names the line."""
    with unchanged(path), path.open("rb") as stream:
        log = TextLog(stream, str(path), settings)
        reader = _RowReader(log)
        for body, lines in log:
            reader.add(body, lines)
        return reader.rows(checks)


class _RowReader:
    """Numbers of a text log, gathered block by block."""

    def __init__(self, log: TextLog) -> None:
        self.log, self.path, self.settings = log, log.path, log.settings
        self.allowed = {"not_finite"} if self.settings.nan == GAP else set()
        if self.settings.bad_rows == DROP:
            self.allowed |= {"bad_row", "nul", "not_a_number", "decimal_comma"}
        if self.settings.session is not None:
            self.allowed.add("restarted")
        self.layout: Layout | None = None
        self.notes: list[Note] = []
        self.row_count = 0  # bad ones as well
        self.blocks: list[dict[int, NDArray[Any]]] = []  # columns of the valid rows
        self.faults: list[Fault] = []
        self.refused: list[Fault] = []
        self.last_row: tuple[int, str] | None = None

    def add(self, body: bytes, lines: Integers) -> None:
        """Add a block of rows with these numbers of lines."""
        layout = self.layout = self.layout or self._find_layout(body, lines)
        numbers = layout.numbers(body, len(lines))
        self.row_count += len(lines)
        if numbers is None:
            body, lines, numbers = self._valid_rows(layout, body, lines)
        else:
            self.last_row = int(lines[-1]), body[body.rfind(b"\n", 0, -1) + 1 : -1].decode("utf-8", "replace")
        if numbers:
            self.blocks.append(numbers | {LINES: lines} | self._exact_times(layout, body, numbers))

    def rows(self, checks: Checks) -> Rows:
        """Return all rows, without those that may be dropped."""
        if self.layout is None:
            raise self.log.no_rows()
        columns = {
            k: np.concatenate([b.pop(k) for b in self.blocks]) for k in list(self.blocks[0] if self.blocks else ())
        }
        parted = [f.line for f in self.faults if f.parted_before]
        if parted and columns:
            keep = ~np.isin(columns[LINES], parted)
            columns = {k: values[keep] for k, values in columns.items()}
        if not columns or not columns[LINES].size:
            raise refusal(self.layout, self.faults)
        lines, exact_ns = columns.pop(LINES), columns.pop(EXACT, None)
        restarts = np.searchsorted(lines, [f.line for f in self.faults if f.kind == "restarted"])
        rows = Rows(self.layout, self.log.sha256, columns, lines, exact_ns, (), 0, tuple(restarts.tolist()))
        if self.faults and self.settings.session is not None:
            part = lines_of_session(rows, self.settings)
            self.faults, self.refused = ([f for f in found if f.line in part] for found in (self.faults, self.refused))
        notes, repaired, refused = self._drop_faults(self.layout, checks, int(lines[-1]))
        return replace(rows, notes=(*self.log.notes, *self.notes, *notes), repaired=repaired, refused=refused)

    def _find_layout(self, body: bytes, lines: Integers) -> Layout:
        """Return which column holds which channel."""
        head, settings = self.log.head, self.settings
        assert head is not None  # noqa: S101  (rows follow it)
        text = body[:SEARCHED_BELOW].decode("utf-8", "replace").split("\n")[:LINES_BELOW]
        below = dict(zip(lines.tolist(), text, strict=False))
        columns = find_columns(head.names, settings, f"{self.path}:{head.line}", below)
        if settings.delimiter == AUTO:
            self.notes.append(Note("N-DELIM", 1, 0, 0, f"the separator is {head.delimiter!r}, by the header"))
        self.notes += column_notes(head.names, columns, head.line if settings.header is True else 0)
        return Layout(self.path, head.names, columns, head.delimiter, settings.decimal)

    def _valid_rows(self, layout: Layout, body: bytes, lines: Integers) -> tuple[bytes, Integers, dict[int, Values]]:
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

    def _exact_times(self, layout: Layout, body: bytes, numbers: dict[int, Values]) -> dict[int, Integers]:
        """Return the times from their digits, from the first that a double does not hold to half a nanosecond."""
        if self.settings.rate_hz is not None or self.settings.tick_ns is not None:
            return {}
        column, index = time_column(layout)
        largest = float(np.abs(numbers[index]).max()) * seconds_per_unit(column.unit)
        if not (self.blocks and EXACT in self.blocks[0]):
            if largest < EXACT_BELOW_S:
                return {}
            for block in self.blocks:
                block[EXACT] = whole_times(block[index], column.unit)
        out_of_range = largest >= LONGEST_S  # refused later
        return {EXACT: np.zeros(len(numbers[index]), np.int64) if out_of_range else exact_times(layout, body)}

    def _drop_faults(self, layout: Layout, checks: Checks, last: int) -> tuple[list[Note], int, IngestError | None]:
        """Return notes on the lines that are dropped, how many count against the limit of repairs, and a refusal."""
        if not self.faults:
            return [], 0, None
        final = self.faults[-1]
        end = max(final.line, last)
        cut = {final.line} if final.short and final.line == end else set()
        tail = [f for f in self.faults if f.line in cut or f.parted_before in cut]
        others = [f for f in self.faults if f not in tail and f.kind != "restarted"]
        refused = [f for f in self.refused if f not in tail]
        if refused:
            return [], 0, refusal(layout, refused)
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
        return notes, len(others), None


def _longest_run(faults: list[Fault]) -> int:
    """Return how many bad lines follow each other directly at most."""
    lines = [f.line for f in faults]
    ends = np.flatnonzero(np.diff([*lines, lines[-1] + 2]) > 1)
    return int(np.diff(ends, prepend=-1).max())
