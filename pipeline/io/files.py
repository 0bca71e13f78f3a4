"""Which files a unit's recordings lie in.

A procedure names a recording's file without suffix; the first kind of file that exists is taken, ``.csv`` before
``.gcsv`` before ``.mcap``. A name with a suffix is taken as it is. Where the ingest profile says that a recording comes
in several ``parts`` (files of one logger, joined on time), these stand in place of the ``.csv``.

Only the standard library is imported here: the Snakefile asks for the files of thousands of units while it is parsed.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

SUFFIXES = (".csv", ".gcsv", ".mcap")
FILE = "{file}"
UNIT_NAME = re.compile(r"[A-Za-z0-9._-]+")
LONGEST_NAME = 200  # a file name has at most 255 bytes; the longest of a unit's adds 41 (_accelerometer_unknown.yaml)
OF_STAGES = (".failed", ".noise", ".calibration")  # <unit>.failed.json and others lie beside <unit>.json


def recording_files(procedure: Mapping[str, Any], ingest: Mapping[str, Any], folder: Path) -> dict[str, list[Path]]:
    """Return the existing files of each recording of a procedure.

    Parameters
    ----------
    procedure, ingest : mapping
        Sections of the unit's configuration.
    folder : Path
        Where the unit's recordings lie.

    Returns
    -------
    dict of str to list of Path
        In the order of the procedure; a recording without any file is absent, one with some of its parts missing has
        those that exist.
    """
    found = {}
    for name, candidates in candidate_files(procedure, ingest).items():
        for candidate in candidates:
            files = [folder / file for file in candidate if os.path.exists(f"{folder}/{file}")]  # noqa: PTH110  (fast)
            if files:
                found[name] = files
                break
    return found


def candidate_files(procedure: Mapping[str, Any], ingest: Mapping[str, Any]) -> dict[str, list[list[str]]]:
    """Return which files each recording may lie in, most wanted first.

    Returns
    -------
    dict of str to list of list of str
        Recording to alternatives, each the names of all files that make up the recording.

    Raises
    ------
    ConfigurationError
        If the profile's parts do not say which recording they belong to.
    """
    recordings: Mapping[str, Mapping[str, Any]] = procedure["recordings"]
    parts: Sequence[Mapping[str, Any]] = (ingest.get("csv") or {}).get("parts") or ()
    owner = _owner_of_parts(recordings, parts)
    out = {}
    for name, entry in recordings.items():
        file = entry["file"]
        if Path(file).suffix:
            out[name] = [[file]]
        elif not parts:
            out[name] = [[file + suffix] for suffix in SUFFIXES]
        elif owner in (None, name):
            out[name] = [[str(part["file"]).replace(FILE, file) for part in parts], [file + ".mcap"]]
        else:
            out[name] = [[file + ".mcap"]]
    return out


def _owner_of_parts(recordings: Mapping[str, Mapping[str, Any]], parts: Sequence[Mapping[str, Any]]) -> str | None:
    """Return the one recording that parts with fixed names belong to, None where their names hold ``{file}``."""
    fixed = [part["file"] for part in parts if FILE not in part["file"]]
    if not fixed:
        return None
    required = [name for name, entry in recordings.items() if not entry.get("optional", False)]
    if len(required) != 1:
        raise ConfigurationError(
            f"ingest.csv.parts names {', '.join(fixed)} without {FILE}, which suits a procedure with one required "
            f"recording; this one requires {', '.join(required)}: write {FILE} where the recording's name belongs"
        )
    return required[0]


def wrong_name(name: str) -> str:
    """Return what is wrong with the name of a unit; nothing for a good one."""
    if not UNIT_NAME.fullmatch(name) or name in (".", ".."):
        return "use letters, digits, '.', '_', '-'"
    if len(name) > LONGEST_NAME:
        return f"has {len(name)} characters; {LONGEST_NAME} is the limit, as file names are made of it"
    ending = next((e for e in OF_STAGES if name.endswith(e)), "")
    return f"a name cannot end in {ending}, which marks files of another kind" if ending else ""
