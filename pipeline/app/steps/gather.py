"""Stage gather: publish the files of all units, the summary and the page of the campaign.

It joins the files of the stage ``summary``, one for each batch, and reads no documents of all units. The complete set
is written to a new folder, which then replaces the published one: the published files are always from one run.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from pipeline.app.results_folder import (
    NEW_FOLDER,
    PUBLISHED_PATHS,
    finish_publishing,
    publish,
    published_units,
    record_units,
)
from pipeline.app.steps.batch import Job
from pipeline.app.steps.summary import failed_files, failed_summary
from pipeline.core import VERSION
from pipeline.core.errors import PipelineError, failure_of
from pipeline.core.files import JSON, flushed_together, read_json, write_atomically, write_json, write_new
from pipeline.core.pack import PACKED_STEPS, PACKS, WITH_PRIOR, Batch, Pack, as_bytes, batches_of, is_published
from pipeline.core.verdicts import READY, state_of
from pipeline.ingest.files import digests_in_pack
from pipeline.output.history import of_units, record
from pipeline.output.pages.campaign_page import render
from pipeline.output.pages.comparison import against_truth, section
from pipeline.output.pages.fleet import (
    fleet_statistics,
    parameter_table,
    runs_data,
    times_of,
    with_history,
    write_parameters,
    write_summary,
)
from pipeline.output.pages.parameters import Parameter


def gather_batch(job: Job) -> None:
    """Publish the files of all units, the summary and the page of the campaign.

    The output, the list of failures, is written last.
    """
    results, run = job.results, job.run
    finish_publishing(results)
    new = results / NEW_FOLDER
    shutil.rmtree(new, ignore_errors=True)
    for name in PUBLISHED_PATHS:
        if "." not in name:
            (new / name).mkdir(parents=True)
    packed = run["packed"]
    asked = asked_units(results)
    found: dict[str, JSON] = {}
    parts: list[pd.DataFrame] = []
    digests: dict[str, list[str] | None] = {}
    with flushed_together(results):
        for name, units in run["batches"].items():
            folder = job.output.parent / name
            if run["combine"] != "lot":
                (folder / f"{WITH_PRIOR}.zip").unlink(missing_ok=True)
            batch = Batch(folder)
            for unit in units:
                found[unit] = _gather_unit(batch, unit, new, publish=not packed or unit in asked)
            digests |= {unit: found[unit].pop("sha256", []) or _digests_of_failed(folder, unit) for unit in units}
            parts.append(parameter_table({unit: found[unit].pop("parameters") for unit in units}))
            for stage in (*PACKED_STEPS, *([WITH_PRIOR] if batch.combined else [])) if packed else ():
                _link(folder / f"{stage}.zip", new / PACKS / name / f"{stage}.zip")
        units = {unit: found[unit] for unit in run["order"]}
        parameters = pd.DataFrame({"unit": run["order"]}).merge(pd.concat(parts), on="unit")
        _write_campaign(job, units, parameters, new, packed=packed)
    publish(new, results, again=run.get("again", 0), keep=_without_successor(results, units))
    record_units(results, {unit: sha256 for unit in units if (sha256 := digests[unit]) is not None})
    write_json(job.output, [u["failure"] for u in units.values() if u["failure"]])


def asked_units(results: Path) -> set[str]:
    """Return the units beyond ``publish_limit`` whose files ``unpack`` has published."""
    packed = any((results / PACKS).glob("*/*"))
    return {file.stem for file in (results / "calibrations").glob("*.json")} if packed else set()


def _gather_unit(batch: Batch, unit: str, new: Path, *, publish: bool) -> JSON:
    """Publish the files of a unit and return its summary; a unit whose files cannot be read has failed."""
    found: JSON = {}
    document: JSON | None = None
    try:
        found = _shared(batch.packs["summary"].json(f"{unit}.json"))
        failure = batch.failure(unit)
        files = dict(batch.files(unit)) if publish else {}
        records = [] if failure else batch.incomplete(unit)
        found["row"]["incomplete"] = "; ".join(f"{r['stage']}: {r['message']}" for r in records) or None
    except Exception as error:  # noqa: BLE001  (one unit never stops the campaign)
        failure = failure_of(error, unit, "gather")
        document, page = failed_files(batch.packs["calibration"], unit, failure).values()
        files = {f"calibrations/{unit}.json": as_bytes(document), f"reports/{unit}.html": as_bytes(page)}
    if failure and failure != found.get("failure"):  # it failed after its summary was written
        document = document or failed_files(batch.packs["calibration"], unit, failure)[f"{unit}.calibration.json"]
        found = failed_summary(found, failure, document)
    for name, content in files.items():
        write_new(f"{new}/{name}", content)
    return found


def _digests_of_failed(batch: Path, unit: str) -> list[str] | None:
    """Return the digests of the recordings of a unit whose document states none; None where nothing states them."""
    try:
        return digests_in_pack(Pack(batch / "ingest.zip"), unit)
    except PipelineError:
        return None


def _without_successor(results: Path, units: Mapping[str, JSON]) -> set[str]:
    """Return the units and serials whose published results no new ones replace.

    They left the campaign, or were calibrated before and fail now.
    """
    before = published_units(results) | set(batches_of(results))
    failed = {u for u in units if units[u]["failure"] and is_published(results / "validations" / f"{u}.json")}
    serials = {found["row"].get("serial") for found in units.values()}
    joint = {file.stem for file in (results / "combined").glob("*.json")} - serials
    return failed | (before | joint) - set(units)


def _shared(value: Any) -> Any:  # noqa: ANN401  (a JSON value)
    """Return a JSON value in which equal texts share their memory, also with other units."""
    if isinstance(value, str):
        return sys.intern(value)
    if isinstance(value, list):
        return [_shared(v) if isinstance(v, (str, list, dict)) else v for v in value]
    return {sys.intern(k): _shared(v) for k, v in value.items()} if isinstance(value, dict) else value


def _figures(job: Job, units: Mapping[str, JSON]) -> list[JSON]:
    """Return the figures of the units for comparisons; for simulated recordings, with their errors."""
    found = []
    for unit, path in job.run["truths"].items():
        truth = read_json(Path(path)) if Path(path).is_file() else {}
        for figures in units[unit].get("figures", []):
            figures["parameters"] = {words: Parameter(*p) for words, p in figures["parameters"].items()}
            if figures["sensor"] in truth:
                figures["truth"] = against_truth(figures, truth[figures["sensor"]])
            found.append(figures)
    return found


def _statistics(job: Job, units: Mapping[str, JSON], parameters: pd.DataFrame, new: Path) -> JSON:
    """Return the statistics of the fleet; write the joint estimates."""
    rows = [u["row"] for u in units.values()]
    statistics = fleet_statistics(rows, parameters)
    if job.run["combine"] == "lot":
        from pipeline.app.steps.prior import LOTS_FILE  # noqa: PLC0415  (only where a lot is the prior)

        statistics["combined"] = Pack(job.output.parent / "lots.zip").json(LOTS_FILE)
    if job.run["combine"] == "serial":
        from pipeline.output.pages.combined import combined_calibrations  # noqa: PLC0415  (only for joint estimates)

        batch_of = {unit: name for name, own in job.run["batches"].items() for unit in own}
        joint, statistics["combined"] = combined_calibrations(
            rows, lambda unit: Batch(job.output.parent / batch_of[unit]).document("calibrations", unit)
        )
        for serial, document in joint.items():
            write_json(new / "combined" / f"{serial}.json", document)
    return statistics


def _write_campaign(job: Job, units: Mapping[str, JSON], parameters: pd.DataFrame, new: Path, *, packed: bool) -> None:
    run, rows = job.run, [u["row"] for u in units.values()]
    failures = [u["failure"] for u in units.values() if u["failure"]]
    statistics = _statistics(job, units, parameters, new)
    for row in rows:
        row["state"] = next(iter(state_of(row).kinds), READY)
    write_summary(new / "summary.csv", rows)
    write_json(new / "failures.json", failures)
    write_parameters(new / "parameters.parquet", rows, parameters)
    write_json(new / "fleet.json", statistics)
    figures = _figures(job, units) if run["compare"] else []
    entries = record(job.results, {name: u["state"] for name, u in units.items()}, run["run"], run["sections"])
    publish_histories(new, entries, units)
    page = render(
        run["campaign"],
        rows,
        failures,
        [section(c, figures, f"comparison-{i}") for i, c in enumerate(run["compare"], 1)],
        run["page"],
        twins=same_files({name: u["state"]["recordings"] for name, u in units.items()}),
        statistics=statistics,
        parameters=parameters,
        history=runs_data(entries, run["run"]),
        settings=run["run"],
        about={"run": entries[-1]["run"], "day": str(entries[-1]["time"])[:10], "version": VERSION},
        published={page.stem for page in (new / "reports").glob("*.html")} if packed else None,
    )
    write_atomically(new / "index.html", page)


def publish_histories(new: Path, entries: Sequence[JSON], units: Iterable[str]) -> None:
    """Add the history to the page of each unit that several runs have changed."""
    times = times_of(entries)
    states = of_units(entries)
    for unit in units:
        history, page = states.get(unit, []), new / "reports" / f"{unit}.html"
        if len(history) > 1 and page.is_file():
            write_atomically(page, with_history(page.read_text(encoding="utf-8"), history, times))


def same_files(recordings: Mapping[str, Mapping[str, str]]) -> list[tuple[list[str], list[list[str]]]]:
    """Return groups of units that have files with the same content under different names, and these files.

    ``recordings``: unit to its files, each with a digest. Of the units that use a file under one name, the first.
    """
    first: dict[str, tuple[str, str]] = {}
    same: dict[str, dict[str, str]] = {}
    for unit, files in recordings.items():
        for file, digest in files.items():
            known, owner = first.setdefault(digest, (file, unit))
            if known != file:
                same.setdefault(digest, {known: owner}).setdefault(file, unit)
    shared: dict[tuple[str, ...], list[list[str]]] = {}
    for found in same.values():
        shared.setdefault(tuple(dict.fromkeys(found.values())), []).append(list(found))
    return [(list(units), files) for units, files in shared.items()]


def _link(source: Path, target: Path) -> None:
    """Publish a pack by a hard link, or by a copy if the file system has no links."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
