"""Messages of one topic to channels in g, deg/s, deg and degC.

    cdr with ros2msg definitions, ros1 with ros1msg   columns of a whole chunk at once, as views on its bytes
    arrays (of other formats: ``message_logs``)       likewise
    protobuf, json                                    message by message

Where the ROS messages of a chunk differ in layout (a text or a list changes its length), the layout of each message is
found by itself. The official ROS decoders are not used: that of ROS 1 runs Python code that it writes from the
definition, and a log from a stranger must not run code; that of ROS 2 accepts bytes that are left over.

The profile states which number of a message is which channel (``ingest.mcap.topics``). Four ROS types are known:

    specific force [g]   = linear_acceleration [m/s^2] / 9.80665          sensor_msgs/Imu
    angular rate [deg/s] = angular_velocity [rad/s] * 180/pi

A covariance whose first element is -1 says that the quantity is absent (sensor_msgs/Imu).
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from decimal import Decimal
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from pipeline.errors import IngestError
from pipeline.io.channel_table import in_house_unit
from pipeline.io.field_path import ONLY, STAMPS, FieldPath, number_at, place_of, stamp_at
from pipeline.io.ingest_settings import HEADER, TIME, MappedField
from pipeline.io.message_layout import (
    ROS1_TIME,
    ROS2_TIME,
    MessageLayout,
    Place,
    find_layout,
    parse_definition,
    short_name,
)
from pipeline.io.ros2_messages import IMU, JOINT_STATE, QUATERNION_STAMPED, TEMPERATURE, VECTORS
from pipeline.io.timestamps import LARGEST, nanoseconds, of_number, of_pair
from pipeline.io.units import ATTITUDE, COUNTS, TRIADS, UNITS, unit_spelt

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mcap.records import Channel, Schema
    from numpy.typing import NDArray

    from pipeline.io.ingest_settings import McapFormat
    from pipeline.io.mcap_chunk import Rows
    from pipeline.io.mcap_reader import MessageReader
    from pipeline.records import Integers, Mask, Values

T = TypeVar("T")
SUPPORTED = "cdr with ros2msg, ros1 with ros1msg, protobuf with protobuf, and json are supported"
ROS_TIMES = {("cdr", "ros2msg"): ROS2_TIME, ("ros1", "ros1msg"): ROS1_TIME}
SECONDS, NANOSECONDS = "\0seconds", "\0nanoseconds"  # columns of a moment; no channel has such a name
ARRAYS = "arrays"  # encoding of messages made of arrays; the definition is JSON: name, byte, type, count of each
MAPPED = "mapped"  # the kind of a topic whose fields the profile names; other kinds are ROS types
KINDS = {short_name(kind): kind for kind in (IMU, TEMPERATURE, JOINT_STATE, QUATERNION_STAMPED)}
STATED = "unit of "  # before a field's name in the metadata of a channel: the unit that the file states
FindLayout = Callable[[bytes], MessageLayout]


@dataclass(frozen=True)
class Wanted:
    """What is read of a message: the number of each column, and the moment (None: the recorder's time is used).

    ``time_unit`` is that of a moment which is one number.
    """

    values: Mapping[str, FieldPath]
    time: FieldPath | None
    time_unit: str = "s"


@dataclass
class Batch:
    """Columns of the messages of one channel in one run.

    A value is NaN where the message has an empty list in its place. ``absent`` marks these rows of a column.
    """

    time_ns: Integers | None
    values: dict[str, Values]
    absent: dict[str, Mask] = field(default_factory=dict)

    def times(self, rows: Rows) -> Integers:
        """Return the moments or, where none is read, the recorder's times, ns."""
        return rows.heads["log_time"].astype(np.int64) if self.time_ns is None else self.time_ns


class ChannelDecoder:
    """Decoder of one channel; ``path`` names the file in messages. An encoding that is not supported is refused."""

    def __init__(self, channel: Channel, schema: Schema | None, wanted: Wanted, path: str) -> None:
        self.topic, self.wanted, self.path = channel.topic, wanted, path
        self.kind = schema.name if schema else "json"
        self.done = 0  # messages so far
        self.one_by_one = 0  # ROS messages among them whose layout was found one by one
        self.coarse_time = False  # whether moments are floating-point numbers
        self.layout: MessageLayout | None = None  # of the messages that were read last, if they were alike
        self.find_layout: FindLayout | None = None
        self.decode: Callable[[bytes], Any] | None = None
        try:
            self.find_layout = ros_layouts(channel, schema)
            self.decode = None if self.find_layout else object_decoder(channel, schema)
        except Exception as error:
            message = f"topic {self.topic}: its message definition cannot be read ({error})"
            raise IngestError(message, path, code="unsupported") from error
        if not self.find_layout and not self.decode:
            message = (
                f"topic {self.topic} is encoded as {channel.message_encoding!r} with "
                f"{schema.encoding if schema else ''!r} definitions"
            )
            raise IngestError(message, path, code="unsupported", hint=SUPPORTED)

    def read(self, rows: Rows) -> Batch:
        """Return the columns of messages; a refusal names the first message that is not what its definition says."""
        if self.find_layout and (self.layout is None or not self.layout.matches(rows)):
            first = self._in_message(0, rows, self.find_layout)
            self.layout = first if first.matches(rows) else None
        layout = self.layout
        if layout is not None:
            batch = self._in_message(0, rows, lambda _payload: self._columns(rows, layout))
        else:
            batch = self._read_one_by_one(rows)
            self.one_by_one += len(rows.starts) if self.find_layout else 0
        self.done += len(rows.starts)
        return batch

    def layout_of(self, row: int, rows: Rows) -> MessageLayout:
        """Return the layout of one ROS message."""
        assert self.find_layout is not None  # noqa: S101  (asked for ROS messages only)
        return self._in_message(row, rows, self.find_layout)

    def _columns(self, rows: Rows, layout: MessageLayout) -> Batch:
        places = {name: place_of(path, layout) for name, path in self.wanted.values.items()}
        numbers = {name: place for name, place in places.items() if place is not None}
        columns = layout.columns(rows, numbers | _stamp_places(self.wanted.time, layout))
        count = len(rows.starts)
        values = {n: columns[n].astype(np.float64) if n in numbers else np.full(count, np.nan) for n in places}
        absent = {n: np.ones(count, np.bool_) for n in places if n not in numbers}
        return Batch(self._moments(columns), values, absent)

    def _moments(self, columns: Mapping[str, NDArray[Any]]) -> Integers | None:
        if SECONDS not in columns:
            return None
        if NANOSECONDS in columns:
            return of_pair(columns[SECONDS], columns[NANOSECONDS])
        self.coarse_time |= columns[SECONDS].dtype.kind == "f"
        return of_number(columns[SECONDS], self.wanted.time_unit)

    def _read_one_by_one(self, rows: Rows) -> Batch:
        values: dict[str, list[float | None]] = {name: [] for name in self.wanted.values}
        moments: list[int] = []
        for row in range(len(rows.starts)):
            numbers, moment = self._in_message(row, rows, self._read_message)
            for name, number in numbers.items():
                values[name].append(number)
            if moment is not None:
                moments.append(moment)
        absent = {n: np.array([v is None for v in numbers]) for n, numbers in values.items() if None in numbers}
        columns = {n: np.array([np.nan if v is None else v for v in numbers]) for n, numbers in values.items()}
        return Batch(None if self.wanted.time is None else np.array(moments, np.int64), columns, absent)

    def _read_message(self, payload: bytes) -> tuple[dict[str, float | None], int | None]:
        moment: tuple[int, int] | int | Decimal
        if self.find_layout is not None:
            layout = self.find_layout(payload)
            places = {name: place_of(path, layout) for name, path in self.wanted.values.items()}
            numbers = {n: None if place is None else float(layout.number(place)) for n, place in places.items()}
            parts = [layout.number(place) for place in _stamp_places(self.wanted.time, layout).values()]
            if not parts:
                return numbers, None
            single = parts[0] if isinstance(parts[0], int) else Decimal(parts[0])
            moment = (int(parts[0]), int(parts[1])) if len(parts) == 2 else single
            self.coarse_time |= isinstance(moment, Decimal)
        else:
            assert self.decode is not None  # noqa: S101  (the constructor found it)
            message = self.decode(payload)
            numbers = {name: number_at(path, message) for name, path in self.wanted.values.items()}
            if self.wanted.time is None:
                return numbers, None
            moment = stamp_at(self.wanted.time, message)
            self.coarse_time |= isinstance(moment, Decimal) and not isinstance(message, dict)  # JSON is decimal text
        return numbers, nanoseconds(moment, self.wanted.time_unit)

    def _in_message(self, row: int, rows: Rows, work: Callable[[bytes], T]) -> T:
        """Call a function on a message; any error becomes an ``IngestError`` that names the message."""
        payload = rows.payload(row)
        try:
            return work(payload)
        except Exception as error:
            reason = str(error) if isinstance(error, ValueError) else f"{type(error).__name__} {error}".strip()
            message = (
                f"message {self.done + row + 1} on {self.topic} ({rows.place}, {len(payload)} bytes) cannot be read "
                f"as {self.kind}: {reason}"
            )
            raise IngestError(message, self.path, code="bad_message", offset=rows.offset) from error


def ros_layouts(channel: Channel, schema: Schema | None) -> FindLayout | None:
    """Return the function that finds the layout of a channel's ROS messages, or arrays; None for other encodings."""
    if schema is not None and schema.encoding == ARRAYS:
        places = {name: Place(byte, code, count) for name, byte, code, count in json.loads(schema.data)}
        return lambda payload: MessageLayout(payload, places)
    if schema is None or (channel.message_encoding, schema.encoding) not in ROS_TIMES:
        return None
    times, cdr = ROS_TIMES[channel.message_encoding, schema.encoding], channel.message_encoding == "cdr"
    definitions = parse_definition(schema.name, schema.data.decode("utf-8"), times)
    root = short_name(schema.name)
    return lambda payload: find_layout(root, definitions, payload, cdr=cdr)


def object_decoder(channel: Channel, schema: Schema | None) -> Callable[[bytes], Any] | None:
    """Return the decoder of protobuf or JSON messages; None for other encodings."""
    if channel.message_encoding == "json":
        return lambda payload: json.loads(payload.decode("utf-8"), parse_float=Decimal)
    if schema is None or (channel.message_encoding, schema.encoding) != ("protobuf", "protobuf"):
        return None
    from mcap_protobuf.decoder import DecoderFactory  # noqa: PLC0415  (few logs need it)

    return DecoderFactory().decoder_for("protobuf", schema)


def _stamp_places(path: FieldPath | None, layout: MessageLayout) -> dict[str, tuple[int, str]]:
    """Return the places of the seconds and nanoseconds of a moment, or of its one number."""
    if path is None:
        return {}
    for seconds, nanos in STAMPS:
        pair = [layout.places.get(f"{path.text}.{name}") for name in (seconds, nanos)]
        if pair[0] is not None and pair[1] is not None:
            return {SECONDS: (pair[0].offset, pair[0].code), NANOSECONDS: (pair[1].offset, pair[1].code)}
    place = place_of(path, layout)
    if place is None:
        raise ValueError(f"{path.text} is an empty list; a moment is expected")
    return {SECONDS: place}


def kind_of(topic: str, schema: Schema | None, settings: McapFormat) -> str:
    """Return the kind of a topic; empty for a type that is not read."""
    if topic in settings.topics:
        return MAPPED
    return KINDS.get(short_name(schema.name), "") if schema else ""


def topic_of(kind: str, settings: McapFormat) -> str | None:
    """Return the topic that the profile names for a ROS type; None stands for the only one."""
    topics = (settings.imu_topic, settings.temperature_topic, settings.joint_topic, settings.attitude_topic)
    return dict(zip(KINDS.values(), topics, strict=True))[kind]


def listed_topics(reader: MessageReader) -> list[tuple[str, str]]:
    """Return all topics of a file, each with its type in words."""
    found = set()
    for number, channel in reader.channels.items():
        schema = reader.schemas.get(channel.schema_id)
        kind = schema.name if schema else channel.message_encoding
        empty = "" if reader.counts[number] else ", no messages"
        found.add((channel.topic, f"{channel.topic} ({kind}{empty})"))
    return sorted(found)


class TopicDecoder:
    """Decoder of one topic; ``count`` are the messages so far."""

    def __init__(self, topic: str, kind: str, settings: McapFormat, path: str) -> None:
        self.topic, self.kind, self.path = topic, kind, path
        fields = settings.topics[topic] if kind == MAPPED else _fields_of(kind, settings)
        self.fields = {c: f for c, f in fields.items() if c != TIME}
        paths = {c: f.field for c, f in self.fields.items()}
        if kind == IMU:
            paths |= {vector: FieldPath.parse(f"{vector}_covariance[0]") for vector in VECTORS}
        time = fields.get(TIME) if settings.time_source == HEADER else None
        self.wanted = Wanted(paths, time.field if time else None, time.unit if time else "ns")
        self.decoders: dict[int, ChannelDecoder] = {}
        self.count = 0
        self._absent: dict[str, bool] = {}  # columns, by the first message

    def read(self, rows: Rows, reader: MessageReader) -> Batch:
        """Return time and channels of some messages; channels that are absent are left out."""
        recorded = rows.heads["log_time"]
        if (recorded > LARGEST).any():
            number = self.count + int(np.argmax(recorded > LARGEST)) + 1
            message = f"message {number} on {self.topic}: the recorder's time of {recorded.max()} ns is none"
            raise IngestError(message, self.path, code="bad_time")
        if rows.channel not in self.decoders:
            channel = reader.channels[rows.channel]
            schema = reader.schemas.get(channel.schema_id)
            self._check_units(channel.metadata)
            self.decoders[rows.channel] = ChannelDecoder(channel, schema, self.wanted, self.path)
        batch = self.decoders[rows.channel].read(rows)
        present = np.zeros(len(recorded), np.bool_)
        for name, column in batch.values.items():
            self._note_absent(name, column == -1.0 if name in VECTORS else batch.absent.get(name, present))
        self.count += len(recorded)
        absent = {name for name, is_absent in self._absent.items() if is_absent}
        absent |= {c for vector in absent & set(VECTORS) for c in TRIADS[VECTORS[vector][0]]}
        if self.kind == IMU and absent >= set(VECTORS):
            message = f"topic {self.topic} says that both quantities are absent (covariance -1)"
            raise IngestError(message, self.path, code="absent")
        values = {c: in_house_unit(self.fields[c], batch.values[c]) for c in self.fields if c not in absent}
        return Batch(batch.time_ns, values)

    def _check_units(self, stated: Mapping[str, str]) -> None:
        """Refuse a unit of the profile that is not the one which the file states (``STATED``)."""
        for channel, source in self.fields.items():
            text = stated.get(f"{STATED}{source.field.base}", "")
            unit = unit_spelt(text)
            if unit in UNITS[channel] and source.unit not in (unit, COUNTS):
                message = (
                    f"topic {self.topic}: the file states {text} for {source.field.text}, the profile {source.unit}"
                )
                raise IngestError(message, self.path, code="other_unit", hint=f"write unit: {unit} for {channel}")

    def _note_absent(self, name: str, absent: Mask) -> None:
        """Refuse a quantity that some messages lack."""
        before = self._absent.setdefault(name, bool(absent[0]))
        changed = np.flatnonzero(absent != before)
        if changed.size:
            covariance = name in VECTORS
            what = f"{name} is absent (covariance -1)" if covariance else f"{self.wanted.values[name].text} is empty"
            message = f"{what} in some messages on {self.topic}, see message {self.count + int(changed[0]) + 1}"
            raise IngestError(message, self.path, code="absent" if covariance else "bad_message")


def _fields_of(kind: str, settings: McapFormat) -> dict[str, MappedField]:
    path = FieldPath.parse
    fields = {TIME: (path("header.stamp"), "ns")}
    if kind == IMU:
        for vector, (sensor, unit, _) in VECTORS.items():
            fields |= {c: (path(f"{vector}.{a}"), unit) for c, a in zip(TRIADS[sensor], "xyz", strict=True)}
    elif kind == TEMPERATURE:
        fields["temperature"] = path("temperature"), "degC"
    elif kind == JOINT_STATE:
        joint = settings.joint or ONLY
        which = "the only joint" if joint == ONLY else f"joint {joint}"
        fields["table_angle"] = FieldPath(f"position of {which}", "position", joint), "rad"
        fields["table_rate"] = FieldPath(f"velocity of {which}", "velocity", joint), "rad/s"
    else:
        fields |= {c: (path(f"quaternion.{a}"), "1") for c, a in zip(ATTITUDE, "wxyz", strict=True)}
    return {c: MappedField(channel=c, field=source, unit=unit) for c, (source, unit) in fields.items()}
