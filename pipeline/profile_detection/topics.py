"""The topics of an unknown log of messages: in lines for a person, and as layouts of columns.

The layouts serve to propose a profile only, which is never applied unasked.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import IngestError
from pipeline.io.field_path import STAMPS
from pipeline.io.files import MESSAGE_FORMATS
from pipeline.io.mcap_channels import KINDS, STATED
from pipeline.io.mcap_reader import McapReader
from pipeline.io.message_decoder import object_decoder, ros_layouts
from pipeline.io.message_layout import short_name
from pipeline.io.message_logs import open_reader
from pipeline.profile_detection.columns import FEWEST_ROWS, MOST_ROWS, TextLayout, find_columns

if TYPE_CHECKING:
    from collections.abc import Iterator

    from mcap.records import Channel, Schema

    from pipeline.io.mcap_chunk import Rows
    from pipeline.io.mcap_reader import MessageReader

LONGEST_ARRAY = 16  # elements of a field that may be readings
LONGEST_LIST = 4  # elements listed of an array
MOST_FIELDS = 24  # listed of a message
MOST_TOPICS = 20  # listed one a line


@dataclass(frozen=True)
class TopicLayout(TextLayout):
    """The fields of a topic as columns. ``fields`` are their paths; ``names`` have the unit that the file states."""

    topic: str = ""
    fields: tuple[str, ...] = ()
    rows: int = 0

    def key(self, index: int) -> str | int:
        """Return the path of a field."""
        return self.fields[index]


def topics_of(path: Path) -> list[TopicLayout]:
    """Return the topics of a log with their first messages; refuse a log none of whose topics may hold readings."""
    found: dict[int, TopicLayout] = {}
    listed = []
    with open_reader(path) as reader:
        for rows in reader.rows():
            if rows.channel not in found and (layout := _layout(reader, rows)) is not None:
                found[rows.channel] = layout
        listed = [f"{c.topic} ({reader.counts[n]})" for n, c in reader.channels.items()]
    best = sorted(found.values(), key=lambda t: (-len(find_columns(t).triads), -t.rows))
    if not best or not find_columns(best[0]).triads:
        message = f"no topic holds the three axes of a sensor; the file has {', '.join(listed) or 'no topics'}"
        raise IngestError(message, str(path), code="no_table")
    return best


def _layout(reader: MessageReader, rows: Rows) -> TopicLayout | None:
    """Return the numbers of a topic's messages; None where they are too few, vary in length or are no arrays."""
    channel = reader.channels[rows.channel]
    try:
        find = ros_layouts(channel, reader.schemas.get(channel.schema_id))
        layout = find(rows.payload(0)) if find is not None and len(rows.starts) >= FEWEST_ROWS else None
    except (ValueError, KeyError):  # a definition that is none, or a message that is not what it says
        return None
    if layout is None or not layout.places or not layout.matches(rows):
        return None
    found = layout.columns(rows, layout.elements(LONGEST_ARRAY))
    columns: dict[str, Any] = {n: c[:MOST_ROWS].astype(np.float64) for n, c in found.items()}
    for seconds, nanos in STAMPS:
        for base in [n.removesuffix(f".{seconds}") for n in columns if n.endswith(f".{seconds}")]:
            if f"{base}.{nanos}" in columns:
                columns[base] = columns.pop(f"{base}.{seconds}") + columns.pop(f"{base}.{nanos}") / 1e9
    fields = tuple(columns)
    stated = [channel.metadata.get(STATED + f.partition("[")[0], "") for f in fields]
    names = [f"{f} [{unit}]" if unit else f for f, unit in zip(fields, stated, strict=True)]
    numbers = {i: columns[f] for i, f in enumerate(fields) if np.isfinite(columns[f]).all()}
    return TopicLayout(
        reader.path, ",", ".", 0, True, None, names, numbers, None, "", 0,  # noqa: FBT003  (fields of a text's layout)
        topic=channel.topic, fields=fields, rows=len(rows.starts),
    )  # fmt: skip


def topic_lines(path: Path, *, fields: bool) -> list[tuple[str, str]]:
    """Return what a log of messages holds, as pairs of label and text; nothing where it cannot be walked through.

    ``fields``: whether the fields of messages of types that ingest does not know are listed.
    """
    first: dict[int, bytes] = {}
    try:
        with open_reader(path) as found:
            for rows in found.rows():
                if rows.channel not in first:
                    first[rows.channel] = rows.payload(0)
    except (IngestError, OSError):
        return []
    lines = [("container", _container(found))]
    if len(found.channels) > MOST_TOPICS:
        return [*lines, ("topics", ", ".join(f"{c.topic} ({found.counts[n]})" for n, c in found.channels.items()))]
    for number, channel in found.channels.items():
        schema = found.schemas.get(channel.schema_id)
        kind = f"{schema.name}, {channel.message_encoding}" if schema else channel.message_encoding or "no encoding"
        text = f"{channel.topic} ({kind}): {counted(found.counts[number], 'message')}"
        if fields and number in first and not (schema and short_name(schema.name) in KINDS):
            text += _fields(channel, schema, first[number])
        lines.append(("topic", text))
    return lines


def _container(reader: MessageReader) -> str:
    """Return the size of a log of messages, and whether it proves to be complete."""
    size, proof = counted(reader.count, "message"), "integrity: not_verifiable, without checksums"
    if not isinstance(reader, McapReader):
        return f"{MESSAGE_FORMATS[Path(reader.path).suffix.lower()].kind} with {size}; {proof}"
    library = f", written by {reader.header.library}" if reader.header and reader.header.library else ""
    proof = "every checksum and count verified" if reader.verified else proof
    return f"{size} in {counted(len(reader.chunks), 'chunk')}{library}; {proof}"


def counted(number: int, what: str) -> str:
    """Return a number of things in words."""
    return f"{number:,} {what}{'s'[: number != 1]}"


def _fields(channel: Channel, schema: Schema | None, payload: bytes) -> str:
    """Return the paths of a message's numbers, for a map of fields."""
    try:
        paths = list(islice(_paths(channel, schema, payload), MOST_FIELDS + 1))
    except Exception:  # noqa: BLE001  (any decoder's trouble with a stranger's message: then nothing is listed)
        return ""
    more = " .." if len(paths) > MOST_FIELDS else ""
    return f", with {', '.join(paths[:MOST_FIELDS])}{more}" if paths else ""


def _paths(channel: Channel, schema: Schema | None, payload: bytes) -> Iterator[str]:
    """Yield the paths of the numbers in a message of any encoding."""
    if find_layout := ros_layouts(channel, schema):
        yield from find_layout(payload).elements(LONGEST_LIST)
    else:
        decode = object_decoder(channel, schema)
        yield from _numbers(decode(payload) if decode else {}, "")


def _numbers(value: Any, path: str) -> Iterator[str]:  # noqa: ANN401  (a message of any decoder)
    """Yield the paths of the numbers in a decoded message."""
    if isinstance(value, bool | str | bytes):
        return
    if hasattr(value, "__float__"):
        yield path
        return
    if hasattr(value, "DESCRIPTOR"):
        children = {f.name: getattr(value, f.name) for f in value.DESCRIPTOR.fields}
    elif isinstance(value, dict):
        children = value
    elif hasattr(value, "__len__"):
        for index in range(min(len(value), LONGEST_LIST)):
            yield from _numbers(value[index], f"{path}[{index}]")
        return
    else:
        children = getattr(value, "__dict__", {})
    for name, child in children.items():
        yield from _numbers(child, f"{path}.{name}" if path else name)
