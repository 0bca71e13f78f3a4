"""Write a pandas DataFrame as canonical CSV, so that the reader of text logs checks it like a file."""

from __future__ import annotations

import csv
import io
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
from pyarrow import csv as arrow_csv

from pipeline.errors import IngestError
from pipeline.io.units import CANONICAL

if TYPE_CHECKING:
    import pandas as pd

    from pipeline.records import Values

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
