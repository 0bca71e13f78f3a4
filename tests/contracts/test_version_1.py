"""Results, device files and profiles of the version before, with schema_version 1, are read without a change.

``data/results_of_version_1.zip`` holds what that version published of one unit of the demo.
"""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from jsonschema import Draft202012Validator

import pipeline
from pipeline.app.commands import add, apply, convert, explain
from pipeline.app.config.campaign import load_campaign
from pipeline.core.records import READABLE_VERSIONS, SCHEMA_VERSION, SENSORS
from pipeline.output.exports.reading import read_any

HERE, ROOT, UNIT = Path(__file__).parent, Path(__file__).parents[2], "mpu6050-2-hidden"
DEVICE = 'overrides:\n  - "effects.gyroscope=[g_sensitivity]"\n'
PROFILE = """\
# Proposed by python -m pipeline check for log.csv. Check each line: no line is certain.
name: prof # name of the profile, for the report

csv:
  delimiter: ","
  decimal: "."
  header: true
  skip_lines: 0
  comment: null
  rate_hz: null
  columns: # channel: the column's name (or index from 0) and its unit
    time: {column: t_ms, unit: ms}
    accel_x: {column: ax, unit: m/s^2}
    accel_y: {column: ay, unit: m/s^2}
    accel_z: {column: az, unit: m/s^2}
    gyro_x: {column: wx, unit: deg/s}
    gyro_y: {column: wy, unit: deg/s}
    gyro_z: {column: wz, unit: deg/s}
"""


@pytest.fixture
def results(tmp_path: Path) -> Path:
    folder = tmp_path / "results" / "demo"
    with zipfile.ZipFile(HERE / "data" / "results_of_version_1.zip") as archive:
        archive.extractall(folder)
    return folder


def test_documents_of_version_1_are_read_by_python_and_by_apply(results: Path) -> None:
    file = results / "calibrations" / f"{UNIT}.json"
    document = json.loads(file.read_text())
    assert document["schema_version"] == 1
    assert document["software"]["imu-calibration"] == "0.1.0"
    raw = pd.read_csv(ROOT / "data" / "demo" / "raw" / UNIT / "validation.csv").head(50)
    log, out = results / "log.csv", results / "out.csv"
    raw.to_csv(log, index=False)
    assert apply.main(["--calibration", str(file), str(log), "-o", str(out)]) == 0
    compensated = pipeline.load_calibration(file).apply(
        raw.filter(regex="^accel_._g$").to_numpy(), raw.filter(regex="^gyro_._dps$").to_numpy()
    )
    for sensor, pattern in (("accelerometer", "^accel_._g$"), ("gyroscope", "^gyro_._dps$")):
        part = document[sensor]
        expected = (raw.filter(regex=pattern).to_numpy() - part["bias"]) @ np.transpose(part["matrix"])
        assert np.allclose(getattr(compensated, sensor), expected, rtol=0.0, atol=1e-12)
        assert np.allclose(pd.read_csv(out).filter(regex=pattern).to_numpy(), expected, rtol=0.0, atol=1e-6)


def test_a_results_folder_of_version_1_is_read_as_tables(results: Path) -> None:
    read = pipeline.load_campaign(results)
    assert read.units == [UNIT]
    assert read.diagnosis.set_index("sensor").loc["gyroscope", "selected"] == "g_sensitivity"
    assert read.parameters.query("sensor == 'gyroscope' and parameter == 'bias_x'")["value"].item() == pytest.approx(
        json.loads((results / "calibrations" / f"{UNIT}.json").read_text())["gyroscope"]["bias"][0]
    )
    for table in (read.summary, read.errors, read.effects, read.noise):
        assert len(table)
    assert read.chips.empty
    assert "gyroscope missing_effect" in repr(read.unit(UNIT))


def test_explain_convert_and_add_take_documents_of_version_1(
    results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert explain.main([str(results), "--all"]) == 0
    assert "The model of the gyroscope misses g sensitivity." in capsys.readouterr().out
    file = results / "calibrations" / f"{UNIT}.json"
    assert explain.main([str(file)]) == 0
    assert "calibrated = matrix (reading - bias)" in capsys.readouterr().out
    kalibr, again = tmp_path / "kalibr.yaml", tmp_path / "calibration.json"
    assert convert.main([str(file), str(kalibr)]) == 0
    assert convert.main([str(kalibr), str(again)]) == 0
    assert json.loads(again.read_text())["schema_version"] == SCHEMA_VERSION
    for sensor in SENSORS:
        matrices = [read_any(path).sensors[sensor].matrix for path in (file, again)]
        assert np.allclose(*matrices, rtol=0.0, atol=1e-9)
    sheet = tmp_path / "demo" / "units.csv"
    sheet.parent.mkdir()
    sheet.write_text(f"unit\n{UNIT}\n")
    (sheet.parent / "raw").symlink_to(ROOT / "data" / "demo" / "raw")
    assert add.main([str(sheet.parent), "--missing", "--no-run", "--results", str(results.parent)]) == 0
    assert (sheet.parent / "devices" / f"{UNIT}.yaml").read_text() == DEVICE


def test_device_files_and_profiles_of_the_version_before_are_loaded(tmp_path: Path) -> None:
    for name, text in (("units.csv", "unit,ingest\nU1,prof\n"), ("devices/U1.yaml", DEVICE),
                       ("configs/ingest/prof.yaml", PROFILE)):  # fmt: skip
        file = tmp_path / "bench" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    config = load_campaign({"campaign": str(tmp_path / "bench")}).units["U1"].config
    assert config.effects.gyroscope == ["g_sensitivity"]
    assert config.ingest.csv["columns"]["accel_x"] == {"column": "ax", "unit": "m/s^2"}


@pytest.mark.parametrize("kind", ["calibration", "validation", "diagnosis"])
def test_the_schemas_accept_the_versions_that_are_read_and_no_other(results: Path, kind: str) -> None:
    schema = json.loads((ROOT / "pipeline" / "schemas" / f"{kind}.json").read_text())
    folder = {"diagnosis": "diagnoses"}.get(kind, f"{kind}s")
    document = json.loads((results / folder / f"{UNIT}.json").read_text())
    valid = [v for v in range(5) if Draft202012Validator(schema).is_valid(document | {"schema_version": v})]
    assert valid == list(READABLE_VERSIONS)
