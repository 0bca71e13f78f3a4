"""Decode the messages of one topic to channels in g, deg/s, deg and degC.

    cdr with ros2msg definitions, ros1 with ros1msg   columns of a whole chunk at once, as views on its bytes
    arrays (of other formats: ``message_logs``)       the same
    protobuf, json                                    message by message

Where the ROS messages of a chunk differ in layout (a text or a list has another length), messages of one layout are
read together. The official ROS decoders are not used: the decoder of ROS 1 generates and runs Python code from the
definition, but a log from a stranger must not run code; the decoder of ROS 2 accepts excess bytes.

The profile assigns fields of messages to channels (``ingest.mcap.topics``). Four ROS types are known:

    specific force [g]   = linear_acceleration [m/s^2] / 9.80665          sensor_msgs/Imu
    angular rate [deg/s] = angular_velocity [rad/s] * 180/pi

A covariance whose first element is -1 means that the quantity is absent (sensor_msgs/Imu).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from decimal import Decimal
from typing import Any, NamedTuple, TypeVar

import numpy as np
from mcap.records import Channel, Schema

from imu_logs import message_layout as layouts
from imu_logs.clocks import MAX_NANOSECONDS, nanoseconds, of_number, of_pair
from imu_logs.errors import IngestError
from imu_logs.log import Index, Integers, Mask, Values, in_house_unit
from imu_logs.mcap_file import ChannelMessages, MessageReader
from imu_logs.mcap_write import IMU, JOINT_STATE, QUATERNION_STAMPED, TEMPERATURE, VECTORS
from imu_logs.profile import HEADER, TIME, FieldPath, MappedField, McapFormat
from imu_logs.units import ATTITUDE, COUNTS, TRIADS, UNITS, unit_spelt

T = TypeVar("T")
SUPPORTED = "cdr with ros2msg, ros1 with ros1msg, protobuf with protobuf, and json are supported"
ROS_TIMES = {("cdr", "ros2msg"): layouts.ROS2_TIME, ("ros1", "ros1msg"): layouts.ROS1_TIME}
SECONDS, NANOSECONDS = "\0seconds", "\0nanoseconds"  # columns of a moment; no channel has such a name
ARRAYS = "arrays"  # encoding of messages made of arrays; the definition is JSON: name, byte, type, count of each
MAPPED = "mapped"  # the kind of a topic whose fields the profile names; other kinds are ROS types
KINDS = {layouts.short_name(kind): kind for kind in (IMU, TEMPERATURE, JOINT_STATE, QUATERNION_STAMPED)}
STATED = "unit of "  # before a field's name in the metadata of a channel: the unit that the file states
MOST_LAYOUTS = 32  # in a run; messages of further layouts are read one by one, which bounds the cost
FindLayout = Callable[[bytes], layouts.MessageLayout]
Decode = Callable[[bytes], Any]


def ros_layouts(channel: Channel, schema: Schema | None) -> FindLayout | None:
    """Return a function that finds the layout of a channel's messages (ROS or arrays); None for other encodings."""
    if schema is not None and schema.encoding == ARRAYS:
        places = {name: layouts.Place(byte, code, count) for name, byte, code, count in json.loads(schema.data)}
        return lambda payload: layouts.MessageLayout(payload, places)
    if schema is None or (channel.message_encoding, schema.encoding) not in ROS_TIMES:
        return None
    times, cdr = ROS_TIMES[channel.message_encoding, schema.encoding], channel.message_encoding == "cdr"
    definitions = layouts.parse_definition(schema.name, schema.data.decode("utf-8"), times)
    root = layouts.short_name(schema.name)
    return lambda payload: layouts.find_layout(root, definitions, payload, cdr=cdr)


def object_decoder(channel: Channel, schema: Schema | None) -> Decode | None:
    """Return the decoder of protobuf or JSON messages; None for other encodings."""
    if channel.message_encoding == "json":
        return lambda payload: json.loads(payload.decode("utf-8"), parse_float=Decimal)
    if schema is None or (channel.message_encoding, schema.encoding) != ("protobuf", "protobuf"):
        return None
    from mcap_protobuf.decoder import DecoderFactory  # noqa: PLC0415  (few logs need it)

    return DecoderFactory().decoder_for("protobuf", schema)


