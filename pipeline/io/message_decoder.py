"""Messages of one channel to columns of numbers.

    cdr with ros2msg definitions, ros1 with ros1msg   columns of a whole chunk at once, as views on its bytes
    arrays (of other formats: ``message_logs``)       likewise
    protobuf, json                                    message by message

Where the ROS messages of a chunk differ in layout (a text or a list changes its length), the layout of each message is
found by itself. The official ROS decoders are not used: that of ROS 1 runs Python code that it writes from the
definition, and a log from a stranger must not run code; that of ROS 2 accepts bytes that are left over.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from decimal import Decimal
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from pipeline.errors import IngestError
from pipeline.io.field_path import STAMPS, FieldPath, number_at, place_of, stamp_at
from pipeline.io.message_layout import (
    ROS1_TIME,
    ROS2_TIME,
    MessageLayout,
    Place,
    find_layout,
    parse_definition,
    short_name,
)
from pipeline.io.timestamps import nanoseconds, of_number, of_pair

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mcap.records import Channel, Schema
    from numpy.typing import NDArray

    from pipeline.io.mcap_chunk import Rows
    from pipeline.records import Integers, Mask, Values

T = TypeVar("T")
SUPPORTED = "cdr with ros2msg, ros1 with ros1msg, protobuf with protobuf, and json are supported"
ROS_TIMES = {("cdr", "ros2msg"): ROS2_TIME, ("ros1", "ros1msg"): ROS1_TIME}
SECONDS, NANOSECONDS = "\0seconds", "\0nanoseconds"  # columns of a moment; no channel has such a name
ARRAYS = "arrays"  # encoding of messages made of arrays; the definition is JSON: name, byte, type, count of each
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
        layout = self._common_layout(rows)
        if layout is not None:
            batch = self._in_message(0, rows, lambda _payload: self._columns(rows, layout))
        else:
            batch = self._read_one_by_one(rows)
            self.one_by_one += len(rows.starts) if self.find_layout else 0
        self.done += len(rows.starts)
        return batch

    def _common_layout(self, rows: Rows) -> MessageLayout | None:
        """Return the layout that all messages have; None where they differ."""
        if self.find_layout is None:
            return None
        if self.layout is None or not self.layout.matches(rows):
            layout = self._in_message(0, rows, self.find_layout)
            self.layout = layout if layout.matches(rows) else None
        return self.layout

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
