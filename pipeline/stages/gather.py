"""Stage gather: publish every unit's files under their stable paths, and write the summary and the campaign page.

The whole set is made beside the published one, and takes its place when it is complete: whatever stops the stage, the
published files are those of one run.
"""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.errors import PipelineError
from pipeline.files import flushed_together, read_json, write_atomically, write_json
from pipeline.history import of_units, record, unit_state
from pipeline.report.campaign_page import render
from pipeline.report.comparison_page import section
from pipeline.report.comparison_units import unit_figures
from pipeline.report.failure_page import failure_page
from pipeline.report.fleet_statistics import fleet_statistics, parameters
from pipeline.report.fleet_table import write_parameters
from pipeline.report.history_section import runs_data, times_of, with_history
from pipeline.report.summary import summary_row, write_summary
from pipeline.results_folder import PUBLISHED, finish_publishing, publish_all
from pipeline.stages.batch import FAILED, failure_of, record_output

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.stages.batch import Job

NEW = ".new"  # the set in the making, below the results
FOLDERS = {"validate": "validations", "diagnose": "diagnoses"}


@dataclass
class Gathered:
    """What one unit adds to the campaign: its documents, and each file to publish with its stable path."""

    calibration: dict[str, Any]
    failure: dict[str, Any] | None = None
    documents: dict[str, Any] = field(default_factory=lambda: dict.fromkeys(FOLDERS))
    files: list[tuple[Path, str]] = field(default_factory=list)
    figures: Any = None
    row: dict[str, Any] = field(default_factory=dict)
    state: dict[str, Any] = field(default_factory=dict)
    fitted: dict[str, tuple[float, float | None, str]] = field(default_factory=dict)


def process_batch(job: Job) -> None:
    """Publish all units; the output, the list of failures, is written last."""
    finish_publishing(job.results)
    new = job.results / NEW
    shutil.rmtree(new, ignore_errors=True)
    for name in PUBLISHED:
        if "." not in name:
            (new / name).mkdir(parents=True)
    with flushed_together(job.results):
        batch_of = {unit: batch for batch, units in job.run["batches"].items() for unit in units}
        rows = {row["unit"]: row for row in job.run["rows"]}
        units = {u: _gather_unit(job, job.results / "batches" / batch_of[u], row, new) for u, row in rows.items()}
        _write_campaign(job, units, new)
    publish_all(new, job.results)
    record_output(job, job.results, PUBLISHED)
    write_json(job.output, [u.failure for u in units.values() if u.failure])


def _write_campaign(job: Job, units: Mapping[str, Gathered], new: Path) -> None:
    """Write what speaks of all units."""
    rows, fitted = [u.row for u in units.values()], {name: u.fitted for name, u in units.items()}
    failures = [u.failure for u in units.values() if u.failure]
    write_summary(new / "summary.csv", rows)
    write_json(new / "failures.json", failures)
    write_parameters(new / "parameters.parquet", rows, fitted)
    statistics = fleet_statistics(rows, fitted)
    write_json(new / "fleet.json", statistics)
    figures = {name: u.figures for name, u in units.items() if u.figures is not None}
    sections = [section(c, figures, f"comparison-{i}") for i, c in enumerate(job.run["compare"], 1)]
    inputs = {name: u.calibration.get("inputs") or [] for name, u in units.items()}
    entries = record(job.results, {name: u.state for name, u in units.items()}, job.run["run"])
    _publish_histories(new, entries)
    page = render(
        job.run["campaign"],
        rows,
        failures,
        sections,
        job.run["page"],
        twins=same_files(inputs),
        statistics=statistics,
        history=runs_data(entries, job.run["run"]),
        settings=job.run["run"],
    )
    write_atomically(new / "index.html", page)


def _publish_histories(new: Path, entries: Sequence[dict[str, Any]]) -> None:
    """Put into the page of each unit that several runs have changed what they changed."""
    times = times_of(entries)
    for unit, history in of_units(entries).items():
        page = new / "reports" / f"{unit}.html"
        if len(history) > 1 and page.is_file():
            write_atomically(page, with_history(page.read_text(encoding="utf-8"), history, times))


def _gather_unit(job: Job, batch: Path, sheet_row: dict[str, str], new: Path) -> Gathered:
    """Publish the files of one unit; one whose files cannot be gathered has failed."""
    try:
        found = _read_unit(job, batch, sheet_row)
    except Exception as error:  # noqa: BLE001  (one unit never stops the campaign)
        found = _failed_unit(batch, sheet_row, error, new)
    overrides = job.run["overrides"].get(sheet_row["unit"], {})
    found.state = unit_state(found.calibration, found.documents["validate"], found.documents["diagnose"], overrides)
    for source, target in found.files:
        publish(source, new / target)
    return found


