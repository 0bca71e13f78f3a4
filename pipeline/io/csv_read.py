"""Text logs to channels in the units of the package; counts stay integers.

    value = (count - offset) / counts_per_unit

Files of one recording that were logged at the same times are joined row by row; the log of
a table with a clock of its own is aligned with the sensor's (``pipeline.io.encoder_log``).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import IngestError
from pipeline.io.channel_table import ChannelTable
from pipeline.io.csv_rows import read_rows
from pipeline.io.csv_times import in_order, times_of
from pipeline.io.ingest_settings import Checks
from pipeline.io.units import COUNTS, to_house_unit
from pipeline.records import Encoding, Note

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from pipeline.io.ingest_settings import Column, CsvFormat

TABLE_TIME = "table_time"


def read_csv(paths: Sequence[Path], formats: Sequence[CsvFormat], checks: Checks | None = None) -> ChannelTable:
    """Return the channels of a text log, or of the files of one recording."""
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
    """Return the channels of one file."""
    rows = read_rows(path, settings, checks)
    rows, time_ns = in_order(rows, times_of(rows, settings), settings, checks)
    notes = rows.notes
    if settings.rate_hz is not None:
        detail = f"no time column: rows counted at {settings.rate_hz:g} Hz"
        notes = (*notes, Note("N-SYNTHTIME", len(time_ns), 0, 0, detail))
    values, encodings = {}, {}
    for column, index in rows.layout.columns:
        if column.channel != "time":
            values[column.channel], encoding = _channel(column, rows.numbers[index])
            if encoding is not None:
                encodings[column.channel] = encoding
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


def _channel(column: Column, numbers: NDArray[np.float64]) -> tuple[NDArray[np.float64], Encoding | None]:
    """Return a channel's values in its unit of the package and, for whole counts, how they are encoded."""
    if column.unit != COUNTS:
        return to_house_unit(column.channel, numbers, column.unit), None
    encoding = Encoding(scale=1.0 / column.counts_per_unit, offset=column.offset)
    whole = bool(np.all(numbers == np.rint(numbers)))
    return encoding.decode(numbers), encoding if whole else None


def _joined(tables: Sequence[ChannelTable]) -> ChannelTable:
    """Return the files of one recording as one, row by row."""
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
