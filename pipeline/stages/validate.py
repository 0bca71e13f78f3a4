"""Stage validate: the errors on held-out motion, and the noise floors."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.stages.unit_files import load_fits, recordings_of, require_noises
from pipeline.validation.attitude import attitude, gravity_direction
from pipeline.validation.heldout import validate

if TYPE_CHECKING:
    from pipeline.pack import Files
    from pipeline.stages.batch import Job


def validate_unit(job: Job, unit: str, settings: dict[str, Any]) -> Files:
    """Compute the errors on held-out motion after each step of both fits, and the noise floors."""
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
