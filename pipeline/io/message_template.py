"""Where the numbers of a ROS message lie, found on one message and proven for others.

Only texts and sequences make the places vary, and each sends its length before it. A template is one message, walked by
its definition: the places of its numbers, and the bytes that fix them (the encapsulation, every length, every text).
Another message of the same length that agrees in those bytes has its numbers in the same places.

    CDR (ROS 2): 4 bytes of encapsulation; a number of size s lies at a multiple of s, counted from after them;
                 a text is a 4-byte length with its closing zero
    ROS 1      : nothing is aligned, no encapsulation, no closing zero

Recursion cannot end in a message that holds itself: its definition would be infinite, so that the walk is bounded.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from pipeline.io.message_definition import NUMBERS, STRING

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.io.mcap_chunk import Rows
    from pipeline.io.message_definition import Definitions, Field

ENCAPSULATION = 4
LITTLE_ENDIAN = b"\x00\x01\x00\x00"
BIG_ENDIAN = b"\x00\x00"
DEEPEST = 32  # types within types
MOST_FIELDS = 100_000  # of one message; a definition of arrays of arrays of nothing would have no end


@dataclass(frozen=True)
class Place:
    """Where a number lies: byte of the message, numpy's type, and how many of them, None for a single one."""

    offset: int
    code: str
    count: int | None


@dataclass
class Template:
    """The layout of one message.

    Attributes
    ----------
    sample : bytes
    places : dict of str to Place
        Path (``linear_acceleration.x``) to where it lies.
    texts : dict of str to str or list of str
        Path to the sample's text.
    fixed : list of (start, end)
        Bytes that have to be those of the sample.
    """

    sample: bytes
    places: dict[str, Place] = field(default_factory=dict)
    texts: dict[str, str | list[str]] = field(default_factory=dict)
    fixed: list[tuple[int, int]] = field(default_factory=list)

    def suits(self, rows: Rows) -> bool:
        """Return whether all messages have their numbers where the sample has them."""
        size = len(self.sample)
        if not (rows.sizes == size).all():
            return False
        merged = _merged(self.fixed)
        names = [f"f{i}" for i in range(len(merged))]
        layout = np.dtype(
            {
                "names": names,
                "formats": [f"V{end - start}" for start, end in merged],
                "offsets": [start for start, _ in merged],
                "itemsize": size,
            }
        )
        table = rows.table(layout)
        return all(
            _all_equal(table[name], self.sample[start:end]) for name, (start, end) in zip(names, merged, strict=True)
        )

    def columns(self, rows: Rows, wanted: dict[str, tuple[int, str]]) -> dict[str, NDArray[np.generic]]:
        """Return numbers of all messages: name to (offset, type) becomes name to column, a copy."""
        layout = np.dtype(
            {
                "names": list(wanted),
                "formats": [code for _, code in wanted.values()],
                "offsets": [offset for offset, _ in wanted.values()],
                "itemsize": len(self.sample),
            }
        )
        table = rows.table(layout)
        return {name: table[name].copy() for name in wanted}


def _merged(spans: list[tuple[int, int]]) -> list[tuple[int, int]]:
    merged: list[tuple[int, int]] = []
    for start, end in spans:
        if start == end:
            continue
        if merged and merged[-1][1] == start:
            merged[-1] = (merged[-1][0], end)
        else:
            merged.append((start, end))
    return merged


def _all_equal(column: NDArray[np.void], expected: bytes) -> bool:
    """Compare bytes of all messages, in words of up to 8 bytes."""
    size = len(expected)
    start = 0
    for width in (8, 4, 2, 1):
        while size - start >= width:
            word = np.dtype({"names": ["w"], "formats": [f"<u{width}"], "offsets": [start], "itemsize": size})
            if (column.view(word)["w"] != int.from_bytes(expected[start : start + width], "little")).any():
                return False
            start += width
    return True


def find_template(root: str, definitions: Definitions, sample: bytes, *, cdr: bool) -> Template:
    """Walk one message by its definition.

    Parameters
    ----------
    root : str
        Type of the message.
    definitions : Definitions
    sample : bytes
    cdr : bool
        Whether it is CDR of either byte order, else ROS 1.

    Raises
    ------
    ValueError
        If the message does not have the bytes that its definition needs, neither more nor less.
    """
    walk = _SampleWalk(definitions, sample, cdr=cdr)
    walk.message(root, "", 0)
    if walk.at != len(sample):
        raise ValueError(f"it has {len(sample)} bytes where {root} needs {walk.at}")
    return walk.template


class _SampleWalk:
    """The walk over one message."""

    def __init__(self, definitions: Definitions, sample: bytes, *, cdr: bool) -> None:
        self.definitions, self.sample, self.cdr = definitions, sample, cdr
        self.template = Template(sample)
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
            self.template.fixed.append((start, end))
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
        self.template.places[path] = Place(self.at, self.order + code, count)
        self.take(size * many)

    def count(self) -> None:
        self.steps += 1
        if self.steps > MOST_FIELDS:
            raise ValueError(f"it has more than {MOST_FIELDS} fields")

    def message(self, key: str, prefix: str, depth: int) -> None:
        if depth > DEEPEST:
            raise ValueError(f"{key} is defined by itself")
        self.count()
        fields = self.definitions[key]
        if not fields and self.cdr:
            self.take(1)  # an empty message is sent as one byte
        for item in fields:
            self.field(item, prefix + item.name, depth)

    def field(self, item: Field, path: str, depth: int) -> None:
        self.count()
        count = self.length() if item.sequence else item.count
        if count is not None and count > len(self.sample):
            raise ValueError(f"{path} claims {count} elements in a message of {len(self.sample)} bytes")
        if item.type in NUMBERS:
            self.numbers(path, item.type, count)
        elif item.type == STRING:
            self.template.texts[path] = self.text() if count is None else [self.text() for _ in range(count)]
        elif count is None:
            self.message(item.type, f"{path}.", depth + 1)
        else:
            for index in range(count):
                self.message(item.type, f"{path}[{index}].", depth + 1)
