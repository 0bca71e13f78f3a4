"""Runs without computations: the files that a run writes, changes and deletes, by the functions that a run uses.

A recording is a short text. What a run publishes of a unit follows from the recording, the setting of the unit and the
version; a recording that begins with ``bad`` fails.
"""

from __future__ import annotations

import csv
import hashlib
import json
import shutil
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Any

from stage_files import write_pack

from pipeline.app.config import load_campaign
from pipeline.app.config.campaign import UnitRow
from pipeline.app.config.owner import check_owner, claim, complete_record
from pipeline.app.results_folder import (
    NEW_FOLDER,
    PUBLISHED_PATHS,
    _digest,
    _record,
    finish_publishing,
    publish,
    record_units,
    repetitions,
    take_run,
)
from pipeline.app.steps import gather
from pipeline.core.pack import PACKED_STEPS, PACKS, WITH_PRIOR, Batch

if TYPE_CHECKING:
    from pathlib import Path

    from pipeline.app.config.campaign import Campaign
    from pipeline.app.config.owner import Checked

BATCH = "method-0001"


def write_campaign(directory: Path, recordings: dict[str, str]) -> Path:
    """Write a campaign with these units and texts as recordings."""
    directory.mkdir(parents=True, exist_ok=True)
    for unit, text in recordings.items():
        (directory / "raw" / unit).mkdir(parents=True, exist_ok=True)
        (directory / "raw" / unit / "accel_x.csv").write_text(text)
    (directory / "units.csv").write_text("\n".join(["unit", *recordings, ""]))
    return directory


def units_of(directory: Path) -> dict[str, str]:
    """Return the recording of each unit of the sheet."""
    with (directory / "units.csv").open() as stream:
        units = [row["unit"] for row in csv.DictReader(stream)]
    return {unit: (directory / "raw" / unit / "accel_x.csv").read_text() for unit in units}


@cache
def _template(directory: Path) -> Campaign:
    """Load a campaign whose configuration stands for that of all others: loading takes most of the time."""
    write_campaign(directory, {"U1": "a recording"})
    return load_campaign({"campaign": str(directory)})


def campaign_of(directory: Path, results: Path, *, template: Path, take_over: bool = False) -> Campaign:
    """Return the campaign in a directory; ``results``: folder of all results, ``template``: any other new folder."""
    made = _template(template)
    config = made.units["U1"].config
    procedure = config.procedure
    units = {
        unit: UnitRow(unit, {"unit": unit}, config.replaced(procedure=procedure.replaced(folder=f"raw/{unit}")))
        for unit in units_of(directory)
    }
    return replace(
        made, name=directory.name, directory=directory.resolve(), results=results / directory.name, units=units,
        batches={BATCH: list(units)}, take_over=take_over,
    )  # fmt: skip


def sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def documents(unit: str, recording: str, setting: str) -> dict[str, dict[str, Any]]:
    """Return the members of the packs of each stage for a unit."""
    of, sensors = f"{unit}: {recording}, {setting}", {"accelerometer": None, "gyroscope": None}
    head = {"unit": unit, "schema_version": 2, "of": of, **sensors}
    row, state = {"unit": unit, "serial": f"S{unit}"}, {"recordings": {"accel_x": sha256(recording)[:16]}}
    summary = {"row": row, "state": state, "parameters": [], "failure": None, "sha256": [sha256(recording)]}
    failure = {"unit": unit, "stage": "ingest", "code": "bad_input", "message": of, "file": None}
    if recording.startswith("bad"):
        failed = {f"{unit}.failed.json": failure}
        calibration = head | {"status": "failed", "error": failure, "inputs": []}
        of_report = {f"{unit}.calibration.json": calibration, f"{unit}.html": f"failed {of}"}
        found = {f"{unit}.json": summary | {"failure": failure, "sha256": []}}
        return dict.fromkeys(PACKED_STEPS, failed) | {"report": failed | of_report, "summary": failed | found}
    inputs = [{"file": f"raw/{unit}/accel_x.csv", "sha256": sha256(recording)}]
    diagnosis: dict[str, Any] = {f"{unit}.json": head}
    if setting.startswith("odd"):
        file = f"{unit}_gyroscope_unknown.yaml"
        diagnosis = {f"{unit}.json": head | {"gyroscope": {"suggested_file": file}}, file: f"formula of {of}"}
    return {
        "calibration": {f"{unit}.json": head | {"status": "ok", "error": None, "inputs": inputs}},
        "validate": {f"{unit}.json": head},
        "diagnose": diagnosis,
        "export": {f"{unit}/kalibr.yaml": f"kalibr {of}", f"{unit}/px4.params": f"px4 {of}"},
        "report": {f"{unit}.html": f"page {of}", f"certificates/{unit}.html": f"certificate {of}",
                   f"certificates/{unit}.json": head},
        "summary": {f"{unit}.json": summary},
        WITH_PRIOR: {f"{unit}/combined/{unit}.json": head, f"{unit}/exports/{unit}/kalibr.yaml": f"lot {of}"},
    }  # fmt: skip


