"""Step validate: compute the errors on held-out motion, and the noise floors."""

from __future__ import annotations

from collections.abc import Mapping

from pipeline.core.records import Fit, SensorValidation, UnitRecordings, Validation, calibrated
from pipeline.core.settings import Settings
from pipeline.estimation.noise import required_noises
from pipeline.evaluation.held_out.attitude import attitude, gravity_direction, held_out_turns
from pipeline.evaluation.held_out.samples import OTHER_SENSOR
from pipeline.evaluation.held_out.validation import validate


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
