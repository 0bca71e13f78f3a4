"""Stage ingest: a unit's files to one Parquet file with all its recordings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.io.parquet import save_recordings
from pipeline.io.read import read_recordings
from pipeline.preprocessing.checks import check_recordings
from pipeline.signal.segments import cut

if TYPE_CHECKING:
    from pipeline.stages.batch import Job


def process_unit(job: Job, unit: str, settings: dict[str, Any]) -> None:
    """Read, cut and check the recordings; files are named by their path below the campaign's directory."""
    directory, procedure = Path(job.run["directory"]), settings["procedure"]
    recordings = []
    folder = directory / procedure["folder"]
    for read in read_recordings(procedure, settings["ingest"], settings["sensor"], folder):
        windows = procedure["recordings"][read.name].get("windows")
        recordings += cut(read, windows) if read.role == "session" else [read]
    named = []
    for recording in check_recordings(recordings, settings):
        path = Path(recording.source["file"])
        file = str(path.relative_to(directory)) if path.is_relative_to(directory) else str(path)
        named.append(replace(recording, source=recording.source | {"file": file}))
    save_recordings(job.output / f"{unit}.parquet", named)
