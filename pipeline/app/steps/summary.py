"""Step summary: compute the part of each unit in the files that summarise all units.

``gather`` joins the outputs of this stage, and reads no calibration, validation or diagnosis.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.core.errors import PipelineError
from pipeline.core.files import JSON
from pipeline.core.pack import Files, Pack
from pipeline.core.settings import Sensor, Settings, Stated
from pipeline.ingest.files import digests_of_entries
from pipeline.output.history import unit_state
from pipeline.output.pages.pages import failure_page
from pipeline.output.pages.parameters import sheet_columns, summary_row, unit_parameters

if TYPE_CHECKING:
    from pipeline.app.steps.batch import Job

KEPT = ("schema_version", "sensor", "table", "procedure", "method", "config_sha256", "software")


def summarise(calibration: JSON, validation: JSON, diagnosis: JSON, settings: Settings) -> JSON:
    """Return the summary of a calibrated unit."""
    found = summary(settings.stated, settings.sensor, None, calibration, validation=validation, diagnosis=diagnosis)
    if settings.stated.compared:
        from pipeline.output.pages.comparison import unit_figures  # noqa: PLC0415  (pandas, where units are compared)

        found["figures"] = unit_figures(calibration, validation, diagnosis)
    if settings.stated.lot_prior:
        from pipeline.output.pages.combined import estimates  # noqa: PLC0415  (only where a lot is the prior)

        found["estimates"] = [e._asdict() for e in estimates(settings.stated.row, calibration, diagnosis)]
    return found


def summary_without(job: Job, unit: str, settings: Settings, record: JSON) -> Files:  # noqa: ARG001
    """Return the summary of a calibrated unit whose documents could not be summarised."""
    return {f"{unit}.json": summary(settings.stated, settings.sensor, None, {"unit": unit, "status": "ok"})}


def summary_failed(job: Job, unit: str, settings: Settings, failure: JSON) -> Files:
    """Return the summary of a failed unit; for one that fails in this stage, with its document and its page."""
    name, report, files = f"{unit}.calibration.json", job.inputs["report"], {}
    try:
        calibration = report.json(name)
    except PipelineError:
        files = failed_files(job.inputs["calibration"], unit, failure)
        calibration = files[name]
    return {f"{unit}.json": summary(settings.stated, settings.sensor, failure, calibration), **files}


def summary(
    stated: Stated,
    sensor: Sensor | None,
    failure: JSON | None,
    calibration: JSON,
    *,
    validation: JSON | None = None,
    diagnosis: JSON | None = None,
) -> JSON:
    """Return the part of a summary that failed units also have; ``sensor`` is None where it is not known."""
    documents = calibration, validation, diagnosis
    return {
        "row": summary_row(calibration["unit"], *documents, stated.row),
        "failure": failure,
        "state": unit_state(*documents, stated.overrides, stated.sections),
        "parameters": [] if sensor is None else unit_parameters(calibration, sensor),
        "sha256": digests_of_entries(calibration.get("inputs") or ()),
    }


def failed_files(calibrations: Pack, unit: str, failure: JSON) -> Files:
    """Return the calibration document and the page of a unit that fails after its report."""
    try:
        known = calibrations.json(f"{unit}.json")
    except PipelineError:
        known = {}
    document = {key: known.get(key) for key in KEPT} | {"unit": unit, "status": "failed", "error": failure}
    document |= {"inputs": known.get("inputs") or [], "accelerometer": None, "gyroscope": None}
    return {f"{unit}.calibration.json": document, f"{unit}.html": failure_page(unit, failure)}


def failed_summary(found: JSON, failure: JSON, document: JSON) -> JSON:
    """Return the summary of a unit that fails after its first summary, ``found``."""
    state = found.get("state", {})
    stated = Stated(
        row=sheet_columns(found.get("row", {})), overrides=state.get("overrides", {}), sections=state.get("config", {})
    )
    return summary(stated, None, failure, document)
