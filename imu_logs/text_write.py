"""Write canonical CSV from logs and DataFrames by pyarrow; columns of pyarrow from arrays, and arrays from columns.

A number with d decimals is written as a decimal,

    round(value * 10^d)  ->  decimal128(38, d)  ->  text

so that the file contains the nearest decimal, and reading it gives ``round(value * 10^d) / 10^d`` to the last bit.

``pyarrow.array`` is not used for columns of a log, because it imports pandas, which takes 0.25 s.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import csv as arrow_csv

from imu_logs.errors import ConfigurationError, IngestError
from imu_logs.files import replacing
from imu_logs.log import Integers, Log, Values
from imu_logs.units import CANONICAL

if TYPE_CHECKING:
    import pandas as pd


IN_SECONDS = "time_s is a number of seconds: (times - times.iloc[0]).dt.total_seconds()"


def canonical_csv(name: str, frame: pd.DataFrame) -> bytes:
    """Return the canonical CSV of a recording that is a DataFrame; its row ``i`` is line ``i + 2``.

    A float is written by its shortest text that reads back as the same float. Columns that are not canonical keep only
    their names, which the reader notes. Raises ``IngestError`` for canonical columns that are not finite numbers;
    missing and repeated columns are left to the reader.
    """
    if frame.columns.nlevels > 1:
        message = f"the columns have {frame.columns.nlevels} levels; one level with the names of the canonical CSV"
        raise IngestError(f"{message} is expected", name, code="missing_column")
    time = CANONICAL["time"]
    if time not in frame.columns and time in frame.index.names:
        raise IngestError(f"{time} is the index", name, code="missing_column", hint="give frame.reset_index()")
    header = io.StringIO()
    names = [" ".join(str(column).split()) for column in frame.columns]
    csv.writer(header, lineterminator="\n").writerow(names)
    known = set(CANONICAL.values())
    unused = np.zeros(len(frame), np.int8)
    columns = [numbers(name, frame.iloc[:, i]) if n in known else unused for i, n in enumerate(names)]
    body = pa.BufferOutputStream()
    if columns and len(frame):
        rows = pa.Table.from_arrays([pa.array(column) for column in columns], [str(i) for i in range(len(columns))])
        arrow_csv.write_csv(rows, body, arrow_csv.WriteOptions(include_header=False))
    return b"".join((header.getvalue().encode(), body.getvalue()))


def numbers(name: str, column: pd.Series) -> Values:
    """Return a column as finite numbers; raises ``IngestError``. ``name``: of the DataFrame, for messages."""
    if column.dtype.kind not in "iuf":
        hint = IN_SECONDS if column.dtype.kind in "mM" else f"convert it: pandas.to_numeric(frame[{column.name!r}])"
        message = f"column {column.name} has the dtype {column.dtype}; numbers are expected"
        raise IngestError(message, name, code="not_a_number", hint=hint)
    values = column.to_numpy(np.float64, na_value=np.nan)
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        row, more = int(bad[0]), f" and in {bad.size - 1} more rows" if bad.size > 1 else ""
        message = f"column {column.name} is {values[row]:g} in row {row} (index {column.index[row]!r}){more}"
        hint = "drop such rows; the gap that they leave is noted"
        raise IngestError(message, name, code="not_finite", hint=hint)
    return np.asarray(values)


def to_numpy(column: Any) -> NDArray[Any]:  # noqa: ANN401  (pyarrow has no types)
    """Return the numbers of a column without nulls."""
    return np.asarray(np.from_dlpack(column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column))


def to_arrow(values: NDArray[Any]) -> pa.Array:
    """Return numbers as a column."""
    return pa.Array.from_buffers(pa.from_numpy_dtype(values.dtype), len(values), [None, pa.py_buffer(values)])


def text_scalar(text: str) -> pa.Scalar:
    """Return a text as a scalar for functions of ``pyarrow.compute``."""
    data = text.encode()
    offsets = np.array([0, len(data)], np.int32)
    return pa.Array.from_buffers(pa.string(), 1, [None, pa.py_buffer(offsets), pa.py_buffer(data)])[0]


def times_as_decimals(time_ns: Integers, digits: int = 9) -> pa.Array:
    """Return times in s as decimals with ``digits`` after the point, which must represent them exactly."""
    return _decimal(time_ns, 9).cast(pa.decimal128(38, digits))


def _decimal(units: Integers, digits: int) -> pa.Array:
    """Return integers as decimals ``units / 10^digits``; the high word of the 128 bits is the sign."""
    words = np.empty((len(units), 2), np.int64)
    words[:, 0], words[:, 1] = units, units >> 63
    return pa.Array.from_buffers(pa.decimal128(38, digits), len(units), [None, pa.py_buffer(words)])


def write_canonical_csv(path: Path, log: Log, decimals: Mapping[str, int] = MappingProxyType({})) -> None:
    """Write a log as canonical CSV; the file is replaced atomically.

    ``decimals``: header name (``accel_x_g`` ...) to digits after the point;
    other columns are written without loss.
    """
    unknown = [name for name in decimals if name not in CANONICAL.values()]
    if unknown:
        known = ", ".join(list(CANONICAL.values())[1:])
        raise ConfigurationError(f"decimals of unknown columns {', '.join(unknown)}; known are {known}")
    columns, time = log.values, log.time_ns
    digits = next((d for d in (3, 6) if not np.any(time % 10 ** (9 - d))), 9)  # the fewest that hold the times exactly
    arrays = {CANONICAL["time"]: times_as_decimals(time, digits)}
    for channel, name in CANONICAL.items():
        if channel in columns and name in decimals:
            values = np.rint(columns[channel] * 10.0 ** decimals[name]).astype(np.int64)
            arrays[name] = _decimal(values, decimals[name])
        elif channel in columns:
            arrays[name] = to_arrow(np.ascontiguousarray(columns[channel]))
    with replacing(path) as new, new.open("wb") as stream:
        stream.write((",".join(arrays) + "\n").encode())
        arrow_csv.write_csv(pa.table(arrays), stream, arrow_csv.WriteOptions(include_header=False))


def write_parquet(path: Path, log: Log) -> None:
    """Write ``log.to_arrow()`` as a Parquet file; the file is replaced atomically."""
    from pyarrow import parquet  # noqa: PLC0415  (only where it is needed)

    with replacing(path) as new:
        parquet.write_table(log.to_arrow(), new)
