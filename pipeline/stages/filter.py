"""Step filter: filter the readings of every recording as configured, and estimate their noise once for all steps."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.estimation.noise import noise_of
from pipeline.records import SENSORS, Recording, UnitRecordings
from pipeline.signal.filters import apply_filter

if TYPE_CHECKING:
    from pipeline.settings import Settings


def filter_recordings(checked: list[Recording], settings: Settings) -> UnitRecordings:
    """Filter the recordings of a unit, and estimate the noise of each sensor."""
    filtered = checked
    if settings.filter.name != "none":
        filtered = [apply_filter(recording, settings.filter) for recording in checked]
    return UnitRecordings(filtered, {sensor: noise_of(sensor, filtered, settings) for sensor in SENSORS})
