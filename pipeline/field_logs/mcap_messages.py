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
    from numpy.typing import NDArray

    from pipeline.io.mcap_chunk import Rows
    from pipeline.io.message_decoder import ChannelDecoder
    from pipeline.io.message_layout import MessageLayout

    Truths = dict[str, NDArray[np.float64]]

CHANNEL_AT = 9  # byte of a record where the channel's number stands
SENSOR_OF = {channels: sensor for sensor, channels in TRIADS.items()}


def replaced(rows: Rows, decoder: ChannelDecoder, truths: Truths, channel: int) -> NDArray[np.uint8] | list[bytes]:
    """Return copies of Imu messages, whole records, in which the readings of some sensors are replaced.

    ``decoder`` has read the messages last; ``truths`` are (n, 3) calibrated readings, g or deg/s; ``channel`` is the
    number of the channel of the copies.
    """
    numbers = _numbers(truths)
    if decoder.layout is not None:
        return _all_at_once(rows, decoder.layout, numbers, channel)
    return [_one(row, rows, decoder.layout_of(row, rows), numbers, channel) for row in range(len(rows.starts))]


def _numbers(truths: Truths) -> dict[str, NDArray[np.float64]]:
    """Return the numbers of Imu messages: path to column, m/s^2 and rad/s."""
    found: dict[str, NDArray[np.float64]] = {}
    for vector, (channels, _unit) in VECTORS.items():
        sensor = SENSOR_OF[channels]
        if sensor in truths:
            values = truths[sensor]
            scaled = values * STANDARD_GRAVITY if sensor == "accelerometer" else np.radians(values)
            found |= {f"{vector}.{a}": scaled[:, i] for i, a in enumerate("xyz")}
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
            "formats": ["<u2", *(p.code for p in places.values())],
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


def new_imu(rows: Rows, truths: Truths, channel: int, time_ns: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Return records of new ROS 2 Imu messages with the times and numbers of the originals' records."""
    messages = imu_table(time_ns, truths.get("accelerometer"), truths.get("gyroscope"))
    count, size = messages.shape
    heads = np.zeros(count, HEAD)
    for name in ("sequence", "log_time", "publish_time"):
        heads[name] = rows.heads[name]
    heads["opcode"], heads["channel"], heads["length"] = Opcode.MESSAGE, channel, MESSAGE_HEAD + size
    table = np.empty((count, HEAD.itemsize + size), np.uint8)
    table[:, : HEAD.itemsize] = heads.view(np.uint8).reshape(count, HEAD.itemsize)
    table[:, HEAD.itemsize :] = messages
    return table
