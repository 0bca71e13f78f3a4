"""Parse records of an MCAP file with the official library; unpack chunks and split them into messages.

A run of records (a chunk, or the messages between chunks) is split by following the lengths from record to record:

    start_0 = 0,   start_{i+1} = start_i + 9 + length_i,   and the last record ends where the run ends

If all records have one length, the starts are an arithmetic series. If the file has an index, they are its offsets.
Else the lengths are followed one by one. numpy checks the first two with the rule above, so that a wrong index has no
effect.

The library returns short data if a length is too large, ignores contradicting lengths, does not check the checksum of
attachments, and reads an index entry by entry. Here such records are refused, and an index is read as an array.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field, replace
from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Attachment, Chunk
from numpy.lib.stride_tricks import sliding_window_view

if TYPE_CHECKING:
    from collections.abc import Iterable

    from mcap.records import McapRecord
    from numpy.typing import NDArray

    from pipeline.records import Index, Integers

MAGIC = b"\x89MCAP0\r\n"
RECORD_HEAD = 9  # bytes of opcode and length
INDEX_ENTRY = 16  # bytes of a time and an offset
LARGEST_CHUNK = 1 << 30  # bytes; recorders write about 1 MiB
LARGEST_EXPANSION = 1000  # times; lz4 reaches 255 at most
ALWAYS_ALLOWED = 1 << 24  # bytes; a small chunk of equal bytes packs better than any log
MESSAGE_HEAD = 22  # bytes of a message before its data
HEAD = np.dtype({
    "names": ["opcode", "length", "channel", "sequence", "log_time", "publish_time"],
    "formats": ["u1", "<u8", "<u2", "<u4", "<u8", "<u8"],
    "offsets": [0, 1, 9, 11, 15, 23],
    "itemsize": RECORD_HEAD + MESSAGE_HEAD,
})  # fmt: skip
_RECORD, _HEAD = struct.Struct("<BQ"), struct.Struct("<BQH")


@dataclass
class ChannelMessages:
    """The messages of one channel in one run."""

    channel: int
    data: NDArray[np.uint8]  # all records of the run
    heads: NDArray[np.void]  # ``HEAD`` of each message
    starts: Integers  # offset of each message's payload in ``data``
    sizes: Integers  # of the payloads, bytes
    stride: int  # distance between the starts if it is constant, else 0
    place: str  # name of the run, for messages to the user: ``chunk 3``
    offset: int  # byte of the file at which the run begins

    def payload(self, row: int) -> bytes:
        """Return the data of one message."""
        start = int(self.starts[row])
        return self.data[start : start + int(self.sizes[row])].tobytes()

    def select(self, rows: Index) -> ChannelMessages:
        """Select messages by their indices, in increasing order."""
        if len(rows) == len(self.starts):
            return self
        return replace(self, heads=self.heads[rows], starts=self.starts[rows], sizes=self.sizes[rows], stride=0)

    def table(self, layout: np.dtype[np.void]) -> NDArray[np.void]:
        """Return all messages as an array of a structured type; they must have the size of that type."""
        if self.stride:
            return np.ndarray(len(self.starts), layout, self.data.data, int(self.starts[0]), (self.stride,))
        windows = sliding_window_view(self.data, layout.itemsize)[self.starts]
        return np.asarray(windows.view(layout)[:, 0])


@dataclass
class Run:
    """Records of the data section: up to and including the messages of one chunk, or messages between chunks.

    ``index``: channel to the offsets of its messages in ``data`` by the file's index, which may be wrong. ``records``:
    (head, content) of each record as in the file, without messages outside chunks.
    """

    offset: int = 0  # byte of the file at which the chunk, or the first message outside chunks, begins
    name: str = ""  # for messages
    data: bytes | memoryview = b""  # the chunk's records, or the messages
    loose: bool = False  # whether the messages lie outside chunks
    index: dict[int, Integers] = field(default_factory=dict)
    records: list[tuple[bytes, bytes]] = field(default_factory=list)
    rows: list[ChannelMessages] = field(default_factory=list)  # the messages of each channel


def unpack(content: bytes, expected: int, compression: str) -> bytes | memoryview:
    """Decompress the records of a chunk, ``expected`` bytes by its head; compression is empty, ``zstd`` or ``lz4``.

    Raises ``ValueError`` for a size that is too large for any log, before memory is allocated.
    """
    if expected > min(LARGEST_CHUNK, max(ALWAYS_ALLOWED, LARGEST_EXPANSION * len(content))):
        raise ValueError(f"a chunk claims to hold {expected} bytes, packed into {len(content)}: damaged, or no log")
    data: bytes | memoryview
    if compression == "zstd":
        import zstandard  # noqa: PLC0415

        promised = zstandard.get_frame_parameters(content).content_size
        if promised not in (expected, zstandard.CONTENTSIZE_UNKNOWN):
            raise ValueError(f"a chunk claims to hold {expected} bytes, and its zstd frame says {promised}")
        data = zstandard.ZstdDecompressor().decompress(content, max_output_size=max(1, expected)) if expected else b""
    elif compression == "lz4":
        import lz4.frame  # noqa: PLC0415

        unpacker = lz4.frame.LZ4FrameDecompressor()
        data = unpacker.decompress(content, max_length=expected + 1) if expected else b""
    elif compression == "":
        data = content
    else:
        raise ValueError(f"a chunk is packed with {compression!r}; zstd, lz4 and none are supported")
    if len(data) != expected:
        raise ValueError(f"a chunk claims to hold {expected} bytes and holds {len(data)}")
    return data


def split(run: Run) -> tuple[list[tuple[int, memoryview]], list[ChannelMessages]]:
    """Split a run into its messages; return the other records (opcode, content), and the messages by channel.

    Raises ``ValueError`` if the records do not fill the run exactly.
    """
    data = np.frombuffer(run.data, np.uint8)
    leading, others = _followed(run.data, 0, stop_at_message=True)
    if not leading.size:
        return others, []
    first = int(leading[0])
    whole = _alike(run, data, first)
    if whole is not None:
        return others, [whole]
    starts = _indexed(run, data, first)
    if starts is None:
        starts, more = _followed(run.data, first)
        others += more
    heads = _heads(data, starts)
    rows = []
    for channel in np.unique(heads["channel"]).tolist():
        mask = heads["channel"] == channel
        sizes = heads["length"][mask].astype(np.int64) - MESSAGE_HEAD
        rows.append(
            ChannelMessages(channel, data, heads[mask], starts[mask] + HEAD.itemsize, sizes, 0, run.name, run.offset)
        )
    return others, rows


def _followed(
    data: bytes | memoryview, start: int, *, stop_at_message: bool = False
) -> tuple[Integers, list[tuple[int, memoryview]]]:
    """Follow the lengths from record to record; return the starts of the messages, and the other records."""
    view, end, starts, others = memoryview(data), len(data), [], []
    while start < end:
        if start + RECORD_HEAD > end:
            raise ValueError(f"{end - start} bytes are left after the last record of a chunk")
        opcode, length = _RECORD.unpack_from(view, start)
        after = start + RECORD_HEAD + length
        if after > end or opcode == 0 or (opcode == Opcode.MESSAGE and length < MESSAGE_HEAD):
            raise ValueError(f"a record of kind {opcode} with {length} bytes does not fit at byte {start} of a chunk")
        if opcode == Opcode.MESSAGE:
            starts.append(start)
            if stop_at_message:
                break
        else:
            others.append((opcode, view[start + RECORD_HEAD : after]))
        start = after
    return np.array(starts, np.int64), others


def _alike(run: Run, data: NDArray[np.uint8], first: int) -> ChannelMessages | None:
    """Return the messages if all records from the first message on have one channel and one length, else None."""
    _, length, channel = _HEAD.unpack_from(run.data, first)
    stride = RECORD_HEAD + length
    count, rest = divmod(len(data) - first, stride)
    if rest:
        return None
    heads = np.ndarray(count, HEAD, data.data, first, (stride,))
    if not ((heads["opcode"] == Opcode.MESSAGE) & (heads["length"] == length) & (heads["channel"] == channel)).all():
        return None
    starts = first + HEAD.itemsize + stride * np.arange(count, dtype=np.int64)
    return ChannelMessages(
        channel, data, heads, starts, np.full(count, length - MESSAGE_HEAD), stride, run.name, run.offset
    )


def _indexed(run: Run, data: NDArray[np.uint8], first: int) -> Integers | None:
    """Return the starts by the index if the lengths of the records confirm them, else None."""
    if not run.index:
        return None
    starts = np.sort(np.concatenate(list(run.index.values())))
    if not (len(starts) and starts[0] == first and starts[-1] + HEAD.itemsize <= len(data)):
        return None
    heads = _heads(data, starts)
    fitting = (heads["opcode"] == Opcode.MESSAGE) & (heads["length"] >= MESSAGE_HEAD) & (heads["length"] <= len(data))
    ends = starts + RECORD_HEAD + heads["length"].astype(np.int64)
    return starts if fitting.all() and np.array_equal(ends, np.append(starts[1:], len(data))) else None


def _heads(data: NDArray[np.uint8], starts: Integers) -> NDArray[np.void]:
    return np.asarray(sliding_window_view(data, HEAD.itemsize)[starts].view(HEAD)[:, 0])


class _Content(ReadDataStream):
    """The content of a record; the stream of the library returns short data at its end without an error."""

    def read(self, length: int) -> bytes:
        data = self._stream.read(length)
        if len(data) < length:
            raise ValueError(f"{length} bytes are claimed where {len(data)} are left")
        self._count += length
        return data


def parsed(kind: Any, content: bytes | memoryview) -> Any:  # noqa: ANN401  (a class of the library, its record)
    """Parse the content of a record; it may be longer, because later versions of the format append fields.

    Raises ``ValueError`` if it is too short, a text is not UTF-8, or its lengths contradict each other.
    """
    record = kind.read(_Content(BytesIO(content)))
    if kind is not Chunk and not bytes(content).startswith(bytes_of([record])[RECORD_HEAD:]):
        raise ValueError(f"the lengths within a {kind.__name__} record contradict each other")
    return record


def attachment(content: bytes) -> Attachment:
    """Parse an attachment; raise ``ValueError`` if its checksum is neither right nor 0 (not computed)."""
    record: Attachment = Attachment.read(_Content(BytesIO(content)))
    written = bytes_of([record])[RECORD_HEAD:]  # with the right checksum, in its last four bytes
    body, crc = content[: len(written) - 4], content[len(written) - 4 : len(written)]
    if body != written[:-4] or crc not in {bytes(4), written[-4:]}:
        raise ValueError(f"the checksum of attachment {record.name!r} is wrong")
    return record


def bytes_of(records: Iterable[McapRecord]) -> bytes:
    """Return the bytes of records in a file."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


def message_index(content: bytes) -> tuple[int, Integers]:
    """Parse a message index: a channel, and the offsets of its messages in the preceding chunk.

    Raises ``ValueError`` if it is not an index.
    """
    number, size = struct.unpack_from("<HI", content)
    body = content[6 : 6 + size]
    if len(body) < size or size % INDEX_ENTRY:
        raise ValueError("an index of messages is no list of times and offsets")
    offsets = np.frombuffer(body, "<u8").reshape(-1, 2)[:, 1]
    if (offsets > np.iinfo(np.int64).max).any():
        raise ValueError("an index of messages has an offset beyond 63 bits")
    return number, offsets.astype(np.int64)
