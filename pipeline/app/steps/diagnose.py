"""Steps validate and diagnose: compute the errors on held-out motion, and find the effects that the models lack."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from pipeline.app.steps.unit_files import StoredUnit
from pipeline.core.errors import omission
from pipeline.core.pack import Files
from pipeline.core.records import (
    SCHEMA_VERSION,
    Fit,
    Noise,
    SensorCalibration,
    SensorDiagnosis,
    SensorValidation,
    UnitRecordings,
    Validation,
    calibrated,
)
from pipeline.core.settings import Settings
from pipeline.estimation.candidates import MOUNTING
from pipeline.estimation.known_effects import without_known_effects
from pipeline.estimation.noise import required_noises
from pipeline.estimation.observations import observe
from pipeline.evaluation.diagnosis.diagnose import diagnose, effective_noise, without_diagnosis
from pipeline.evaluation.held_out.attitude import attitude, gravity_direction, held_out_turns
from pipeline.evaluation.held_out.samples import OTHER_SENSOR
from pipeline.evaluation.held_out.validation import validate

if TYPE_CHECKING:
    from pipeline.app.steps.batch import Job


def validate_unit(unit: str, recordings: UnitRecordings, fits: Mapping[str, Fit], settings: Settings) -> Validation:
    """Return the errors on held-out motion after each step of both fits."""
    filtered, found = recordings.filtered, calibrated(fits)
    noise = recordings.noises.get("gyroscope")
    return Validation(
        unit,
        held_out_errors(recordings, fits, settings),
        attitude(found["accelerometer"], found["gyroscope"], filtered),
        gravity_direction(**found, recordings=filtered, noise=noise, procedure=settings.procedure),
        *held_out_turns(**found, recordings=filtered, noise=noise, procedure=settings.procedure),
    )


def held_out_errors(
    recordings: UnitRecordings, fits: Mapping[str, Fit], settings: Settings
) -> dict[str, SensorValidation | None]:
    """Return the errors of each sensor; None for a sensor without a calibration."""
    known = calibrated(fits)
    noises = required_noises(recordings, settings.sensor, known)
    return {
        s: None if c is None else validate(c, recordings.filtered, noises[s], settings, other=known[OTHER_SENSOR[s]])
        for s, c in known.items()
    }


@dataclass(frozen=True)
class Diagnosis:
    """The diagnosis of a unit."""

    unit: str
    sensors: dict[str, SensorDiagnosis | None] = field(default_factory=dict)  # None for a sensor without a calibration
    effect_files: dict[str, str] = field(default_factory=dict)  # of suggested formulas, by name
    omissions: list[dict[str, Any]] = field(default_factory=list)  # records of what could not be made

    @property
    def document(self) -> dict[str, Any]:
        """``diagnoses/<unit>.json``."""
        parts = {sensor: found and found.to_json() for sensor, found in self.sensors.items()}
        return {"schema_version": SCHEMA_VERSION, "unit": self.unit, **parts}


def diagnose_unit(
    unit: str, recordings: UnitRecordings, fits: Mapping[str, Fit], validated: Validation, settings: Settings
) -> Diagnosis:
    """Diagnose which physical effects the models of both sensors lack.

    A diagnosis of one sensor that fails does not stop the other.
    """
    noises = required_noises(recordings, settings.sensor, calibrated(fits))
    recordings, known = without_known_effects(recordings, calibrated(fits), settings.method)
    made = Diagnosis(unit)
    for sensor, calibration in known.items():
        if calibration is None:
            made.sensors[sensor] = None
            continue
        try:
            gravity = made.sensors.get("accelerometer")
            found = _diagnosed(calibration, known, recordings, noises[sensor], settings, validated, gravity)
        except Exception as error:  # noqa: BLE001  (the calibration does not depend on its diagnosis)
            made.omissions.append(omission(error, unit, f"diagnose/{sensor}"))
            failure = made.omissions[-1]
            found = without_diagnosis(sensor, settings.effects, failure["code"], failure["message"])
        if found.suggested_effect:
            file = f"{unit}_{sensor}_unknown.yaml"
            made.effect_files[file] = effect_file(found.suggested_effect, unit)
            found = replace(found, further={**found.further, "suggested_file": file})
        made.sensors[sensor] = found
    return made


def diagnose_without(job: Job, unit: str, settings: Settings, record: dict[str, Any]) -> Files:
    """Return the document of a unit without a diagnosis of either sensor."""
    failed, fits = (settings.effects, record["code"], record["message"]), calibrated(StoredUnit(job, unit).fits)
    parts = {s: None if fit is None else without_diagnosis(s, *failed) for s, fit in fits.items()}
    return {f"{unit}.json": Diagnosis(unit, parts).document}


def _diagnosed(  # noqa: PLR0917  (what a diagnosis needs)
    calibration: SensorCalibration,
    known: Mapping[str, SensorCalibration | None],
    recordings: UnitRecordings,
    noise: Noise,
    settings: Settings,
    validated: Validation,
    gravity: SensorDiagnosis | None,
) -> SensorDiagnosis:
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
        departures=validated.turn_departures if sensor == "gyroscope" else (),
    )
    other = next(c for s, c in known.items() if s != sensor)
    densities = effective_noise(calibration, filtered, noise, settings.table, found, other=other)
    if MOUNTING not in found.configured:  # else the gyroscope's mountings use the accelerometer's selections
        observe(sensor, filtered, settings.table).forget()
    return replace(found, further={**found.further, "effective_noise": densities})


def effect_file(definition: Mapping[str, Any], unit: str) -> str:
    """Return the text of an effect file for a campaign's ``effects/``, from the definition that a unit suggests."""
    import yaml  # noqa: PLC0415  (only a unit with unknown physics pays for it)

    name, sensor = definition["name"], definition["sensors"][0]
    remarks = (
        f"# What unit {unit} shows beyond the catalogue of effects: a first guess, to be named, tried and confirmed.\n"
        f"# To try it, copy this file to effects/{name}.yaml in the campaign's directory and add {name} to\n"
        f"# effects.{sensor}. To rename it, change the file's name and the one below together.\n"
    )
    return remarks + str(yaml.safe_dump(dict(definition), sort_keys=False, allow_unicode=True, width=110))
