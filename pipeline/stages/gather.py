"""Stage gather: publish every unit's files under their stable paths, and write the summary and the campaign page.

The whole set is made in a folder of its own and replaces the published one when it is complete, so that the published
files are always those of one run.
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
from pipeline.report.combined import combined_calibrations
from pipeline.report.comparison_section import section, unit_figures
from pipeline.report.fleet import fleet_statistics, unit_parameters, write_parameters
from pipeline.report.pages import failure_page
from pipeline.report.run_section import runs_data, times_of, with_history
from pipeline.report.strips import Placed, against_limits
from pipeline.report.summary import summary_row, write_summary
from pipeline.results_folder import PUBLISHED, finish_publishing, publish_all
from pipeline.stages.batch import FAILED, failure_of, record_output

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.report.parameters import Parameter
    from pipeline.stages.batch import Job

JSON = dict[str, Any]
NEW = ".new"  # folder of the new set, below the results
STAGES_BACKWARDS = ("report", "export", "diagnose", "validate", "calibration")


@dataclass
class Gathered:
    """What one unit adds to the campaign: its documents, and each file to publish with its stable path."""

    calibration: JSON
    failure: JSON | None = None
    validation: JSON | None = None
    diagnosis: JSON | None = None
    files: list[tuple[Path, str]] = field(default_factory=list)
    row: JSON = field(default_factory=dict)
    fitted: dict[str, Parameter] = field(default_factory=dict)
    placed: dict[str, Placed] = field(default_factory=dict)
    figures: list[JSON] = field(default_factory=list)


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


def _gather_unit(job: Job, batch: Path, sheet_row: dict[str, str], new: Path) -> Gathered:
    """Publish the files of one unit; one whose files cannot be gathered has failed."""
    try:
        found = _read_unit(job, batch, sheet_row)
    except Exception as error:  # noqa: BLE001  (one unit never stops the campaign)
        found = _failed_unit(batch, sheet_row, error, new)
    for source, target in found.files:
        publish(source, new / target)
    return found


def _read_unit(job: Job, batch: Path, sheet_row: dict[str, str]) -> Gathered:
    """Return what a unit adds to the campaign; nothing is written."""
    unit = sheet_row["unit"]
    failed = (batch / stage / f"{unit}{FAILED}" for stage in STAGES_BACKWARDS)
    failure = next((read_json(file) for file in failed if file.is_file()), None)
    document = batch / "report" / f"{unit}.calibration.json" if failure else batch / "calibration" / f"{unit}.json"
    found = Gathered(read_json(document), failure)
    found.files = [
        (batch / "report" / f"{unit}.html", f"reports/{unit}.html"),
        (document, f"calibrations/{unit}.json"),
    ]
    if not failure:
        files = (batch / "validate" / f"{unit}.json", batch / "diagnose" / f"{unit}.json")
        found.validation, found.diagnosis = map(read_json, files)
        found.files += zip(files, (f"validations/{unit}.json", f"diagnoses/{unit}.json"), strict=True)
        parts = [part for part in (found.diagnosis or {}).values() if isinstance(part, dict)]
        suggested = [name for part in parts if (name := part.get("suggested_file"))]
        found.files += [(batch / "diagnose" / name, f"diagnoses/{name}") for name in suggested]
        certificates = [f"certificates/{unit}.{kind}" for kind in ("json", "html", "xml")]
        if not (batch / "report" / certificates[-1]).is_file():  # where what its schema demands was not stated
            del certificates[-1]
        found.files += [(batch / "report" / name, name) for name in certificates]
        found.files += [(file, f"exports/{unit}/{file.name}") for file in sorted((batch / "export" / unit).iterdir())]
    missing = [str(source) for source, _ in found.files if not source.is_file()]
    if missing:
        raise FileNotFoundError(
            f"{missing[0]} does not exist; delete the folder above it and run the same command again"
        )
    documents = (found.calibration, found.validation, found.diagnosis)
    if any(unit in g["units"] for c in job.run["compare"] for g in c["groups"]):
        truth = Path(job.run["truths"][unit])  # behind the recordings, where they were simulated
        found.figures = unit_figures(*documents, read_json(truth) if truth.is_file() else None)
    found.fitted = unit_parameters(found.calibration)
    found.placed = against_limits(found.calibration, job.units[unit]["sensor"])
    found.row = summary_row(unit, *documents, sheet_row)
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


def _write_campaign(job: Job, units: Mapping[str, Gathered], new: Path) -> None:
    """Write the files about all units."""
    run, rows = job.run, [u.row for u in units.values()]
    fitted = {name: u.fitted for name, u in units.items()}
    failures, statistics = [u.failure for u in units.values() if u.failure], fleet_statistics(rows, fitted)
    if run["combine"]:
        joint, told = combined_calibrations(rows, {name: u.calibration for name, u in units.items()})
        statistics["combined"] = told
        for serial, document in joint.items():
            write_json(new / "combined" / f"{serial}.json", document)
    write_summary(new / "summary.csv", rows)
    write_json(new / "failures.json", failures)
    write_parameters(new / "parameters.parquet", rows, fitted)
    write_json(new / "fleet.json", statistics)
    figures = [figure for u in units.values() for figure in u.figures]
    states = {
        name: unit_state(u.calibration, u.validation, u.diagnosis, run["overrides"].get(name, {}))
        for name, u in units.items()
    }
    entries = record(job.results, states, run["run"])
    _publish_histories(new, entries)
    page = render(
        run["campaign"],
        rows,
        failures,
        [section(c, figures, f"comparison-{i}") for i, c in enumerate(run["compare"], 1)],
        run["page"],
        twins=same_files({name: u.calibration.get("inputs") or [] for name, u in units.items()}),
        statistics=statistics,
        placed={name: u.placed for name, u in units.items()},
        history=runs_data(entries, run["run"]),
        settings=run["run"],
    )
    write_atomically(new / "index.html", page)


def _publish_histories(new: Path, entries: Sequence[JSON]) -> None:
    """Add to the page of each unit that several runs have changed what they changed."""
    times = times_of(entries)
    for unit, history in of_units(entries).items():
        page = new / "reports" / f"{unit}.html"
        if len(history) > 1 and page.is_file():
            write_atomically(page, with_history(page.read_text(encoding="utf-8"), history, times))


def same_files(inputs: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[list[str]]:
    """Return the files of several units with the same content under different names.

    One file that several units are calibrated from is not reported.
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
