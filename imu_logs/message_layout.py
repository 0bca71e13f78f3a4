"""Find the layout of ROS messages: parse their definitions, and locate the numbers in a message.

A definition is the text of the message's type, followed by the text of each type in it after a line of ``=`` signs and
a line ``MSG: package/Type``. A line is ``type name``, with an optional default value, or ``type NAME=value`` (a
constant, which is not sent); ``#`` begins a comment. ``type[3]`` is an array, ``type[]`` and ``type[<=3]`` are
sequences.

    CDR (ROS 2): 4 bytes of encapsulation; a number of size s is at a multiple of s, counted after these bytes;
                 a text is a 4-byte length and the text with a closing zero
    ROS 1      : no alignment, no encapsulation, no closing zero

Only texts and sequences change the places of the numbers after them, and each is preceded by its length. So another
message of the same size with equal encapsulation, lengths and texts has its numbers in the same places.

Paths to numbers in messages: ``linear_acceleration.x``, ``acc[0]``, ``samples[2].value``, ``position[table]``.

``[2]`` counts from 0. ``[table]`` is the element whose name, in the field ``name`` of the same message, is ``table``
(sensor_msgs/JointState); ``[*]`` is the only element. A path to a time ends at a message with seconds and nanoseconds.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass, field
from decimal import Decimal
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from imu_logs.log import Index
    from imu_logs.mcap_file import ChannelMessages
    from imu_logs.profile import FieldPath


NUMBERS = {
    "bool": "u1", "byte": "u1", "char": "u1", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4",
    "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip
STRING = "string"
_SECTION = re.compile(r"^={20,}\s*$", re.MULTILINE)
_LINE = re.compile(r"([A-Za-z][\w/]*)(?:<=\d+)?(\[(?:<=)?\d*\])?\s+([A-Za-z]\w*)\s*(=)?.*")
_SEQUENCE = -1
ENCAPSULATION = 4  # bytes before the content: its representation and options
LITTLE_ENDIAN = b"\x00\x01\x00\x00"
BIG_ENDIAN = b"\x00\x00"
MAX_NESTED_TYPES = 32  # types within types
MOST_FIELDS = 100_000  # of one message; nested arrays of empty messages would not end
ONLY = "*"
STAMPS = (("sec", "nanosec"), ("secs", "nsecs"), ("seconds", "nanos"), ("sec", "nsec"))


@dataclass(frozen=True)
class Field:
    """One field: its type (a number, ``string``, or the key of a definition) and its count.

    The count is the length of an array, -1 for a sequence, whose length is sent, and None for a single value.
    """

    name: str
    type: str
    count: int | None = None


Definitions = dict[str, tuple[Field, ...]]

ROS2_TIME: Definitions = {
    "builtin_interfaces/Time": (Field("sec", "int32"), Field("nanosec", "uint32")),
    "builtin_interfaces/Duration": (Field("sec", "int32"), Field("nanosec", "uint32")),
}
ROS1_TIME: Definitions = {
    "time": (Field("secs", "uint32"), Field("nsecs", "uint32")),
    "duration": (Field("secs", "int32"), Field("nsecs", "int32")),
}


def short_name(name: str) -> str:
    """Return ``package/Type`` of ``package/msg/Type``."""
    return name.replace("/msg/", "/")


def parse_definition(name: str, text: str, given: Definitions) -> Definitions:
    """Parse the definitions in the text of the message type ``name``; ``given``: definitions that it may omit."""
    sections = _SECTION.split(text)
    bodies = {short_name(name): sections[0]}
    for section in sections[1:]:
        head, _, body = section.strip().partition("\n")
        if not head.startswith("MSG:"):
            raise ValueError(f"{head!r} stands where 'MSG: package/Type' is expected")
        bodies[short_name(head.removeprefix("MSG:").strip())] = body
    found = dict(given)
    for key in bodies:
        found[key] = ()
    for key, body in bodies.items():
        found[key] = tuple(_fields(key, body, found))
    return found


def _fields(owner: str, body: str, known: Definitions) -> list[Field]:
    fields = []
    for number, line in enumerate(body.splitlines(), 1):
        stripped = line.partition("#")[0].strip()
        if not stripped:
            continue
        match = _LINE.fullmatch(stripped)
        if match is None:
            raise ValueError(f"line {number} of {owner} is no field: {line.strip()!r}")
        kind, array, name, constant = match.groups()
        if constant:
            continue
        count = None
        if array is not None:
            inner = array[1:-1]
            count = int(inner) if inner.isdigit() else _SEQUENCE
        fields.append(Field(name, _resolve(kind, owner, known), count))
    return fields


def _resolve(kind: str, owner: str, known: Definitions) -> str:
    if kind in NUMBERS or kind == STRING:
        return kind
    package = owner.rpartition("/")[0]
    choices = (short_name(kind), f"{package}/{kind}", *(("std_msgs/Header",) if kind == "Header" else ()))
    for choice in choices:
        if choice in known:
            return str(choice)
    raise ValueError(f"type {kind} in {owner} is not defined")


@dataclass(frozen=True)
class Place:
    """The place of a number: byte of the message, numpy's type, and length of an array (None: a single number)."""

    offset: int
    code: str
    count: int | None