def _stamp_places(path: FieldPath | None, layout: layouts.MessageLayout) -> dict[str, tuple[int, str]]:
    """Return the places of the seconds and nanoseconds of a time, or of its single number."""
    if path is None:
        return {}
    for seconds, nanos in layouts.STAMPS:
        pair = [layout.places.get(f"{path.text}.{name}") for name in (seconds, nanos)]
        if pair[0] is not None and pair[1] is not None:
            return {SECONDS: (pair[0].offset, pair[0].code), NANOSECONDS: (pair[1].offset, pair[1].code)}
    place = layouts.place_of(path, layout)
    if place is None:
        raise ValueError(f"{path.text} is an empty list; a moment is expected")
    return {SECONDS: place}


def topic_of(kind: str, settings: McapFormat) -> str | None:
    """Return the topic that the profile names for a ROS type; None means the only topic of the type."""
    topics = (settings.imu_topic, settings.temperature_topic, settings.joint_topic, settings.attitude_topic)
    return dict(zip(KINDS.values(), topics, strict=True))[kind]


def listed_topics(reader: MessageReader) -> list[tuple[str, str]]:
    """Return all topics of a file, each with a text that includes its type."""
    found = set()
    for number, channel in reader.channels.items():
        schema = reader.schemas.get(channel.schema_id)
        kind = schema.name if schema else channel.message_encoding
        empty = "" if reader.counts[number] else ", no messages"
        found.add((channel.topic, f"{channel.topic} ({kind}{empty})"))
    return sorted(found)


class MessageBatch(NamedTuple):
    """Messages of a topic: their times, ns (None: the recorder's times are used), and values by channel."""

    time_ns: Integers | None
    values: dict[str, Values]

    def times(self, rows: ChannelMessages) -> Integers:
        """Return the times of the messages, or the recorder's times if none are read, ns."""
        return rows.heads["log_time"].astype(np.int64) if self.time_ns is None else self.time_ns


def _together(parts: Sequence[MessageBatch], groups: Sequence[tuple[Index, layouts.MessageLayout]]) -> MessageBatch:
    """Join the messages of all layouts in the order of the file."""
    if len(parts) == 1:
        return parts[0]
    order = np.argsort(np.concatenate([own for own, _ in groups]))
    times = [part.time_ns for part in parts if part.time_ns is not None]
    values = {name: np.concatenate([part.values[name] for part in parts])[order] for name in parts[0].values}
    return MessageBatch(np.concatenate(times)[order] if times else None, values)


