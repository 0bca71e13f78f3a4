"""Step validate: compute the errors on held-out motion, and the noise floors."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.estimation.noise import required_noises
from pipeline.records import SCHEMA_VERSION, calibrated
from pipeline.validation.attitude import attitude, gravity_direction
from pipeline.validation.heldout import validate

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pipeline.records import Fit, UnitRecordings
    from pipeline.settings import Settings


def held_out_document(
    unit: str, recordings: UnitRecordings, fits: Mapping[str, Fit], settings: Settings
) -> dict[str, Any]:
    """Return ``validations/<unit>.json``: the errors on held-out motion after each step of both fits."""
    filtered, found = recordings.filtered, calibrated(fits)
    document: dict[str, Any] = {"schema_version": SCHEMA_VERSION, "unit": unit} | held_out_errors(
        recordings, fits, settings
    )
    document["attitude"] = attitude(found["accelerometer"], found["gyroscope"], filtered)
    document["gravity_direction"] = gravity_direction(
        **found, recordings=filtered, noise=recordings.noises.get("gyroscope"), settings=settings
    )
    return document


def held_out_errors(recordings: UnitRecordings, fits: Mapping[str, Fit], settings: Settings) -> dict[str, Any]:
    """Return the part of each sensor in ``validations/<unit>.json``; None for a sensor without a calibration."""
    known = calibrated(fits)
    noises = required_noises(recordings, settings.sensor, known)
    found = {}
    for sensor, calibration in known.items():
        other = next(c for s, c in known.items() if s != sensor)
        found[sensor] = calibration and validate(
            calibration, recordings.filtered, noises[sensor], settings, other=other
        )
    return found
