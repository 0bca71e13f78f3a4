"""Stage validate: the error on held-out motion after each step, beside the noise floor."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.stages.unit_files import load_fits, recordings_of, require_noises
from pipeline.validation.attitude import attitude, gravity_direction
from pipeline.validation.heldout import validate

if TYPE_CHECKING:
    from pipeline.pack import Files
    from pipeline.stages.batch import Job


def process_unit(job: Job, unit: str, settings: dict[str, Any]) -> Files:
    """Validate both sensors, and the attitude that they give together."""
    recordings = recordings_of(job.inputs, unit)
    fits = load_fits(job.inputs, unit)
    noises = require_noises(job.inputs["filter"], unit, recordings, settings["sensor"], fits)
    document: dict[str, Any] = {"schema_version": 1, "unit": unit}
    for sensor, calibration in fits.items():
        other = next(fit for s, fit in fits.items() if s != sensor)
        document[sensor] = calibration and validate(calibration, recordings, noises[sensor], settings, other=other)
    document["attitude"] = attitude(fits["accelerometer"], fits["gyroscope"], recordings)
    document["gravity_direction"] = gravity_direction(
        **fits, recordings=recordings, noise=noises.get("gyroscope"), settings=settings
    )
    return {f"{unit}.json": document}