class TopicDecoder:
    """Decoder of one topic; ``path`` names the file in messages.

    ``fields``: channel to its field, unit and scale. ``count``: messages so far; ``varying``: messages in runs with
    several layouts. ``coarse_time``: whether times are floating-point numbers. ``groups``: indices of the ROS messages
    that were read last, grouped by layout.
    """

    def __init__(self, topic: str, kind: str, settings: McapFormat, path: str) -> None:
        self.topic, self.kind, self.path = topic, kind, path
        fields = settings.topics[topic] if kind == MAPPED else _fields_of(kind, settings)
        self.fields = {c: f for c, f in fields.items() if c != TIME}
        self._paths = {c: f.field for c, f in self.fields.items()}
        if kind == IMU:
            self._paths |= {vector: FieldPath.parse(f"{vector}_covariance[0]") for vector in VECTORS}
        time = fields.get(TIME) if settings.time_source == HEADER and settings.rate_hz is None else None
        self._time = time.field if time else None
        self._time_unit = time.unit if time else "ns"
        self.count = self.varying = 0
        self.coarse_time = False
        self.groups: list[tuple[Index, layouts.MessageLayout]] = []
        self._channels: dict[int, tuple[str, FindLayout | None, Decode | None]] = {}  # type, and what reads a message
        self._layouts: dict[int, layouts.MessageLayout] = {}  # the last one of each channel
        self._absent: dict[str, bool] = {}  # columns, by the first message

    def read(self, rows: ChannelMessages, reader: MessageReader) -> MessageBatch:
        """Return times and channels of messages, without absent channels.

        An ``IngestError`` names the first message that contradicts its definition.
        """
        recorded = rows.heads["log_time"]
        if (recorded > MAX_NANOSECONDS).any():
            number = self.count + int(np.argmax(recorded > MAX_NANOSECONDS)) + 1
            message = f"message {number} on {self.topic}: the recorder's time of {recorded.max()} ns is out of range"
            raise IngestError(message, self.path, code="bad_time")
        if rows.channel not in self._channels:
            self._channels[rows.channel] = self._open(reader, rows.channel)
        _, find, decode = self._channels[rows.channel]
        if decode is not None:
            batch = self._decoded(rows, decode)
        elif find is not None:
            self.groups = list(self._by_layout(rows, find))
            batch = _together([self._columns(rows, own, layout) for own, layout in self.groups], self.groups)
            self.varying += len(recorded) if len(self.groups) > 1 else 0
        self.count += len(recorded)
        absent = {name for name, is_absent in self._absent.items() if is_absent}
        absent |= {c for vector in absent & set(VECTORS) for c in TRIADS[VECTORS[vector][0]]}
        if self.kind == IMU and absent >= set(VECTORS):
            message = f"topic {self.topic} says that both quantities are absent (covariance -1)"
            raise IngestError(message, self.path, code="absent")
        values = {c: in_house_unit(f, batch.values[c]) for c, f in self.fields.items() if c not in absent}
        return batch._replace(values=values)

    def _open(self, reader: MessageReader, number: int) -> tuple[str, FindLayout | None, Decode | None]:
        """Return the type of a channel's messages, and the functions that read one; refuse an unknown encoding."""
        channel = reader.channels[number]
        schema = reader.schemas.get(channel.schema_id)
        self._check_units(channel.metadata)
        try:
            find = ros_layouts(channel, schema)
            decode = None if find else object_decoder(channel, schema)
        except Exception as error:
            message = f"topic {self.topic}: its message definition cannot be read ({error})"
            raise IngestError(message, self.path, code="unsupported") from error
        if not find and not decode:
            message = (
                f"topic {self.topic} is encoded as {channel.message_encoding!r} with "
                f"{schema.encoding if schema else ''!r} definitions"
            )
            raise IngestError(message, self.path, code="unsupported", hint=SUPPORTED)
        return schema.name if schema else "json", find, decode

    def _by_layout(self, rows: ChannelMessages, find: FindLayout) -> Iterator[tuple[Index, layouts.MessageLayout]]:
        """Yield the indices of the messages of each layout, and the layout."""
        remaining = np.arange(len(rows.starts))
        layout = self._layouts.get(rows.channel)
        for _ in range(MOST_LAYOUTS):
            rest = rows.select(remaining)
            matching = np.zeros(0, np.intp) if layout is None else layout.matching(rest)
            if not matching.size or matching[0]:
                layout = self._layouts[rows.channel] = self._in_message(int(remaining[0]), rows, find)
                matching = layout.matching(rest)
            assert layout is not None  # noqa: S101  (found above)
            yield remaining[matching], layout
            if len(matching) == len(remaining):
                return
            remaining = np.delete(remaining, matching)
        for row in remaining.tolist():
            yield np.array([row]), self._in_message(row, rows, find)

    def _columns(self, rows: ChannelMessages, indices: Index, layout: layouts.MessageLayout) -> MessageBatch:
        """Return times and columns of the messages of one layout; a column is NaN where the list is empty."""

        def find(_: bytes) -> dict[str, tuple[int, str] | None]:
            places = {name: layouts.place_of(path, layout) for name, path in self._paths.items()}
            return places | _stamp_places(self._time, layout)

        def moments(_: bytes) -> Integers | None:
            if NANOSECONDS in found:
                return of_pair(found[SECONDS], found[NANOSECONDS])
            return of_number(found[SECONDS], self._time_unit) if SECONDS in found else None

        places = self._in_message(int(indices[0]), rows, find)
        found = layout.columns(rows.select(indices), {n: place for n, place in places.items() if place is not None})
        time_ns = self._in_message(int(indices[0]), rows, moments)
        self.coarse_time |= SECONDS in found and found[SECONDS].dtype.kind == "f"
        empty, columns = np.full(len(indices), np.nan), {}
        for name in self._paths:
            columns[name] = found[name].astype(np.float64) if name in found else empty
            absent = columns[name] == -1.0 if name in VECTORS else np.array([name not in found])  # the same in all
            self._note_absent(name, absent, indices)
        return MessageBatch(time_ns, columns)

    def _decoded(self, rows: ChannelMessages, decode: Decode) -> MessageBatch:
        """Return times and columns of messages, decoded one by one."""
        numbers: dict[str, list[float | None]] = {name: [] for name in self._paths}
        moments: list[int] = []

        def work(payload: bytes) -> None:
            message = decode(payload)
            for name, path in self._paths.items():
                numbers[name].append(layouts.number_at(path, message))
            if self._time is not None:
                moment = layouts.stamp_at(self._time, message)
                self.coarse_time |= isinstance(moment, Decimal) and not isinstance(message, dict)  # JSON is decimal
                moments.append(nanoseconds(moment, self._time_unit))

        for row in range(len(rows.starts)):
            self._in_message(row, rows, work)
        for name, values in numbers.items():
            self._note_absent(name, np.array([v is None for v in values]), np.arange(len(values)))
        columns = {name: np.array(values, np.float64) for name, values in numbers.items()}
        return MessageBatch(None if self._time is None else np.array(moments, np.int64), columns)

    def _in_message(self, row: int, rows: ChannelMessages, work: Callable[[bytes], T]) -> T:
        """Call a function on a message; any error becomes an ``IngestError`` that names the message."""
        payload = rows.payload(row)
        try:
            return work(payload)
        except Exception as error:
            reason = str(error) if isinstance(error, ValueError) else f"{type(error).__name__} {error}".strip()
            message = (
                f"message {self.count + row + 1} on {self.topic} ({rows.place}, {len(payload)} bytes) cannot be read "
                f"as {self._channels[rows.channel][0]}: {reason}"
            )
            raise IngestError(message, self.path, code="bad_message", offset=rows.offset) from error

    def _check_units(self, stated: Mapping[str, str]) -> None:
        """Raise ``IngestError`` if the file states another unit than the profile (``STATED``)."""
        for channel, source in self.fields.items():
            text = stated.get(f"{STATED}{source.field.base}", "")
            unit = unit_spelt(text)
            if unit in UNITS[channel] and source.unit not in (unit, COUNTS):
                message = (
                    f"topic {self.topic}: the file states {text} for {source.field.text}, the profile {source.unit}"
                )
                raise IngestError(message, self.path, code="other_unit", hint=f"write unit: {unit} for {channel}")

    def _note_absent(self, name: str, absent: Mask, index: Index) -> None:
        """Raise ``IngestError`` if a quantity is absent in some messages only; ``own``: indices of the messages."""
        before = self._absent.setdefault(name, bool(absent[0]))
        changed = np.flatnonzero(absent != before)
        if changed.size:
            covariance = name in VECTORS
            what = f"{name} is absent (covariance -1)" if covariance else f"{self._paths[name].text} is empty"
            message = f"{what} in some messages on {self.topic}, see message {self.count + int(index[changed[0]]) + 1}"
            raise IngestError(message, self.path, code="absent" if covariance else "bad_message")


