"""The rows of a text log as numbers, read in one of two ways that give the same.

*Quickly*, in one pass over small blocks, where a log is as it should be: no NUL bytes, carriage returns, empty lines,
comments or other than ASCII characters, every cell a finite number, a newline at the end. *Carefully*, as a whole,
where anything is otherwise: what is wrong is named by its line, or repaired with a note where the profile says so.
"""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from pipeline.formats.csv_columns import find_columns, refuse_twice
from pipeline.formats.csv_fault import KIND_OF_SETTING, find_faults, refusal
from pipeline.formats.csv_layout import LineNumbers, fields, find_layout, ignored_columns
from pipeline.formats.csv_parse import all_finite, parse
from pipeline.formats.csv_settings import AUTO, COMMENTED, DROP, GAP, WHITESPACE
from pipeline.formats.csv_time import EXACT_BELOW_S, LONGEST_S, exact_times, seconds_per_unit
from pipeline.formats.ingest_error import IngestError
from pipeline.formats.text_file import load_text, unchanged
from pipeline.records import Note

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path
    from typing import BinaryIO

    from numpy.typing import NDArray

    from pipeline.formats.checks import Checks
    from pipeline.formats.csv_fault import Fault
    from pipeline.formats.csv_layout import Layout
    from pipeline.formats.csv_settings import Column, CsvFormat

BLOCK_BYTES = 1 << 22
NEWLINE = ord("\n")
EXACT = -1  # in place of a column's index: the times in ns
LONGEST_PREAMBLE = 1 << 16


@dataclass(frozen=True)
class Rows:
    """The numbers of a text log.

    Attributes
    ----------
    path, sha256 : str
    names : list of str
        All columns, for messages.
    columns : list of (Column, int)
        The channels that the file holds and the index of their column.
    numbers : dict of int to (n,) array
        Those columns, by index.
    exact_ns : (n,) array of int64, ns, or None
        Times from their decimal digits, where doubles are too coarse.
    line_of : LineNumbers
    notes : tuple of Note
    repaired : int
        Rows that were dropped, out of the budget.
    restarts : tuple of int
        Rows before which a header stood again.
    """

    path: str
    sha256: str
    names: list[str]
    columns: list[tuple[Column, int]]
    numbers: dict[int, NDArray[np.float64]]
    exact_ns: NDArray[np.int64] | None
    line_of: LineNumbers
    notes: tuple[Note, ...]
    repaired: int = 0
    restarts: tuple[int, ...] = ()

    @property
    def count(self) -> int:
        """Number of rows."""
        return len(next(iter(self.numbers.values()))) if self.numbers else 0


def read_rows(path: Path, settings: CsvFormat, checks: Checks) -> Rows:
    """Read the rows of a text log.

    Raises
    ------
    IngestError
        With ``path:line`` where a line is to blame.
    """
    return _read_quickly(path, settings) or read_carefully(path, settings, checks)


def _read_quickly(path: Path, settings: CsvFormat) -> Rows | None:
    """Return the rows of a log that is as it should be, else None."""
    if settings.delimiter in (WHITESPACE, AUTO) or settings.comment is not None or settings.header == COMMENTED:
        return None
    with unchanged(path), path.open("rb") as stream:
        return _read_blocks(stream, str(path), settings)


def _read_blocks(stream: BinaryIO, path: str, settings: CsvFormat) -> Rows | None:
    digest = hashlib.sha256()
    lines = [stream.readline(LONGEST_PREAMBLE) for _ in range(settings.skip_lines + bool(settings.header))]
    found = _header(lines, path, settings)
    if found is None:
        return None
    for text in lines:
        digest.update(text)
    names, columns, first, notes = found
    size = os.fstat(stream.fileno()).st_size
    store, rest = _Store(size), b""
    while chunk := stream.read(min(BLOCK_BYTES, max(size - stream.tell(), 0))):
        digest.update(chunk)
        end = chunk.rfind(b"\n") + 1
        data, rest = rest + chunk[:end], chunk[end:] if end else rest + chunk
        if not end:
            continue
        if not names:  # no header: the first line says how many columns there are
            names = [f"column {i}" for i in range(data.partition(b"\n")[0].count(settings.delimiter.encode()) + 1)]
            columns = [(c, int(c.column)) for c in settings.columns if int(c.column) < len(names)]
            notes = ignored_columns(names, columns, 0)
        if not _parse_block(data, names, columns, settings, store):
            return None
    if rest or not store.rows:
        return None
    numbers = {i: store.column(i) for i in store.arrays if i != EXACT}
    exact = store.column(EXACT) if EXACT in store.arrays else None
    return Rows(path, digest.hexdigest(), names, columns, numbers, exact, LineNumbers(first), tuple(notes))


