"""A unit on its way to be corrupted: its files as tables, the truth behind them, and how they are written.

A table maps the columns of the canonical CSV to their values. The writers are not the product's: text by numpy, MCAP by
the library ``mcap`` with messages packed here.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import Writer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

Table = dict[str, np.ndarray]
ACCELEROMETER = ["accel_x_g", "accel_y_g", "accel_z_g"]
GYROSCOPE = ["gyro_x_dps", "gyro_y_dps", "gyro_z_dps"]
COLUMNS = {"accelerometer": ACCELEROMETER, "gyroscope": GYROSCOPE}
ANGLE, RATE, TEMPERATURE, TIME = "table_angle_deg", "table_rate_dps", "temperature_degc", "time_s"
ATTITUDE = ["table_qw", "table_qx", "table_qy", "table_qz"]
TURNS = ["accel_x", "accel_y", "accel_z", "gyro_x", "gyro_y", "gyro_z"]
STANDARD_GRAVITY = 9.80665


@dataclass
class Truth:
    """What a perfect calibration of the readings in the files is: body = matrix @ (reading - bias)."""

    bias: np.ndarray
    matrix: np.ndarray
    hidden: tuple[str, ...] = ()  # effects in the good recordings that the configuration does not hold


@dataclass
class Copy:
    """A unit: good at first, then corrupted in one or two ways.

    Attributes
    ----------
    causes : set of str
        Effects of which one may truthfully be named as the cause of what was changed.
    unseen : str
        Why no logged channel reveals the change; empty where one does.
    harmless : bool
        Whether the change leaves all results right, so that a refusal would be needless.
    leaked : bool
        Whether the held-out motion shares samples with a fit.
    said : dict
        What was drawn at random, for the report.
    """

    name: str
    base: str
    model: str
    format: str
    interval_s: float
    tables: dict[str, Table]
    truth: dict[str, Truth]
    of_other: Callable[[], Copy] | None = None  # makes another unit of the model, like this one
    rng: np.random.Generator = field(default_factory=np.random.default_rng)
    row: dict[str, str] = field(default_factory=dict)
    overrides: list[str] = field(default_factory=list)
    causes: set[str] = field(default_factory=set)
    unseen: str = ""
    harmless: bool = False
    leaked: bool = False
    log_stamps: dict[str, float] = field(default_factory=dict)  # MCAP: seconds added to the stamps of a kind of message
    said: dict[str, Any] = field(default_factory=dict)
    way: str = ""
    kind: str = ""

    @cached_property
    def other(self) -> Copy:
        """The other unit, simulated where a way takes something from it."""
        assert self.of_other is not None
        return self.of_other()

    def recordings(self, scope: str) -> list[str]:
        """Return the names of the recordings that a scope means; a random one is drawn."""
        turns = [n for n in self.tables if n not in ("validation", "static")]
        if scope in ("all", "turns"):
            return list(self.tables) if scope == "all" else turns
        if scope in ("accelerometer", "gyroscope"):
            return [n for n in turns if n.startswith(scope[:4]) or n == "recording"]
        if scope == "one":
            found = str(self.rng.choice(turns))
        elif scope in ("one_accelerometer", "one_gyroscope"):
            found = str(self.rng.choice(self.recordings(scope[4:])))
        else:
            found = scope
        self.said["recording"] = found
        if found not in self.tables:
            raise NotApplicableError(f"{self.base} has no {found}")
        return [found]

    def map_readings(self, scope: str, sensor: str, A: np.ndarray) -> None:
        """Replace readings by A @ reading; in all files the truth is that of the new readings."""
        for name in self.recordings(scope):
            put(self.tables[name], COLUMNS[sensor], values(self.tables[name], COLUMNS[sensor]) @ np.asarray(A).T)
        if scope == "all":
            before = self.truth[sensor]
            self.truth[sensor] = Truth(A @ before.bias, before.matrix @ np.linalg.inv(A), before.hidden)

    def body(self, name: str, sensor: str) -> np.ndarray:
        """Return what a recording's readings show of the motion: (n, 3) array, with the sensor's noise."""
        truth = self.truth[sensor]
        return (values(self.tables[name], COLUMNS[sensor]) - truth.bias) @ truth.matrix.T


class NotApplicableError(Exception):
    """A way needs what the good unit does not have."""


def values(table: Table, columns: Iterable[str]) -> np.ndarray:
    """Return columns side by side."""
    missing = [c for c in columns if c not in table]
    if missing:
        raise NotApplicableError(f"no column {missing[0]}")
    return np.stack([table[c] for c in columns], axis=1)


def put(table: Table, columns: Iterable[str], new: np.ndarray) -> None:
    """Set columns."""
    for column, each in zip(columns, np.asarray(new, float).T, strict=True):
        table[column] = each


def rows_of(table: Table, chosen: np.ndarray) -> Table:
    """Return the chosen rows (indices or a mask)."""
    return {c: v[chosen] for c, v in table.items()}


def table_of(recording: Any) -> Table:
    """Return a recording of the simulator as a table."""
    out: Table = {TIME: recording.time_ns * 1e-9}
    for columns, readings in ((ACCELEROMETER, recording.accelerometer), (GYROSCOPE, recording.gyroscope)):
        if readings is not None:
            put(out, columns, readings)
    for column, given, decimals in (
        (TEMPERATURE, recording.temperature, 3),
        (ANGLE, recording.table_angle, 6),
        (RATE, recording.table_rate, 6),
    ):
        if given is not None:
            out[column] = np.round(given, decimals)
    if recording.table_attitude is not None:
        put(out, ATTITUDE, np.round(recording.table_attitude, 9))
    return out


def write(copy: Copy, folder: Path) -> None:
    """Write the recordings of a unit."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, table in copy.tables.items():
        if copy.format == "mcap":
            _write_mcap(folder / f"{name}.mcap", table, copy.log_stamps)
        else:
            _write_csv(folder / f"{name}.csv", table)


