"""What topics an MCAP file holds, and for types that ingest does not know the fields of their first message."""

from __future__ import annotations

from itertools import islice
from typing import TYPE_CHECKING, Any

from pipeline.errors import IngestError
from pipeline.io.mcap_channels import KINDS
from pipeline.io.mcap_reader import McapReader
from pipeline.io.message_decoder import object_decoder, ros_layouts
from pipeline.io.message_layout import short_name

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from mcap.records import Channel, Schema

MOST_FIELDS = 24  # listed of a message
LONGEST_LIST = 4  # elements listed of an array


def topic_lines(path: Path, *, fields: bool) -> list[tuple[str, str]]:
    """Return what an MCAP file holds, as pairs of label and text; nothing where it cannot be walked through.

    ``fields``: whether the fields of messages of types that ingest does not know are listed.
    """
    first: dict[int, bytes] = {}
    try:
        with path.open("rb") as stream:
            found = McapReader(stream, str(path))
            for rows in found.rows():
                if rows.channel not in first:
                    first[rows.channel] = rows.payload(0)
    except (IngestError, OSError):
        return []
    library = f", written by {found.header.library}" if found.header and found.header.library else ""
    proof = "every checksum and count verified" if found.verified else "integrity: not_verifiable, without checksums"
    size = f"{counted(found.count, 'message')} in {counted(len(found.chunks), 'chunk')}"
    lines = [("container", f"{size}{library}; {proof}")]
    for number, channel in found.channels.items():
        schema = found.schemas.get(channel.schema_id)
        kind = f"{schema.name}, {channel.message_encoding}" if schema else channel.message_encoding or "no encoding"
        text = f"{channel.topic} ({kind}): {counted(found.counts[number], 'message')}"
        if fields and number in first and not (schema and short_name(schema.name) in KINDS):
            text += _fields(channel, schema, first[number])
        lines.append(("topic", text))
    return lines


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
    find_layout = ros_layouts(channel, schema)
    if find_layout is None:
        decode = object_decoder(channel, schema)
        yield from _numbers(decode(payload) if decode else {}, "")
        return
    for path, place in find_layout(payload).places.items():
        if place.count is None:
            yield path
        else:
            yield from (f"{path}[{i}]" for i in range(min(place.count, LONGEST_LIST)))


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
