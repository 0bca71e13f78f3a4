"""What is wrong with the lines of a text log that did not parse: line, column and value of each.

The fast parser says that a cell is bad but not where. So the data are parsed again in blocks of some thousand lines,
and only the lines of the blocks that fail are looked at one by one.
"""

from __future__ import annotations

import csv
import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import pyarrow as pa

from pipeline.errors import IngestError
from pipeline.io.csv_parse import all_finite, parse

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from pipeline.io.csv_layout import Layout

BLOCK_BYTES = 1 << 18
LISTED = 5
HINTS = {
    "bad_row": "ingest.csv.bad_rows=drop leaves a gap in place of such rows",
    "nul": "ingest.csv.bad_rows=drop leaves a gap in place of such rows",
    "not_a_number": "ingest.csv.bad_rows=drop leaves a gap in place of such rows",
    "not_finite": "ingest.csv.nan=gap leaves a gap in place of such rows",
    "decimal_comma": "set ingest.csv.decimal=',' and a delimiter that is none",
    "restarted": "the log was restarted: set ingest.csv.session=1, 2 .. to read one part of it",
}
END_OF_NUMBER = re.compile(r"[\d.,eE+-]+")
KIND_OF_SETTING = {"bad_row": "bad_rows", "nul": "bad_rows", "not_a_number": "bad_rows", "not_finite": "nan"}


@dataclass(frozen=True)
class Fault:
    """One bad line.

    Attributes
    ----------
    row : int
        Counted from 0 among the data lines.
    line : int
        Of the file, counted from 1.
    kind : str
        ``bad_row``, ``nul``, ``restarted``, ``not_finite``, ``decimal_comma`` or ``not_a_number``.
    message : str
    text : str
        The line.
    short : bool
        Whether it has fewer fields than are expected.
    parted_before : int
        The row of the single field that may be the end of this line's last number, -1 if there is none.
    """

    row: int
    line: int
    kind: str
    message: str
    text: str
    short: bool = False
    parted_before: int = -1


def refusal(layout: Layout, faults: list[Fault], reason: str) -> IngestError:
    """Return the error that names the first bad line of a log, and how many there are.

    Parameters
    ----------
    layout : Layout
    faults : list of Fault
    reason : str
        What the parser said, used if there are none.
    """
    if not faults:
        return IngestError(f"cannot be read as numbers: {reason}", layout.path, fault="not_a_number")
    worst = next((f for f in faults if f.kind == "restarted"), faults[0])
    others = [str(f.line) for f in faults if f is not worst]
    more = f" ({len(others)} more such lines, up to line {faults[-1].line})" if others else ""
    if len(others) > 1:
        more = more[:-1] + f": {', '.join(others[: LISTED - 1])}{' ..' if len(others) >= LISTED else ''})"
    return IngestError(worst.message + more, f"{layout.path}:{worst.line}", fault=worst.kind, hint=HINTS[worst.kind])


def find_faults(layout: Layout) -> list[Fault]:
    """Return every bad line of a log."""
    found, start, row = [], 0, 0
    while start < len(layout.body):
        end = layout.body.find(b"\n", start + BLOCK_BYTES) + 1 or len(layout.body)
        block = layout.body[start:end]
        rows = block.count(b"\n")
        if not _sound(layout, block):
            found += list(_faults(layout, block, row))
        start, row = end, row + rows
    return found


def with_parted_rows(faults: list[Fault], layout: Layout) -> list[Fault]:
    """Return the faults and each row before a lone field: a line break in ``-0.0394`` leaves ``-0.03`` and ``94``."""
    known = {-1, *(f.row for f in faults)}
    lines = layout.body.split(b"\n") if faults else []
    out = []
    for fault in faults:
        before = fault.row - 1
        if (
            fault.short
            and layout.delimiter not in fault.text
            and END_OF_NUMBER.fullmatch(fault.text)
            and before not in known
        ):
            message = f"the line may end inside a number: the next has a single field, {fault.text[:40]!r}"
            text = lines[before].decode("utf-8", "replace")
            out.append(Fault(before, layout.line_of(before), "bad_row", message, text, parted_before=fault.row))
        out.append(fault)
    return out