class Topics:
    """The topics of a log that are read: topics in the profile, and topics of known types."""

    def __init__(self, settings: McapFormat, path: str) -> None:
        self.settings, self.path = settings, path
        self.decoders: dict[str, TopicDecoder] = {}

    def decoder_of(self, rows: ChannelMessages, reader: MessageReader) -> TopicDecoder | None:
        """Return the decoder for messages; None if their topic is not read."""
        channel = reader.channels[rows.channel]
        name, schema = channel.topic, reader.schemas.get(channel.schema_id)
        if name not in self.decoders:
            kind = KINDS.get(layouts.short_name(schema.name), "") if schema else ""
            known = kind and not (kind == IMU and self.settings.topics)
            if name in self.settings.topics:
                kind = MAPPED
            elif not known or topic_of(kind, self.settings) not in {None, name}:
                return None
            self.decoders[name] = TopicDecoder(name, kind, self.settings, self.path)
        return self.decoders[name]


def _fields_of(kind: str, settings: McapFormat) -> dict[str, MappedField]:
    path = FieldPath.parse
    fields = {TIME: (path("header.stamp"), "ns")}
    if kind == IMU:
        for vector, (sensor, unit, _) in VECTORS.items():
            fields |= {c: (path(f"{vector}.{a}"), unit) for c, a in zip(TRIADS[sensor], "xyz", strict=True)}
    elif kind == TEMPERATURE:
        fields["temperature"] = path("temperature"), "degC"
    elif kind == JOINT_STATE:
        joint = settings.joint or layouts.ONLY
        which = "the only joint" if joint == layouts.ONLY else f"joint {joint}"
        fields["table_angle"] = FieldPath(f"position of {which}", "position", joint), "rad"
        fields["table_rate"] = FieldPath(f"velocity of {which}", "velocity", joint), "rad/s"
    else:
        fields |= {c: (path(f"quaternion.{a}"), "1") for c, a in zip(ATTITUDE, "wxyz", strict=True)}
    return {c: MappedField(channel=c, field=source, unit=unit) for c, (source, unit) in fields.items()}
