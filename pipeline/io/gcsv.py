"""Gyroflow's self-describing log, ``.gcsv``: the file states scales, orientation and column names.

    GYROFLOW IMU LOG            (or CAMERA IMU LOG)
    version,1.3
    orientation,YxZ
    tscale,0.001                time [s]                  = tscale * t
    gscale,0.00122173047        angular rate [rad/s]      = gscale * count
    ascale,0.00048828125        specific force [g]        = ascale * count
    t,gx,gy,gz,ax,ay,az
    0,39,86,183,-1137,-15689,-2986

Source: docs.gyroflow.xyz/app/technical-details/gcsv-format (versions 1.0 to 1.3). The orientation names, for the
body's x, y and z, the reading that points along it (capital) or against it (small letter). A magnetometer (``mx`` ..)
is not used. Columns with canonical names (``temperature_degc``, ``table_angle_deg`` ...) may follow, in the unit that
the name states. A recording without an accelerometer holds ``t,gx,gy,gz``.
"""

from __future__ import annotations

import re
from dataclasses import replace
from fractions import Fraction
from typing import TYPE_CHECKING

from pipeline.errors import IngestError
from pipeline.io.channel_table import to_body_axes
from pipeline.io.csv_read import read_one
from pipeline.io.files import refuse_foreign, unchanged
from pipeline.io.ingest_settings import Column, CsvFormat
from pipeline.io.units import ATTITUDE, CANONICAL, COUNTS, DEGREES, SCALARS, TRIADS, UNITS

if TYPE_CHECKING:
    from pathlib import Path

    from pipeline.io.channel_table import ChannelTable
    from pipeline.io.ingest_settings import Checks

FIRST_LINES = (b"GYROFLOW IMU LOG", b"CAMERA IMU LOG")
LONGEST_HEADER = 1 << 16  # bytes that are searched for the line of names
LAST_VERSION = "1.3"


def read_gcsv(path: Path, checks: Checks) -> ChannelTable:
    """Return the channels of a ``.gcsv`` file in the axes of its orientation; raw counts stay integers."""
    names, facts, line = _read_head(path)
    table = read_one(path, _format(names, facts, line, path), checks)
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
