"""Find the columns of a text log, parse its rows to numbers, and find the faults of rows that are not numbers.

Columns are found by their names. No type is inferred, and no text means a missing value. The fast parser reports that a
block of rows has a bad cell, but not where; so only the lines of such a block are checked one by one.

Gyroflow's ``.gcsv`` states scales, orientation and column names (versions 1.0 to 1.3;
docs.gyroflow.xyz/app/technical-details/gcsv-format):

    GYROFLOW IMU LOG            (or CAMERA IMU LOG)
    version,1.3
    orientation,YxZ             the reading along (capital) or against (small letter) the body's x, y and z
    tscale,0.001                time [s]                  = tscale * t
    gscale,0.00122173047        angular rate [rad/s]      = gscale * count
    ascale,0.00048828125        specific force [g]        = ascale * count
    t,gx,gy,gz,ax,ay,az         (a magnetometer is not used; columns with canonical names may follow)
    0,39,86,183,-1137,-15689,-2986
"""

from __future__ import annotations

import csv
import difflib
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import csv as arrow_csv

from imu_logs.errors import IngestError
from imu_logs.files import refuse_foreign, unchanged
from imu_logs.log import Integers, Note, Values
from imu_logs.profile import Column, CsvFormat
from imu_logs.units import ATTITUDE, CANONICAL, COUNTS, DEGREES, SCALARS, TRIADS, UNITS, unit_in_brackets

NUMBER = re.compile(r"\s*[+-]?(\d+[.,]?\d*|[.,]\d+)([eE][+-]?\d+)?\s*")
LISTED = 5  # lines named in a refusal
LEAVE_A_GAP = "ingest.csv.bad_rows=drop replaces such rows by a gap"
PARTS = "if the logger was restarted, make each part a recording, by its key session (docs/troubleshooting.md)"
HINTS = {
    "bad_row": LEAVE_A_GAP,
    "nul": LEAVE_A_GAP,
    "not_a_number": LEAVE_A_GAP,
    "not_finite": "ingest.csv.nan=gap replaces such rows by a gap",
    "decimal_comma": "set ingest.csv.decimal=',' and a delimiter that is none",
    "restarted": PARTS,
}
END_OF_NUMBER = re.compile(r"[\d.,eE+-]+")
FIRST_LINES = (b"GYROFLOW IMU LOG", b"CAMERA IMU LOG")
LONGEST_HEADER = 1 << 16  # bytes that are searched for the line of names
LAST_VERSION = "1.3"


def find_columns(
    names: list[str], settings: CsvFormat, where: str, below: Callable[[], dict[int, str]]
) -> list[tuple[Column, int]]:
    """Return the channels of a file, each with the index of its column.

    All columns of one sensor may be missing if those of the other sensor are found, and fewer than three other columns
    could contain them under other names: then the log has one sensor. ``below`` returns the next lines by number, where
    a header at another place is searched.
    """
    numbers = bool(settings.header) and all(NUMBER.fullmatch(n) for name in names for n in re.split(r"[;\t| ]+", name))
    twice = [] if numbers else sorted({n for n in names if n and names.count(n) > 1})
    others = [f"column name {', '.join(twice)} occurs more than once in the header"] if twice else []
    found: list[tuple[Column, int]] = []
    lacking: list[Column] = []
    for column in settings.columns:
        index = column.index(names)
        if index is not None:
            others += _contradiction(column, names[index])
            found.append((column, index))
        elif not column.optional:
            lacking.append(column)
    absent = _channels_of_absent_sensor(lacking, found, len(names))
    missing = [str(column.column) for column in lacking if column.channel not in absent]
    if missing:
        near = {m: difflib.get_close_matches(m, names, 1) for m in missing}
        wanted = ", ".join(f"{m} (nearest: {n[0]})" if n else m for m, n in near.items())
        others = [f"column {wanted} missing; found {', '.join(names)[:300]}{other_separator(names)}", *others]
        hint = "" if twice else _what_to_do(missing, names, settings, below(), numbers=numbers)
        code = "duplicate_column" if twice else "no_header" if numbers else "missing_column"
        raise IngestError("; ".join(others), where, code=code, hint=hint)
    if others:
        raise IngestError("; ".join(others), where, code="duplicate_column" if twice else "unit_contradiction")
    return found


