"""Step diagnose: find the effects that the model of each sensor lacks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from pipeline.diagnosis.diagnose import diagnose
from pipeline.diagnosis.effective_noise import effective_noise
from pipeline.diagnosis.formula_discovery import effect_file
from pipeline.estimation.noise import required_noises
from pipeline.records import calibrated

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pipeline.records import Fit, UnitRecordings


class Diagnosis(NamedTuple):
    """``diagnoses/<unit>.json``, and the effect files of suggested formulas by their names."""

    document: dict[str, Any]
    effect_files: dict[str, str]


def diagnose_unit(
    unit: str,
    recordings: UnitRecordings,
    fits: Mapping[str, Fit],
    validation: Mapping[str, Any],
    settings: Mapping[str, Any],
) -> Diagnosis:
    """Diagnose which physical effects the models of both sensors lack."""
    filtered, known = recordings.filtered, calibrated(fits)
    noises = required_noises(recordings, settings["sensor"], known)
    document: dict[str, Any] = {"schema_version": 1, "unit": unit}
    files: dict[str, str] = {}
    for sensor, calibration in known.items():
        document[sensor] = found = calibration and diagnose(
            calibration,
            filtered,
            noises[sensor],
            settings,
            known["accelerometer"],
            validation=validation[sensor],
            gravity=document.get("accelerometer"),
            moves=validation["gravity_direction"] if sensor == "gyroscope" else None,
        )
        if calibration and found:
            other = next(c for s, c in known.items() if s != sensor)
            found["effective_noise"] = effective_noise(
                calibration, filtered, noises[sensor], settings["table"], found, other=other
            )
        if found and found.get("suggested_effect"):
            found["suggested_file"] = f"{unit}_{sensor}_unknown.yaml"
            files[found["suggested_file"]] = effect_file(found["suggested_effect"], unit)
    return Diagnosis(document, files)
