"""Stage report: one page a unit, those that failed included, and the calibration report of those that did not."""

from __future__ import annotations

import traceback
from typing import TYPE_CHECKING, Any

from pipeline.diagnosis.words import in_words
from pipeline.estimation.rest_means import rests_by_use
from pipeline.files import read_json, write_atomically, write_json
from pipeline.io.parquet import load_recordings
from pipeline.records import SENSORS
from pipeline.report.certificate import certificate, certificate_page
from pipeline.report.dcc import digital_certificate
from pipeline.report.pages import failure_page
from pipeline.report.recording_section import sensor_temperature
from pipeline.report.unit_page import render
from pipeline.stages.calibration import header, inputs

if TYPE_CHECKING:
    from pathlib import Path

    from pipeline.stages.batch import Job

STAGES = ("calibration", "validate", "diagnose")


def process_unit(job: Job, unit: str, settings: dict[str, Any]) -> None:
    """Write the page and the calibration report of a unit."""
    calibration, validation, diagnosis = (read_json(job.inputs[s] / f"{unit}.json") for s in STAGES)
    recordings = load_recordings(job.inputs["filter"] / f"{unit}.parquet")
    words = {sensor: in_words(diagnosis[sensor], sensor, most_values=3) for sensor in SENSORS}
    page = render(calibration, validation, diagnosis, recordings, settings, words=words)
    write_atomically(job.output / f"{unit}.html", page)
    report = certificate(calibration, validation, settings, sensor_temperature(recordings))
    write_json(job.output / "certificates" / f"{unit}.json", report)
    write_atomically(job.output / "certificates" / f"{unit}.html", certificate_page(unit, report))
    if xml := digital_certificate(unit, report):
        write_atomically(job.output / "certificates" / f"{unit}.xml", xml)


def process_failed(job: Job, unit: str, settings: dict[str, Any], failure: dict[str, Any]) -> None:
    """Write the page and the calibration document of a unit that failed."""
    document = header(unit, settings) | {"status": "failed", "error": failure, "inputs": []}
    document |= {"accelerometer": None, "gyroscope": None, "not_calibrated": {}}
    try:
        page = _page_of_failed(document, settings, job.inputs["filter"] / f"{unit}.parquet")
    except Exception:  # noqa: BLE001  (every unit has a page, whatever fails)
        traceback.print_exc()
        page = failure_page(unit, failure)
    write_json(job.output / f"{unit}.calibration.json", document)
    write_atomically(job.output / f"{unit}.html", page)


def _page_of_failed(document: dict[str, Any], settings: dict[str, Any], file: Path) -> str:
    """Add what was ingested before the failure to a unit's document, and return its page."""
    recordings = load_recordings(file) if file.is_file() else []
    if recordings:
        document["inputs"] = inputs(recordings)
        document["rests"] = rests_by_use(recordings, settings)
    return render(document, None, None, recordings, settings)
