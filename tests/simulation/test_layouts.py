"""How simulated recordings are laid out in files, and that all layouts hold the same motion."""

from __future__ import annotations

import csv
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import yaml

from pipeline.core.errors import ConfigurationError
from pipeline.core.records import rate_of_attitude
from pipeline.ingest.clock_alignment import Program, _flat
from pipeline.simulation.campaign import Streams, as_program, simulate_unit, write_campaign
from pipeline.simulation.description import Course, UnitDescription, description_from, plan
from pipeline.simulation.trajectory import CommandedTurns

if TYPE_CHECKING:
    from pathlib import Path

    from pipeline.core.records import Recording

SHORT = {"step_deg": 30.0, "validation_s": 30.0, "static_s": 20.0}


def simulated(**keys: Any) -> tuple[dict[str, Recording], dict[str, Any]]:
    recordings, truth = simulate_unit(UnitDescription("U", **{"course": SHORT, **keys}), 1, 0)
    return {r.name: r for r in recordings}, truth


@pytest.mark.parametrize("kind", ["file", "program"])
def test_where_the_table_is_logged_changes_nothing_that_the_sensors_read(kind: str) -> None:
    rows, _ = simulated()
    other, truth = simulated(table_log={"kind": kind})
    assert ("table_clock" in truth) == (kind == "file")
    for name, recording in rows.items():
        np.testing.assert_array_equal(other[name].accelerometer, recording.accelerometer)
        np.testing.assert_array_equal(other[name].gyroscope, recording.gyroscope)
        if recording.axis is not None:
            assert other[name].table_angle is None


def test_a_log_of_its_own_is_the_rows_log_by_another_clock() -> None:
    rows, _ = simulated()
    other, truth = simulated(table_log={"kind": "file"})
    clock = truth["table_clock"]
    assert 0.0 <= clock["offset_s"] <= 100.0
    for name in ("accel_x", "gyro_z"):
        recording, log = rows[name], other[f"{name}_table"]
        tau = recording.time + clock["offset_s"] + 1e-6 * clock["drift_ppm"] * recording.time
        assert log.table_angle is not None
        angle = np.interp(tau, log.time, log.table_angle)
        np.testing.assert_allclose(angle, recording.table_angle, atol=0.002)  # a bend within 10 ms


def test_a_program_is_written_as_its_steps() -> None:
    course = Course(step_deg=30.0, rates_dps=(20.0, 60.0), both_directions=True)
    for part in plan("three_axis_turns", course, Streams(1, 0)["motion"]):
        if isinstance(part.trajectory, CommandedTurns):
            program = part.trajectory.program
            written = Program(_flat(as_program(program)))
            assert len(written.stops) == len(program.stops)
            time = np.linspace(0.0, program.duration, 3000)
            for found, true in zip(written.at(time), program.at(time), strict=True):
                np.testing.assert_allclose(found, true, atol=1e-5)


def test_equal_steps_are_written_once() -> None:
    course = Course(step_deg=5.0)
    turn = next(p.trajectory for p in plan("three_axis_turns", course, Streams(1, 0)["motion"]) if p.name == "accel_x")
    assert isinstance(turn, CommandedTurns)
    steps = as_program(turn.program)
    assert max(getattr(step, "repeat", 0) for step in steps) > 60
    assert len(steps) < 6


def test_one_recording_goes_on_without_a_jump() -> None:
    whole = simulated(procedure="one_recording")[0]["recording"]
    np.testing.assert_array_equal(np.diff(whole.time_ns), 120_000_000)
    assert whole.table_attitude is not None
    assert float(np.abs(np.sum(whole.table_attitude[1:] * whole.table_attitude[:-1], axis=1)).min()) > np.cos(
        np.radians(0.5 * 70.0 * 0.12)
    )
    force = whole.accelerometer
    assert force is not None
    assert float(np.linalg.norm(np.diff(force, axis=0), axis=1).max()) < 0.2  # at most 60 deg/s


def test_held_out_motion_of_one_recording_begins_and_ends_at_rest_and_its_rate_is_that_of_its_attitude() -> None:
    whole = simulated(procedure="one_recording", interval_s=0.02)[0]["recording"]
    assert whole.table_attitude is not None
    assert whole.table_rate is not None
    turned = rate_of_attitude(whole.time, whole.table_attitude)
    off = np.abs(turned - np.abs(whole.table_rate))
    assert float(np.percentile(off, 90.0)) < 0.01
    assert float(np.abs(np.diff(whole.table_rate)).max()) < 2.1  # deg/s in 20 ms: 100 deg/s^2 of the table, no jump


def test_a_campaign_names_the_profile_or_the_procedure_that_reads_it(tmp_path: Path) -> None:
    units = [{"unit": f"U{k}", "table_log": {"kind": k}, "course": SHORT} for k in ("rows", "file", "program")]
    write_campaign(description_from({"units": units}, "test"), tmp_path)
    with (tmp_path / "units.csv").open() as stream:
        rows = {r["unit"]: r for r in csv.DictReader(stream)}
    assert rows["Ufile"]["ingest"] == "table_log"
    assert rows["Uprogram"]["procedure"] == "three_axis_turns_commanded"
    assert rows["Urows"]["ingest"] == ""
    assert (tmp_path / "raw" / "Ufile" / "gyro_x_table.csv").is_file()
    written = yaml.safe_load((tmp_path / "configs" / "procedure" / "three_axis_turns_commanded.yaml").read_text())
    assert "program" in written["recordings"]["accel_x"]
    assert "program" not in written["recordings"]["validation"]


def test_a_sheet_alone_comes_with_the_programs_that_it_names(tmp_path: Path) -> None:
    units = [{"unit": "U", "table_log": {"kind": "program"}, "course": SHORT}]
    write_campaign(description_from({"units": units}, "test"), tmp_path, sheet_only=True)
    assert (tmp_path / "configs" / "procedure" / "three_axis_turns_commanded.yaml").is_file()
    assert not (tmp_path / "raw").exists()


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"table_log": {"kind": "tape"}}, "table_log: kind is 'tape'; it must be 'rows', 'file' or 'program'"),
        ({"table_log": {"offset": 1.0}}, "table_log: offset is not known; known: drift_ppm"),
        ({"table_log": {"kind": "file"}, "format": "mcap"}, "written in csv only"),
        ({"table_log": {"kind": "file"}, "procedure": "multi_position", "table": "hand"}, "has no table to log"),
        ({"table_log": {"kind": "program"}, "procedure": "one_recording"}, "moves that no program describes"),
    ],
)
def test_a_layout_that_makes_no_sense_is_refused(keys: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message.replace("(", r"\(")):
        UnitDescription("U", **keys)


def test_units_that_follow_different_programs_under_one_name_are_refused(tmp_path: Path) -> None:
    units = [
        {"unit": f"U{s:.0f}", "table_log": {"kind": "program"}, "course": {**SHORT, "step_deg": s}}
        for s in (30.0, 15.0)
    ]
    with pytest.raises(ConfigurationError, match="unit U15: its table follows another program"):
        write_campaign(description_from({"units": units}, "test"), tmp_path)
