"""Logs of ROS, PX4, ArduPilot, HDF5 and MATLAB: the readings that were written, by the rules of MCAP; or refused."""

from __future__ import annotations

import json
import sys
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
import pytest
import yaml
from foreign_logs import (
    GRAVITY,
    STORES,
    Truth,
    write_arrays,
    write_bag,
    write_dataflash,
    write_matlab73,
    write_raw_ulog,
    write_ulog,
)
from pymavlink.DFReader import DFReader_binary
from pyulog import ULog
from rosbags import rosbag2
from sample_logs import SENSOR, procedure, profile
from scipy.io import savemat
from unit_settings import ingest_of

from imu_logs.files import MESSAGE_FORMATS
from imu_logs.message_read import read_log
from imu_logs.profile import mcap_format
from pipeline.app.commands.apply import main as apply
from pipeline.app.commands.check import main as check
from pipeline.app.config.compose import check_ingest
from pipeline.core.errors import ConfigurationError, IngestError, InputError
from pipeline.core.files import CONFIGS
from pipeline.core.records import SensorCalibration
from pipeline.ingest.read import read_recordings

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from imu_logs.log import Log

WRITERS: dict[str, tuple[Callable[..., Path], str]] = {
    "log.bag": (write_bag, "mcap"),
    "log.db3": (write_bag, "mcap"),
    "log.ulg": (write_ulog, "px4_ulog"),
    "log.bin": (write_dataflash, "ardupilot"),
    "log.h5": (write_arrays, "array_file"),
    "log.hdf5": (write_arrays, "array_file"),
    "log.mat": (write_arrays, "array_file"),
    "log73.mat": (write_matlab73, "array_file"),
}


def read(path: Path, ingest: str, **settings: Any) -> Log:
    return read_log(path, mcap_format(ingest_of({"mcap": {**profile(ingest)["mcap"], **settings}})))


def assert_is(table: Log, truth: Truth) -> None:
    assert table.time_ns.tolist() == (truth.time_us * 1000).tolist()
    force = np.column_stack([table.values[f"accel_{a}"] for a in "xyz"])
    rate = np.column_stack([table.values[f"gyro_{a}"] for a in "xyz"])
    np.testing.assert_allclose(force, truth.force / GRAVITY, rtol=1e-15)
    np.testing.assert_allclose(rate, np.degrees(truth.rate), rtol=1e-15)


@pytest.mark.parametrize("name", WRITERS)
def test_each_format_gives_the_readings_that_were_written(name: str, tmp_path: Path) -> None:
    truth = Truth()
    write, ingest = WRITERS[name]
    table = read(write(tmp_path / name, truth), ingest)
    assert_is(table, truth)
    if name == "log.bin":
        np.testing.assert_array_equal(table.values["temperature"], truth.warmth)


@pytest.mark.parametrize("name", [n for n in WRITERS if n != "log73.mat"])
def test_a_procedure_finds_the_file_in_place_of_a_csv(name: str, tmp_path: Path) -> None:
    write, ingest = WRITERS[name]
    write(tmp_path / name, Truth())
    recording = read_recordings(procedure("log"), ingest_of(profile(ingest)), SENSOR, tmp_path)[0]
    assert recording.samples == 300
    assert {"N-NOCRC"} <= {n.code for n in recording.notes}


def test_other_instances_are_topics_of_their_own(tmp_path: Path) -> None:
    truth = Truth()
    for path, ingest, topic in (
        (write_ulog(tmp_path / "log.ulg", truth, instances=2), "px4_ulog", "sensor_combined"),
        (write_dataflash(tmp_path / "log.bin", truth), "ardupilot", "IMU"),
    ):
        fields = next(iter(profile(ingest)["mcap"]["topics"].values()))
        table = read(path, ingest, topics={f"{topic}[1]": fields})
        expected = np.float32(truth.force[:, 0] + 1).astype(np.float64) / GRAVITY
        np.testing.assert_allclose(table.values["accel_x"], expected, rtol=1e-15)


