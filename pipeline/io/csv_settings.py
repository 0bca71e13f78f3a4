"""The ``csv`` section of an ingest profile, checked.

Every key stands with its unit and a sentence in ``configs/ingest/canonical_csv.yaml``. A profile says what a file
holds; nothing about names, units, separators or order is guessed from the file.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Any

from pipeline.errors import ConfigurationError
from pipeline.io.setting_checks import is_number, refuse_unknown
from pipeline.io.units import CHANNELS, COUNTS, TRIADS, UNITS

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

NANOSECONDS = 1_000_000_000
WHITESPACE = "whitespace"
AUTO = "auto"
COMMENTED = "commented"
REFUSE, DROP, GAP = "refuse", "drop", "gap"
CSV_KEYS = (
    "delimiter", "decimal", "comment", "header", "skip_lines", "bad_rows", "nan", "session", "parts", "rate_hz",
    "columns",
)  # fmt: skip
COLUMN_KEYS = ("column", "unit", "optional", "counts_per_unit", "offset")


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
        One character, ``whitespace`` for any run of blanks and tabs, or ``auto`` to take it from the header.
    header : bool or str
        Whether a line of column names stands before the data; ``commented``: it is the last comment line.
    skip_lines : int
        Lines before the header or the data.
    rate_hz : float or None
        Sampling rate of a file without a time column.
    columns : tuple of Column
    decimal : str
        ``.`` or ``,``.
    comment : str or None
        What lines start with that are no data.
    bad_rows : str
        ``refuse``, or ``drop`` to leave a gap where a row cannot be read.
    nan : str
        ``refuse``, or ``gap`` to leave one where a row holds no number or an infinite one.
    session : int or None
        Which part, counted from 1, of a log that was restarted.
    own_clock : bool
        Whether the times are those of another clock (a table's log).
    tick_ns : Fraction or None
        Duration of one count of the time, where it comes in counts.
    """

    delimiter: str
    header: bool | str
    skip_lines: int
    rate_hz: float | None
    columns: tuple[Column, ...]
    decimal: str = "."
    comment: str | None = None
    bad_rows: str = REFUSE
    nan: str = REFUSE
    session: int | None = None
    own_clock: bool = False
    tick_ns: Fraction | None = None


def csv_formats(ingest: Mapping[str, Any]) -> list[CsvFormat]:
    """Return the layout of each text file of a recording: one, or one for each of the profile's parts."""
    csv: Mapping[str, Any] = ingest.get("csv") or {}
    refuse_unknown("ingest.csv", csv, CSV_KEYS)
    shared = _shared_settings(csv)
    parts = csv.get("parts") or [{"file": None, "columns": csv.get("columns") or {}}]
    formats = []
    for index, part in enumerate(parts):
        where = f"ingest.csv.parts[{index}]" if csv.get("parts") else "ingest.csv"
        if csv.get("parts"):
            refuse_unknown(where, part, ("file", "columns", "own_clock"))
            if not (isinstance(part.get("file"), str) and part["file"]):
                raise ConfigurationError(f"{where}.file is {part.get('file')!r}; it is the name of a file")
        own_clock = part.get("own_clock", False)
        if not isinstance(own_clock, bool):
            raise ConfigurationError(f"{where}.own_clock is {own_clock!r}; it is true or false")
        columns = _columns(f"{where}.columns", part.get("columns") or {}, header=bool(shared["header"]))
        formats.append(CsvFormat(**shared, columns=columns, own_clock=own_clock, tick_ns=_tick_ns(columns)))
    _check_channels(formats, shared["rate_hz"])
    return formats


