"""Step diagnose: find the effects that the model of each sensor lacks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from pipeline.diagnosis.diagnose import diagnose, without_diagnosis
from pipeline.diagnosis.effective_noise import effective_noise
from pipeline.diagnosis.formula_discovery import effect_file
from pipeline.errors import omission
from pipeline.estimation.known_effects import without_known_effects
from pipeline.estimation.noise import required_noises
from pipeline.records import SCHEMA_VERSION, Validation, calibrated
from pipeline.stages.unit_files import StoredUnit

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pipeline.pack import Files
    from pipeline.records import Fit, Noise, SensorCalibration, UnitRecordings
    from pipeline.settings import Settings
    from pipeline.stages.batch import Job


class Diagnosis(NamedTuple):
    """``diagnoses/<unit>.json``, effect files of suggested formulas by name, and records of what could not be made."""

    document: dict[str, Any]
    effect_files: dict[str, str]
    omissions: list[dict[str, Any]]


def diagnose_unit(
    unit: str,
    recordings: UnitRecordings,
    fits: Mapping[str, Fit],
    validated: Validation,
    settings: Settings,
) -> Diagnosis:
    """Diagnose which physical effects the models of both sensors lack.

    A diagnosis of one sensor that fails does not stop the other.
    """
    noises = required_noises(recordings, settings.sensor, calibrated(fits))
    recordings, known = without_known_effects(recordings, calibrated(fits), settings)
    made = Diagnosis({"schema_version": SCHEMA_VERSION, "unit": unit}, {}, [])
    for sensor, calibration in known.items():
        if calibration is None:
            made.document[sensor] = None
            continue
        try:
            gravity = made.document.get("accelerometer")
            found = _diagnosed(calibration, known, recordings, noises[sensor], settings, validated, gravity)
        except Exception as error:  # noqa: BLE001  (the calibration does not depend on its diagnosis)
            made.omissions.append(omission(error, unit, f"diagnose/{sensor}"))
            found = without_diagnosis(sensor, settings, made.omissions[-1])
        made.document[sensor] = found
        if found.get("suggested_effect"):
            found["suggested_file"] = f"{unit}_{sensor}_unknown.yaml"
            made.effect_files[found["suggested_file"]] = effect_file(found["suggested_effect"], unit)
    return made


def diagnose_without(job: Job, unit: str, settings: Settings, record: dict[str, Any]) -> Files:
    """Return the document of a unit without a diagnosis of either sensor."""
    known = calibrated(StoredUnit(job, unit).fits)
    parts = {s: c and without_diagnosis(s, settings, record) for s, c in known.items()}
    return {f"{unit}.json": {"schema_version": SCHEMA_VERSION, "unit": unit} | parts}


def _diagnosed(  # noqa: PLR0917  (what a diagnosis needs)
    calibration: SensorCalibration,
    known: Mapping[str, SensorCalibration | None],
    recordings: UnitRecordings,
    noise: Noise,
    settings: Settings,
    validated: Validation,
    gravity: Mapping[str, Any] | None,
) -> dict[str, Any]:
    """Return the diagnosis of one sensor, with its effective noise; ``gravity``: diagnosis of the accelerometer."""
    sensor, filtered = calibration.sensor, recordings.filtered
    found = diagnose(
        calibration,
        filtered,
        noise,
        settings,
        known["accelerometer"],
        validation=validated.sensors[sensor],
        gravity=gravity,
        moves=validated.moves_error if sensor == "gyroscope" else None,
    )
    other = next(c for s, c in known.items() if s != sensor)
    found["effective_noise"] = effective_noise(calibration, filtered, noise, settings.table, found, other=other)
    return found
