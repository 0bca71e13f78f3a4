"""Typed parsing of rows: every column's type is given, none is inferred, and no text stands for a missing value."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
from pyarrow import csv

if TYPE_CHECKING:
    from collections.abc import Mapping

PARSER_BLOCK_BYTES = 1 << 24


def parse(data: bytes | memoryview, delimiter: str, decimal: str, width: int, types: Mapping[int, Any]) -> Any:  # noqa: ANN401
    """Parse some columns of rows.

    Parameters
    ----------
    data : bytes
        Lines without a header, each ending in a newline.
    delimiter, decimal : str
    width : int
        Number of columns.
    types : mapping of int to pyarrow type
        Index of each column that is wanted, to its type.

    Returns
    -------
    pyarrow.Table
        Columns named by their index.

    Raises
    ------
    pyarrow.ArrowInvalid
        If a row has another number of fields, or a cell is not of its type.
    """
    quoted = b'"' in data if isinstance(data, bytes) else False
    return csv.read_csv(
        pa.py_buffer(data),
        read_options=csv.ReadOptions(
            use_threads=False,
            block_size=min(len(data) + 1, PARSER_BLOCK_BYTES),
            column_names=[str(i) for i in range(width)],
        ),
        parse_options=csv.ParseOptions(
            delimiter=delimiter, quote_char='"' if quoted else False, newlines_in_values=False
        ),
        convert_options=csv.ConvertOptions(
            column_types={str(i): t for i, t in types.items()},
            include_columns=[str(i) for i in types],
            null_values=[],
            check_utf8=False,
            decimal_point=decimal,
        ),
    )


def all_finite(table: Any) -> bool:  # noqa: ANN401  (pyarrow has no types)
    """Return whether a table of doubles holds finite numbers only."""
    return all(bool(np.isfinite(chunk.to_numpy()).all()) for column in table.columns for chunk in column.chunks)
