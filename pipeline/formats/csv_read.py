"""Text logs to channels: typed parsing without inference, units, and counts that stay integers.

    value = (count - offset) / counts_per_unit

    time  = integer nanoseconds: round(t * 10^9), from the decimal digits themselves where doubles are too coarse

where a double of t seconds is finer than half a nanosecond up to t = 10^6 s (and Unix time, 1.7*10^9 s, is not).
"""

from __future__ import annotations

from decimal import Decimal
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
from pyarrow import csv

from pipeline.errors import InputError
from pipeline.formats.channel_table import ChannelTable
from pipeline.formats.csv_fault import explain
from pipeline.formats.csv_layout import find_layout
from pipeline.formats.text_file import load_text
from pipeline.formats.units import COUNTS, UNITS, decode, to_house_unit
from pipeline.records import Encoding, Note

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from pipeline.formats.csv_layout import Layout
    from pipeline.formats.settings import Column, CsvFormat

EXACT_BELOW_S = 1e6
LONGEST_S = 9.2e9  # int64 nanoseconds end at 292 years
DECIMAL_DIGITS = {"s": 9, "ms": 6, "us": 3, "ns": 0}


def read_csv(paths: Sequence[Path], formats: Sequence[CsvFormat]) -> ChannelTable:
    """Read a text log, or the parts of one that were logged at the same times.

    Parameters
    ----------
    paths : sequence of Path
    formats : sequence of CsvFormat
        The layout of each file.

    Returns
    -------
    ChannelTable

    Raises
    ------
    InputError
        With ``path:line`` where a line is to blame.
    """
    tables = [_read_one(path, layout) for path, layout in zip(paths, formats, strict=True)]
    first = tables[0]
    for other in tables[1:]:
        _check_same_times(first, other)
    if len(tables) == 1:
        return first
    return ChannelTable(
        path=first.path,
        time_ns=first.time_ns,
        values={k: v for t in tables for k, v in t.values.items()},
        source={**first.source, "parts": [t.source for t in tables]},
        line_of=first.line_of,
        encodings={k: v for t in tables for k, v in t.encodings.items()},
        notes=tuple(n for t in tables for n in t.notes),
    )


def _read_one(path: Path, settings: CsvFormat) -> ChannelTable:
    text = load_text(path)
    layout = find_layout(text, settings)
    wanted = sorted({index for _, index in layout.columns})
    try:
        table = _parse(layout, dict.fromkeys(wanted, pa.float64()))
    except pa.ArrowInvalid as error:
        raise explain(layout, str(error)) from error
    numbers = {i: table.column(str(i)).to_numpy() for i in wanted}
    if not all(np.isfinite(v).all() for v in numbers.values()):
        raise explain(layout, "a value is not finite")
    notes = list(layout.notes)
    time_ns, values, encodings = _times(layout, settings, numbers, table.num_rows, notes), {}, {}
    for column, index in layout.columns:
        if column.channel != "time":
            values[column.channel], encoding = _channel(column, numbers[index])
            if encoding is not None:
                encodings[column.channel] = encoding
    source = {"file": text.path, "sha256": text.sha256, "rows": table.num_rows}
    return ChannelTable(text.path, time_ns, values, source, layout.line_of, encodings, tuple(notes))


def _parse(layout: Layout, types: dict[int, Any]) -> Any:  # noqa: ANN401  (pyarrow has no types)
    """Parse some columns, named by their index; no value stands for a missing one."""
    return csv.read_csv(
        pa.py_buffer(layout.body),
        read_options=csv.ReadOptions(
            use_threads=False,
            block_size=min(len(layout.body) + 1, 1 << 24),
            column_names=[str(i) for i in range(len(layout.names))],
        ),
        parse_options=csv.ParseOptions(
            delimiter=layout.delimiter, quote_char='"' if b'"' in layout.body else False, newlines_in_values=False
        ),
        convert_options=csv.ConvertOptions(
            column_types={str(i): t for i, t in types.items()},
            include_columns=[str(i) for i in types],
            null_values=[],
            check_utf8=False,
        ),
    )


def _channel(column: Column, numbers: NDArray[np.float64]) -> tuple[NDArray[np.float64], Encoding | None]:
    """Return a channel's values in its house unit and, for whole counts, the way back to them."""
    if column.unit != COUNTS:
        return to_house_unit(column.channel, numbers, column.unit), None
    encoding = Encoding(scale=1.0 / column.counts_per_unit, offset=column.offset)
    whole = bool(np.all(numbers == np.rint(numbers)))
    return decode(numbers, encoding), encoding if whole else None


def _times(
    layout: Layout, settings: CsvFormat, numbers: dict[int, NDArray[np.float64]], rows: int, notes: list[Note]
) -> NDArray[np.int64]:
    """Return the time of each row, ns."""
    if settings.rate_hz is not None:
        notes.append(Note("N-SYNTHTIME", rows, 0, 0, f"no time column: rows counted at {settings.rate_hz:g} Hz"))
        counted: NDArray[np.int64] = np.rint(np.arange(rows) * (1e9 / settings.rate_hz)).astype(np.int64)
        return counted
    column, index = next((c, i) for c, i in layout.columns if c.channel == "time")
    seconds = numbers[index] * (UNITS["time"][column.unit][0] / 1e9)
    largest = float(np.max(np.abs(seconds)))
    if largest >= LONGEST_S:
        row = int(np.argmax(np.abs(seconds)))
        raise InputError(
            f"time {seconds[row]:g} s is out of range; is {column.unit} the unit of column {layout.names[index]}?",
            f"{layout.path}:{layout.line_of(row)}",
        )
    if largest >= EXACT_BELOW_S:
        return _exact_times(layout, index, DECIMAL_DIGITS[column.unit])
    rounded: NDArray[np.int64] = np.rint(numbers[index] * UNITS["time"][column.unit][0]).astype(np.int64)
    return rounded


def _exact_times(layout: Layout, index: int, digits: int) -> NDArray[np.int64]:
    """Return times in ns from their decimal digits: a decimal with ``digits`` places is an integer of ns."""
    try:
        decimals = _parse(layout, {index: pa.decimal128(38, digits)}).column(0).combine_chunks()
        words = np.frombuffer(decimals.buffers()[1], np.int64)
        return words[2 * decimals.offset : 2 * (decimals.offset + len(decimals)) : 2].copy()  # low words of 128 bits
    except pa.ArrowInvalid:  # more digits than whole ns have
        strings = _parse(layout, {index: pa.string()}).column(0).to_pylist()
        return np.array([int(Decimal(s.strip()).scaleb(digits).to_integral_value()) for s in strings], np.int64)


def _check_same_times(first: ChannelTable, other: ChannelTable) -> None:
    """Refuse parts that were not logged at the same times: their rows do not belong together."""
    if np.array_equal(first.time_ns, other.time_ns):
        return
    rows = min(len(first.time_ns), len(other.time_ns))
    differs = np.flatnonzero(first.time_ns[:rows] != other.time_ns[:rows])
    if differs.size == 0:
        raise InputError(
            f"{other.source['rows']} rows, but {first.path} has {first.source['rows']}; parts of one recording need "
            "the same times",
            other.path,
        )
    row = int(differs[0])
    raise InputError(
        f"time {other.time_ns[row] / 1e9:.9g} s differs from {first.time_ns[row] / 1e9:.9g} s in {first.place(row)}; "
        "parts of one recording need the same times",
        other.place(row),
    )
