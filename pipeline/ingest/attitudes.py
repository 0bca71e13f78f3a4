"""Read a file of attitudes: one row an attitude, or a block of rows with equal ``label``; times do not count.

The rows get times of their own, so that blocks are ``BETWEEN_ATTITUDES_S`` apart. A row that is an attitude by itself
is a mean over an unknown time. Its white noise is that of the sensor file over ``AVERAGED_S``; the scatter of the
attitudes about the fit adds to it.
"""

from __future__ import annotations

import csv
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from imu_logs.profile import TIME
from imu_logs.text_read import read_csv
from pipeline.core.errors import IngestError
from pipeline.core.records import BETWEEN_ATTITUDES_S, NOISE_OF_ROWS, SENSORS

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from imu_logs.log import Log
    from imu_logs.profile import Checks, CsvFormat
    from pipeline.core.records import Integers, Mask
    from pipeline.core.settings import Sensor

LABEL = "label"
AVERAGED_S = 1.0  # shorter than anyone averages by hand: the noise is then rather too large
ROW_S = 1.0  # between the rows of a block


def read_attitudes(path: Path, layouts: Sequence[CsvFormat], sensor: Sensor, checks: Checks) -> Log:
    """Read the channels of a file of attitudes; raises ``IngestError`` for a log that is no text."""
    if path.suffix.lower() != ".csv" or len(layouts) != 1:
        raise IngestError("attitudes are read from one .csv; export them as text", str(path), code="foreign")
    columns = tuple(c for c in layouts[0].columns if c.channel != TIME)
    table = read_csv([path], [layouts[0].model_copy(update={"columns": columns, "rate_hz": 1.0 / ROW_S})], checks)
    assert table.lines is not None  # noqa: S101  (of text)
    starts = _starts(path, layouts[0], table.lines)
    number = np.cumsum(starts) - 1
    time = np.arange(len(starts)) * ROW_S + number * BETWEEN_ATTITUDES_S
    notes = tuple(note for note in table.notes if note.code != "N-SYNTHTIME")
    table = replace(table, time_ns=np.rint(time * 1e9).astype(np.int64), notes=notes)
    if not starts.all():
        return table
    noise = {name: sensor.of(name).noise_density * float(np.sqrt(0.5 / AVERAGED_S)) for name in SENSORS}
    return replace(table, source={**table.source, NOISE_OF_ROWS: noise})


def _starts(path: Path, layout: CsvFormat, lines: Integers) -> Mask:
    """Return at which rows an attitude begins: (n,) array of bool; every row without a column of labels."""
    with path.open(encoding="utf-8-sig", newline="") as stream:
        delimiter = layout.delimiter if len(layout.delimiter) == 1 else ","
        cells = list(csv.reader(stream, delimiter=delimiter))
    names = next(([cell.strip() for cell in row] for row in cells if LABEL in [cell.strip() for cell in row]), None)
    if names is None:
        return np.ones(len(lines), bool)
    labels = [cells[line - 1][names.index(LABEL)].strip() for line in lines.tolist()]
    return np.array([True, *(one != two for one, two in pairwise(labels))])
