"""Step filter: filter the readings of every recording as configured, and estimate their noise once for all steps."""

from __future__ import annotations

from pipeline.core.records import Recording, UnitRecordings
from pipeline.core.settings import Settings
from pipeline.estimation.noise import with_noises
from pipeline.physics.signal.filters import apply_filter


def filter_recordings(checked: list[Recording], settings: Settings) -> UnitRecordings:
    """Filter the recordings of a unit, and estimate the noise of each sensor."""
    filtered = checked
    if settings.filter.name != "none":
        filtered = [apply_filter(recording, settings.filter) for recording in checked]
    return with_noises(filtered, settings.sensor)
