"""Logs of other types, encodings and layouts: by their fields, by their topics, or refused by name."""

from __future__ import annotations

import json
import struct
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.writer import Writer
from rosbags.typesys import Stores, get_typestore
from sample_logs import SENSOR, procedure, profile
from unit_settings import ingest_of

from imu_logs.mcap_write import DEFINITIONS, IMU
from imu_logs.message_read import read_log
from imu_logs.profile import mcap_format
from pipeline.core.errors import ConfigurationError, IngestError
from pipeline.ingest.read import read_recordings

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from imu_logs.log import Log

SECOND = 10**9
GRAVITY = 9.80665
STORE2 = get_typestore(Stores.ROS2_HUMBLE)
STORE1 = get_typestore(Stores.ROS1_NOETIC)
MAPPED: dict[str, Any] = profile("mcap_fields")["mcap"]["topics"]["/imu"]


def read(path: Path, **mcap: Any) -> Log:
    return read_log(path, mcap_format(ingest_of({"mcap": mcap})))


def write(path: Path, *topics: tuple[str, str, tuple[str, str, bytes], Sequence[bytes]], **options: Any) -> None:
    """Write (topic, message encoding, (schema name, schema encoding, schema), messages), a second apart."""
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start()
        for topic, encoding, schema, messages in topics:
            number = 0 if schema[0] == "" else writer.register_schema(*schema)
            channel = writer.register_channel(topic, encoding, number)
            for index, data in enumerate(messages):
                writer.add_message(channel, (index + 1) * SECOND, data, (index + 1) * SECOND, index)
        writer.finish()


def imu_message(store: Any, index: int, *, frame: str = "imu_link") -> Any:
    vector, types = store.types["geometry_msgs/msg/Vector3"], store.types
    time = types["builtin_interfaces/msg/Time"](sec=index + 1, nanosec=7)
    extra = {"seq": index} if store is STORE1 else {}
    return types[IMU](
        header=types["std_msgs/msg/Header"](stamp=time, frame_id=frame, **extra),
        orientation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=np.zeros(9),
        angular_velocity=vector(x=np.pi, y=0.0, z=float(index)),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=vector(x=0.0, y=GRAVITY * index, z=GRAVITY),
        linear_acceleration_covariance=np.zeros(9),
    )


def cdr_imu(index: int, *, frame: str = "imu_link", little_endian: bool = True) -> bytes:
    message = imu_message(STORE2, index, frame=frame)
    return bytes(STORE2.serialize_cdr(message, IMU, little_endian=little_endian))


IMU_PARTS = [
    f"{name}{end}" for name in ("orientation", "angular_velocity", "linear_acceleration") for end in ("", "_covariance")
]
ROS2_IMU = (IMU, "ros2msg", DEFINITIONS[IMU].encode())


def assert_is_the_imu(table: Log, count: int) -> None:
    assert table.time_ns.tolist() == [(i + 1) * SECOND + 7 for i in range(count)]
    np.testing.assert_array_equal(table.values["accel_y"], np.arange(float(count)))
    np.testing.assert_array_equal(table.values["accel_z"], np.ones(count))
    np.testing.assert_array_equal(table.values["gyro_x"], np.full(count, 180.0))
    np.testing.assert_array_equal(table.values["gyro_z"], np.arange(float(count)) * (180 / np.pi))


