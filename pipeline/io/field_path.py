"""Paths to numbers in messages: ``linear_acceleration.x``, ``acc[0]``, ``samples[2].value``, ``position[table]``.

``[2]`` counts from 0. ``[table]`` is the element whose name, in the field ``name`` of the same message, is ``table``
(sensor_msgs/JointState); ``[*]`` is the only element. A path to a time ends at a message with seconds and nanoseconds.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from decimal import Decimal
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pipeline.io.message_layout import MessageLayout, Place

ONLY = "*"
NAMES = "name"
STAMPS = (("sec", "nanosec"), ("secs", "nsecs"), ("seconds", "nanos"), ("sec", "nsec"))
_STEP = re.compile(r"([^.\[\]]+)((?:\[\d+\])*)")
_LAST = re.compile(r"(.*?)(?:\[([^\[\]]+)\])?")


@dataclass(frozen=True)
class FieldPath:
    """A path: its text, the base without the last index, and that index (a number, a name, ``*``, or None)."""

    text: str
    base: str
    index: int | str | None

    @classmethod
    def parse(cls, text: str) -> FieldPath:
        """Parse a path; raise ``ValueError`` if it is invalid."""
        match = _LAST.fullmatch(text)
        base, last = match.groups() if match else ("", None)
        if not all(_STEP.fullmatch(part) for part in base.split(".")):
            raise ValueError(f"{text!r} is no path to a field, such as linear_acceleration.x or position[table]")
        return cls(text, base, int(last) if last is not None and last.isdigit() else last)

    @property
    def steps(self) -> list[str | int]:
        """Names and indices of the base, in order."""
        found: list[str | int] = []
        for part in self.base.split("."):
            name, _, rest = part.partition("[")
            found.append(name)
            found += [int(i) for i in re.findall(r"\d+", rest)]
        return found

    @property
    def names(self) -> FieldPath:
        """Path to the list of names in the same message as the numbers."""
        parent = self.base.rpartition(".")[0]
        base = f"{parent}.{NAMES}" if parent else NAMES
        return FieldPath(base, base, None)


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
