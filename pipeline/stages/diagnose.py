"""Stage diagnose: find the effects that the model of each sensor lacks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.diagnosis.diagnose import diagnose
from pipeline.diagnosis.effective_noise import effective_noise
from pipeline.diagnosis.formula_discovery import effect_file
from pipeline.records import SCHEMA_VERSION
from pipeline.stages.unit_files import load_fits, recordings_of, require_noises

if TYPE_CHECKING:
    from pipeline.pack import Files
    from pipeline.stages.batch import Job


def diagnose_unit(job: Job, unit: str, settings: dict[str, Any]) -> Files:
    """Diagnose which physical effects the models of both sensors lack.

    A suggested formula is written as a separate file.
    """
    recordings = recordings_of(job.inputs, unit)
    fits = load_fits(job.inputs, unit)
    noises = require_noises(job.inputs["filter"], unit, recordings, settings["sensor"], fits)
    validation = job.inputs["validate"].json(f"{unit}.json")
    document: dict[str, Any] = {"schema_version": SCHEMA_VERSION, "unit": unit}
    files: Files = {f"{unit}.json": document}
    for sensor, calibration in fits.items():
        document[sensor] = found = calibration and diagnose(
            calibration,
            recordings,
            noises[sensor],
            settings,
            fits["accelerometer"],
            validation=validation[sensor],
            gravity=document.get("accelerometer"),
            moves=validation["gravity_direction"] if sensor == "gyroscope" else None,
        )
        if calibration and found:
            other = next(fit for s, fit in fits.items() if s != sensor)
            found["effective_noise"] = effective_noise(
                calibration, recordings, noises[sensor], settings["table"], found, other=other
            )
        if found and found.get("suggested_effect"):
            found["suggested_file"] = f"{unit}_{sensor}_unknown.yaml"
            files[found["suggested_file"]] = effect_file(found["suggested_effect"], unit)
    return files
