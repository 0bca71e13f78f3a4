"""Step report: render the page of each unit, also of failed units, and the calibration report of the others."""

from __future__ import annotations

import traceback
from typing import TYPE_CHECKING, Any

from pipeline.app.steps.calibration import header, inputs
from pipeline.app.steps.unit_files import recordings_of
from pipeline.core.pack import Files
from pipeline.core.records import SENSORS, UnitRecordings
from pipeline.core.settings import Settings
from pipeline.estimation.rest_means import rests_by_use
from pipeline.evaluation.diagnosis.words import in_words
from pipeline.output.pages.certificate import certificate, certificate_page, digital_certificate
from pipeline.output.pages.pages import failure_page
from pipeline.output.pages.unit_page import render, sensor_temperature

if TYPE_CHECKING:
    from pipeline.app.steps.batch import Job


def report(
    *,
    recordings: UnitRecordings,
    calibration: dict[str, Any],
    validation: dict[str, Any],
    diagnosis: dict[str, Any],
    omissions: list[dict[str, Any]],
    settings: Settings,
) -> Files:
    """Return the page and the calibration report (certificate) of a unit, by their names below ``reports``.

    ``omissions``: records of what earlier steps could not make; the page states them.
    """
    unit, filtered = calibration["unit"], recordings.filtered
    words = {sensor: in_words(diagnosis[sensor], sensor, most_values=3) for sensor in SENSORS}
    page = render(calibration, validation, diagnosis, filtered, settings, words=words, incomplete=omissions)
    document = certificate(calibration, validation, settings, sensor_temperature(filtered), diagnosis)
    kinds = {"json": document, "html": certificate_page(unit, document), "xml": digital_certificate(document)}
    return {f"{unit}.html": page} | {f"certificates/{unit}.{kind}": made for kind, made in kinds.items() if made}


def report_without(job: Job, unit: str, settings: Settings, record: dict[str, Any]) -> Files:  # noqa: ARG001
    """Return a page that states why the page of a calibrated unit could not be made."""
    return {f"{unit}.html": failure_page(unit, record, calibrated=True)}


def report_failed(job: Job, unit: str, settings: Settings, failure: dict[str, Any]) -> Files:
    """Return the page and the calibration document of a unit that failed."""
    document = header(unit, settings) | {"status": "failed", "error": failure, "inputs": []}
    document |= {"accelerometer": None, "gyroscope": None, "not_calibrated": {}}
    try:
        page = _page_of_failed(job, document, settings)
    except Exception:  # noqa: BLE001  (every unit has a page, whatever fails)
        traceback.print_exc()
        page = failure_page(unit, failure)
    return {f"{unit}.calibration.json": document, f"{unit}.html": page}


def _page_of_failed(job: Job, document: dict[str, Any], settings: Settings) -> str:
    """Add the recordings that were read before the failure to a unit's document, and return its page."""
    unit = document["unit"]
    recordings = recordings_of(job.inputs, unit) if f"{unit}.noise.json" in job.inputs["filter"] else []
    if recordings:
        document["inputs"] = inputs(recordings)
        document["rests"] = rests_by_use(recordings, settings.procedure)
    return render(document, None, None, recordings, settings)
