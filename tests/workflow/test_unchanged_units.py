"""A changed unit is computed alone, other units of its batch are taken from the last run: the results are the same."""

import shutil
from pathlib import Path
from typing import Any

import pytest
from whole_run import run_campaign

from pipeline.app.commands import simulate
from pipeline.app.steps import batch, prior
from pipeline.app.steps.unit_files import StoredUnit
from pipeline.core.settings import Settings
from pipeline.unit import Task

pytestmark = pytest.mark.workflow

UNITS = """
seed: 5
units:
  - {unit: A, count: 3, columns: {lot: 7}, recordings: [accel_x, accel_y, accel_z, validation],
     course: {step_deg: 90.0, dwell_s: 1.0, validation_s: 20.0, static_s: 0.0, warm_up_rest_s: 2.0, pause_s: 5.0}}
"""
FIRST, SECOND, THIRD = "A001", "A002", "A003"
PUBLISHED = ("calibrations", "validations", "diagnoses", "exports", "certificates", "combined", "summary.csv")


def published(results: Path) -> dict[str, bytes]:
    """Return the published files, without the pages, which have the history of their units."""
    files = [f for f in results.rglob("*") if f.is_file() and f.relative_to(results).parts[0] in PUBLISHED]
    return {f.relative_to(results).as_posix(): f.read_bytes() for f in files if f.suffix != ".html"}


def change_recording(campaign: Path) -> None:
    file = campaign / "raw" / FIRST / "accel_x.csv"
    lines = file.read_text().splitlines()
    file.write_text("\n".join(lines[:-1]) + "\n")


def add_effect(campaign: Path) -> None:
    (campaign / "devices").mkdir(exist_ok=True)
    (campaign / "devices" / f"{SECOND}.yaml").write_text(
        "overrides: ['effects.accelerometer=[quadratic_nonlinearity]']\n"
    )


def state_date(campaign: Path) -> None:
    sheet = campaign / "units.csv"
    header, *rows = sheet.read_text().splitlines()
    dated = [f"{row},2024-01-0{k}" if row.startswith(THIRD) else f"{row}," for k, row in enumerate(rows, 1)]
    sheet.write_text("\n".join([f"{header},date", *dated, ""]))


def test_a_changed_unit_is_computed_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    campaign = tmp_path / "fleet"
    campaign.mkdir()
    (campaign / "simulation.yaml").write_text(UNITS)
    assert simulate.main([str(campaign)]) == 0
    (campaign / "campaign.yaml").write_text("overrides: [method.gyroscope=null]\n")
    computed: set[tuple[str, str]] = set()
    of_step, of_prior = batch.run_step, prior.prior_unit

    def step(task: Task, stored: StoredUnit, settings: Settings) -> Any:
        computed.add((task.step, stored.unit))
        return of_step(task, stored, settings)

    def with_prior(job: batch.Job, unit: str, settings: Settings) -> Any:
        computed.add(("prior", unit))
        return of_prior(job, unit, settings)

    monkeypatch.setattr(batch, "run_step", step)
    monkeypatch.setattr(prior, "prior_unit", with_prior)

    def run(*, compared: bool = False, **settings: Any) -> set[tuple[str, str]]:
        """Return the stages and units that a run computes; ``compared``: with a run that computes all of them."""
        computed.clear()
        found, code = run_campaign(campaign, **settings)
        assert code == 0
        made = set(computed)
        if compared:
            afresh, _ = run_campaign(campaign, results=tmp_path / "afresh", **settings)
            assert published(found.results) == published(afresh.results)
            shutil.rmtree(tmp_path / "afresh")
        return made

    of_unit = {"ingest", "filter", "fit", "validate", "diagnose", "calibration", "export", "report", "summary"}
    assert run() == {(stage, unit) for stage in of_unit for unit in (FIRST, SECOND, THIRD)}
    assert run() == set()
    change_recording(campaign)
    assert run() == {(stage, FIRST) for stage in of_unit}
    add_effect(campaign)
    assert {unit for _, unit in run(compared=True)} == {SECOND}
    state_date(campaign)
    assert run() == {("report", THIRD), *(("summary", unit) for unit in (FIRST, SECOND, THIRD))}  # each has the column
    lot = {"overrides": ["combine=lot"]}
    assert {stage for stage, _ in run(**lot)} == {"report", "summary", "prior"}
    change_recording(campaign)
    assert run(compared=True, **lot) == {(stage, FIRST) for stage in (*of_unit, "prior")}  # no prior of three
