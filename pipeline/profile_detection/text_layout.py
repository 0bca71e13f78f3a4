"""The shape of an unknown text log: what separates its fields, where its data begin, what its columns are called.

Used to propose a profile only: nothing that is guessed here is ever applied unasked.
"""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import IngestError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

LOOKED_AT = 400  # lines that tell the shape
MOST_ROWS = 200_000
FEWEST_ROWS = 3
FEWEST_COLUMNS = 3
SEPARATORS = (",", ";", "\t", "|", " ")
POINT = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
COMMA = re.compile(r"[+-]?(\d+,?\d*|,\d+)([eE][+-]?\d+)?")
STATED_NUMBER = re.compile(r"[\s,;:=]+(\d+(\.\d+)?)\s*(hz)?\s*$", re.IGNORECASE)
RATE_KEY = re.compile(r"(fs|odr|(sampl\w*[ _]?)?(rate|freq\w*))\b", re.IGNORECASE)


@dataclass(frozen=True)
class Shape:
    """The shape of a text log.

    Attributes
    ----------
    path : str
    delimiter, decimal : str
        A blank stands for any run of blanks and tabs.
    skip_lines : int
        Lines before the header, or before the data.
    header : bool
        Whether a line of names stands before the data.
    comment : str or None
        What lines before the data start with.
    names : list of str
        Of all columns.
    numbers : dict of int to (n,) array
        The columns that hold numbers, by index.
    rate_hz : float or None
        Sampling rate, where a line before the data states one.
    rate_line : str
        That line.
    odd_rows : int
        Rows of another shape, left out.
    """

    path: str
    delimiter: str
    decimal: str
    skip_lines: int
    header: bool
    comment: str | None
    names: list[str]
    numbers: dict[int, NDArray[np.float64]]
    rate_hz: float | None
    rate_line: str
    odd_rows: int

    def key(self, index: int) -> str | int:
        """Return what a profile calls a column: its name, or its index where there is no header."""
        return self.names[index] if self.header else index


def find_shape(data: bytes, path: str) -> Shape:
    """Look at a text log as people do: the most columns of numbers tell how it is cut.

    Raises
    ------
    IngestError
        If no part of it looks like a table of numbers.
    """
    lines = data.decode("utf-8", "replace").splitlines()
    tried = [_cut(lines[:LOOKED_AT], separator, decimal) for separator in SEPARATORS for decimal in ".,"]
    width, start, separator, decimal = max(tried, key=lambda t: (t[0], -t[1]))
    names, skip, comment = _names(lines, start, separator)
    kept = lines[start : start + MOST_ROWS]
    rows = [cells for cells in rows_of(kept, separator) if len(cells) == len(names)]
    if width < FEWEST_COLUMNS or len(rows) < FEWEST_ROWS:
        first = " / ".join(lines[:3])[:150]
        raise IngestError(f"no table of numbers was found in it; it starts with {first!r}", path, fault="no_table")
    rate_hz, rate_line = _stated_rate(lines[:start])
    return Shape(
        path, separator, decimal, skip, names != _numbered(len(names)), comment, names, _numbers(rows, decimal),
        rate_hz, rate_line, len(kept) - len(rows),
    )  # fmt: skip


def rows_of(lines: Sequence[str], separator: str) -> list[list[str]]:
    """Return the fields of lines."""
    if separator == " ":
        return [line.split() for line in lines]
    return list(csv.reader(lines, delimiter=separator, skipinitialspace=True))


def _numbered(count: int) -> list[str]:
    return [f"column {i}" for i in range(count)]


def _cut(lines: list[str], separator: str, decimal: str) -> tuple[int, int, str, str]:
    """Return how many columns of numbers a cut gives, and where they begin."""
    number = POINT if decimal == "." else COMMA
    if decimal == "," and (separator == "," or not any("," in line for line in lines)):
        return 0, 0, separator, decimal
    rows = rows_of(lines, separator)
    counts = [sum(bool(number.fullmatch(c.strip())) for c in cells) for cells in rows]
    widths = [len(cells) for cells in rows]
    if not rows:
        return 0, 0, separator, decimal
    width, usual = (int(np.median(x[len(x) // 2 :])) for x in (counts, widths))
    start = next((i for i, (c, w) in enumerate(zip(counts, widths, strict=True)) if c >= width and w == usual), 0)
    return width, start, separator, decimal


def _names(lines: list[str], start: int, separator: str) -> tuple[list[str], int, str | None]:
    """Return the names of the columns, the lines before them, and what comments start with."""
    width = len(rows_of([lines[start]], separator)[0])
    comment = "#" if start and lines[start - 1].lstrip().startswith("#") else None
    above = rows_of([lines[start - 1].lstrip().lstrip("#")], separator) if start else []
    if above and len(above[0]) == width and not any(POINT.fullmatch(c.strip()) for c in above[0]):
        return [c.strip() for c in above[0]], start - 1, comment
    return _numbered(width), start, comment


def _numbers(rows: list[list[str]], decimal: str) -> dict[int, NDArray[np.float64]]:
    out = {}
    for index, cells in enumerate(zip(*rows, strict=True)):
        texts = [c.replace(",", ".") for c in cells] if decimal == "," else cells
        try:
            column = np.array(texts, np.float64)
        except ValueError:
            continue
        if np.isfinite(column).all():
            out[index] = column
    return out


def _stated_rate(lines: list[str]) -> tuple[float | None, str]:
    """Return the sampling rate that a line before the data states."""
    for line in lines:
        found = STATED_NUMBER.search(line)
        if found and RATE_KEY.search(line) and float(found.group(1)) > 0:
            return float(found.group(1)), line.strip()
    return None, ""
