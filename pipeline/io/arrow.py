"""Numbers between numpy, pyarrow and canonical CSV; ``pyarrow.array`` would import pandas, which takes 0.25 s.

In a CSV a number with fixed decimals is an integer with a point in it,

    round(value * 10^d)  ->  decimal128(38, d)  ->  text

so that the file holds the nearest decimal, and reading it gives ``round(value * 10^d) / 10^d`` to the last bit.
"""

from __future__ import annotations

import os
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
from pyarrow import csv

from pipeline.errors import ConfigurationError
from pipeline.io.units import ACCELEROMETER, ATTITUDE, CANONICAL, GYROSCOPE

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from pipeline.records import Integers, Recording

BLOCKS = {"accelerometer": ACCELEROMETER, "gyroscope": GYROSCOPE, "table_attitude": ATTITUDE}
SINGLES = ("temperature", "table_angle", "table_rate", "flags")


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


def columns_of(recording: Recording) -> dict[str, NDArray[Any]]:
    """Return the times, channels and flags that a recording holds, by name."""
    columns: dict[str, NDArray[Any]] = {"time_ns": recording.time_ns}
    for name, channels in BLOCKS.items():
        block = getattr(recording, name)
        if block is not None:
            columns |= {c: np.ascontiguousarray(block[:, i]) for i, c in enumerate(channels)}
    return columns | {n: getattr(recording, n) for n in SINGLES if getattr(recording, n) is not None}


def write_canonical_csv(path: Path, recording: Recording, decimals: Mapping[str, int] = MappingProxyType({})) -> None:
    """Write a recording as canonical CSV; the file is replaced at once, never half written.

    Readings are written along the body axes. ``decimals``: header name (``accel_x_g`` ...) to digits after the point; a
    column that is not named keeps every bit.
    """
    unknown = [name for name in decimals if name not in CANONICAL.values()]
    if unknown:
        known = ", ".join(list(CANONICAL.values())[1:])
        raise ConfigurationError(f"decimals of unknown columns {', '.join(unknown)}; known are {known}")
    columns = columns_of(recording)
    time = columns.pop("time_ns")
    digits = next((d for d in (3, 6) if not np.any(time % 10 ** (9 - d))), 9)  # the fewest that hold the times exactly
    arrays = {CANONICAL["time"]: times_as_decimals(time, digits)}
    for channel, name in CANONICAL.items():
        if channel in columns and name in decimals:
            values = np.rint(columns[channel] * 10.0 ** decimals[name]).astype(np.int64)
            arrays[name] = _decimal(values, decimals[name])
        elif channel in columns:
            arrays[name] = to_arrow(np.ascontiguousarray(columns[channel]))
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    with temporary.open("wb") as stream:
        stream.write((",".join(arrays) + "\n").encode())
        csv.write_csv(pa.table(arrays), stream, csv.WriteOptions(include_header=False))
    temporary.replace(path)


def times_as_decimals(time_ns: Integers, digits: int = 9) -> pa.Array:
    """Return times in s as decimals with ``digits`` after the point, which have to hold them exactly."""
    return _decimal(time_ns, 9).cast(pa.decimal128(38, digits))


def _decimal(units: Integers, digits: int) -> pa.Array:
    """Return integers as decimals: ``units / 10^digits``; both words of 128 bits, the high one the sign."""
    words = np.empty((len(units), 2), np.int64)
    words[:, 0], words[:, 1] = units, units >> 63
    return pa.Array.from_buffers(pa.decimal128(38, digits), len(units), [None, pa.py_buffer(words)])
