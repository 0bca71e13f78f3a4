"""Stage report: one page a unit, those that failed included, and the calibration report of those that did not."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.atomic import write_atomically
from pipeline.diagnosis.words import in_words
from pipeline.estimation.rest_means import rests_by_use
from pipeline.formats.parquet import load_recordings
from pipeline.records import SENSORS
from pipeline.report import certificate_page
from pipeline.report.certificate import certificate
from pipeline.report.session import sensor_temperature
from pipeline.report.unit_page import render
from pipeline.stages.batch import FAILED, parse_job, read_json, run_batch, write_json
from pipeline.stages.calibration import header, inputs

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from pipeline.records import Recording

STAGES = ("calibration", "validate", "diagnose")


def main(argv: Sequence[str]) -> int:
    """Run the stage."""
    job = parse_job("report", argv, ["filter", *STAGES])

    def work(unit: str, part: dict[str, Any]) -> None:
        calibration, validation, diagnosis = (read_json(job.inputs[s] / f"{unit}.json") for s in STAGES)
        recordings = load_recordings(job.inputs["filter"] / f"{unit}.parquet")
        words = {sensor: in_words(diagnosis[sensor], sensor) for sensor in SENSORS}
        page = render(calibration, validation, diagnosis, recordings, part, words=words)
        write_atomically(job.output / f"{unit}.html", page)
        report = certificate(calibration, validation, part, sensor_temperature(recordings))
        write_json(job.output / "certificates" / f"{unit}.json", report)
        write_atomically(job.output / "certificates" / f"{unit}.html", certificate_page.render(unit, report))

    (job.output / "certificates").mkdir(parents=True, exist_ok=True)
    status = run_batch(job, work)
    for unit, part in job.units.items():
        failed = job.output / f"{unit}{FAILED}"
        if failed.is_file():
            document = header(unit, part) | {"status": "failed", "error": read_json(failed), "inputs": []}
            document |= {"accelerometer": None, "gyroscope": None, "not_calibrated": {}}
            recordings = _ingested(job.inputs["filter"] / f"{unit}.parquet")
            if recordings:
                document["inputs"] = inputs(job.inputs["filter"] / f"{unit}.parquet")
                document["rests"] = rests_by_use(recordings, part)
            write_json(job.output / f"{unit}.calibration.json", document)
            write_atomically(job.output / f"{unit}.html", render(document, None, None, recordings, part))
    return status


def _ingested(path: Path) -> list[Recording]:
    """Return the recordings of a unit that failed after them; none where it failed before."""
    return load_recordings(path) if path.is_file() else []
