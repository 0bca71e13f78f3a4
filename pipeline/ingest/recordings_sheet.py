"""Read the sheet of a unit's recordings, ``recordings.csv``: one row a file, which states what the file holds.

| column | content |
|---|---|
| ``file`` | name of a file in the folder of the unit |
| ``kind`` | one of ``FILE_KINDS`` |
| ``axis`` | of a turn, or of turns on a table: ``x``, ``-y``, or three numbers; the body axis, as far as it is known |
| ``angle_deg`` | of a turn, in all, signed by the right hand; empty: whole turns are found from the gyroscope |
| ``angle_accuracy_deg`` | its standard uncertainty; empty: that of the procedure, or of the table |
| ``held_out`` | ``yes``: no fit and no selection uses the file |
| ``label`` | any text |

Columns may be left out, but for the first two. An error names the row, as a line of the file, and the column.
"""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import get_args

import numpy as np

from imu_logs.files import read_text
from pipeline.core.errors import ConfigurationError, IngestError, MissingInputError
from pipeline.core.records import AXES
from pipeline.core.settings import FileKind, Procedure, RecordingFile, Settings

FILE_KINDS: tuple[str, ...] = get_args(FileKind)
COLUMNS = ("file", "kind", "axis", "angle_deg", "angle_accuracy_deg", "held_out", "label")
SHEET = "recordings"  # its name among recordings that are named one by one
OF_TURNS = ("axis", "angle_deg", "angle_accuracy_deg")
ANSWERS = {"": False, "no": False, "yes": True}
LARGEST = 1_000_000  # bytes: thousands of rows
EXAMPLE = f"""\
{",".join(COLUMNS)}
# one row a file in this folder; docs/recordings.md has a row for each case. The kinds are
# {", ".join(FILE_KINDS)}
# still.csv,rest
# tx.csv,turn,x,360,1
# other.csv,turn,x,360,1,yes
"""
HINT = "docs/recordings.md shows a sheet for each case"


def with_sheet(settings: Settings, folder: Path) -> Settings:
    """Return the settings of a unit with the recordings of its sheet, if its procedure reads one.

    A sheet that cannot be used leaves no recordings, so that other units go on; ``require_recordings`` says why.
    """
    procedure = settings.procedure
    if procedure.sheet is None:
        return settings
    try:
        recordings = read_sheet(folder / procedure.sheet)
    except (IngestError, MissingInputError):
        recordings = {}
    return settings.replaced(procedure=procedure.replaced(recordings=recordings))


def require_recordings(procedure: Procedure, folder: Path) -> None:
    """Raise the error of a sheet that could not be used."""
    if procedure.sheet is not None and not procedure.recordings:
        read_sheet(folder / procedure.sheet)


def sheet_of_mapping(recordings: Mapping[str, object]) -> dict[str, RecordingFile]:
    """Return the recordings of the sheet ``recordings``, a path or a DataFrame, among recordings that are named."""
    sheet = recordings.get(SHEET)
    as_csv = getattr(sheet, "to_csv", None)
    if as_csv is not None:
        return recordings_of_text(str(as_csv(index=False)), f"{SHEET} (DataFrame)")
    if not isinstance(sheet, str | os.PathLike):
        message = f"recordings: no sheet: name its path or a DataFrame {SHEET!r}, with columns {', '.join(COLUMNS)}"
        raise MissingInputError(f"{message}; {HINT}")
    return read_sheet(Path(sheet))


def read_sheet(path: Path) -> dict[str, RecordingFile]:
    """Return the recordings of a sheet, by name: that of the file, without its suffix where that is unique.

    Raises ``MissingInputError`` without the file, ``IngestError`` for a row that cannot be used.
    """
    if not path.is_file():
        message = f"there is no such file: it states what each recording is, in columns {', '.join(COLUMNS)}; {HINT}"
        raise MissingInputError(message, str(path))
    try:
        text = read_text(path, LARGEST, "the sheet of recordings")
    except ConfigurationError as error:
        raise IngestError(error.message, str(path), code="sheet", hint=HINT) from None
    return recordings_of_text(text, str(path))


