"""A unit on its way to be corrupted: its files as tables, the truth behind them, and how they are written.

A table maps the columns of the canonical CSV to their values. The writers are not the product's: text by numpy, MCAP by
the libraries ``mcap`` and ``rosbags``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import Writer
from rosbags.typesys import Stores, get_typestore

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
    """A unit: good at first, then corrupted in one or two ways."""

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
    causes: set[str] = field(default_factory=set)  # effects that may truthfully be named for what was changed
    unseen: str = ""  # why no logged channel reveals the change; empty where one does
    harmless: bool = False  # whether the change leaves all results right, so that a refusal would be needless
    leaked: bool = False  # whether the held-out motion shares samples with a fit
    log_stamps: dict[str, float] = field(default_factory=dict)  # MCAP: seconds added to the stamps of a kind of message
    said: dict[str, Any] = field(default_factory=dict)  # what was drawn at random, for the report
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

    def chosen(self, scope: str) -> list[Table]:
        """Return the tables of the recordings that a scope means."""
        return [self.tables[name] for name in self.recordings(scope)]

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
    for column, each in zip(columns, np.asarray(new, float).T, strict=True):
        table[column] = each


def add(table: Table, sensor: str, change: np.ndarray) -> None:
    """Add to the readings of a sensor."""
    put(table, COLUMNS[sensor], values(table, COLUMNS[sensor]) + change)


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
    folder.mkdir(parents=True, exist_ok=True)
    for name, table in copy.tables.items():
        if copy.format == "mcap":
            _write_mcap(folder / f"{name}.mcap", table, copy.log_stamps)
        else:
            _write_csv(folder / f"{name}.csv", table)


def _write_csv(path: Path, table: Table) -> None:
    formats = ["%.15g" if column == TIME else "%.10g" for column in table]
    rows = np.stack(list(table.values()), axis=1)
    np.savetxt(path, rows, formats, delimiter=",", header=",".join(table), comments="")


STORE = get_typestore(Stores.ROS2_HUMBLE)


def _write_mcap(path: Path, table: Table, shifted: dict[str, float]) -> None:
    types = STORE.types
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library="tests")
        items = []
        for kind, contents in _messages(table).items():
            definition, _ = STORE.generate_msgdef(kind, ros_version=2)
            schema = writer.register_schema(kind, SchemaEncoding.ROS2, definition.encode())
            topic = "/" + kind.rpartition("/")[2].lower()
            channel = writer.register_channel(topic, MessageEncoding.CDR, schema)
            times = np.round((table[TIME] + shifted.get(kind, 0.0)) * 1e9).astype(np.int64).tolist()
            stamps = np.round(table[TIME] * 1e9).astype(np.int64).tolist()
            for time, log, content in zip(times, stamps, contents, strict=True):
                stamp = types["builtin_interfaces/msg/Time"](time // 10**9, time % 10**9)
                header = types["std_msgs/msg/Header"](stamp, "imu")
                message = types[kind](header=header, **content)
                items.append((log, channel, time, bytes(STORE.serialize_cdr(message, kind))))
        for sequence, (log, channel, time, data) in enumerate(sorted(items, key=lambda item: item[0])):
            writer.add_message(channel, max(log, 0), data, max(time, 0), sequence)
        writer.finish()


def _messages(table: Table) -> dict[str, list[dict[str, Any]]]:
    """Return the fields of each message but its header, by kind."""
    vector, quaternion = (STORE.types[f"geometry_msgs/msg/{kind}"] for kind in ("Vector3", "Quaternion"))
    same = {f"{name}_covariance": np.zeros(9) for name in ("angular_velocity", "linear_acceleration")}
    same |= {"orientation": quaternion(0.0, 0.0, 0.0, 1.0)}
    same |= {"orientation_covariance": np.repeat([-1.0, 0.0], [1, 8])}  # no orientation
    rates, forces = np.radians(values(table, GYROSCOPE)), values(table, ACCELEROMETER) * STANDARD_GRAVITY
    found: dict[str, list[dict[str, Any]]] = {
        "sensor_msgs/msg/Imu": [
            {"angular_velocity": vector(*rate), "linear_acceleration": vector(*force), **same}
            for rate, force in zip(rates.tolist(), forces.tolist(), strict=True)
        ]
    }
    if TEMPERATURE in table:
        temperatures = table[TEMPERATURE].tolist()
        found["sensor_msgs/msg/Temperature"] = [{"temperature": t, "variance": 0.0} for t in temperatures]
    if ATTITUDE[0] in table:
        rows = values(table, [*ATTITUDE[1:], ATTITUDE[0]]).tolist()
        found["geometry_msgs/msg/QuaternionStamped"] = [{"quaternion": quaternion(*row)} for row in rows]
    if ANGLE in table or RATE in table:
        none = np.zeros((len(table[TIME]), 0))
        joint = [np.radians(table[c])[:, None] if c in table else none for c in (ANGLE, RATE)]
        found["sensor_msgs/msg/JointState"] = [
            {"name": ["table"], "position": position, "velocity": velocity, "effort": np.zeros(0)}
            for position, velocity in zip(*joint, strict=True)
        ]
    return found
