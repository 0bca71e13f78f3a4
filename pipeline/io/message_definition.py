"""Definitions of ROS messages, text to fields.

A definition is the text of the message's own type, then that of each type in it, each after a line of ``=`` signs and a
line ``MSG: package/Type``. A line is ``type name``, with an optional default value, or ``type NAME=value`` (a constant,
which is not sent); ``#`` begins a comment. ``type[3]`` is an array, ``type[]`` and ``type[<=3]`` are sequences.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

NUMBERS = {
    "bool": "u1",
    "byte": "u1",
    "char": "u1",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "int64": "i8",
    "uint64": "u8",
    "float32": "f4",
    "float64": "f8",
}
STRING = "string"
_SECTION = re.compile(r"^={20,}\s*$", re.MULTILINE)
_LINE = re.compile(r"([A-Za-z][\w/]*)(?:<=\d+)?(\[(?:<=)?\d*\])?\s+([A-Za-z]\w*)\s*(=)?.*")
_SEQUENCE = -1


@dataclass(frozen=True)
class Field:
    """One field: its type (a number, ``string``, or the key of a definition) and how many there are.

    Attributes
    ----------
    count : int or None
        Of an array; -1 for a sequence, whose length is sent; None for a single value.
    """

    name: str
    type: str
    count: int | None = None

    @property
    def sequence(self) -> bool:
        """Whether the number of values is sent before them."""
        return self.count == _SEQUENCE


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
    """Return the definitions in a text.

    Parameters
    ----------
    name : str
        Type of the message.
    text : str
    given : Definitions
        Of types that a text need not define.

    Raises
    ------
    ValueError
        Naming the line that is no field, or the type that is not defined.
    """
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
