"""Recordings that a sheet lists, against the truth of a simulation that shares no code with the package."""

from __future__ import annotations

import csv
import json
import re
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import scipy

import pipeline
from pipeline.app.field_logs.stream import compensate_log
from pipeline.core.errors import InputError, NotObservableError
from pipeline.core.records import SensorCalibration
from pipeline.output.pages.held_out_section import over_temperature
from pipeline.physics.compensation import load
from pipeline.physics.statements import not_determined
from tests.study.listed_recordings import (
    RATE_HZ,
    TAU_S,
    WANDER,
    WHITE,
    Unit,
    at_rest,
    joined,
    on_table,
    rotation,
    run,
    table,
    turned,
)

if TYPE_CHECKING:
    from pathlib import Path

SENSOR = "mpu6050"


def calibrated(folder: Path, *overrides: str) -> Any:
    return pipeline.calibrate(folder, sensor=SENSOR, procedure="listed", overrides=list(overrides))


def errors(unit: Unit, document: dict[str, Any], sensor: str, *, in_case: bool = False) -> np.ndarray:
    """Error over U of bias and matrix: (12,); 0 where U is 0."""
    part = document[sensor]
    value = np.concatenate([part["bias"], np.ravel(part["matrix"])]) - unit.truth(sensor, in_case=in_case)
    U = np.concatenate([part["expanded_uncertainty"]["bias"], np.ravel(part["expanded_uncertainty"]["matrix"])])
    return np.where(U > 0.0, value / np.where(U > 0.0, U, 1.0), 0.0)


def with_three_turns(folder: Path, angle: float = 360.0, sensors: str = "g") -> Unit:
    """A rest, and a turn about each axis by a stop; without an accelerometer by default."""
    unit, up = Unit(folder, np.random.default_rng(4)), np.array([0.0, 0.0, 1.0])
    unit.write("still", "rest,,,,", *at_rest(20.0, up), sensors)
    for axis, e in zip("xyz", np.eye(3), strict=True):
        turn = joined(at_rest(4.0, up), turned(angle, 90.0, e, up), at_rest(4.0, up))
        unit.write(f"turn_{axis}", f"turn,{axis},{angle:g},0.05,", *turn, sensors)
    unit.sheet()
    return unit


def test_three_turns_and_a_rest_calibrate_a_gyroscope(tmp_path: Path) -> None:
    unit = with_three_turns(tmp_path)
    found = calibrated(tmp_path, "procedure.turns.axis_accuracy_deg=0.1").calibration
    assert found["accelerometer"] is None
    part = found["gyroscope"]
    assert np.abs(errors(unit, found, "gyroscope", in_case=True)).max() < 1.5
    assert set(np.ravel(part["determined_by"]["matrix"])) == {"recordings"}
    scale = np.diag(part["expanded_uncertainty"]["matrix"])
    assert np.all(scale < 4.0 * 0.05 / 360.0 + 2.0 * 0.1 / 360.0 * 16.0)  # the stop, and the bias over eight seconds


@pytest.mark.parametrize(("stated", "departs"), [(360.0, False), (357.5, True)])
def test_a_held_out_turn_whose_stated_angle_is_wrong_is_a_reference_in_doubt(
    stated: float, *, departs: bool, tmp_path: Path
) -> None:
    unit, up = with_three_turns(tmp_path), np.array([0.0, 0.0, 1.0])
    turn = joined(at_rest(4.0, up), turned(360.0, 90.0, np.eye(3)[2], up), at_rest(4.0, up))
    unit.write("judge", f"turn,z,{stated:g},0.05,yes", *turn, "g")
    unit.sheet()
    found = calibrated(tmp_path, "procedure.turns.axis_accuracy_deg=0.1")
    assert ("turn_departures" in found.validation) is departs
    assert (found.verdict["gyroscope"] == "reference_in_doubt") is departs
    assert ("judge is 2.5 deg off" in found.diagnosis["gyroscope"]["reason"]) is departs


def test_an_axis_that_is_known_to_a_degree_leaves_the_cross_axis_terms_to_the_sensor_file(tmp_path: Path) -> None:
    with_three_turns(tmp_path)
    result = calibrated(tmp_path)
    by = np.array(result.calibration["gyroscope"]["determined_by"]["matrix"])
    assert set(by[~np.eye(3, dtype=bool)]) == {"sensor_file"}
    assert result.verdict["gyroscope"] == "not_enough_data"
    U = np.array(result.calibration["gyroscope"]["expanded_uncertainty"]["matrix"])
    assert np.all(np.diag(U) < 0.002)  # the turns give the scale, whatever the axes: its limit is 0.03
    limit = 0.02 / np.sqrt(3.0)  # cross_axis of the sensor file
    assert np.all(U[~np.eye(3, dtype=bool)] > 1.5 * limit)
    assert np.all(U[~np.eye(3, dtype=bool)] < 2.5 * limit)


def test_the_setting_that_would_determine_cross_axis_terms_is_named_and_does(tmp_path: Path) -> None:
    with_three_turns(tmp_path)
    open_ = not_determined(calibrated(tmp_path).calibration["gyroscope"])
    assert open_.startswith("the recordings do not determine matrix_xy, matrix_xz, matrix_yx")
    named = re.search(r"(procedure\.turns\.axis_accuracy_deg) \(now 1\.5\) to ([\d.]+) or less", open_)
    assert named
    found = calibrated(tmp_path, f"{named[1]}={named[2]}").calibration["gyroscope"]
    assert set(np.ravel(found["determined_by"]["matrix"])) == {"recordings"}
    assert not not_determined(found)