def test_big_endian_messages_are_read_right(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", ("/imu", "cdr", ROS2_IMU, [cdr_imu(i, little_endian=False) for i in range(5)]))
    table = read(tmp_path / "a.mcap")
    assert_is_the_imu(table, 5)
    assert table.notes == ()


@pytest.mark.parametrize("other", [{"frame": "imu_link_2"}, {"frame": "imu_lonk"}, {"little_endian": False}])
def test_frame_or_byte_order_that_changes_within_a_chunk_is_read_by_layout(
    tmp_path: Path, other: dict[str, Any]
) -> None:
    messages = [cdr_imu(i, **(other if i in (3, 4) else {})) for i in range(7)]
    write(tmp_path / "a.mcap", ("/imu", "cdr", ROS2_IMU, messages))
    table = read(tmp_path / "a.mcap")
    assert_is_the_imu(table, 7)
    assert [(n.code, n.count) for n in table.notes] == [("N-FALLBACK", 7)]


def test_messages_that_all_differ_in_layout_are_read(tmp_path: Path) -> None:
    """More layouts than are looked for in the rest of a run, of several lengths and in turns."""
    for name, frames in (("a.mcap", [f"imu_{i % 50}" for i in range(120)]), ("b.mcap", ["imu"] * 120)):
        messages = [cdr_imu(i, frame=frame) for i, frame in enumerate(frames)]
        write(tmp_path / name, ("/imu", "cdr", ROS2_IMU, messages))
    varied, alike = read(tmp_path / "a.mcap"), read(tmp_path / "b.mcap")
    assert varied.time_ns.tolist() == alike.time_ns.tolist() == [(i + 1) * SECOND + 7 for i in range(120)]
    assert {c: v.tolist() for c, v in varied.values.items()} == {c: v.tolist() for c, v in alike.values.items()}
    assert [(n.code, n.count) for n in varied.notes] == [("N-FALLBACK", 120)]


@pytest.mark.parametrize("kind", [0x02, 0x03, 0x06, 0x07, 0x09, 0x0B])
def test_other_encapsulations_are_refused(tmp_path: Path, kind: int) -> None:
    messages = [cdr_imu(0), bytes([0, kind]) + cdr_imu(1)[2:]]
    write(tmp_path / "a.mcap", ("/imu", "cdr", ROS2_IMU, messages))
    with pytest.raises(IngestError, match=f"message 2 on /imu .* its encapsulation is 00 {kind:02x} 00 00") as caught:
        read(tmp_path / "a.mcap")
    assert caught.value.code == "bad_message"


def ros1_topic(topic: str, name: str, make: Callable[[int], dict[str, Any]]) -> tuple[str, str, Any, list[bytes]]:
    """Return four messages of a type with a header."""
    kind, types, messages = f"sensor_msgs/msg/{name}", STORE1.types, []
    for index in range(4):
        stamp = types["builtin_interfaces/msg/Time"](sec=index + 1, nanosec=7)
        header = types["std_msgs/msg/Header"](seq=index, stamp=stamp, frame_id="")
        messages.append(bytes(STORE1.serialize_ros1(types[kind](header=header, **make(index)), kind)))
    definition = STORE1.generate_msgdef(kind, ros_version=1)[0].encode()
    return topic, "ros1", (f"sensor_msgs/{name}", "ros1msg", definition), messages


def ros1_joints(index: int) -> dict[str, Any]:
    position, velocity = np.array([0.0, np.pi * index]), np.array([1.0, np.pi])
    return {"name": ["base", "table"], "position": position, "velocity": velocity, "effort": np.array([])}


def test_ros_1_log_of_the_usual_types_is_read(tmp_path: Path) -> None:
    field = STORE1.types["geometry_msgs/msg/Vector3"](x=1.0, y=2.0, z=3.0)
    write(
        tmp_path / "a.mcap",
        ros1_topic("/imu", "Imu", lambda i: {k: v for k, v in vars(imu_message(STORE1, i)).items() if k in IMU_PARTS}),
        ros1_topic("/temperature", "Temperature", lambda i: {"temperature": 20.0 + i, "variance": 0.0}),
        ros1_topic("/table", "JointState", ros1_joints),
        ros1_topic(
            "/field", "MagneticField", lambda _: {"magnetic_field": field, "magnetic_field_covariance": np.zeros(9)}
        ),
    )
    table = read(tmp_path / "a.mcap", joint="table")
    assert_is_the_imu(table, 4)
    assert table.values["temperature"].tolist() == [20.0, 21.0, 22.0, 23.0]
    assert table.values["table_angle"].tolist() == [0.0, 180.0, 360.0, 540.0]
    assert table.values["table_rate"].tolist() == [180.0] * 4
    assert [(n.code, n.detail) for n in table.notes] == [
        ("N-IGNORED", "topics not used: /field (sensor_msgs/MagneticField)")
    ]


def test_one_of_several_imus_is_chosen_by_topic(tmp_path: Path) -> None:
    other = [cdr_imu(i + 10) for i in range(3)]
    topics = (("/a", "cdr", ROS2_IMU, [cdr_imu(i) for i in range(3)]), ("/b", "cdr", ROS2_IMU, other))
    write(tmp_path / "a.mcap", *topics)
    with pytest.raises(IngestError, match=r"2 topics are of type sensor_msgs/msg/Imu: /a, /b; choose one") as caught:
        read(tmp_path / "a.mcap")
    assert caught.value.code == "ambiguous"
    table = read(tmp_path / "a.mcap", imu_topic="/a")
    assert_is_the_imu(table, 3)
    assert [n.detail for n in table.notes] == ["topics not used: /b (sensor_msgs/msg/Imu)"]


def json_imu(index: int, **changes: Any) -> bytes:
    message = {
        "timestamp": {"sec": index + 1, "nsec": 7},
        "linear_acceleration": {"x": 0.0, "y": GRAVITY * index, "z": GRAVITY},
        "angular_velocity": {"x": np.pi, "y": 0, "z": float(index)},
    }
    return json.dumps(message | changes).encode()


def test_json_is_read_by_its_fields(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", ("/imu", "json", ("", "", b""), [json_imu(i) for i in range(4)]))
    assert_is_the_imu(read(tmp_path / "a.mcap", topics={"/imu": MAPPED}), 4)


def test_lists_counts_and_integer_times_are_read(tmp_path: Path) -> None:
    messages = [json.dumps({"t": 1_700_000_000_000_001 + 10 * i, "acc": [i, 0, 8192]}).encode() for i in range(3)]
    write(tmp_path / "a.mcap", ("/imu", "json", ("", "", b""), messages))
    counts = {"unit": "counts", "counts_per_unit": 8192.0}
    axes = {f"accel_{a}": {"field": f"acc[{i}]", **counts} for i, a in enumerate("xyz")}
    topics = {"/imu": {"time": {"field": "t", "unit": "us"}, **axes}}
    table = read(tmp_path / "a.mcap", topics=topics, clock_difference_s=None)
    assert table.time_ns.tolist() == [1_700_000_000_000_001_000 + 10_000 * i for i in range(3)]
    assert table.values["accel_z"].tolist() == [1.0] * 3
    assert table.values["accel_x"].tolist() == [0.0, 1 / 8192, 2 / 8192]
    assert table.count_sizes["accel_x"] == 1 / 8192


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        (b"[", "message 2 on /imu .* cannot be read as json: Expecting value"),
        (b"\xff", "message 2 on /imu .* 'utf-8' codec"),
        (json_imu(1, angular_velocity={"x": 1.0}), "it has no field angular_velocity.y; there are x"),
        (json_imu(1, angular_velocity={"x": "1", "y": 0, "z": 0}), "angular_velocity.x is '1'; a number is expected"),
        (json_imu(1, angular_velocity={"x": True, "y": 0, "z": 0}), "angular_velocity.x is True; a number"),
        (json_imu(1, angular_velocity={"x": float("nan"), "y": 0, "z": 0}), r"gyro_x is nan at 2.00000001 s \(1 such"),
        (json_imu(1, timestamp={"sec": 2, "nsec": SECOND}), "its stamp has 1000000000 nanoseconds"),
        (json_imu(1, timestamp="yesterday"), "timestamp is 'yesterday'; a number, or seconds and nanoseconds"),
        (json_imu(1, timestamp=10**30), "its stamp of 10+ ns is out of range"),
    ],
)
def test_faulty_json_is_refused_by_message_and_field(tmp_path: Path, message: bytes, expected: str) -> None:
    write(tmp_path / "a.mcap", ("/imu", "json", ("", "", b""), [json_imu(0), message]))
    with pytest.raises(IngestError, match=expected):
        read(tmp_path / "a.mcap", topics={"/imu": MAPPED})


