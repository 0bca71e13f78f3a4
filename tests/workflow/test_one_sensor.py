"""Units with one sensor: the other is null with the reason, everything else is made of them as of any unit."""

from __future__ import annotations

import json
import shutil
from html import unescape
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from calls import ONCE_A_RECORDING, counted
from whole_run import run_campaign

import pipeline
from pipeline.app.commands import apply, simulate
from pipeline.app.config import load_campaign
from pipeline.core.errors import ConfigurationError
from pipeline.core.records import Recording
from pipeline.ingest.arrow import write_recording

from .conftest import Bench

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.workflow

UNITS = """unit,procedure,method,overrides
whole,multi_position,rests_and_moves,
csv,multi_position,rests_and_moves,
mcap,multi_position,rests_and_moves,
null,multi_position,rests_and_moves,method.gyroscope=null
table,three_axis_turns,,method.accelerometer=null
"""


def without(source: Path, target: Path, sensor: str) -> None:
    """Copy a recording without the columns of a sensor."""
    rows = [line.split(",") for line in source.read_text().splitlines()]
    kept = [i for i, name in enumerate(rows[0]) if not name.startswith(sensor)]
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text("".join(",".join(row[i] for i in kept) + "\n" for row in rows))


def as_mcap(source: Path, target: Path) -> None:
    """Write the same readings as MCAP, with the gyroscope marked as absent by the covariance -1."""
    rows = np.genfromtxt(source, delimiter=",", names=True)
    time = np.rint(rows["time_s"] * 1e9).astype(np.int64)
    force = np.column_stack([rows[f"accel_{axis}_g"] for axis in "xyz"])
    write_recording(target, Recording("recording", "rests", None, time, force, None, rows["temperature_degc"]))


def simulated(directory: Path, *options: str) -> Path:
    assert simulate.main([str(directory), "--sensor", "mpu6050", "--quiet", *options]) == 0
    return next((directory / "raw").iterdir())


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    directory = tmp_path_factory.mktemp("one_sensor")
    hand = simulated(directory / "hand", "--procedure", "multi_position", "--table", "hand", "--positions", "24",
                     "--static", "0", "--validation", "0")  # fmt: skip
    table = simulated(directory / "table", "--step", "15", "--static", "0", "--validation", "30")
    campaign = directory / "units"
    for unit in ("whole", "null"):
        shutil.copytree(hand, campaign / "raw" / unit)
    without(hand / "recording.csv", campaign / "raw" / "csv" / "recording.csv", "gyro")
    for name in ("gyro_x", "gyro_y", "gyro_z", "validation"):  # no recording of the accelerometer's turns at all
        without(table / f"{name}.csv", campaign / "raw" / "table" / f"{name}.csv", "accel")
    (campaign / "raw" / "mcap").mkdir()
    as_mcap(campaign / "raw" / "csv" / "recording.csv", campaign / "raw" / "mcap" / "recording.mcap")
    (campaign / "units.csv").write_text(UNITS)
    assert run_campaign(campaign)[1] == 0
    return Bench(directory, campaign)


def document(bench: Bench, kind: str, unit: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((bench.results / kind / f"{unit}.json").read_text())
    return found


def test_calibrate_unit_saves_the_files_of_the_run_by_hand(done: Bench, tmp_path: Path) -> None:
    with counted(ONCE_A_RECORDING) as calls:
        found = pipeline.calibrate_unit(done.campaign, "whole", results=done.results.parent)
    found.save(tmp_path)
    saved = {str(file.relative_to(tmp_path)): file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}
    assert len(saved) > 10
    assert saved == {path: (done.results / path).read_bytes() for path in saved}
    assert calls["find_rests", "recording"] == calls["rests_from_table", "recording"] == 1
    assert set(calls.values()) == {1}
    alone = pipeline.calibrate({"recording": done.campaign / "raw" / "csv" / "recording.csv"}, sensor="generic",
                               procedure="multi_position", method="rests_and_moves")  # fmt: skip
    assert alone.gyroscope is None
    assert repr(alone).splitlines()[-1].startswith("gyroscope: null, ")
    assert alone.calibration["accelerometer"] == document(done, "calibrations", "csv")["accelerometer"]


@pytest.mark.parametrize("unit", ["csv", "mcap", "null", "table"])
def test_the_absent_sensor_is_null_with_the_reason_and_all_files_are_made(done: Bench, unit: str) -> None:
    there, absent = sorted(
        ("accelerometer", "gyroscope"), key=lambda sensor: (sensor == "gyroscope") != (unit == "table")
    )
    found = document(done, "calibrations", unit)
    assert found["status"] == "ok"
    assert found[absent] is None
    assert absent in found["not_calibrated"][absent]
    assert found[there]["converged"]
    for kind in ("validations", "diagnoses"):
        assert document(done, kind, unit)[absent] is None
        assert document(done, kind, unit)[there] is not None
    notes = {note["code"] for file in found["inputs"] for note in file["notes"]}
    assert ("N-ABSENT" in notes) == (unit != "null")
    page = unescape((done.results / "reports" / f"{unit}.html").read_text())
    assert found["not_calibrated"][absent].split(":")[0] in page
    assert (done.results / "exports" / unit / "calibration.h").is_file()


@pytest.mark.parametrize("unit", ["csv", "mcap", "null"])
def test_one_sensor_gets_the_same_numbers_as_beside_the_other(done: Bench, unit: str) -> None:
    alone, beside = (document(done, "calibrations", u)["accelerometer"] for u in (unit, "whole"))
    for part in ("bias", "matrix"):
        uncertainty = np.array(beside["expanded_uncertainty"][part])
        assert np.abs(np.subtract(alone[part], beside[part])).max() <= 0.5 * uncertainty.max()


def test_a_log_of_one_sensor_is_compensated(done: Bench) -> None:
    log, out = done.campaign / "raw" / "csv" / "recording.csv", done.directory / "out.csv"
    calibration = done.results / "calibrations" / "csv.json"
    assert apply.main(["--calibration", str(calibration), str(log), "-o", str(out)]) == 0
    header, first = out.read_text().splitlines()[:2]
    assert header == log.read_text().splitlines()[0]
    assert first != log.read_text().splitlines()[1]


def test_a_method_without_any_sensor_is_refused(done: Bench) -> None:
    overrides = ["method.accelerometer=null", "method.gyroscope=null"]
    with pytest.raises(ConfigurationError, match="no sensor would be calibrated"):
        load_campaign({"campaign": str(done.campaign), "overrides": overrides})
