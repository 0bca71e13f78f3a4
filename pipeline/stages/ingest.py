"""Stages ingest and filter: a unit's files become one Parquet file with its recordings, and their noise.

The noise is estimated once, of the filtered readings, for all stages after it (``<unit>.noise.json``). Without a filter
the readings are those of ingest (``unit_files.recordings_of``).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.io.parquet import to_parquet
from pipeline.io.read import read_recordings
from pipeline.preprocessing.checks import check_recordings
from pipeline.signal.filters import apply_filter
from pipeline.signal.segments import cut, held_out_windows
from pipeline.stages.unit_files import noise_file, recordings_of

if TYPE_CHECKING:
    from pipeline.pack import Files
    from pipeline.stages.batch import Job


def ingest_unit(job: Job, unit: str, settings: dict[str, Any]) -> Files:
    """Read, cut and check the recordings of a unit.

    Files are named by their path below the campaign's directory.
    """
    directory, procedure = Path(job.run["directory"]), settings["procedure"]
    recordings = []
    folder = directory / procedure["folder"]
    whole = read_recordings(procedure, settings["ingest"], settings["sensor"], folder)
    held_out = any(read.role == "validation" for read in whole)
    for read in whole:
        windows = procedure["recordings"][read.name].get("windows")
        if read.role == "rests" and procedure["turns"] and not held_out:
            turns = held_out_windows(read, procedure["turns"])
            recordings += cut(read, turns, found=True) if turns else [read]
        else:
            recordings += cut(read, windows) if read.role == "session" else [read]
    named = []
    for recording in check_recordings(recordings, settings):
        path = Path(recording.source["file"])
        file = str(path.relative_to(directory)) if path.is_relative_to(directory) else str(path)
        named.append(replace(recording, source=recording.source | {"file": file}))
    return {f"{unit}.parquet": to_parquet(named)}


def filter_unit(job: Job, unit: str, settings: dict[str, Any]) -> Files:
    """Filter the readings of a unit as configured, and estimate their noise."""
    recordings, files = recordings_of(job.inputs, unit), {}
    if settings["filter"]["name"] != "none":
        recordings = [apply_filter(r, settings["filter"]) for r in recordings]
        files = {f"{unit}.parquet": to_parquet(recordings)}
    return files | noise_file(unit, recordings, settings)