def protobuf_types() -> tuple[bytes, Any]:
    """Return a description of lab.Imu with a google.protobuf.Timestamp, and its class."""
    files = descriptor_pb2.FileDescriptorSet()
    stamp = files.file.add(name="google/protobuf/timestamp.proto", package="google.protobuf", syntax="proto3")
    kind = stamp.message_type.add(name="Timestamp")
    kind.field.add(name="seconds", number=1, type=3, label=1)
    kind.field.add(name="nanos", number=2, type=5, label=1)
    file = files.file.add(name="lab.proto", package="lab", syntax="proto3", dependency=[stamp.name])
    vector = file.message_type.add(name="Vector")
    for number, axis in enumerate("xyz", 1):
        vector.field.add(name=axis, number=number, type=1, label=1)
    imu = file.message_type.add(name="Imu")
    imu.field.add(name="timestamp", number=1, type=11, label=1, type_name=".google.protobuf.Timestamp")
    for number, name in enumerate(("linear_acceleration", "angular_velocity"), 2):
        imu.field.add(name=name, number=number, type=11, label=1, type_name=".lab.Vector")
    pool = descriptor_pool.DescriptorPool()
    for one in files.file:
        pool.Add(one)
    return files.SerializeToString(), message_factory.GetMessageClass(pool.FindMessageTypeByName("lab.Imu"))


def test_protobuf_is_read_by_its_fields(tmp_path: Path) -> None:
    definition, kind = protobuf_types()
    messages = []
    for index in range(4):
        message = kind()
        message.timestamp.seconds, message.timestamp.nanos = index + 1, 7
        message.linear_acceleration.y, message.linear_acceleration.z = GRAVITY * index, GRAVITY
        message.angular_velocity.x, message.angular_velocity.z = np.pi, float(index)
        messages.append(message.SerializeToString())
    topic = ("/imu", "protobuf", ("lab.Imu", "protobuf", definition), messages)
    write(tmp_path / "a.mcap", topic)
    assert_is_the_imu(read(tmp_path / "a.mcap", topics={"/imu": MAPPED}), 4)
    with pytest.raises(IngestError, match=r"no topic of type .*; the file has /imu \(lab.Imu\); ingest.mcap.topics"):
        read(tmp_path / "a.mcap")
    bad = {**MAPPED, "gyro_x": {"field": "rate.x", "unit": "rad/s"}}
    with pytest.raises(IngestError, match=r"it has no field rate\.x; there are timestamp, linear_acceleration"):
        read(tmp_path / "a.mcap", topics={"/imu": bad})
    message.ClearField("angular_velocity")
    write(tmp_path / "a.mcap", (*topic[:3], [*messages[:3], message.SerializeToString()]))
    with pytest.raises(IngestError, match=r"message 4 on /imu .* it has no value of angular_velocity for "):
        read(tmp_path / "a.mcap", topics={"/imu": MAPPED})


