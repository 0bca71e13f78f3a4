"""``units.csv``: one row a unit, every cell a text."""

from __future__ import annotations

import csv
import difflib
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from pipeline.config.options import GROUPS
from pipeline.config.user_effects import ONLY_FROM_THE_COMMAND_LINE, PYTHON
from pipeline.errors import ConfigurationError
from pipeline.io.files import not_regular, wrong_name

if TYPE_CHECKING:
    from pathlib import Path

CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]")  # all but tab and line ends
MEANT = ("unit", "overrides", *GROUPS, "serial", "lot", "date")
ALIKE = 0.85  # similarity of a name that is taken for a slip: overide 0.88, procedur 0.94; material for serial 0.71
LARGEST_BYTES = 100_000_000  # a million units of 100 characters each


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

    Raises ``ConfigurationError``.
    """
    columns, rows = _table(path)
    if PYTHON in columns:
        raise ConfigurationError(f"column {PYTHON}: {ONLY_FROM_THE_COMMAND_LINE}", f"{path}:1")
    if "unit" not in columns:
        raise ConfigurationError(f"has no column 'unit'{_why(columns)}", f"{path}:1")
    found: dict[str, dict[str, str]] = {}
    lines: dict[str, int] = {}
    alike: dict[str, str] = {}
    problems = [f"line 1: column {c!r} stands twice" for c in sorted({c for c in columns if columns.count(c) > 1})]
    problems += [
        f"line 1: column {c!r} is not known; nearest: {m}; correct it, or rename a column of your own"
        for c, m in _misspelt(columns)
    ]
    for line, raw in rows:
        if None in raw or any(v is None for v in raw.values()):
            problems.append(f"line {line}: {len(columns)} columns expected, as in the header")
            continue
        row = {k: v.strip() for k, v in raw.items()}
        problems += [
            f"line {line}: column {k!r} holds a control character" for k, v in row.items() if CONTROL.search(v)
        ]
        name = row["unit"]
        wrong = wrong_name(name)
        twin = alike.setdefault(name.casefold(), name)
        if wrong:
            problems.append(f"line {line}: unit {name[:60]!r}: {wrong}")
        elif name in found:
            problems.append(f"line {line}: unit {name!r} stands twice")
        elif twin != name:
            problems.append(
                f"line {line}: units {twin!r} and {name!r} differ in upper and lower case only; their files would be "
                "the same on disks that make no difference; rename one"
            )
        else:
            found[name], lines[name] = row, line
    if not found and not problems:
        problems.append("has no units")
    if problems:
        more = [f"and {len(problems) - 20} more"] * (len(problems) > 20)
        raise ConfigurationError("; ".join([*problems[:20], *more]), str(path))
    return Sheet(found, lines)


def _table(path: Path) -> tuple[list[str], list[tuple[int, dict[str | Any, Any]]]]:
    """Return the columns, and each row with the line on which it ends."""
    try:
        other = not_regular(path)
        if other:
            raise ConfigurationError(other, str(path))
        if path.stat().st_size > LARGEST_BYTES:
            raise ConfigurationError(f"is larger than {LARGEST_BYTES} bytes, the limit for a sheet", str(path))
        with path.open(encoding="utf-8-sig", newline="") as stream:
            reader = csv.DictReader(stream, strict=True)
            columns = [c.strip() for c in reader.fieldnames or []]
            reader.fieldnames = columns
            return columns, [(reader.line_num, row) for row in reader]
    except UnicodeDecodeError as error:
        reason = (
            "it is UTF-16" if error.object[:2] in (b"\xff\xfe", b"\xfe\xff") else f"byte {error.start} is not UTF-8"
        )
        raise ConfigurationError(f"cannot be read: {reason}; save it as CSV in UTF-8", str(path)) from error
    except csv.Error as error:
        raise ConfigurationError(f"cannot be read after line {reader.line_num}: {error}", str(path)) from error
    except OSError as error:
        raise ConfigurationError(f"cannot be read: {error}", str(path)) from error


def _why(columns: list[str]) -> str:
    """Return what a header without a column ``unit`` looks like, and what to do."""
    for sign, name in ((";", "semicolons"), ("\t", "tabs")):
        if len(columns) < 2 and columns and "unit" in [c.strip() for c in columns[0].split(sign)]:
            return (
                f": its columns are separated by {name}, where commas are expected; save it again as CSV with commas "
                "(quote a cell that holds a comma)"
            )
    close = difflib.get_close_matches("unit", columns, 1, ALIKE)
    names = ", ".join(repr(c[:60])[1:-1] for c in columns[:20])
    return (f"; nearest: {close[0]}" if close else "") + f"; its columns are {names or 'none'}"


def _misspelt(columns: list[str]) -> list[tuple[str, str]]:
    """Return columns that are not known, with the known one that each nearly is; plot is not taken for lot."""
    found = []
    for column in columns:
        close = difflib.get_close_matches(column.casefold(), MEANT, 1, ALIKE)
        if column not in MEANT and close and (len(close[0]) > 4 or column.casefold() in (close[0], close[0] + "s")):
            found.append((column, close[0]))
    return found