def test_a_scale_factor_by_turns_is_of_the_recordings_though_the_sensor_file_holds_the_axes(tmp_path: Path) -> None:
    unit, up = Unit(tmp_path, np.random.default_rng(9)), np.array([0.0, 0.0, 1.0])
    for axis, e in zip("xyz", np.eye(3), strict=True):
        turn = joined(at_rest(4.0, up), turned(360.0, 90.0, e, up), at_rest(4.0, up))
        unit.write(f"turn_{axis}", f"turn,{axis},360,0.5,", *turn)
    unit.sheet()
    part = calibrated(tmp_path).calibration["gyroscope"]
    assert {part["determined_by"]["matrix"][i][i] for i in range(3)} == {"recordings"}


@pytest.mark.parametrize("sensors", ["g", "ag"])
def test_bias_and_noise_are_no_departure_of_a_turn_whose_angle_is_stated_as_exact(tmp_path: Path, sensors: str) -> None:
    # In ten seconds the bias between files turns by 0.1 deg, ten times the stated accuracy.
    unit, up = Unit(tmp_path, np.random.default_rng(10)), np.array([0.0, 0.0, 1.0])
    unit.write("still", "rest,,,,", *at_rest(60.0, up), sensors)
    for axis, e in zip("xyz", np.eye(3), strict=True):
        turn = joined(at_rest(4.0, up), turned(360.0, 90.0, e, up), at_rest(4.0, up))
        unit.write(f"turn_{axis}", f"turn,{axis},360,0.01,", *turn, sensors)
    unit.sheet()
    result = calibrated(tmp_path)
    assert result.verdict["gyroscope"] == "not_enough_data"
    assert not [d for s in result.calibration["gyroscope"]["stages"] for d in s["details"].get("departures", ())]


def test_two_turns_that_contradict_each_other_are_doubted(tmp_path: Path) -> None:
    unit = with_three_turns(tmp_path)
    up, e = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
    turn = joined(at_rest(4.0, up), turned(366.0, 90.0, e, up), at_rest(4.0, up))
    unit.write("again", "turn,x,360,0.05,", *turn, "g")
    unit.sheet()
    result = calibrated(tmp_path)
    assert result.verdict["gyroscope"] == "reference_in_doubt"
    assert "times angle_accuracy_deg with noise and bias" in result.diagnosis["gyroscope"]["reason"]


def test_rests_beside_a_turn_are_found_without_an_accelerometer(tmp_path: Path) -> None:
    unit = with_three_turns(tmp_path)
    stage = calibrated(tmp_path).calibration["gyroscope"]["stages"][-1]["details"]
    assert stage["rests"] == 7  # one alone, and two beside each turn
    for turn in stage["turns"]:
        assert turn["time_s"] == pytest.approx(4.0, abs=0.6)
    assert unit.rows


@pytest.mark.parametrize("sensors", ["g", "ag"])
def test_a_turn_that_begins_and_ends_slowly_is_used_whole(tmp_path: Path, sensors: str) -> None:
    unit, e, up = Unit(tmp_path, np.random.default_rng(8)), np.eye(3)[0], np.array([0.8, 0.0, 0.6])
    unit.write("still", "rest,,,,", *at_rest(20.0, up), sensors)
    turn = joined(at_rest(3.0, up), turned(720.0, 55.0, e, up), at_rest(3.0, up))  # 3 deg in its first two seconds
    unit.write("turn", "turn,x,720,0.1,", *turn, sensors)
    unit.sheet()
    found = calibrated(tmp_path).calibration
    assert found["gyroscope"]["expanded_uncertainty"]["matrix"][0][0] < 0.002
    assert abs(errors(unit, found, "gyroscope", in_case=sensors == "g")[3]) < 1.5


def test_limits_and_axes_share_the_error_of_the_accelerometers_frame(tmp_path: Path) -> None:
    with_three_turns(tmp_path, sensors="ag")
    found = calibrated(tmp_path).calibration["gyroscope"]
    across = np.array(found["expanded_uncertainty"]["matrix"])[~np.eye(3, dtype=bool)]
    frame = cross = 0.02 / np.sqrt(3.0)  # cross_axis of either sensor in the sensor file
    axis = np.radians(1.5)  # axis_accuracy_deg; whole turns: gravity is where it was, and shows no axis
    u = np.sqrt(frame**2 + cross**2 * axis**2 / (cross**2 + axis**2))
    assert across == pytest.approx(np.full(6, 1.96 * u), rel=0.05)


def test_a_turn_in_the_other_sense_is_refused_with_the_angle_that_agrees(tmp_path: Path) -> None:
    with_three_turns(tmp_path, angle=-360.0)
    sheet = tmp_path / "recordings.csv"
    sheet.write_text(sheet.read_text().replace("turn,y,-360", "turn,y,360"))
    with pytest.raises(Exception, match=r"turn_y is no turn about y by 360 deg.*angle_deg -360 would agree"):
        calibrated(tmp_path)


def test_a_turn_by_another_angle_is_refused_with_the_angle_that_it_shows(tmp_path: Path) -> None:
    with_three_turns(tmp_path, angle=90.0)
    sheet = tmp_path / "recordings.csv"
    sheet.write_text(sheet.read_text().replace("turn,y,90", "turn,y,180"))
    with pytest.raises(Exception, match=r"turn_y is no turn about y by 180 deg.*angle_deg (8\d|9\d) would agree"):
        calibrated(tmp_path)


