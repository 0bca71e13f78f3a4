"""A text log as blocks of text cells: for programs that change some columns and keep the others as written.

Every cell is text until a column is asked for as numbers, so that nothing is lost in what is not changed. What stands
before the data (lines that are skipped, comments, the header) is kept as it is, but for the names.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import IO, TYPE_CHECKING

import numpy as np
import pyarrow as pa
from pyarrow import compute as pc
from pyarrow import csv as arrow_csv

from pipeline.errors import InputError
from pipeline.io.csv_header import DELIMITERS, fields, single_blanks
from pipeline.io.ingest_settings import AUTO, COMMENTED, WHITESPACE

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from pipeline.io.ingest_settings import CsvFormat

LONGEST_LINE = 1 << 20
DECIMALS = 12  # far below any sensor's resolution, above the rounding of a double


@dataclass(frozen=True)
class Head:
    """What stands before the data.

    Attributes
    ----------
    lines : list of str
        As they are, without the header.
    header : str or None
        The line with the names, as it is; None where there is none.
    names : list of str
        Of the columns; ``column 0`` and so on where there is no header.
    delimiter : str
    start : int
        Byte at which the data begin.
    """

    lines: list[str]
    header: str | None
    names: list[str]
    delimiter: str
    start: int

    def text(self, names: list[str]) -> str:
        """Return what stands before the data, with other names where they differ."""
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
        If there is no header where there should be one, or what stands there is no text.
    """
    lines: list[str] = []
    while True:
        start = raw.tell()
        line = _decoded(raw.readline(LONGEST_LINE), f"{source}:{len(lines) + 1}")
        comment = settings.comment is not None and line.lstrip().startswith(settings.comment)
        if not line or not (len(lines) < settings.skip_lines or comment):
            break
        lines.append(line.rstrip("\r\n"))
    header: str | None = line.rstrip("\r\n") if settings.header is True else None
    if settings.header is True:
        start = raw.tell()
    elif settings.header == COMMENTED and lines:
        header = lines.pop()
    first = header or line.rstrip("\r\n")
    if not first.strip():
        raise InputError("the file is empty; expected a header with the names of the columns", f"{source}:1")
    delimiter = settings.delimiter
    if delimiter == AUTO:
        delimiter = max(DELIMITERS, key=first.count)
    if delimiter == WHITESPACE:
        delimiter, first = " ", " ".join(first.split())
    names = fields(first.lstrip(settings.comment or ""), delimiter)
    if header is None:
        names = [f"column {i}" for i in range(len(names))]
    return Head(lines, header, names, delimiter, start)


def _decoded(line: bytes, where: str) -> str:
    try:
        return line.decode("utf-8-sig" if where.endswith(":1") else "utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"this line is not UTF-8: {error.reason}", where) from None


@dataclass(frozen=True)
class TextBlock:
    """Some rows of a text log.

    Attributes
    ----------
    columns : list of Array of text
    quoted : bool
        Whether cells may have to be quoted.
    data : bytes
        The lines, as they were read.
    comment : str or None
    line : int
        Number of their first line, counted from 1.
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

    @cached_property
    def _lines(self) -> list[int]:
        parts = self.data.split(b"\n")
        mark = (self.comment or "\0").encode()
        return [i for i, part in enumerate(parts) if part.strip(b"\r") and not part.lstrip().startswith(mark)]

    def line_of(self, row: int) -> int:
        """Return the line of a row, counted from 1."""
        return self.line + self._lines[row] if row < len(self._lines) else self.line

    def numbers(self, where: list[int], decimal: str, names: list[str], source: Path) -> NDArray[np.float64]:
        """Return columns as numbers, NaN where a cell is empty: (n, k) array.

        Raises
        ------
        InputError
            Naming the line of a cell that is no number.
        """
        out = np.empty((self.rows, len(where)))
        for k, i in enumerate(where):
            text = self.columns[i]
            if decimal != ".":
                text = pc.replace_substring(text, decimal, ".")
            try:
                out[:, k] = pc.cast(text, pa.float64()).to_numpy(zero_copy_only=False)
            except pa.ArrowInvalid:
                out[:, k] = self._carefully(text, names[i], source)
        return out

    def _carefully(self, text: pa.Array, name: str, source: Path) -> NDArray[np.float64]:
        """Read a column with blanks, empty cells, or what is no number."""
        trimmed = pc.utf8_trim_whitespace(text)
        filled = pc.if_else(pc.equal(trimmed, ""), pa.scalar(None, pa.string()), trimmed)
        try:
            return np.asarray(pc.cast(filled, pa.float64()).to_numpy(zero_copy_only=False), np.float64)
        except pa.ArrowInvalid:
            row, cell = next((r, c) for r, c in enumerate(filled.to_pylist()) if c is not None and not _is_number(c))
            raise InputError(f"{name} is {cell!r}; expected a number", f"{source}:{self.line_of(row)}") from None


def text_blocks(raw: IO[bytes], head: Head, settings: CsvFormat, block_bytes: int, source: Path) -> Iterator[TextBlock]:
    """Yield the rows as text, some at a time."""
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
