"""Stage filter: the readings of every recording through the configured filter, and their noise.

The noise is estimated once, for all stages after it, and written as ``<unit>.noise.json``.
"""

from __future__ import annotations

import os
import shutil
from typing import TYPE_CHECKING, Any

from pipeline.io.parquet import load_recordings, save_recordings
from pipeline.signal.filters import apply_filter
from pipeline.stages.unit_files import save_noises

if TYPE_CHECKING:
    from pipeline.stages.batch import Job


def process_unit(job: Job, unit: str, settings: dict[str, Any]) -> None:
    """Filter a unit's recordings."""
    source, target = job.inputs["ingest"] / f"{unit}.parquet", job.output / f"{unit}.parquet"
    recordings = load_recordings(source)
    if settings["filter"]["name"] == "none":
        try:
            os.link(source, target)
        except OSError:  # a file system without hard links
            shutil.copyfile(source, target)
    else:
        recordings = [apply_filter(r, settings["filter"]) for r in recordings]
        save_recordings(target, recordings)
    save_noises(job.output, unit, recordings, settings)
