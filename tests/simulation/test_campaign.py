"""Written campaigns against what was asked for, and the demo that ships against its description."""

import csv
import json
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.app.commands.simulate import main
from pipeline.app.config import load_campaign
from pipeline.checks.at_rest import check_axes
from pipeline.checks.evidence import ChannelLimits
from pipeline.checks.reference_scale import doubt_of_angle
from pipeline.core.errors import ConfigurationError, IngestError, MissingInputError
from pipeline.core.records import SENSORS, Recording
from pipeline.ingest.read import read_recordings
from pipeline.physics.kinematics import reference_motion
from pipeline.simulation.campaign import simulate_unit, write_campaign
from pipeline.simulation.description import (
    Course,
    UnitDescription,
    description_from,
    read_description,
    shipped_settings,
)

RECORD = Path(__file__).parents[2] / "docs" / "record.md"
DEMO = Path(__file__).parents[2] / "data" / "demo"
SHORT = {"step_deg": 30.0, "validation_s": 30.0, "static_s": 20.0}


def simulated(seed: int = 1, **keys: Any) -> tuple[dict[str, Recording], dict[str, Any]]:
    recordings, truth = simulate_unit(UnitDescription("U", **{"course": SHORT, **keys}), seed, 0)
    return {r.name: r for r in recordings}, truth


def read(folder: Path, procedure: str = "three_axis_turns", sensor: str = "mpu6050") -> dict[str, Recording]:
    settings = shipped_settings(procedure=procedure, sensor=sensor)
    return {r.name: r for r in read_recordings(settings.procedure, settings.ingest, settings.sensor, folder)}


def residual(recording: Recording, truth: dict[str, Any], sensor: str) -> np.ndarray:
    """What bias, matrix and the motion that the log implies leave of the readings."""
    motion = reference_motion(recording)
    assert motion is not None
    ideal = motion.specific_force if sensor == "accelerometer" else motion.angular_rate
    reading = recording.reading(sensor)
    assert reading is not None
    return np.asarray((reading - truth[sensor]["bias"]) @ np.array(truth[sensor]["matrix"]).T - ideal)


def files_of(folder: Path) -> dict[str, bytes]:
    return {str(f.relative_to(folder)): f.read_bytes() for f in sorted(folder.rglob("*")) if f.is_file()}


def test_long_rests_before_a_turn_give_no_refusal_and_no_doubt_but_faults_do() -> None:
    """In 100,000 samples at 0.12 s, rests of 9 minutes stand before turns of 6 s: less than a tenth of the rows."""
    recordings, _ = simulate_unit(UnitDescription("U", samples=100_000), 0, 0)
    turns = [r for r in recordings if r.role == "gyroscope"]
    rests = np.concatenate([r.table_rate == 0.0 for r in turns if r.table_rate is not None])
    assert rests.mean() > 0.95
    check_axes(recordings)
    limits = ChannelLimits.of(shipped_settings(sensor="mpu6050", table="acutronic"))
    assert [doubt_of_angle(turn, limits) for turn in turns] == [None] * 3
    wrong = [replace(r, table_angle=1.005 * r.table_angle) for r in turns if r.table_angle is not None]  # counts a turn
    told = [str(doubt_of_angle(turn, limits)).partition("turns ")[2].partition(" ")[0] for turn in wrong]
    assert [float(ratio) for ratio in told] == pytest.approx([1.005] * 3, abs=8e-4)
    last = turns[-1]
    assert last.accelerometer is not None
    for axis in (0, 1):
        readings = last.accelerometer.copy()
        readings[:, axis] = 0.4 + 0.001 * np.random.default_rng(0).standard_normal(last.samples)
        with pytest.raises(IngestError, match=f"accel_{'xy'[axis]} stays within .* the rows in which the table turns"):
            check_axes([replace(last, accelerometer=readings)])


def test_the_written_log_implies_the_motion_that_the_sensors_felt(tmp_path: Path) -> None:
    quiet = {"sensor": "stim300", "course": {**SHORT, "rates_dps": [20.0, 200.0], "both_directions": True}}
    write_campaign(description_from({"units": [{"unit": "U", **quiet}]}, "test"), tmp_path)
    truth = json.loads((tmp_path / "truth" / "U.json").read_text())
    recordings = read(tmp_path / "raw" / "U", sensor="stim300")
    assert set(recordings) == {f"{s}_{a}" for s in ("accel", "gyro") for a in "xyz"} | {"validation", "static"}
    del recordings["static"]
    for name, recording in recordings.items():
        for sensor, wander, table in (("accelerometer", 2e-5, 5e-5), ("gyroscope", 1.4e-4, 5e-3)):
            left = residual(recording, truth, sensor)
            white = truth[sensor]["noise"]["white"]
            assert np.std(left) < 1.1 * white + 3.0 * wander + table, (name, sensor)
            assert np.abs(np.mean(left, axis=0)).max() < 4.0 * (white / np.sqrt(len(left)) + wander) + table


