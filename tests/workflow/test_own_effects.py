"""An effect of a user's own through every stage: hidden, found, fitted, and taken off a field log."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls import OF_STEPS, ONCE_A_RECORDING, ONCE_A_RECORDING_AND_SENSOR, Calls, counted, designs, names
from whole_run import run_campaign

import pipeline
from pipeline.app.commands import apply, check, explain, simulate
from pipeline.app.config import load_campaign
from pipeline.core.pack import Batch
from pipeline.physics.effects import forget

from .conftest import Bench

pytestmark = pytest.mark.workflow

GEAR = """\
name: gear_mesh
owner: table
sensors: [gyroscope]
meaning: The gear of the table pushes five times a turn.
terms:
  B: {formula: "sin(5 * radians(angle))", unit: deg/s}
  A: {formula: "cos(5 * radians(angle))", unit: deg/s}
limits: {A: 0.1, B: 0.1}
"""
LOOSE = """\
name: loose_part
owner: sensor
sensors: [accelerometer]
meaning: A loose part of the sensor tips over with gravity.
terms:
  d: {formula: "tanh(8 * fz)", unit: g}
limits: {d: 0.05}
"""
SHEET = """\
unit,sensor,overrides
found,mpu6050,
known,mpu6050,"effects.gyroscope=[gear_mesh];effects.accelerometer=[loose_part]"
"""
SIMULATE = "--sensor mpu6050 --step 15 --dwell 1 --rates 20 60 --both-directions --validation 60 --seed 4"
HIDDEN = {"gyroscope": "gear_mesh", "accelerometer": "loose_part"}


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    directory = tmp_path_factory.mktemp("own")
    campaign = directory / "own"
    (campaign / "effects").mkdir(parents=True)
    (campaign / "effects" / "gear_mesh.yaml").write_text(GEAR)
    (campaign / "effects" / "loose_part.yaml").write_text(LOOSE)
    hide = ["--effect", "gyroscope.gear_mesh=0.03", "--effect", "accelerometer.loose_part=0.01"]
    assert simulate.main([str(campaign), *SIMULATE.split(), *hide]) == 0
    forget()  # the command is a process of its own
    (campaign / "raw" / "U001").rename(campaign / "raw" / "found")
    (campaign / "raw" / "known").symlink_to("found")
    (campaign / "units.csv").write_text(SHEET)
    return Bench(directory, campaign)


@pytest.fixture(scope="module")
def run(bench: Bench) -> Calls:
    """Run the campaign; return the calls of the steps."""
    with counted(OF_STEPS) as calls:
        assert run_campaign(bench.campaign)[1] == 0
    return calls


def result(bench: Bench, kind: str, unit: str) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((bench.results / kind / f"{unit}.json").read_text())
    return content


@pytest.mark.usefixtures("run")
def test_a_hidden_formula_is_found_and_once_configured_nothing_is_missing(bench: Bench) -> None:
    found, known = (result(bench, "diagnoses", unit) for unit in ("found", "known"))
    for sensor, name in HIDDEN.items():
        assert found[sensor]["verdict"] == "missing_effect"
        assert found[sensor]["selected"] == [name]
        assert found[sensor]["override"] == f"effects.{sensor}=[{name}]"
        assert known[sensor]["verdict"] == "nothing_missing"


@pytest.mark.usefixtures("run")
def test_the_hidden_size_is_found_within_its_uncertainty(bench: Bench) -> None:
    truth = json.loads((bench.campaign / "truth" / "U001.json").read_text())
    for sensor, name in HIDDEN.items():
        (fitted,) = result(bench, "calibrations", "known")[sensor]["effects"]
        for parameter, size in truth[sensor]["effects"][name].items():
            entry = fitted["parameters"][parameter]
            assert abs(entry["value"] - size) < 2 * entry["expanded_uncertainty"] < 0.2 * abs(size)


@pytest.mark.usefixtures("run")
def test_validation_words_page_and_exports_know_it(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    before, after = result(bench, "validations", "known")["accelerometer"]["steps"][-2:]
    assert after["name"] == "+ loose_part"
    assert after["vector_rms_error"] < 0.2 * before["vector_rms_error"]
    assert explain.main([str(bench.results)]) == 0
    words = capsys.readouterr().out
    assert "effect missing: found; accelerometer: loose part" in words
    assert explain.main([str(bench.results), "found"]) == 0
    words = capsys.readouterr().out
    assert "A loose part of the sensor tips over with gravity." in words
    assert "loose_part" in (bench.results / "reports" / "known.html").read_text()
    header = (bench.results / "exports" / "known" / "calibration.h").read_text()
    taken_off = re.findall(
        r"r\[\d\] -= \(imu_real\)(\S+) \* \(imu_real\)tanh\(\(\(imu_real\)8\.0 \* f\[2\]\)\)", header
    )
    assert len(taken_off) == 3
    np.testing.assert_allclose(np.array(taken_off, float), 0.01, rtol=0.05)
    assert "Of the bench, not of the gyroscope: gear_mesh." in header


def test_a_run_calibrate_unit_and_check_are_one_chain(
    bench: Bench, run: Calls, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same functions make the same files, and what a step computes of a recording the next ones need not."""
    settings = {"campaign": str(bench.campaign), "results": str(bench.results.parent)}
    with counted((*OF_STEPS, *ONCE_A_RECORDING, *ONCE_A_RECORDING_AND_SENSOR)) as calls, designs() as built:
        pipeline.calibrate_unit(bench.campaign, "known", results=bench.results.parent).save(tmp_path)
    assert names(run) == {name.rpartition(".")[2] for name in OF_STEPS}
    assert names(calls) >= names(run) - {"summarise"}  # of all units
    of_unit = [path for path, _ in Batch(*(bench.results / "batches").glob("ref*")).files("known")]
    saved = {str(file.relative_to(tmp_path)): file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}
    assert saved == {path: (bench.results / path).read_bytes() for path in of_unit}
    assert load_campaign(settings).units["known"].config_sha256 in saved["calibrations/known.json"].decode()
    computed = {name: [n for (f, _), n in calls.items() if f == name] for name in names(calls)}
    turns = 6
    assert computed["_motion_of_turn"] == [1] * turns
    assert computed["_motion_of_attitude"] == [1]  # of the held-out motion
    assert computed["smooth_temperature"] == [1] * (turns + 2)
    assert max(computed["rests_from_table"]) == 1
    assert max(computed["_part"]) == 2  # of each sensor
    assert {sensor for sensor, *_ in built} == {"accelerometer", "gyroscope"}
    assert set(built.values()) == {1}
    with counted(OF_STEPS) as calls:
        assert check.main(["--campaign", str(bench.campaign), "--unit", "known"]) == 0
    assert "unit known: " in capsys.readouterr().out
    assert names(calls) == names(run) - {"export", "report", "summarise"}


@pytest.mark.usefixtures("run")
def test_the_calibration_alone_takes_the_sensors_formula_off_a_log(bench: Bench, tmp_path: Path) -> None:
    file = bench.results / "calibrations" / "known.json"
    own = json.loads(file.read_text())["accelerometer"]
    size = np.array([p["value"] for p in own["effects"][0]["parameters"].values()])
    force = np.random.default_rng(7).normal(0.0, 0.6, (200, 3))
    reading = np.array(own["bias"]) + force @ np.linalg.inv(own["matrix"]).T + np.tanh(8.0 * force[:, 2:]) * size
    log, out = tmp_path / "log.csv", tmp_path / "out.csv"
    rows = "\n".join(",".join(map(repr, map(float, row))) for row in reading)
    log.write_text(f"accel_x_g,accel_y_g,accel_z_g\n{rows}\n")
    assert apply.main(["--calibration", str(file), str(log), "-o", str(out)]) == 0
    np.testing.assert_allclose(np.loadtxt(out, delimiter=",", skiprows=1), force, atol=1e-9)
