"""The ``csv`` and ``mcap`` sections of an ingest profile, checked.

Every key stands with its unit and a sentence in ``configs/ingest/canonical_csv.yaml``. A profile says what a file
holds; nothing about names, units, separators or order is guessed from the file.
"""

from __future__ import annotations

import difflib
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from pipeline.errors import ConfigurationError
from pipeline.formats.files import candidate_files
from pipeline.formats.units import CHANNELS, COUNTS, TRIADS, UNITS

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

WHITESPACE = "whitespace"
CSV_KEYS = ("delimiter", "header", "skip_lines", "parts", "rate_hz", "columns")
COLUMN_KEYS = ("column", "unit", "optional", "counts_per_unit", "offset")
MCAP_KEYS = ("imu_topic", "temperature_topic", "joint_topic", "attitude_topic", "joint")


@dataclass(frozen=True)
class Column:
    """Where a channel comes from: a column's name (or index from 0), its unit, and the scale of its counts."""

    channel: str
    column: str | int
    unit: str
    optional: bool = False
    counts_per_unit: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class CsvFormat:
    """How one text file is laid out.

    Attributes
    ----------
    delimiter : str
        One character, or ``whitespace`` for any run of blanks and tabs.
    header : bool
        Whether a line of column names stands before the data.
    skip_lines : int
        Lines before the header or the data.
    rate_hz : float or None
        Sampling rate of a file without a time column.
    columns : tuple of Column
    """

    delimiter: str
    header: bool
    skip_lines: int
    rate_hz: float | None
    columns: tuple[Column, ...]


@dataclass(frozen=True)
class McapFormat:
    """Topics of an MCAP file; None stands for the only one of its type."""

    imu_topic: str | None = None
    temperature_topic: str | None = None
    joint_topic: str | None = None
    attitude_topic: str | None = None
    joint: str | None = None


def check_ingest(ingest: Mapping[str, Any], procedure: Mapping[str, Any] | None = None) -> None:
    """Refuse an ingest profile that no file could be read with.

    Parameters
    ----------
    ingest : mapping
        Section of a unit's configuration.
    procedure : mapping, optional
        Where it is given, the profile's parts have to suit its recordings.

    Raises
    ------
    ConfigurationError
        Naming the key, what it is, what is allowed.
    """
    mcap_format(ingest)
    if ingest.get("csv"):
        csv_formats(ingest)
    if procedure is not None:
        candidate_files(procedure, ingest)


def csv_formats(ingest: Mapping[str, Any]) -> list[CsvFormat]:
    """Return the layout of each text file of a recording: one, or one for each of the profile's parts."""
    csv: Mapping[str, Any] = ingest.get("csv") or {}
    _refuse_unknown("ingest.csv", csv, CSV_KEYS)
    delimiter, skip_lines, rate_hz = csv.get("delimiter", ","), csv.get("skip_lines", 0), csv.get("rate_hz")
    header = csv.get("header", True)
    if delimiter != WHITESPACE and not (isinstance(delimiter, str) and len(delimiter) == 1 and delimiter.isascii()):
        raise ConfigurationError(f"ingest.csv.delimiter is {delimiter!r}; it is one character, or {WHITESPACE}")
    if not isinstance(header, bool):
        raise ConfigurationError(f"ingest.csv.header is {header!r}; it is true or false")
    if isinstance(skip_lines, bool) or not isinstance(skip_lines, int) or skip_lines < 0:
        raise ConfigurationError(f"ingest.csv.skip_lines is {skip_lines!r}; it is a number of lines, 0 or more")
    if rate_hz is not None and not (_is_number(rate_hz) and rate_hz > 0):
        raise ConfigurationError(f"ingest.csv.rate_hz is {rate_hz!r}; it is a positive number in Hz, or null")
    parts = csv.get("parts") or [{"file": None, "columns": csv.get("columns") or {}}]
    formats = []
    for index, part in enumerate(parts):
        where = f"ingest.csv.parts[{index}]" if csv.get("parts") else "ingest.csv"
        if csv.get("parts"):
            _refuse_unknown(where, part, ("file", "columns"))
            if not (isinstance(part.get("file"), str) and part["file"]):
                raise ConfigurationError(f"{where}.file is {part.get('file')!r}; it is the name of a file")
        columns = _columns(f"{where}.columns", part.get("columns") or {}, header=header)
        formats.append(CsvFormat(delimiter, header, skip_lines, rate_hz, columns))
    _check_channels(formats, rate_hz)
    return formats


