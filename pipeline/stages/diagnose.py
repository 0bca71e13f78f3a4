"""Stage diagnose: which physical effects are missing from each sensor's model."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.diagnosis.diagnose import diagnose
from pipeline.diagnosis.effective_noise import effective_noise
from pipeline.diagnosis.formula_discovery import effect_file
from pipeline.files import read_json, write_atomically, write_json
from pipeline.io.parquet import load_recordings
from pipeline.stages.unit_files import load_fits, require_noises

if TYPE_CHECKING:
    from pipeline.stages.batch import Job


def process_unit(job: Job, unit: str, settings: dict[str, Any]) -> None:
    """Diagnose both sensors; an effect suggested for unknown physics is written as a file of its own."""
    recordings = load_recordings(job.inputs["filter"] / f"{unit}.parquet")
    fits = load_fits(job.inputs, unit)
    noises = require_noises(job.inputs["filter"], unit, recordings, settings["sensor"], fits)
    validation = read_json(job.inputs["validate"] / f"{unit}.json")
    document: dict[str, Any] = {"schema_version": 1, "unit": unit}
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
            write_atomically(job.output / found["suggested_file"], effect_file(found["suggested_effect"], unit))
    write_json(job.output / f"{unit}.json", document)
