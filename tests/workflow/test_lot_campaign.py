"""A small campaign with the prior of its lot: what a run publishes of it, with files of units and with packs."""

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from whole_run import run_campaign

import pipeline
from pipeline.app.commands import simulate, unpack
from pipeline.app.config import load_campaign, settings_of_jobs
from pipeline.app.results_folder import release_locks
from pipeline.app.steps import batch

pytestmark = pytest.mark.workflow

PACKED = {"overrides": ["publish_limit=2"]}
# Turns of the accelerometer with few positions; units of one lot are alike, and B differs from them by 20 mg.
UNITS = """
seed: 3
units:
  - {unit: A, count: 9, columns: {lot: 7}, course: &short {step_deg: 90.0, dwell_s: 1.0, validation_s: 20.0,
     static_s: 0.0, warm_up_rest_s: 2.0, pause_s: 5.0}, recordings: &some [accel_x, accel_y, accel_z, validation],
     accelerometer: &same {bias: [0.01, 0.01, 0.01], matrix: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}}
  - {unit: B, columns: {lot: 7}, course: *short, recordings: *some,
     accelerometer: {bias: [0.01, 0.03, 0.01], matrix: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}}
"""


def test_a_campaign_with_the_prior_of_its_lot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    directory = tmp_path / "lot"
    directory.mkdir()
    (directory / "simulation.yaml").write_text(UNITS)
    assert simulate.main([str(directory)]) == 0
    (directory / "campaign.yaml").write_text("overrides: [method.gyroscope=null, combine=lot]\n")
    campaign, code = run_campaign(directory)
    assert code == 0
    results = campaign.results
    told = json.loads((results / "fleet.json").read_text())["combined"]
    assert told[0]["outliers"] == ["B"]
    assert told[0]["with_prior"] == 9
    plain, prior = (pipeline.load_calibration(results / of / "A001.json") for of in ("calibrations", "combined"))
    errors = [abs(c.accelerometer.bias - 0.01).mean() for c in (plain, prior)]
    assert errors[1] < errors[0]  # nine equal units: 30 % of the error is left where mean and spread are known
    held_out = pd.read_csv(directory / "raw" / "A001" / "validation.csv")
    readings = held_out[[f"accel_{axis}_g" for axis in "xyz"]].to_numpy()
    document = json.loads((results / "combined" / "A001.json").read_text())
    told_errors = document["lot_prior"]["accelerometer"]["held_out_rms_error"]
    for calibration, name in ((plain, "without"), (prior, "with")):
        size = np.linalg.norm(calibration.apply(accelerometer=readings).accelerometer, axis=1)
        assert told_errors[name] == pytest.approx(np.sqrt(np.mean((size - 1.0) ** 2)), rel=1e-3)
    assert "g without the prior" in (results / "reports" / "A001.html").read_text()
    exported = (results / "exports" / "A001" / "kalibr.yaml").read_text()
    assert "With the prior of mpu6050, lot 7, accelerometer: 8 siblings" in exported
    assert "With the prior of 8 siblings" not in (results / "exports" / "B" / "kalibr.yaml").read_text()
    assert "with the prior of 8 siblings (mpu6050, lot 7)" in (results / "reports" / "A001.html").read_text()
    assert "calibrated without the prior" in (results / "reports" / "B.html").read_text()
    assert not (results / "combined" / "B.json").exists()
    published = {path: (results / path).read_bytes() for path in ("combined/A001.json", "exports/A001/kalibr.yaml")}
    _packed_the_same(directory, published)
    capsys.readouterr()


def _packed_the_same(directory: Path, published: dict[str, bytes]) -> None:
    """Beyond ``publish_limit`` the files are in packs, and ``unpack`` publishes the same."""
    campaign = load_campaign({"campaign": str(directory), "results": str(directory.parent / "results"), **PACKED})
    file, batches = settings_of_jobs(campaign)["campaign"]["gather"], campaign.results / "batches"
    (campaign.results / "configs" / file.name).write_bytes(file.content)
    shutil.rmtree(campaign.results / "calibrations")  # else its units are those that were asked for
    config = str(campaign.results / "configs" / file.name)
    try:
        assert batch.main("gather", ["--config", config, "--output", str(batches / "gathered.json")]) == 0
    finally:
        release_locks()
    assert not (campaign.results / "combined" / "A001.json").exists()
    assert unpack.main([str(campaign.results), "A001"]) == 0
    assert {path: (campaign.results / path).read_bytes() for path in published} == published
