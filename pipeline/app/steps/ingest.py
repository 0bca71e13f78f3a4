"""Steps collect, ingest and filter: read, cut, check and filter the recordings of a unit; estimate their noise."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from imu_logs.files import unchanged
from pipeline.checks.checks import check_recordings
from pipeline.checks.evidence import gravity_turned, of_table, spin
from pipeline.core.errors import IngestError, PipelineError, failure_of
from pipeline.core.pack import FAILED_SUFFIX, Pack, as_bytes, new_pack
from pipeline.core.records import Recording, UnitRecordings
from pipeline.core.settings import Settings
from pipeline.estimation.noise import with_noises
from pipeline.ingest.files import candidate_files, recording_files, state_of_recordings
from pipeline.ingest.read import read_recordings
from pipeline.physics.signal.filters import apply_filter
from pipeline.physics.signal.segments import cut, held_out_windows, logged_turns
from pipeline.unit import UnitFiles

if TYPE_CHECKING:
    from pipeline.app.steps.batch import Job


def collect_batch(job: Job) -> None:
    """Write the raw recordings of all units into one file, for a machine without access to this disk.

    The name of a member is the absolute path of its file without the first slash. A recording of several units is
    stored once. A unit with an unreadable recording has failed, as in ``ingest``.
    """
    files: dict[str, bytes] = {}
    folders = {unit: Path(job.run["directory"], s.procedure.folder) for unit, s in job.units.items()}
    done: set[str] = set()
    with new_pack(job.output) as add:
        for unit, settings in job.units.items():
            found = recording_files(settings.procedure, settings.ingest, folders[unit])
            try:
                for path in sorted({path for paths in found.values() for path in paths}):
                    if _member(path) not in done:
                        with unchanged(path):
                            add({_member(path): path.read_bytes()})
                        done.add(_member(path))
            except IngestError as error:
                add({unit + FAILED_SUFFIX: as_bytes(failure_of(error, unit, "ingest"))})
            # Empty members, because ingest reports missing folders, and files that it did not read.
            files |= {f"{_member(folders[unit])}/": b""} if folders[unit].is_dir() else {}
            files |= {_member(path): b"" for path in _candidates(settings, folders[unit]) if path.exists()}
        add({name: content for name, content in files.items() if name not in done})


def _extract(recordings: Pack, settings: Settings, folder: Path, root: str) -> None:
    """Write the recordings of a unit below ``root``, which replaces the root of the file system."""
    if f"{_member(folder)}/" in recordings:
        Path(f"{root}{folder}").mkdir(parents=True)
    for path in _candidates(settings, folder):
        if _member(path) in recordings:
            copy = Path(root, _member(path))
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(recordings.read(_member(path)))


def _candidates(settings: Settings, folder: Path) -> list[Path]:
    files = candidate_files(settings.procedure, settings.ingest).values()
    return [folder / file for candidates in files for candidate in candidates for file in candidate]


def _member(path: Path) -> str:
    return os.path.normpath(path).lstrip("/")


def ingest(files: UnitFiles, settings: Settings) -> list[Recording]:
    """Read, cut and check the recordings of a unit."""
    if files.archive is None:
        return _ingested(files, settings)
    with tempfile.TemporaryDirectory() as root:
        try:
            _extract(files.archive, settings, files.folder, root)
            extracted = replace(files, directory=Path(f"{root}{files.directory}"), folder=Path(f"{root}{files.folder}"))
            ingested = _ingested(extracted, settings)
        except PipelineError as error:
            error.message, error.file = error.message.replace(root, ""), error.file and error.file.replace(root, "")
            raise
        return [r.with_source(_named(r.source, lambda file: file.removeprefix(root))) for r in ingested]


def ingest_reads(job: Job, unit: str, settings: Settings) -> str | None:
    """Return the state of the recordings of a unit; None where they are simulated and not on this machine."""
    if job.run["recordings"] is not None:
        return str(job.run["recordings"][unit])
    folder = Path(job.run["directory"], settings.procedure.folder)
    return None if "recordings" in job.inputs else state_of_recordings(settings.procedure, settings.ingest, folder)


def _ingested(files: UnitFiles, settings: Settings) -> list[Recording]:
    procedure, recordings = settings.procedure, []
    place = files.folder, files.in_memory
    whole = files.recordings or read_recordings(procedure, settings.ingest, settings.sensor, *place)
    held_out = any(read.role == "validation" for read in whole)
    for read in whole:
        entry = procedure.recordings.get(read.name)
        windows = entry.windows if entry else None
        if entry and procedure.turns and entry.kind == "table":
            recordings.append(logged_turns(read, settings.table, entry, procedure.turns))
            continue
        if read.role == "rests" and procedure.turns and not held_out:
            turns = held_out_windows(read, procedure.turns)
            recordings += cut(read, turns, found=True) if turns else [read]
        else:
            recordings += cut(read, windows) if read.role == "session" else [read]

    def below(file: str) -> str:
        path = Path(file)
        return path.relative_to(files.directory).as_posix() if path.is_relative_to(files.directory) else file

    checked = check_recordings(recordings, settings)  # turns between samples are read by checks alone
    return [r.with_source(_named(r.source, below), of_table, spin, gravity_turned) for r in checked]


def _named(source: Mapping[str, Any], name: Callable[[str], str]) -> dict[str, Any]:
    """Rename the file of a recording's source, and the files joined with it, by the function ``name``."""
    if "file" not in source:  # of a simulation
        return dict(source)
    joined = {"joined": [_named(other, name) for other in source["joined"]]} if "joined" in source else {}
    return {**source, "file": name(source["file"]), **joined}


def filter_recordings(checked: list[Recording], settings: Settings) -> UnitRecordings:
    """Filter the recordings of a unit, and estimate the noise of each sensor."""
    filtered = checked
    if settings.filter.name != "none":
        filtered = [apply_filter(recording, settings.filter) for recording in checked]
    return with_noises(filtered, settings.sensor)
