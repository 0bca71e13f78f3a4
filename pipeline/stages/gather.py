"""Stage gather: publish every unit's files under their stable paths, and write the summary and the campaign page."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.atomic import write_atomically
from pipeline.history import of_units, record, unit_state
from pipeline.report.campaign_page import render
from pipeline.report.comparison_page import section
from pipeline.report.comparison_units import unit_figures
from pipeline.report.fleet_statistics import fleet_statistics, parameters
from pipeline.report.fleet_table import write_parameters
from pipeline.report.history_section import runs_data, times_of, with_history
from pipeline.report.summary import summary_row, write_summary
from pipeline.stages.batch import FAILED, parse_job, read_json, write_json

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

PUBLISHED = {"validate": "validations", "diagnose": "diagnoses"}


def main(argv: Sequence[str]) -> int:
    """Run the stage; ``--output`` is the campaign's results, ``--batches`` the folder of the batches concerned."""
    job = parse_job("gather", argv, [], ["batches"])
    of_unit = {unit: Path(folder) for folder in job.run["batches"].split(",") for unit in _units(Path(folder))}
    for name in ("calibrations", "validations", "diagnoses", "reports", "certificates", "exports"):
        shutil.rmtree(job.output / name, ignore_errors=True)
        (job.output / name).mkdir(parents=True)
    compared = {u for c in job.run["compare"] for g in c["groups"] for u in g["units"]}
    rows, failures, figures = [], [], {}
    inputs: dict[str, list[dict[str, Any]]] = {}
    fitted: dict[str, dict[str, tuple[float, float | None, str]]] = {}
    states: dict[str, dict[str, Any]] = {}
    for sheet_row in job.run["rows"]:
        unit = sheet_row["unit"]
        batch = of_unit[unit]
        failure = _failure(batch, unit)
        publish(batch / "report" / f"{unit}.html", job.output / "reports" / f"{unit}.html")
        documents: dict[str, Any] = {"validate": None, "diagnose": None}
        if failure:
            failures.append(failure)
            document = batch / "report" / f"{unit}.calibration.json"
            calibration = read_json(document)
            publish(document, job.output / "calibrations" / f"{unit}.json")
        else:
            calibration = read_json(batch / "calibration" / f"{unit}.json")
            publish(batch / "calibration" / f"{unit}.json", job.output / "calibrations" / f"{unit}.json")
            for stage, folder in PUBLISHED.items():
                documents[stage] = read_json(batch / stage / f"{unit}.json")
                publish(batch / stage / f"{unit}.json", job.output / folder / f"{unit}.json")
            for part in documents["diagnose"].values():
                if isinstance(part, dict) and part.get("suggested_file"):
                    name = part["suggested_file"]
                    publish(batch / "diagnose" / name, job.output / "diagnoses" / name)
            for kind in ("json", "html"):
                name = f"{unit}.{kind}"
                publish(batch / "report" / "certificates" / name, job.output / "certificates" / name)
            for file in sorted((batch / "export" / unit).iterdir()):
                publish(file, job.output / "exports" / unit / file.name)
        if unit in compared:
            truth = _truth(Path(job.run["truths"][unit]))
            figures[unit] = unit_figures(calibration, documents["validate"], documents["diagnose"], truth)
        overrides = job.run["overrides"].get(unit, {})
        states[unit] = unit_state(calibration, documents["validate"], documents["diagnose"], overrides)
        inputs[unit] = calibration.get("inputs") or []
        fitted[unit] = parameters(calibration)
        rows.append(summary_row(unit, calibration, documents["validate"], documents["diagnose"], sheet_row))
    write_summary(job.output / "summary.csv", rows)
    write_json(job.output / "failures.json", failures)
    write_parameters(job.output / "parameters.parquet", rows, fitted)
    entries = record(job.output, states, job.run["run"])
    _publish_histories(job.output, entries)
    statistics = fleet_statistics(rows, fitted)
    write_json(job.output / "fleet.json", statistics)
    sections = [section(c, figures, f"comparison-{i}") for i, c in enumerate(job.run["compare"], 1)]
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
    write_atomically(job.output / "index.html", page)
    return 0


def _publish_histories(results: Path, entries: Sequence[dict[str, Any]]) -> None:
    """Put into the page of each unit that several runs have changed what they changed."""
    times = times_of(entries)
    for unit, history in of_units(entries).items():
        page = results / "reports" / f"{unit}.html"
        if len(history) > 1 and page.is_file():
            write_atomically(page, with_history(page.read_text(encoding="utf-8"), history, times))


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


def _units(batch: Path) -> list[str]:
    return [f.stem for f in (batch / "report").glob("*.html")]


def _failure(batch: Path, unit: str) -> dict[str, Any] | None:
    for stage in ("report", "export", "diagnose", "validate", "calibration"):
        file = batch / stage / f"{unit}{FAILED}"
        if file.is_file():
            failure: dict[str, Any] = read_json(file)
            return failure
    return None
