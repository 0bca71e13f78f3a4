"""Logs of other formats, written by the formats' own libraries (ULog: by its specification) from arrays."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
from pymavlink.DFReader import DFFormat, DFReader_binary
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore
from scipy.io import savemat

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

GRAVITY = 9.80665
STORES = {".bag": get_typestore(Stores.ROS1_NOETIC), ".db3": get_typestore(Stores.ROS2_HUMBLE)}


class Truth:
    """A recording at 100 Hz in m/s^2, rad/s and us; numbers that single precision holds exactly."""

    def __init__(self, samples: int = 300, seed: int = 3) -> None:
        generator = np.random.default_rng(seed)
        self.time_us = 2_000_000 + 10_000 * np.arange(samples, dtype=np.int64)
        turn = np.pi / 2 * np.clip(np.linspace(-1.0, 2.0, samples), 0.0, 1.0)  # a rest, a quarter turn about x, a rest
        force = GRAVITY * np.stack([0 * turn, np.sin(turn), np.cos(turn)], axis=1)
        self.force = np.float32(force + 0.01 * generator.normal(size=(samples, 3))).astype(np.float64)
        rate = np.stack([np.gradient(turn) * 100.0, 0 * turn, 0 * turn], axis=1)
        self.rate = np.float32(rate + 0.001 * generator.normal(size=(samples, 3))).astype(np.float64)
        self.warmth = np.float32(25 + 0.1 * generator.normal(size=samples)).astype(np.float64)


def write_bag(path: Path, truth: Truth, topics: tuple[str, ...] = ("/imu",)) -> Path:
    """Write a ROS 1 bag, or the SQLite file of a ROS 2 bag, whose definitions are left out as before Iron."""
    store, kind = STORES[path.suffix], "sensor_msgs/msg/Imu"
    types, ros1 = store.types, path.suffix == ".bag"
    vector = types["geometry_msgs/msg/Vector3"]
    made: Any = rosbag1.Writer(path) if ros1 else rosbag2.Writer(path.with_suffix(""), version=8)
    with made as bag:
        connections = [bag.add_connection(t, kind, typestore=store) for t in topics]
        for i, us in enumerate(truth.time_us.tolist()):
            stamp = types["builtin_interfaces/msg/Time"](sec=us // 10**6, nanosec=us % 10**6 * 1000)
            extra = {"seq": i} if ros1 else {}
            message = types[kind](
                header=types["std_msgs/msg/Header"](stamp=stamp, frame_id="imu", **extra),
                orientation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
                orientation_covariance=np.zeros(9),
                angular_velocity=vector(*truth.rate[i].tolist()),
                angular_velocity_covariance=np.zeros(9),
                linear_acceleration=vector(*truth.force[i].tolist()),
                linear_acceleration_covariance=np.zeros(9),
            )
            data = (store.serialize_ros1 if ros1 else store.serialize_cdr)(message, kind)
            for connection in connections:
                bag.write(connection, us * 1000 + 5, data)
    if not ros1:
        next(path.with_suffix("").glob("*.db3")).rename(path)
    return path


def _record(kind: str, content: bytes) -> bytes:
    return struct.pack("<HB", len(content), ord(kind)) + content


ULOG_HEAD = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0) + _record("B", bytes(40))


def write_ulog(path: Path, truth: Truth, instances: int = 1) -> Path:
    """Write a ULog by its specification (docs.px4.io, ULog File Format): magic, formats, subscriptions, data."""
    out = [
        ULOG_HEAD,
        _record("F", b"sensor_combined:uint64_t timestamp;float[3] gyro_rad;float[3] accelerometer_m_s2;"),
    ]
    out += [_record("A", struct.pack("<BH", i, i) + b"sensor_combined") for i in range(instances)]
    for us, rate, force in zip(truth.time_us.tolist(), truth.rate, truth.force, strict=True):
        for i in range(instances):
            out.append(_record("D", struct.pack("<HQ6f", i, us, *rate, *(force + i))))
    path.write_bytes(b"".join(out))
    return path


def write_raw_ulog(path: Path, truth: Truth, messages: dict[str, tuple[str, NDArray[Any]]], instance: int) -> Path:
    """Write messages of one instance with the times of a recording: name to (fields, (n, 3) readings), at 25 degC."""
    out = [ULOG_HEAD, *(_record("F", f"{name}:{fields}".encode()) for name, (fields, _) in messages.items())]
    out += [_record("A", struct.pack("<BH", instance, i) + name.encode()) for i, name in enumerate(messages)]
    for k, us in enumerate(truth.time_us.tolist()):
        for i, (_, readings) in enumerate(messages.values()):
            out.append(_record("D", struct.pack("<HQQ4f", i, us + 7, us, *readings[k], 25.0)))
    path.write_bytes(b"".join(out))
    return path


def write_dataflash(path: Path, truth: Truth, warmth: str = "f") -> Path:
    """Write a DataFlash log with the formats, units and multipliers that ArduPilot 4 writes, by pymavlink.

    It has two sensors. ``warmth``: format of the temperature; ``c``: in whole hundredths.
    """
    log = DFReader_binary.__new__(DFReader_binary)
    log.formats = {0x80: DFFormat(0x80, "FMT", 89, "BBnNZ", "Type,Length,Name,Format,Columns")}
    columns = "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz"
    known = {
        "UNIT": DFFormat(177, "UNIT", 0, "QbZ", "TimeUS,Id,Label"),
        "MULT": DFFormat(178, "MULT", 0, "Qbd", "TimeUS,Id,Mult"),
        "FMTU": DFFormat(179, "FMTU", 0, "QBNN", "TimeUS,FmtType,UnitIds,MultIds"),
        "IMU": DFFormat(180, "IMU", 0, f"QBffffffII{warmth}BBHH", columns),
    }
    out = [log.make_format_msgbuf(log.formats[0x80]), *(log.make_format_msgbuf(f) for f in known.values())]
    for letter, label in {"s": b"s", "#": b"instance", "E": b"rad/s", "o": b"m/s/s", "O": b"degC", "z": b"Hz"}.items():
        out.append(log.make_msgbuf(known["UNIT"], [0, ord(letter), label]))
    out += [log.make_msgbuf(known["MULT"], [0, ord("F"), 1e-6]), log.make_msgbuf(known["MULT"], [0, ord("0"), 1.0])]
    out.append(log.make_msgbuf(known["FMTU"], [0, 180, b"s#EEEooo--O--zz", b"F-000000-00--00"[:15]]))
    for us, rate, force, warm in zip(truth.time_us.tolist(), truth.rate, truth.force, truth.warmth, strict=True):
        for i in range(2):
            stored = round(100 * warm) if warmth == "c" else warm
            values = [us, i, *rate, *(force + i), 0, 0, stored, 1, 1, 1000, 1000]
            out.append(log.make_msgbuf(known["IMU"], values))
    path.write_bytes(b"".join(out))
    return path


def write_arrays(path: Path, truth: Truth, units: tuple[str, str] = ("m/s^2", "rad/s")) -> Path:
    """Write an HDF5 file, or a MATLAB file of version 5 (``.mat``), with t, acc and gyr in the group imu."""
    arrays: dict[str, NDArray[Any]] = {"t": truth.time_us / 1e6, "acc": truth.force, "gyr": truth.rate}
    if path.suffix == ".mat":
        savemat(path, {"imu": arrays, "fs": 100.0})
        return path
    with h5py.File(path, "w") as file:
        group = file.create_group("imu")
        for name, array in arrays.items():
            group[name] = array
        group["acc"].attrs["units"], group["gyr"].attrs["units"] = units
        file["fs"] = 100.0
    return path


def write_matlab73(path: Path, truth: Truth) -> Path:
    """Write an HDF5 file as MATLAB 7.3 does: a text of 512 bytes first, arrays transposed."""
    with h5py.File(path, "w", userblock_size=512) as file:
        group = file.create_group("imu")
        for name, array in {"t": (truth.time_us / 1e6)[None], "acc": truth.force.T, "gyr": truth.rate.T}.items():
            group[name] = array
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512))
    return path
