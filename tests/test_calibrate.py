"""``pipeline.calibrate`` and ``calibrate_unit``: what they take, return and refuse.

Their figures against those of runs: ``tests/workflow/test_own_effects.py``, ``tests/study/test_one_chain.py``.
"""

from __future__ import annotations

import os
import pickle
import re
import subprocess
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import imu_calibration.core.errors
import imu_calibration.unit
import numpy as np
import pandas as pd
import pytest
from calls import ONCE_A_RECORDING, ONCE_A_RECORDING_AND_SENSOR, counted, designs
from hydra import initialize
from hydra.core.global_hydra import GlobalHydra
from imu_calibration.physics.effects import catalogue as same_catalogue

import pipeline
import pipeline.unit
from pipeline.app.commands import apply, simulate
from pipeline.app.config import load_campaign
from pipeline.app.one_unit import ConfiguredUnit, notes_of_campaign
from pipeline.core.errors import InputError, InternalError
from pipeline.core.verdicts import Verdict
from pipeline.physics.effects import catalogue, forget

if TYPE_CHECKING:
    from pipeline.app.one_unit import UnitResult
    from pipeline.unit import UnitState

COURSE = "--units 1 --sensor mpu6050 --quiet --step 45 --dwell 1 --rates 60 --validation 30 --seed 4"
BENCH: dict[str, Any] = {"sensor": "mpu6050", "table": "acutronic"}
EFFECTS = [
    "effects.accelerometer=[quadratic_nonlinearity]",
    "effects.gyroscope=[bias_temperature, warm_up, g_sensitivity]",
    "sensor.axis_map=[+y, -x, +z]",
]
AXES = {"accel_{}_g": "accelerometer", "gyro_{}_dps": "gyroscope"}


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("made") / "bench"
    assert simulate.main([str(directory), *COURSE.split()]) == 0
    return directory


@pytest.fixture(scope="module")
def folder(campaign: Path) -> Path:
    return campaign / "raw" / "U001"


@pytest.fixture(scope="module")
def frames(folder: Path) -> dict[str, pd.DataFrame]:
    return {file.stem: pd.read_csv(file) for file in sorted(folder.glob("*.csv"))}


@pytest.fixture(scope="module")
def from_folder(folder: Path) -> UnitResult:
    return pipeline.calibrate(folder, **BENCH)


@pytest.fixture(scope="module")
def with_effects(frames: dict[str, pd.DataFrame]) -> UnitResult:
    """Of a sensor whose reading axes x and y point along the body axes y and -x."""
    return pipeline.calibrate({name: turned(frame) for name, frame in frames.items()}, **BENCH, overrides=EFFECTS)


def turned(frame: pd.DataFrame) -> pd.DataFrame:
    out = frame.copy()
    for names in AXES:
        x, y = (frame[names.format(axis)] for axis in "xy")
        out[names.format("x")], out[names.format("y")] = y, -x
    return out


def test_the_noise_of_a_run_has_no_intervals_and_names_what_gives_them(campaign: Path) -> None:
    parts = [
        pipeline.calibrate_unit(campaign, "U001", overrides=overrides).calibration["noise"]["gyroscope"]
        for overrides in ((), ["diagnosis.depth=full"])
    ]
    stated, full = (part["axes"]["x"]["terms"]["white"] for part in parts)
    command = "python -m pipeline noise CAMPAIGN/raw/U001/static.csv --ingest canonical_csv --sensor mpu6050"
    assert parts[0]["intervals_by"] == f"{command}, or a run with diagnosis.depth=full"
    assert stated["interval"] is None
    assert "intervals_by" not in parts[1]
    low, high = full["interval"]
    assert low < stated["value"] < high


def assert_same_figures(one: Any, two: Any, place: str = "") -> None:
    """Compare two documents: numbers to 1e-12 of their size, everything else exactly."""
    if isinstance(one, dict):
        assert list(one) == list(two), place
        for key in one:
            assert_same_figures(one[key], two[key], f"{place}.{key}")
    elif isinstance(one, list):
        assert len(one) == len(two), place
        for i, (a, b) in enumerate(zip(one, two, strict=True)):
            assert_same_figures(a, b, f"{place}[{i}]")
    elif isinstance(one, float):
        assert two == pytest.approx(one, rel=1e-12, abs=1e-15), place
    else:
        assert one == two, place


