"""Text logs to channels in the units of the package; counts stay integers.

    value = (count - offset) / counts_per_unit

Files of one recording that were logged at the same times are joined row by row; the log of a table with a clock of its
own is aligned with the sensor's (``pipeline.io.encoder_log``).

Gyroflow's ``.gcsv`` states scales, orientation and column names itself (versions 1.0 to 1.3;
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

import re
from dataclasses import replace
from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import IngestError
from pipeline.io.channel_table import ChannelTable, in_house_unit, to_body_axes
from pipeline.io.csv_rows import read_rows
from pipeline.io.csv_times import in_order, times_of
from pipeline.io.files import refuse_foreign, unchanged
from pipeline.io.ingest_settings import Checks, Column, CsvFormat
from pipeline.io.units import ATTITUDE, CANONICAL, COUNTS, DEGREES, SCALARS, TRIADS, UNITS
from pipeline.records import Encoding, Note

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path


TABLE_TIME = "table_time"
FIRST_LINES = (b"GYROFLOW IMU LOG", b"CAMERA IMU LOG")
LONGEST_HEADER = 1 << 16  # bytes that are searched for the line of names
LAST_VERSION = "1.3"


def read_csv(paths: Sequence[Path], formats: Sequence[CsvFormat], checks: Checks | None = None) -> ChannelTable:
    """Return the channels of a text log, or of the files of one recording."""
    tables = [_read_one(path, layout, checks or Checks()) for path, layout in zip(paths, formats, strict=True)]
    same = [t for t, layout in zip(tables, formats, strict=True) if not layout.own_clock]
    others = [t for t, layout in zip(tables, formats, strict=True) if layout.own_clock]
    joined = _joined(same)
    if others or TABLE_TIME in joined.values:
        from pipeline.io.encoder_log import align, own_rows  # noqa: PLC0415  (few logs need it)

        for log in others or [own_rows(joined)]:
            joined = align(joined, log)
    return joined


def _read_one(path: Path, settings: CsvFormat, checks: Checks) -> ChannelTable:
    """Return the channels of one file."""
    rows = read_rows(path, settings, checks)
    refused = rows.refused
    try:
        rows, time_ns = in_order(rows, times_of(rows, settings), settings, checks)
    except IngestError as error:
        raise also(refused, error) if refused else error from None
    if refused:
        raise refused
    notes = rows.notes
    if settings.rate_hz is not None:
        detail = f"no time column: rows counted at {settings.rate_hz:g} Hz"
        notes = (*notes, Note("N-SYNTHTIME", len(time_ns), 0, 0, detail))
    values, encodings = {}, {}
    for column, index in rows.layout.columns:
        if column.channel != "time":
            numbers = rows.numbers[index]
            values[column.channel] = in_house_unit(column, numbers)
            if column.unit == COUNTS and bool(np.all(numbers == np.rint(numbers))):
                encodings[column.channel] = Encoding(1.0 / column.counts_per_unit, column.offset)
    lines = rows.lines
    return ChannelTable(
        path=rows.layout.path,
        time_ns=time_ns,
        values=values,
        source={"file": rows.layout.path, "sha256": rows.sha256, "rows": len(lines)},
        line_of=lambda row: int(lines[row]) if row < len(lines) else 0,
        encodings=encodings,
        notes=notes,
        flags=rows.flags,
    )


def also(first: IngestError, second: IngestError) -> IngestError:
    """Return a refusal for two faults of one file."""
    line = (second.file or "").rpartition(":")[2]
    place = f"line {line}: " if line.isdigit() else ""
    both = IngestError(f"{first.message}. Also {place}{second.message}", first.file, code=first.code)
    both.sessions = second.sessions
    return both


def _joined(tables: Sequence[ChannelTable]) -> ChannelTable:
    first = tables[0]
    if len(tables) == 1:
        return first
    for other in tables[1:]:
        _check_same_times(first, other)
    return replace(
        first,
        values={k: v for t in tables for k, v in t.values.items()},
        source={**first.source, "parts": [t.source for t in tables]},
        encodings={k: v for t in tables for k, v in t.encodings.items()},
        notes=tuple(n for t in tables for n in t.notes),
    )


def _check_same_times(first: ChannelTable, other: ChannelTable) -> None:
    """Refuse files that were not logged at the same times: their rows do not belong together."""
    rows = min(len(first.time_ns), len(other.time_ns))
    differs = np.flatnonzero(first.time_ns[:rows] != other.time_ns[:rows])
    same = "parts of one recording need the same times"
    if differs.size:
        row = int(differs[0])
        times = f"time {other.time_ns[row] / 1e9:.9g} s differs from {first.time_ns[row] / 1e9:.9g} s"
        hint = "a table's log with a clock of its own is marked own_clock: true"
        message = f"{times} in {first.place(row)}; {same}"
        raise IngestError(message, other.place(row), code="other_times", hint=hint)
    if len(first.time_ns) != len(other.time_ns):
        message = f"{other.source['rows']} rows, but {first.path} has {first.source['rows']}; {same}"
        raise IngestError(message, other.path, code="other_times")


def read_gcsv(path: Path, checks: Checks) -> ChannelTable:
    """Return the channels of a ``.gcsv`` file in the axes of its orientation; raw counts stay integers."""
    names, facts, line = _read_head(path)
    table = _read_one(path, _format(names, facts, line, path), checks)
    table = to_body_axes(table, dict.fromkeys(TRIADS, _orientation(facts, path)))
    kept = {k: v for k, v in facts.items() if k in ("id", "note", "fwversion", "vendor", "orientation")}
    return replace(table, source={**table.source, "gcsv": kept})


def _read_head(path: Path) -> tuple[list[str], dict[str, str], int]:
    """Return the names of the columns, all facts that the head states, and the number of its lines before the names."""
    with unchanged(path), path.open("rb") as stream:
        start = stream.read(LONGEST_HEADER)
    refuse_foreign(start[:16], str(path))
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


def _orientation(facts: dict[str, str], path: Path) -> tuple[str, str, str]:
    """Return the axis map of an orientation: body axis j is the reading named by letter j."""
    text = facts.get("orientation", "XYZ")
    if sorted(text.lower()) != ["x", "y", "z"]:
        message = f"orientation is {text!r}; it names X, Y and Z once each, small where turned round"
        raise IngestError(message, str(path), code="gcsv")
    found = {
        letter.lower(): ("+" if letter.isupper() else "-") + body for letter, body in zip(text, "xyz", strict=True)
    }
    return found["x"], found["y"], found["z"]