def test_cholesky_and_lu_do_not_use_rests_that_are_held_out(tmp_path: Path) -> None:
    """Sixteen rests of moves, of which every third is held out, one rest alone, and two of each of three turns."""
    unit, up = with_three_turns(tmp_path, sensors="ag"), np.array([0.0, 0.0, 1.0])
    parts = [at_rest(4.0, up)]
    for k in range(15):
        parts.append(turned(90.0, 90.0, np.eye(3)[k % 3], parts[-1][0][-1]))
        parts.append(at_rest(4.0, parts[-1][0][-1]))
    unit.write("moves", "moves,,,,", *joined(*parts))
    unit.sheet()
    found = pipeline.calibrate(tmp_path, sensor=SENSOR, procedure="listed", method="cholesky_lu").calibration
    (bias, _) = found["gyroscope"]["stages"]
    assert bias["details"]["rests"] == 16 - 5 + 1 + 6


def test_cholesky_and_lu_work_on_turns_by_known_angles(tmp_path: Path) -> None:
    unit = with_three_turns(tmp_path)
    result = pipeline.calibrate(
        tmp_path, sensor=SENSOR, procedure="listed", method="cholesky_lu", overrides=["diagnosis.depth=standard"]
    )
    part = result.calibration["gyroscope"]
    assert [stage["name"] for stage in part["stages"]] == ["bias", "cholesky_lu"]
    assert np.abs(errors(unit, result.calibration, "gyroscope", in_case=True)).max() < 1.5
    # S T M of the true forward matrix, by their definition
    L, found = np.linalg.cholesky(unit.K["gyroscope"] @ unit.K["gyroscope"].T), part["stages"][-1]["parameters"]
    for i, axis in enumerate("xyz"):
        S = found[f"S_{axis}"]
        assert abs(S["value"] - L[i, i]) < 3.0 * S["standard_uncertainty"]
    # One turn by 360 deg an axis: the axis' 1.5 deg are the uncertainty of each cross-axis term.
    u = np.array(part["standard_uncertainty"]["matrix"])
    assert u[~np.eye(3, dtype=bool)] == pytest.approx(np.radians(1.5), rel=0.1)


@pytest.mark.parametrize(("sensors", "logged"), [("ag", "angle"), ("g", "rate")])
def test_turns_on_a_table_and_by_hand_are_one_calibration(tmp_path: Path, sensors: str, logged: str) -> None:
    unit = Unit(tmp_path, np.random.default_rng(11))
    table(unit, sensors, logged)
    unit.sheet()
    overrides = ["table.seat_deg=null", "diagnosis.depth=standard"]
    result = pipeline.calibrate(tmp_path, sensor=SENSOR, table="single_axis", procedure="listed", overrides=overrides)
    found = result.calibration
    for sensor in ("accelerometer", "gyroscope") if sensors == "ag" else ("gyroscope",):
        assert np.abs(errors(unit, found, sensor, in_case=sensors == "g")).max() < 1.5
        assert set(np.ravel(found[sensor]["determined_by"]["matrix"])) == {"recordings"}
    turns_ = found["gyroscope"]["stages"][-1]["details"]["turns"]
    assert [sum(t["recording"] == name for t in turns_) for name in ("table_x", "table_z", "hand")] == [8, 8, 1]
    U = np.array(found["gyroscope"]["expanded_uncertainty"]["matrix"])
    assert np.all(np.diag(U) < 3e-4)  # 0.014 deg of 315, and the bias: the turn by hand alone leaves 3e-3
    assert result.verdict["gyroscope"] in {"nothing_missing", "not_enough_data"}


def test_a_table_that_turned_the_other_way_or_logs_nothing_is_refused(tmp_path: Path) -> None:
    unit = Unit(tmp_path, np.random.default_rng(12))
    on_table(unit, "g", 0, "angle")
    unit.sheet()
    with pytest.raises(NotObservableError, match=r"no turn about x as the table logged.*axis -x would agree"):
        calibrated(tmp_path, "table.sense=-1")
    log = tmp_path / "table_x.csv"
    log.write_text("\n".join(line.rpartition(",")[0] for line in log.read_text().splitlines()) + "\n")
    with pytest.raises(InputError, match="neither the angle nor the rate of a table"):
        calibrated(tmp_path)


def test_few_rests_near_a_plane_do_not_lead_away_from_the_sensor_files_limits() -> None:
    ratios = [ratio for name, ratio, _ in run(3, kind="turns", seed=40)["accelerometer"]]
    assert np.abs(ratios).max() < 1.5  # they were up to 71


def test_a_bad_sheet_is_the_error_of_its_unit(tmp_path: Path) -> None:
    (tmp_path / "recordings.csv").write_text("file,kind\na.csv,resting\n")
    with pytest.raises(InputError, match="column kind: 'resting'"):
        calibrated(tmp_path)


def test_24_means_calibrate_an_accelerometer_and_25_others_judge_it(tmp_path: Path) -> None:
    unit = Unit(tmp_path, np.random.default_rng(5))
    for name, count, held in (("fit", 24, ""), ("other", 25, "yes")):
        up = unit.rng.normal(size=(count, 3))
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        mean = unit.bias["accelerometer"] + up @ unit.K["accelerometer"].T + 2e-4 * unit.rng.normal(size=(count, 3))
        header = "accel_x_g,accel_y_g,accel_z_g"
        np.savetxt(tmp_path / f"{name}.csv", mean, fmt="%.8g", delimiter=",", header=header, comments="")
        unit.rows.append(f"{name}.csv,attitudes,,,,{held}")
    unit.sheet()
    result = calibrated(tmp_path)
    assert np.abs(errors(unit, result.calibration, "accelerometer")).max() < 1.2
    judged = result.validation["accelerometer"]
    assert judged["held_out"]
    assert judged["samples"] == 25
    assert judged["steps"][-1]["rms_error"] < 4e-4
    assert set(np.ravel(result.calibration["accelerometer"]["determined_by"]["matrix"])) == {"recordings"}


