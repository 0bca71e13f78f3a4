"""ROS 2 logs: the same numbers as the text log of the same recording, and no damage that goes unseen."""

from __future__ import annotations

import re
from dataclasses import replace
from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from damaged_logs import copy_with, read_messages
from mcap.stream_reader import StreamReader
from mcap.writer import Writer
from mcap_ros2.writer import Writer as Ros2Writer
from sample_logs import SENSOR, channels, make_recording, procedure
from unit_settings import ingest_of

from imu_logs.mcap_file import McapReader
from imu_logs.mcap_write import DEFINITIONS, IMU, JOINT_STATE, TEMPERATURE
from pipeline.core.errors import InputError
from pipeline.ingest.arrow import write_recording
from pipeline.ingest.read import read_recordings

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from pipeline.core.records import Recording


def read(folder: Path, **mcap: Any) -> Recording:
    ingest = {"name": "mcap", "mcap": mcap}
    return read_recordings(procedure("accel_x"), ingest_of(ingest), SENSOR, folder)[0]


def header(seconds: int, nanoseconds: int = 0) -> dict[str, Any]:
    return {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": "imu_link"}


def imu(seconds: int, nanoseconds: int = 0, **changes: Any) -> dict[str, Any]:
    zeros = [0.0] * 9
    return {
        "header": header(seconds, nanoseconds),
        "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
        "orientation_covariance": zeros,
        "angular_velocity": {"x": np.pi, "y": 0.0, "z": 0.0},
        "angular_velocity_covariance": zeros,
        "linear_acceleration": {"x": 0.0, "y": 0.0, "z": 9.80665},
        "linear_acceleration_covariance": zeros,
        **changes,
    }


def joint(seconds: int, **changes: Any) -> dict[str, Any]:
    state = {"name": ["base", "table"], "position": [0.0, np.pi / 2], "velocity": [0.0, 1.0], "effort": []}
    return {"header": header(seconds), **state, **changes}


def write_ros2(path: Path, *messages: tuple[str, str, dict[str, Any]]) -> None:
    """Write (topic, type, message) with the official encoder."""
    with path.open("wb") as stream, Ros2Writer(stream) as writer:
        schemas = {k: writer.register_msgdef(k, t) for k, t in DEFINITIONS.items()}
        for index, (topic, kind, message) in enumerate(messages):
            writer.write_message(topic, schemas[kind], message, log_time=10**15 + index)


def test_log_equals_its_text_twin_to_the_last_digit(tmp_path: Path, canonical: dict[str, Any]) -> None:
    recording = make_recording(500)
    names = ("accel_x_g", "accel_y_g", "accel_z_g", "gyro_x_dps", "gyro_y_dps", "gyro_z_dps", "table_rate_dps")
    write_recording(tmp_path / "a.csv", recording, dict.fromkeys(names, 9))
    text = read_recordings(procedure("a"), ingest_of(canonical), SENSOR, tmp_path)[0]
    write_recording(tmp_path / "accel_x.mcap", text)
    log = read(tmp_path)
    for name, values in channels(text).items():
        twin = getattr(log, name)
        if values is None:
            assert twin is None
        elif name in ("time_ns", "temperature", "table_attitude"):
            np.testing.assert_array_equal(twin, values)
        else:  # through m/s^2 and rad/s and back: two roundings
            np.testing.assert_allclose(twin, values, rtol=4.5e-16, atol=0)
            np.testing.assert_array_equal(np.round(twin, 9), np.round(values, 9))


def test_channels_that_are_absent_stay_absent(tmp_path: Path) -> None:
    bare = replace(
        make_recording(), gyroscope=None, temperature=None, table_angle=None, table_rate=None, table_attitude=None
    )
    write_recording(tmp_path / "accel_x.mcap", bare)
    log = read(tmp_path)
    present = {n for n, v in channels(log).items() if v is not None}
    assert present == {"time_ns", "accelerometer"}
    assert [n.code for n in log.notes] == ["N-ABSENT"]


def test_writing_twice_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in "ab":
        write_recording(tmp_path / f"{name}.mcap", make_recording())
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_file_of_the_official_encoder_is_read_in_house_units(tmp_path: Path) -> None:
    messages = [("/imu", IMU, imu(s, 5)) for s in range(3)]
    messages += [
        ("/temperature", TEMPERATURE, {"header": header(s), "temperature": 20.0 + s, "variance": 0.0}) for s in (0, 4)
    ]
    messages += [("/camera", JOINT_STATE, joint(s)) for s in range(3)]
    messages += [("/table", JOINT_STATE, joint(s, header=header(s, 5))) for s in range(4)]
    write_ros2(tmp_path / "accel_x.mcap", *messages)
    log = read(tmp_path, joint_topic="/table", joint="table")
    assert log.time_ns.tolist() == [5, 1_000_000_005, 2_000_000_005]
    assert log.accelerometer is not None
    assert log.gyroscope is not None
    assert log.table_angle is not None
    assert log.table_rate is not None
    assert log.temperature is not None
    np.testing.assert_array_equal(log.accelerometer[0], [0.0, 0.0, 1.0])
    np.testing.assert_array_equal(log.gyroscope[0], [180.0, 0.0, 0.0])
    np.testing.assert_array_equal(log.table_angle, [90.0] * 3)
    np.testing.assert_allclose(log.table_rate, [57.29577951308232] * 3, rtol=1e-15)
    np.testing.assert_allclose(log.temperature, [20, 21, 22], atol=1e-7)
    assert {n.code for n in log.notes} == {"N-INTERPOLATED", "N-UNMATCHED", "N-IGNORED"}


def test_a_temperature_is_that_of_the_time_of_its_own_stamps_and_held_at_the_ends(tmp_path: Path) -> None:
    warmth = [
        ("/temperature", TEMPERATURE, {"header": header(s), "temperature": value, "variance": 0.0})
        for s, value in ((1, 20.0), (3, 22.0))
    ]
    write_ros2(tmp_path / "accel_x.mcap", *(("/imu", IMU, imu(s)) for s in range(5)), *warmth)
    found = read(tmp_path).temperature
    assert found is not None
    np.testing.assert_allclose(found, [20.0, 20.0, 21.0, 22.0, 22.0])


MINUS_ONE = [-1.0, *[0.0] * 8]
IMUS = [("/a", IMU, imu(s)) for s in (1, 2)]
ABSENT = {"angular_velocity_covariance": MINUS_ONE, "linear_acceleration_covariance": MINUS_ONE}
NAN = {"x": np.nan, "y": 0.0, "z": 0.0}


def table(**changes: Any) -> list[tuple[str, str, dict[str, Any]]]:
    return [("/t", JOINT_STATE, joint(s, **changes)) for s in (1, 2)]


REFUSED: dict[str, tuple[list[tuple[str, str, dict[str, Any]]], str]] = {
    "no imu": (table(), r"no topic of type sensor_msgs/msg/Imu; the file has /t \(sensor_msgs"),
    "two imus": ([("/a", IMU, imu(0)), ("/b", IMU, imu(0))], "2 topics are of type .*: /a, /b; choose one"),
    "two joints": (IMUS + table(), r"joints base, table; set ingest\.mcap\.joint"),
    "stamps of zero": ([("/a", IMU, imu(0))] * 3, "all header stamps are 0"),
    "stamps that go back": ([("/a", IMU, imu(s)) for s in (1, 20, 1)], "message 3 on /a: header stamp 1 s after 20 s"),
    "table of another clock": (
        [*IMUS, *[("/t", JOINT_STATE, joint(s, name=["x"], position=[1.0], velocity=[])) for s in (1, 3)]],
        "1 of 2 Imu messages have no message of equal stamp on /t, the first at 2 s",
    ),
    "absent in some": (
        [("/a", IMU, imu(1)), ("/a", IMU, imu(2, angular_velocity_covariance=MINUS_ONE))],
        "angular_velocity is absent .* see message 2",
    ),
    "absent in all": ([("/a", IMU, imu(s, **ABSENT)) for s in (1, 2)], "both quantities are absent"),
    "no number": (
        [("/a", IMU, imu(s, angular_velocity=NAN)) for s in (1, 2)],
        r"gyro_x is nan at 1 s \(2 such samples\)",
    ),
    "too many velocities": (
        IMUS + table(name=["x"], position=[], velocity=[1.0, 2.0]),
        "2 numbers of velocity for 1 joints",
    ),
    "empty in some": (
        [*IMUS, table(name=["x"], position=[1.0], velocity=[])[0], table(name=["x"], position=[], velocity=[])[1]],
        "position of the only joint is empty in some messages on /t",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refusal_says_what_and_where(tmp_path: Path, case: str) -> None:
    messages, expected = REFUSED[case]
    write_ros2(tmp_path / "accel_x.mcap", *messages)
    with pytest.raises(InputError) as caught:
        read(tmp_path)
    assert re.search(expected, caught.value.message), caught.value.message
    assert caught.value.file == str(tmp_path / "accel_x.mcap")


def test_topic_or_joint_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    write_recording(tmp_path / "accel_x.mcap", make_recording())
    with pytest.raises(InputError, match=r"no topic /imu of type .*; the file has /imu/data"):
        read(tmp_path, imu_topic="/imu")
    with pytest.raises(
        InputError, match=r"message 1 on /table/joint_states .* wheel is not among its names, which are table"
    ):
        read(tmp_path, joint="wheel")


def test_message_of_another_type_than_its_definition_says_is_refused(tmp_path: Path) -> None:
    """The decoder reads Imu bytes by the definition of Temperature without complaint; the length tells."""
    with (tmp_path / "accel_x.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema(IMU, "ros2msg", DEFINITIONS[TEMPERATURE].encode())
        channel = writer.register_channel("/imu", "cdr", schema)
        writer.add_message(channel, 1, bytes([0, 1, 0, 0, *[0] * 320]), 1)
        writer.finish()
    with pytest.raises(InputError, match="message 1 on /imu"):
        read(tmp_path)


@pytest.mark.parametrize("extra", [-8, 8])
def test_message_of_a_wrong_length_is_refused(tmp_path: Path, extra: int) -> None:
    write_recording(tmp_path / "whole.mcap", make_recording(10))
    _, by_channel = read_messages((tmp_path / "whole.mcap").read_bytes())
    with (tmp_path / "accel_x.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel(
            "/imu", "cdr", writer.register_schema(IMU, "ros2msg", DEFINITIONS[IMU].encode())
        )
        for message in by_channel[1]:
            data = message.data + bytes(extra) if extra > 0 else message.data[:extra]
            writer.add_message(channel, message.log_time, data, message.log_time)
        writer.finish()
    with pytest.raises(InputError, match="message 1 on /imu"):
        read(tmp_path)


@pytest.mark.parametrize(
    ("message_encoding", "schema_encoding"), [("flatbuffer", "flatbuffer"), ("cdr", "ros2idl"), ("cbor", "")]
)
def test_other_encodings_are_refused_by_name(tmp_path: Path, message_encoding: str, schema_encoding: str) -> None:
    with (tmp_path / "accel_x.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel("/imu", message_encoding, writer.register_schema(IMU, schema_encoding, b""))
        writer.add_message(channel, 1, b"x", 1)
        writer.finish()
    with pytest.raises(InputError, match=rf"topic /imu is encoded as '{message_encoding}' with '{schema_encoding}'"):
        read(tmp_path)


def test_text_under_the_name_of_a_log_is_refused(tmp_path: Path) -> None:
    (tmp_path / "accel_x.mcap").write_text("time_s,accel_x_g\n")
    with pytest.raises(InputError, match=r"it starts with 'time_s,a'; a text log needs the suffix .csv"):
        read(tmp_path)


def test_file_without_checksums_is_noted(tmp_path: Path) -> None:
    write_recording(tmp_path / "whole.mcap", make_recording(10))
    copy_with(tmp_path / "whole.mcap", tmp_path / "accel_x.mcap", enable_crcs=False)
    assert [n.code for n in read(tmp_path).notes] == ["N-NOCRC"]


def test_chunk_that_claims_to_be_huge_is_refused_before_it_is_unpacked(tmp_path: Path) -> None:
    write_recording(tmp_path / "accel_x.mcap", make_recording(5))
    whole = (tmp_path / "accel_x.mcap").read_bytes()
    chunk = whole.index(b"\x04\x00\x00\x00zstd")
    damaged = whole[: chunk - 12] + (1 << 40).to_bytes(8, "little") + whole[chunk - 4 :]
    (tmp_path / "accel_x.mcap").write_bytes(damaged)
    with pytest.raises(InputError, match="a chunk claims to hold 1099511627776 bytes"):
        read(tmp_path)


@pytest.mark.parametrize(
    ("lost", "message"),
    [
        (0, r"messages of channel 1, which no record before them defines: a part is missing"),
        (1, r"the summary lists \d+ chunks, and the file holds \d+ at the stated places: a part is missing"),
    ],
)
def test_lost_chunk_is_missed_by_the_summary(tmp_path: Path, lost: int, message: str) -> None:
    """Without a checksum of the data section, only the summary tells that a chunk is gone."""
    write_recording(tmp_path / "source.mcap", make_recording(60))
    file = tmp_path / "accel_x.mcap"
    copy_with(tmp_path / "source.mcap", file, chunk_size=4000)
    whole = bytearray(file.read_bytes())
    reader = McapReader(BytesIO(whole), "")
    list(reader.rows())
    whole[reader.chunks[lost]] = 0x60  # no known kind of record: readers skip it
    file.write_bytes(whole)
    with pytest.raises(InputError, match=message):
        read(tmp_path)


@pytest.mark.parametrize("time", [-1, 2**31 * 10**9])
def test_times_that_no_stamp_can_hold_are_refused(tmp_path: Path, time: int) -> None:
    with pytest.raises(InputError, match="between 0 and"):
        write_recording(tmp_path / "a.mcap", make_recording(5, start_ns=time))
    assert list(tmp_path.iterdir()) == []


def records_of(path: Path, keep: Callable[[object], bool]) -> int:
    with path.open("rb") as stream:
        return sum(keep(r) for r in StreamReader(stream, emit_chunks=True).records)


def test_written_chunks_and_data_carry_checksums(tmp_path: Path) -> None:
    write_recording(tmp_path / "a.mcap", make_recording(50))
    missing = records_of(
        tmp_path / "a.mcap", lambda r: 0 in (getattr(r, "uncompressed_crc", 1), getattr(r, "data_section_crc", 1))
    )
    assert missing == 0
