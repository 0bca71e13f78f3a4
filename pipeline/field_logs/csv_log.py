"""Compensation of a text log, block by block.

The columns that the profile names as readings are replaced by calibrated ones in g and deg/s, under the canonical names
``accel_x_g`` .. ``gyro_z_dps``; every other cell, and what stands before the data, is written as it stands.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
from pyarrow import compute as pc

from pipeline.errors import InputError, PipelineError
from pipeline.field_logs.output import replacing, require_apart
from pipeline.field_logs.profile import EPOCH_AFTER_S, LogProfile
from pipeline.io.csv_cells import digits, lines_of, read_head, text_blocks
from pipeline.io.ingest_settings import csv_formats
from pipeline.io.units import COUNTS, TRIADS, UNITS, decode, to_house_unit
from pipeline.model.compensation import SMOOTHING_S
from pipeline.records import SENSORS, Encoding

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

    from pipeline.field_logs.doubts import Doubts
    from pipeline.io.csv_cells import TextBlock
    from pipeline.io.ingest_settings import Column
    from pipeline.model.compensation import Compensation

SIGNALS = {**TRIADS, "temperature": ("temperature",), "time": ("time",)}
CANONICAL = {c: f"{c}_{'g' if s == 'accelerometer' else 'dps'}" for s in SENSORS for c in TRIADS[s]}
BLOCK_BYTES = 1 << 21
NANOSECONDS = 1e9


def compensate_csv(
    compensation: Compensation,
    source: Path,
    target: Path,
    profile: LogProfile | None = None,
    *,
    smoothing: float = SMOOTHING_S,
    block_bytes: int = BLOCK_BYTES,
    progress: Callable[[int, int], None] | None = None,
    doubts: Doubts | None = None,
) -> tuple[int, list[str]]:
    """Compensate a text log.

    Parameters
    ----------
    compensation : Compensation
    source, target : Path
    profile : LogProfile, optional
        How the log is laid out; the canonical CSV by default.
    smoothing : float, s
        As of ``Compensation.apply``.
    block_bytes : int
        Size of the blocks that are read.
    progress : callable, optional
        Called with the rows done and the bytes read.
    doubts : Doubts, optional
        Takes in what speaks against compensating this log.

    Returns
    -------
    rows : int
    sensors : list of str
        Those whose columns the log holds.

    Raises
    ------
    InputError
        If the log cannot be read as it is, or the output would overwrite it.
    """
    require_apart(source, target)
    log = _Log(source, profile or LogProfile())
    stream = compensation.stream(smoothing)
    rows = 0
    with source.open("rb") as raw:
        head = read_head(raw, log.settings, source)
        log.find(head.names, f"{source}:{len(head.lines) + 1}")
        with replacing(target) as out:
            out.write(head.text(log.new_names(head.names)).encode())
            for block in text_blocks(raw, head, log.settings, block_bytes, source):
                signals = log.signals(block, rows)
                try:
                    found = stream.apply(**signals)
                except PipelineError as error:
                    raise type(error)(error.message, f"{source}:{block.line_of(0)}") from None
                if doubts is not None:
                    if rows == 0:
                        doubts.look_at([block.columns[i] for i in log.readings], log.settings.decimal)
                    after = {s: getattr(found, s) for s in SENSORS if s in signals}
                    doubts.take({s: signals[s] for s in after}, after, signals.get("time"), rows)
                for sensor in (s for s in SENSORS if s in signals):
                    log.replace(block.columns, sensor, getattr(found, sensor), signals[sensor])
                out.write(lines_of(block.columns, head.delimiter, quoted=block.quoted))
                rows += block.rows
                if progress is not None:
                    progress(rows, raw.tell())
    return rows, [sensor for sensor in SENSORS if sensor in log.places]


class _Log:
    """Where the signals of a text log stand, and how its cells become numbers."""

    def __init__(self, source: Path, profile: LogProfile) -> None:
        formats = csv_formats(profile.ingest)
        if len(formats) > 1:
            raise InputError(
                "the profile joins several files to one recording, which apply does not; write them into one file, "
                "or choose another profile by --ingest",
                str(source),
            )
        self.source, self.profile, self.settings = source, profile, formats[0]
        self.columns = {c.channel: c for c in self.settings.columns}
        self.places: dict[str, list[int]] = {}
        self.names: list[str] = []
        self.origin = 0.0

    def find(self, names: list[str], where: str) -> None:
        """Find the columns of each signal."""
        self.names = names
        for signal, channels in SIGNALS.items():
            wanted = [self.columns[c] for c in channels if c in self.columns]
            present = [c for c in wanted if _index(c, names) is not None]
            twice = [c.column for c in present if names.count(str(c.column)) > 1]
            if twice:
                raise InputError(f"the header names {twice[0]} more than once", where)
            if present and len(present) < len(wanted):
                missing = ", ".join(str(c.column) for c in wanted if c not in present)
                raise InputError(
                    f"the header names {', '.join(str(c.column) for c in present)}, but not {missing}", where
                )
            if present:
                self.places[signal] = [i for c in present if (i := _index(c, names)) is not None]
        if not any(sensor in self.places for sensor in SENSORS):
            told = "--ingest names the profile that describes this log"
            if set(CANONICAL.values()) & set(names):
                told = f"these are the columns that this command writes: the log is compensated already, else {told}"
            expected = ", ".join(str(self.columns[c].column) for s in SENSORS for c in TRIADS[s] if c in self.columns)
            raise InputError(f"no column of a sensor; expected {expected}, got {', '.join(names)[:200]}; {told}", where)

    @property
    def readings(self) -> list[int]:
        """Columns of the readings."""
        return [i for sensor in SENSORS for i in self.places.get(sensor, [])]

    def new_names(self, names: list[str]) -> list[str]:
        """Return the names of the columns of the output."""
        new = list(names)
        for sensor in (s for s in SENSORS if s in self.places):
            for channel, i in zip(TRIADS[sensor], self.places[sensor], strict=True):
                new[i] = CANONICAL[channel]
        return new

    def signals(self, block: TextBlock, rows: int) -> dict[str, Any]:
        """Return the signals of a block in the units of the house, the readings in body axes."""
        out: dict[str, Any] = {}
        for signal, where in self.places.items():
            numbers = block.numbers(where, self.settings.decimal, self.names, self.source)
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

    def replace(
        self, columns: list[pa.Array], sensor: str, after: NDArray[np.float64], before: NDArray[np.float64]
    ) -> None:
        """Put calibrated numbers in the place of the raw ones; what is missing stays as it was written."""
        for k, i in enumerate(self.places[sensor]):
            text = digits(after[:, k], self.settings.decimal)
            missing = ~np.isfinite(after[:, k])
            if missing.any():
                written = pa.array(~np.isfinite(before[:, k]))
                text = pc.if_else(pa.array(missing), pc.if_else(written, columns[i], ""), text)
            columns[i] = text


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