def test_dataflash_agrees_with_pymavlink_message_by_message(tmp_path: Path) -> None:
    path = write_dataflash(tmp_path / "log.bin", Truth())
    with DFReader_binary(str(path)) as log:
        messages = [m for m in iter(lambda: log.recv_match(type="IMU"), None) if m.I == 0]
    table = read(path, "ardupilot")
    assert table.time_ns.tolist() == [m.TimeUS * 1000 for m in messages]
    assert table.values["accel_y"].tolist() == [m.AccY / GRAVITY for m in messages]
    assert table.values["temperature"].tolist() == [m.T for m in messages]


def test_ulog_agrees_with_pyulog(tmp_path: Path) -> None:
    path = write_ulog(tmp_path / "log.ulg", Truth())
    data = ULog(str(path)).get_dataset("sensor_combined").data
    np.testing.assert_array_equal(
        read(path, "px4_ulog").values["accel_z"], data["accelerometer_m_s2[2]"].astype(float) / GRAVITY
    )


def test_hundredths_in_a_dataflash_log_are_read_as_pymavlink_reads_them(tmp_path: Path) -> None:
    truth = Truth()
    path = write_dataflash(tmp_path / "log.bin", truth, warmth="c")
    with DFReader_binary(str(path)) as log:
        messages = [m for m in iter(lambda: log.recv_match(type="IMU"), None) if m.I == 0]
    table = read(path, "ardupilot")
    np.testing.assert_allclose(table.values["temperature"], [m.T for m in messages], rtol=1e-12)
    np.testing.assert_allclose(table.values["temperature"], truth.warmth, atol=0.0051)


def test_the_loggers_times_of_a_ulog_are_those_of_its_messages(tmp_path: Path) -> None:
    path = write_ulog(tmp_path / "log.ulg", Truth())
    stamps = ULog(str(path)).get_dataset("sensor_combined").data["timestamp"].astype(np.int64)
    assert read(path, "px4_ulog", time_source="log_time").time_ns.tolist() == (1000 * stamps).tolist()