def _read_unit(job: Job, batch: Path, sheet_row: dict[str, str]) -> Gathered:
    """Return what a unit adds to the campaign; nothing is written."""
    unit = sheet_row["unit"]
    failure = _failure(batch, unit)
    page = batch / "report" / f"{unit}.html"
    document = batch / "report" / f"{unit}.calibration.json" if failure else batch / "calibration" / f"{unit}.json"
    found = Gathered(read_json(document), failure)
    found.files = [(page, f"reports/{unit}.html"), (document, f"calibrations/{unit}.json")]
    if not failure:
        for stage, folder in FOLDERS.items():
            found.documents[stage] = read_json(batch / stage / f"{unit}.json")
            found.files.append((batch / stage / f"{unit}.json", f"{folder}/{unit}.json"))
        for part in found.documents["diagnose"].values():
            if isinstance(part, dict) and part.get("suggested_file"):
                name = part["suggested_file"]
                found.files.append((batch / "diagnose" / name, f"diagnoses/{name}"))
        for kind in ("json", "html"):
            name = f"{unit}.{kind}"
            found.files.append((batch / "report" / "certificates" / name, f"certificates/{name}"))
        exported = sorted((batch / "export" / unit).iterdir())
        found.files += [(file, f"exports/{unit}/{file.name}") for file in exported]
    validation, diagnosis = (found.documents[stage] for stage in FOLDERS)
    missing = [str(source) for source, _ in found.files if not source.is_file()]
    if missing:
        raise FileNotFoundError(
            f"{missing[0]} does not exist; delete the folder above it and run the same command again"
        )
    if any(unit in g["units"] for c in job.run["compare"] for g in c["groups"]):
        truth = _truth(Path(job.run["truths"][unit]))
        found.figures = unit_figures(found.calibration, validation, diagnosis, truth)
    found.fitted = parameters(found.calibration)
    found.row = summary_row(unit, found.calibration, validation, diagnosis, sheet_row)
    return found


def _failed_unit(batch: Path, sheet_row: dict[str, str], error: Exception, new: Path) -> Gathered:
    """Return a unit that fails here, its page and its document written."""
    unit = sheet_row["unit"]
    failure = failure_of(error, unit, "gather")
    keys = ("schema_version", "sensor", "table", "procedure", "method", "config_sha256", "software")
    try:
        known = read_json(batch / "calibration" / f"{unit}.json")
    except PipelineError:
        known = {}
    calibration = {key: known.get(key) for key in keys} | {"unit": unit, "status": "failed", "error": failure}
    calibration |= {"inputs": known.get("inputs") or [], "accelerometer": None, "gyroscope": None}
    write_json(new / "calibrations" / f"{unit}.json", calibration)
    write_atomically(new / "reports" / f"{unit}.html", failure_page(unit, failure))
    return Gathered(calibration, failure, row=summary_row(unit, calibration, None, None, sheet_row))


def same_files(inputs: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[list[str]]:
    """Return the files of several units that are the same, byte for byte, under different names.

    Parameters
    ----------
    inputs : mapping of str to sequence of mapping
        Unit to its inputs: ``file``, ``sha256``. One file that several units are calibrated from is meant so.
    """
    known: dict[str, dict[str, str]] = {}
    for unit, files in inputs.items():
        for file in files:
            known.setdefault(str(file["sha256"]), {}).setdefault(str(file["file"]), unit)
    return [[f"{unit}: {file}" for file, unit in found.items()] for found in known.values() if len(found) > 1]


def publish(source: Path, target: Path) -> None:
    """Give a file its stable path: a hard link, or a copy where the file system has none."""
    target.parent.mkdir(parents=True, exist_ok=True)
    target.unlink(missing_ok=True)
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)


def _truth(path: Path) -> dict[str, Any] | None:
    """Return the truth behind a unit's recordings, where they were simulated."""
    document: dict[str, Any] | None = read_json(path) if path.is_file() else None
    return document


def _failure(batch: Path, unit: str) -> dict[str, Any] | None:
    for stage in ("report", "export", "diagnose", "validate", "calibration"):
        file = batch / stage / f"{unit}{FAILED}"
        if file.is_file():
            failure: dict[str, Any] = read_json(file)
            return failure
    return None