def test_the_scatter_of_means_states_their_noise_where_it_is_less_than_assumed(tmp_path: Path) -> None:
    unit, true = Unit(tmp_path, np.random.default_rng(4)), 5e-5  # g; averages over a minute, of a steady sensor
    up = unit.rng.normal(size=(50, 3))
    mean = unit.bias["accelerometer"] + up / np.linalg.norm(up, axis=1)[:, None] @ unit.K["accelerometer"].T
    mean += true * unit.rng.normal(size=(50, 3))
    header = "accel_x_g,accel_y_g,accel_z_g"
    np.savetxt(tmp_path / "means.csv", mean, fmt="%.8g", delimiter=",", header=header, comments="")
    unit.rows.append("means.csv,attitudes,,,,")
    unit.sheet()
    found = calibrated(tmp_path).calibration
    stated = found["accelerometer"]["stages"][0]["details"]["noise_of_means"]
    assert stated == pytest.approx(true, rel=3.0 / np.sqrt(2.0 * 41))  # 41 degrees of freedom, three deviations
    assert np.abs(errors(unit, found, "accelerometer")).max() < 1.2
    # Bias of 50 attitudes on a sphere: 2 sigma sqrt(3 / 50), and half as much again for attitudes at random
    assert max(found["accelerometer"]["expanded_uncertainty"]["bias"]) < 1.5 * 2.0 * true * np.sqrt(3.0 / 50.0)


def test_blocks_of_rows_with_a_label_are_attitudes(tmp_path: Path) -> None:
    unit = Unit(tmp_path, np.random.default_rng(6))
    lines = ["label,accel_x_g,accel_y_g,accel_z_g"]
    for k in range(12):
        up = unit.rng.normal(size=3)
        mean = unit.bias["accelerometer"] + unit.K["accelerometer"] @ up / np.linalg.norm(up)
        rows = mean + 1e-3 * unit.rng.normal(size=(20, 3))
        lines += [f"attitude {k}," + ",".join(f"{v:.7f}" for v in row) for row in rows]
    (tmp_path / "samples.csv").write_text("\n".join(lines) + "\n")
    unit.rows.append("samples.csv,attitudes,,,,")
    unit.sheet()
    found = calibrated(tmp_path).calibration
    assert found["accelerometer"]["stages"][0]["details"]["orientations_used"] == 12
    (file,) = found["inputs"]
    assert file["missing_s"] == 0.0
    assert {note["code"] for note in file["notes"]} == {"N-ABSENT"}  # the label is used, and its rows miss no time
    assert np.abs(errors(unit, found, "accelerometer")).max() < 1.2


def test_samples_of_one_attitude_are_no_attitudes(tmp_path: Path) -> None:
    unit = Unit(tmp_path, np.random.default_rng(8))
    unit.write("still", "attitudes,,,,", *at_rest(9.0, np.array([0.0, 0.6, 0.8])), "a")
    unit.sheet()
    with pytest.raises(InputError, match="gravity turns by 0") as refused:
        calibrated(tmp_path)
    assert "still.csv" in str(refused.value)


def test_an_axis_that_stops_for_a_while_is_no_internal_error_without_an_accelerometer(tmp_path: Path) -> None:
    unit, up = Unit(tmp_path, np.random.default_rng(8)), np.array([0.0, 0.0, 1.0])
    unit.write("still", "rest,,,,", *at_rest(20.0, up), "g")
    turns = [joined(at_rest(4.0, up), turned(360.0, 90.0, e, up), at_rest(4.0, up)) for e in np.eye(3)]
    for axis, turn in zip("xyz", turns, strict=True):
        unit.write(f"turn_{axis}", f"turn,{axis},360,0.05,", *turn, "g")
    unit.sheet()
    lines = (tmp_path / "still.csv").read_text().splitlines()
    held = lines[1].rpartition(",")[2]
    lines[1:900] = [f"{line.rpartition(',')[0]},{held}" for line in lines[1:900]]
    (tmp_path / "still.csv").write_text("\n".join(lines) + "\n")
    found = calibrated(tmp_path).calibration["gyroscope"]
    assert np.isfinite(found["bias"]).all()


def test_a_long_soak_determines_the_bias_at_low_frequencies(tmp_path: Path) -> None:
    rng, rate, n, tau = np.random.default_rng(8), 2.0, 10800, 100.0
    keep, white = np.exp(-1.0 / (rate * tau)), 5e-3 * np.sqrt(rate / 2.0)
    drive = 3e-3 * np.sqrt(1.0 - keep**2) * rng.normal(size=(n, 3))
    wander = scipy.signal.lfilter([1.0], [1.0, -keep], drive, axis=0)
    time = np.arange(n) / rate
    warm = 30.0 * np.sin(2.0 * np.pi * time / 5400.0)
    gyro = np.outer(warm, [0.01, -0.02, 0.03]) + wander + white * rng.normal(size=(n, 3))
    header = "time_s,gyro_x_dps,gyro_y_dps,gyro_z_dps,temperature_degc"
    table = np.column_stack([time, gyro, 25.0 + warm])
    np.savetxt(tmp_path / "soak.csv", table, fmt="%.8g", delimiter=",", header=header, comments="")
    (tmp_path / "recordings.csv").write_text("file,kind\nsoak.csv,soak\n")
    stages = calibrated(tmp_path, "effects.gyroscope=[bias_temperature]").calibration["gyroscope"]["stages"]
    details = stages[-1]["details"]
    found = details["wander_ratio"] ** 2 * details["wander_time_s"]
    # 27 independent values of each of 3 axes: a variance to sqrt(2 / 81) = 16 %, here within 2.5 times that
    assert found == pytest.approx((3e-3 / white) ** 2 * tau, rel=0.4)


