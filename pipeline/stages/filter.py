"""Stage filter: the readings of every recording through the configured filter, and their noise.

All stages after it need the noise: it is estimated once, and lies beside the readings as ``<unit>.noise.json``.
"""

from __future__ import annotations

import os
import shutil
from typing import TYPE_CHECKING, Any

from pipeline.io.parquet import load_recordings, save_recordings
from pipeline.signal.filters import apply_filter
from pipeline.stages.batch import parse_job, run_batch
from pipeline.stages.noises import save_noises

if TYPE_CHECKING:
    from collections.abc import Sequence


def main(argv: Sequence[str]) -> int:
    """Run the stage."""
    job = parse_job("filter", argv, ["ingest"])

    def work(unit: str, part: dict[str, Any]) -> None:
        source, target = job.inputs["ingest"] / f"{unit}.parquet", job.output / f"{unit}.parquet"
        recordings = load_recordings(source)
        if part["filter"]["name"] == "none":
            try:
                os.link(source, target)
            except OSError:  # a file system without hard links
                shutil.copyfile(source, target)
        else:
            recordings = [apply_filter(r, part["filter"]) for r in recordings]
            save_recordings(target, recordings)
        save_noises(job.output, unit, recordings, part)

    return run_batch(job, work)
