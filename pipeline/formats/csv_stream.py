"""A text log as a stream of blocks of text cells: for programs that change some columns and keep the others as written.

Every cell is text until a column is asked for as numbers, so that nothing is lost in what is not changed.
"""

from __future__ import annotations

import csv
from contextlib import contextmanager
from typing import IO, TYPE_CHECKING, TextIO

import numpy as np
import pyarrow as pa
from pyarrow import compute as pc
from pyarrow import csv as arrow_csv

from pipeline.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

LONGEST_HEADER = 1 << 20
DECIMALS = 12  # far below any sensor's resolution, above the rounding of a double


def read_header(source: Path) -> tuple[str, list[str]]:
    """Return the first line and the column names in it."""
    with source.open("rb") as raw:
        line = raw.readline(LONGEST_HEADER)
    try:
        text = line.decode("utf-8-sig").rstrip("\r\n")
    except UnicodeDecodeError as error:
        raise InputError(f"the header is not UTF-8: {error.reason}", f"{source}:1") from None
    names = [name.strip() for name in next(csv.reader([text]), [])]
    if not any(names):
        raise InputError("the file is empty; expected a header with the names of the columns", f"{source}:1")
    return text, names


def text_blocks(raw: IO[bytes], width: int, block_bytes: int, source: Path) -> Iterator[pa.RecordBatch]:
    """Yield the rows as text, some at a time."""
    columns = [str(i) for i in range(width)]
    read = arrow_csv.ReadOptions(use_threads=False, block_size=block_bytes, skip_rows=1, column_names=columns)
    convert = arrow_csv.ConvertOptions(
        column_types=dict.fromkeys(columns, pa.string()), strings_can_be_null=False, check_utf8=True
    )
    try:
        yield from arrow_csv.open_csv(raw, read_options=read, convert_options=convert)
    except pa.ArrowInvalid as error:
        if "Empty CSV" in str(error):
            return
        raise InputError(f"the log is no table of {width} columns: {error}", str(source)) from None


def numbers(
    columns: list[pa.Array], where: list[int], names: list[str], rows: int, source: Path
) -> NDArray[np.float64]:
    """Return columns as numbers, NaN where a cell is empty: (n, k) array.

    Parameters
    ----------
    columns : list of Array of text
    where : list of int
        Places of the columns asked for.
    names : list of str
        Of all columns, for messages.
    rows : int
        Rows before this block, likewise.
    source : Path

    Raises
    ------
    InputError
        Naming the line of a cell that is no number.
    """
    out = np.empty((len(columns[0]), len(where)))
    for k, i in enumerate(where):
        text = pc.utf8_trim_whitespace(columns[i])
        filled = pc.if_else(pc.equal(text, ""), pa.scalar(None, pa.string()), text)
        try:
            out[:, k] = pc.cast(filled, pa.float64()).to_numpy(zero_copy_only=False)
        except pa.ArrowInvalid:
            row, cell = next((r, c) for r, c in enumerate(filled.to_pylist()) if c is not None and not _is_number(c))
            line = rows + row + 2
            raise InputError(f"{names[i]} is {cell!r}; expected a number", f"{source}:{line}") from None
    return out


def _is_number(cell: str) -> bool:
    try:
        pc.cast(pa.scalar(cell), pa.float64())
    except pa.ArrowInvalid:
        return False
    return True


def digits(values: NDArray[np.float64]) -> pa.Array:
    """Return numbers as text, rounded to 1e-12."""
    return pc.cast(pa.array(np.round(values, DECIMALS) + 0.0), pa.string())


def lines_of(columns: list[pa.Array]) -> str:
    """Return the rows as lines of a CSV."""
    cells = [_quoted(column) for column in columns]
    lines = pc.binary_join_element_wise(*cells, ",") if len(cells) > 1 else cells[0]
    return "".join(f"{line}\n" for line in lines.to_pylist())


def _quoted(column: pa.Array) -> pa.Array:
    """Quote the cells that would not read back as one cell."""
    special = pc.match_substring_regex(column, '[",\r\n]')
    if not pc.any(special).as_py():
        return column
    doubled = pc.replace_substring(column, '"', '""')
    return pc.if_else(special, pc.binary_join_element_wise('"', doubled, '"', ""), column)


@contextmanager
def replacing(target: Path) -> Iterator[TextIO]:
    """Open a file that takes its name only when it is complete."""
    if target.exists() and not target.is_file():  # a pipe or device
        with target.open("w", encoding="utf-8", newline="") as out:
            yield out
        return
    part = target.with_name(f".{target.name}.part")
    try:
        with part.open("w", encoding="utf-8", newline="") as out:
            yield out
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)
