"""Stage validate: compute the errors on held-out motion, and the noise floors."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.records import SCHEMA_VERSION
from pipeline.stages.unit_files import load_fits, recordings_of, require_noises
from pipeline.validation.attitude import attitude, gravity_direction
from pipeline.validation.heldout import validate

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.pack import Files
    from pipeline.records import Noise, Recording, SensorCalibration
    from pipeline.stages.batch import Job


def validate_unit(job: Job, unit: str, settings: dict[str, Any]) -> Files:
    """Compute the errors on held-out motion after each step of both fits, and the noise floors."""
    recordings = recordings_of(job.inputs, unit)
    fits = load_fits(job.inputs, unit)
    noises = require_noises(job.inputs["filter"], unit, recordings, settings["sensor"], fits)
    document: dict[str, Any] = {"schema_version": SCHEMA_VERSION, "unit": unit}
    document |= held_out(fits, recordings, noises, settings)
    document["attitude"] = attitude(fits["accelerometer"], fits["gyroscope"], recordings)
    document["gravity_direction"] = gravity_direction(
        **fits, recordings=recordings, noise=noises.get("gyroscope"), settings=settings
    )
    return {f"{unit}.json": document}


def held_out(
    fits: Mapping[str, SensorCalibration | None],
    recordings: Sequence[Recording],
    noises: Mapping[str, Noise],
    settings: dict[str, Any],
) -> dict[str, Any]:
    """Return the part of each sensor in ``validations/<unit>.json``; None for a sensor without a fit."""
    found = {}
    for sensor, fit in fits.items():
        other = next(f for s, f in fits.items() if s != sensor)
        found[sensor] = fit and validate(fit, recordings, noises[sensor], settings, other=other)
    return found
