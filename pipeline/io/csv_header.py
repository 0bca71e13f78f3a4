"""The header of a text log: which column holds which channel, by its name, and what to do where one is not found."""

from __future__ import annotations

import csv
import difflib
import re
from typing import TYPE_CHECKING

from pipeline.errors import IngestError
from pipeline.io.ingest_settings import AUTO, WHITESPACE
from pipeline.io.units import TRIADS, UNITS, unit_in_brackets
from pipeline.records import Note

if TYPE_CHECKING:
    from pipeline.io.ingest_settings import Column, CsvFormat

DELIMITERS = ",;\t|"
NUMBER = re.compile(r"\s*[+-]?(\d+[.,]?\d*|[.,]\d+)([eE][+-]?\d+)?\s*")


def find_delimiter(settings: CsvFormat, line: str) -> str:
    """Return the separator; ``auto`` takes the one that occurs most often in a line."""
    if settings.delimiter == WHITESPACE:
        return " "
    if settings.delimiter != AUTO:
        return settings.delimiter
    counts = {d: line.count(d) for d in DELIMITERS if d != settings.decimal}
    found = max(counts, key=lambda d: counts[d])
    return found if counts[found] else " "


def fields(line: str, delimiter: str) -> list[str]:
    """Return the fields of a line, without blanks around them."""
    return [name.strip() for name in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])]


def single_blanks(body: bytes) -> bytes:
    """Replace every run of blanks and tabs by one blank, and none at the ends of lines."""
    body = body.replace(b"\t", b" ")
    while b"  " in body:
        body = body.replace(b"  ", b" ")
    return body.replace(b"\n ", b"\n").replace(b" \n", b"\n").lstrip(b" ")


def find_columns(names: list[str], settings: CsvFormat, where: str, below: dict[int, str]) -> list[tuple[Column, int]]:
    """Return the channels that a file holds, each with the index of its column.

    All columns of one sensor may be missing where those of the other are found and fewer than three columns are left
    over that could hold them under other names: then the log is of one sensor.

    Parameters
    ----------
    names : list of str
        The columns, in order.
    where : str
        Place of the header, for refusals.
    below : dict of int to str
        The next lines, by their number, searched for a header that was not expected there.

    Raises
    ------
    IngestError
        If a column is missing, a name stands twice, or a name states another unit than the profile.
    """
    twice = sorted({n for n in names if n and names.count(n) > 1})
    if twice:
        message = f"column name {', '.join(twice)} stands more than once in the header"
        raise IngestError(message, where, code="duplicate_column")
    found: list[tuple[Column, int]] = []
    lacking: list[Column] = []
    for column in settings.columns:
        wanted = column.column
        index = wanted if isinstance(wanted, int) else names.index(wanted) if wanted in names else len(names)
        if index < len(names):
            _check_unit(column, names[index], where)
            found.append((column, index))
        elif not column.optional:
            lacking.append(column)
    absent = _channels_of_absent_sensor(lacking, found, len(names))
    missing = [str(column.column) for column in lacking if column.channel not in absent]
    if missing:
        numbers = bool(settings.header) and all(
            NUMBER.fullmatch(n) for name in names for n in re.split(r"[;\t| ]+", name)
        )
        message = _missing_message(missing, names)
        hint = _what_to_do(missing, names, settings, below, numbers=numbers)
        raise IngestError(message, where, code="no_header" if numbers else "missing_column", hint=hint)
    return found


def column_notes(names: list[str], columns: list[tuple[Column, int]], line: int) -> list[Note]:
    """Return notes on axes in another order than x, y, z and on columns that the profile does not use."""
    place = {column.channel: index for column, index in columns if isinstance(column.column, str)}
    turned = [t for t in TRIADS.values() if set(t) <= place.keys() and sorted(t, key=lambda c: place[c]) != list(t)]
    listed = [names[i] for i in sorted(place[c] for t in turned for c in t)]
    detail = f"axes stand in the order {', '.join(listed)} and were taken by their names"
    notes = [Note("N-ORDER", len(listed), line, line, detail)] if turned else []
    used = {index for _, index in columns}
    ignored = [n for i, n in enumerate(names) if i not in used]
    detail = f"columns not used: {', '.join(ignored)}"
    return notes + ([Note("N-IGNORED", len(ignored), line, line, detail)] if ignored else [])


def _channels_of_absent_sensor(missing: list[Column], found: list[tuple[Column, int]], columns: int) -> tuple[str, ...]:
    """Return the channels of the sensor that a log of the other one does not hold; none where it may hold them."""
    lacking, known = {c.channel for c in missing}, {c.channel for c, _ in found}
    absent = [triad for triad in TRIADS.values() if set(triad) <= lacking]
    other = any(set(triad) <= known for triad in TRIADS.values())
    return absent[0] if absent and other and columns - len(found) < len(absent[0]) else ()


def _check_unit(column: Column, name: str, where: str) -> None:
    stated = unit_in_brackets(name)
    if stated is not None and stated != column.unit and stated in UNITS[column.channel]:
        message = (
            f"the header says that {name!r} is in {stated}, ingest.csv.columns.{column.channel}.unit says "
            f"{column.unit}; one of them is wrong"
        )
        raise IngestError(message, where, code="unit_contradiction")


def _missing_message(missing: list[str], names: list[str]) -> str:
    near = {m: difflib.get_close_matches(m, names, 1) for m in missing}
    hints = [f"{m} (nearest: {n[0]})" if n else m for m, n in near.items()]
    message = f"column {', '.join(hints)} missing; found {', '.join(names)[:300]}"
    separators = [repr(c) for c in ",;\t| " if c in names[0]] if len(names) == 1 else []
    if separators:
        message += f"; is the separator {' or '.join(separators)}? Set ingest.csv.delimiter"
    return message


def _what_to_do(
    missing: list[str], names: list[str], settings: CsvFormat, below: dict[int, str], *, numbers: bool
) -> str:
    """Return the setting with which the columns would be found."""
    for number, line in below.items():
        if all(m in line for m in missing):
            return f"line {number} holds them: set ingest.csv.skip_lines to the lines before"
    if numbers:
        return "the first line holds numbers: set ingest.csv.header=false and give columns by index from 0"
    lines = list(below.values())
    if lines and len(names) != lines[min(len(lines) - 1, 12)].count(settings.delimiter[:1]) + 1:
        start = " / ".join(lines[:3])[:150]
        return f"the next lines are {start!r}; lines before the header are skipped by ingest.csv.skip_lines"
    advice = "describe the file's columns in ingest.csv.columns"
    absent = [
        sensor
        for sensor, triad in TRIADS.items()
        if {str(c.column) for c in settings.columns if c.channel in triad} <= set(missing)
    ]
    if len(absent) == 1:
        advice += f"; of a log without {absent[0]}, set {', '.join(TRIADS[absent[0]])} to null there"
    return advice
