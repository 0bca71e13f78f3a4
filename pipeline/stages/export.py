"""Stage export: write the calibration in the formats of other tools."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.exports import exports

if TYPE_CHECKING:
    from pipeline.pack import Files
    from pipeline.stages.batch import Job


def export_unit(job: Job, unit: str, settings: dict[str, Any]) -> Files:
    """Write the calibration in the formats of other tools."""
    calibration, validation, diagnosis = (
        job.inputs[stage].json(f"{unit}.json") for stage in ("calibration", "validate", "diagnose")
    )
    written = exports(calibration, settings, validation, diagnosis)
    return {f"{unit}/{file}": text for file, text in written.items()}
