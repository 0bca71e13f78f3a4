"""Messages of one channel to columns of numbers.

    cdr  with ros2msg definitions  (ROS 2)      columns of a whole chunk at once, as views on its bytes
    ros1 with ros1msg definitions  (ROS 1)      likewise
    protobuf                                    message by message, official decoder
    json                                        message by message

Where the messages of a chunk of ROS are not alike (a text or a list changes its length), the chunk is read message by
message: ROS 2 with the official decoder, each message held to the length that its definition needs, because that
decoder accepts bytes that are left over and bytes of another type; ROS 1 by the walk that makes the templates, because
the official decoder writes Python code from the definition and runs it, and a log from a stranger must not run code.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from decimal import Decimal
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from pipeline.errors import IngestError
from pipeline.io.field_path import STAMPS, FieldPath, number_at, place_of, stamp_at
from pipeline.io.message_definition import ROS1_TIME, ROS2_TIME, parse_definition, short_name
from pipeline.io.message_template import Template, find_template
from pipeline.io.official_decoders import object_decoder, ros2_decoder
from pipeline.io.timestamps import nanoseconds, of_number, of_pair

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from mcap.records import Channel, Schema
    from numpy.typing import NDArray

    from pipeline.io.mcap_chunk import Rows

T = TypeVar("T")
SUPPORTED = "cdr with ros2msg, ros1 with ros1msg, protobuf with protobuf, and json are supported"
SECONDS, NANOSECONDS = "\0seconds", "\0nanoseconds"  # no channel bears such names


@dataclass(frozen=True)
class Wanted:
    """What is read of a message.

    Attributes
    ----------
    values : dict of str to FieldPath
        Column to the path of its number.
    time : FieldPath or None
        The moment of the measurement; None where the recorder's time is used.
    time_unit : str
        Of a moment that is one number.
    """

    values: Mapping[str, FieldPath]
    time: FieldPath | None
    time_unit: str = "s"


@dataclass
class Batch:
    """Columns of the messages of one channel in one run.

    Attributes
    ----------
    time_ns : (n,) array of int64, or None
    values : dict of str to (n,) array of float64
        NaN where the message has an empty list in place of the number.
    absent : dict of str to (n,) array of bool
        Where that is so; columns without such messages are left out.
    """

    time_ns: NDArray[np.int64] | None
    values: dict[str, NDArray[np.float64]]
    absent: dict[str, NDArray[np.bool_]] = field(default_factory=dict)


class ChannelDecoder:
    """Decoder of one channel.

    Parameters
    ----------
    channel, schema : Channel, Schema or None
    wanted : Wanted
    path : str
        File, for messages.

    Raises
    ------
    IngestError
        If the channel's encoding is not supported or its definition cannot be read.
    """

    def __init__(self, channel: Channel, schema: Schema | None, wanted: Wanted, path: str) -> None:
        self.topic, self.wanted, self.path = channel.topic, wanted, path
        self.schema = schema
        self.kind = schema.name if schema else "json"
        self.done = 0  # messages so far
        self.coarse_time = False  # whether moments are floating-point numbers
        self.one_by_one = 0  # of those, read message by message though they are ROS
        self.ros = ""
        self.encoding = channel.message_encoding
        encodings = (channel.message_encoding, schema.encoding if schema else "")
        if encodings == ("cdr", "ros2msg"):
            self.ros, given = "cdr", ROS2_TIME
        elif encodings == ("ros1", "ros1msg"):
            self.ros, given = "ros1", ROS1_TIME
        elif encodings != ("protobuf", "protobuf") and channel.message_encoding != "json":
            raise IngestError(
                f"topic {self.topic} is encoded as {encodings[0]!r} with {encodings[1]!r} definitions",
                path,
                fault="unsupported",
                hint=SUPPORTED,
            )
        try:
            if self.ros and schema is not None:
                self.definitions = parse_definition(schema.name, schema.data.decode("utf-8"), given)
            self._official = None if self.ros else object_decoder(channel, schema)
        except Exception as error:
            raise IngestError(
                f"topic {self.topic}: its message definition cannot be read ({error})", path, fault="unsupported"
            ) from error
        self.template: Template | None = None  # of the messages that were read last, if they were alike

    def read(self, rows: Rows) -> Batch:
        """Return the columns of messages.

        Raises
        ------
        IngestError
            Naming the first message that is not what its definition says.
        """
        batch = self._read_alike(rows) if self.ros else None
        if batch is None:
            batch = self._read_one_by_one(rows)
            self.one_by_one += len(rows.starts) if self.ros else 0
        self.done += len(rows.starts)
        return batch

    def _read_alike(self, rows: Rows) -> Batch | None:
        """Return columns as views on the chunk, if its messages are alike."""
        template = self.template
        if template is None or not template.suits(rows):
            template, self.template = self.template_of(0, rows), None
            if not template.suits(rows):
                return None
            self.template = template
        return self._in_message(0, rows, lambda _payload: self._columns(rows, template))

    def template_of(self, row: int, rows: Rows) -> Template:
        """Return where the numbers of one ROS message lie."""
        return self._in_message(row, rows, self._find_template)

    def _find_template(self, payload: bytes) -> Template:
        return find_template(short_name(self.kind), self.definitions, payload, cdr=self.ros == "cdr")

    def _columns(self, rows: Rows, template: Template) -> Batch:
        places = {name: place_of(path, template) for name, path in self.wanted.values.items()}
        numbers = {name: place for name, place in places.items() if place is not None}
        stamps = _stamp_places(self.wanted.time, template)
        columns = template.columns(rows, numbers | stamps)
        time = None
        if SECONDS in columns:
            time = of_pair(columns[SECONDS], columns[NANOSECONDS]) if NANOSECONDS in columns else None
            if time is None:
                time = of_number(columns[SECONDS], self.wanted.time_unit)
                self.coarse_time |= columns[SECONDS].dtype.kind == "f"
        count = len(rows.starts)
        values = {n: columns[n].astype(np.float64) if n in numbers else np.full(count, np.nan) for n in places}
        return Batch(time, values, {n: np.ones(count, np.bool_) for n in places if n not in numbers})

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
        message: Any
        if self.ros:
            template = self._find_template(payload)  # raises unless the length is what the definition needs
            if self.ros == "ros1":
                return _of_template(template, self.wanted)
            if self._official is None:
                self._official = ros2_decoder(self.schema)
        assert self._official is not None  # noqa: S101  (made above, or in the constructor)
        message = self._official(payload)
        numbers = {name: number_at(path, message) for name, path in self.wanted.values.items()}
        if self.wanted.time is None:
            return numbers, None
        moment = stamp_at(self.wanted.time, message)
        self.coarse_time |= isinstance(moment, Decimal) and self.encoding != "json"
        return numbers, nanoseconds(moment, self.wanted.time_unit)

    def _in_message(self, row: int, rows: Rows, work: Callable[[bytes], T]) -> T:
        """Do a piece of work on a message; whatever is wrong with its bytes becomes the one error."""
        payload = rows.payload(row)
        try:
            return work(payload)
        except Exception as error:
            reason = str(error) if isinstance(error, ValueError) else f"{type(error).__name__} {error}".strip()
            raise IngestError(
                f"message {self.done + row + 1} on {self.topic} ({rows.run.name}, {len(payload)} bytes) cannot be read "
                f"as {self.kind}: {reason}",
                self.path,
                fault="bad_message",
                offset=rows.run.offset,
            ) from error


def _stamp_places(path: FieldPath | None, template: Template) -> dict[str, tuple[int, str]]:
    """Return where the seconds and nanoseconds of a moment lie, or its one number."""
    if path is None:
        return {}
    for seconds, nanos in STAMPS:
        pair = [template.places.get(f"{path.text}.{name}") for name in (seconds, nanos)]
        if pair[0] is not None and pair[1] is not None:
            return {SECONDS: (pair[0].offset, pair[0].code), NANOSECONDS: (pair[1].offset, pair[1].code)}
    place = place_of(path, template)
    if place is None:
        raise ValueError(f"{path.text} is an empty list; a moment is expected")
    return {SECONDS: place}


def _of_template(template: Template, wanted: Wanted) -> tuple[dict[str, float | None], int | None]:
    """Return the numbers and the moment of the message that a template was made of."""

    def number(place: tuple[int, str]) -> int | float:
        value: int | float = np.frombuffer(template.sample, place[1], 1, place[0])[0].item()
        return value

    places = {name: place_of(path, template) for name, path in wanted.values.items()}
    numbers = {name: None if place is None else float(number(place)) for name, place in places.items()}
    moment = [number(place) for place in _stamp_places(wanted.time, template).values()]
    if not moment:
        return numbers, None
    if len(moment) == 2:
        return numbers, nanoseconds((int(moment[0]), int(moment[1])), wanted.time_unit)
    return numbers, nanoseconds(moment[0] if isinstance(moment[0], int) else Decimal(moment[0]), wanted.time_unit)
