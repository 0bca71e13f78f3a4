"""The topics of an unknown log of messages, as layouts of columns, and the one that holds the readings.

It is used to propose a profile only and is never applied unasked.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import IngestError
from pipeline.io.field_path import STAMPS
from pipeline.io.mcap_channels import STATED
from pipeline.io.message_decoder import ros_layouts
from pipeline.io.message_logs import open_reader
from pipeline.profile_detection.columns import FEWEST_ROWS, MOST_ROWS, TextLayout, find_columns

if TYPE_CHECKING:
    from pathlib import Path

    from pipeline.io.mcap_channels import AnyReader
    from pipeline.io.mcap_chunk import Rows

LONGEST_ARRAY = 16  # elements of a field that may be readings


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


def _layout(reader: AnyReader, rows: Rows) -> TopicLayout | None:
    """Return the numbers of a topic's messages; None where they are too few, vary in length or are no arrays."""
    channel = reader.channels[rows.channel]
    try:
        find = ros_layouts(channel, reader.schemas.get(channel.schema_id))
        layout = find(rows.payload(0)) if find is not None and len(rows.starts) >= FEWEST_ROWS else None
    except (ValueError, KeyError):  # a definition that is none, or a message that is not what it says
        return None
    if layout is None or not layout.places or not layout.matches(rows):
        return None
    places: dict[str, tuple[int, str]] = {}
    for name, place in layout.places.items():
        elements = [""] if place.count is None else [f"[{i}]" for i in range(min(place.count, LONGEST_ARRAY))]
        size = int(place.code[2:])
        places |= {name + e: (place.offset + i * size, place.code) for i, e in enumerate(elements)}
    columns: dict[str, Any] = {n: c[:MOST_ROWS].astype(np.float64) for n, c in layout.columns(rows, places).items()}
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
