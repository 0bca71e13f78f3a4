"""Records of an MCAP file, their bytes to values; no length that a record claims is believed.

    record = opcode (1 byte) | length (8 bytes) | content (length bytes)

All numbers are little-endian; a string is its length (4 bytes) and UTF-8 text. Content may be longer than what is known
of it (later versions of the format). The values are those of the official library, ``mcap.records``.
"""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING

import numpy as np
from mcap.records import Attachment, Channel, Footer, Header, Metadata, Schema, Statistics

if TYPE_CHECKING:
    from numpy.typing import NDArray

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = 1, 2, 3, 4, 5, 6, 7, 8
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(9, 16)
IN_DATA = frozenset({HEADER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, ATTACHMENT, METADATA, DATA_END})
IN_SUMMARY = frozenset(
    {SCHEMA, CHANNEL, CHUNK_INDEX, ATTACHMENT_INDEX, STATISTICS, METADATA_INDEX, SUMMARY_OFFSET, FOOTER}
)
RECORD_HEAD = 9  # bytes of opcode and length
MESSAGE_HEAD = 22  # bytes of a message before its data
INDEX_ENTRY = 16  # bytes of a time and an offset


class Cursor:
    """Values of a record's content, one after the other.

    Raises ``ValueError`` where the content is too short or a text is no UTF-8.
    """

    def __init__(self, data: bytes | memoryview) -> None:
        self.data = memoryview(data)
        self.at = 0

    def take(self, count: int) -> memoryview:
        """Return the next bytes."""
        end = self.at + count
        if end > len(self.data):
            raise ValueError(f"{count} bytes are claimed where {len(self.data) - self.at} are left")
        part = self.data[self.at : end]
        self.at = end
        return part

    def number(self, size: int) -> int:
        """Return the next unsigned integer of so many bytes."""
        return int.from_bytes(self.take(size), "little")

    def text(self) -> str:
        """Return the next string."""
        return bytes(self.take(self.number(4))).decode("utf-8")

    def texts(self) -> dict[str, str]:
        """Return the next map of strings."""
        inner = Cursor(self.take(self.number(4)))
        found = {}
        while inner.at < len(inner.data):
            key = inner.text()
            found[key] = inner.text()
        return found


def header(content: bytes) -> Header:
    """Return the file's header."""
    cursor = Cursor(content)
    return Header(profile=cursor.text(), library=cursor.text())


def schema(content: bytes | memoryview) -> Schema:
    """Return a message definition."""
    cursor = Cursor(content)
    number, name, encoding = cursor.number(2), cursor.text(), cursor.text()
    return Schema(id=number, name=name, encoding=encoding, data=bytes(cursor.take(cursor.number(4))))


def channel(content: bytes | memoryview) -> Channel:
    """Return a channel."""
    cursor = Cursor(content)
    number, definition, topic = cursor.number(2), cursor.number(2), cursor.text()
    return Channel(
        id=number, schema_id=definition, topic=topic, message_encoding=cursor.text(), metadata=cursor.texts()
    )


def attachment(content: bytes) -> Attachment:
    """Return an attachment whose checksum is right (or 0, not given)."""
    cursor = Cursor(content)
    log_time, create_time, name, media_type = cursor.number(8), cursor.number(8), cursor.text(), cursor.text()
    data = bytes(cursor.take(cursor.number(8)))
    crc = zlib.crc32(cursor.data[: cursor.at])
    if cursor.number(4) not in (0, crc):
        raise ValueError(f"the checksum of attachment {name!r} is wrong")
    return Attachment(create_time=create_time, log_time=log_time, name=name, media_type=media_type, data=data)


def metadata(content: bytes) -> Metadata:
    """Return a record of free texts."""
    cursor = Cursor(content)
    return Metadata(name=cursor.text(), metadata=cursor.texts())


def statistics(content: bytes) -> Statistics:
    """Return what the summary says is in the file."""
    cursor = Cursor(content)
    sizes = {
        "message_count": 8,
        "schema_count": 2,
        "channel_count": 4,
        "attachment_count": 4,
        "metadata_count": 4,
        "chunk_count": 4,
        "message_start_time": 8,
        "message_end_time": 8,
    }
    numbers = {name: cursor.number(size) for name, size in sizes.items()}
    inner = Cursor(cursor.take(cursor.number(4)))
    counts = {}
    while inner.at < len(inner.data):
        key = inner.number(2)
        counts[key] = inner.number(8)
    return Statistics(channel_message_counts=counts, **numbers)


def footer(content: bytes) -> Footer:
    """Return the footer."""
    cursor = Cursor(content)
    return Footer(summary_start=cursor.number(8), summary_offset_start=cursor.number(8), summary_crc=cursor.number(4))


def message_index(content: bytes) -> tuple[int, NDArray[np.int64]]:
    """Return a channel and the offsets of its messages in the chunk before."""
    cursor = Cursor(content)
    number, size = cursor.number(2), cursor.number(4)
    entries = np.frombuffer(cursor.take(size - size % INDEX_ENTRY), "<u8").reshape(-1, 2)
    if size % INDEX_ENTRY or (entries[:, 1] > np.iinfo(np.int64).max).any():
        raise ValueError("an index of messages is no list of times and offsets")
    return number, entries[:, 1].astype(np.int64)
