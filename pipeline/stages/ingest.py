"""Stage ingest: a unit's files to one Parquet file with all its recordings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.io.parquet import save_recordings
from pipeline.io.read import read_recordings
from pipeline.preprocessing.checks import check_recordings
from pipeline.signal.segments import cut
from pipeline.stages.batch import parse_job, run_batch

if TYPE_CHECKING:
    from collections.abc import Sequence


def main(argv: Sequence[str]) -> int:
    """Run the stage."""
    job = parse_job("ingest", argv, [])
    directory = Path(job.run["directory"])

    def work(unit: str, part: dict[str, Any]) -> None:
        folder = directory / part["procedure"]["folder"]
        read = read_recordings(part["procedure"], part["ingest"], part["sensor"], folder)
        entries = part["procedure"]["recordings"]
        recordings = [s for r in read for s in ([r] if r.role != "session" else cut(r, entries[r.name].get("windows")))]
        recordings = check_recordings(recordings, part)
        named = [replace(r, source=r.source | {"file": below(directory, r.source["file"])}) for r in recordings]
        save_recordings(job.output / f"{unit}.parquet", named)

    return run_batch(job, work)


def below(directory: Path, file: str) -> str:
    """Return a file's path below the campaign's directory; one that lies elsewhere keeps its path."""
    path = Path(file)
    return str(path.relative_to(directory)) if path.is_relative_to(directory) else file
