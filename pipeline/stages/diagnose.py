"""Stage diagnose: find the effects that the model of each sensor lacks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.diagnosis.diagnose import diagnose, without_diagnosis
from pipeline.diagnosis.effective_noise import effective_noise
from pipeline.diagnosis.formula_discovery import effect_file
from pipeline.pack import INCOMPLETE
from pipeline.stages.batch import omission
from pipeline.stages.unit_files import load_fits, recordings_of, require_noises

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.pack import Files
    from pipeline.records import Noise, Recording, SensorCalibration
    from pipeline.stages.batch import Job


def diagnose_unit(job: Job, unit: str, settings: dict[str, Any]) -> Files:
    """Diagnose which physical effects the models of both sensors lack.

    A suggested formula is written as a separate file. A diagnosis of one sensor that fails does not stop the other.
    """
    recordings = recordings_of(job.inputs, unit)
    fits = load_fits(job.inputs, unit)
    noises = require_noises(job.inputs["filter"], unit, recordings, settings["sensor"], fits)
    validation = job.inputs["validate"].json(f"{unit}.json")
    document: dict[str, Any] = {"schema_version": 1, "unit": unit}
    files: Files = {f"{unit}.json": document}
    records = []
    for sensor, calibration in fits.items():
        if calibration is None:
            document[sensor] = None
            continue
        try:
            gravity = document.get("accelerometer")
            found = _diagnosed(calibration, fits, recordings, noises[sensor], settings, validation, gravity)
        except Exception as error:  # noqa: BLE001  (the calibration does not depend on its diagnosis)
            records.append(omission(error, unit, f"diagnose/{sensor}"))
            found = without_diagnosis(sensor, settings, records[-1])
        document[sensor] = found
        if found.get("suggested_effect"):
            found["suggested_file"] = f"{unit}_{sensor}_unknown.yaml"
            files[found["suggested_file"]] = effect_file(found["suggested_effect"], unit)
    return files | ({unit + INCOMPLETE: records} if records else {})


def diagnose_without(job: Job, unit: str, settings: dict[str, Any], record: dict[str, Any]) -> Files:
    """Return the document of a unit without a diagnosis of either sensor."""
    fits = load_fits(job.inputs, unit)
    parts = {s: fit and without_diagnosis(s, settings, record) for s, fit in fits.items()}
    return {f"{unit}.json": {"schema_version": 1, "unit": unit} | parts}


def _diagnosed(  # noqa: PLR0917  (what a diagnosis needs)
    calibration: SensorCalibration,
    fits: Mapping[str, SensorCalibration | None],
    recordings: Sequence[Recording],
    noise: Noise,
    settings: dict[str, Any],
    validation: Mapping[str, Any],
    gravity: Mapping[str, Any] | None,
) -> dict[str, Any]:
    """Return the diagnosis of one sensor, with its effective noise; ``gravity``: diagnosis of the accelerometer."""
    sensor = calibration.sensor
    found = diagnose(
        calibration,
        recordings,
        noise,
        settings,
        fits["accelerometer"],
        validation=validation[sensor],
        gravity=gravity,
        moves=validation["gravity_direction"] if sensor == "gyroscope" else None,
    )
    other = next(fit for s, fit in fits.items() if s != sensor)
    found["effective_noise"] = effective_noise(calibration, recordings, noise, settings["table"], found, other=other)
    return found