def test_a_folder_a_campaign_and_data_frames_give_the_same_figures(
    campaign: Path, frames: dict[str, pd.DataFrame], from_folder: UnitResult
) -> None:
    with_index = {
        name: frame.assign(label='a, "b"', temperature_degc=frame["temperature_degc"].astype("Float64")).set_index(
            pd.date_range("2026", periods=len(frame), freq="min")
        )
        for name, frame in frames.items()
    }
    others = pipeline.calibrate(with_index, **BENCH), pipeline.calibrate_unit(campaign, "U001")
    for other in others:
        for document in ("calibration", "validation", "diagnosis"):
            for sensor in ("accelerometer", "gyroscope"):
                one, two = (getattr(r, document)[sensor] for r in (from_folder, other))
                assert_same_figures(one, two, f"{document}.{sensor}")
    of_frames, of_campaign = others
    assert "static: columns not used: label" in of_frames.notes
    assert of_frames.calibration["inputs"][0]["file"] == "accel_x (DataFrame)"
    for sensor in ("accelerometer", "gyroscope"):
        part, result = of_campaign.calibration[sensor], getattr(of_campaign, sensor)
        assert result.matrix.tolist() == part["matrix"]
        assert result.expanded_uncertainty["bias"].tolist() == part["expanded_uncertainty"]["bias"]


AUTO = ["effects.accelerometer=auto", "effects.gyroscope=auto"]
KNOWN = [f"sensor.{s}.known_temperature.bias=[2e-5, -1e-5, 1e-5]" for s in ("accelerometer", "gyroscope")]


@pytest.mark.parametrize(
    ("method", "overrides"),
    [
        (None, AUTO),
        (None, ["effects.accelerometer=[mounting]", "effects.gyroscope=[mounting]"]),
        (None, [*AUTO, "table.seat_deg=2"]),
        ("known_temperature", [*AUTO, *KNOWN]),
        ("staged", AUTO),
    ],
)
def test_motion_rests_temperatures_and_designs_are_computed_once(method: str | None, overrides: list[str]) -> None:
    folder = Path(__file__).parents[1] / "data/demo/raw/mpu6050-2-hidden"
    with counted((*ONCE_A_RECORDING, *ONCE_A_RECORDING_AND_SENSOR)) as calls, designs() as built:
        pipeline.calibrate(folder, **BENCH, method=method, overrides=overrides)
    most: dict[str, int] = {}
    for (path, _), count in calls.items():
        name = path.rpartition(".")[2]
        most[name] = max(most.get(name, 0), count)
    assert most.pop("_part") == 2  # the rows of each sensor
    assert set(most.values()) == set(built.values()) == {1}
    assert {sensor for sensor, *_ in built} == {"accelerometer", "gyroscope"}


def test_what_a_unit_by_hand_needs_is_computed_once(tmp_path: Path) -> None:
    options = (
        "--sensor mpu6050 --procedure multi_position --table hand --positions 24 --static 0 --validation 0 --quiet"
    )
    assert simulate.main([str(tmp_path / "hand"), *options.split()]) == 0
    with counted(ONCE_A_RECORDING) as calls:
        pipeline.calibrate_unit(tmp_path / "hand", "U001", overrides=AUTO)
    assert {name for name, _ in calls} >= {"find_rests", "smooth_temperature"}
    assert set(calls.values()) == {1}


def test_files_may_be_named_one_by_one_and_one_sensor_needs_only_its_own(folder: Path) -> None:
    files: dict[str, Any] = {name: folder / name for name in ("accel_x", "accel_y", "accel_z")}  # without suffix
    files["validation"] = str(folder / "validation.csv")
    result = pipeline.calibrate(files, **BENCH, overrides="method.gyroscope=null")
    assert result.gyroscope is None
    assert result.accelerometer is not None
    assert set(result.verdict) == {"accelerometer"}
    assert [i["recording"] for i in result.calibration["inputs"]] == ["accel_x", "accel_y", "accel_z", "validation"]
    assert result.calibration["inputs"][0]["file"] == str(folder / "accel_x.csv")


