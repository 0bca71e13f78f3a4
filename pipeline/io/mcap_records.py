"""Records of an MCAP file, bytes to values and back, by the official library.

The library returns short data where a length within a record is too large, ignores contradicting lengths, does not
compare the checksum of attachments, and reads an index entry by entry. Here such records are refused, and an index is
an array.
"""

from __future__ import annotations

import struct
from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.records import Attachment, Chunk

if TYPE_CHECKING:
    from collections.abc import Iterable

    from mcap.records import McapRecord
    from numpy.typing import NDArray

MAGIC = b"\x89MCAP0\r\n"
RECORD_HEAD = 9  # bytes of opcode and length
INDEX_ENTRY = 16  # bytes of a time and an offset


class _Content(ReadDataStream):
    """The content of a record; the library's own stream returns less than asked for at its end."""

    def read(self, length: int) -> bytes:
        data = self._stream.read(length)
        if len(data) < length:
            raise ValueError(f"{length} bytes are claimed where {len(data)} are left")
        self._count += length
        return data


def parsed(kind: Any, content: bytes | memoryview) -> Any:  # noqa: ANN401  (a class of the library, its record)
    """Return the record in a content, which may be longer: later versions of the format append to it.

    ``ValueError``: it is too short, a text is not UTF-8, or the lengths in it contradict each other.
    """
    record = kind.read(_Content(BytesIO(content)))
    if kind is not Chunk and not bytes(content).startswith(bytes_of([record])[RECORD_HEAD:]):
        raise ValueError(f"the lengths within a {kind.__name__} record contradict each other")
    return record


def attachment(content: bytes) -> Attachment:
    """Return an attachment; ``ValueError`` if its checksum is neither right nor 0 (not computed)."""
    record: Attachment = Attachment.read(_Content(BytesIO(content)))
    written = bytes_of([record])[RECORD_HEAD:]  # with the right checksum, in its last four bytes
    body, crc = content[: len(written) - 4], content[len(written) - 4 : len(written)]
    if body != written[:-4] or crc not in {bytes(4), written[-4:]}:
        raise ValueError(f"the checksum of attachment {record.name!r} is wrong")
    return record


def bytes_of(records: Iterable[McapRecord]) -> bytes:
    """Return records as they stand in a file."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


def message_index(content: bytes) -> tuple[int, NDArray[np.int64]]:
    """Return a channel and the offsets of its messages in the chunk before; ``ValueError`` if it is not an index."""
    number, size = struct.unpack_from("<HI", content)
    body = content[6 : 6 + size]
    if len(body) < size or size % INDEX_ENTRY:
        raise ValueError("an index of messages is no list of times and offsets")
    offsets = np.frombuffer(body, "<u8").reshape(-1, 2)[:, 1]
    if (offsets > np.iinfo(np.int64).max).any():
        raise ValueError("an index of messages has an offset beyond 63 bits")
    return number, offsets.astype(np.int64)