def column_notes(names: list[str], columns: list[tuple[Column, int]], line: int) -> list[Note]:
    """Return notes on axes in another order than x, y, z and on columns that the profile does not use."""
    place = {column.channel: index for column, index in columns if isinstance(column.column, str)}
    turned = [t for t in TRIADS.values() if set(t) <= place.keys() and sorted(t, key=lambda c: place[c]) != list(t)]
    listed = [names[i] for i in sorted(place[c] for t in turned for c in t)]
    detail = f"axes are in the order {', '.join(listed)} and were assigned by their names"
    notes = [Note("N-ORDER", len(listed), line, line, detail)] if turned else []
    used = {index for _, index in columns}
    ignored = [n for i, n in enumerate(names) if n and i not in used]
    detail = f"columns not used: {', '.join(ignored)}"
    return notes + ([Note("N-IGNORED", len(ignored), line, line, detail)] if ignored else [])


def _channels_of_absent_sensor(missing: list[Column], found: list[tuple[Column, int]], columns: int) -> tuple[str, ...]:
    """Return the channels of a sensor that the log does not have; none if other columns could contain them."""
    lacking, known = {c.channel for c in missing}, {c.channel for c, _ in found}
    absent = [triad for triad in TRIADS.values() if set(triad) <= lacking]
    other = any(set(triad) <= known for triad in TRIADS.values())
    return absent[0] if absent and other and columns - len(found) < len(absent[0]) else ()


def _contradiction(column: Column, name: str) -> list[str]:
    """Return the message for a header that states another unit than the profile; empty for none."""
    stated = unit_in_brackets(name)
    if stated is None or stated == column.unit or stated not in UNITS[column.channel]:
        return []
    where = f"ingest.csv.columns.{column.channel}.unit"
    return [f"the header says that {name!r} is in {stated}, {where} says {column.unit}; one of them is wrong"]


def other_separator(names: list[str]) -> str:
    """Return a hint on the separators in a header that was read as one name; empty for none."""
    separators = [repr(c) for c in ",;\t| " if c in names[0]] if len(names) == 1 else []
    return f"; is the separator {' or '.join(separators)}? Set ingest.csv.delimiter" if separators else ""


def _what_to_do(
    missing: list[str], names: list[str], settings: CsvFormat, below: dict[int, str], *, numbers: bool
) -> str:
    """Return advice: the setting with which the columns would be found."""
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


@dataclass(frozen=True)
class TextLayout:
    """The columns of a text log and the channels that they hold, each with the index of its column."""

    path: str
    names: list[str]
    columns: list[tuple[Column, int]]
    delimiter: str
    decimal: str

    def parse(self, body: bytes, types: Mapping[int, Any]) -> Any:  # noqa: ANN401  (pyarrow has no types)
        """Parse columns of rows to a pyarrow table, by their index; raises ``ArrowInvalid`` if a row does not fit."""
        names = [str(i) for i in range(len(self.names))]
        return arrow_csv.open_csv(  # of one block; read_csv takes 50 us more to start
            pa.py_buffer(body),
            arrow_csv.ReadOptions(use_threads=False, block_size=len(body) + 1, column_names=names),
            arrow_csv.ParseOptions(delimiter=self.delimiter, quote_char='"' if b'"' in body else False),
            arrow_csv.ConvertOptions(
                column_types={str(i): t for i, t in types.items()},
                include_columns=[str(i) for i in types],
                null_values=[],
                check_utf8=False,
                decimal_point=self.decimal,
            ),
        ).read_all()

    def numbers(self, body: bytes, rows: int) -> dict[int, Values] | None:
        """Parse the used columns to numbers, by index; None if a cell is not a finite number."""
        wanted = sorted({index for _, index in self.columns})
        quoted = (line.decode("utf-8", "replace") for line in body.split(b"\n") if b'"' in line) if b'"' in body else ()
        if b"\0" in body or any(set(wanted) & set(_quoted(line, self.delimiter)) for line in quoted):
            return None  # a comma in a quoted number may separate thousands
        try:
            table = self.parse(body, dict.fromkeys(wanted, pa.float64()))
        except pa.ArrowInvalid:
            return None
        if table.num_rows != rows:
            return None
        values = table.to_batches()[0].to_tensor(row_major=False).to_numpy()
        return dict(zip(wanted, values.T, strict=True)) if np.isfinite(values).all() else None


