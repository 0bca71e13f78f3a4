"""Where the columns of a text log lie: preamble, header, data, and which column holds which channel."""

from __future__ import annotations

import csv
import difflib
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pipeline.errors import InputError
from pipeline.formats.settings import WHITESPACE
from pipeline.records import Note

if TYPE_CHECKING:
    from pipeline.formats.settings import Column, CsvFormat
    from pipeline.formats.text_file import TextFile


@dataclass(frozen=True)
class Layout:
    """The data of a text log and the place of each channel in it.

    Attributes
    ----------
    path : str
    body : bytes
        The data lines, fields separated by ``delimiter``.
    first_line : int
        Line of the file, counted from 1, on which the data start.
    delimiter : str
    names : list of str
        All columns, for messages.
    columns : list of (Column, int)
        The channels that the file holds and the index of their column.
    notes : tuple of Note
    """

    path: str
    body: bytes
    first_line: int
    delimiter: str
    names: list[str]
    columns: list[tuple[Column, int]]
    notes: tuple[Note, ...]

    def line_of(self, row: int) -> int:
        """Return the line of a data row counted from 0, past any empty lines."""
        if b"\n\n" not in self.body and not self.body.startswith(b"\n"):
            return self.first_line + row
        seen = -1
        for index, line in enumerate(self.body.split(b"\n")):
            seen += bool(line)
            if line and seen == row:
                return self.first_line + index
        return 0


def find_layout(text: TextFile, settings: CsvFormat) -> Layout:
    """Find header and data of a text log.

    Raises
    ------
    InputError
        If there are no data, a column that is needed is missing, or a name stands twice.
    """
    start, line = _after_lines(text, settings.skip_lines)
    body = text.data[start:]
    delimiter = settings.delimiter
    if delimiter == WHITESPACE:
        body, delimiter = _single_blanks(body), " "
    if settings.header:
        head, _, body = body.partition(b"\n")
        names = _fields(head.decode("utf-8"), delimiter)
        line += 1
    else:
        first = body.lstrip(b"\n").partition(b"\n")[0].decode("utf-8")
        names = [f"column {i}" for i in range(len(_fields(first, delimiter)))]
    where = f"{text.path}:{line - 1 if settings.header else line}"
    if not body or body.isspace():
        found = f"header on line {line - 1}, " if settings.header else ""
        raise InputError(f"{found}0 data rows; at least 2 are needed", text.path)
    columns = _find_columns(names, settings, where)
    ignored = [n for i, n in enumerate(names) if i not in {index for _, index in columns}]
    notes = list(text.notes)
    if ignored:
        at = line - 1 if settings.header else 0
        notes.append(Note("N-IGNORED", len(ignored), at, at, f"columns not used: {', '.join(ignored)}"))
    return Layout(text.path, body, line, delimiter, names, columns, tuple(notes))


def _after_lines(text: TextFile, count: int) -> tuple[int, int]:
    """Return the byte after ``count`` lines and the number of the line that starts there."""
    start = 0
    for _ in range(count):
        start = text.data.find(b"\n", start) + 1
        if start == 0:
            raise InputError(f"the file ends within the {count} lines that ingest.csv.skip_lines skips", text.path)
    return start, count + 1


def _single_blanks(body: bytes) -> bytes:
    """Turn every run of blanks and tabs into one blank, none at the ends of lines."""
    body = body.replace(b"\t", b" ")
    while b"  " in body:
        body = body.replace(b"  ", b" ")
    return body.replace(b"\n ", b"\n").replace(b" \n", b"\n").lstrip(b" ")


def _fields(line: str, delimiter: str) -> list[str]:
    return [name.strip() for name in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])]


def _find_columns(names: list[str], settings: CsvFormat, where: str) -> list[tuple[Column, int]]:
    twice = sorted({n for n in names if n and names.count(n) > 1})
    if twice:
        raise InputError(f"column name {', '.join(twice)} stands more than once in the header", where)
    found, missing = [], []
    for column in settings.columns:
        index = column.column if isinstance(column.column, int) else _index(names, column.column)
        if 0 <= index < len(names):
            found.append((column, index))
        elif not column.optional:
            missing.append(str(column.column))
    if missing:
        raise InputError(_missing_message(missing, names), where)
    return found


def _index(names: list[str], name: str) -> int:
    return names.index(name) if name in names else -1


def _missing_message(missing: list[str], names: list[str]) -> str:
    near = {m: difflib.get_close_matches(m, names, 1) for m in missing}
    hints = [f"{m} (nearest: {n[0]})" if n else m for m, n in near.items()]
    message = f"column {', '.join(hints)} missing; found {', '.join(names)[:300]}"
    if len(names) == 1:
        separators = [repr(c) for c in ",;\t| " if c in names[0]]
        if separators:
            message += f"; is the separator {' or '.join(separators)}? Set ingest.csv.delimiter"
    return message + "; describe the file's columns in ingest.csv.columns"