def _write_csv(path: Path, table: Table) -> None:
    formats = ["%.15g" if column == TIME else "%.10g" for column in table]
    matrix = np.stack(list(table.values()), axis=1)
    with path.open("w", encoding="utf-8") as stream:
        stream.write(",".join(table) + "\n")
        row = ",".join(formats) + "\n"
        stream.writelines(row % tuple(line) for line in matrix.tolist())


_HEADER = """std_msgs/Header header
"""
_COMMON = """================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
_QUATERNION = """================================================================================
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
"""
_VECTOR = """================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
"""
SCHEMAS = {
    "sensor_msgs/msg/Imu": _HEADER
    + """geometry_msgs/Quaternion orientation
float64[9] orientation_covariance
geometry_msgs/Vector3 angular_velocity
float64[9] angular_velocity_covariance
geometry_msgs/Vector3 linear_acceleration
float64[9] linear_acceleration_covariance
"""
    + _COMMON
    + _QUATERNION
    + _VECTOR,
    "sensor_msgs/msg/Temperature": _HEADER + "float64 temperature\nfloat64 variance\n" + _COMMON,
    "sensor_msgs/msg/JointState": _HEADER
    + "string[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n"
    + _COMMON,
    "geometry_msgs/msg/QuaternionStamped": _HEADER + "geometry_msgs/Quaternion quaternion\n" + _COMMON + _QUATERNION,
}
_HEAD = "<4siII4s"  # encapsulation, stamp, frame id "imu"
PACKED = {
    "sensor_msgs/msg/Imu": struct.Struct(_HEAD + "37d"),
    "sensor_msgs/msg/Temperature": struct.Struct(_HEAD + "2d"),
    "geometry_msgs/msg/QuaternionStamped": struct.Struct(_HEAD + "4d"),
}


def _write_mcap(path: Path, table: Table, shifted: dict[str, float]) -> None:
    streams = _messages(table)
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library="tests")
        items = []
        for kind, (packed, rows) in streams.items():
            schema = writer.register_schema(kind, SchemaEncoding.ROS2, SCHEMAS[kind].encode())
            topic = "/" + kind.rpartition("/")[2].lower()
            channel = writer.register_channel(topic, MessageEncoding.CDR, schema)
            times = np.round((table[TIME] + shifted.get(kind, 0.0)) * 1e9).astype(np.int64).tolist()
            stamps = np.round(table[TIME] * 1e9).astype(np.int64).tolist()
            for time, log, numbers in zip(times, stamps, rows, strict=True):
                head = (b"\x00\x01\x00\x00", time // 10**9, time % 10**9, 4, b"imu\0")
                items.append((log, channel, time, packed(head, numbers)))
        for sequence, (log, channel, time, data) in enumerate(sorted(items, key=lambda item: item[0])):
            writer.add_message(channel, max(log, 0), data, max(time, 0), sequence)
        writer.finish()


def _messages(table: Table) -> dict[str, tuple[Any, list[Any]]]:
    """Return how each kind of message is packed, and the numbers of each row."""
    n = len(table[TIME])
    imu = np.zeros((n, 37))
    imu[:, 3], imu[:, 4] = 1.0, -1.0  # no orientation
    imu[:, 13:16] = np.radians(values(table, GYROSCOPE))
    imu[:, 25:28] = values(table, ACCELEROMETER) * STANDARD_GRAVITY
    found = {"sensor_msgs/msg/Imu": imu}
    if TEMPERATURE in table:
        found["sensor_msgs/msg/Temperature"] = np.stack([table[TEMPERATURE], np.zeros(n)], axis=1)
    if ATTITUDE[0] in table:
        found["geometry_msgs/msg/QuaternionStamped"] = values(table, [*ATTITUDE[1:], ATTITUDE[0]])
    packers = {kind: _plain(PACKED[kind]) for kind in found}
    if ANGLE in table or RATE in table:
        found["sensor_msgs/msg/JointState"] = np.radians(values(table, [c for c in (ANGLE, RATE) if c in table]))
        packers["sensor_msgs/msg/JointState"] = _joint(ANGLE in table, RATE in table)
    return {kind: (packers[kind], rows.tolist()) for kind, rows in found.items()}


def _plain(packing: struct.Struct) -> Any:
    return lambda head, numbers: packing.pack(*head, *numbers)


def _joint(*present: bool) -> Any:
    """Return what packs a joint's message: its name, then position and velocity, each a list of one number or none."""
    if all(present):
        both = struct.Struct(_HEAD + "II6s2xI4xdI4xdI")
        return lambda head, n: both.pack(*head, 1, 6, b"table\0", 1, n[0], 1, n[1], 0)
    if present[0]:
        angle = struct.Struct(_HEAD + "II6s2xI4xdII")
        return lambda head, n: angle.pack(*head, 1, 6, b"table\0", 1, n[0], 0, 0)
    rate = struct.Struct(_HEAD + "II6s2xIIdI")
    return lambda head, n: rate.pack(*head, 1, 6, b"table\0", 0, 1, n[0], 0)
