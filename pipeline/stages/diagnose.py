"""Stage diagnose: which physical effect is missing, as far as the recordings can tell."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.atomic import write_atomically
from pipeline.diagnosis.diagnose import diagnose
from pipeline.diagnosis.guess_words import effect_file
from pipeline.io.parquet import load_recordings
from pipeline.stages.batch import parse_job, read_json, run_batch, write_json
from pipeline.stages.fits import load_fits
from pipeline.stages.noises import require_noises

if TYPE_CHECKING:
    from collections.abc import Sequence


def main(argv: Sequence[str]) -> int:
    """Run the stage."""
    job = parse_job("diagnose", argv, ["filter", "accelerometer", "gyroscope", "validate"])

    def work(unit: str, part: dict[str, Any]) -> None:
        recordings = load_recordings(job.inputs["filter"] / f"{unit}.parquet")
        document: dict[str, Any] = {"schema_version": 1, "unit": unit}
        fits = load_fits(job.inputs, unit)
        noises = require_noises(job.inputs["filter"], unit, recordings, part["sensor"], fits)
        validation = read_json(job.inputs["validate"] / f"{unit}.json")
        for sensor, calibration in fits.items():
            document[sensor] = found = calibration and diagnose(
                calibration, recordings, noises[sensor], part, fits["accelerometer"], validation=validation[sensor]
            )
            if found and found.get("suggested_effect"):
                found["suggested_file"] = suggested_file(unit, sensor)
                write_atomically(job.output / found["suggested_file"], effect_file(found["suggested_effect"], unit))
        write_json(job.output / f"{unit}.json", document)

    return run_batch(job, work)


def suggested_file(unit: str, sensor: str) -> str:
    """Return the name of the file that holds the effect which a diagnosis suggests for unknown physics."""
    return f"{unit}_{sensor}_unknown.yaml"
