"""Find the files of a unit's recordings, and check names.

A procedure names a recording's file without suffix; the first kind of file that exists is used, in the order of
``SUFFIXES``. A name with a suffix is used unchanged. If the ingest profile has ``parts`` (files of one logger, text or
message logs, joined on time), they replace the ``.csv``.

The SHA-256 of the recordings of a unit is a sorted list of hexadecimal digests, one for each different file.
"""

from __future__ import annotations

import hashlib
import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from imu_logs.files import SUFFIXES, not_regular
from pipeline.core.errors import ConfigurationError
from pipeline.core.files import state_of_files

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from pipeline.core.pack import Pack
    from pipeline.core.settings import Ingest, Procedure, RecordingFile


FILE = "{file}"
UNIT_NAME = re.compile(r"[A-Za-z0-9._-]+")
LONGEST_NAME = 200  # a file name has at most 255 bytes; files of a unit add up to 41 (_accelerometer_unknown.yaml)
STAGE_ENDINGS = (".failed", ".noise", ".calibration")  # <unit>.failed.json and others are in the folder of <unit>.json


def recording_files(procedure: Procedure, ingest: Ingest, folder: Path) -> dict[str, list[Path]]:
    """Return the existing files of each recording of a procedure, in its order.

    A recording without any file is not in the result; a recording with missing parts has its existing parts.
    """
    found = {}
    for name, candidates in candidate_files(procedure, ingest).items():
        existing = ([folder / f for f in c if os.path.exists(f"{folder}/{f}")] for c in candidates)  # noqa: PTH110  (fast)
        if files := next(filter(None, existing), None):
            found[name] = files
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
