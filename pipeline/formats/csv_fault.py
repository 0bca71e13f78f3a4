"""What is wrong with a text log that did not parse: line, column and value.

The fast parser says that a cell is bad but not where. This slow walk over the lines runs on refused files only.
"""

from __future__ import annotations

import csv
import math
import re
from typing import TYPE_CHECKING

from pipeline.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pipeline.formats.csv_layout import Layout

NUMBER = re.compile(r"\s*[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?\s*")


def explain(layout: Layout, reason: str) -> InputError:
    """Return the error that names the first bad line of a log, and how many there are.

    Parameters
    ----------
    layout : Layout
    reason : str
        What the parser said, used if the walk finds nothing.
    """
    faults = list(_faults(layout))
    if not faults:
        return InputError(f"cannot be read as numbers: {reason}", layout.path)
    line, message = faults[0]
    more = f" ({len(faults) - 1} more such lines, up to line {faults[-1][0]})" if len(faults) > 1 else ""
    return InputError(message + more, f"{layout.path}:{line}")


def _faults(layout: Layout) -> Iterator[tuple[int, str]]:
    width = len(layout.names)
    for offset, raw in enumerate(layout.body.split(b"\n")):
        if not raw:
            continue
        text = raw.decode("utf-8", "replace")
        cells = next(csv.reader([text], delimiter=layout.delimiter), [])
        message = None
        if len(cells) != width:
            message = f"the line has {len(cells)} fields where {width} are expected: {text[:120]!r}"
        else:
            message = next((m for c, i in layout.columns if (m := _cell(layout.names[i], c.channel, cells[i]))), None)
        if message:
            yield layout.first_line + offset, message


def _cell(name: str, channel: str, cell: str) -> str | None:
    """Return what is wrong with a cell, None if it is a finite number."""
    column = f"column {name}" if not name.startswith("column ") else name
    text = cell.strip()
    if not text:
        return f"{column} ({channel}) is empty; a number is expected"
    if NUMBER.fullmatch(text):
        return None if math.isfinite(float(text)) else f"{column} ({channel}) is {text!r}, more than a number can hold"
    if re.fullmatch(r"[+-]?\d+,\d+", text):
        return f"{column} ({channel}) is {text!r}, a decimal comma; write numbers with a point"
    return f"{column} ({channel}) is {text[:40]!r}; a finite number is expected"
