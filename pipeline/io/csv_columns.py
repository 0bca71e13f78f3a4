"""Which column of a text log holds which channel, by its name, and whether the header agrees with the profile."""

from __future__ import annotations

import difflib
import re
from typing import TYPE_CHECKING

from pipeline.errors import IngestError
from pipeline.io.units import TRIADS, UNITS

if TYPE_CHECKING:
    from pipeline.io.ingest_settings import Column, CsvFormat

NUMBER = re.compile(rb"\s*[+-]?(\d+[.,]?\d*|[.,]\d+)([eE][+-]?\d+)?\s*")
BRACKETS = re.compile(r"[\[(]([^\])]*)[\])]\s*$")
# Spellings of units in headers, lower case and without blanks, to the names of the house.
SPELLINGS = {
    "g": "g", "mg": "mg", "m/s^2": "m/s^2", "m/s2": "m/s^2", "m/s²": "m/s^2", "ms^-2": "m/s^2", "m/s/s": "m/s^2",
    "mps2": "m/s^2", "deg/s": "deg/s", "°/s": "deg/s", "dps": "deg/s", "degs/s": "deg/s", "rad/s": "rad/s",
    "rads/s": "rad/s", "s": "s", "sec": "s", "seconds": "s", "ms": "ms", "us": "us", "µs": "us", "μs": "us", "ns": "ns",
    "deg": "deg", "°": "deg", "rad": "rad", "degc": "degC", "°c": "degC", "c": "degC", "celsius": "degC",
    "counts": "counts", "lsb": "counts", "raw": "counts",
}  # fmt: skip


def unit_in_brackets(name: str) -> str | None:
    """Return the unit that a column's name states in brackets, in the house's spelling; None where it states none."""
    found = BRACKETS.search(name)
    return SPELLINGS.get(found.group(1).strip().lower().replace(" ", "")) if found else None


def find_columns(
    names: list[str], settings: CsvFormat, where: str, body: bytes, first: bytes = b""
) -> list[tuple[Column, int]]:
    """Return the channels that a file holds and the index of their column.

    All three columns of one sensor may be missing where those of the other are there and fewer than three columns are
    left over that could be them under other names: the log is of one sensor.

    Parameters
    ----------
    names : list of str
    settings : CsvFormat
    where : str
        Place of the header, for messages.
    body : bytes
        The data, searched for a header that was not expected there.
    first : bytes
        The line that was taken as the header.

    Raises
    ------
    IngestError
        If a column that is needed is missing, or its name states another unit than the profile.
    """
    found: list[tuple[Column, int]] = []
    lacking: list[Column] = []
    for column in settings.columns:
        index = column.column if isinstance(column.column, int) else _index(names, column.column)
        if 0 <= index < len(names):
            _check_unit(column, names[index], where)
            found.append((column, index))
        elif not column.optional:
            lacking.append(column)
    absent = _of_absent_sensor(lacking, found, len(names))
    missing = [str(column.column) for column in lacking if column.channel not in absent]
    if missing:
        numbers = bool(first) and all(NUMBER.fullmatch(c) for c in re.split(rb"[,;\t| ]+", first.strip()))
        raise IngestError(
            _missing_message(missing, names),
            where,
            fault="no_header" if numbers else "missing_column",
            hint=_what_to_do(missing, names, settings, body, numbers=numbers),
        )
    return found


def _of_absent_sensor(missing: list[Column], found: list[tuple[Column, int]], columns: int) -> tuple[str, ...]:
    """Return the channels of the sensor that a log of the other one does not hold; none where it may hold them."""
    lacking, known = {c.channel for c in missing}, {c.channel for c, _ in found}
    absent = [triad for triad in TRIADS.values() if set(triad) <= lacking]
    other = any(set(triad) <= known for triad in TRIADS.values())
    return absent[0] if absent and other and columns - len(found) < len(absent[0]) else ()


def refuse_twice(names: list[str], where: str) -> None:
    """Refuse a header that bears one name twice."""
    twice = sorted({n for n in names if n and names.count(n) > 1})
    if twice:
        raise IngestError(
            f"column name {', '.join(twice)} stands more than once in the header", where, fault="duplicate_column"
        )


def _index(names: list[str], name: str) -> int:
    return names.index(name) if name in names else -1


def _check_unit(column: Column, name: str, where: str) -> None:
    stated = unit_in_brackets(name)
    if stated is not None and stated != column.unit and stated in UNITS[column.channel]:
        raise IngestError(
            f"the header says that {name!r} is in {stated}, ingest.csv.columns.{column.channel}.unit says "
            f"{column.unit}; one of them is wrong",
            where,
            fault="unit_contradiction",
        )


def _missing_message(missing: list[str], names: list[str]) -> str:
    near = {m: difflib.get_close_matches(m, names, 1) for m in missing}
    hints = [f"{m} (nearest: {n[0]})" if n else m for m, n in near.items()]
    message = f"column {', '.join(hints)} missing; found {', '.join(names)[:300]}"
    separators = [repr(c) for c in ",;\t| " if c in names[0]] if len(names) == 1 else []
    if separators:
        message += f"; is the separator {' or '.join(separators)}? Set ingest.csv.delimiter"
    return message


def _what_to_do(missing: list[str], names: list[str], settings: CsvFormat, body: bytes, *, numbers: bool) -> str:
    """Return what would make the columns be found."""
    lines = body[:10_000].rstrip(b"\n").split(b"\n")[:60]
    wanted = [m.encode() for m in missing]
    for offset, line in enumerate(lines):
        if all(w in line for w in wanted):
            return f"line {settings.skip_lines + 2 + offset} holds them: set ingest.csv.skip_lines to the lines before"
    if numbers:
        return "the first line holds numbers: set ingest.csv.header=false and give columns by index from 0"
    if lines and len(names) != lines[min(len(lines) - 1, 12)].count(settings.delimiter.encode()[:1]) + 1:
        start = b" / ".join(lines[:3]).decode("utf-8", "replace")[:150]
        return f"the next lines are {start!r}; lines before the header are skipped by ingest.csv.skip_lines"
    advice = "describe the file's columns in ingest.csv.columns"
    absent = [
        s
        for s, triad in TRIADS.items()
        if {str(c.column) for c in settings.columns if c.channel in triad} <= set(missing)
    ]
    if len(absent) == 1:
        advice += f"; of a log without {absent[0]}, set {', '.join(TRIADS[absent[0]])} to null there"
    return advice
