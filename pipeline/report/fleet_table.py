"""``parameters.parquet``: a row a unit with everything of ``summary.csv`` and every fitted parameter, for own analyses.

Columns of a parameter: ``<name>`` and ``<name>_expanded_uncertainty``; the unit stands in the column's metadata.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.parquet as pq

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    Parameters = Mapping[str, tuple[float, float | None, str]]


def write_parameters(path: Path, rows: Sequence[Mapping[str, Any]], found: Mapping[str, Parameters]) -> None:
    """Write the table under a temporary name, then rename it.

    Parameters
    ----------
    path : Path
    rows : sequence of mapping
        One a unit, as of ``summary.summary_row``.
    found : mapping
        Unit to its parameters, as of ``fleet_statistics.parameters``.
    """
    columns = list(dict.fromkeys(key for row in rows for key in row))
    arrays = [pa.array([row.get(c) for row in rows], _kind(rows, c)) for c in columns]
    fields = [pa.field(c, a.type) for c, a in zip(columns, arrays, strict=True)]
    units = {name: p[2] for each in found.values() for name, p in each.items()}
    for name, unit in units.items():
        for i, suffix in ((0, ""), (1, "_expanded_uncertainty")):
            values = [found.get(row["unit"], {}).get(name, (None, None))[i] for row in rows]
            arrays.append(pa.array(values, pa.float64()))
            fields.append(pa.field(name + suffix, pa.float64(), metadata={"unit": unit}))
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    pq.write_table(pa.Table.from_arrays(arrays, schema=pa.schema(fields)), temporary, compression="zstd")
    temporary.replace(path)


def _kind(rows: Sequence[Mapping[str, Any]], column: str) -> pa.DataType:
    values = [row.get(column) for row in rows if row.get(column) is not None]
    if values and all(isinstance(v, bool) for v in values):
        return pa.bool_()
    return pa.float64() if values and all(isinstance(v, float) for v in values) else pa.string()
