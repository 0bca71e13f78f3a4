"""Recordings to canonical CSV, fast: a number with fixed decimals is an integer with a point in it.

    round(value * 10^d)  ->  decimal128(38, d)  ->  text

so that the file holds the nearest decimal, and reading it gives ``round(value * 10^d) / 10^d`` to the last bit.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
from pyarrow import csv

from pipeline.errors import ConfigurationError
from pipeline.io.units import ACCELEROMETER, ATTITUDE, GYROSCOPE, SCALARS

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from pipeline.records import Recording

TIME = "time_s"
HEADER = (
    *(f"{c}_g" for c in ACCELEROMETER),
    *(f"{c}_dps" for c in GYROSCOPE),
    *(name for name in ("temperature_degc", "table_angle_deg", "table_rate_dps")),
    *ATTITUDE,
)


def write_canonical_csv(path: Path, recording: Recording, decimals: Mapping[str, int] | None = None) -> None:
    """Write a recording as canonical CSV; the file is replaced at once, never half written.

    Readings are written along the body axes. ``decimals``: header name (``accel_x_g`` ...) to digits after the point; a
    column that is not named keeps every bit.
    """
    decimals = decimals or {}
    columns = _columns(recording)
    unknown = [name for name in decimals if name not in HEADER]
    if unknown:
        raise ConfigurationError(f"decimals of unknown columns {', '.join(unknown)}; known are {', '.join(HEADER)}")
    arrays = {TIME: _decimal(recording.time_ns, 9).cast(pa.decimal128(38, _time_digits(recording.time_ns)))}
    for name, values in columns.items():
        if name in decimals:
            arrays[name] = _decimal(np.rint(values * 10.0 ** decimals[name]).astype(np.int64), decimals[name])
        else:
            arrays[name] = pa.array(values)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    with temporary.open("wb") as stream:
        stream.write((",".join(arrays) + "\n").encode())
        csv.write_csv(pa.table(arrays), stream, csv.WriteOptions(include_header=False))
    temporary.replace(path)


def _columns(recording: Recording) -> dict[str, NDArray[np.float64]]:
    """Return the channels of a recording under their canonical names."""
    blocks = (recording.accelerometer, recording.gyroscope, *(getattr(recording, name) for name in SCALARS))
    widths = (3, 3, 1, 1, 1, 4)
    names = iter(HEADER)
    out = {}
    for block, width in zip((*blocks, recording.table_attitude), widths, strict=True):
        for column in range(width):
            name = next(names)
            if block is not None:
                out[name] = np.ascontiguousarray(block[:, column] if block.ndim == 2 else block)
    return out


def _time_digits(time_ns: NDArray[np.int64]) -> int:
    """Return the fewest digits, of 3, 6 and 9, that hold the times exactly."""
    return next((d for d in (3, 6) if not np.any(time_ns % 10 ** (9 - d))), 9)


def _decimal(units: NDArray[np.int64], digits: int) -> pa.Array:
    """Return integers as decimals: ``units / 10^digits``; both words of 128 bits, the high one the sign."""
    words = np.empty((len(units), 2), np.int64)
    words[:, 0], words[:, 1] = units, units >> 63
    return pa.Array.from_buffers(pa.decimal128(38, digits), len(units), [None, pa.py_buffer(words)])