def test_a_soak_shows_bias_over_temperature_to_the_third_power(tmp_path: Path) -> None:
    rng, rate, n = np.random.default_rng(7), 2.0, 5400
    time = np.arange(n) / rate
    for name, phase in (("soak", 0.0), ("other", 1.0)):
        warm = 40.0 * np.sin(2.0 * np.pi * time / 2700.0 + phase)
        gyro = np.outer(warm, [0.01, -0.02, 0.03]) + np.outer(warm**3, [2e-6, -3e-6, 1e-6]) + [0.5, -1.0, 2.0]
        force = np.outer(warm, [1e-4, -2e-4, 3e-4]) + np.array([0.01, -0.02, 1.03])
        noise = rng.normal(size=(n, 6)) * np.repeat([4e-4, 5e-3], 3) * np.sqrt(rate / 2.0)
        table = np.column_stack([time, np.column_stack([force, gyro]) + noise, 25.0 + warm])
        header = "time_s,accel_x_g,accel_y_g,accel_z_g,gyro_x_dps,gyro_y_dps,gyro_z_dps,temperature_degc"
        np.savetxt(tmp_path / f"{name}.csv", table, fmt="%.8g", delimiter=",", header=header, comments="")
    (tmp_path / "recordings.csv").write_text("file,kind,held_out\nsoak.csv,soak,\nother.csv,soak,yes\n")
    result = calibrated(tmp_path, "effects.accelerometer=auto", "effects.gyroscope=auto")
    effects = {s: result.calibration[s]["effects"][0] for s in ("accelerometer", "gyroscope")}
    assert effects["gyroscope"]["name"] == "bias_temperature_cubic"
    assert effects["accelerometer"]["name"] == "bias_temperature"
    for axis, cubic, linear in (("x", 2e-6, 1e-4), ("y", -3e-6, -2e-4), ("z", 1e-6, 3e-4)):
        b3 = effects["gyroscope"]["parameters"][f"b_T3_{axis}"]
        b1 = effects["accelerometer"]["parameters"][f"b_T_{axis}"]
        assert abs(b3["value"] - cubic) < 1.5 * b3["expanded_uncertainty"] < 0.1 * abs(cubic)
        assert abs(b1["value"] - linear) < 1.5 * b1["expanded_uncertainty"] < 0.05 * abs(linear)
    steps = result.validation["gyroscope"]["steps"]
    assert steps[-1]["rms_error"] < 0.01
    assert steps[0]["rms_error"] > 1.0
    assert result.calibration["calibrated_range"]["temperature_degc"] == pytest.approx([-15.0, 65.0], abs=0.5)
    figure = over_temperature(result._state.fits["gyroscope"], result._state.recordings.filtered)
    changes, beyond = map(float, re.findall(r"by ([\d.]+) deg/s", figure.finding))
    bias = np.outer(warm, [0.01, -0.02, 0.03]) + np.outer(warm**3, [2e-6, -3e-6, 1e-6])
    assert changes == pytest.approx(np.sqrt(np.mean((bias - bias.mean(axis=0)) ** 2)), rel=0.03)
    assert beyond < 0.01 * changes
    assert {"warming", "cooling"} <= {text for _, text in figure.legend}


# A thermometer that follows the die with a time constant, s; a bias that differs between heating and cooling, deg/s.
@pytest.mark.parametrize(
    ("lag", "loop", "named"), [(0.0, 0.0, []), (30.0, 0.0, []), (0.0, 0.05, ["temperature_hysteresis"])]
)
def test_a_soak_that_heats_and_cools_shows_lag_and_hysteresis(
    tmp_path: Path, lag: float, loop: float, named: list[str]
) -> None:
    rng, n, b_T = np.random.default_rng(14), 5400, np.array([0.01, -0.02, 0.03])
    time, keep = np.arange(n) / 1.0, np.exp(-1.0 / lag) if lag else 0.0
    die = 30.0 * np.sin(np.pi * time / n) ** 2
    warm = scipy.signal.lfilter([1.0 - keep], [1.0, -keep], die)  # the thermometer
    heats = np.tanh(np.gradient(die) / 0.005)
    gyro = np.outer(die, b_T) + loop * np.outer(heats, [1.0, -1.0, 1.0]) + [0.5, -1.0, 2.0]
    table_ = np.column_stack([time, gyro + 5e-3 * np.sqrt(0.5) * rng.normal(size=(n, 3)), 25.0 + warm])
    header = "time_s,gyro_x_dps,gyro_y_dps,gyro_z_dps,temperature_degc"
    np.savetxt(tmp_path / "soak.csv", table_, fmt="%.8g", delimiter=",", header=header, comments="")
    (tmp_path / "recordings.csv").write_text("file,kind\nsoak.csv,soak\n")
    found = calibrated(tmp_path, "effects.gyroscope=auto")
    diagnosis, effects = found.diagnosis["gyroscope"], found.calibration["gyroscope"]["effects"]
    assert [each["covariate"] for each in diagnosis["unexplained"]] == named
    assert ("heating or cooling (hysteresis)" in diagnosis["reason"]) is bool(loop)
    assert ("temperature_lag" in [e["name"] for e in effects]) is bool(lag)
    if not loop:
        assert [e["name"] for e in effects] == ["bias_temperature", "temperature_lag"][: 1 + bool(lag)]
    if lag:
        b_tau = keep / (1.0 - keep) * b_T  # by the mean delay of the filter in s, which is near the lag
        pairs = zip(effects[1]["parameters"].values(), b_tau, strict=True)
        assert all(abs(p["value"] - b) < 1.5 * p["expanded_uncertainty"] for p, b in pairs)


