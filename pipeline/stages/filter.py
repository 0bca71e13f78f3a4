"""Stage filter: the readings of every recording through the configured filter."""

from __future__ import annotations

import os
import shutil
from typing import TYPE_CHECKING, Any

from pipeline.stages.batch import parse_job, run_batch

if TYPE_CHECKING:
    from collections.abc import Sequence


def main(argv: Sequence[str]) -> int:
    """Run the stage."""
    job = parse_job("filter", argv, ["ingest"])

    def work(unit: str, part: dict[str, Any]) -> None:
        source, target = job.inputs["ingest"] / f"{unit}.parquet", job.output / f"{unit}.parquet"
        if part["filter"]["name"] == "none":
            try:
                os.link(source, target)
            except OSError:  # a file system without hard links
                shutil.copyfile(source, target)
            return
        from pipeline.formats.parquet import load_recordings, save_recordings  # noqa: PLC0415  (nothing to import for none)
        from pipeline.signal.filters import apply_filter  # noqa: PLC0415

        save_recordings(target, [apply_filter(r, part["filter"]) for r in load_recordings(source)])

    return run_batch(job, work)