def test_noise_of_a_rest_is_what_the_data_sheet_says() -> None:
    recordings, truth = simulated(course={**SHORT, "static_s": 600.0})
    static = recordings["static"]
    for sensor in SENSORS:
        reading = static.reading(sensor)
        assert reading is not None
        noise = truth[sensor]["noise"]
        differences = np.diff(reading, axis=0)  # the wander hardly changes from one sample to the next
        step = 1.0 / shipped_settings(sensor="mpu6050").sensor.of(sensor).counts_per_unit
        expected = np.sqrt(noise["white"] ** 2 + step**2 / 12.0)
        # 15 000 differences, neighbours correlated: relative standard error 1 / sqrt(2 * 15000 / 1.5)
        assert np.sqrt(np.mean(differences**2) / 2.0) == pytest.approx(expected, rel=0.03)


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(tmp_path: Path) -> None:
    options = ["--samples", "2500", "--units", "2", "--effect", "gyroscope.g_sensitivity", "--lost", "0.01", "--quiet"]
    for name, seed in (("a", "5"), ("b", "5"), ("c", "6")):
        assert main([str(tmp_path / name), "--seed", seed, *options]) == 0
    first, again, other = (files_of(tmp_path / n) for n in "abc")
    assert first == again
    assert {n for n in first if first[n] == other[n]} == {"units.csv", "campaign.yaml"}
    assert first["raw/U001/accel_x.csv"] != first["raw/U002/accel_x.csv"]


def test_a_described_campaign_is_made_again_from_its_own_description(tmp_path: Path) -> None:
    assert main([str(tmp_path / "a"), "--samples", "2500", "--effect", "table_tilt=0.2", "--quiet"]) == 0
    assert main([str(tmp_path / "b"), "--from", str(tmp_path / "a" / "simulation.yaml"), "--quiet"]) == 0
    first = files_of(tmp_path / "a")
    del first["simulation.yaml"]
    assert first == files_of(tmp_path / "b")


@pytest.mark.parametrize("kind", ["csv", "mcap"])
def test_both_formats_hold_the_same_values(tmp_path: Path, kind: str) -> None:
    unit = {"unit": "U", "course": SHORT, "format": kind}
    write_campaign(description_from({"seed": 1, "units": [unit]}, "test"), tmp_path)
    expected, _ = simulated(format=kind)
    for name, recording in read(tmp_path / "raw" / "U").items():
        np.testing.assert_array_equal(recording.time_ns, expected[name].time_ns)
        for channel in ("accelerometer", "gyroscope", "temperature", "table_angle", "table_attitude"):
            found, wanted = getattr(recording, channel), getattr(expected[name], channel)
            assert (found is None) == (wanted is None), channel
            if wanted is not None:
                np.testing.assert_allclose(found, wanted, rtol=1e-14, atol=1e-13)


def test_readings_are_whole_counts_after_printing(tmp_path: Path) -> None:
    write_campaign(description_from({"units": [{"unit": "U", "sensor": "stim300", "course": SHORT}]}, "test"), tmp_path)
    for sensor, sheet in ((s, shipped_settings(sensor="stim300").sensor.of(s)) for s in SENSORS):
        reading = read(tmp_path / "raw" / "U", sensor="stim300")["gyro_x"].reading(sensor)
        assert reading is not None
        counts = reading * sheet.counts_per_unit
        assert np.abs(counts - np.rint(counts)).max() < 0.1


def test_lost_samples_are_dropped_and_leave_the_others_as_they_are() -> None:
    whole, _ = simulated()
    holes, _ = simulated(lost=0.2)
    count = sum(r.samples for r in holes.values()) / sum(r.samples for r in whole.values())
    assert count == pytest.approx(0.8, abs=0.03)
    for name, recording in holes.items():
        kept = np.isin(whole[name].time_ns, recording.time_ns)
        assert recording.samples == kept.sum()
        np.testing.assert_array_equal(whole[name].gyroscope[kept], recording.gyroscope)


