"""Find the files of a unit's recordings, by the names of a procedure or the sheet of the unit; check names.

A procedure names a recording's file without suffix; the first kind of file that exists is used, in the order of
``SUFFIXES``. A name with a suffix is used unchanged. If the ingest profile has ``parts`` (files of one logger, text or
message logs, joined on time), they replace the ``.csv``.

The SHA-256 of the recordings of a unit is a sorted list of hexadecimal digests, one for each different file.

The sheet, ``recordings.csv``, has one row a file, which states what the file holds:

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
import hashlib
import math
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np

from imu_logs.files import SUFFIXES, not_regular, read_text
from pipeline.core.errors import ConfigurationError, IngestError, MissingInputError
from pipeline.core.files import state_of_files
from pipeline.core.pack import Pack
from pipeline.core.records import AXES
from pipeline.core.settings import FileKind, Ingest, Procedure, RecordingFile, Settings

FILE = "{file}"
UNIT_NAME = re.compile(r"[A-Za-z0-9._-]+")
LONGEST_NAME = 200  # a file name has at most 255 bytes; files of a unit add up to 41 (_accelerometer_unknown.yaml)
STAGE_ENDINGS = (".failed", ".noise", ".calibration")  # <unit>.failed.json and others are in the folder of <unit>.json
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


def recording_files(procedure: Procedure, ingest: Ingest, folder: Path) -> dict[str, list[Path]]:
    """Return the existing files of each recording of a procedure, in its order.

    A recording without any file is not in the result; a recording with missing parts has its existing parts.
    """
    found = {}
    for name, candidates in candidate_files(procedure, ingest).items():
        for candidate in candidates:
            files = [folder / file for file in candidate if os.path.exists(f"{folder}/{file}")]  # noqa: PTH110  (fast)
            if files:
                found[name] = files
                break
    return found


def state_of_recordings(procedure: Procedure, ingest: Ingest, folder: Path) -> str:
    """Return a digest of the names, sizes and times of the files of a unit's recordings, and of their sheet."""
    sheets = [path for path in [folder / (procedure.sheet or "")] if path.is_file()]
    files = recording_files(procedure, ingest, folder).values()
    return state_of_files({*sheets, *(path for paths in files for path in paths)})


def candidate_files(procedure: Procedure, ingest: Ingest) -> dict[str, list[list[str]]]:
    """Return the possible files of each recording: alternatives in order of preference, each with all its files."""
    parts = parts_of(ingest)
    owner = _owner_of_parts(procedure.recordings, parts)
    out = {}
    for name, entry in procedure.recordings.items():
        file = entry.file
        messages = [[file + suffix] for suffix in SUFFIXES[2:]]
        if Path(file).suffix:
            out[name] = [[file]]
        elif not parts:
            out[name] = [[file + suffix] for suffix in SUFFIXES]
        elif owner in (None, name):
            out[name] = [[str(part["file"]).replace(FILE, file) for part in parts], *messages]
        else:
            out[name] = messages
    return out


def parts_of(ingest: Ingest) -> Sequence[Mapping[str, str]]:
    """Return the files of one recording, if the profile joins several text or message logs."""
    found: Sequence[Mapping[str, str]] = ingest.csv.get("parts") or ingest.mcap.get("parts") or ()
    return found


def grouped(files: Sequence[Path], ingest: Ingest) -> list[list[Path]]:
    """Return the files of each recording: one, or one for each part of the profile."""
    parts, of_messages = [part["file"] for part in parts_of(ingest)], bool(ingest.mcap.get("parts"))
    groups: dict[Path, list[Path]] = {}
    for file in files:
        if not parts or (file.suffix.lower() in SUFFIXES[1:] and not of_messages):
            groups[file] = [file]
            continue
        patterns = [re.escape(p).replace(re.escape(FILE), "(.+)") for p in parts]
        match = next((m for p in patterns if (m := re.fullmatch(p, file.name))), None)
        if match is None:
            raise ConfigurationError(f"matches none of the profile's parts ({', '.join(parts)})", str(file))
        stem = match.group(1) if match.groups() else ""
        groups[file.parent / stem] = [file.parent / p.replace(FILE, stem) for p in parts]
    return list(groups.values())


def _owner_of_parts(recordings: Mapping[str, RecordingFile], parts: Sequence[Mapping[str, str]]) -> str | None:
    """Return the recording to which parts with fixed names belong; None if their names contain ``{file}``."""
    fixed = [part["file"] for part in parts if FILE not in part["file"]]
    if not fixed or not recordings:  # a sheet that cannot be used says so where it is read
        return None
    required = [name for name, entry in recordings.items() if not entry.optional]
    if len(required) != 1:
        raise ConfigurationError(
            f"parts of the ingest profile names {', '.join(fixed)} without {FILE}, which suits a procedure with one "
            f"required recording; this one requires {', '.join(required) or 'none'}: write {FILE} where the "
            f'recording\'s name belongs, as in "{FILE}_{fixed[0]}", and name the files so'
        )
    return required[0]


def wrong_name(name: str) -> str:
    """Return what is wrong with the name of a unit; empty for a valid name."""
    if not UNIT_NAME.fullmatch(name) or name in (".", ".."):
        return "use letters, digits, '.', '_', '-'"
    if len(name) > LONGEST_NAME:
        return f"has {len(name)} characters; {LONGEST_NAME} is the limit, as file names are made of it"
    ending = next((e for e in STAGE_ENDINGS if name.endswith(e)), "")
    return f"a name cannot end in {ending}, which marks files of another kind" if ending else ""


def digests_of_files(procedure: Procedure, ingest: Ingest, folder: Path) -> list[str]:
    """Return the digests of the existing files of a unit's recordings; a file that cannot be read is left out."""
    digests = set()
    for path in {path for paths in recording_files(procedure, ingest, folder).values() for path in paths}:
        try:
            if not not_regular(path):
                with path.open("rb") as stream:
                    digests.add(hashlib.file_digest(stream, "sha256").hexdigest())
        except OSError:
            continue
    return sorted(digests)


def digests_of_entries(entries: Iterable[Mapping[str, Any]]) -> list[str]:
    """Return the digests in ``inputs`` of a calibration document, or in the sources of recordings."""
    digests = set()
    for entry in entries:
        digests |= {str(entry["sha256"])} if entry.get("sha256") else set()
        digests |= set(digests_of_entries(entry.get("joined") or ()))
    return sorted(digests)


def digests_in_pack(ingested: Pack, unit: str) -> list[str] | None:
    """Return the digests of a unit in the output of ingest; None if the unit failed there."""
    if f"{unit}.parquet" not in ingested:
        return None
    from pipeline.ingest.arrow import from_parquet  # noqa: PLC0415  (pyarrow, where a unit has failed)

    recordings = from_parquet(ingested.read(f"{unit}.parquet"), str(ingested.path))
    return digests_of_entries(recording.source for recording in recordings)


def with_sheet(settings: Settings, folder: Path) -> Settings:
    """Return the settings of a unit with the recordings of its sheet, if its procedure reads one.

    ``folder``: of the unit's recordings. A sheet that cannot be used leaves no recordings: ``require_recordings`` then
    states the reason where the recordings are read, so that other units go on.
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
