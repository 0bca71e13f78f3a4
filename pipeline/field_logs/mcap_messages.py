"""Imu messages with calibrated readings, as the records of an MCAP file."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

import numpy as np
from mcap.opcode import Opcode

from pipeline.io.mcap_channels import VECTORS
from pipeline.io.mcap_chunk import HEAD, MESSAGE_HEAD
from pipeline.io.ros2_messages import imu_table
from pipeline.io.units import STANDARD_GRAVITY, TRIADS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from pipeline.io.mcap_chunk import Rows
    from pipeline.io.message_decoder import ChannelDecoder
    from pipeline.io.message_layout import MessageLayout

    Truths = dict[str, NDArray[np.float64]]

CHANNEL_AT = 9  # byte of a record where the channel's number stands
SENSOR_OF = {channels: sensor for sensor, channels in TRIADS.items()}


def replaced(
    rows: Rows, decoder: ChannelDecoder, truths: Truths, channel: int, covariances: Mapping[str, NDArray[np.float64]]
) -> NDArray[np.uint8] | list[bytes]:
    """Return copies of Imu messages, whole records, in which the readings of some sensors are replaced.

    ``decoder`` has read the messages last; ``truths`` are (n, 3) calibrated readings, g or deg/s; ``channel`` is the
    number of the channel of the copies; ``covariances`` are those of a sample, (3, 3), g^2 or (deg/s)^2, of some
    sensors: where there is none, that of the message stays.
    """
    numbers = _numbers(truths, covariances)
    if decoder.layout is not None:
        return _all_at_once(rows, decoder.layout, numbers, channel)
    return [_one(row, rows, decoder.layout_of(row, rows), numbers, channel) for row in range(len(rows.starts))]


def _in_ros_units(sensor: str, covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a covariance in g^2 or (deg/s)^2 in (m/s^2)^2 or (rad/s)^2."""
    return covariance * (STANDARD_GRAVITY if sensor == "accelerometer" else np.pi / 180.0) ** 2


def _numbers(truths: Truths, covariances: Mapping[str, NDArray[np.float64]]) -> dict[str, NDArray[np.float64]]:
    """Return the numbers of Imu messages: path to column, (n,) or (n, 9), m/s^2 and rad/s."""
    found: dict[str, NDArray[np.float64]] = {}
    for vector, (channels, _unit) in VECTORS.items():
        sensor = SENSOR_OF[channels]
        if sensor in truths:
            values = truths[sensor]
            scaled = values * STANDARD_GRAVITY if sensor == "accelerometer" else np.radians(values)
            found |= {f"{vector}.{a}": scaled[:, i] for i, a in enumerate("xyz")}
            if sensor in covariances:
                covariance = _in_ros_units(sensor, covariances[sensor]).ravel()
                found[f"{vector}_covariance"] = np.broadcast_to(covariance, (len(values), 9))
    return found


def _all_at_once(
    rows: Rows, layout: MessageLayout, numbers: dict[str, NDArray[np.float64]], channel: int
) -> NDArray[np.uint8]:
    """Copy all records at once, and replace their numbers."""
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


def _one(row: int, rows: Rows, layout: MessageLayout, numbers: dict[str, NDArray[np.float64]], channel: int) -> bytes:
    """Copy one record, and replace its numbers."""
    start, end = int(rows.starts[row]) - HEAD.itemsize, int(rows.starts[row] + rows.sizes[row])
    record = bytearray(rows.data[start:end].tobytes())
    struct.pack_into("<H", record, CHANNEL_AT, channel)
    for path, column in numbers.items():
        place = layout.places[path]
        at = HEAD.itemsize + place.offset
        number = np.array([column[row]], place.code).tobytes()
        record[at : at + len(number)] = number
    return bytes(record)


def new_imu(
    rows: Rows,
    truths: Truths,
    channel: int,
    time_ns: NDArray[np.int64],
    covariances: Mapping[str, NDArray[np.float64]],
) -> NDArray[np.uint8]:
    """Return records of new ROS 2 Imu messages with the times and numbers of the originals' records."""
    scaled = {s: _in_ros_units(s, c) for s, c in covariances.items()}
    messages = imu_table(time_ns, truths.get("accelerometer"), truths.get("gyroscope"), scaled)
    count, size = messages.shape
    heads = np.zeros(count, HEAD)
    for name in ("sequence", "log_time", "publish_time"):
        heads[name] = rows.heads[name]
    heads["opcode"], heads["channel"], heads["length"] = Opcode.MESSAGE, channel, MESSAGE_HEAD + size
    table = np.empty((count, HEAD.itemsize + size), np.uint8)
    table[:, : HEAD.itemsize] = heads.view(np.uint8).reshape(count, HEAD.itemsize)
    table[:, HEAD.itemsize :] = messages
    return table
