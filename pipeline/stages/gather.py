"""Stage gather: every unit's files under their stable paths, the summary and the page of the campaign.

The whole set is made in a folder of its own and replaces the published one when it is complete, so that the published
files are always those of one run.
"""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.errors import DamagedFileError, PipelineError
from pipeline.exports import exports
from pipeline.files import flushed_together, read_json, write_atomically, write_json
from pipeline.history import of_units, record, unit_state
from pipeline.pack import DOCUMENTS, PACKS, STAGES, WITH_PRIOR, Batch, Files, as_bytes, new_pack
from pipeline.records import SENSORS
from pipeline.report.campaign_page import Placed, against_limits, render
from pipeline.report.combined import combined_calibrations
from pipeline.report.comparison_section import section, unit_figures
from pipeline.report.fleet import fleet_statistics, summary_row, unit_parameters, write_parameters, write_summary
from pipeline.report.lot import Prior, calibration_with_prior, estimates, priors_of, with_card
from pipeline.report.pages import failure_page
from pipeline.report.run_section import runs_data, times_of, with_history
from pipeline.results_folder import PUBLISHED, finish_publishing, publish_all
from pipeline.stages.batch import Job, failure_of, record_output

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from pipeline.report.parameters import Parameter

JSON = dict[str, Any]
NEW = ".new"  # folder of the new set, below the results


@dataclass
class Gathered:
    """What one unit adds to the files about all units."""

    row: JSON
    failure: JSON | None = None
    state: JSON = field(default_factory=dict)
    inputs: list[tuple[str, str]] = field(default_factory=list)  # file and SHA-256
    calibration: JSON | None = None  # where a joint estimate is asked for
    fitted: dict[str, Parameter] = field(default_factory=dict)
    placed: dict[str, Placed] = field(default_factory=dict)
    figures: list[JSON] = field(default_factory=list)


def gather_batch(job: Job) -> None:
    """Publish the files of all units, the summary and the page of the campaign.

    The output, the list of failures, is written last.
    """
    results = job.results
    finish_publishing(results)
    new = results / NEW
    shutil.rmtree(new, ignore_errors=True)
    for name in PUBLISHED:
        if "." not in name:
            (new / name).mkdir(parents=True)
    packed = len(job.run["rows"]) > job.run["publish_limit"]
    known = (results / "calibrations").glob("*.json") if any((results / PACKS).glob("*")) else ()
    asked = {file.stem for file in known}  # by ``unpack``
    with flushed_together(results):
        rows = {row["unit"]: row for row in job.run["rows"]}
        gathered = {}
        told = _with_lots(job, rows)
        for name, units in job.run["batches"].items():
            folder = job.output.parent / name
            batch = Batch(folder)
            for unit in units:
                gathered[unit] = _gather_unit(job, batch, rows[unit], new, publish=not packed or unit in asked)
            for stage in (*STAGES, *([WITH_PRIOR] if told else [])) if packed else ():
                _link(folder / f"{stage}.zip", new / PACKS / name / f"{stage}.zip")
        units = {unit: gathered[unit] for unit in rows}
        _write_campaign(job, units, new, told, packed=packed)
    publish_all(new, results)
    record_output(job, results, PUBLISHED)
    write_json(job.output, [u.failure for u in units.values() if u.failure])


def _with_lots(job: Job, rows: Mapping[str, dict[str, str]]) -> list[JSON]:
    """Write what the priors of the lots change, ``combined.zip`` of each batch; return what ``fleet.json`` tells."""
    if job.run["combine"] != "lot":
        for name in job.run["batches"]:
            (job.output.parent / name / f"{WITH_PRIOR}.zip").unlink(missing_ok=True)
        return []
    batches = {name: Batch(job.output.parent / name) for name in job.run["batches"]}
    found = []
    for name, units in job.run["batches"].items():
        for unit in units:
            with suppress(DamagedFileError):  # the unit fails where its files are published
                if not batches[name].failure(unit):
                    documents = (batches[name].document(of, unit) for of in ("calibrations", "diagnoses"))
                    found += estimates(rows[unit], *documents)
    priors, told = priors_of(found)
    for name, units in job.run["batches"].items():
        with new_pack(job.output.parent / name / f"{WITH_PRIOR}.zip") as add:
            for unit in units:
                if own := {s: priors[unit, s] for s in SENSORS if (unit, s) in priors}:
                    files = _files_with_prior(job, batches[name], unit, own)
                    add({f"{unit}/{path}": as_bytes(content) for path, content in files.items()})
    return told


def _files_with_prior(job: Job, batch: Batch, unit: str, priors: Mapping[str, Prior]) -> Files:
    """Return the files of a unit that its priors add or change."""
    calibration, validation, diagnosis = (batch.document(folder, unit) for folder in DOCUMENTS)
    document = calibration_with_prior(calibration, priors)
    page = batch.packs["report"].read(f"{unit}.html").decode()
    files: Files = {f"reports/{unit}.html": with_card(page, calibration, document, priors)}
    if document:
        files[f"combined/{unit}.json"] = document
        written = exports(document, job.units[unit], validation, diagnosis)
        files |= {f"exports/{unit}/{file}": text for file, text in written.items()}
    return files


def _gather_unit(job: Job, batch: Batch, row: dict[str, str], new: Path, *, publish: bool) -> Gathered:
    """Publish the files of one unit; one whose files cannot be gathered has failed."""
    try:
        found = _read_unit(job, batch, row)
        files = dict(batch.files(row["unit"])) if publish else {}
    except Exception as error:  # noqa: BLE001  (one unit never stops the campaign)
        return _failed_unit(job, batch, row, error, new)
    for name, content in files.items():
        write_atomically(new / name, content)
    return found


