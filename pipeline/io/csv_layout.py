"""Where the columns of a text log lie: preamble, header, data, and which column holds which channel.

Columns are found by name, never by position, unless the profile says that there is no header. What is no data line
(empty, or a comment where the profile says how comments start) is left out; ``LineNumbers`` keeps the way back to the
lines of the file.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import IngestError
from pipeline.io.csv_columns import find_columns, refuse_twice
from pipeline.io.ingest_settings import AUTO, COMMENTED, WHITESPACE
from pipeline.io.units import TRIADS
from pipeline.records import Note

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.io.ingest_settings import Column, CsvFormat
    from pipeline.io.text_file import TextFile

DELIMITERS = ",;\t|"


@dataclass(frozen=True)
class LineNumbers:
    """Rows, counted from 0, to lines of the file, counted from 1.

    Attributes
    ----------
    first : int
        Line of the first row, where every line from there on is a row.
    lines : (n,) array of int64, or None
        The line of each row, where some lines are no rows.
    """

    first: int
    lines: NDArray[np.int64] | None = None

    def __call__(self, row: int) -> int:
        """Return the line of a row; 0 where there is no such row."""
        if self.lines is None:
            return self.first + row
        return int(self.lines[row]) if row < len(self.lines) else 0

    def select(self, index: NDArray[np.intp]) -> LineNumbers:
        """Return the lines of some rows, in their order."""
        return LineNumbers(self.first, index + self.first if self.lines is None else self.lines[index])


@dataclass(frozen=True)
class Layout:
    """The data of a text log and the place of each channel in it.

    Attributes
    ----------
    path : str
    body : bytes
        The data lines, fields separated by ``delimiter``.
    line_of : LineNumbers
    delimiter : str
    decimal : str
    names : list of str
        All columns, for messages.
    columns : list of (Column, int)
        The channels that the file holds and the index of their column.
    notes : tuple of Note
    """

    path: str
    body: bytes
    line_of: LineNumbers
    delimiter: str
    decimal: str
    names: list[str]
    columns: list[tuple[Column, int]]
    notes: tuple[Note, ...]


def find_layout(text: TextFile, settings: CsvFormat) -> Layout:
    """Find header and data of a text log.

    Raises
    ------
    IngestError
        If there are no data, a column that is needed is missing, or a name stands twice.
    """
    start, line = _after_lines(text, settings.skip_lines)
    body, notes = text.data[start:], list(text.notes)
    lines = LineNumbers(line)
    head = None
    if settings.comment is not None:
        body, lines, head = _without_comments(body, line, settings.comment, notes)
    delimiter = _delimiter(settings, (head or body).lstrip(b"\n").partition(b"\n")[0], notes)
    if settings.delimiter == WHITESPACE:
        body, delimiter = single_blanks(body), " "
    if settings.header == COMMENTED:
        first, names = body.partition(b"\n")[0], _commented_names(head, settings, delimiter, text.path)
    elif settings.header:
        first, _, body = body.partition(b"\n")
        names = fields(first.decode("utf-8"), delimiter)
        at, lines = lines(0), _without_first(lines)
    else:
        first = body.lstrip(b"\n").partition(b"\n")[0]
        names = [f"column {i}" for i in range(len(fields(first.decode("utf-8"), delimiter)))]
    at = at if settings.header is True else lines(0)
    if not body or body.isspace():
        found = f"header on line {at}, " if settings.header else ""
        raise IngestError(f"{found}0 data rows; at least 2 are needed", text.path, fault="no_rows")
    where = f"{text.path}:{at}"
    refuse_twice(names, where)
    columns = find_columns(names, settings, where, body, first)
    body, lines = without_empty_lines(body, lines)
    notes += column_notes(names, columns, at if settings.header is True else 0)
    return Layout(text.path, body, lines, delimiter, settings.decimal, names, columns, tuple(notes))


def column_notes(names: list[str], columns: list[tuple[Column, int]], line: int) -> list[Note]:
    """Return notes on axes in another order than x, y, z and on columns that the profile does not ask for."""
    place = {column.channel: index for column, index in columns if isinstance(column.column, str)}
    turned = [t for t in TRIADS.values() if set(t) <= place.keys() and sorted(t, key=lambda c: place[c]) != list(t)]
    listed = [names[i] for i in sorted(place[c] for t in turned for c in t)]
    detail = f"axes stand in the order {', '.join(listed)} and were taken by their names"
    notes = [Note("N-ORDER", len(listed), line, line, detail)] if turned else []
    used = {index for _, index in columns}
    ignored = [n for i, n in enumerate(names) if i not in used]
    detail = f"columns not used: {', '.join(ignored)}"
    return notes + ([Note("N-IGNORED", len(ignored), line, line, detail)] if ignored else [])


def fields(line: str, delimiter: str) -> list[str]:
    """Return the fields of a line, without blanks around them."""
    return [name.strip() for name in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])]


def single_blanks(body: bytes) -> bytes:
    """Turn every run of blanks and tabs into one blank, none at the ends of lines."""
    body = body.replace(b"\t", b" ")
    while b"  " in body:
        body = body.replace(b"  ", b" ")
    return body.replace(b"\n ", b"\n").replace(b" \n", b"\n").lstrip(b" ")


def without_empty_lines(body: bytes, lines: LineNumbers) -> tuple[bytes, LineNumbers]:
    """Return data without empty lines, and the lines that are left."""
    if b"\n\n" not in body and not body.startswith(b"\n"):
        return body, lines
    ends = np.flatnonzero(np.frombuffer(body, np.uint8) == ord("\n"))
    kept = np.flatnonzero(np.diff(ends, prepend=-1) > 1)
    return b"\n".join(part for part in body.split(b"\n") if part) + b"\n", lines.select(kept)


def _after_lines(text: TextFile, count: int) -> tuple[int, int]:
    """Return the byte after ``count`` lines and the number of the line that starts there."""
    start = 0
    for _ in range(count):
        start = text.data.find(b"\n", start) + 1
        if start == 0:
            raise IngestError(
                f"the file ends within the {count} lines that ingest.csv.skip_lines skips", text.path, fault="no_rows"
            )
    return start, count + 1


def _without_first(lines: LineNumbers) -> LineNumbers:
    return LineNumbers(lines.first + 1, None if lines.lines is None else lines.lines[1:])


def _without_comments(body: bytes, first: int, comment: str, notes: list[Note]) -> tuple[bytes, LineNumbers, bytes]:
    """Return the lines that are no comments, where they stand, and the last comment before the first of them."""
    parts, mark = body.split(b"\n")[:-1], comment.encode()
    is_comment = [part.lstrip().startswith(mark) for part in parts]
    kept = np.flatnonzero(~np.array(is_comment, bool))
    found = np.flatnonzero(is_comment)
    head = b""
    if found.size:
        before = found[: np.searchsorted(found, kept[0] if kept.size else len(parts))]
        head = parts[before[-1]].lstrip()[len(mark) :] if before.size else b""
        detail = f"lines that start with {comment!r} are no data"
        notes.append(Note("N-COMMENT", found.size, first + int(found[0]), first + int(found[-1]), detail))
    return b"".join(parts[i] + b"\n" for i in kept), LineNumbers(first, kept + first), head


def _commented_names(head: bytes | None, settings: CsvFormat, delimiter: str, path: str) -> list[str]:
    if not head:
        raise IngestError(
            f"no line that starts with {settings.comment!r} stands before the data, where ingest.csv.header looks for "
            "the column names",
            path,
            fault="no_header",
        )
    if settings.delimiter == WHITESPACE:
        return head.decode("utf-8").split()
    return fields(head.decode("utf-8"), delimiter)


def _delimiter(settings: CsvFormat, line: bytes, notes: list[Note]) -> str:
    """Return the separator, where it is to be taken from the header the one that occurs most often in it."""
    if settings.delimiter != AUTO:
        return settings.delimiter
    counts = {d: line.count(d.encode()) for d in DELIMITERS if d != settings.decimal or settings.decimal == "."}
    found = max(counts, key=lambda d: counts[d])
    if counts[found] == 0:
        found = " "
    notes.append(Note("N-DELIM", 1, 0, 0, f"the separator is {found!r}, by the header"))
    return found
