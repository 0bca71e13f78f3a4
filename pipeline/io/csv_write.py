"""Recordings to canonical CSV, fast: a number with fixed decimals is an integer with a point in it.

    round(value * 10^d)  ->  decimal128(38, d)  ->  text

so that the file holds the nearest decimal, and reading it gives ``round(value * 10^d) / 10^d`` to the last bit.
"""

from __future__ import annotations

import os
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
from pyarrow import csv

from pipeline.errors import ConfigurationError
from pipeline.io.arrow import to_arrow
from pipeline.io.parquet import columns_of
from pipeline.io.units import CANONICAL

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from pipeline.records import Recording


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
    arrays = {CANONICAL["time"]: times_as_decimals(time, _time_digits(time))}
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


def times_as_decimals(time_ns: NDArray[np.int64], digits: int = 9) -> pa.Array:
    """Return times in s as decimals with ``digits`` after the point, which have to hold them exactly."""
    return _decimal(time_ns, 9).cast(pa.decimal128(38, digits))


def _time_digits(time_ns: NDArray[np.int64]) -> int:
    """Return the fewest digits, of 3, 6 and 9, that hold the times exactly."""
    return next((d for d in (3, 6) if not np.any(time_ns % 10 ** (9 - d))), 9)


def _decimal(units: NDArray[np.int64], digits: int) -> pa.Array:
    """Return integers as decimals: ``units / 10^digits``; both words of 128 bits, the high one the sign."""
    words = np.empty((len(units), 2), np.int64)
    words[:, 0], words[:, 1] = units, units >> 63
    return pa.Array.from_buffers(pa.decimal128(38, digits), len(units), [None, pa.py_buffer(words)])
