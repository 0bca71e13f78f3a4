"""What every format needs of a calibration document."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.model.effects import effect
from pipeline.model.effects.base import Owner
from pipeline.records import SENSORS, SensorCalibration

if TYPE_CHECKING:
    from numpy.typing import NDArray

STANDARD_GRAVITY = 9.80665  # m/s^2


def calibrations(document: dict[str, Any]) -> dict[str, SensorCalibration]:
    """Return the sensors that were calibrated."""
    return {s: SensorCalibration.from_json(s, document[s]) for s in SENSORS if document.get(s)}


def missing(document: dict[str, Any]) -> list[str]:
    """Return a sentence for each sensor that was not calibrated."""
    reasons = document.get("not_calibrated") or {}
    return [f"the {s} is not calibrated: {reasons.get(s, 'no reason given')}" for s in SENSORS if not document.get(s)]


def sensor_effects(calibration: SensorCalibration) -> dict[str, NDArray[np.float64]]:
    """Return the values of the effects that belong to the sensor itself, by name."""
    return {e.name: e.values for e in calibration.effects if effect(e.name).owner == Owner.SENSOR}


def bench_effects(calibration: SensorCalibration) -> list[str]:
    """Return the effects of mounting, place, recording, table and timing, which no export carries."""
    return [e.name for e in calibration.effects if effect(e.name).owner != Owner.SENSOR]


def forward(calibration: SensorCalibration) -> NDArray[np.float64]:
    """Return K, the inverse of the calibration matrix, with ``reading = bias + K @ truth``."""
    return np.asarray(np.linalg.solve(calibration.matrix, np.eye(3)))


def final_errors(validation: dict[str, Any] | None) -> list[str]:
    """Return a sentence a sensor on the held-out error with and without effects."""
    lines = []
    for sensor in SENSORS:
        steps = ((validation or {}).get(sensor) or {}).get("steps") or []
        for step in steps:
            if step["name"] == "calibrated" or step["name"].startswith("+ "):
                unit = validation[sensor]["unit"] if validation else ""
                error = "unknown" if step["rms_error"] is None else f"{step['rms_error']:.4g} {unit}"
                lines.append(f"held-out rms error of the {sensor}, {step['name']}: {error}")
    return lines