def test_hysteresis_does_not_move_the_mean_of_a_soak(tmp_path: Path) -> None:
    """The part nearest to 25 degC is on one side of the loop."""
    rng, n = np.random.default_rng(3), 3600
    warm = -30.0 * np.cos(2.0 * np.pi * np.arange(n) / n)
    force = 1e-3 * rng.normal(size=(n, 3))
    force[:, 2] += 1.01 + 3e-4 * warm + 5e-3 * np.tanh(np.gradient(warm) / 0.01)
    header = "time_s,accel_x_g,accel_y_g,accel_z_g,temperature_degc"
    table_ = np.column_stack([np.arange(n), force, 25.0 + warm])
    np.savetxt(tmp_path / "soak.csv", table_, fmt="%.8g", delimiter=",", header=header, comments="")
    rows = "file,kind\nsoak.csv,soak\n"
    (tmp_path / "recordings.csv").write_text(rows)
    part = calibrated(tmp_path, "effects.accelerometer=[bias_temperature]").accelerometer
    assert part.matrix[2, 2] * (1.01 - part.bias[2]) == pytest.approx(1.0, abs=5e-4)  # a tenth of the loop
    for k, up in enumerate([*np.eye(3), *-np.eye(3), *(np.eye(3) * 0.6 + np.roll(np.eye(3), 1, axis=0) * 0.8)]):
        rest = np.column_stack([np.arange(60), up + 1e-3 * rng.normal(size=(60, 3))])
        np.savetxt(tmp_path / f"{k}.csv", rest, fmt="%.8g", delimiter=",", header=header[:-17], comments="")
        rows += f"{k}.csv,rest\n"
    (tmp_path / "recordings.csv").write_text(rows)
    assert "failed" not in calibrated(tmp_path).diagnosis["accelerometer"]  # as rests without a temperature made it


def test_held_out_turns_without_rests_state_their_angle(tmp_path: Path) -> None:
    unit, x = with_three_turns(tmp_path), np.eye(3)[0]
    unit.write("other", "turn,x,360,3,yes", *turned(361.5, 90.0, x, np.eye(3)[2]), "g", between=0.0)
    unit.sheet()
    found = calibrated(tmp_path)
    (turn,) = found.validation["turns"]
    assert (turn["recording"], turn["axis"], turn["stated_deg"]) == ("other", "x", 360.0)
    assert abs(turn["angle_deg"]["after"] - 361.5) < 4.0 < abs(turn["angle_deg"]["before"] - 361.5)
    assert 3.0 < turn["standard_uncertainty_deg"] < 6.0
    found.report(tmp_path / "page.html")
    assert "of the angle of 1 held-out turn" in (tmp_path / "page.html").read_text()


@pytest.mark.parametrize("cycles", [1, 2])
def test_a_drift_is_told_from_hysteresis_by_a_second_cycle(tmp_path: Path, cycles: int) -> None:
    rng, n = np.random.default_rng(5), 5400
    time = np.arange(float(n))
    warm = 30.0 * np.sin(2.0 * np.pi * cycles * time / n)
    gyro = np.outer(warm, [0.005, -0.01, 0.015]) + np.outer(time, [2e-5, -3e-5, 1e-5]) + [0.5, -1.0, 2.0]
    table_ = np.column_stack([time, gyro + 5e-3 * np.sqrt(0.5) * rng.normal(size=(n, 3)), 25.0 + warm])
    header = "time_s,gyro_x_dps,gyro_y_dps,gyro_z_dps,temperature_degc"
    np.savetxt(tmp_path / "soak.csv", table_, fmt="%.8g", delimiter=",", header=header, comments="")
    (tmp_path / "recordings.csv").write_text("file,kind\nsoak.csv,soak\n")
    found = calibrated(tmp_path, "effects.gyroscope=auto")
    named, diagnosis = [e["name"] for e in found.calibration["gyroscope"]["effects"]], found.diagnosis["gyroscope"]
    assert ("bias_drift" in named) is (cycles > 1)
    reasons = {each["effect"]: each["reason"] for each in diagnosis["not_observable"]}
    assert ("bias_drift" in reasons) is (cycles == 1)
    if cycles == 1:
        assert "twice in one direction" in reasons["bias_drift"]


def test_a_lag_below_its_gate_is_no_hysteresis(tmp_path: Path) -> None:
    rng, n, keep = np.random.default_rng(27), 5400, np.exp(-0.5)  # a lag of 2 s; here hysteresis passes the test, too
    die = 30.0 * np.sin(np.pi * np.arange(n) / n) ** 2
    warm = scipy.signal.lfilter([1.0 - keep], [1.0, -keep], die)
    gyro = np.outer(die, [0.005, -0.01, 0.015]) + [0.5, -1.0, 2.0] + 5e-3 * np.sqrt(0.5) * rng.normal(size=(n, 3))
    header = "time_s,gyro_x_dps,gyro_y_dps,gyro_z_dps,temperature_degc"
    rows = np.column_stack([np.arange(float(n)), gyro, 25.0 + warm])
    np.savetxt(tmp_path / "soak.csv", rows, fmt="%.8g", delimiter=",", header=header, comments="")
    (tmp_path / "recordings.csv").write_text("file,kind\nsoak.csv,soak\n")
    found = calibrated(tmp_path, "effects.gyroscope=auto").diagnosis["gyroscope"]
    assert found["selected"] == ["bias_temperature"]
    assert found["unexplained"] == []