def _read_unit(job: Job, batch: Batch, row: dict[str, str]) -> Gathered:
    """Return what a unit adds to the campaign."""
    unit, failure = row["unit"], batch.failure(row["unit"])
    calibration = batch.document("calibrations", unit)
    validation, diagnosis = (None if failure else batch.document(name, unit) for name in ("validations", "diagnoses"))
    found = _gathered(job, row, failure, (calibration, validation, diagnosis))
    if any(unit in g["units"] for c in job.run["compare"] for g in c["groups"]):
        truth = Path(job.run["truths"][unit])  # behind the recordings, where they were simulated
        known = read_json(truth) if truth.is_file() else None
        found.figures = unit_figures(calibration, validation, diagnosis, known)
    found.fitted = unit_parameters(calibration)
    found.placed = against_limits(calibration, job.units[unit]["sensor"])
    return found


def _gathered(
    job: Job,
    row: dict[str, str],
    failure: JSON | None,
    documents: tuple[JSON, JSON | None, JSON | None],
) -> Gathered:
    unit, (calibration, validation, diagnosis) = row["unit"], documents
    return Gathered(
        summary_row(unit, calibration, validation, diagnosis, row),
        failure,
        unit_state(calibration, validation, diagnosis, job.run["overrides"].get(unit, {}), job.units[unit]["config"]),
        [(file["file"], file["sha256"]) for file in calibration.get("inputs") or []],
        calibration if job.run["combine"] == "serial" else None,
    )


def _failed_unit(job: Job, batch: Batch, row: dict[str, str], error: Exception, new: Path) -> Gathered:
    """Return a unit that fails here, its page and its document written."""
    unit = row["unit"]
    failure = failure_of(error, unit, "gather")
    keys = ("schema_version", "sensor", "table", "procedure", "method", "config_sha256", "software")
    try:
        known = batch.packs["calibration"].json(f"{unit}.json")
    except PipelineError:
        known = {}
    calibration = {key: known.get(key) for key in keys} | {"unit": unit, "status": "failed", "error": failure}
    calibration |= {"inputs": known.get("inputs") or [], "accelerometer": None, "gyroscope": None}
    write_json(new / "calibrations" / f"{unit}.json", calibration)
    write_atomically(new / "reports" / f"{unit}.html", failure_page(unit, failure))
    return _gathered(job, row, failure, (calibration, None, None))


def _write_campaign(job: Job, units: Mapping[str, Gathered], new: Path, lots: list[JSON], *, packed: bool) -> None:
    """Write the files about all units; ``lots``: what ``fleet.json`` tells of their priors."""
    run, rows = job.run, [u.row for u in units.values()]
    fitted = {name: u.fitted for name, u in units.items()}
    failures, statistics = [u.failure for u in units.values() if u.failure], fleet_statistics(rows, fitted)
    if lots:
        statistics["combined"] = lots
    if run["combine"] == "serial":
        joint, told = combined_calibrations(rows, {name: u.calibration for name, u in units.items() if u.calibration})
        statistics["combined"] = told
        for serial, document in joint.items():
            write_json(new / "combined" / f"{serial}.json", document)
    write_summary(new / "summary.csv", rows)
    write_json(new / "failures.json", failures)
    write_parameters(new / "parameters.parquet", rows, fitted)
    write_json(new / "fleet.json", statistics)
    figures = [figure for u in units.values() for figure in u.figures]
    entries = record(job.results, {name: u.state for name, u in units.items()}, run["run"], run["sections"])
    publish_histories(new, entries, units)
    page = render(
        run["campaign"],
        rows,
        failures,
        [section(c, figures, f"comparison-{i}") for i, c in enumerate(run["compare"], 1)],
        run["page"],
        twins=same_files({name: u.inputs for name, u in units.items()}),
        statistics=statistics,
        placed={name: u.placed for name, u in units.items()},
        history=runs_data(entries, run["run"]),
        settings=run["run"],
        published={page.stem for page in (new / "reports").glob("*.html")} if packed else None,
    )
    write_atomically(new / "index.html", page)


def publish_histories(new: Path, entries: Sequence[JSON], units: Iterable[str]) -> None:
    """Add to the page of each unit that several runs have changed what they changed."""
    times = times_of(entries)
    states = of_units(entries)
    for unit in units:
        history, page = states.get(unit, []), new / "reports" / f"{unit}.html"
        if len(history) > 1 and page.is_file():
            write_atomically(page, with_history(page.read_text(encoding="utf-8"), history, times))


def same_files(inputs: Mapping[str, Sequence[tuple[str, str]]]) -> list[list[str]]:
    """Return the files of several units with the same content under different names.

    ``inputs``: unit to its files, each with its SHA-256. One file that several units are calibrated from is not
    reported.
    """
    first: dict[str, tuple[str, str]] = {}
    same: dict[str, dict[str, str]] = {}
    for unit, files in inputs.items():
        for file, digest in files:
            known, owner = first.setdefault(digest, (file, unit))
            if known != file:
                same.setdefault(digest, {known: owner}).setdefault(file, unit)
    return [[f"{unit}: {file}" for file, unit in found.items()] for found in same.values()]


def _link(source: Path, target: Path) -> None:
    """Publish a pack: a hard link, or a copy where the file system has none."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
