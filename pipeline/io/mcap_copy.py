"""An MCAP file written anew from one that is read, every record of its data byte for byte, with messages added.

Chunks stay as they are packed; added messages stand in chunks of their own, each behind the chunk that it belongs to.
Messages that lie outside chunks are put into one, because readers that go by a file's index look into chunks only. The
summary is made anew: it says where everything lies now.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from typing import TYPE_CHECKING, Protocol

import numpy as np
from mcap.data_stream import RecordBuilder
from mcap.records import AttachmentIndex, ChunkIndex, DataEnd, Footer, MetadataIndex, Statistics, SummaryOffset

from pipeline.io import mcap_records as records
from pipeline.io.mcap_chunk import HEAD
from pipeline.io.mcap_walk import Walk

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from typing import BinaryIO

    from mcap.records import Channel, McapRecord, Metadata, Schema
    from numpy.typing import NDArray

    from pipeline.io.mcap_chunk import Rows
    from pipeline.io.mcap_container import Container

ZSTD_LEVEL = -3  # twice as fast as 1 on calibrated messages, and as small as the recorders' 3


class Sink(Protocol):
    """What bytes are written to."""

    def write(self, data: bytes | memoryview, /) -> object:
        """Write all of them."""


class CopyingWalk(Walk):
    """One pass over a file that copies it.

    Parameters
    ----------
    stream : binary file
        At its beginning.
    path : str
        For messages.
    copy : McapCopy
    on_run : callable
        Called with the messages of each run, when the run has been copied.
    allow_truncated : bool
    """

    def __init__(
        self,
        stream: BinaryIO,
        path: str,
        copy: McapCopy,
        on_run: Callable[[list[Rows]], None],
        *,
        allow_truncated: bool = False,
    ) -> None:
        super().__init__(stream, path, allow_truncated=allow_truncated)
        self.copy, self.on_run = copy, on_run
        self._in_data = True

    def absorb(self, *parts: bytes) -> None:
        """Count bytes as read, and copy the records of the data."""
        super().absorb(*parts)
        if len(parts) < 2 or not self._in_data:
            return
        self._in_data = parts[0][0] != records.DATA_END
        if self._in_data:
            self.copy.record(parts[0], parts[1], self.found)

    def _flush(self) -> Iterator[Rows]:
        loose = bool(self._loose)
        rows = list(super()._flush())
        if loose:
            self.copy.loose(rows)
        for each in rows:
            self.copy.count(each)
        if rows:
            self.on_run(rows)
        yield from rows


class McapCopy:
    """The file that is written.

    Parameters
    ----------
    out : file
        Empty; bytes are written to it in order.
    """

    def __init__(self, out: Sink) -> None:
        self.out = out
        self.position = self.crc = 0
        self.packing = ""  # of the last chunk
        self.counts: Counter[int] = Counter()
        self.times: list[int] = []
        self.chunks: list[ChunkIndex] = []
        self.attachments: list[AttachmentIndex] = []
        self.metadata: list[MetadataIndex] = []
        self._write(records.MAGIC)

    def _write(self, *parts: bytes | memoryview) -> None:
        for part in parts:
            self.out.write(part)
            self.crc = zlib.crc32(part, self.crc)
            self.position += len(part)

    def record(self, head: bytes, content: bytes, found: Container) -> None:
        """Copy a record of the data."""
        opcode, at, length = head[0], self.position, len(head) + len(content)
        if opcode == records.CHUNK:
            self._note_chunk(content, length)
        elif opcode == records.MESSAGE_INDEX and self.chunks:
            index = self.chunks[-1]
            index.message_index_offsets[int.from_bytes(content[:2], "little")] = at
            index.message_index_length += length
        elif opcode == records.ATTACHMENT:
            a = found.attachments[-1]
            self.attachments.append(
                AttachmentIndex(
                    offset=at, length=length, create_time=a.create_time, log_time=a.log_time,
                    data_size=len(a.data), name=a.name, media_type=a.media_type,
                )
            )  # fmt: skip
        elif opcode == records.METADATA:
            self.metadata.append(MetadataIndex(offset=at, length=length, name=found.metadata[-1].name))
        self._write(head, content)

    def _note_chunk(self, content: bytes, length: int) -> None:
        cursor = records.Cursor(content)
        start, end, size = cursor.number(8), cursor.number(8), cursor.number(8)
        cursor.take(4)
        self.packing = cursor.text()
        self.chunks.append(
            ChunkIndex(
                chunk_length=length, chunk_start_offset=self.position, compression=self.packing,
                compressed_size=cursor.number(8), message_start_time=start, message_end_time=end,
                message_index_offsets={}, message_index_length=0, uncompressed_size=size,
            )
        )  # fmt: skip

    def count(self, rows: Rows) -> None:
        """Count messages for the statistics."""
        self._count(rows.channel, rows.heads["log_time"])

    def _count(self, channel: int, times: NDArray[np.uint64]) -> None:
        if len(times):
            self.counts[channel] += len(times)
            self.times = [min([*self.times, int(times.min())]), max([*self.times, int(times.max())])]

    def loose(self, rows: list[Rows]) -> None:
        """Put messages that lay outside chunks into one."""
        data = bytes(rows[0].run.data)
        entries = {r.channel: (r.heads["log_time"], r.starts - HEAD.itemsize) for r in rows}
        self._chunk(data, entries)

    def add(self, table: NDArray[np.uint8] | list[bytes], before: Iterable[McapRecord], channel: int) -> None:
        """Add messages of one channel.

        Parameters
        ----------
        table : (n, size) array of uint8, or list of bytes
            Whole records.
        before : iterable of records
            Definitions that have to stand before them.
        channel : int
        """
        head = _bytes_of(before)
        if isinstance(table, np.ndarray):
            body: bytes | memoryview = table.data.cast("B")
            starts = table.shape[1] * np.arange(len(table))
            times = np.ndarray(len(table), HEAD, table.data, 0, (table.shape[1],))["log_time"]
        else:
            body = b"".join(table)
            starts = np.cumsum([0, *map(len, table)])[:-1]
            times = np.array([np.frombuffer(part, HEAD, 1)["log_time"][0] for part in table], np.uint64)
        self._chunk(head + body if head else body, {channel: (times, starts + len(head))})
        self._count(channel, times)

    def _chunk(
        self, data: bytes | memoryview, entries: dict[int, tuple[NDArray[np.uint64], NDArray[np.int64]]]
    ) -> None:
        """Write a chunk and its indexes."""
        times = np.concatenate([t for t, _ in entries.values()])
        packing = self.packing.encode()
        packed = _packed(data, self.packing)
        fields = struct.pack("<QQQI", times.min(), times.max(), len(data), zlib.crc32(data))
        content = fields + struct.pack("<I", len(packing)) + packing + struct.pack("<Q", len(packed))
        head = struct.pack("<BQ", records.CHUNK, len(content) + len(packed))
        self._note_chunk(content, len(head) + len(content) + len(packed))
        self._write(head, content, packed)
        index = self.chunks[-1]
        for channel, (log_times, starts) in entries.items():
            index.message_index_offsets[channel] = self.position
            table = np.stack([log_times.astype("<u8"), starts.astype("<u8")], axis=1).tobytes()
            body = struct.pack("<HI", channel, len(table)) + table
            self._write(struct.pack("<BQ", records.MESSAGE_INDEX, len(body)), body)
            index.message_index_length += records.RECORD_HEAD + len(body)

    def note(self, metadata: Metadata) -> None:
        """Add a record of metadata."""
        data = _bytes_of([metadata])
        self.metadata.append(MetadataIndex(offset=self.position, length=len(data), name=metadata.name))
        self._write(data)

    def finish(self, schemas: Iterable[Schema], channels: Iterable[Channel]) -> None:
        """Close the data and write the summary."""
        schemas, channels = list(schemas), list(channels)
        self._write(_bytes_of([DataEnd(data_section_crc=self.crc)]))
        start = self.position
        times = self.times or [0, 0]
        statistics = Statistics(
            attachment_count=len(self.attachments), channel_count=len(channels), schema_count=len(schemas),
            channel_message_counts=dict(self.counts), chunk_count=len(self.chunks), metadata_count=len(self.metadata),
            message_count=self.counts.total(), message_start_time=times[0], message_end_time=times[1],
        )  # fmt: skip
        groups: list[Sequence[McapRecord]] = [
            schemas,
            channels,
            [statistics],
            self.chunks,
            self.attachments,
            self.metadata,
        ]
        summary, offsets = b"", []
        for group in groups:
            data = _bytes_of(group)
            if data:
                place = start + len(summary)
                offsets.append(SummaryOffset(group_opcode=data[0], group_start=place, group_length=len(data)))
            summary += data
        offset_start = start + len(summary)
        summary += _bytes_of(offsets)
        head = struct.pack("<BQQQ", records.FOOTER, 20, start, offset_start)
        crc = zlib.crc32(head, zlib.crc32(summary))
        footer = Footer(summary_start=start, summary_offset_start=offset_start, summary_crc=crc)
        self._write(summary, _bytes_of([footer]), records.MAGIC)


def _bytes_of(parts: Iterable[McapRecord]) -> bytes:
    builder = RecordBuilder()
    for part in parts:
        part.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


def _packed(data: bytes | memoryview, packing: str) -> bytes | memoryview:
    if packing == "zstd":
        import zstandard  # noqa: PLC0415

        return zstandard.ZstdCompressor(level=ZSTD_LEVEL).compress(data)
    if packing == "lz4":
        import lz4.frame  # noqa: PLC0415

        return bytes(lz4.frame.compress(data))
    return data
