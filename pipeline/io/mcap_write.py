"""Recordings to MCAP files of ROS 2 messages, as a recorder writes them: zstd chunks under checksums.

    linear_acceleration [m/s^2] = specific force [g] * 9.80665
    angular_velocity [rad/s]    = angular rate [deg/s] * pi/180

Headers carry the sample times. All messages of a topic have one length, so that a table of bytes is filled column by
column and cut into messages.
"""

from __future__ import annotations

import os
import struct
from typing import TYPE_CHECKING

import numpy as np
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import Writer

from pipeline.errors import InputError
from pipeline.io.ros2 import DEFINITIONS, IMU, JOINT_STATE, QUATERNION_STAMPED, TEMPERATURE
from pipeline.io.units import STANDARD_GRAVITY

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from pipeline.records import Recording

TOPICS = {
    IMU: "/imu/data",
    TEMPERATURE: "/imu/temperature",
    JOINT_STATE: "/table/joint_states",
    QUATERNION_STAMPED: "/table/attitude",
}
JOINT = "table"
NANOSECONDS = 1_000_000_000


class _Template:
    """One message as CDR, with the places of its numbers."""

    def __init__(self, frame: str) -> None:
        self.data = bytearray(b"\x00\x01\x00\x00" + bytes(8))  # little endian; stamp
        self.places: list[int] = []
        self.text(frame)

    def align(self, size: int) -> None:
        self.data += bytes(-(len(self.data) - 4) % size)

    def count(self, value: int) -> None:
        self.align(4)
        self.data += struct.pack("<I", value)

    def text(self, value: str) -> None:
        encoded = value.encode() + b"\0"
        self.count(len(encoded))
        self.data += encoded

    def doubles(self, count: int) -> None:
        if count:
            self.align(8)
        for _ in range(count):
            self.places.append(len(self.data))
            self.data += bytes(8)

    def fill(self, time_ns: NDArray[np.int64], numbers: NDArray[np.float64]) -> list[bytes]:
        """Return a message for each time and row of numbers."""
        return [row.tobytes() for row in self.table(time_ns, numbers)]

    def table(self, time_ns: NDArray[np.int64], numbers: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Return the messages as rows of bytes."""
        table = np.tile(np.frombuffer(bytes(self.data), np.uint8), (len(time_ns), 1))
        stamps = np.stack([time_ns // NANOSECONDS, time_ns % NANOSECONDS], axis=1).astype("<u4")
        table[:, 4:12] = stamps.view(np.uint8)
        for column, place in enumerate(self.places):
            table[:, place : place + 8] = np.ascontiguousarray(numbers[:, column], "<f8").view(np.uint8).reshape(-1, 8)
        return table


def write_mcap(path: Path, recording: Recording) -> None:
    """Write a recording as ROS 2 messages; channels that it does not hold are left out.

    Parameters
    ----------
    path : Path
        Replaced at once, never half written.
    recording : Recording

    Raises
    ------
    InputError
        If a time is negative or later than a stamp can hold.
    """
    time = recording.time_ns
    if len(time) and not (time.min() >= 0 and time.max() < 2**31 * NANOSECONDS):
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
                writer.add_message(channel, stamp, messages[row], stamp, row)
        writer.finish()  # type: ignore[no-untyped-call]
    temporary.replace(path)


def _streams(recording: Recording) -> dict[str, list[bytes]]:
    """Return the messages of each type, one for each sample."""
    time = recording.time_ns
    streams = {IMU: _imu(recording)}
    if recording.temperature is not None:
        template = _Template("imu")
        template.doubles(2)
        numbers = np.stack([recording.temperature, np.zeros(len(time))], axis=1)
        streams[TEMPERATURE] = template.fill(time, numbers)
    if recording.table_angle is not None or recording.table_rate is not None:
        streams[JOINT_STATE] = _joint(recording)
    if recording.table_attitude is not None:
        template = _Template("level")
        template.doubles(4)
        streams[QUATERNION_STAMPED] = template.fill(time, recording.table_attitude[:, [1, 2, 3, 0]])
    return streams


def _imu(recording: Recording) -> list[bytes]:
    table = imu_table(recording.time_ns, recording.accelerometer, recording.gyroscope)
    return [row.tobytes() for row in table]


def imu_table(
    time_ns: NDArray[np.int64], accelerometer: NDArray[np.float64] | None, gyroscope: NDArray[np.float64] | None
) -> NDArray[np.uint8]:
    """Return Imu messages: orientation, angular rate, acceleration, each with nine numbers of covariance.

    Parameters
    ----------
    time_ns : (n,) array of int64, ns
    accelerometer : (n, 3) array, g, or None
    gyroscope : (n, 3) array, deg/s, or None

    Returns
    -------
    (n, size) array of uint8
    """
    numbers = np.zeros((len(time_ns), 37))
    numbers[:, 3] = 1.0  # identity, and absent:
    numbers[:, 4] = -1.0
    if gyroscope is None:
        numbers[:, 16] = -1.0
    else:
        numbers[:, 13:16] = np.radians(gyroscope)
    if accelerometer is None:
        numbers[:, 28] = -1.0
    else:
        numbers[:, 25:28] = accelerometer * STANDARD_GRAVITY
    template = _Template("imu")
    template.doubles(37)
    return template.table(time_ns, numbers)


def _joint(recording: Recording) -> list[bytes]:
    """Return JointState messages of the table's one joint."""
    template = _Template("table")
    template.count(1)
    template.text(JOINT)
    columns = []
    for values in (recording.table_angle, recording.table_rate):
        present = values is not None
        template.count(int(present))
        template.doubles(int(present))
        if values is not None:
            columns.append(np.radians(values))
    template.count(0)  # effort
    return template.fill(recording.time_ns, np.stack(columns, axis=1))
