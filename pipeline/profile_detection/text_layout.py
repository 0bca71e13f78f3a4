"""The layout of an unknown text log: what separates its fields, where its data begin, the names of its columns.

It is used to propose a profile only and is never applied unasked.
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

LINES_TRIED = 400  # with each separator
MOST_ROWS = 200_000  # read as numbers; bounds the cost
FEWEST_ROWS = FEWEST_COLUMNS = 3
SEPARATORS = (",", ";", "\t", "|", " ")
NUMBER = {
    ".": re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?"),
    ",": re.compile(r"[+-]?(\d+,?\d*|,\d+)([eE][+-]?\d+)?"),
}
STATED_NUMBER = re.compile(r"[\s,;:=]+(\d+(\.\d+)?)\s*(hz)?\s*$", re.IGNORECASE)
RATE_KEY = re.compile(r"(fs|odr|(sampl\w*[ _]?)?(rate|freq\w*))\b", re.IGNORECASE)


@dataclass(frozen=True)
class TextLayout:
    """The layout of a text log.

    ``delimiter``: a blank stands for any run of blanks and tabs. ``skip_lines``: before the header, or before the data.
    ``comment``: start of the lines before the data. ``numbers``: the columns that hold finite numbers only.
    ``rate_hz``: sampling rate that the line ``rate_line`` before the data states. ``odd_rows``: with another number of
    fields.
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


def find_layout(data: bytes, path: str) -> TextLayout:
    """Return the layout of a text; refuse one of which no part is a table of numbers."""
    lines = data.decode("utf-8", "replace").splitlines()
    tried = [_try(lines[:LINES_TRIED], separator, decimal) for separator in SEPARATORS for decimal in NUMBER]
    width, start, separator, decimal = max(tried, key=lambda t: (t[0], -t[1]))
    names, skip, comment = _names(lines, start, separator)
    kept = lines[start : start + MOST_ROWS]
    rows = [cells for cells in _cells(kept, separator) if len(cells) == len(names)]
    if width < FEWEST_COLUMNS or len(rows) < FEWEST_ROWS:
        first = " / ".join(lines[:3])[:150]
        raise IngestError(f"no table of numbers was found in it; it starts with {first!r}", path, code="no_table")
    rate_hz, rate_line = _stated_rate(lines[:start])
    return TextLayout(
        path, separator, decimal, skip, names != _numbered(len(names)), comment, names, _numbers(rows, decimal),
        rate_hz, rate_line, len(kept) - len(rows),
    )  # fmt: skip


def _cells(lines: Sequence[str], separator: str) -> list[list[str]]:
    """Return the fields of lines."""
    if separator == " ":
        return [line.split() for line in lines]
    return list(csv.reader(lines, delimiter=separator, skipinitialspace=True))


def _numbered(count: int) -> list[str]:
    return [f"column {i}" for i in range(count)]


def _try(lines: list[str], separator: str, decimal: str) -> tuple[int, int, str, str]:
    """Return how many columns of numbers a separator and decimal point give, and the line where they begin."""
    if not lines or (decimal == "," and (separator == "," or not any("," in line for line in lines))):
        return 0, 0, separator, decimal
    rows = _cells(lines, separator)
    counts = [sum(bool(NUMBER[decimal].fullmatch(c.strip())) for c in cells) for cells in rows]
    widths = [len(cells) for cells in rows]
    width, usual = (int(np.median(x[len(x) // 2 :])) for x in (counts, widths))
    start = next((i for i, (c, w) in enumerate(zip(counts, widths, strict=True)) if c >= width and w == usual), 0)
    return width, start, separator, decimal


def _names(lines: list[str], start: int, separator: str) -> tuple[list[str], int, str | None]:
    """Return the names of the columns, the number of lines before them, and the start of comments."""
    width = len(_cells([lines[start]], separator)[0]) if lines else 0
    comment = "#" if start and lines[start - 1].lstrip().startswith("#") else None
    above = _cells([lines[start - 1].lstrip().lstrip("#")], separator) if start else []
    if above and len(above[0]) == width and not any(NUMBER["."].fullmatch(c.strip()) for c in above[0]):
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
    """Return the sampling rate that a line before the data states, and that line."""
    for line in lines:
        found = STATED_NUMBER.search(line)
        if found and RATE_KEY.search(line) and float(found.group(1)) > 0:
            return float(found.group(1)), line.strip()
    return None, ""