def test_recordings_share_one_clock_and_follow_one_another() -> None:
    recordings, _ = simulated()
    ordered = list(recordings.values())
    assert ordered[0].time[0] == pytest.approx(30.0)
    for before, after in pairwise(ordered):
        assert 30.0 <= after.time[0] - before.time[-1] < 30.2
    assert all(np.all(np.diff(r.time_ns) == 120_000_000) for r in ordered)


@pytest.mark.parametrize("samples", [2500, 10000, 40000])
def test_as_many_samples_are_made_as_asked_for(samples: int) -> None:
    recordings, _ = simulated(samples=samples, course={})
    assert sum(r.samples for r in recordings.values()) == pytest.approx(samples, rel=0.01)


@pytest.mark.parametrize("procedure", ["orientations_24", "six_positions", "multi_position"])
def test_procedures_without_a_table_show_gravity_alone_in_their_rests(procedure: str) -> None:
    recordings, truth = simulated(procedure=procedure, table="hand", course={"static_s": 0.0})
    (recording,) = recordings.values()
    assert recording.role == "rests"
    assert recording.table_rate is None
    calibrated = (recording.accelerometer - truth["accelerometer"]["bias"]) @ np.array(
        truth["accelerometer"]["matrix"]
    ).T
    turned = (recording.gyroscope - truth["gyroscope"]["bias"]) @ np.array(truth["gyroscope"]["matrix"]).T
    error = np.linalg.norm(calibrated, axis=1) - 1.0
    assert np.std(error) == pytest.approx(truth["accelerometer"]["noise"]["white"], rel=0.1)
    assert np.linalg.norm(turned, axis=1).max() > 50.0


def test_the_temperature_of_a_thermal_ramp_goes_both_ways() -> None:
    recordings, _ = simulated(procedure="thermal_ramp", effects={"accelerometer.bias_temperature": 1e-3})
    temperature = np.concatenate([r.temperature for r in recordings.values()])
    steps = [r.temperature[-1] - r.temperature[0] for r in recordings.values()]
    assert np.ptp(temperature) > 20.0
    assert max(steps) > 1.0
    assert min(steps) < -1.0


def test_a_hidden_effect_is_in_the_readings_and_in_the_truth() -> None:
    values = [0.01 * k for k in range(1, 10)]
    hidden, truth = simulated(effects={"gyroscope.g_sensitivity": values})
    plain, _ = simulated()
    assert list(truth["gyroscope"]["effects"]["g_sensitivity"].values()) == values
    assert truth["accelerometer"]["effects"] == {}
    motion = reference_motion(plain["validation"])
    assert motion is not None
    added = hidden["validation"].gyroscope - plain["validation"].gyroscope
    expected = motion.specific_force @ np.reshape(values, (3, 3)).T
    assert np.abs(added - expected).max() < 1.01 / 131.0  # both are rounded to counts
    np.testing.assert_array_equal(hidden["validation"].accelerometer, plain["validation"].accelerometer)


def test_a_time_offset_of_one_sensor_leaves_the_other_as_it_is() -> None:
    late, _ = simulated(effects={"gyroscope.time_offset": 0.12})
    plain, _ = simulated()
    np.testing.assert_array_equal(late["gyro_x"].accelerometer, plain["gyro_x"].accelerometer)
    ramp = np.abs(np.diff(plain["gyro_x"].table_rate, append=0.0)) > 5.0
    moved = (late["gyro_x"].gyroscope - plain["gyro_x"].gyroscope)[ramp, 0]
    expected = np.diff(plain["gyro_x"].table_rate, append=0.0)[ramp]  # what the table does in one interval
    assert np.median(np.abs(moved / expected)) == pytest.approx(1.0, abs=0.05)


def test_an_effect_of_the_table_is_the_same_for_both_sensors() -> None:
    _, truth = simulated(effects={"table_rate_ripple": None, "warm_up": None})
    ripples = [truth[s]["effects"]["table_rate_ripple"] for s in SENSORS]
    assert ripples[0] == ripples[1]
    assert 0.7 * 0.005 <= max(abs(v) for v in ripples[0].values()) <= 1.3 * 0.005
    assert 210.0 <= truth["gyroscope"]["effects"]["warm_up"]["time_constant"] <= 390.0


