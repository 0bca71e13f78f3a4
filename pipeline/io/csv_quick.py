"""A text log that is as it should be, read in one pass over blocks of some megabytes.

That is: no NUL bytes, carriage returns, quotes, empty lines, comments or other than ASCII characters, every cell a
finite number, a newline at the end. Anything else is left to ``pipeline.io.csv_careful``, which gives the same
numbers and says what is wrong.
"""

from __future__ import annotations

import hashlib
import os
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from pipeline.errors import IngestError
from pipeline.io.csv_columns import find_columns, refuse_twice
from pipeline.io.csv_layout import LineNumbers, column_notes, fields
from pipeline.io.csv_parse import all_finite, parse
from pipeline.io.csv_rows import Rows
from pipeline.io.csv_time import EXACT_BELOW_S, exact_times, seconds_per_unit
from pipeline.io.ingest_settings import AUTO, COMMENTED, WHITESPACE
from pipeline.io.text_file import unchanged

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from io import BufferedReader
    from pathlib import Path

    from numpy.typing import NDArray

    from pipeline.io.ingest_settings import Column, CsvFormat
    from pipeline.records import Note

BLOCK_BYTES = 1 << 20
LONGEST_PREAMBLE = 1 << 16
NEWLINE, LAST_OF_ASCII = ord("\n"), 127
ODD = (b"\0", b"\r", b'"')
EXACT = -1  # in place of a column's index: the times in ns


def read_quickly(path: Path, settings: CsvFormat) -> Rows | None:
    """Return the rows of a log that is as it should be, else None."""
    if settings.delimiter in (WHITESPACE, AUTO) or settings.comment is not None or settings.header == COMMENTED:
        return None
    with unchanged(path), path.open("rb") as stream:
        return _read_blocks(stream, str(path), settings)


def _read_blocks(stream: BufferedReader, path: str, settings: CsvFormat) -> Rows | None:
    digest = hashlib.sha256()
    lines = [stream.readline(LONGEST_PREAMBLE) for _ in range(settings.skip_lines + bool(settings.header))]
    found = _header(lines, path, settings)
    if found is None:
        return None
    for text in lines:
        digest.update(text)
    names, columns, first, notes = found
    size = os.fstat(stream.fileno()).st_size
    store = _Store(size)
    blocks = _Blocks(stream, size, digest.update)
    for data in blocks:
        if not names:  # no header: the first line says how many columns there are
            first_line = bytes(data).partition(b"\n")[0]
            names = [f"column {i}" for i in range(first_line.count(settings.delimiter.encode()) + 1)]
            columns = [(c, int(c.column)) for c in settings.columns if int(c.column) < len(names)]
            notes = column_notes(names, columns, 0)
        if not blocks.plain(len(data)) or not _parse_block(data, names, columns, settings, store):
            return None
    if blocks.rest or not store.rows:
        return None
    numbers = {i: store.column(i) for i in store.arrays if i != EXACT}
    exact = store.column(EXACT) if EXACT in store.arrays else None
    return Rows(path, digest.hexdigest(), names, columns, numbers, exact, LineNumbers(first), tuple(notes))


class _Blocks:
    """Whole lines of a file, some megabytes at a time, in one buffer that is used again.

    A block of a megabyte or two stays in the processor's cache while it is hashed, looked through and parsed.
    """

    def __init__(self, stream: BufferedReader, size: int, seen: Callable[[memoryview], None]) -> None:
        self.stream, self.size, self.seen = stream, size, seen
        self.buffer = bytearray(min(2 * BLOCK_BYTES, size))
        self.rest = 0  # bytes of a line that is not complete yet, at the buffer's beginning

    def __iter__(self) -> Iterator[memoryview]:
        """Yield blocks; what they hold is gone with the next."""
        while left := min(BLOCK_BYTES, max(self.size - self.stream.tell(), 0)):
            if self.rest + left > len(self.buffer):
                self.buffer = self.buffer + bytes(len(self.buffer))
            view = memoryview(self.buffer)
            count = self.stream.readinto(view[self.rest : self.rest + left])
            stop = self.rest + count
            self.seen(view[self.rest : stop])
            end = self.buffer.rfind(b"\n", self.rest, stop) + 1
            if count == 0:
                return
            if end:
                yield view[:end]
                self.buffer[: stop - end] = self.buffer[end:stop]
            self.rest = stop - end

    def plain(self, length: int) -> bool:
        """Return whether the first bytes of the buffer are ASCII without NUL, carriage return or quote."""
        odd = any(self.buffer.find(character, 0, length) >= 0 for character in ODD)
        return not odd and int(np.frombuffer(self.buffer, np.uint8, length).max()) <= LAST_OF_ASCII


class _Store:
    """Columns that grow block by block, in memory for as many rows as the file seems to have."""

    def __init__(self, size: int) -> None:
        self.size = size
        self.rows = 0
        self.arrays: dict[int, NDArray[Any]] = {}

    def append(self, columns: dict[int, NDArray[Any]], data: memoryview) -> None:
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
    return names, columns, len(lines) + 1, column_notes(names, columns, len(lines))


def _parse_block(
    data: memoryview,
    names: list[str],
    columns: list[tuple[Column, int]],
    settings: CsvFormat,
    store: _Store,
) -> bool:
    """Store the numbers of some lines; return whether all is as it should be."""
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
