"""A text log as blocks of text cells, for programs that change some columns and write the others unchanged.

A cell stays text until its column is asked for as numbers. The lines before the data (skipped lines, comments, the
header) are kept, except for changed names.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import IO, TYPE_CHECKING

import numpy as np
import pyarrow as pa
from pyarrow import compute as pc
from pyarrow import csv as arrow_csv

from pipeline.errors import InputError
from pipeline.io.csv_header import fields, find_delimiter, single_blanks
from pipeline.io.ingest_settings import COMMENTED, WHITESPACE

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from pipeline.io.ingest_settings import CsvFormat

LONGEST_LINE = 1 << 20  # bytes, of a line before the data
DECIMALS = 12  # far below any sensor's resolution, above the rounding of a double


@dataclass(frozen=True)
class Head:
    """The lines before the data, without the header; the header line (None: there is none) and its names.

    ``names`` are ``column 0`` ... where there is no header. The data begin at byte ``start``.
    """

    lines: list[str]
    header: str | None
    names: list[str]
    delimiter: str
    start: int

    def text(self, names: list[str]) -> str:
        """Return the lines before the data, with other names where they differ."""
        header = self.header
        if header is not None and names != self.names:
            mark = header[: len(header) - len(header.lstrip("#%/;! "))]
            cells = (f'"{name}"' if set(name) & {self.delimiter, '"'} else name for name in names)
            header = mark + self.delimiter.join(cells)
        return "".join(f"{line}\n" for line in [*self.lines, *([] if header is None else [header])])


def read_head(raw: IO[bytes], settings: CsvFormat, source: Path) -> Head:
    """Read a log up to its data.

    Raises
    ------
    InputError
        If there is no header where there should be one, or a line is not UTF-8.
    """
    lines: list[str] = []
    while True:
        start = raw.tell()
        try:
            line = raw.readline(LONGEST_LINE).decode("utf-8" if lines else "utf-8-sig")
        except UnicodeDecodeError as error:
            raise InputError(f"this line is not UTF-8: {error.reason}", f"{source}:{len(lines) + 1}") from None
        comment = settings.comment is not None and line.lstrip().startswith(settings.comment)
        if not line or not (len(lines) < settings.skip_lines or comment):
            break
        lines.append(line.rstrip("\r\n"))
    first = line.rstrip("\r\n")
    header: str | None = None
    if settings.header is True:
        header, start = first, raw.tell()
    elif settings.header == COMMENTED and lines:
        first = header = lines.pop()
    if not first.strip():
        raise InputError("the file is empty; expected a header with the names of the columns", f"{source}:1")
    delimiter = find_delimiter(settings, first)
    if settings.delimiter == WHITESPACE:
        first = " ".join(first.split())
    names = fields(first.lstrip(settings.comment or ""), delimiter)
    if header is None:
        names = [f"column {i}" for i in range(len(names))]
    return Head(lines, header, names, delimiter, start)


@dataclass(frozen=True)
class TextBlock:
    """Rows of a text log as columns of text.

    ``quoted``: cells may have to be quoted. ``data``: the lines as they were read, the first of which has the number
    ``line``, counted from 1; those that start with ``comment`` are no rows.
    """

    columns: list[pa.Array]
    quoted: bool
    data: bytes
    comment: str | None
    line: int

    @property
    def rows(self) -> int:
        """Number of rows."""
        return len(self.columns[0])

    def line_of(self, row: int) -> int:
        """Return the line of a row, counted from 1."""
        mark = (self.comment or "\0").encode()
        parts = enumerate(self.data.split(b"\n"), self.line)
        lines = [i for i, part in parts if part.strip(b"\r") and not part.lstrip().startswith(mark)]
        return lines[row] if row < len(lines) else self.line

    def numbers(self, where: list[int], decimal: str, names: list[str], source: Path) -> NDArray[np.float64]:
        """Return columns as numbers, NaN where a cell is empty: (n, k) array.

        Raises
        ------
        InputError
            Naming the line of a cell that is no number.
        """
        out = np.empty((self.rows, len(where)))
        for k, i in enumerate(where):
            text = self.columns[i] if decimal == "." else pc.replace_substring(self.columns[i], decimal, ".")
            try:
                out[:, k] = pc.cast(text, pa.float64()).to_numpy(zero_copy_only=False)
                continue
            except pa.ArrowInvalid:  # blanks, empty cells, or no number
                trimmed = pc.utf8_trim_whitespace(text)
                text = pc.if_else(pc.equal(trimmed, ""), pa.scalar(None, pa.string()), trimmed)
            try:
                out[:, k] = pc.cast(text, pa.float64()).to_numpy(zero_copy_only=False)
            except pa.ArrowInvalid:
                row, cell = next((r, c) for r, c in enumerate(text.to_pylist()) if c is not None and not _is_number(c))
                place = f"{source}:{self.line_of(row)}"
                raise InputError(f"{names[i]} is {cell!r}; expected a number", place) from None
        return out


def text_blocks(raw: IO[bytes], head: Head, settings: CsvFormat, block_bytes: int, source: Path) -> Iterator[TextBlock]:
    """Yield the rows as text, block by block."""
    names = [str(i) for i in range(len(head.names))]
    convert = arrow_csv.ConvertOptions(
        column_types=dict.fromkeys(names, pa.string()), strings_can_be_null=False, check_utf8=True
    )
    line = len(head.lines) + 1 + (head.header is not None)
    for data in _whole_lines(raw, head.start, block_bytes):
        rows = _rows_only(data, settings)
        quoted = b'"' in rows
        read = arrow_csv.ReadOptions(use_threads=False, block_size=len(rows) + 1, column_names=names)
        parse = arrow_csv.ParseOptions(delimiter=head.delimiter, quote_char='"' if quoted else False)
        if rows.strip():
            try:
                table = arrow_csv.read_csv(pa.py_buffer(rows), read, parse, convert)
            except pa.ArrowInvalid as error:
                what = f"the log is no table of {len(names)} columns from here on: {error}"
                raise InputError(what, f"{source}:{line}") from None
            columns = [column.combine_chunks() for column in table.columns]
            yield TextBlock(columns, quoted, data, settings.comment, line)
        line += data.count(b"\n")


def _whole_lines(raw: IO[bytes], start: int, block_bytes: int) -> Iterator[bytes]:
    raw.seek(start)
    rest = b""
    while part := raw.read(block_bytes):
        end = part.rfind(b"\n") + 1
        if end:
            yield rest + part[:end]
        rest = part[end:] if end else rest + part
    if rest:
        yield rest


def _rows_only(data: bytes, settings: CsvFormat) -> bytes:
    """Return lines without comments and with one blank between cells that blanks separate."""
    if settings.comment is not None and settings.comment.encode() in data:
        mark = settings.comment.encode()
        data = b"".join(part for part in data.splitlines(keepends=True) if not part.lstrip().startswith(mark))
    if settings.delimiter == WHITESPACE:
        data = single_blanks(data.replace(b"\r\n", b"\n").rstrip(b"\n") + b"\n")
    return data


def _is_number(cell: str) -> bool:
    try:
        pc.cast(pa.scalar(cell), pa.float64())
    except pa.ArrowInvalid:
        return False
    return True


def digits(values: NDArray[np.float64], decimal: str) -> pa.Array:
    """Return numbers as text, rounded to 1e-12."""
    text = pc.cast(pa.array(np.round(values, DECIMALS) + 0.0), pa.string())
    return text if decimal == "." else pc.replace_substring(text, ".", decimal)


def lines_of(columns: list[pa.Array], delimiter: str, *, quoted: bool) -> memoryview:
    """Return the rows as the lines of a text file."""
    cells = [_quoted(column, delimiter) for column in columns] if quoted else list(columns)
    cells[-1] = pc.binary_join_element_wise(cells[-1], "\n", "")
    lines = pc.binary_join_element_wise(*cells, delimiter) if len(cells) > 1 else cells[0]
    ends = np.frombuffer(lines.buffers()[1], np.int32, len(lines) + 1, 4 * lines.offset)
    return memoryview(lines.buffers()[2])[ends[0] : ends[-1]]


def _quoted(column: pa.Array, delimiter: str) -> pa.Array:
    """Quote the cells that would not read back as one cell."""
    special = pc.match_substring_regex(column, f'["{delimiter}\r\n]')
    if not pc.any(special).as_py():
        return column
    doubled = pc.replace_substring(column, '"', '""')
    return pc.if_else(special, pc.binary_join_element_wise('"', doubled, '"', ""), column)