ONE = {"recording": "recording.csv"}
WRONG: list[tuple[Any, dict[str, Any], str, str]] = [
    (ONE, {"sensor": "mpu605"}, "bad_configuration", "sensor=mpu605: no such sensor; nearest: mpu6050"),
    (ONE, {"sensor": None}, "bad_configuration", "sensor=None: a name is expected"),
    (ONE, {"table": "acutronik"}, "bad_configuration", "no such table; nearest: acutronic"),
    (ONE, {"procedure": "multi"}, "bad_configuration", "no such procedure; nearest: multi_position"),
    (ONE, {"method": "stagd"}, "bad_configuration", "no such method; nearest: staged"),
    (ONE, {"overrides": ["filter.cutof=3"]}, "bad_configuration", "unknown key; nearest: cutoff_hz"),
    (ONE, {"overrides": "foo"}, "bad_configuration", "'foo' is not a Hydra override"),
    (ONE, {"overrides": [3]}, "bad_configuration", "a list of overrides KEY=VALUE is expected, got"),
    (ONE, {"overrides": None}, "bad_configuration", "a list of overrides KEY=VALUE is expected, got None"),
    (ONE, {"overrides": ["batch_size=50"]}, "bad_configuration", "batch_size=50: a setting of a run"),
    (ONE, {"overrides": ["combine=lot"]}, "bad_configuration", "combine=lot: a setting of a run"),
    (ONE, {"overrides": ["python_effects=[a.py]"]}, "bad_configuration", "the argument python_effects"),
    (ONE, {"overrides": ["effects.gyroscope=[g_sens]"]}, "bad_configuration", "nearest: g_sensitivity"),
    (ONE, {"python_effects": ["none.py"]}, "bad_configuration", "there is no such Python file"),
    (ONE, {"python_effects": [3]}, "bad_configuration", "a list of paths of Python files is expected"),
    (ONE, {"method": "given", "overrides": "method.file=no.yaml"}, "bad_configuration", "method.file: no.yaml"),
    ({"recordin": "a.csv"}, {}, "bad_configuration", "is called 'recordin'; nearest: recording"),
    ({3: "a.csv"}, {}, "bad_configuration", "is called 3; valid: recording, static, validation"),
    ({}, {}, "missing_file", "missing recordings: recording; procedure multi_position needs them"),
    (ONE, {}, "missing_file", "recording recording: there is no such file (tried /"),
    ({"recording": "rec"}, {}, "missing_file", "rec.csv, .gcsv, .mcap"),
    ({"recording": "/"}, {}, "bad_input", "recording recording: is a folder; a file is expected"),
    ({"recording": np.zeros((9, 7))}, {}, "bad_input", "or a pandas DataFrame is expected; got ndarray"),
    ({"recording": None}, {}, "bad_input", "or a pandas DataFrame is expected; got NoneType"),
    (pd.DataFrame(), {}, "bad_input", "a mapping of names to files or DataFrames, for example {'recording': frame}"),
    ([ONE], {}, "bad_input", "; got list"),
    ("nowhere", {}, "missing_file", "does not exist; a folder of recordings is expected"),
    (__file__, {}, "bad_input", "is no folder; a folder of recordings is expected"),
    (Path(__file__).parents[1] / "data" / "demo", {}, "bad_input", "calibrate_unit(campaign, unit)"),
]


@pytest.mark.parametrize(("recordings", "options", "code", "message"), WRONG)
def test_what_is_given_wrong_is_refused_with_what_is_right(
    recordings: Any, options: dict[str, Any], code: str, message: str
) -> None:
    with pytest.raises(pipeline.PipelineError) as refused:
        pipeline.calibrate(recordings, **{"sensor": "mpu6050", "procedure": "multi_position", **options})
    assert refused.value.code == code
    assert message in str(refused.value)


