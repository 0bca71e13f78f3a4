"""Text logs to channels: typed parsing without inference, units, and counts that stay integers.

    value = (count - offset) / counts_per_unit

Files of one recording that were logged at the same times are joined row by row; a table's log with a clock of its own
is brought to the sensor's (``pipeline.io.clock_alignment``).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import IngestError
from pipeline.io.channel_table import ChannelTable
from pipeline.io.csv_careful import read_carefully
from pipeline.io.csv_order import in_order
from pipeline.io.csv_quick import read_quickly
from pipeline.io.csv_time import LONGEST_S, refuse_coarse, seconds_per_unit, whole_times
from pipeline.io.ingest_settings import Checks
from pipeline.io.units import COUNTS, UNITS, decode, to_house_unit
from pipeline.records import Encoding, Note

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from pipeline.io.csv_rows import Rows
    from pipeline.io.ingest_settings import Column, CsvFormat

TABLE_TIME = "table_time"


def read_csv(paths: Sequence[Path], formats: Sequence[CsvFormat], checks: Checks | None = None) -> ChannelTable:
    """Read a text log, or the parts of one.

    Parameters
    ----------
    paths : sequence of Path
    formats : sequence of CsvFormat
        The layout of each file.
    checks : Checks, optional

    Returns
    -------
    ChannelTable

    Raises
    ------
    InputError
        With ``path:line`` where a line is to blame.
    """
    tables = [read_one(path, layout, checks or Checks()) for path, layout in zip(paths, formats, strict=True)]
    same = [t for t, layout in zip(tables, formats, strict=True) if not layout.own_clock]
    others = [t for t, layout in zip(tables, formats, strict=True) if layout.own_clock]
    joined = _joined(same)
    if others or TABLE_TIME in joined.values:
        from pipeline.io.encoder_log import align, own_rows  # noqa: PLC0415  (few logs need it)

        for log in others or [own_rows(joined)]:
            joined = align(joined, log)
    return joined


def read_one(path: Path, settings: CsvFormat, checks: Checks) -> ChannelTable:
    """Read one file."""
    rows = read_quickly(path, settings) or read_carefully(path, settings, checks)
    tick_ns = float(settings.tick_ns or UNITS["time"][_unit_of_time(rows)][0])
    ordered = in_order(rows, _times(rows, settings), settings.session, checks, tick_ns)
    rows = ordered.rows
    source = {"file": rows.path, "sha256": rows.sha256, "rows": rows.count}
    values, encodings, notes = {}, {}, list(rows.notes)
    if settings.rate_hz is not None:
        notes.append(Note("N-SYNTHTIME", rows.count, 0, 0, f"no time column: rows counted at {settings.rate_hz:g} Hz"))
    for column, index in rows.columns:
        if column.channel != "time":
            uses = sum(i == index for _, i in rows.columns)
            numbers = rows.numbers[index] if uses > 1 else rows.numbers.pop(index)
            values[column.channel], encoding = _channel(column, numbers)
            if encoding is not None:
                encodings[column.channel] = encoding
    return ChannelTable(
        rows.path, ordered.time_ns, values, source, rows.line_of, encodings, tuple(notes), ordered.flags
    )


def _joined(tables: Sequence[ChannelTable]) -> ChannelTable:
    """Return the files of one recording as one, row by row."""
    first = tables[0]
    if len(tables) == 1:
        return first
    for other in tables[1:]:
        _check_same_times(first, other)
    return ChannelTable(
        path=first.path,
        time_ns=first.time_ns,
        values={k: v for t in tables for k, v in t.values.items()},
        source={**first.source, "parts": [t.source for t in tables]},
        line_of=first.line_of,
        encodings={k: v for t in tables for k, v in t.encodings.items()},
        notes=tuple(n for t in tables for n in t.notes),
        flags=first.flags,
    )


def _channel(column: Column, numbers: NDArray[np.float64]) -> tuple[NDArray[np.float64], Encoding | None]:
    """Return a channel's values in its house unit and, for whole counts, the way back to them."""
    if column.unit != COUNTS:
        return to_house_unit(column.channel, numbers, column.unit), None
    encoding = Encoding(scale=1.0 / column.counts_per_unit, offset=column.offset)
    whole = bool(np.all(numbers == np.rint(numbers)))
    return decode(numbers, encoding), encoding if whole else None


def _unit_of_time(rows: Rows) -> str:
    return next((c.unit for c, _ in rows.columns if c.channel == "time"), "s")


def _times(rows: Rows, settings: CsvFormat) -> NDArray[np.int64]:
    """Return the time of each row, ns."""
    if settings.rate_hz is not None:
        counted: NDArray[np.int64] = np.rint(np.arange(rows.count) * (1e9 / settings.rate_hz)).astype(np.int64)
        return counted
    column, index = next((c, i) for c, i in rows.columns if c.channel == "time")
    values, name = rows.numbers[index], rows.names[index]
    unit_s = float(settings.tick_ns) / 1e9 if settings.tick_ns is not None else seconds_per_unit(column.unit)
    largest = float(np.max(np.abs(values[[np.argmin(values), np.argmax(values)]]))) * unit_s
    if largest >= LONGEST_S:
        row = int(np.argmax(np.abs(values)))
        raise IngestError(
            f"time {values[row] * unit_s:g} s is out of range; is {column.unit} the unit of column {name}?",
            f"{rows.path}:{rows.line_of(row)}",
            fault="wrong_rate",
        )
    if rows.exact_ns is not None:
        refuse_coarse(values, rows.exact_ns, column.unit, name, rows.path)
        return rows.exact_ns
    return whole_times(values, column.unit, settings.tick_ns)


def _check_same_times(first: ChannelTable, other: ChannelTable) -> None:
    """Refuse parts that were not logged at the same times: their rows do not belong together."""
    if np.array_equal(first.time_ns, other.time_ns):
        return
    rows = min(len(first.time_ns), len(other.time_ns))
    differs = np.flatnonzero(first.time_ns[:rows] != other.time_ns[:rows])
    if differs.size == 0:
        raise IngestError(
            f"{other.source['rows']} rows, but {first.path} has {first.source['rows']}; parts of one recording need "
            "the same times",
            other.path,
            fault="other_times",
        )
    row = int(differs[0])
    raise IngestError(
        f"time {other.time_ns[row] / 1e9:.9g} s differs from {first.time_ns[row] / 1e9:.9g} s in {first.place(row)}; "
        "parts of one recording need the same times",
        other.place(row),
        fault="other_times",
        hint="a table's log with a clock of its own is marked own_clock: true",
    )