class _Store:
    """Columns that grow block by block, in memory for as many rows as the file seems to have."""

    def __init__(self, size: int) -> None:
        self.size = size
        self.rows = 0
        self.arrays: dict[int, NDArray[Any]] = {}

    def append(self, columns: dict[int, NDArray[Any]], data: bytes) -> None:
        """Append the rows of some data."""
        count = len(next(iter(columns.values())))
        for index, values in columns.items():
            have = self.arrays.get(index)
            if have is None or len(have) < self.rows + count:
                room = int(1.02 * (self.rows + count) * max(self.size / len(data) if not self.rows else 1.3, 1.0)) + 16
                grown = np.empty(room, values.dtype)
                if have is not None:
                    grown[: self.rows] = have[: self.rows]
                self.arrays[index] = have = grown
            have[self.rows : self.rows + count] = values
        self.rows += count

    def column(self, index: int) -> NDArray[Any]:
        """Return a column's values."""
        return self.arrays[index][: self.rows]


def _header(
    lines: Sequence[bytes], path: str, settings: CsvFormat
) -> tuple[list[str], list[tuple[Column, int]], int, list[Note]] | None:
    """Return names, columns, the first line of data and notes; None where anything about the header is odd."""
    if not all(line.endswith(b"\n") and line.isascii() and not set(b"\r\0") & set(line) for line in lines):
        return None
    if not settings.header:
        return [], [], settings.skip_lines + 1, []
    names = fields(lines[-1][:-1].decode("ascii"), settings.delimiter)
    try:
        refuse_twice(names, path)
        columns = find_columns(names, settings, path, b"")
    except IngestError:
        return None
    return names, columns, len(lines) + 1, ignored_columns(names, columns, len(lines))


def _parse_block(
    data: bytes,
    names: list[str],
    columns: list[tuple[Column, int]],
    settings: CsvFormat,
    store: _Store,
) -> bool:
    """Store the numbers of some lines; return whether all is as it should be."""
    if b"\0" in data or b"\r" in data or b'"' in data or not data.isascii():
        return False
    wanted = sorted({index for _, index in columns})
    try:
        table = parse(data, settings.delimiter, settings.decimal, len(names), dict.fromkeys(wanted, pa.float64()))
        if table.num_rows != np.count_nonzero(np.frombuffer(data, np.uint8) == NEWLINE) or not all_finite(table):
            return False  # empty lines are skipped in silence
        new: dict[int, NDArray[Any]] = {i: table.column(str(i)).to_numpy() for i in wanted}
        clock = next(((c, i) for c, i in columns if c.channel == "time"), None)
        if (
            clock is not None
            and settings.tick_ns is None
            and _needs_digits(clock[0], new[clock[1]], EXACT in store.arrays)
        ):
            if store.rows and EXACT not in store.arrays:
                return False  # times grow too large on the way: read as a whole
            dialect = settings.delimiter, settings.decimal
            new[EXACT] = exact_times(data, dialect, len(names), clock[1], clock[0].unit)
    except pa.ArrowInvalid:
        return False
    store.append(new, data)
    return True


def _needs_digits(column: Column, values: NDArray[np.float64], before: bool) -> bool:  # noqa: FBT001
    return before or bool(np.abs(values[[0, -1]]).max() * seconds_per_unit(column.unit) >= EXACT_BELOW_S)


