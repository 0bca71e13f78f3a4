"""Stage filter: filter the readings of every recording as configured, and estimate their noise.

The noise of the filtered readings is estimated once for all later stages (``<unit>.noise.json``). Without a filter,
later stages read the recordings of ingest (``unit_files.recordings_of``).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.io.arrow import to_parquet
from pipeline.signal.filters import apply_filter
from pipeline.stages.unit_files import noise_file, recordings_of

if TYPE_CHECKING:
    from pipeline.pack import Files
    from pipeline.stages.batch import Job


def filter_unit(job: Job, unit: str, settings: dict[str, Any]) -> Files:
    """Filter the readings of a unit as configured, and estimate their noise."""
    recordings, files = recordings_of(job.inputs, unit), {}
    if settings["filter"]["name"] != "none":
        recordings = [apply_filter(r, settings["filter"]) for r in recordings]
        files = {f"{unit}.parquet": to_parquet(recordings)}
    return files | noise_file(unit, recordings, settings)
