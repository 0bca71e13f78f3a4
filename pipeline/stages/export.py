"""Stage export: the calibration in the formats of other tools."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.exports import export_all
from pipeline.files import read_json

if TYPE_CHECKING:
    from pipeline.stages.batch import Job


def process_unit(job: Job, unit: str, settings: dict[str, Any]) -> None:
    """Write every format into the unit's folder."""
    stages = ("calibration", "validate", "diagnose")
    calibration, validation, diagnosis = (read_json(job.inputs[stage] / f"{unit}.json") for stage in stages)
    export_all(calibration, settings, job.output / unit, validation, diagnosis)