@dataclass
class MessageLayout:
    """The layout of one message.

    ``places`` of the numbers and ``texts`` are by path, such as ``linear_acceleration.x``. ``fixed``: spans of bytes
    that are equal in all messages of this layout.
    """

    sample: bytes
    places: dict[str, Place] = field(default_factory=dict)
    texts: dict[str, str | list[str]] = field(default_factory=dict)
    fixed: list[tuple[int, int]] = field(default_factory=list)

    def matching(self, rows: ChannelMessages) -> Index:
        """Return the indices of the messages with this layout."""
        same_size = np.flatnonzero(rows.sizes == len(self.sample))
        if not same_size.size:
            return same_size
        words = [word for span in self.fixed for word in _words(*span)]
        table = rows.select(same_size).table(self._items({f"{at}": (at, f"<u{width}") for at, width in words}))
        same = np.ones(len(same_size), np.bool_)
        for at, width in words:
            same &= table[f"{at}"] == int.from_bytes(self.sample[at : at + width], "little")
        return same_size[same]

    def columns(self, rows: ChannelMessages, wanted: dict[str, tuple[int, str]]) -> dict[str, NDArray[np.generic]]:
        """Return columns of all messages as copies; ``wanted``: name to (offset, type)."""
        table = rows.table(self._items(wanted))
        return {name: table[name].copy() for name in wanted}

    def elements(self, most: int) -> dict[str, tuple[int, str]]:
        """Return (offset, type) of each number by its path, with at most ``most`` elements of an array."""
        found: dict[str, tuple[int, str]] = {}
        for name, place in self.places.items():
            indices = [""] if place.count is None else [f"[{i}]" for i in range(min(place.count, most))]
            size = int(place.code[2:])
            found |= {name + index: (place.offset + i * size, place.code) for i, index in enumerate(indices)}
        return found

    def _items(self, places: dict[str, tuple[int, str]]) -> np.dtype[np.void]:
        """Return the structured type of a message with fields at the given places."""
        offsets, codes = [p[0] for p in places.values()], [p[1] for p in places.values()]
        return np.dtype({"names": [*places], "formats": codes, "offsets": offsets, "itemsize": len(self.sample)})


def _words(start: int, end: int) -> Iterator[tuple[int, int]]:
    """Yield offset and size of the words of up to 8 bytes that fill a span."""
    while start < end:
        width = next(w for w in (8, 4, 2, 1) if w <= end - start)
        yield start, width
        start += width


def find_layout(root: str, definitions: Definitions, sample: bytes, *, cdr: bool) -> MessageLayout:
    """Return the layout of one message of the type ``root``: CDR of either byte order, or ROS 1.

    Raises ``ValueError`` if the message does not have exactly the size by its definition.
    """
    finder = _LayoutFinder(definitions, sample, cdr=cdr)
    finder.message(root, "", 0)
    if finder.at != len(sample):
        raise ValueError(f"it has {len(sample)} bytes where {root} needs {finder.at}")
    return finder.layout


class _LayoutFinder:
    """Follows a definition through one message; depth and number of fields are limited, so that it ends."""

    def __init__(self, definitions: Definitions, sample: bytes, *, cdr: bool) -> None:
        self.definitions, self.sample, self.cdr = definitions, sample, cdr
        self.layout = MessageLayout(sample)
        self.order, self.at, self.steps = "<", 0, 0
        if not cdr:
            return
        self.take(ENCAPSULATION, fixed=True)
        if sample[:2] == BIG_ENDIAN:
            self.order = ">"
        elif sample[:2] != LITTLE_ENDIAN[:2]:
            raise ValueError(f"its encapsulation is {sample[:4].hex(' ')}; plain CDR (00 00 or 00 01) is supported")

    def take(self, size: int, *, fixed: bool = False) -> bytes:
        start, end = self.at, self.at + size
        if end > len(self.sample):
            raise ValueError(f"it has {len(self.sample)} bytes, and its content needs at least {end}")
        if fixed:
            self.layout.fixed.append((start, end))
        self.at = end
        return self.sample[start:end]

    def align(self, size: int) -> None:
        if self.cdr:
            self.at += -(self.at - ENCAPSULATION) % size

    def length(self) -> int:
        self.align(4)
        number: int = struct.unpack(f"{self.order}I", self.take(4, fixed=True))[0]
        return number

    def text(self) -> str:
        content = self.take(self.length(), fixed=True)
        if self.cdr and content[-1:] not in (b"\0", b""):
            raise ValueError("a text in it does not end where its length says")
        return (content[:-1] if self.cdr else content).decode("utf-8")

    def numbers(self, path: str, kind: str, count: int | None) -> None:
        code = NUMBERS[kind]
        size, many = int(code[1:]), 1 if count is None else count
        if many:
            self.align(size)
        self.layout.places[path] = Place(self.at, self.order + code, count)
        self.take(size * many)

    def count(self) -> None:
        self.steps += 1
        if self.steps > MOST_FIELDS:
            raise ValueError(f"it has more than {MOST_FIELDS} fields")

    def message(self, key: str, prefix: str, depth: int) -> None:
        if depth > MAX_NESTED_TYPES:
            raise ValueError(f"{key} contains itself")
        self.count()
        fields = self.definitions[key]
        if not fields and self.cdr:
            self.take(1)  # an empty message is sent as one byte
        for item in fields:
            self.field(item, prefix + item.name, depth)

    def field(self, item: Field, path: str, depth: int) -> None:
        self.count()
        count = self.length() if item.count == _SEQUENCE else item.count
        if count is not None and count > len(self.sample):
            raise ValueError(f"{path} claims {count} elements in a message of {len(self.sample)} bytes")
        if item.type in NUMBERS:
            self.numbers(path, item.type, count)
        elif item.type == STRING:
            self.layout.texts[path] = self.text() if count is None else [self.text() for _ in range(count)]
        elif count is None:
            self.message(item.type, f"{path}.", depth + 1)
        else:
            for index in range(count):
                self.message(item.type, f"{path}[{index}].", depth + 1)