def read_carefully(path: Path, settings: CsvFormat, checks: Checks) -> Rows:
    """Read the rows of a log as a whole, name what is wrong, drop what may be dropped."""
    text = load_text(path, keep_nul=settings.bad_rows == DROP)
    layout = find_layout(text, settings)
    notes, repaired, restarts = list(layout.notes), 0, tuple[int, ...]()
    table = _numbers(layout)
    if table is None:
        layout, repaired, restarts = _without_faults(layout, settings, checks, notes)
        table = _numbers(layout)
        if table is None:
            raise refusal(layout, find_faults(layout), "its rows cannot be told apart")
    numbers = {i: table.column(str(i)).to_numpy() for i in {index for _, index in layout.columns}}
    clock = next(((c, i) for c, i in layout.columns if c.channel == "time"), None)
    exact = None
    if clock is not None and settings.tick_ns is None:
        largest = float(np.abs(numbers[clock[1]]).max()) * seconds_per_unit(clock[0].unit)
        if largest >= EXACT_BELOW_S:
            arguments = ((layout.delimiter, layout.decimal), len(layout.names), clock[1], clock[0].unit)
            exact = exact_times(layout.body, *arguments) if largest < LONGEST_S else None
    return Rows(
        text.path, text.sha256, layout.names, layout.columns, numbers, exact, layout.line_of, tuple(notes), repaired,
        restarts,
    )  # fmt: skip


def _numbers(layout: Layout) -> Any:  # noqa: ANN401  (pyarrow has no types)
    """Return the wanted columns as doubles, None where a line is not as it should be."""
    wanted = sorted({index for _, index in layout.columns})
    if b"\0" in layout.body:
        return None
    try:
        types = dict.fromkeys(wanted, pa.float64())
        table = parse(layout.body, layout.delimiter, layout.decimal, len(layout.names), types)
    except pa.ArrowInvalid:
        return None
    return table if table.num_rows == layout.body.count(b"\n") and all_finite(table) else None


def _without_faults(
    layout: Layout, settings: CsvFormat, checks: Checks, notes: list[Note]
) -> tuple[Layout, int, tuple[int, ...]]:
    """Return the layout without its bad lines, how many rows were given up, and where the log was restarted."""
    faults = find_faults(layout)
    rows = layout.body.count(b"\n")
    tail = [f for f in faults if f.short and f.row == rows - 1]
    headers = [f for f in faults if f.kind == "restarted"]
    others = [f for f in faults if f not in tail and f not in headers]
    allowed = {"bad_rows": settings.bad_rows == DROP, "nan": settings.nan == GAP}
    refused = [f for f in others if not allowed[KIND_OF_SETTING.get(f.kind, "bad_rows")]]
    if refused or (headers and settings.session is None) or not faults:
        raise refusal(layout, refused + headers if refused or headers else faults, "its rows cannot be told apart")
    if len(others) > checks.repaired_rows * rows:
        raise over_budget(refusal(layout, others, ""), len(others), rows, checks)
    for fault in tail:
        detail = f"the last line is cut, so it was dropped: {fault.text[:200]!r}"
        notes.append(Note("N-TAIL", 1, fault.line, fault.line, detail))
    for code, kinds, what in (
        ("N-BADROW", ("bad_row", "nul", "not_a_number", "decimal_comma"), "rows that cannot be read were dropped"),
        ("N-NAN", ("not_finite",), "rows without a finite number were dropped"),
    ):
        dropped = [f for f in others if f.kind in kinds]
        if dropped:
            detail = f"{what}, each a gap; the first: {dropped[0].message}"
            notes.append(Note(code, len(dropped), dropped[0].line, dropped[-1].line, detail))
    starts = tuple(h.row - sum(f.row < h.row for f in faults) for h in headers)
    return _without_lines(layout, faults, rows), len(others), starts


def over_budget(error: IngestError, touched: int, rows: int, checks: Checks) -> IngestError:
    """Return a refusal for more repairs than the profile allows."""
    hint = (
        f"{touched} of {rows} rows would have to be repaired, more than the share of {checks.repaired_rows:g} that "
        "ingest.checks.repaired_rows allows"
    )
    return IngestError(error.fact, error.file, fault=error.fault, hint=hint)


def _without_lines(layout: Layout, faults: list[Fault], rows: int) -> Layout:
    keep = np.ones(rows, bool)
    keep[[f.row for f in faults]] = False
    index = np.flatnonzero(keep)
    parts = layout.body.split(b"\n")
    body = b"".join(parts[i] + b"\n" for i in index)
    if not body:
        raise refusal(layout, faults, "no row can be read")
    return replace(layout, body=body, line_of=layout.line_of.select(index))
