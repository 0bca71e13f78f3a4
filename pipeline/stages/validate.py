"""Stage validate: the error on held-out motion after each step, beside the noise floor."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.io.parquet import load_recordings
from pipeline.stages.batch import parse_job, run_batch, write_json
from pipeline.stages.fits import load_fits
from pipeline.stages.noises import require_noises
from pipeline.validation.attitude import attitude, gravity_direction
from pipeline.validation.heldout import validate

if TYPE_CHECKING:
    from collections.abc import Sequence


def main(argv: Sequence[str]) -> int:
    """Run the stage."""
    job = parse_job("validate", argv, ["filter", "accelerometer", "gyroscope"])

    def work(unit: str, part: dict[str, Any]) -> None:
        recordings = load_recordings(job.inputs["filter"] / f"{unit}.parquet")
        document: dict[str, Any] = {"schema_version": 1, "unit": unit}
        fits = load_fits(job.inputs, unit)
        noises = require_noises(job.inputs["filter"], unit, recordings, part["sensor"], fits)
        for sensor, calibration in fits.items():
            other = next(fit for s, fit in fits.items() if s != sensor)
            document[sensor] = calibration and validate(calibration, recordings, noises[sensor], part, other=other)
        document["attitude"] = attitude(fits["accelerometer"], fits["gyroscope"], recordings)
        document["gravity_direction"] = gravity_direction(
            **fits, recordings=recordings, noise=noises.get("gyroscope"), settings=part
        )
        write_json(job.output / f"{unit}.json", document)

    return run_batch(job, work)