def test_the_wander_of_soaks_is_no_difference_between_them_too(tmp_path: Path) -> None:
    """The means of two soaks differ by the wander, which counted a second time as a bias that differs between files."""
    unit, seconds = Unit(tmp_path, np.random.default_rng(8)), 4000.0
    for number in range(2):
        n = round(seconds * 5.0)
        warm = 20.0 * np.sin(2.0 * np.pi * np.arange(n) / n)
        still = np.tile([0.0, 0.0, 1.0], (n, 1)), np.zeros((n, 3))
        unit.write(f"soak_{number}", "soak,,,,", *still, warmth=25.0 + warm, hz=5.0, between=0.0)
    unit.sheet()
    part = calibrated(tmp_path, "effects.gyroscope=[bias_temperature]").calibration["gyroscope"]
    x = seconds / TAU_S
    # 20 independent values of 3 axes in 2 soaks show a variance to sqrt(2 / 120) = 13 %; three times that of U
    of_mean = WANDER["gyroscope"] * np.sqrt(2.0 * (x - 1.0 + np.exp(-x))) / x  # of an exponential autocorrelation
    assert np.mean(part["standard_uncertainty"]["bias"]) == pytest.approx(of_mean / np.sqrt(2.0), rel=0.2)


def test_the_bias_of_few_files_has_their_degrees_of_freedom(tmp_path: Path) -> None:
    """Four means of three axes that scatter alike show a variance with 3 (4 - 1) degrees of freedom."""
    unit = Unit(tmp_path, np.random.default_rng(12))
    for number in range(4):
        unit.write(f"rest_{number}", "rest,,,,", *at_rest(20.0, np.array([0.0, 0.0, 1.0])), "g", between=0.1)
    unit.sheet()
    part = calibrated(tmp_path).calibration["gyroscope"]
    assert part["effective_degrees_of_freedom"][:3] == pytest.approx([9.0] * 3, rel=0.05)
    assert part["coverage_factor"]["bias"] == pytest.approx([scipy.stats.t.ppf(0.975, 9)] * 3, rel=0.01)


def test_rests_of_one_file_share_the_wander_where_they_are_as_many_as_parameters(tmp_path: Path) -> None:
    """Against the covariance of the exact equations ``|M (y - b)| = 1`` with white noise and the wander."""
    unit, rng, seconds = Unit(tmp_path, np.random.default_rng(2)), np.random.default_rng(3), 10.0
    up, middle = [], []
    for number in range(5):
        start, axis = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        end = rotation(axis, np.array([-np.radians(150.0)]))[0] @ start
        turn = turned(150.0, 60.0, axis, start)
        parts = joined(at_rest(seconds, start), turn, at_rest(seconds, end))
        unit.write(f"two_{number}", "moves,,,,", *parts, "a")
        up += [start, end]
        middle += [0.0, seconds + len(turn[0]) / RATE_HZ]
    unit.sheet()
    part = calibrated(tmp_path).calibration["accelerometer"]
    assert set(np.ravel(part["determined_by"]["bias"])) == {"recordings"}
    M, K = unit.frame() @ np.linalg.inv(unit.K["accelerometer"]), unit.K["accelerometer"]
    f = np.array(up) @ unit.frame().T
    by_matrix = np.einsum("ni,nj->nij", f, np.array(up) @ K.T)[:, *np.tril_indices(3)]
    J = np.concatenate([-f @ M, by_matrix], axis=1)
    apart, file = np.abs(np.subtract.outer(middle, middle)), np.arange(10) // 2
    together = np.where(np.equal.outer(file, file), np.exp(-apart / TAU_S), 0.0) * ((f @ M) @ (f @ M).T)
    of_white = WHITE["accelerometer"] ** 2 / (RATE_HZ * seconds) * np.sum((f @ M) ** 2, axis=1)
    C = WANDER["accelerometer"] ** 2 * together + np.diag(of_white)
    expected = np.sqrt(np.diag(np.linalg.inv(J.T @ np.linalg.solve(C, J))))
    assert part["standard_uncertainty"]["bias"] == pytest.approx(expected[:3].tolist(), rel=0.1)


@pytest.mark.parametrize("lag", [0.0, 30.0])
def test_a_lag_is_told_from_hysteresis_where_the_temperature_moves_at_one_rate(tmp_path: Path, lag: float) -> None:
    """There both have one curve; but a thermometer lags by one time for all axes."""
    rng, n, b_T = np.random.default_rng(15), 4800, np.array([0.01, -0.02, 0.03])
    die = np.interp(np.arange(n) / n, [0.0, 0.2, 0.3, 0.65, 0.75, 0.95, 1.0], [0.0, 25.0, 25.0, -25.0, -25.0, 0.0, 0.0])
    keep = np.exp(-1.0 / lag) if lag else 0.0
    warm = scipy.signal.lfilter([1.0 - keep], [1.0, -keep], die)
    loop = 0.0 if lag else 0.03 * np.outer(np.sign(np.gradient(die)), [1.0, 1.0, 1.0])
    gyro = np.outer(die, b_T) + loop + [0.5, -1.0, 2.0] + 5e-3 * np.sqrt(0.5) * rng.normal(size=(n, 3))
    header = "time_s,gyro_x_dps,gyro_y_dps,gyro_z_dps,temperature_degc"
    rows = np.column_stack([np.arange(float(n)), gyro, 25.0 + warm])
    np.savetxt(tmp_path / "soak.csv", rows, fmt="%.8g", delimiter=",", header=header, comments="")
    (tmp_path / "recordings.csv").write_text("file,kind\nsoak.csv,soak\n")
    found = calibrated(tmp_path, "effects.gyroscope=auto").diagnosis["gyroscope"]
    assert ("temperature_lag" in found["selected"]) is bool(lag)
    assert ("warm_up" in {e["effect"] for e in found["ranking"]}) is bool(lag)  # in one cycle it imitates hysteresis
    assert [each["covariate"] for each in found["unexplained"]] == ([] if lag else ["temperature_hysteresis"])


