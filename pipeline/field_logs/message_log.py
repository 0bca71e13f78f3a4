"""A log of another program (ROS bag, ULog, DataFlash, HDF5, MATLAB) as canonical CSV with calibrated readings.

These formats are read as at ingest, with its checks, and are not written: the output has the columns of the canonical
CSV, ``time_s, accel_x_g .. gyro_z_dps, temperature_degc``, in the body's axes. The log is held in memory.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
from pyarrow import csv

from pipeline.field_logs.compensate import Block
from pipeline.field_logs.log_checks import DECIMALS
from pipeline.io.arrow import times_as_decimals, to_arrow
from pipeline.io.ingest_settings import mcap_format
from pipeline.io.mcap import read_log
from pipeline.io.units import CANONICAL, SINCE_1970_NS, TRIADS
from pipeline.records import SENSORS

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from pipeline.field_logs.compensate import LogProfile, Readings, Result
    from pipeline.field_logs.log_checks import LogChecks
    from pipeline.field_logs.output import Output

BLOCK_ROWS = 20_000  # as a block of a text log


class MessageLog:
    """A log of messages and the text that is made of it; ``smoothing`` of the temperature, s."""

    def __init__(self, source: Path, out: Output, profile: LogProfile, smoothing: float) -> None:
        self.source, self.out, self.profile, self.smoothing = source, out, profile, smoothing
        self.notes: list[str] = []

    def blocks(self, _needs: set[str], _checks: LogChecks) -> Iterator[Block]:
        """Yield the samples, and write the header."""
        table = read_log(self.source, mcap_format(self.profile.ingest))
        self.notes = [f"{n.code}: {n.detail}" for n in table.notes]
        readings = {
            s: self.profile.to_body(s, np.column_stack([table.values[c] for c in triad]))
            for s, triad in TRIADS.items()
            if triad[0] in table.values
        }
        names = [c for s in readings for c in TRIADS[s]] + ["temperature"] * ("temperature" in table.values)
        self.out.write((",".join(CANONICAL[c] for c in ("time", *names)) + "\n").encode())
        origin = int(table.time_ns[0]) if table.time_ns[0] > SINCE_1970_NS else 0
        for start in range(0, len(table.time_ns), BLOCK_ROWS):
            rows = slice(start, start + BLOCK_ROWS)
            signals = {s: v[rows] for s, v in readings.items()}
            signals["time"] = (table.time_ns[rows] - origin) / 1e9
            if "temperature" in table.values:
                signals["temperature"] = table.values["temperature"][rows]
            yield Block(signals, str(self.source), f" (row {start + 1})", 0, table.time_ns[rows])

    def write(self, block: Block, readings: Readings, _changed: set[str]) -> None:
        """Write the rows of a block with calibrated readings."""
        columns = [v for s in SENSORS if s in readings for v in readings[s].T]
        columns += [block.signals["temperature"]] if "temperature" in block.signals else []
        arrays = [times_as_decimals(block.content), *(to_arrow(np.round(v, DECIMALS) + 0.0) for v in columns)]
        rows = pa.Table.from_arrays(arrays, [str(i) for i in range(len(arrays))])
        sink = pa.BufferOutputStream()
        csv.write_csv(rows, sink, csv.WriteOptions(include_header=False))
        self.out.write(memoryview(sink.getvalue()))

    def finish(self, result: Result) -> None:
        """Add the notes of the reader."""
        result.notes += self.notes
