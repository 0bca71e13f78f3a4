"""Write the ROS 2 messages of a calibration log: recordings as MCAP files, and calibrated Imu messages.

    linear_acceleration [m/s^2] = specific force [g] * 9.80665
    angular_velocity [rad/s]    = angular rate [deg/s] * pi/180

All messages of a topic have one length: they are the rows of a table of bytes, which is filled column by column.
"""

from __future__ import annotations

import os
import struct
from typing import TYPE_CHECKING

import numpy as np
from mcap.opcode import Opcode
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import Writer

from pipeline.errors import InputError
from pipeline.io.mcap_chunk import HEAD, MESSAGE_HEAD
from pipeline.io.message_layout import LITTLE_ENDIAN
from pipeline.io.units import SECOND_NS, STANDARD_GRAVITY
from pipeline.records import SENSORS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from pipeline.io.mcap_chunk import ChannelMessages
    from pipeline.io.message_layout import MessageLayout
    from pipeline.records import Index, Integers, Recording, Values

    Readings = Mapping[str, Values]  # sensor to (n, 3) readings, or to the (3, 3) covariance of a sample

IMU = "sensor_msgs/msg/Imu"
TEMPERATURE = "sensor_msgs/msg/Temperature"
JOINT_STATE = "sensor_msgs/msg/JointState"
QUATERNION_STAMPED = "geometry_msgs/msg/QuaternionStamped"

_RULE = "=" * 80
_HEADER = f"""{_RULE}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{_RULE}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
_QUATERNION = f"""{_RULE}
MSG: geometry_msgs/Quaternion
float64 x 0
float64 y 0
float64 z 0
float64 w 1
"""
_VECTOR = f"""{_RULE}
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
"""
DEFINITIONS = {
    IMU: f"""std_msgs/Header header
geometry_msgs/Quaternion orientation
float64[9] orientation_covariance
geometry_msgs/Vector3 angular_velocity
float64[9] angular_velocity_covariance
geometry_msgs/Vector3 linear_acceleration
float64[9] linear_acceleration_covariance
{_HEADER}{_QUATERNION}{_VECTOR}""",
    TEMPERATURE: f"""std_msgs/Header header
float64 temperature
float64 variance
{_HEADER}""",
    JOINT_STATE: f"""std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
{_HEADER}""",
    QUATERNION_STAMPED: f"""std_msgs/Header header
