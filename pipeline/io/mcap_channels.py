"""The messages of one topic as channels in g, deg/s, deg and degC.

The profile states which number of a message is which channel (``ingest.mcap.topics``). Four ROS types are known:

    specific force [g]   = linear_acceleration [m/s^2] / 9.80665          sensor_msgs/Imu
    angular rate [deg/s] = angular_velocity [rad/s] * 180/pi

A covariance whose first element is -1 says that the quantity is absent (sensor_msgs/Imu).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import IngestError
from pipeline.io.channel_table import in_house_unit
from pipeline.io.field_path import ONLY, FieldPath
from pipeline.io.ingest_settings import HEADER, TIME, MappedField
from pipeline.io.message_decoder import Batch, ChannelDecoder, Wanted
from pipeline.io.message_layout import short_name
from pipeline.io.ros2_messages import IMU, JOINT_STATE, QUATERNION_STAMPED, TEMPERATURE, VECTORS
from pipeline.io.units import ATTITUDE, COUNTS, TRIADS, UNITS, unit_spelt
from pipeline.records import Encoding

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mcap.records import Schema

    from pipeline.io.ingest_settings import McapFormat
    from pipeline.io.mcap_chunk import Rows
    from pipeline.io.mcap_reader import MessageReader
    from pipeline.records import Mask

MAPPED = "mapped"  # the kind of a topic whose fields the profile names; other kinds are ROS types
KINDS = {short_name(kind): kind for kind in (IMU, TEMPERATURE, JOINT_STATE, QUATERNION_STAMPED)}
STATED = "unit of "  # before a field's name in the metadata of a channel: the unit that the file states
LARGEST_NS = np.iinfo(np.int64).max


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
    """Decoder of one topic; ``encodings`` are those of channels sent as counts, ``count`` the messages so far."""

    def __init__(self, topic: str, kind: str, settings: McapFormat, path: str) -> None:
        self.topic, self.kind, self.path = topic, kind, path
        fields = settings.topics[topic] if kind == MAPPED else _fields_of(kind, settings)
        self.fields = {c: f for c, f in fields.items() if c != TIME}
        self.encodings = {
            c: Encoding(1.0 / f.counts_per_unit, f.offset) for c, f in self.fields.items() if f.unit == COUNTS
        }
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
        if (recorded > LARGEST_NS).any():
            number = self.count + int(np.argmax(recorded > LARGEST_NS)) + 1
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
