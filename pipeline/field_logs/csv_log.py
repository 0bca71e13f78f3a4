"""A text log with calibrated readings.

The columns that the profile names as readings are replaced by calibrated ones in g and deg/s, under the canonical names
``accel_x_g`` .. ``gyro_z_dps``. Every other cell, and the lines before the data, are written unchanged.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
from pyarrow import compute as pc

from pipeline.errors import InputError
from pipeline.field_logs.compensate import Block
from pipeline.field_logs.profile import EPOCH_AFTER_S
from pipeline.io.csv_cells import digits, lines_of, read_head, text_blocks
from pipeline.io.ingest_settings import csv_formats
from pipeline.io.units import COUNTS, TRIADS, UNITS, decode, to_house_unit
from pipeline.records import SENSORS, Encoding

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from pipeline.field_logs.compensate import Readings, Result
    from pipeline.field_logs.log_checks import LogChecks
    from pipeline.field_logs.output import Output
    from pipeline.field_logs.profile import LogProfile
    from pipeline.io.csv_cells import Head, TextBlock
    from pipeline.io.ingest_settings import Column

SIGNALS = {**TRIADS, "temperature": ("temperature",), "time": ("time",)}
CANONICAL = {c: f"{c}_{'g' if s == 'accelerometer' else 'dps'}" for s in SENSORS for c in TRIADS[s]}
NANOSECONDS = 1e9


class CsvLog:
    """A text log; see ``pipeline.field_logs.compensate.Log``."""

    def __init__(self, source: Path, out: Output, profile: LogProfile, smoothing: float, block_bytes: int) -> None:
        formats = csv_formats(profile.ingest)
        if len(formats) > 1:
            raise InputError(
                "the profile joins several files to one recording, which apply does not; write them into one file, "
                "or choose another profile by --ingest",
                str(source),
            )
        self.source, self.out, self.profile, self.settings = source, out, profile, formats[0]
        self.smoothing, self.block_bytes = smoothing, block_bytes
        self.columns = {c.channel: c for c in self.settings.columns}
        self.places: dict[str, list[int]] = {}  # of the columns of each signal
        self.origin = 0.0

    def blocks(self, _needs: set[str], checks: LogChecks) -> Iterator[Block]:
        """Yield the samples, and write the lines before them."""
        with self.source.open("rb") as raw:
            head = read_head(raw, self.settings, self.source)
            self._find(head.names, f"{self.source}:{len(head.lines) + 1}")
            self.out.write(head.text(self._new_names(head.names)).encode())
            rows = 0
            for block in text_blocks(raw, head, self.settings, self.block_bytes, self.source):
                if rows == 0:
                    readings = [block.columns[i] for s in SENSORS for i in self.places.get(s, [])]
                    checks.check_decimals(readings, self.settings.decimal)
                signals = self._signals(block, head, rows)
                file = partial(self._line, block)
                yield Block(signals, file, "", raw.tell(), (block, head))
                rows += block.rows

    def _line(self, block: TextBlock) -> str:
        return f"{self.source}:{block.line_of(0)}"

    def write(self, block: Block, readings: Readings, _changed: set[str]) -> None:
        """Write the block with calibrated numbers in place of the raw ones; missing ones stay as they were written."""
        text_block: TextBlock
        head: Head
        text_block, head = block.content
        columns = text_block.columns
        for sensor, values in readings.items():
            for k, i in enumerate(self.places[sensor]):
                text = digits(values[:, k], self.settings.decimal)
                missing = ~np.isfinite(values[:, k])
                if missing.any():
                    written = pa.array(~np.isfinite(block.signals[sensor][:, k]))
                    text = pc.if_else(pa.array(missing), pc.if_else(written, columns[i], ""), text)
                columns[i] = text
        self.out.write(lines_of(columns, head.delimiter, quoted=text_block.quoted))

    def finish(self, result: Result) -> None:
        """Name the sensors of a log without rows too."""
        result.sensors = [sensor for sensor in SENSORS if sensor in self.places]

    def _find(self, names: list[str], where: str) -> None:
        """Find the columns of each signal."""
        for signal, channels in SIGNALS.items():
            wanted = [self.columns[c] for c in channels if c in self.columns]
            present = [c for c in wanted if _index(c, names) is not None]
            twice = [c.column for c in present if names.count(str(c.column)) > 1]
            if twice:
                raise InputError(f"the header names {twice[0]} more than once", where)
            if present and len(present) < len(wanted):
                missing = ", ".join(str(c.column) for c in wanted if c not in present)
                message = f"the header names {', '.join(str(c.column) for c in present)}, but not {missing}"
                raise InputError(message, where)
            if present:
                self.places[signal] = [i for c in present if (i := _index(c, names)) is not None]
        if not any(sensor in self.places for sensor in SENSORS):
            told = "--ingest names the profile that describes this log"
            if set(CANONICAL.values()) & set(names):
                told = f"these are the columns that this command writes: the log is compensated already, else {told}"
            expected = ", ".join(str(self.columns[c].column) for s in SENSORS for c in TRIADS[s] if c in self.columns)
            raise InputError(f"no column of a sensor; expected {expected}, got {', '.join(names)[:200]}; {told}", where)

    def _new_names(self, names: list[str]) -> list[str]:
        """Return the names of the columns of the output."""
        new = list(names)
        for sensor in (s for s in SENSORS if s in self.places):
            for channel, i in zip(TRIADS[sensor], self.places[sensor], strict=True):
                new[i] = CANONICAL[channel]
        return new

    def _signals(self, block: TextBlock, head: Head, rows: int) -> dict[str, Any]:
        """Return the signals of a block in g, deg/s, degC and s, the readings in body axes."""
        out: dict[str, Any] = {}
        for signal, where in self.places.items():
            numbers = block.numbers(where, self.settings.decimal, head.names, self.source)
            columns = [self.columns[c] for c in SIGNALS[signal]]
            for k, column in enumerate(columns):
                numbers[:, k] = _in_house_unit(column, numbers[:, k])
            out[signal] = self.profile.to_body(signal, numbers) if signal in SENSORS else numbers[:, 0]
        if self.settings.rate_hz is not None:
            out["time"] = np.arange(rows, rows + block.rows) / self.settings.rate_hz
        if "time" in out:
            if rows == 0 and out["time"][0] > EPOCH_AFTER_S:
                self.origin = float(out["time"][0])
            out["time"] = out["time"] - self.origin
        return out


def _index(column: Column, names: list[str]) -> int | None:
    if isinstance(column.column, int):
        return column.column if column.column < len(names) else None
    return names.index(column.column) if column.column in names else None


def _in_house_unit(column: Column, numbers: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return values in g, deg/s, degC or s."""
    if column.unit == COUNTS:
        return decode(numbers, Encoding(1.0 / column.counts_per_unit, column.offset))
    if column.channel == "time":
        multiplier, divisor = UNITS["time"][column.unit]
        return numbers / (NANOSECONDS * divisor / multiplier)
    return to_house_unit(column.channel, numbers, column.unit)