geometry_msgs/Quaternion quaternion
{_HEADER}{_QUATERNION}""",
}
TOPICS = {
    IMU: "/imu/data",
    TEMPERATURE: "/imu/temperature",
    JOINT_STATE: "/table/joint_states",
    QUATERNION_STAMPED: "/table/attitude",
}
JOINT = "table"
# Vector of an Imu message: sensor, its unit, and one g or deg/s in that unit.
VECTORS = {
    "linear_acceleration": ("accelerometer", "m/s^2", STANDARD_GRAVITY),
    "angular_velocity": ("gyroscope", "rad/s", np.pi / 180.0),
}
CHANNEL_AT = 9  # byte offset of the channel's number in a record


def _count(value: int) -> bytes:
    return struct.pack("<I", value)


def _text(value: str) -> bytes:
    encoded = value.encode() + b"\0"
    return _count(len(encoded)) + encoded


def as_messages(time_ns: Integers, frame: str, *parts: bytes | Values) -> NDArray[np.uint8]:
    """Return CDR messages with a header at (n,) times, as rows of bytes; ``parts``: constants and (n, k) numbers."""
    constant = (len(time_ns), 1)
    stamps = np.stack([time_ns // SECOND_NS, time_ns % SECOND_NS], axis=1).astype("<u4").view(np.uint8)
    columns = [np.tile(np.frombuffer(LITTLE_ENDIAN, np.uint8), constant), stamps]
    size = stamps.shape[1]  # after the encapsulation, from which alignment counts
    for part in (_text(frame), *parts):
        fixed = isinstance(part, bytes)
        data = np.frombuffer(part, np.uint8) if fixed else np.ascontiguousarray(part, "<f8").view(np.uint8)
        gap = -size % (4 if fixed else 8)
        columns += [np.zeros((len(time_ns), gap), np.uint8), np.tile(data, constant) if fixed else data]
        size += gap + data.shape[-1]
    return np.hstack(columns)


def write_mcap(path: Path, recording: Recording) -> None:
    """Write a recording as ROS 2 messages; the file is replaced atomically."""
    time = recording.time_ns
    if len(time) and not (time.min() >= 0 and time.max() < 2**31 * SECOND_NS):
        raise InputError("times of a ROS 2 stamp lie between 0 and 2^31 s", str(path))
    streams = _streams(recording)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    with temporary.open("wb") as stream:
        writer = Writer(stream, enable_data_crcs=True)
        writer.start(profile="ros2", library="imu-calibration")
        channels = []
        for kind in streams:
            schema = writer.register_schema(kind, SchemaEncoding.ROS2, DEFINITIONS[kind].encode())
            channels.append(writer.register_channel(TOPICS[kind], MessageEncoding.CDR, schema))
        for row, stamp in enumerate(time.tolist()):
            for channel, messages in zip(channels, streams.values(), strict=True):
                writer.add_message(channel, stamp, messages[row].tobytes(), stamp, row)
        writer.finish()  # type: ignore[no-untyped-call]
    temporary.replace(path)


def _streams(recording: Recording) -> dict[str, NDArray[np.uint8]]:
    """Return the messages of each type, as one row of bytes for each sample."""
    time = recording.time_ns
    readings = {s: r for s in SENSORS if (r := recording.reading(s)) is not None}
    streams = {IMU: imu_table(time, readings)}
    if recording.temperature is not None:
        numbers = np.stack([recording.temperature, np.zeros(len(time))], axis=1)
        streams[TEMPERATURE] = as_messages(time, "imu", numbers)
    joint = recording.table_angle, recording.table_rate  # position and velocity of the table's one joint; no effort
    if any(log is not None for log in joint):
        parts: list[bytes | Values] = [_count(1) + _text(JOINT)]
        for log in joint:
            parts += [_count(0)] if log is None else [_count(1), np.radians(log)[:, None]]
        streams[JOINT_STATE] = as_messages(time, "table", *parts, _count(0))
    if recording.table_attitude is not None:
        streams[QUATERNION_STAMPED] = as_messages(time, "level", recording.table_attitude[:, [1, 2, 3, 0]])
    return streams


def imu_table(time_ns: Integers, readings: Readings, covariances: Readings | None = None) -> NDArray[np.uint8]:
    """Return Imu messages with (n,) times and (n, 3) readings in g and deg/s, as rows of bytes.

    Orientation, angular rate and acceleration each have a covariance. Its first element is -1 for an absent quantity;
    an unknown covariance is zeros. ``covariances``: sensor to (3, 3), g^2 or (deg/s)^2.
    """
    numbers = np.zeros((len(time_ns), 37))
    numbers[:, 3] = 1.0  # the identity
    numbers[:, [4, 16, 28]] = -1.0
    found = _in_ros_units(readings, covariances or {})
    for vector, start in (("angular_velocity", 13), ("linear_acceleration", 25)):
        if f"{vector}.x" in found:
            numbers[:, start : start + 3] = np.stack([found[f"{vector}.{a}"] for a in "xyz"], axis=1)
            numbers[:, start + 3 : start + 12] = found.get(f"{vector}_covariance", 0.0)
    return as_messages(time_ns, "imu", numbers)


def replaced(
    rows: ChannelMessages,
    groups: Sequence[tuple[Index, MessageLayout]],
    truths: Readings,
    channel: int,
    covariances: Readings,
) -> NDArray[np.uint8] | list[bytes]:
    """Return copies of Imu messages, as whole records, with calibrated readings.

    ``groups``: indices and layout of the messages of each layout; ``truths``: sensor to (n, 3) calibrated readings, g
    or deg/s; ``channel``: number of the copies' channel; ``covariances``: sensor to the covariance of a sample, (3, 3),
    g^2 or (deg/s)^2; without one, the covariance in the message is not changed.
    """
    numbers = _in_ros_units(truths, covariances)
    copies: dict[int, bytes] = {}
    for own, layout in groups:
        table = _all_at_once(rows.select(own), layout, {path: column[own] for path, column in numbers.items()}, channel)
        if len(groups) == 1:
            return table
        copies |= {row: copy.tobytes() for row, copy in zip(own.tolist(), table, strict=True)}
    return [copies[row] for row in sorted(copies)]


def _in_ros_units(readings: Readings, covariances: Readings) -> dict[str, Values]:
    """Return the numbers of Imu messages: path to column, (n,) or (n, 9), m/s^2 and rad/s."""
    found: dict[str, Values] = {}
    for vector, (sensor, _unit, one) in VECTORS.items():
        if sensor in readings:
            found |= {f"{vector}.{a}": readings[sensor][:, i] * one for i, a in enumerate("xyz")}
            if sensor in covariances:
                covariance = (covariances[sensor] * one**2).ravel()
                found[f"{vector}_covariance"] = np.broadcast_to(covariance, (len(readings[sensor]), 9))
    return found


def _all_at_once(
    rows: ChannelMessages, layout: MessageLayout, numbers: dict[str, Values], channel: int
) -> NDArray[np.uint8]:
    """Copy all records of one layout, and replace their numbers."""
    size = HEAD.itemsize + len(layout.sample)
    places = {path: layout.places[path] for path in numbers}
    items = np.dtype(
        {
            "names": ["channel", *places],
            "formats": ["<u2", *(p.code if p.count is None else (p.code, p.count) for p in places.values())],
            "offsets": [CHANNEL_AT, *(HEAD.itemsize + p.offset for p in places.values())],
            "itemsize": size,
        }
    )
    starts = rows.starts - HEAD.itemsize
    if rows.stride:
        whole = np.ndarray(len(starts), f"V{size}", rows.data.data, int(starts[0]), (rows.stride,)).copy()
    else:
        whole = np.ndarray(len(rows.data) - size + 1, f"V{size}", rows.data.data, 0, (1,))[starts]
    records = whole.view(items)
    records["channel"] = channel
    for path, column in numbers.items():
        records[path] = column
    return whole.view(np.uint8).reshape(len(starts), size)


def new_imu(
    rows: ChannelMessages, truths: Readings, channel: int, time_ns: Integers, covariances: Readings
) -> NDArray[np.uint8]:
    """Return records of new ROS 2 Imu messages, with the log times and sequence numbers of the original records."""
    messages = imu_table(time_ns, truths, covariances)
    count, size = messages.shape
    heads = np.zeros(count, HEAD)
    for name in ("sequence", "log_time", "publish_time"):
        heads[name] = rows.heads[name]
    heads["opcode"], heads["channel"], heads["length"] = Opcode.MESSAGE, channel, MESSAGE_HEAD + size
    table = np.empty((count, HEAD.itemsize + size), np.uint8)
    table[:, : HEAD.itemsize] = heads.view(np.uint8).reshape(count, HEAD.itemsize)
    table[:, HEAD.itemsize :] = messages
    return table