def _shared_settings(csv: Mapping[str, Any]) -> dict[str, Any]:
    """Return the checked settings that all files of a recording share."""
    out: dict[str, Any] = {
        "delimiter": csv.get("delimiter", ","),
        "header": csv.get("header", True),
        "skip_lines": csv.get("skip_lines", 0),
        "rate_hz": csv.get("rate_hz"),
        "decimal": csv.get("decimal", "."),
        "comment": csv.get("comment"),
        "bad_rows": csv.get("bad_rows", REFUSE),
        "nan": csv.get("nan", REFUSE),
        "session": csv.get("session"),
    }
    delimiter, header, comment, rate_hz = (out[k] for k in ("delimiter", "header", "comment", "rate_hz"))
    one_character = isinstance(delimiter, str) and len(delimiter) == 1 and delimiter.isascii()
    rules: dict[str, tuple[bool, str]] = {
        "delimiter": (delimiter in (WHITESPACE, AUTO) or one_character, f"one character, or {WHITESPACE}, or {AUTO}"),
        "header": (isinstance(header, bool) or header == COMMENTED, f"true or false, or {COMMENTED}"),
        "skip_lines": (_is_count(out["skip_lines"], 0), "a number of lines, 0 or more"),
        "rate_hz": (rate_hz is None or (is_number(rate_hz) and rate_hz > 0), "a positive number in Hz, or null"),
        "decimal": (out["decimal"] in (".", ","), "'.' or ','"),
        "comment": (comment is None or (isinstance(comment, str) and bool(comment.strip())), "a text, or null"),
        "bad_rows": (out["bad_rows"] in (REFUSE, DROP), f"{REFUSE} or {DROP}"),
        "nan": (out["nan"] in (REFUSE, GAP), f"{REFUSE} or {GAP}"),
        "session": (out["session"] is None or _is_count(out["session"], 1), "a number counted from 1, or null"),
    }
    for key, (allowed, what) in rules.items():
        if not allowed:
            raise ConfigurationError(f"ingest.csv.{key} is {out[key]!r}; it is {what}")
    if out["decimal"] == delimiter:
        raise ConfigurationError(f"ingest.csv.decimal and ingest.csv.delimiter are both {delimiter!r}")
    if header == COMMENTED and comment is None:
        raise ConfigurationError(f"ingest.csv.header is {COMMENTED}; ingest.csv.comment has to say how comments start")
    return out


def _is_count(value: object, least: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= least


def _columns(where: str, columns: Mapping[str, Any], *, header: bool) -> tuple[Column, ...]:
    refuse_unknown(where, columns, tuple(UNITS))
    return tuple(
        _column(f"{where}.{channel}", channel, entry, header=header)
        for channel, entry in columns.items()
        if entry is not None
    )


def _tick_ns(columns: Iterable[Column]) -> Fraction | None:
    """Return the duration of one count of the time, None where it comes in a unit."""
    counted = next((c for c in columns if c.channel == "time" and c.unit == COUNTS), None)
    return None if counted is None else NANOSECONDS / Fraction(repr(counted.counts_per_unit))


def _column(where: str, channel: str, entry: Mapping[str, Any], *, header: bool) -> Column:
    refuse_unknown(where, entry, COLUMN_KEYS)
    column: Any = entry.get("column")
    unit = entry.get("unit")
    wanted = "a name of the header" if header else "an index from 0, for header is false"
    index = isinstance(column, int) and not isinstance(column, bool) and column >= 0
    if not (isinstance(column, str) and column if header else index):
        raise ConfigurationError(f"{where}.column is {column!r}; it is {wanted}")
    allowed = (*UNITS[channel], COUNTS) if channel == "time" else tuple(UNITS[channel])
    if str(unit) not in allowed:
        raise ConfigurationError(f"{where}.unit is {unit!r}; allowed are {', '.join(allowed)}")
    scale, offset = entry.get("counts_per_unit"), entry.get("offset", 0.0)
    if unit == COUNTS and not (is_number(scale) and scale != 0):
        raise ConfigurationError(f"{where}.counts_per_unit is {scale!r}; counts need a number other than 0")
    if unit != COUNTS and (scale is not None or offset):
        raise ConfigurationError(f"{where}: counts_per_unit and offset belong to the unit counts; this is {unit}")
    if channel == "time" and offset:
        raise ConfigurationError(f"{where}.offset is {offset!r}; a time has none")
    if not is_number(offset):
        raise ConfigurationError(f"{where}.offset is {offset!r}; it is a number of counts")
    return Column(channel, column, str(unit), bool(entry.get("optional", False)), float(scale or 1.0), float(offset))


def _check_channels(formats: Iterable[CsvFormat], rate_hz: float | None) -> None:
    """Refuse a profile without time, without a sensor, or with half of one."""
    seen: set[str] = set()
    for layout in formats:
        channels = {c.channel for c in layout.columns}
        foreign = sorted(channels & set(CHANNELS[:6]))
        if layout.own_clock and (foreign or "time" not in channels):
            raise ConfigurationError(
                f"ingest.csv.parts: a part with own_clock is a table's log with its time; it holds {foreign or 'none'}"
            )
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
