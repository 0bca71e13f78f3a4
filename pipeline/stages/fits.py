"""What stages after the fits read of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.records import SENSORS, SensorCalibration
from pipeline.stages.batch import read_json

if TYPE_CHECKING:
    from pathlib import Path


def load_fits(folders: dict[str, Path], unit: str) -> dict[str, SensorCalibration | None]:
    """Return each sensor's calibration, None for one that could not be calibrated."""
    found: dict[str, SensorCalibration | None] = {}
    for sensor in SENSORS:
        data = read_json(folders[sensor] / f"{unit}.json")
        found[sensor] = None if "not_calibrated" in data else SensorCalibration.from_json(sensor, data)
    return found