def test_rows_beyond_the_soaked_temperatures_are_marked_or_refused(tmp_path: Path) -> None:
    part = SensorCalibration("gyroscope").to_json()
    known = {"calibrated_range": {"temperature_degc": [-20.0, 80.0], "soaked_degc": [10.0, 40.0]}}
    document = {"schema_version": 2, "status": "ok", "unit": "U1", "accelerometer": None, "gyroscope": part, **known}
    calibration, log, out = (tmp_path / name for name in ("U1.json", "log.csv", "out.csv"))
    calibration.write_text(json.dumps(document))
    warm = [5.0, 10.0, 25.0, 40.0, 41.0]
    rows = [f"{k},0.1,0.2,0.3,{t}" for k, t in enumerate(warm)]
    log.write_text("\n".join(["time_s,gyro_x_dps,gyro_y_dps,gyro_z_dps,temperature_degc", *rows]) + "\n")
    compensation = load(calibration)
    result = compensate_log(compensation, log, out)
    written = list(csv.DictReader(out.read_text().splitlines()))
    assert [row["extrapolated"] for row in written] == ["1", "0", "0", "0", "1"]
    assert any("2 of 5 samples" in warning for warning in result.warnings)
    with pytest.raises(InputError, match=r"2 samples at 5\.0 to 41\.0 degC are beyond the soaked"):
        compensate_log(compensation, log, tmp_path / "refused.csv", strict=True)
    assert not (tmp_path / "refused.csv").exists()


def test_slow_movement_is_used_whole_and_its_accelerations_are_not_independent(tmp_path: Path) -> None:
    """Parts of 0.2 s follow one another; of a movement of 20 s one part was used."""
    rng, n, keep = np.random.default_rng(9), 2000, np.exp(-0.01 / 0.3)
    z, angle = np.linspace(-1.0, 1.0, n), np.linspace(0.0, 12.0 * np.pi, n)
    up = np.stack([np.sqrt(1.0 - z**2) * np.cos(angle), np.sqrt(1.0 - z**2) * np.sin(angle), z], axis=1)
    drive = 3e-3 * np.sqrt(1.0 - keep**2) * rng.normal(size=(n, 3))
    force = up + scipy.signal.lfilter([1.0], [1.0, -keep], drive, axis=0) + 1e-3 * rng.normal(size=(n, 3))
    table_, header = np.column_stack([np.arange(n) / 100.0, force]), "time_s,accel_x_g,accel_y_g,accel_z_g"
    np.savetxt(tmp_path / "f.csv", table_, fmt="%.8g", delimiter=",", header=header, comments="")
    (tmp_path / "recordings.csv").write_text("file,kind\nf.csv,slow\n")
    part = calibrated(tmp_path).calibration["accelerometer"]
    details = part["stages"][0]["details"]
    assert details["orientations_used"] == 100
    assert details["scatter_time_s"] == pytest.approx(0.3, abs=0.2)  # 60 independent values: ln of 0.5 +- 0.2
    assert set(part["determined_by"]["bias"]) == {"recordings"}


@pytest.mark.parametrize("kind", ["attitudes", "slow"])
def test_differences_between_attitudes_are_no_noise(tmp_path: Path, kind: str) -> None:
    """They were exported as 4 g/sqrt(Hz), and slow movement as a random walk."""
    rng = np.random.default_rng(3)
    angle = np.linspace(0.0, 40.0 * np.pi, 6000)  # through all attitudes on a spiral
    z = np.linspace(-1.0, 1.0, 6000)
    up = np.stack([np.sqrt(1.0 - z**2) * np.cos(angle), np.sqrt(1.0 - z**2) * np.sin(angle), z], axis=1)
    readings = up + 2e-3 * rng.normal(size=up.shape) if kind == "slow" else up[::120]
    time = np.arange(len(readings))[:, None] / 50.0
    names = "accel_x_g,accel_y_g,accel_z_g"
    table, header = (np.hstack([time, readings]), f"time_s,{names}") if kind == "slow" else (readings, names)
    np.savetxt(tmp_path / "f.csv", table, delimiter=",", header=header, comments="")
    (tmp_path / "recordings.csv").write_text(f"file,kind\nf.csv,{kind}\n")
    result = pipeline.calibrate(tmp_path, sensor="mpu6050", procedure="listed")
    noise = result.calibration["noise"]["accelerometer"]
    assert noise["axes"] is None
    assert noise["reason"] == "the recordings hold no readings of the accelerometer at rest"
    result.save(tmp_path / "out")
    (text,) = [f.read_text() for f in (tmp_path / "out" / "exports").glob("*/kalibr.yaml")]
    white = 4e-4 * 9.80665 / np.sqrt(2.0)  # of the sensor file, one-sided
    assert f"# accelerometer, white: {white:.4g} m/s^2/sqrt(Hz); of the sensor's configuration." in text
