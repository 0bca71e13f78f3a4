"""Copy an MCAP file, every record of its data section byte for byte, and add messages.

Chunks are not decompressed. Added messages are written in separate chunks, each after the chunk to which it belongs.
Messages outside chunks are written into a chunk, because readers that use the file's index read chunks only. The
summary is computed again, because the records have new offsets.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from typing import TYPE_CHECKING, Protocol

import numpy as np
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Metadata,
    MetadataIndex,
    Statistics,
    SummaryOffset,
)

from pipeline.io.mcap_chunk import HEAD, MAGIC, RECORD_HEAD, attachment, bytes_of, parsed

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from mcap.records import Channel, McapRecord, Schema
    from numpy.typing import NDArray

    from pipeline.io.mcap_chunk import Run
    from pipeline.records import Integers

ZSTD_LEVEL = -3  # twice as fast as 1 on calibrated messages, and as small as the recorders' 3: benchmarks/apply.py


class _Sink(Protocol):
    def write(self, data: bytes, /) -> object: ...


class McapCopy:
    """The file that is written, in order, to ``out``."""

    def __init__(self, out: _Sink) -> None:
        self.out = out
        self.position = self.crc = 0
        self.compression = ""  # of the last chunk
        self.counts: Counter[int] = Counter()
        self.times: list[int] = []  # the first and the last
        self.chunks: list[ChunkIndex] = []
        self.attachments: list[AttachmentIndex] = []
        self.metadata: list[MetadataIndex] = []
        self._write(MAGIC)

    def _write(self, *parts: bytes) -> None:
        for part in parts:
            self.out.write(part)
            self.crc = zlib.crc32(part, self.crc)
            self.position += len(part)

    def copy(self, run: Run) -> None:
        """Copy a run of the data section."""
        for head, content in run.records:
            self._record(head, content)
        if run.loose:
            self._chunk(run.data, {r.channel: (r.heads["log_time"], r.starts - HEAD.itemsize) for r in run.rows})
        for rows in run.rows:
            self._count(rows.channel, rows.heads["log_time"])

    def _record(self, head: bytes, content: bytes) -> None:
        """Write a record of the data section, and store its place for the summary."""
        opcode, place = head[0], {"offset": self.position, "length": len(head) + len(content)}
        if opcode == Opcode.CHUNK:
            chunk = parsed(Chunk, content)
            self.compression = chunk.compression
            self.chunks.append(
                ChunkIndex(
                    chunk_start_offset=place["offset"], chunk_length=place["length"], compression=chunk.compression,
                    compressed_size=len(chunk.data), uncompressed_size=chunk.uncompressed_size,
                    message_start_time=chunk.message_start_time, message_end_time=chunk.message_end_time,
                    message_index_offsets={}, message_index_length=0,
                )
            )  # fmt: skip
        elif opcode == Opcode.MESSAGE_INDEX and self.chunks:
            index = self.chunks[-1]
            index.message_index_offsets[int.from_bytes(content[:2], "little")] = place["offset"]
            index.message_index_length += place["length"]
        elif opcode == Opcode.ATTACHMENT:
            a = attachment(content)
            self.attachments.append(
                AttachmentIndex(
                    **place, create_time=a.create_time, log_time=a.log_time, data_size=len(a.data), name=a.name,
                    media_type=a.media_type,
                )
            )  # fmt: skip
        elif opcode == Opcode.METADATA:
            self.metadata.append(MetadataIndex(**place, name=parsed(Metadata, content).name))
        self._write(head, content)

    def _count(self, channel: int, times: NDArray[np.uint64]) -> None:
        self.counts[channel] += len(times)
        self.times = [min([*self.times, int(times.min())]), max([*self.times, int(times.max())])]

    def add(self, table: NDArray[np.uint8] | list[bytes], before: Iterable[McapRecord], channel: int) -> None:
        """Add messages of one channel, as rows of bytes or a list of records, after the definitions ``before``."""
        head = bytes_of(before)
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

    def _chunk(self, data: bytes | memoryview, entries: dict[int, tuple[NDArray[np.uint64], Integers]]) -> None:
        """Write a chunk and the indexes of its channels: times and offsets of their messages."""
        times = np.concatenate([t for t, _ in entries.values()])
        chunk = Chunk(
            compression=self.compression, data=_compressed(data, self.compression), uncompressed_size=len(data),
            uncompressed_crc=zlib.crc32(data), message_start_time=int(times.min()), message_end_time=int(times.max()),
        )  # fmt: skip
        self.add_record(chunk)
        for channel, (log_times, starts) in entries.items():
            table = np.stack([log_times.astype("<u8"), starts.astype("<u8")], axis=1).tobytes()
            content = struct.pack("<HI", channel, len(table)) + table
            self._record(struct.pack("<BQ", Opcode.MESSAGE_INDEX, len(content)), content)

    def add_record(self, record: McapRecord) -> None:
        """Add a record of the data section."""
        written = bytes_of([record])
        self._record(written[:RECORD_HEAD], written[RECORD_HEAD:])

    def finish(self, schemas: Sequence[Schema], channels: Sequence[Channel]) -> None:
        """Close the data section and write the summary."""
        self._write(bytes_of([DataEnd(data_section_crc=self.crc)]))
        start = self.position
        times = self.times or [0, 0]
        statistics = Statistics(
            attachment_count=len(self.attachments), channel_count=len(channels), schema_count=len(schemas),
            channel_message_counts=dict(self.counts), chunk_count=len(self.chunks), metadata_count=len(self.metadata),
            message_count=self.counts.total(), message_start_time=times[0], message_end_time=times[1],
        )  # fmt: skip
        groups = [schemas, channels, [statistics], self.chunks, self.attachments, self.metadata]
        summary, offsets = b"", []
        for data in (bytes_of(group) for group in groups if group):
            offsets.append(SummaryOffset(data[0], start + len(summary), len(data)))
            summary += data
        footer = Footer(summary_start=start, summary_offset_start=start + len(summary), summary_crc=0)
        summary += bytes_of(offsets)
        footer.summary_crc = zlib.crc32(bytes_of([footer])[:-4], zlib.crc32(summary))
        self._write(summary, bytes_of([footer]), MAGIC)


def _compressed(data: bytes | memoryview, compression: str) -> bytes:
    if compression == "zstd":
        import zstandard  # noqa: PLC0415

        return zstandard.ZstdCompressor(level=ZSTD_LEVEL).compress(data)
    if compression == "lz4":
        import lz4.frame  # noqa: PLC0415

        return bytes(lz4.frame.compress(data))
    return bytes(data)
