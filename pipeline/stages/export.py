"""Stage export: the calibration in the formats of those who use it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.exports import export_all
from pipeline.stages.batch import parse_job, read_json, run_batch

if TYPE_CHECKING:
    from collections.abc import Sequence


def main(argv: Sequence[str]) -> int:
    """Run the stage."""
    job = parse_job("export", argv, ["calibration", "validate"])

    def work(unit: str, part: dict[str, Any]) -> None:
        calibration = read_json(job.inputs["calibration"] / f"{unit}.json")
        validation = read_json(job.inputs["validate"] / f"{unit}.json")
        export_all(calibration, part, job.output / unit, validation)

    return run_batch(job, work)