def recordings_of_text(text: str, path: str) -> dict[str, RecordingFile]:
    """Return the recordings of the text of a sheet, by name; ``path`` stands for it in errors."""
    entries = [(line, _entry(row, path, line)) for line, row in _rows(text, path)]
    if not entries:
        raise _refusal("no row names a file; python -m pipeline check --campaign DIR proposes rows", path, 1)
    stems = [Path(entry.file).stem for _, entry in entries]
    found: dict[str, RecordingFile] = {}
    for (line, entry), stem in zip(entries, stems, strict=True):
        name = stem if stems.count(stem) == 1 else entry.file
        if name in found:
            raise _refusal(f"column file: {entry.file} is in two rows", path, line)
        found[name] = entry
    if all(entry.role == "validation" for entry in found.values()):
        raise _refusal("column held_out: every file is held out, and none is left to fit", path, 1)
    return found


def _rows(text: str, path: str) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield the number and the cells of each line; an empty line, or one that begins with #, is none."""
    try:
        rows = list(csv.reader(text.splitlines(), strict=True))
    except csv.Error as error:
        raise IngestError(f"is no CSV: {error}", path, code="sheet", hint=HINT) from None
    names = [name.strip() for name in rows[0]] if rows else []
    known = f"columns are {', '.join(COLUMNS)}, each once"
    if unknown := [name for name in names if name not in COLUMNS or names.count(name) > 1]:
        raise _refusal(f"column {unknown[0]!r} is unknown or named twice; {known}", path, 1)
    if lacking := [name for name in COLUMNS[:2] if name not in names]:
        raise _refusal(f"column {lacking[0]!r} is missing; {known}", path, 1)
    for line, cells in enumerate(rows[1:], 2):
        texts = [cell.strip() for cell in cells]
        if any(texts) and not texts[0].startswith("#"):
            if len(texts) > len(names):
                raise _refusal(f"{len(texts)} cells, where the header has {len(names)} columns", path, line)
            yield line, dict.fromkeys(COLUMNS, "") | dict(zip(names, texts, strict=False))


def _entry(row: Mapping[str, str], path: str, line: int) -> RecordingFile:
    kind, held_out, direction = row["kind"], row["held_out"].lower(), direction_of(row["axis"])
    turned = kind in {"turn", "table"}
    angle, accuracy = (_number(row[name]) for name in OF_TURNS[1:])
    of_turns = [(n, bool(row[n]) and not turned, f"nothing (it is of a turn, this is {kind})") for n in OF_TURNS]
    logged = kind == "table" and bool(row["angle_deg"])
    checks = [
        ("file", not row["file"], "the name of a file in this folder"),
        ("kind", kind not in FILE_KINDS, f"one of {', '.join(FILE_KINDS)}"),
        ("held_out", held_out not in ANSWERS, "yes or nothing"),
        *of_turns,
        ("angle_deg", logged, "nothing (the table logs it)"),
        ("axis", turned and direction is None, "a body axis, such as x or -y, or three numbers separated by blanks,"),
        ("angle_deg", angle is not None and not 0.0 < abs(angle) < math.inf, "the whole angle, not 0, or nothing,"),
        ("angle_accuracy_deg", accuracy is not None and not 0.0 < accuracy < math.inf, "a number above 0, or nothing,"),
    ]
    for column, refused, expected in checks:
        if refused:
            raise _refusal(f"column {column}: {row[column]!r}; {expected} is expected", path, line)
    of_turn = {"direction": direction, "angle_deg": angle, "angle_accuracy_deg": accuracy}
    role = "validation" if ANSWERS[held_out] else "rests"
    about = {"file": row["file"], "role": role, "axis": None, "optional": False, "kind": kind, **of_turn}
    return RecordingFile.model_validate(about)


def direction_of(text: str) -> list[float] | None:
    """Return the unit vector of a body axis (``x``, ``-y``) or of three numbers; None for anything else."""
    name = text.removeprefix("+").removeprefix("-")
    if name in AXES and len(text) - len(name) <= 1:
        return [(-1.0 if text.startswith("-") else 1.0) * float(axis == name) for axis in AXES]
    numbers = [_number(part) for part in text.split()]
    if len(numbers) != len(AXES) or any(n is None or not math.isfinite(n) for n in numbers):
        return None
    vector = np.array(numbers, float)
    size = float(np.linalg.norm(vector))
    return (vector / size).tolist() if size > 0.0 else None


def _number(text: str) -> float | None:
    """Return a number; None for an empty cell, NaN for anything else."""
    try:
        return float(text) if text else None
    except ValueError:
        return math.nan


def _refusal(message: str, path: str, line: int) -> IngestError:
    return IngestError(message, f"{path}:{line}", code="sheet", hint=HINT)
