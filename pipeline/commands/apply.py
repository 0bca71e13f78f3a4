"""Compensate a log with a unit's calibration.

    python -m pipeline apply --calibration results/C/calibrations/U1.json LOG.csv -o OUT.csv

The log is a canonical CSV (``time_s, accel_x_g, accel_y_g, accel_z_g, gyro_x_dps, gyro_y_dps, gyro_z_dps,
temperature_degc`` in any order, other columns beside them). The columns of the sensors are replaced by calibrated ones
of the same name and unit; every other cell is written as it stands. The log is read in blocks, so that its length is
bounded by the disk alone, and what a block gives does not depend on where it was cut.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
from pyarrow import compute as pc

from pipeline.errors import ConfigurationError, InputError, MissingInputError, PipelineError
from pipeline.formats.csv_stream import digits, lines_of, numbers, read_header, replacing, text_blocks
from pipeline.model.compensation import SMOOTHING_S, load
from pipeline.records import SENSORS

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from pipeline.model.compensation import Compensation

COLUMNS = {
    "accelerometer": ("accel_x_g", "accel_y_g", "accel_z_g"),
    "gyroscope": ("gyro_x_dps", "gyro_y_dps", "gyro_z_dps"),
    "temperature": ("temperature_degc",),
    "time": ("time_s",),
}
BLOCK_BYTES = 1 << 21


def main(argv: Sequence[str]) -> int:
    """Run ``python -m pipeline apply``."""
    parser = argparse.ArgumentParser(prog="python -m pipeline apply", description="Compensate a log (CSV) in a stream.")
    parser.add_argument("log", type=Path, metavar="LOG.csv", help="canonical CSV: accel_x_g .. gyro_z_dps, time_s ...")
    parser.add_argument("--calibration", type=Path, required=True, metavar="C.json", help="calibrations/<unit>.json")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="file to write")
    parser.add_argument(
        "--temperature-smoothing", type=float, default=SMOOTHING_S, metavar="S", dest="smoothing",
        help="memory of the causal smoothing of the temperature, s; 0: none (default: %(default)g)",
    )  # fmt: skip
    parser.add_argument(
        "--python-effect", action="append", default=[], metavar="FILE", dest="python_effects",
        help="Python file of an effect of yours that the calibration was made with (it is run); may be repeated",
    )  # fmt: skip
    arguments = parser.parse_args(argv)
    if arguments.smoothing < 0:
        raise ConfigurationError(f"--temperature-smoothing is {arguments.smoothing:g} s; it cannot be negative")
    compensation = load(arguments.calibration, arguments.python_effects)
    progress = _Progress(arguments.log)
    rows, sensors = compensate_csv(
        compensation, arguments.log, arguments.output, smoothing=arguments.smoothing, progress=progress
    )
    for sensor in sensors:
        if compensation.calibration(sensor) is None:
            print(f"note: {arguments.calibration} holds no {sensor}; its columns are unchanged", file=sys.stderr)
    print(f"{rows} rows compensated with unit {compensation.unit}: {arguments.output}", file=sys.stderr)
    return 0


def compensate_csv(
    compensation: Compensation,
    source: Path,
    target: Path,
    *,
    smoothing: float = SMOOTHING_S,
    block_bytes: int = BLOCK_BYTES,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[int, list[str]]:
    """Compensate a canonical CSV.

    Parameters
    ----------
    compensation : Compensation
    source, target : Path
    smoothing : float, s
        As of ``Compensation.apply``.
    block_bytes : int
        Size of the blocks that are read, at least a row.
    progress : callable, optional
        Called with the rows done and the bytes read.

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
    _require_apart(source, target)
    header, names = read_header(source)
    places = _places(names, source)
    stream = compensation.stream(smoothing)
    rows = 0
    with replacing(target) as out, source.open("rb") as raw:
        out.write(header + "\n")
        for block in text_blocks(raw, len(names), block_bytes, source):
            columns = [block.column(i) for i in range(block.num_columns)]
            signals = {name: numbers(columns, where, names, rows, source) for name, where in places.items()}
            given: dict[str, Any] = {n: v if n in SENSORS else v[:, 0] for n, v in signals.items()}
            try:
                found = stream.apply(**given)
            except PipelineError as error:
                raise type(error)(error.message, f"{source}:{rows + 2}") from None
            for sensor in SENSORS:
                if sensor in places:
                    _replace(columns, places[sensor], getattr(found, sensor), given[sensor])
            out.write(lines_of(columns))
            rows += block.num_rows
            if progress is not None:
                progress(rows, raw.tell())
    return rows, [sensor for sensor in SENSORS if sensor in places]


def _require_apart(source: Path, target: Path) -> None:
    if source.suffix.lower() == ".mcap":
        raise InputError(
            "MCAP logs cannot be compensated; supported: canonical CSV (.csv). Convert the log", str(source)
        )
    if not source.is_file():
        raise MissingInputError("there is no such log", str(source))
    if target.exists() and target.samefile(source):
        raise InputError("the output would overwrite the log; choose another file for -o", str(target))
    if not target.parent.is_dir():
        raise InputError("the directory of the output does not exist; make it first", str(target))


def _places(names: list[str], source: Path) -> dict[str, list[int]]:
    """Return where the columns of each signal stand."""
    places = {}
    for signal, wanted in COLUMNS.items():
        present = [name for name in wanted if name in names]
        twice = [name for name in present if names.count(name) > 1]
        if twice:
            raise InputError(f"the header names {twice[0]} more than once", f"{source}:1")
        if len(present) == len(wanted):
            places[signal] = [names.index(name) for name in wanted]
        elif present:
            missing = ", ".join(name for name in wanted if name not in names)
            raise InputError(f"the header names {', '.join(present)}, but not {missing}", f"{source}:1")
    if not any(sensor in places for sensor in SENSORS):
        expected = ", ".join(COLUMNS["accelerometer"] + COLUMNS["gyroscope"])
        raise InputError(f"no column of a sensor; expected {expected}, got {', '.join(names)[:200]}", f"{source}:1")
    return places


def _replace(
    columns: list[pa.Array], where: list[int], after: NDArray[np.float64], before: NDArray[np.float64]
) -> None:
    """Put calibrated numbers in the place of the raw ones; what is missing stays as it was written."""
    for k, i in enumerate(where):
        text = digits(after[:, k])
        missing = pa.array(~np.isfinite(after[:, k]))
        written = pa.array(~np.isfinite(before[:, k]))
        columns[i] = pc.if_else(missing, pc.if_else(written, columns[i], ""), text)


class _Progress:
    """A line on a terminal that says how far the log is read; silent elsewhere."""

    def __init__(self, source: Path) -> None:
        self.size = source.stat().st_size if source.is_file() else 0
        self.said = time.monotonic()

    def __call__(self, rows: int, read: int) -> None:
        if sys.stderr.isatty() and time.monotonic() - self.said > 0.5:
            self.said = time.monotonic()
            print(f"\r{100 * read // max(self.size, 1)} %, {rows} rows", end="\r", file=sys.stderr, flush=True)