def test_a_fleet_is_drawn_from_the_data_sheet() -> None:
    units = [
        simulate_unit(UnitDescription("U", course={"static_s": 0.0, "validation_s": 0.0, "step_deg": 90.0}), 3, k)[1]
        for k in range(40)
    ]
    bias = np.array([u["gyroscope"]["bias"] for u in units])
    assert np.abs(bias).max() <= 20.0
    # a limit is three standard deviations: 120 draws give the deviation within 4 * 6.7 / sqrt(240)
    assert np.std(bias) == pytest.approx(20.0 / 3.0, abs=1.8)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"effects": {"gyroscope.lever_arm": 0.1}}, "lever_arm applies to the accelerometer"),
        ({"effects": {"accelerometer.lever": 0.1}}, "no effect is called 'lever'"),
        ({"effects": {"mounting": 1.0}}, "has parameters for each recording; give imperfections mounting_deg"),
        ({"effects": {"lever_arm": [1.0, 2.0]}}, "takes one size or 3 values (r_x, r_y, r_z), not 2"),
        ({"effects": {"lever_arm": ["long", 0.1, 0.1]}}, "lever_arm: a size, or the list of the parameters' values"),
        ({"sensor": "mpu9"}, "no sensor is called 'mpu9'; known: adis16448, adis16470"),
        ({"procedure": "dance"}, "no procedure is called 'dance'"),
        ({"samples": 100}, "cannot be recorded in 100 samples"),
        ({"accelerometer": {"scale": 1.0}}, "accelerometer: scale is not known"),
        ({"format": "xlsx"}, "format is 'xlsx'; it must be 'csv' or 'mcap'"),
        ({"lost": 1.0}, "lost is 1.0; it must be less than 0.9"),
        ({"interval_s": 0.0}, "interval_s is 0.0; it must be greater than 0"),
        ({"course": {"dwel": 1.0}}, "course: dwel is not known; known: acceleration_dps2"),
    ],
)
def test_what_is_not_known_is_refused_by_name(keys: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError) as refused:
        simulated(**keys)
    assert message in str(refused.value)