def mcap_format(ingest: Mapping[str, Any]) -> McapFormat:
    """Return the topics of an MCAP file."""
    mcap: Mapping[str, Any] = ingest.get("mcap") or {}
    _refuse_unknown("ingest.mcap", mcap, MCAP_KEYS)
    for key, value in mcap.items():
        if not (value is None or isinstance(value, str)):
            raise ConfigurationError(f"ingest.mcap.{key} is {value!r}; it is a name, or null for the only one")
    return McapFormat(**mcap)


def _columns(where: str, columns: Mapping[str, Any], *, header: bool) -> tuple[Column, ...]:
    _refuse_unknown(where, columns, tuple(UNITS))
    return tuple(
        _column(f"{where}.{channel}", channel, entry, header=header)
        for channel, entry in columns.items()
        if entry is not None
    )


def _column(where: str, channel: str, entry: Mapping[str, Any], *, header: bool) -> Column:
    _refuse_unknown(where, entry, COLUMN_KEYS)
    column: Any = entry.get("column")
    unit = entry.get("unit")
    wanted = "a name of the header" if header else "an index from 0, for header is false"
    index = isinstance(column, int) and not isinstance(column, bool) and column >= 0
    if not (isinstance(column, str) and column if header else index):
        raise ConfigurationError(f"{where}.column is {column!r}; it is {wanted}")
    if str(unit) not in UNITS[channel]:
        raise ConfigurationError(f"{where}.unit is {unit!r}; allowed are {', '.join(UNITS[channel])}")
    scale, offset = entry.get("counts_per_unit"), entry.get("offset", 0.0)
    if unit == COUNTS and not (_is_number(scale) and scale != 0):
        raise ConfigurationError(f"{where}.counts_per_unit is {scale!r}; counts need a number other than 0")
    if unit != COUNTS and (scale is not None or offset):
        raise ConfigurationError(f"{where}: counts_per_unit and offset belong to the unit counts; this is {unit}")
    if not _is_number(offset):
        raise ConfigurationError(f"{where}.offset is {offset!r}; it is a number of counts")
    return Column(channel, column, str(unit), bool(entry.get("optional", False)), float(scale or 1.0), float(offset))


def _check_channels(formats: Iterable[CsvFormat], rate_hz: float | None) -> None:
    """Refuse a profile without time, without a sensor, or with half of one."""
    seen: set[str] = set()
    for layout in formats:
        channels = {c.channel for c in layout.columns}
        if ("time" in channels) == (rate_hz is not None):
            raise ConfigurationError(
                "ingest.csv needs either a time column (columns.time) or the sampling rate (rate_hz), in every part"
            )
        twice = seen & channels - {"time"}
        if twice:
            raise ConfigurationError(f"ingest.csv.parts: {', '.join(sorted(twice))} stands in two parts")
        seen |= channels
    for sensor, triad in TRIADS.items():
        missing = [c for c in triad if c not in seen]
        if 0 < len(missing) < 3:
            raise ConfigurationError(f"ingest.csv.columns: {', '.join(missing)} of the {sensor} is not described")
    if not seen & set(CHANNELS[:6]):
        raise ConfigurationError("ingest.csv.columns describes neither an accelerometer nor a gyroscope")


def _refuse_unknown(where: str, entries: Mapping[str, Any], allowed: tuple[str, ...]) -> None:
    if not hasattr(entries, "keys"):
        raise ConfigurationError(f"{where} is {entries!r}; it is a mapping with {', '.join(allowed)}")
    for key in entries:
        if key not in allowed:
            near = difflib.get_close_matches(str(key), allowed, 1)
            hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(allowed)}"
            raise ConfigurationError(f"{where}.{key} is unknown; {hint}")


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
