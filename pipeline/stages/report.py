"""Stage report: one page a unit, those that failed included, and the calibration report of those that did not."""

from __future__ import annotations

import traceback
from typing import TYPE_CHECKING, Any

from pipeline.atomic import write_atomically
from pipeline.diagnosis.words import in_words
from pipeline.estimation.rest_means import rests_by_use
from pipeline.io.parquet import load_recordings
from pipeline.records import SENSORS
from pipeline.report import certificate_page
from pipeline.report.certificate import certificate
from pipeline.report.failure_page import failure_page
from pipeline.report.session import sensor_temperature
from pipeline.report.unit_page import render
from pipeline.stages.batch import parse_job, read_json, run_batch, write_json
from pipeline.stages.calibration import header, inputs

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

STAGES = ("calibration", "validate", "diagnose")


def main(argv: Sequence[str]) -> int:
    """Run the stage."""
    job = parse_job("report", argv, ["filter", *STAGES, "export"])

    def work(unit: str, part: dict[str, Any]) -> None:
        calibration, validation, diagnosis = (read_json(job.inputs[s] / f"{unit}.json") for s in STAGES)
        recordings = load_recordings(job.inputs["filter"] / f"{unit}.parquet")
        words = {sensor: in_words(diagnosis[sensor], sensor) for sensor in SENSORS}
        page = render(calibration, validation, diagnosis, recordings, part, words=words)
        write_atomically(job.output / f"{unit}.html", page)
        report = certificate(calibration, validation, part, sensor_temperature(recordings))
        write_json(job.output / "certificates" / f"{unit}.json", report)
        write_atomically(job.output / "certificates" / f"{unit}.html", certificate_page.render(unit, report))

    def of_failed(unit: str, part: dict[str, Any], failure: dict[str, Any]) -> None:
        document = header(unit, part) | {"status": "failed", "error": failure, "inputs": []}
        document |= {"accelerometer": None, "gyroscope": None, "not_calibrated": {}}
        try:
            page = _page_of_failed(document, part, job.inputs["filter"] / f"{unit}.parquet")
        except Exception:  # noqa: BLE001  (every unit has a page, whatever fails)
            traceback.print_exc()
            page = failure_page(unit, failure)
        write_json(job.output / f"{unit}.calibration.json", document)
        write_atomically(job.output / f"{unit}.html", page)

    (job.output / "certificates").mkdir(parents=True, exist_ok=True)
    return run_batch(job, work, of_failed)


def _page_of_failed(document: dict[str, Any], part: dict[str, Any], file: Path) -> str:
    """Put into the document of a unit what was ingested before it failed, and return its page."""
    recordings = load_recordings(file) if file.is_file() else []
    if recordings:
        document["inputs"] = inputs(file)
        document["rests"] = rests_by_use(recordings, part)
    return render(document, None, None, recordings, part)