def quoted_numbers(layout: Layout, block: bytes) -> bool:
    """Return whether a cell that holds a number stands in quotes: then a comma in it may be of thousands."""
    if b'"' not in block:
        return False
    wanted = {index for _, index in layout.columns}
    lines = (line.decode("utf-8", "replace") for line in block.split(b"\n") if b'"' in line)
    return any(wanted & set(_quoted(line, layout.delimiter)) for line in lines)


def _quoted(line: str, delimiter: str) -> list[int]:
    """Return which cells of a line stand in quotes."""
    cells = re.findall(rf'\s*("(?:[^"]|"")*"|[^{re.escape(delimiter)}]*)\s*(?:{re.escape(delimiter)}|$)', line)
    return [index for index, cell in enumerate(cells) if cell.startswith('"')]


def _sound(layout: Layout, block: bytes) -> bool:
    if b"\0" in block or quoted_numbers(layout, block):
        return False
    wanted = dict.fromkeys([index for _, index in layout.columns], pa.float64())
    try:
        table = parse(block, layout.delimiter, layout.decimal, len(layout.names), wanted)
    except pa.ArrowInvalid:
        return False
    return table.num_rows == block.count(b"\n") and all_finite(table)


def _faults(layout: Layout, block: bytes, first: int) -> Iterator[Fault]:
    width = len(layout.names)
    for offset, raw in enumerate(block.split(b"\n")[:-1]):
        text = raw.decode("utf-8", "replace")
        row = first + offset
        line = layout.line_of(row)
        if b"\0" in raw:
            yield Fault(row, line, "nul", f"{raw.count(0)} NUL bytes within the line: {text[:60]!r}", text)
            continue
        try:
            cells = next(csv.reader([text], delimiter=layout.delimiter, strict=True), [])
        except csv.Error as error:
            yield Fault(row, line, "bad_row", f"the line cannot be split into fields ({error}): {text[:120]!r}", text)
            continue
        if _is_header(cells, layout):
            yield Fault(row, line, "restarted", _cell(layout, layout.columns[0], cells)[1] + ": a header again", text)
        elif len(cells) != width:
            message = f"the line has {len(cells)} fields where {width} are expected: {text[:120]!r}"
            yield Fault(row, line, "bad_row", message, text, short=len(cells) < width)
        else:
            quoted = _quoted(text, layout.delimiter) if '"' in text else []
            bad = next((b for c in layout.columns if (b := _cell(layout, c, cells, quoted))[0]), None)
            if bad:
                yield Fault(row, line, *bad, text)


def _is_header(cells: list[str], layout: Layout) -> bool:
    return [cell.strip() for cell in cells] == layout.names


def _cell(layout: Layout, where: tuple[object, int], cells: list[str], quoted: Sequence[int] = ()) -> tuple[str, str]:
    """Return the kind of fault of a cell, empty where it is a finite number, and what is wrong with it."""
    column, index = where
    name, channel = layout.names[index], getattr(column, "channel", "")
    label = f"column {name}" if not name.startswith("column ") else name
    text = cells[index].strip()
    point = re.escape(layout.decimal)
    if not text:
        return "not_finite", f"{label} ({channel}) is empty; a number is expected"
    if re.fullmatch(rf"[+-]?(\d+{point}?\d*|{point}\d+)([eE][+-]?\d+)?", text):
        if index in quoted:
            return "not_a_number", f"{label} ({channel}) is '\"{text[:40]}\"', in quotes; a number stands without them"
        if math.isfinite(float(text.replace(",", "."))):
            return "", ""
        return "not_finite", f"{label} ({channel}) is {text!r}, more than a number can hold"
    if re.fullmatch(r"[+-]?\d+,\d+", text):
        return "decimal_comma", f"{label} ({channel}) is {text!r}, a decimal comma; write numbers with a point"
    kind = "not_finite" if re.fullmatch(r"[+-]?(nan|inf(inity)?)", text, re.IGNORECASE) else "not_a_number"
    return kind, f"{label} ({channel}) is {text[:40]!r}; a finite number is expected"
