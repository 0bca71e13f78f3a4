"""``units.csv``: one row a unit, every cell a text."""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pipeline.config.user_effects import ONLY_FROM_THE_COMMAND_LINE, PYTHON
from pipeline.errors import ConfigurationError

if TYPE_CHECKING:
    from pathlib import Path

UNIT_NAME = re.compile(r"[A-Za-z0-9._-]+")


@dataclass(frozen=True)
class Sheet:
    """The rows of ``units.csv``.

    Attributes
    ----------
    rows : dict of str to dict
        Unit to its cells by column, in the order of the sheet.
    lines : dict of str to int
        Unit to the line of the file on which its row ends.
    """

    rows: dict[str, dict[str, str]]
    lines: dict[str, int]


def read_sheet(path: Path) -> Sheet:
    """Read ``units.csv``; refuses bad names, duplicates and ragged rows, all in one message.

    Parameters
    ----------
    path : Path

    Raises
    ------
    ConfigurationError
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            reader = csv.DictReader(stream, strict=True)
            columns = [c.strip() for c in reader.fieldnames or []]
            reader.fieldnames = columns
            rows = [(reader.line_num, row) for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ConfigurationError(f"cannot be read: {error}", str(path)) from error
    if PYTHON in columns:
        raise ConfigurationError(f"column {PYTHON}: {ONLY_FROM_THE_COMMAND_LINE}", f"{path}:1")
    if "unit" not in columns:
        raise ConfigurationError(f"has no column 'unit'; its columns are {', '.join(columns) or 'none'}", f"{path}:1")
    found: dict[str, dict[str, str]] = {}
    lines: dict[str, int] = {}
    problems = [f"line 1: column {c!r} stands twice" for c in sorted({c for c in columns if columns.count(c) > 1})]
    for line, raw in rows:
        if None in raw or any(v is None for v in raw.values()):
            problems.append(f"line {line}: {len(columns)} columns expected, as in the header")
            continue
        row = {k: v.strip() for k, v in raw.items()}
        name = row["unit"]
        if not UNIT_NAME.fullmatch(name) or name in (".", ".."):
            problems.append(f"line {line}: unit {name!r}: use letters, digits, '.', '_', '-'")
        elif name in found:
            problems.append(f"line {line}: unit {name!r} stands twice")
        else:
            found[name], lines[name] = row, line
    if not found and not problems:
        problems.append("has no units")
    if problems:
        raise ConfigurationError("; ".join(problems), str(path))
    return Sheet(found, lines)