@dataclass(frozen=True)
class Fault:
    """A line that is no row of numbers.

    ``kind`` is a code of ``HINTS``. ``parted_before``: the line is a row, but its last number may continue in the line
    with this number.
    """

    line: int
    kind: str
    message: str
    text: str
    short: bool = False
    parted_before: int = 0


def refusal(layout: TextLayout, faults: Sequence[Fault], *, more: bool = False) -> IngestError:
    """Return the error with the first bad line of a log, the number of bad lines, and advice for each kind of fault.

    ``more``: there may be further bad lines.
    """
    worst = next((f for f in faults if f.kind == "restarted"), faults[0])
    others = [str(f.line) for f in faults if f is not worst]
    others_text = ""
    if others:
        count = f"at least {len(others)}" if more else str(len(others))
        kinds = sorted({f.kind for f in faults} - {worst.kind})
        other = f", {', '.join(kinds)} among them" if kinds else ""
        others_text = f" ({count} more {'such' if not kinds else 'bad'} lines{other}, up to line {faults[-1].line}"
        if len(others) > 1:
            others_text += f": {', '.join(others[: LISTED - 1])}{' ..' if len(others) >= LISTED else ''}"
        others_text += ")"
    hint = "; ".join(dict.fromkeys(HINTS[f.kind] for f in (worst, *faults)))
    return IngestError(worst.message + others_text, f"{layout.path}:{worst.line}", code=worst.kind, hint=hint)


def find_faults(layout: TextLayout, body: bytes, lines: Integers, before: tuple[int, str] | None) -> Iterator[Fault]:
    """Yield the faults of a block of rows; ``before``: number and text of the preceding valid row."""
    for number, raw in zip(lines.tolist(), body.split(b"\n"), strict=False):
        text = raw.decode("utf-8", "replace")
        fault = _fault(layout, number, text)
        if fault is None:
            before = (number, text)
            continue
        single = fault.short and layout.delimiter not in text and END_OF_NUMBER.fullmatch(text)
        if single and before is not None:  # a line break in -0.0394 leaves -0.03 and 94
            message = f"the line may end inside a number: the next has a single field, {text[:40]!r}"
            yield Fault(before[0], "bad_row", message, before[1], parted_before=number)
        before = None
        yield fault


def _fault(layout: TextLayout, line: int, text: str) -> Fault | None:
    """Return the fault of a line, None for a row of numbers."""
    if "\0" in text:
        nul = text.count("\0")
        return Fault(line, "nul", f"{nul} NUL bytes within the line: {text[:60]!r}", text)
    try:
        cells = next(csv.reader([text], delimiter=layout.delimiter, strict=True), [])
    except csv.Error as error:
        return Fault(line, "bad_row", f"the line cannot be split into fields ({error}): {text[:120]!r}", text)
    if [cell.strip() for cell in cells] == layout.names:
        said = _fault_of_cell(layout, layout.columns[0], cells, [])[1]
        return Fault(line, "restarted", f"{said}: a repeated header", text)
    width = len(layout.names)
    if len(cells) != width:
        message = f"the line has {len(cells)} fields where {width} are expected: {text[:120]!r}"
        return Fault(line, "bad_row", message, text, short=len(cells) < width)
    quoted = _quoted(text, layout.delimiter) if '"' in text else []
    for column in layout.columns:
        kind, message = _fault_of_cell(layout, column, cells, quoted)
        if kind:
            return Fault(line, kind, message, text)
    return None