def test_table_in_a_topic_of_its_own_joins_by_equal_times(tmp_path: Path) -> None:
    angles = [json.dumps({"timestamp": {"sec": i, "nsec": 7}, "deg": 10.0 * i}).encode() for i in range(6)]
    plain = ("", "", b"")
    write(tmp_path / "a.mcap", ("/imu", "json", plain, [json_imu(i) for i in range(4)]), ("/t", "json", plain, angles))
    angle = {"time": MAPPED["time"], "table_angle": {"field": "deg", "unit": "deg"}}
    table = read(tmp_path / "a.mcap", topics={"/imu": MAPPED, "/t": angle})
    assert_is_the_imu(table, 4)
    assert table.values["table_angle"].tolist() == [10.0, 20.0, 30.0, 40.0]
    assert [(n.code, n.count) for n in table.notes] == [("N-UNMATCHED", 2)]


def test_mapped_topic_that_is_not_there_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", ("/imu2", "json", ("", "", b""), [json_imu(0)]))
    with pytest.raises(IngestError, match=r"no messages on /imu; the file has /imu2 \(json\)"):
        read(tmp_path / "a.mcap", topics={"/imu": MAPPED})


def test_profile_of_fields_reads_a_recording(tmp_path: Path) -> None:
    messages = [json_imu(i, linear_acceleration={"x": 0, "y": 0, "z": GRAVITY}) for i in range(4)]
    write(tmp_path / "accel_x.mcap", ("/imu", "json", ("", "", b""), messages))
    (recording,) = read_recordings(procedure("accel_x"), ingest_of(profile("mcap_fields")), SENSOR, tmp_path)
    assert recording.accelerometer is not None
    assert recording.accelerometer.tolist() == [[0.0, 0.0, 1.0]] * 4


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"accel_x": {"field": "a.x", "unit": "furlong"}}, "accel_x.unit is 'furlong'; allowed are g"),
        ({"accel_x": {"field": "a..x", "unit": "g"}}, "'a..x' is no path to a field"),
        ({"accel_x": {"field": "a.x", "unit": "counts"}}, "counts_per_unit is None"),
        ({"accel_x": None}, "accel_x is not described"),
        ({"time": None}, "/imu.time is missing"),
        ({"acel_x": {"field": "a"}}, "acel_x is unknown; did you mean accel_x"),
    ],
)
def test_faulty_map_is_refused_before_any_file(change: dict[str, Any], expected: str) -> None:
    with pytest.raises(ConfigurationError, match=expected):
        mcap_format(ingest_of({"mcap": {"topics": {"/imu": {**MAPPED, **change}}}}))


@pytest.mark.parametrize(
    ("key", "value"), [("time_source", "gps"), ("allow_truncated", 1), ("reorder_s", -1), ("clock_difference_s", "1 h")]
)
def test_faulty_setting_is_refused(key: str, value: Any) -> None:
    with pytest.raises(ConfigurationError, match=rf"ingest\.mcap\.{key} is"):
        mcap_format(ingest_of({"mcap": {key: value}}))


def test_definition_without_end_is_refused(tmp_path: Path) -> None:
    rule = "=" * 80
    for text, expected in (
        ("lab/Box inner\n" + f"{rule}\nMSG: lab/Box\nlab/Box box\n", "lab/Box contains itself"),
        ("lab/A[999] a\n" + f"{rule}\nMSG: lab/A\nlab/B[999] b\n{rule}\nMSG: lab/B\n", "more than 100000 fields"),
        ("float64 x\nfloat64[]\n", r"line 2 of sensor_msgs/Imu is no field: 'float64\[\]'"),
        ("lab/Nowhere x\n", "type lab/Nowhere in sensor_msgs/Imu is not defined"),
    ):
        schema = ("sensor_msgs/Imu", "ros1msg", text.encode())
        write(tmp_path / "a.mcap", ("/imu", "ros1", schema, [struct.pack("<1000x")] * 2))
        with pytest.raises(IngestError, match=expected):
            read(tmp_path / "a.mcap")