def run(
    campaign: Campaign,
    settings: dict[str, str],
    *,
    packed: bool = False,
    lot: bool = False,
    checked: Checked | None = None,
) -> None:
    """Do what a run does to the results folder; raises ``OtherCampaignError`` where the run is refused."""
    results, recordings = campaign.results, units_of(campaign.directory)
    checked = checked or check_owner(campaign, move=True)
    again, _ = repetitions(results, "")
    take_run(results)
    claim(campaign, checked)
    finish_publishing(results)
    batch = results / "batches" / BATCH
    made = {u: documents(u, recordings[u], settings.get(u, "none")) for u in recordings}
    for stage in (*PACKED_STEPS, WITH_PRIOR):
        members = [each.get(stage, {}) for each in made.values()]
        (batch / f"{stage}.zip").unlink(missing_ok=True)  # as Snakemake does
        if stage != WITH_PRIOR or lot:
            write_pack(batch / f"{stage}.zip", {name: content for each in members for name, content in each.items()})
    _publish(results, list(recordings), again, packed=packed)
    complete_record(campaign)


def _publish(results: Path, units: list[str], again: int, *, packed: bool) -> None:
    """Do what the stage ``gather`` does, without the files about all units that it computes."""
    finish_publishing(results)
    new, batch = results / NEW_FOLDER, Batch(results / "batches" / BATCH)
    shutil.rmtree(new, ignore_errors=True)
    for name in PUBLISHED_PATHS:
        if "." not in name:
            (new / name).mkdir(parents=True)
    asked = gather.asked_units(results)
    found = {u: gather._gather_unit(batch, u, new, publish=not packed or u in asked) for u in units}
    for stage in (*PACKED_STEPS, *([WITH_PRIOR] if batch.combined else [])) if packed else ():
        gather._link(results / "batches" / BATCH / f"{stage}.zip", new / PACKS / BATCH / f"{stage}.zip")
    rows = {u: found[u]["sha256"] for u in units}
    for name, text in {"summary.csv": "unit\n" + "\n".join(units), "index.html": f"campaign {rows}",
                       "failures.json": "[]", "fleet.json": "{}", "parameters.parquet": f"{rows}"}.items():  # fmt: skip
        (new / name).write_text(text)
    (results / "history").mkdir(exist_ok=True)
    number = len(list((results / "history").iterdir())) + 1
    entry = {"run": number, "time": "2024-01-01T00:00:00+00:00", "units": {}}
    (results / "history" / f"{number:04d}.json").write_text(json.dumps(entry))
    publish(new, results, again=again, keep=gather._without_successor(results, found))
    record_units(results, {unit: digests for unit, digests in rows.items() if digests})


def as_of_version_1(results: Path) -> None:
    """Make a results folder look as the version before left it: no owner, one digest for each published folder."""
    (results / ".owner.json").unlink(missing_ok=True)
    plan = results / ".published" / ".plan.json"
    if plan.is_file():
        read = json.loads(plan.read_text())
        plan.write_text(json.dumps(read.get("inodes", read)))
    record = _record(results, "")
    if record.is_file():
        found = json.loads(record.read_text())
        below = {name: {p[len(name) + 1 :]: s for p, s in found["written"].items() if p.partition("/")[0] == name}
                 for name in PUBLISHED_PATHS} if "written" in found else {}  # fmt: skip
        files = found.get("files") or {name: _digest(states) for name, states in below.items()}
        record.write_text(json.dumps({"again": found["again"], "files": files}))