def _quoted(line: str, delimiter: str) -> list[int]:
    """Return the indices of the quoted cells of a line."""
    cells = re.findall(rf'\s*("(?:[^"]|"")*"|[^{re.escape(delimiter)}]*)\s*(?:{re.escape(delimiter)}|$)', line)
    return [index for index, cell in enumerate(cells) if cell.startswith('"')]


def _fault_of_cell(
    layout: TextLayout, where: tuple[Column, int], cells: list[str], quoted: Sequence[int]
) -> tuple[str, str]:
    """Return the kind and the message of a cell's fault; both empty for a finite number."""
    column, index = where
    name, channel = layout.names[index], column.channel
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


def gcsv_format(path: Path) -> tuple[CsvFormat, dict[str, str]]:
    """Return the layout of a ``.gcsv`` file, and the facts that its head states, with the orientation."""
    names, facts, line = _read_head(path)
    text = facts.get("orientation", "XYZ")
    if sorted(text.lower()) != ["x", "y", "z"]:
        message = f"orientation is {text!r}; it names X, Y and Z once each, small where turned round"
        raise IngestError(message, str(path), code="gcsv")
    kept = {k: v for k, v in facts.items() if k in ("id", "note", "fwversion", "vendor", "orientation")}
    return _format(names, facts, line, path), kept


def _read_head(path: Path) -> tuple[list[str], dict[str, str], int]:
    """Return the column names, all other facts of the head, and the number of lines before the column names."""
    with unchanged(path), path.open("rb") as stream:
        start = stream.read(LONGEST_HEADER)
    refuse_foreign(start[:18], str(path))
    lines = start.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").split(b"\n")
    if not any(lines[0].startswith(first) for first in FIRST_LINES):
        message = f"not a .gcsv file: it starts with {lines[0][:40]!r}, GYROFLOW IMU LOG is expected"
        raise IngestError(message, f"{path}:1", code="gcsv")
    facts: dict[str, str] = {}
    for number, line in enumerate(lines[1:], 1):
        cells = [c.strip() for c in line.decode("utf-8", "replace").split(",")]
        if cells[0] in ("t", "time"):
            return cells, facts, number
        if len(cells) > 1:
            facts[cells[0]] = ",".join(cells[1:])
    raise IngestError("the head of the file has no line of column names (t,gx,gy,gz,...)", str(path), code="gcsv")


def _format(names: list[str], facts: dict[str, str], skip: int, path: Path) -> CsvFormat:
    version = facts.get("version", "1")
    if version.split(".")[0] != "1":
        message = f"version {version} of .gcsv is not known; known are 1 to {LAST_VERSION}"
        raise IngestError(message, str(path), code="gcsv")
    rate = 1.0 / float(Fraction(_number(facts, "tscale", path)))
    columns = [Column(channel="time", column=names[0], unit=COUNTS, counts_per_unit=rate)]
    for sensor, letter, scale, factor in (("gyroscope", "g", "gscale", DEGREES), ("accelerometer", "a", "ascale", 1.0)):
        if any(f"{letter}{axis}" in names for axis in "xyz"):
            per_unit = 1.0 / (float(Fraction(_number(facts, scale, path))) * factor)
            columns += [
                Column(channel=channel, column=f"{letter}{channel[-1]}", unit=COUNTS, counts_per_unit=per_unit)
                for channel in TRIADS[sensor]
            ]
    others = [c for c in CANONICAL if c in (*SCALARS, *ATTITUDE)]
    columns += [Column(channel=c, column=CANONICAL[c], unit=next(iter(UNITS[c])), optional=True) for c in others]
    return CsvFormat(skip_lines=skip, columns=tuple(columns))


def _number(facts: dict[str, str], key: str, path: Path) -> str:
    text = facts.get(key, "")
    if not re.fullmatch(r"\+?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", text) or float(text) == 0:
        what = f"is {text!r}" if text else "is missing"
        message = f"{key} {what}; a positive number is expected in the head of the file"
        raise IngestError(message, str(path), code="gcsv")
    return text
