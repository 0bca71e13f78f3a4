"""The table's log in another file, a program, one long recording: each to the page, and to the same calibration."""

from __future__ import annotations

import hashlib
import json
from typing import Any

import numpy as np
import pytest
from whole_run import run_campaign

from pipeline.app.commands import simulate
from pipeline.app.steps.unit_files import recordings_of
from pipeline.core.pack import Pack

from .conftest import Bench

pytestmark = pytest.mark.workflow

COURSE = "course: {step_deg: 15.0, validation_s: 60.0, static_s: 60.0}, motion: 1"
DESCRIPTION = f"""\
seed: 5
units:
- {{unit: rows, {COURSE}}}
- {{unit: file, copy_of: rows, {COURSE}, table_log: {{kind: file, wrapped: true}}}}
- {{unit: program, copy_of: rows, {COURSE}, table_log: {{kind: program}}}}
- {{unit: one, {COURSE}, procedure: one_recording}}
- {{unit: one_file, {COURSE}, procedure: one_recording, table_log: {{kind: file}}}}
- {{unit: windows, {COURSE}, procedure: one_recording}}
"""
TIMES = {"x": [(0, 50), (240, 272)], "y": [(60, 112), (310, 345)], "z": [(140, 195), (388, 422)]}
WINDOWS = ", ".join(
    f"{{role: {role}, axis: {axis}, start_s: {a}, stop_s: {b}}}"
    for axis, spans in TIMES.items()
    for role, (a, b) in zip(("accelerometer", "gyroscope"), spans, strict=True)
)


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    directory = tmp_path_factory.mktemp("layouts")
    campaign = directory / "layouts"
    campaign.mkdir()
    (campaign / "simulation.yaml").write_text(DESCRIPTION)
    assert simulate.main([str(campaign)]) == 0
    override = f"procedure.recordings.recording.windows=[{WINDOWS}]"
    assert run_campaign(campaign, unit_overrides={"windows": [override]})[1] == 0
    return Bench(directory, campaign)


def result(bench: Bench, kind: str, unit: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((bench.results / kind / f"{unit}.json").read_text())
    return found


@pytest.mark.parametrize("unit", ["rows", "file", "program", "one", "one_file"])
def test_each_layout_gives_the_truth_within_its_uncertainty(done: Bench, unit: str) -> None:
    found = result(done, "calibrations", unit)
    assert found["status"] == "ok"
    truth = json.loads((done.campaign / "truth" / f"{unit}.json").read_text())
    for sensor in ("accelerometer", "gyroscope"):
        for key in ("bias", "matrix"):
            off = np.array(found[sensor][key]) - truth[sensor][key]
            assert float(np.abs(off / found[sensor]["expanded_uncertainty"][key]).max()) < 2.0


@pytest.mark.parametrize("unit", ["file", "program"])
def test_a_twin_differs_by_little_of_its_uncertainty(done: Bench, unit: str) -> None:
    twin, found = result(done, "calibrations", "rows"), result(done, "calibrations", unit)
    for sensor in ("accelerometer", "gyroscope"):
        for key in ("bias", "matrix"):
            off = np.array(found[sensor][key]) - twin[sensor][key]
            assert float(np.abs(off / twin[sensor]["expanded_uncertainty"][key]).max()) < 0.5
        held_out = [result(done, "validations", u)[sensor]["steps"][-1]["rms_error"] for u in ("rows", unit)]
        assert held_out[1] == pytest.approx(held_out[0], rel=0.05)


def test_the_page_tells_clock_program_and_segments(done: Bench) -> None:
    for unit, told in (
        ("file", "the table&#39;s clock is"),
        ("program", "the table is followed from its program"),
        ("one", "24 steps about x at"),
        ("windows", "accelerometer about x, from 0.00 to 49"),
    ):
        assert told in (done.results / "reports" / f"{unit}.html").read_text(), unit


def test_every_file_that_was_read_is_listed_with_its_hash(done: Bench) -> None:
    page = (done.results / "reports" / "file.html").read_text()
    inputs = result(done, "calibrations", "file")["inputs"]
    listed = {f["file"]: f["sha256"] for entry in inputs for f in (entry, *entry["joined"])}
    files = sorted(f for f in (done.campaign / "raw" / "file").iterdir() if f.suffix == ".csv")
    assert sorted(listed) == [str(f.relative_to(done.campaign)) for f in files]
    for file in files:
        digest = hashlib.sha256(file.read_bytes()).hexdigest()
        assert listed[str(file.relative_to(done.campaign))] == digest
        assert digest in page


def test_the_inputs_hold_the_program_that_is_the_reference(done: Bench) -> None:
    inputs = {entry["recording"]: entry for entry in result(done, "calibrations", "program")["inputs"]}
    turned = [step["turn_deg"] for step in inputs["gyro_x"]["program"] if "turn_deg" in step]
    assert abs(turned[0]) >= 360.0
    assert all("program" not in entry for entry in result(done, "calibrations", "file")["inputs"])


def test_windows_in_the_configuration_take_the_place_of_what_is_found(done: Bench) -> None:
    packs = map(Pack, done.results.glob("batches/*/ingest.zip"))
    ingested = next(pack for pack in packs if "windows.parquet" in pack)
    found = {r.name: float(r.time[-1] - r.time[0]) for r in recordings_of({"ingest": ingested}, "windows")}
    spans = {
        f"{s}_{axis}": b - a for axis, at in TIMES.items() for s, (a, b) in zip(("accel", "gyro"), at, strict=True)
    }
    assert found == pytest.approx(spans, abs=0.25)  # two samples
    assert result(done, "calibrations", "windows")["status"] == "ok"
