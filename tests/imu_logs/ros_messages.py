"""Random ROS messages: definitions, values and their bytes by an independent library."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

if TYPE_CHECKING:
    from pathlib import Path

    from rosbags.typesys.store import Typestore

NUMBERS = ("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64")
NAME = "lab_msgs/msg/Sample"
INNER = "lab_msgs/msg/Inner"
FIRST_NS = 1_700_000_000_123_456_789
STEP_NS = 10_000_000


@dataclass(frozen=True)
class RandomField:
    """A field of a random definition: its type, and how many (0: one value, above: array, -1: sequence)."""

    kind: str
    count: int


@dataclass(frozen=True)
class RandomLog:
    """A log of random messages."""

    before: tuple[RandomField, ...]  # fields before the three that are read
    between: tuple[RandomField, ...]  # after the first of them
    inner: tuple[RandomField, ...]  # of a type within
    wanted: tuple[str, ...]  # types of the three fields that are read
    alike: bool  # whether texts and sequences have the same lengths in all messages
    messages: int
    seed: int
    chunk_size: int
    compression: CompressionType
    ros: int = 2
    little_endian: bool = True

    def fields(self) -> list[tuple[str, RandomField]]:
        named = [(f"before{i}", f) for i, f in enumerate(self.before)]
        for index, kind in enumerate(self.wanted):
            named.append((f"wanted{index}", RandomField(kind, 0)))
            if index == 0:
                named += [(f"between{i}", f) for i, f in enumerate(self.between)]
        return named

    def definition(self, *, store: Typestore) -> str:
        store.register(get_types_from_msg(lines(named_inner(self.inner)), INNER))
        store.register(get_types_from_msg("std_msgs/Header header\n" + lines(self.fields()), NAME))
        text: str = store.generate_msgdef(NAME, ros_version=self.ros)[0]
        return text

    def encoded(self) -> tuple[str, list[bytes]]:
        """Return the definition and the messages' bytes."""
        store = get_typestore(Stores.ROS2_HUMBLE if self.ros == 2 else Stores.ROS1_NOETIC)
        text = self.definition(store=store)
        out = []
        for index in range(self.messages):
            lengths = np.random.default_rng(self.seed if self.alike else self.seed + 1 + index)
            values = np.random.default_rng([self.seed, index])
            stamp = FIRST_NS + index * STEP_NS
            time = store.types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
            extra = {"seq": index} if self.ros == 1 else {}
            header = store.types["std_msgs/msg/Header"](stamp=time, frame_id=word(lengths), **extra)
            parts = {n: value_of(f, store, self.inner, lengths, values) for n, f in self.fields()}
            message = store.types[NAME](header=header, **parts)
            if self.ros == 2:
                data = store.serialize_cdr(message, NAME, little_endian=self.little_endian)
            else:
                data = store.serialize_ros1(message, NAME)
            out.append(bytes(data))
        return text, out

    def write(self, path: Path) -> None:
        """Write the log, with messages of another topic in between."""
        text, messages = self.encoded()
        with path.open("wb") as stream:
            writer = Writer(stream, chunk_size=self.chunk_size, compression=self.compression)
            writer.start(profile=f"ros{self.ros}")
            name = NAME if self.ros == 2 else NAME.replace("/msg/", "/")
            schema = writer.register_schema(name, f"ros{self.ros}msg", text.encode())
            channel = writer.register_channel("/sample", "cdr" if self.ros == 2 else "ros1", schema)
            other = writer.register_channel("/other", "json", 0)
            for index, data in enumerate(messages):
                stamp = FIRST_NS + index * STEP_NS
                writer.add_message(channel, stamp, data, stamp, index)
                if self.seed % 3 == 0:
                    writer.add_message(other, stamp, b"{}" * (index % 4), stamp)
            writer.finish()


def named_inner(inner: tuple[RandomField, ...]) -> list[tuple[str, RandomField]]:
    return [(f"part{i}", f) for i, f in enumerate(inner)]


def lines(named: list[tuple[str, RandomField]]) -> str:
    brackets = {0: "", -1: "[]"}
    return "".join(f"{f.kind}{brackets.get(f.count, f'[{f.count}]')} {n}  # a comment = 3\n" for n, f in named)


def word(lengths: np.random.Generator) -> str:
    return "".join(lengths.choice(list("abcé_")) for _ in range(lengths.integers(0, 9)))


def value_of(
    item: RandomField,
    store: Typestore,
    inner: tuple[RandomField, ...],
    lengths: np.random.Generator,
    values: np.random.Generator,
) -> Any:
    count = int(lengths.integers(0, 4)) if item.count == -1 else item.count
    if item.kind in NUMBERS:
        code = np.dtype(item.kind)
        if code.kind == "f":
            numbers = values.normal(size=max(1, count)).astype(code)
        else:
            limits = np.iinfo(code)
            numbers = values.integers(limits.min, limits.max, size=max(1, count), dtype=code, endpoint=True)
        return numbers[0].item() if item.count == 0 else numbers[:count]

    def one() -> Any:
        if item.kind == "string":
            return word(lengths)
        parts = {n: value_of(f, store, (), lengths, values) for n, f in named_inner(inner)}
        return store.types[INNER](**parts)

    return one() if item.count == 0 else [one() for _ in range(count)]
