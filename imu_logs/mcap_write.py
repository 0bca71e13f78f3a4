"""Write the ROS 2 messages of a calibration log: recordings as MCAP files, and calibrated Imu messages.

    linear_acceleration [m/s^2] = specific force [g] * 9.80665
    angular_velocity [rad/s]    = angular rate [deg/s] * pi/180

All messages of a topic have one length: they are the rows of a table of bytes, which is filled column by column.

Copy an MCAP file, every record of its data section byte for byte, and add messages.

Chunks are not decompressed. Added messages are written in separate chunks, each after the chunk to which it belongs.
Messages outside chunks are written into a chunk, because readers that use the file's index read chunks only. The
summary is computed again, because the records have new offsets.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Protocol

import mcap.records as mcap
import numpy as np
from mcap.opcode import Opcode
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import Writer
from numpy.typing import NDArray

from imu_logs.errors import InputError
from imu_logs.files import replacing
from imu_logs.log import Index, Integers, Log, Values
from imu_logs.mcap_file import (
    HEAD,
    MAGIC,
    MESSAGE_HEAD,
    RECORD_HEAD,
    ChannelMessages,
    Run,
    attachment,
    bytes_of,
    parsed,
)
from imu_logs.message_layout import LITTLE_ENDIAN, MessageLayout
from imu_logs.units import ATTITUDE, SECOND_NS, STANDARD_GRAVITY, TRIADS

Readings = Mapping[str, Values]  # sensor to (n, 3) readings, or to the (3, 3) covariance of a sample

MESSAGES = Path(__file__).parent / "messages"
IMU = "sensor_msgs/msg/Imu"
TEMPERATURE = "sensor_msgs/msg/Temperature"
JOINT_STATE = "sensor_msgs/msg/JointState"
QUATERNION_STAMPED = "geometry_msgs/msg/QuaternionStamped"

TOPICS = {
    IMU: "/imu/data",
    TEMPERATURE: "/imu/temperature",
    JOINT_STATE: "/table/joint_states",
    QUATERNION_STAMPED: "/table/attitude",
}
# Of each type, with those of the types in it.
DEFINITIONS = {kind: (MESSAGES / f"{kind.rpartition('/')[2]}.msg").read_text("utf-8") for kind in TOPICS}
JOINT = "table"
# Vector of an Imu message: sensor, its unit, and one g or deg/s in that unit.
VECTORS = {
    "linear_acceleration": ("accelerometer", "m/s^2", STANDARD_GRAVITY),
    "angular_velocity": ("gyroscope", "rad/s", np.pi / 180.0),
}
CHANNEL_AT = 9  # byte offset of the channel's number in a record
ZSTD_LEVEL = -3  # twice as fast as 1 on calibrated messages, and as small as the recorders' 3: benchmarks/apply.py


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


def write_mcap(path: Path, log: Log) -> None:
    """Write a log as ROS 2 messages; the file is replaced atomically."""
    time = log.time_ns
    if len(time) and not (time.min() >= 0 and time.max() < 2**31 * SECOND_NS):
        raise InputError("times of a ROS 2 stamp lie between 0 and 2^31 s", str(path))
    streams = _streams(log)
    with replacing(path) as new, new.open("wb") as stream:
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


def _streams(log: Log) -> dict[str, NDArray[np.uint8]]:
    """Return the messages of each type, as one row of bytes for each sample."""
    time, values = log.time_ns, log.values
    readings = {s: np.column_stack([values[c] for c in t]) for s, t in TRIADS.items() if t[0] in values}
    streams = {IMU: imu_table(time, readings)}
    if "temperature" in values:
        numbers = np.stack([values["temperature"], np.zeros(len(time))], axis=1)
        streams[TEMPERATURE] = as_messages(time, "imu", numbers)
    # position and velocity of the table's one joint; no effort
    joint = values.get("table_angle"), values.get("table_rate")
    if any(logged is not None for logged in joint):
        parts: list[bytes | Values] = [_count(1) + _text(JOINT)]
        for logged in joint:
            parts += [_count(0)] if logged is None else [_count(1), np.radians(logged)[:, None]]
        streams[JOINT_STATE] = as_messages(time, "table", *parts, _count(0))
    if ATTITUDE[0] in values:
        attitude = np.column_stack([values[f"table_q{c}"] for c in "xyzw"])
        streams[QUATERNION_STAMPED] = as_messages(time, "level", attitude)
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


class _Sink(Protocol):
    def write(self, data: bytes, /) -> object: ...


class McapCopy:
    """The file that is written, in order, to ``out``."""

    def __init__(self, out: _Sink) -> None:
        self.out = out
        self.position = self.crc = 0
        self.compression = ""  # of the last chunk
        self.counts: Counter[int] = Counter()
        self.times: list[int] = []  # the first and the last
        self.chunks: list[mcap.ChunkIndex] = []
        self.attachments: list[mcap.AttachmentIndex] = []
        self.metadata: list[mcap.MetadataIndex] = []
        self._write(MAGIC)

    def _write(self, *parts: bytes) -> None:
        for part in parts:
            self.out.write(part)
            self.crc = zlib.crc32(part, self.crc)
            self.position += len(part)

    def copy(self, run: Run) -> None:
        """Copy a run of the data section."""
        for head, content in run.records:
            self._record(head, content)
        if run.loose:
            self._chunk(run.data, {r.channel: (r.heads["log_time"], r.starts - HEAD.itemsize) for r in run.rows})
        for rows in run.rows:
            self._count(rows.channel, rows.heads["log_time"])

    def _record(self, head: bytes, content: bytes) -> None:
        """Write a record of the data section, and store its place for the summary."""
        opcode, place = head[0], {"offset": self.position, "length": len(head) + len(content)}
        if opcode == Opcode.CHUNK:
            chunk = parsed(mcap.Chunk, content)
            self.compression = chunk.compression
            self.chunks.append(
                mcap.ChunkIndex(
                    chunk_start_offset=place["offset"], chunk_length=place["length"], compression=chunk.compression,
                    compressed_size=len(chunk.data), uncompressed_size=chunk.uncompressed_size,
                    message_start_time=chunk.message_start_time, message_end_time=chunk.message_end_time,
                    message_index_offsets={}, message_index_length=0,
                ),
            )  # fmt: skip
        elif opcode == Opcode.MESSAGE_INDEX and self.chunks:
            index = self.chunks[-1]
            index.message_index_offsets[int.from_bytes(content[:2], "little")] = place["offset"]
            index.message_index_length += place["length"]
        elif opcode == Opcode.ATTACHMENT:
            a = attachment(content)
            self.attachments.append(
                mcap.AttachmentIndex(
                    **place, create_time=a.create_time, log_time=a.log_time, data_size=len(a.data), name=a.name,
                    media_type=a.media_type,
                ),
            )  # fmt: skip
        elif opcode == Opcode.METADATA:
            self.metadata.append(mcap.MetadataIndex(**place, name=parsed(mcap.Metadata, content).name))
        self._write(head, content)

    def _count(self, channel: int, times: NDArray[np.uint64]) -> None:
        self.counts[channel] += len(times)
        self.times = [min([*self.times, int(times.min())]), max([*self.times, int(times.max())])]

    def add(self, table: NDArray[np.uint8] | list[bytes], before: Iterable[mcap.McapRecord], channel: int) -> None:
        """Add messages of one channel, as rows of bytes or a list of records, after the definitions ``before``."""
        head = bytes_of(before)
        if isinstance(table, np.ndarray):
            body: bytes | memoryview = table.data.cast("B")
            starts = table.shape[1] * np.arange(len(table))
            times = np.ndarray(len(table), HEAD, table.data, 0, (table.shape[1],))["log_time"]
        else:
            body = b"".join(table)
            starts = np.cumsum([0, *map(len, table)])[:-1]
            times = np.array([np.frombuffer(part, HEAD, 1)["log_time"][0] for part in table], np.uint64)
        self._chunk(head + body if head else body, {channel: (times, starts + len(head))})
        self._count(channel, times)

    def _chunk(self, data: bytes | memoryview, entries: dict[int, tuple[NDArray[np.uint64], Integers]]) -> None:
        """Write a chunk and the indexes of its channels: times and offsets of their messages."""
        times = np.concatenate([t for t, _ in entries.values()])
        chunk = mcap.Chunk(
            compression=self.compression, data=_compressed(data, self.compression), uncompressed_size=len(data),
            uncompressed_crc=zlib.crc32(data), message_start_time=int(times.min()), message_end_time=int(times.max()),
        )  # fmt: skip
        self.add_record(chunk)
        for channel, (log_times, starts) in entries.items():
            table = np.stack([log_times.astype("<u8"), starts.astype("<u8")], axis=1).tobytes()
            content = struct.pack("<HI", channel, len(table)) + table
            self._record(struct.pack("<BQ", Opcode.MESSAGE_INDEX, len(content)), content)

    def add_record(self, record: mcap.McapRecord) -> None:
        """Add a record of the data section."""
        written = bytes_of([record])
        self._record(written[:RECORD_HEAD], written[RECORD_HEAD:])

    def finish(self, schemas: Sequence[mcap.Schema], channels: Sequence[mcap.Channel]) -> None:
        """Close the data section and write the summary."""
        self._write(bytes_of([mcap.DataEnd(data_section_crc=self.crc)]))
        start = self.position
        times = self.times or [0, 0]
        statistics = mcap.Statistics(
            attachment_count=len(self.attachments), channel_count=len(channels), schema_count=len(schemas),
            channel_message_counts=dict(self.counts), chunk_count=len(self.chunks), metadata_count=len(self.metadata),
            message_count=self.counts.total(), message_start_time=times[0], message_end_time=times[1],
        )  # fmt: skip
        groups = [schemas, channels, [statistics], self.chunks, self.attachments, self.metadata]
        summary, offsets = b"", []
        for data in (bytes_of(group) for group in groups if group):
            offsets.append(mcap.SummaryOffset(data[0], start + len(summary), len(data)))
            summary += data
        footer = mcap.Footer(summary_start=start, summary_offset_start=start + len(summary), summary_crc=0)
        summary += bytes_of(offsets)
        footer.summary_crc = zlib.crc32(bytes_of([footer])[:-4], zlib.crc32(summary))
        self._write(summary, bytes_of([footer]), MAGIC)


def _compressed(data: bytes | memoryview, compression: str) -> bytes:
    if compression == "zstd":
        import zstandard  # noqa: PLC0415

        return zstandard.ZstdCompressor(level=ZSTD_LEVEL).compress(data)
    if compression == "lz4":
        import lz4.frame  # noqa: PLC0415

        return bytes(lz4.frame.compress(data))
    return bytes(data)