def test_the_raw_messages_of_one_sensor_of_a_board(tmp_path: Path) -> None:
    """``sensor_accel`` and ``sensor_gyro`` of instance 1, as PX4 names their fields."""
    truth = Truth()
    message = "uint64_t timestamp;uint64_t timestamp_sample;float x;float y;float z;float temperature;"
    logged = {"sensor_accel": truth.force, "sensor_gyro": truth.rate}
    path = write_raw_ulog(tmp_path / "log.ulg", truth, {n: (message, v) for n, v in logged.items()}, instance=1)
    text = yaml.safe_load((CONFIGS / "ingest" / "px4_raw.yaml").read_text().replace("${ingest.instance}", "1"))
    table = read_log(path, mcap_format(ingest_of(text)))
    rows = (table.time_ns // 1000 - truth.time_us[0]) // 10_000
    assert len(rows) == 298
    np.testing.assert_allclose(table.values["accel_y"], truth.force[rows, 1] / GRAVITY, rtol=1e-15)
    mean = np.degrees((truth.rate[:-2] + 6 * truth.rate[1:-1] + truth.rate[2:]) / 8)  # of the lines between messages
    np.testing.assert_allclose(table.values["gyro_x"], mean[rows - 1, 0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(table.values["temperature"], 25.0)


def test_a_unit_other_than_the_file_states_is_refused(tmp_path: Path) -> None:
    hdf5 = write_arrays(tmp_path / "log.h5", Truth(), units=("m/s^2", "deg/s"))
    with pytest.raises(IngestError, match=r"the file states deg/s for gyr\[0\], the profile rad/s") as caught:
        read(hdf5, "array_file")
    assert caught.value.code == "other_unit"
    fields = profile("ardupilot")["mcap"]["topics"]["IMU[0]"] | {"accel_x": {"field": "AccX", "unit": "g"}}
    with pytest.raises(IngestError, match="the file states m/s/s for AccX, the profile g"):
        read(write_dataflash(tmp_path / "log.bin", Truth()), "ardupilot", topics={"IMU": fields})


def test_two_imus_in_a_bag_are_chosen_by_their_topic(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "log.bag", Truth(), ("/imu0", "/imu1"))
    with pytest.raises(IngestError, match="2 topics are of type") as caught:
        read(path, "mcap")
    assert caught.value.code == "ambiguous"
    assert_is(read(path, "mcap", imu_topic="/imu1"), Truth())


@pytest.mark.parametrize("suffix", MESSAGE_FORMATS)
def test_a_missing_library_names_the_extra(suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    known = MESSAGE_FORMATS[suffix]
    wanted = rf"'imu-calibration\[{known.extra}\]'" if known.extra else known.library
    parts = known.library.split(".")
    for depth in range(1, len(parts) + 1):
        monkeypatch.setitem(sys.modules, ".".join(parts[:depth]), None)
    path = tmp_path / f"log{suffix}"
    path.write_bytes(b"MATLAB 7.3")
    with pytest.raises(IngestError, match=rf"pip install {wanted}") as caught:
        read(path, "mcap")
    assert caught.value.code == "missing_extra"


def damaged(kind: str, data: bytes) -> bytes:
    """Return a log cut at a third, another file, or one with zeros over a fifth of it."""
    at = len(data) // 2
    zeros = data[:at] + bytes(at // 5) + data[at + at // 5 :]
    return {"cut": data[: len(data) // 3], "other": b"no log" * 100, "zeros": zeros}[kind]


DAMAGED = [(n, "other") for n in WRITERS]
DAMAGED += [(n, "cut") for n in ("log.bag", "log.db3", "log.h5", "log.mat", "log73.mat")]
DAMAGED += [(n, "zeros") for n in ("log.ulg", "log.bin", "log.db3")]


@pytest.mark.parametrize(("name", "kind"), DAMAGED)
def test_a_damaged_file_is_refused(name: str, kind: str, tmp_path: Path) -> None:
    write, ingest = WRITERS[name]
    path = write(tmp_path / name, Truth())
    path.write_bytes(damaged(kind, path.read_bytes()))
    with pytest.raises(IngestError):
        read(path, ingest)


def test_a_log_that_ends_with_the_power_gives_what_was_written_before(tmp_path: Path) -> None:
    """Neither format marks its end."""
    truth = Truth()
    for path, ingest in (
        (write_dataflash(tmp_path / "log.bin", truth), "ardupilot"),
        (write_ulog(tmp_path / "log.ulg", truth), "px4_ulog"),
    ):
        path.write_bytes(path.read_bytes()[:-20])
        table = read(path, ingest)
        assert table.time_ns.tolist()[:290] == (truth.time_us * 1000).tolist()[:290]
        assert 290 < len(table.time_ns) <= 300
        assert path.suffix == ".ulg" or "N-TRUNCATED" in {n.code for n in table.notes}


@pytest.mark.parametrize("name", ["log.bag", "log.bin", "log.mat"])
def test_apply_writes_the_calibrated_readings_as_canonical_csv(name: str, tmp_path: Path) -> None:
    write, ingest = WRITERS[name]
    truth = Truth()
    bias, matrix = np.array([0.01, -0.02, 0.03]), np.diag([1.1, 0.9, 1.0]) + 0.01
    fits = {s: SensorCalibration(s, bias, matrix).to_json() for s in ("accelerometer", "gyroscope")}
    head = {"schema_version": 1, "unit": "U1", "status": "ok", "error": None, "sensor": "generic"}
    (tmp_path / "U1.json").write_text(json.dumps({**head, **fits}))
    log, out = write(tmp_path / name, truth), tmp_path / "out.csv"
    assert apply([str(log), "--calibration", str(tmp_path / "U1.json"), "-o", str(out), "--ingest", ingest]) == 0
    found = np.genfromtxt(out, delimiter=",", names=True)
    np.testing.assert_allclose(found["time_s"], truth.time_us / 1e6, rtol=0, atol=1e-9)
    for prefix, unit, given in (("accel", "g", truth.force / GRAVITY), ("gyro", "dps", np.degrees(truth.rate))):
        columns = np.column_stack([found[f"{prefix}_{a}_{unit}"] for a in "xyz"])
        np.testing.assert_allclose(columns, (given - bias) @ matrix.T, rtol=0, atol=1e-11)


PROPOSED = {
    "log.ulg": ("sensor_combined", "timestamp", "us"),
    "log.bin": ("IMU", "TimeUS", "us"),
    "log.h5": ("/imu", "t", "s"),
    "log.mat": ("/imu", "t", "s"),
}


@pytest.mark.parametrize("name", PROPOSED)
def test_check_proposes_a_profile_that_reads_the_log(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth, profile_file = Truth(1200), tmp_path / "own.yaml"
    log = WRITERS[name][0](tmp_path / name, truth)
    assert check([str(log), "--save", str(profile_file)]) == 2
    saved = yaml.safe_load(profile_file.read_text())
    topic, time, unit = PROPOSED[name]
    assert saved["mcap"]["topics"][topic]["time"] == {"field": time, "unit": unit}
    assert_is(read_log(log, mcap_format(ingest_of(saved))), truth)
    assert "PROPOSED PROFILE" in capsys.readouterr().out


def in_columns(truth: Truth, *parts: str) -> np.ndarray:
    """Return an array as users save it, one row a sample: t, f and w are time (s), force and rate."""
    columns = {"t": truth.time_us[:, None] / 1e6, "f": truth.force, "w": truth.rate}
    return np.hstack([columns[part] for part in parts])


@pytest.mark.parametrize(
    "arrays", [{"acc": "tf", "gyr": "tw"}, {"data": "tfw"}, {"imu_log": "twf"}, {"acc": "f", "gyr": "w", "t": "t"}]
)
@pytest.mark.parametrize("suffix", [".mat", ".h5"])
def test_the_time_in_the_first_column_of_an_array_is_no_reading(
    arrays: dict[str, str], suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth, log, profile_file = Truth(1200), tmp_path / f"log{suffix}", tmp_path / "own.yaml"
    found = {name: in_columns(truth, *parts) for name, parts in arrays.items()}
    if suffix == ".mat":
        savemat(log, found)
    else:
        with h5py.File(log, "w") as file:
            for name, array in found.items():
                file[name] = array
    assert check([str(log), "--save", str(profile_file)]) == 2
    assert "100 Hz (median interval 10 ms)" in capsys.readouterr().out
    assert_is(read_log(log, mcap_format(ingest_of(yaml.safe_load(profile_file.read_text())))), truth)


def test_a_time_in_bursts_in_the_first_column_of_an_array_is_a_time(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth, log, profile_file = Truth(3200), tmp_path / "log.mat", tmp_path / "own.yaml"
    data = in_columns(truth, "t", "f", "w")
    data[:, 0] = np.repeat(data[15::16, 0], 16)
    savemat(log, {"data": data})
    assert check([str(log), "--save", str(profile_file)]) == 2
    assert "samples arrive in bursts of 16, 160 ms apart" in capsys.readouterr().out
    fields = yaml.safe_load(profile_file.read_text())["mcap"]["topics"]["/"]
    assert fields["time"] == {"field": "data[0]", "unit": "s"}
    assert fields["gyro_z"] == {"field": "data[6]", "unit": "rad/s"}


def test_two_files_of_arrays_are_one_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth, profile_file = Truth(1200), tmp_path / "own.yaml"
    files = [tmp_path / "IMU0x2Dalpha.mat", tmp_path / "IMU0x2Domega.mat"]  # as imu_tk_matlab names them
    savemat(files[0], {files[0].stem: in_columns(truth, "t", "f")})
    savemat(files[1], {files[1].stem: in_columns(truth, "t", "w")})
    assert check([*map(str, files), "--save", str(profile_file)]) == 2
    out = capsys.readouterr().out
    assert out.count("PROPOSED PROFILE") == 1
    assert "are one recording: place both in raw/<unit>/ under these names" in out
    ingest = yaml.safe_load(profile_file.read_text())
    assert [part["file"] for part in ingest["mcap"]["parts"]] == [file.name for file in files]
    recording = read_recordings(procedure("recording"), ingest_of(ingest), SENSOR, tmp_path)[0]
    assert recording.time_ns.tolist() == (truth.time_us * 1000).tolist()
    np.testing.assert_allclose(recording.accelerometer, truth.force / GRAVITY, rtol=1e-15)
    np.testing.assert_allclose(recording.gyroscope, np.degrees(truth.rate), rtol=1e-15)
    assert [other["file"] for other in recording.source["joined"]] == [str(files[1])]
    assert check([*map(str, files), "--ingest", str(profile_file)]) == 0
    fits = {s: SensorCalibration(s, np.zeros(3), 2.0 * np.eye(3)).to_json() for s in ("accelerometer", "gyroscope")}
    head = {"schema_version": 1, "unit": "U1", "status": "ok", "error": None, "sensor": "generic"}
    (tmp_path / "U1.json").write_text(json.dumps({**head, **fits}))
    arguments = ["--calibration", str(tmp_path / "U1.json"), "-o", str(tmp_path / "out.csv")]
    assert apply([*map(str, files), *arguments, "--ingest", str(profile_file)]) == 0
    written = np.genfromtxt(tmp_path / "out.csv", delimiter=",", names=True)
    np.testing.assert_allclose(written["gyro_y_dps"], 2.0 * np.degrees(truth.rate[:, 1]), rtol=0, atol=1e-9)
    savemat(files[1], {files[1].stem: in_columns(truth, "t", "w")[:-3]})
    with pytest.raises(InputError, match=r"1197 rows, but .* has 1200; parts of one recording need the same times"):
        read_recordings(procedure("recording"), ingest_of(ingest), SENSOR, tmp_path)
    ingest["mcap"]["topics"] = {"/": ingest["mcap"]["parts"][0]["topics"]["/"]}
    with pytest.raises(ConfigurationError, match=r"ingest\.mcap\.parts: topics stand in each part"):
        check_ingest(ingest_of(ingest))


def test_arrays_without_a_time_are_counted_at_the_stated_rate(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth, log, profile_file = Truth(1200), tmp_path / "log.mat", tmp_path / "own.yaml"
    savemat(log, {"acc": truth.force, "gyr": truth.rate})
    assert check([str(log), "--save", str(profile_file)]) == 2
    assert "Fill in ??? for rate_hz" in capsys.readouterr().out
    text = profile_file.read_text()
    assert 'rate_hz: "???"' in text
    unit = {f"gyro_{a}": "rad/s" for a in "xyz"}
    saved = yaml.safe_load(text.replace('rate_hz: "???"', "rate_hz: 100"))
    for channel, entry in saved["mcap"]["topics"]["/"].items():
        entry["unit"] = unit.get(channel, entry["unit"])
    table = read_log(log, mcap_format(ingest_of(saved)))
    assert table.time_ns.tolist() == (truth.time_us * 1000 - 2_000_000_000).tolist()
    np.testing.assert_allclose(table.values["gyro_x"], np.degrees(truth.rate[:, 0]), rtol=1e-15)
    (note,) = (n for n in table.notes if n.code == "N-SYNTHTIME")
    assert note.detail == "no times are read: messages counted at 100 Hz"
    saved["mcap"]["rate_hz"] = None
    with pytest.raises(ConfigurationError, match=r"time is missing: .* the sampling rate \(ingest\.mcap\.rate_hz\)"):
        mcap_format(ingest_of(saved))
    savemat(log, {"acc": truth.force, "gyr": truth.rate[:-2]})
    fields = saved["mcap"]["topics"]["/"]
    apart = {f"/{s}": {c: e for c, e in fields.items() if c[:3] == s} for s in ("acc", "gyr")}
    with pytest.raises(IngestError, match="counts the messages of topics of one length"):
        read_log(log, mcap_format(ingest_of({"mcap": {"rate_hz": 100.0, "topics": apart}})))


def test_a_log_without_readings_is_told_what_it_holds(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "talker.db3"
    store = STORES[".db3"]
    text, kind = store.types["std_msgs/msg/String"], "std_msgs/msg/String"
    with rosbag2.Writer(tmp_path / "talker", version=8) as bag:
        connection = bag.add_connection("/topic", kind, typestore=store)
        for i, data in enumerate(["a", "bcd", "", "efghij"]):
            bag.write(connection, i, store.serialize_cdr(text(data=data), kind))
    next((tmp_path / "talker").glob("*.db3")).rename(path)
    assert check([str(path)]) == 2
    said = " ".join(capsys.readouterr().out.split())  # the terminal's lines are wrapped
    assert "no topic of type sensor_msgs/msg/Imu; the file has /topic (std_msgs/msg/String)" in said
    assert "no topic holds the three axes of a sensor; the file has /topic (4)" in said


def test_arrays_of_several_lengths_are_topics_by_their_first_array(tmp_path: Path) -> None:
    truth, path = Truth(), tmp_path / "log.h5"
    with h5py.File(path, "w") as file:
        file["acc"], file["acc_t"] = truth.force, truth.time_us
        file["gyr"], file["gyr_t"] = truth.rate[:-5], truth.time_us[:-5]
        file["table"] = np.array(
            [(t, *f) for t, f in zip(truth.time_us, truth.force, strict=True)],
            [("t", "<i8"), ("x", "<f4"), ("y", "<f4"), ("z", "<f4")],
        )
    axes = {f"accel_{a}": {"field": f"acc[{i}]", "unit": "m/s^2"} for i, a in enumerate("xyz")}
    table = read(path, "array_file", topics={"/acc": {"time": {"field": "acc_t", "unit": "us"}, **axes}})
    np.testing.assert_allclose(table.values["accel_y"], truth.force[:, 1] / GRAVITY, rtol=1e-15)
    axes = {f"accel_{a}": {"field": a, "unit": "m/s^2"} for a in "xyz"}
    table = read(path, "array_file", topics={"/table": {"time": {"field": "t", "unit": "us"}, **axes}})
    np.testing.assert_allclose(table.values["accel_y"], truth.force[:, 1] / GRAVITY, rtol=1e-15)
    gyro = {f"gyro_{a}": {"field": f"gyr[{i}]", "unit": "rad/s"} for i, a in enumerate("xyz")}
    force = {f"accel_{a}": {"field": f"acc[{i}]", "unit": "m/s^2"} for i, a in enumerate("xyz")}
    topics = {
        "/acc": {"time": {"field": "acc_t", "unit": "us"}, **force},
        "/gyr": {"time": {"field": "gyr_t", "unit": "us"}, **gyro},
    }
    assert read(path, "array_file", topics=topics, sensor_clock="own").values["gyro_z"].shape == (293,)
    with pytest.raises(IngestError, match="both sensors need the same stamps, and the gyroscope has others"):
        read(path, "array_file", topics=topics)
    with pytest.raises(IngestError, match="has no recorder's times"):
        read(path, "array_file", topics={"/table": axes}, time_source="log_time")