def place_of(path: FieldPath, layout: MessageLayout) -> tuple[int, str] | None:
    """Return the byte offset and the type of a number in a layout; None for an element of an empty list."""
    place: Place | None = layout.places.get(path.base)
    if place is None:
        raise ValueError(f"it has no number {path.base}; it has {', '.join(layout.places)}")
    if place.count is None or path.index is None:
        if place.count is not None or path.index is not None:
            raise ValueError(f"{path.text} is {'one number' if place.count is None else 'a list, and needs an index'}")
        return place.offset, place.code
    index = path.index
    if isinstance(index, str):
        found = _named(path, place.count, layout.texts.get(path.names.base))
        if found is None:
            return None
        index = found
    if index >= place.count:
        raise ValueError(f"{path.base} has {place.count} elements, too few for {path.text}")
    return place.offset + index * int(place.code[2:]), place.code


def _named(path: FieldPath, count: int, names: object) -> int | None:
    """Return the index of the element with a name; None for an empty list."""
    if not isinstance(names, list):
        raise ValueError(f"{path.names.base} is no list of names, which {path.text} needs")  # noqa: TRY004
    if path.index == ONLY and len(names) != 1:
        raise ValueError(f"it has the joints {', '.join(names)}; set ingest.mcap.joint")
    if path.index not in (ONLY, *names):
        raise ValueError(f"{path.index} is not among its names, which are {', '.join(names) or 'none'}")
    if count == 0:
        return None
    if count != len(names):
        raise ValueError(f"it has {count} numbers of {path.base} for {len(names)} joints")
    return 0 if path.index == ONLY else names.index(str(path.index))


def look_up(path: FieldPath, message: object) -> Any:  # noqa: ANN401  (a number, or a message)
    """Return the value at a path of a decoded message; None for an element of an empty list."""
    value: Any = message
    for step in path.steps:
        value = _step(value, step, path)
    if path.index is None:
        return value
    if isinstance(path.index, int):
        return _step(value, path.index, path)
    index = _named(path, len(value), list(look_up(path.names, message)))
    return None if index is None else value[index]


def _step(value: Any, step: str | int, path: FieldPath) -> Any:  # noqa: ANN401
    """Return a field of a protobuf message, an entry of a JSON object, or an element of a list."""
    descriptor = getattr(value, "DESCRIPTOR", None)
    if descriptor is not None and isinstance(step, str):
        known = descriptor.fields_by_name.get(step)
        if known is None:
            raise ValueError(f"it has no field {path.text}; there are {', '.join(descriptor.fields_by_name)}")
        if known.has_presence and not value.HasField(step):
            raise ValueError(f"it has no value of {step} for {path.text}")
        return getattr(value, step)
    try:
        return value[step]
    except (KeyError, IndexError, TypeError) as error:
        names = value if isinstance(value, dict) else ()
        raise ValueError(f"it has no field {path.text}; there are {', '.join(names)}") from error


def number_at(path: FieldPath, message: object) -> float | None:
    """Return the number at a path of a decoded message; None for an element of an empty list."""
    value = look_up(path, message)
    if value is None and path.index is not None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float | Decimal):
        raise ValueError(f"{path.text} is {value!r}; a number is expected")  # noqa: TRY004
    return float(value)


def stamp_at(path: FieldPath, message: object) -> tuple[int, int] | int | Decimal:
    """Return the time at a path of a decoded message: (seconds, nanoseconds), or one number."""
    value = look_up(path, message)
    if isinstance(value, int | float | Decimal) and not isinstance(value, bool):
        return value if isinstance(value, int) else Decimal(value)
    if isinstance(value, str) and value.isdigit():
        return int(value)
    for names in STAMPS:
        pair = [value.get(n) if isinstance(value, dict) else getattr(value, n, None) for n in names]
        if isinstance(pair[0], int) and isinstance(pair[1], int):
            return pair[0], pair[1]
    raise ValueError(f"{path.text} is {value!r}; a number, or seconds and nanoseconds, are expected")