FAULTS: list[tuple[Any, str, str, str]] = [
    (lambda f: f.drop(columns="time_s"), "missing_column", "accel_y (DataFrame):1", "time_s missing"),
    (lambda f: f.set_index("time_s"), "missing_column", "accel_y (DataFrame)", "give frame.reset_index()"),
    (lambda f: f.rename(columns={"accel_x_g": "ax"}), "missing_column", "accel_y (DataFrame):1", "found time_s, ax"),
    (
        lambda f: f.set_axis(pd.MultiIndex.from_product([["imu"], f.columns]), axis=1),
        "missing_column", "accel_y (DataFrame)", "one level",
    ),
    (lambda f: pd.concat([f, f["time_s"]], axis=1), "duplicate_column", "accel_y (DataFrame):1", "time_s occurs"),
    (lambda f: f.assign(accel_z_g="1.0"), "not_a_number", "accel_y (DataFrame)", "to_numeric(frame['accel_z_g'])"),
    (lambda f: f.assign(accel_z_g=f["accel_z_g"] > 0), "not_a_number", "accel_y (DataFrame)", "has the dtype bool"),
    (
        lambda f: f.assign(time_s=pd.to_datetime(f["time_s"], unit="s")),
        "not_a_number", "accel_y (DataFrame)", "dt.total_seconds()",
    ),
    (
        lambda f: f.assign(accel_z_g=f["accel_z_g"].where(f.index != 7)).set_index(f.index + 100),
        "not_finite", "accel_y (DataFrame)", "accel_z_g is nan in row 7 (index 107)",
    ),
    (lambda f: f.assign(time_s=np.inf), "not_finite", "accel_y (DataFrame)", "more rows"),
    (lambda f: f.iloc[::-1], "time_back", "accel_y (DataFrame):3", "time has to increase"),
    (lambda f: f.iloc[:0], "no_rows", "accel_y (DataFrame)", "0 data rows"),
    (lambda f: f.assign(accel_x_g=9.81 * f["accel_x_g"], accel_y_g=9.81 * f["accel_y_g"], accel_z_g=9.81),
     "implausible_force", "accel_y (DataFrame)", "look like m/s^2"),
]  # fmt: skip


@pytest.mark.parametrize(("fault", "code", "file", "message"), FAULTS)
def test_a_data_frame_is_checked_like_a_file(
    fault: Any, code: str, file: str, message: str, frames: dict[str, pd.DataFrame]
) -> None:
    with pytest.raises(InputError) as refused:
        pipeline.calibrate({**frames, "accel_y": fault(frames["accel_y"])}, **BENCH)
    assert (refused.value.code, refused.value.file) == (code, file)
    assert message in refused.value.message


def test_a_profile_of_files_does_not_describe_data_frames(frames: dict[str, pd.DataFrame]) -> None:
    with pytest.raises(pipeline.PipelineError, match="a DataFrame has those of the canonical CSV"):
        pipeline.calibrate(frames, **BENCH, overrides=["ingest.csv.columns.accel_x.unit=mg"])