def test_descriptions_are_refused_where_they_are_wrong(tmp_path: Path) -> None:
    with pytest.raises(MissingInputError, match="does not exist"):
        read_description(tmp_path / "none.yaml")
    (tmp_path / "bad.yaml").write_text("units: [")
    with pytest.raises(ConfigurationError, match="is not YAML"):
        read_description(tmp_path / "bad.yaml")
    (tmp_path / "list.yaml").write_text("[1]")
    with pytest.raises(ConfigurationError, match="expected a mapping"):
        read_description(tmp_path / "list.yaml")
    for data, message in (
        ({"unit": []}, "unit is not known"),
        ({"units": []}, "at least one unit"),
        ({"units": [{"sensor": "mpu6050"}]}, "a unit has no name"),
        ({"units": [{"unit": "A"}, {"unit": "A"}]}, "a unique name"),
        ({"units": [{"unit": "A", "speed": 1}]}, "unit A: speed is not known"),
        ({"units": [{"unit": "A", "lost": "few"}]}, "test: unit A: lost is 'few'; it must be a valid number"),
        ({"units": [{"unit": 3}]}, "test: unit 3: unit is 3; it must be a valid string"),
        ({"units": [{"unit": "A", "course": {"turns": 0.5}}]}, "unit A: course: turns is 0.5; it must be a valid int"),
        ({"units": ["A"]}, "test: defaults is a mapping of the keys of a unit, and units a list of them"),
        ({"units": [{"unit": "A"}], "variants": [{}]}, "test: variants: suffix is missing"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            description_from(data, "test")
    with pytest.raises(ConfigurationError, match="copy_of names B"):
        write_campaign(description_from({"units": [{"unit": "A", "copy_of": "B"}]}, "test"), tmp_path)
    with pytest.raises(ConfigurationError, match="after = a number"):
        main([str(tmp_path), "--effect", "lever_arm=big"])
    with pytest.raises(ConfigurationError, match="leave out --units or --from"):
        main([str(tmp_path), "--units", "3", "--from", "x.yaml"])


def test_the_demo_that_ships_follows_from_its_description(tmp_path: Path) -> None:
    write_campaign(read_description(DEMO / "simulation.yaml"), tmp_path)
    made = {name: content for name, content in files_of(tmp_path).items() if not name.endswith(".mcap")}
    del made["campaign.yaml"]  # a campaign keeps its own: what its page compares
    assert len(made) == 1 + 6 + 5 * 8
    for name, content in made.items():
        assert (DEMO / name).read_bytes() == content, (
            f"{name}: make it again with python -m pipeline simulate data/demo"
        )


@pytest.mark.parametrize("name", ["sweep_rates", "sweep_duration", "sweep_sampling", "thermal_ramp"])
def test_the_sheet_of_a_campaign_whose_run_makes_the_recordings_follows_from_its_description(
    name: str, tmp_path: Path
) -> None:
    shipped = DEMO.parent / name
    write_campaign(read_description(shipped / "simulation.yaml"), tmp_path, sheet_only=True)
    assert (shipped / "units.csv").read_bytes() == (tmp_path / "units.csv").read_bytes()
    assert load_campaign({"campaign": str(shipped)}).compare


def test_the_demo_s_ros_log_holds_the_same_recordings() -> None:
    first, again = read(DEMO / "raw" / "mpu6050-1"), read(DEMO / "raw" / "mpu6050-1-mcap")
    assert set(first) == set(again)
    for name, recording in first.items():
        np.testing.assert_array_equal(again[name].time_ns, recording.time_ns)
        np.testing.assert_allclose(again[name].accelerometer, recording.accelerometer, rtol=1e-14)
        np.testing.assert_allclose(again[name].gyroscope, recording.gyroscope, rtol=1e-14)


def test_every_unit_of_the_demo_has_its_recordings_and_the_thesis_s_chain_shares_them() -> None:
    with (DEMO / "units.csv").open() as stream:
        rows = {row["unit"]: row for row in csv.DictReader(stream)}
    assert len(rows) == 10
    for name, row in rows.items():
        folder = row["overrides"].removeprefix("procedure.folder=") or f"raw/{name}"
        assert len(list((DEMO / folder).iterdir())) == 8
        assert bool(row["overrides"]) == (row["method"] == "staged") == (row["filter"] == "rc_low_pass")


def test_the_demo_s_home_made_table_is_off_and_its_held_out_motion_is_not() -> None:
    truth = json.loads((DEMO / "truth" / "mpu6050-1-mark2.json").read_text())
    recordings = read(DEMO / "raw" / "mpu6050-1-mark2")
    turning = np.abs(recordings["gyro_x"].table_rate) > 59.9
    left = residual(recordings["gyro_x"], truth, "gyroscope")[turning, 0] * np.sign(
        recordings["gyro_x"].table_rate[turning]
    )
    assert np.mean(left) == pytest.approx(-0.027 * 60.0, abs=0.15)
    precise = json.loads((DEMO / "truth" / "mpu6050-1.json").read_text())
    assert np.std(residual(recordings["validation"], precise, "gyroscope")) < 0.013


def test_a_simulated_sheet_names_its_files_and_the_chamber_ramps_in_its_soaks_alone(tmp_path: Path) -> None:
    course = {"positions": 10, "soak_s": 300.0, "soaks": 2, "static_s": 20.0}
    unit = {"unit": "U", "procedure": "listed", "table": "hand", "interval_s": 0.1, "course": course}
    write_campaign(description_from({"units": [unit]}, "test"), tmp_path)
    settings = load_campaign({"campaign": str(tmp_path)}).units["U"].config
    listed = settings.procedure.recordings
    turns = [f"turn_{axis}{end}" for axis in "xyz" for end in ("", "_held_out")]
    assert list(listed) == ["still", "moves", *turns, "soak_1", "soak_2"]
    assert {name for name, entry in listed.items() if entry.role == "validation"} == set(turns[1::2])
    for r in read_recordings(settings.procedure, settings.ingest, settings.sensor, tmp_path / "raw" / "U"):
        assert r.temperature is not None
        low, high = np.ptp(r.temperature[: r.samples // 2]), np.ptp(r.temperature)
        assert (29.0 < low < 35.0 and 58.0 < high < 65.0) if r.kind == "soak" else high < 6.0


def test_a_turn_by_hand_has_one_accuracy() -> None:
    course, said = Course(), re.search(r"a multiple of it; its uncertainty \| 360, (\S+) \|", RECORD.read_text())
    assert said
    for procedure in ("ferraris", "listed"):
        turns = shipped_settings(procedure=procedure).procedure.turns
        assert turns is not None
        assert turns.accuracy_deg == course.turn_error_deg == float(said[1])
        assert turns.axis_accuracy_deg == course.turn_axis_error_deg