def test_the_error_of_a_bug_and_of_the_machine(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The codes and messages are those of ``failure_of``, which a run publishes."""

    def fails(*_: object) -> None:
        raise failure

    monkeypatch.setattr("pipeline.app.steps.ingest.check_recordings", fails)
    failure: Exception = ZeroDivisionError("by zero")
    with pytest.raises(InternalError, match=r"ZeroDivisionError: by zero \(a bug") as bug:
        pipeline.calibrate(folder, **BENCH)
    assert (bug.value.code, bug.value.__cause__) == ("internal_error", failure)
    failure = PermissionError(13, "Permission denied", "/etc/secret.csv")
    with pytest.raises(InputError) as refused:
        pipeline.calibrate(folder, **BENCH)
    assert vars(refused.value) == {"message": "Permission denied", "file": "/etc/secret.csv"}
    failure = OSError(28, "No space left on device")
    with pytest.raises(OSError, match="No space left"):
        pipeline.calibrate(folder, **BENCH)


def test_apply_gives_what_the_command_gives(
    with_effects: UnitResult, frames: dict[str, pd.DataFrame], tmp_path: Path
) -> None:
    """With readings that are turned to body axes, three kinds of effects, and other columns."""
    log = turned(frames["validation"])
    log["time_s"] += 1.7e9  # counted from the first sample
    log["count"] = np.arange(len(log), dtype=np.int8)
    log = log[log.columns[::-1]].set_index(pd.date_range("2026", periods=len(log), freq="ms"))
    with_effects.save(tmp_path / "saved")
    log.to_csv(tmp_path / "log.csv", index=False)
    calibration = tmp_path / "saved" / "calibrations" / "unit.json"
    argv = ["--calibration", str(calibration), str(tmp_path / "log.csv"), "-o", str(tmp_path / "out.csv")]
    assert apply.main(argv) == 0
    expected = pd.read_csv(tmp_path / "out.csv").set_index(log.index)
    found = with_effects.apply(log)
    pd.testing.assert_frame_equal(found, expected, check_dtype=False, check_freq=False, rtol=0.0, atol=1e-12)
    changed = {names.format(axis) for names in AXES for axis in "xyz"}
    assert found.drop(columns=changed).equals(log.drop(columns=changed))
    assert found["count"].dtype == np.int8
    lengths = np.linalg.norm(found[[f"accel_{axis}_g" for axis in "xyz"]], axis=1)
    assert abs(lengths - 1.0).max() < 0.005  # of raw readings: 0.06
    loaded = pipeline.load_calibration(calibration)
    assert loaded.gyroscope is not None
    assert with_effects.gyroscope is not None
    assert loaded.gyroscope.bias.tolist() == with_effects.gyroscope.bias.tolist()


def test_apply_refuses_a_log_without_what_it_needs(with_effects: UnitResult, frames: dict[str, pd.DataFrame]) -> None:
    log = frames["validation"]
    six = [names.format(axis) for names in AXES for axis in "xyz"]
    for faulty, message in (
        (log.drop(columns="temperature_degc"), "bias_temperature, which needs temperature.*no column temperature_degc"),
        (log.drop(columns="time_s"), "warm_up, which needs time.*the log has no column time_s"),
        (
            log.drop(columns=six[:3]),
            "g_sensitivity, which needs accelerometer.*no column accel_x_g, accel_y_g, accel_z_g",
        ),
        (log.drop(columns="gyro_y_dps"), "no column gyro_y_dps; the three of a sensor are expected"),
        (log[["time_s"]], "no column of a calibrated sensor; expected accel_x_g"),
        (log.astype({"accel_x_g": str}), "column accel_x_g of the log has the dtype"),
        (pd.concat([log, log["accel_x_g"]], axis=1), "more than one column accel_x_g"),
        (log.to_numpy(), "a pandas DataFrame is expected; got ndarray"),
    ):
        with pytest.raises(InputError, match=message):
            with_effects.apply(faulty)


def test_a_log_of_a_sensor_that_is_not_calibrated_is_refused(folder: Path, frames: dict[str, pd.DataFrame]) -> None:
    alone = pipeline.calibrate(folder, **BENCH, overrides="method.gyroscope=null")
    log = frames["validation"]
    found = alone.apply(log)
    assert found.filter(like="gyro").equals(log.filter(like="gyro"))
    assert not found.filter(like="accel").equals(log.filter(like="accel"))
    with pytest.raises(InputError, match=r"not calibrated: gyroscope: method.gyroscope is null"):
        alone.apply(log.filter(like="gyro"))
    long = replace(alone, calibration=alone.calibration | {"not_calibrated": {"gyroscope": "x" * 999}})
    lines = repr(long).splitlines()
    assert lines[-1].startswith("gyroscope: null, xxx")
    assert lines[-1].endswith("xxx...")
    assert max(map(len, lines)) == 120


def test_the_summary_of_a_unit_has_at_most_16_lines(with_effects: UnitResult, from_folder: UnitResult) -> None:
    lines = repr(with_effects).splitlines()
    assert len(lines) == 15
    assert lines[0] == "unit: mpu6050, three_axis_turns, reference_least_squares"
    assert lines[1] == "accelerometer: nothing_missing"
    assert "  effects bias_temperature, warm_up, g_sensitivity" in lines
    assert len(repr(from_folder).splitlines()) == 13


def test_a_result_is_copied_to_another_process(from_folder: UnitResult, frames: dict[str, pd.DataFrame]) -> None:
    copy = pickle.loads(pickle.dumps(from_folder))  # noqa: S301  (our own)
    assert repr(copy) == repr(from_folder)
    pd.testing.assert_frame_equal(copy.apply(frames["validation"]), from_folder.apply(frames["validation"]))


def test_the_page_names_the_override_and_no_command_of_a_campaign(from_folder: UnitResult, tmp_path: Path) -> None:
    state, override = from_folder._state, "effects.gyroscope=[warm_up]"
    of_unit = state.diagnosed.sensors
    found = replace(of_unit["gyroscope"], verdict=Verdict.MISSING_EFFECT, selected=["warm_up"], override=override)
    diagnosed = replace(state.diagnosed, sensors=of_unit | {"gyroscope": found})
    missing = replace(from_folder, _state=replace(state, diagnosed=diagnosed))
    missing.report(tmp_path / "new" / "page.html")
    page = (tmp_path / "new" / "page.html").read_text(encoding="utf-8")
    assert "The override that adds it: <code>effects.gyroscope=[warm_up]</code>" in page
    assert "pipeline add" not in page


def test_effects_of_a_campaign_and_of_a_python_file_stay_with_their_unit(campaign: Path, tmp_path: Path) -> None:
    (campaign / "effects").mkdir(exist_ok=True)
    own = "{name: loose_part, owner: sensor, sensors: [accelerometer], meaning: A part tips over.,"
    own += " terms: {d: {formula: tanh(8 * fz), unit: g}}, limits: {d: 0.05}}"
    (campaign / "effects" / "loose_part.yaml").write_text(own)
    python = tmp_path / "squeezed.py"
    python.write_text(SQUEEZED)
    known = set(catalogue())
    override = ["effects.accelerometer=[loose_part, squeezed]", "method.gyroscope=null"]
    try:
        found = pipeline.calibrate_unit(campaign, "U001", overrides=override, python_effects=[python])
    finally:
        (campaign / "effects" / "loose_part.yaml").unlink()
    assert set(catalogue()) == known
    assert found.accelerometer is not None
    assert set(found.accelerometer.effects) == {"loose_part", "squeezed"}
    log = pd.DataFrame({f"accel_{axis}_g": [0.0, float(axis == "z")] for axis in "xyz"})
    assert found.apply(log).shape == (2, 3)
    found.save(tmp_path / "saved")
    file = tmp_path / "saved" / "calibrations" / "U001.json"
    try:
        loaded = pipeline.load_calibration(file, python_effects=[python])  # whose effects stay in this process
        np.testing.assert_array_equal(loaded.apply(log.to_numpy()).accelerometer, found.apply(log))
    finally:
        forget(*set(catalogue()) - known)


SQUEEZED = """
import numpy as np
from imu_calibration.physics.effects.base import Effect, Layout, Owner, axis_parameters

class Squeezed(Effect):
    name = "squeezed"
    owner = Owner.SENSOR
    layout = Layout.EVERY_AXIS
    sensors = ("accelerometer",)
    meaning = "A force squeezes the sensor."
    excitation = "rests on both sides"
    experiment = "squeeze it"
    source = "the user's own"

    def parameters(self, sensor):
        return axis_parameters("s", "g", "size")

    def regressors(self, sensor, motion, K, values):
        return motion.specific_force[:, :1] ** 2

EFFECT = Squeezed()
"""


def test_what_other_units_would_add_is_noted(campaign: Path, tmp_path: Path) -> None:
    for combine, board, expected in (
        ("lot", "", ["combine=lot: the other units of the campaign were not used"]),
        ("serial", "", ["combine=serial: the other units of the campaign were not used"]),
        ("null", "B1", ["board B1: the other chips were not used; how they are mounted is not stated"]),
        ("null", "", []),
    ):
        sheet = "unit,sensor,serial,board,overrides\n" + "".join(
            f"{unit},mpu6050,S1,{board},procedure.folder={campaign / 'raw' / 'U001'}\n" for unit in ("A", "B")
        )
        (tmp_path / "units.csv").write_text(sheet)
        (tmp_path / "campaign.yaml").write_text(f"overrides: [combine={combine}]\n")
        assert notes_of_campaign(load_campaign({"campaign": str(tmp_path)}), "A") == expected


def test_a_unit_that_is_not_in_the_campaign_and_wrong_settings_of_it(campaign: Path) -> None:
    for arguments, options, message in (
        ((campaign, "U01"), {}, "no unit 'U01'; nearest: U001"),
        ((campaign, 7), {}, "no unit 7; valid: U001"),
        (("nowhere", "U001"), {}, "neither data/nowhere nor nowhere holds a units.csv"),
        ((campaign, "U001"), {"overrides": "method=stagd"}, "no such method"),
        ((campaign, "U001"), {"overrides": {"method": "staged"}}, "a list of overrides"),
        ((campaign, "U001"), {"python_effects": "none.py"}, "there is no such Python file"),
    ):
        with pytest.raises(pipeline.PipelineError, match=message):
            pipeline.calibrate_unit(*arguments, **options)


def test_simulated_recordings_are_those_of_a_run_or_refused(campaign: Path, tmp_path: Path) -> None:
    """``simulate: true``: the recordings are in the results of a run, and there only."""
    directory, results = tmp_path / "fleet", tmp_path / "results"
    directory.mkdir()
    (directory / "units.csv").write_text("unit,sensor\nU001,mpu6050\n")
    (directory / "campaign.yaml").write_text("{simulate: true, overrides: [method.gyroscope=null]}\n")
    description = directory / "simulation.yaml"
    description.write_text((campaign / "simulation.yaml").read_text())
    made = campaign.stat().st_mtime
    os.utime(description, (made - 10.0, made - 10.0))
    with pytest.raises(InputError, match="simulated by its run, and they do not exist; run it: snakemake") as refused:
        pipeline.calibrate_unit(directory, "U001", results=results)
    assert (refused.value.code, refused.value.file) == ("missing_file", str(results / "fleet" / "simulated"))
    (results / "fleet").mkdir(parents=True)
    (results / "fleet" / "simulated").symlink_to(campaign)
    found = pipeline.calibrate_unit(directory, "U001", results=results)
    assert found.calibration["inputs"][0]["file"] == "raw/U001/accel_x.csv"
    os.utime(description, (made + 10.0, made + 10.0))
    with pytest.raises(InputError, match="has changed since"):
        pipeline.calibrate_unit(directory, "U001", results=results)


def test_a_program_that_uses_hydra_keeps_its_hydra(folder: Path) -> None:
    with initialize(None, version_base="1.3"):
        own = GlobalHydra.instance().hydra
        with pytest.raises(pipeline.PipelineError):
            pipeline.calibrate(folder, sensor="mpu6050", procedure="multi_position", overrides="filter=high_pass")
        assert GlobalHydra.instance().hydra is own is not None


def test_imu_calibration_is_the_same_package() -> None:
    """No module is loaded twice, with classes that differ: an error of one name is caught by the other."""
    assert imu_calibration is pipeline
    assert imu_calibration.calibrate is pipeline.calibrate
    assert callable(pipeline.calibrate)  # also once pipeline.unit is imported: no module has the name of a function
    assert sys.modules["imu_calibration.unit"] is pipeline.unit
    assert sys.modules["imu_calibration.core.errors"].PipelineError is pipeline.PipelineError
    assert same_catalogue is catalogue
    assert pipeline.unit.__spec__.name == pipeline.unit.__name__ == "pipeline.unit"
    with pytest.raises(ModuleNotFoundError, match=r"pipeline\.nothing"):
        import_module("imu_calibration.nothing")


# Modules that Windows lacks, or of which it lacks parts. ``opened``: by name and mode or flags.
ELSEWHERE = """
import os, sys
for name in ("fcntl", "resource", "pwd", "grp", "termios", "tty", "pty", "readline", "curses"):
    sys.modules[name] = None
for name in ("fork", "forkpty", "posix_spawn", "mkfifo", "getuid", "geteuid", "sync", "sendfile", "sched_getaffinity"):
    if hasattr(os, name):
        delattr(os, name)
import socket
del socket.AF_UNIX
written, started = [], []
def watch(event, arguments):
    if event == "open" and arguments[0] != os.devnull:
        mode, flags = arguments[1:]
        if (isinstance(mode, str) and set(mode) & set("wax+")) or flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
            written.append(arguments)
    elif event in ("os.mkdir", "os.rename", "os.remove", "os.symlink", "os.link", "shutil.copyfile"):
        written.append((event, *arguments))
    elif event in ("subprocess.Popen", "os.fork", "os.forkpty", "os.system", "os.exec", "os.posix_spawn",
                   "socket.connect", "socket.bind"):
        started.append((event, *arguments))
sys.addaudithook(watch)
import imu_calibration
import pandas
folder, out = sys.argv[1:]
result = imu_calibration.calibrate(folder, sensor="mpu6050", table="acutronic")
log = pandas.read_csv(folder + "/validation.csv")
calibrated = result.apply(log)
from threadpoolctl import threadpool_info
with result._configured.environment():
    import scipy.linalg
    print({library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"})
print(written, started)
result.save(out)
from pipeline.app.commands import apply
words = ["--calibration", f"{out}/calibrations/U001.json", f"{folder}/validation.csv", "-o", f"{out}/log.csv"]
code = apply.main(words)
print(code, abs(pandas.read_csv(f"{out}/log.csv") - calibrated).to_numpy().max() < 1e-12)
"""


def test_it_needs_nothing_of_posix_writes_no_file_and_starts_no_process(folder: Path, tmp_path: Path) -> None:
    """As on Windows and macOS: without these modules, and text is not read in the encoding of the locale."""
    words = [sys.executable, "-B", "-X", "warn_default_encoding", "-W", "error::EncodingWarning", "-c", ELSEWHERE]
    environment = {k: v for k, v in os.environ.items() if k not in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
    done = subprocess.run(
        [*words, str(folder), str(tmp_path / "saved")], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["{1}", "[] []", "0 True"]


def test_the_examples_of_the_document_run(
    from_folder: UnitResult, frames: dict[str, pd.DataFrame], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each unit is configured as its example says; the steps, which other tests run, are those of another unit."""
    root = Path(__file__).parents[1]
    examples = re.findall(
        r"^```python\n(.*?)^```$", (root / "docs" / "python.md").read_text(), re.MULTILINE | re.DOTALL
    )
    state = replace(from_folder._state, unit="mpu6050-1")
    configured: list[str] = []

    def calibrated(unit: ConfiguredUnit) -> UnitState:
        configured.append(f"{unit.row.name} {unit.row.config.procedure.name}")
        state.calibration = {**from_folder.calibration, "unit": unit.row.name}
        with_effect = [{"name": e, "parameters": {}} for e in unit.row.config.effects.gyroscope]
        state.calibration["gyroscope"] = from_folder.calibration["gyroscope"] | {"effects": with_effect}
        return replace(state)

    monkeypatch.setattr(ConfiguredUnit, "calibrated", calibrated)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data").symlink_to(root / "data")
    for name in ("rests.csv", "log.csv"):
        frames["validation"].to_csv(tmp_path / name, index=False)
    exec("".join(examples), {})  # noqa: S102  (our own document)
    expected = ["mpu6050-1 three_axis_turns", "unit multi_position", "mpu6050-2-hidden three_axis_turns"]
    assert (len(examples), configured) == (2, expected)
    assert pipeline.load_calibration("saved/calibrations/mpu6050-1.json").gyroscope is not None
    assert (tmp_path / "unit.html").is_file()
