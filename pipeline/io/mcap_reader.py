"""Read MCAP files in one pass from the first byte to the last, and check that they are complete.

    file   = magic | data section | summary | magic
    record = opcode (1 byte) | length (8 bytes) | content (length bytes)

Checked are the checksums of each chunk, each attachment, the data section and the summary (0: the recorder computed
none); that records fill their chunks; and that the counts in the summary are right. Every length is first compared with
the number of remaining bytes. Messages are returned chunk by chunk, so that the largest chunk determines the memory. A
file is known to be complete only after the iteration has ended without an error.
"""

from __future__ import annotations

import hashlib
import os
import struct
import zlib
from collections import Counter
from typing import TYPE_CHECKING, Any, BinaryIO

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, ChunkIndex, DataEnd, Footer, Header, Metadata, Schema, Statistics

from pipeline.errors import IngestError
from pipeline.io.files import FOREIGN
from pipeline.io.mcap_chunk import MAGIC, RECORD_HEAD, Run, attachment, message_index, parsed, split, unpack

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pipeline.io.mcap_chunk import ChannelMessages
    from pipeline.records import Note

DEFINITIONS = {Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel}
ONLY_IN_DATA = frozenset({
    Opcode.HEADER, Opcode.MESSAGE, Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT, Opcode.METADATA,
    Opcode.DATA_END,
})  # fmt: skip
ONLY_IN_SUMMARY = frozenset(Opcode) - ONLY_IN_DATA - frozenset(DEFINITIONS)
_KINDS = frozenset(Opcode)
COPY_AGAIN = "copy the file again from its source"
RUN_SIZE = 1 << 20  # bytes of messages outside chunks that are returned together, as the recorders' usual chunk
_RECORD = struct.Struct("<BQ")


class _TruncatedError(Exception):
    """The file ends before its end magic."""


class MessageReader:
    """One pass over a log of messages.

    ``schemas``, ``channels`` and ``counts`` of messages are by number. ``notes``: from the reader of the format.
    ``has_recorder``: whether the messages have times of the logger. ``truncated``: description of the missing end of a
    file whose complete chunks are read on request. ``sha256``: of the whole file, after the iteration has ended.
    """

    def __init__(self, path: str) -> None:
        self.path = path
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.counts: Counter[int] = Counter()
        self.notes: list[Note] = []
        self.has_recorder = True
        self.truncated = self.sha256 = ""

    @property
    def count(self) -> int:
        """Number of messages so far."""
        return self.counts.total()

    @property
    def verified(self) -> bool:
        """Whether a checksum covers every message; a file may have no checksums."""
        return False

    def rows(self) -> Iterator[ChannelMessages]:
        """Yield the messages, run by run and channel by channel; damage raises ``IngestError``."""
        raise NotImplementedError


class McapReader(MessageReader):
    """One pass over an MCAP file; ``allow_truncated``: whether to read the complete chunks of a truncated file."""

    def __init__(self, stream: BinaryIO, path: str, *, allow_truncated: bool = False) -> None:
        super().__init__(path)
        self.stream, self.allow_truncated = stream, allow_truncated
        check_magic(stream.read(64), path)
        self.size = stream.seek(0, os.SEEK_END)
        stream.seek(0)
        self.header: Header | None = None
        self.attachments: list[Attachment] = []
        self.metadata: list[Metadata] = []
        self.chunks: list[int] = []  # byte at which each begins
        self.position = 0  # bytes read so far
        self._statistics: Statistics | None = None
        self._chunk_index: list[int] = []  # bytes at which chunks begin, by the summary
        self._crc, self._sha = 0, hashlib.sha256()
        self._start = 0  # byte at which the current record begins
        self._run = Run()  # not yet returned: the index of its chunk may follow
        self._loose: list[bytes] = []  # messages outside chunks, not yet returned
        self._outside_chunks = False  # messages or definitions lie outside chunks
        self._unknown_kinds = False  # records of kinds that the format does not know (yet)
        self._data_checked = False  # the checksum of the data section is given, and right
        self._chunks_checked = True

    @property
    def verified(self) -> bool:
        """Whether a checksum covers every message."""
        return self._data_checked or (self._chunks_checked and not self._outside_chunks)

    def rows(self) -> Iterator[ChannelMessages]:
        """Yield the messages, run by run and channel by channel; errors as of ``runs``."""
        for run in self.runs():
            yield from run.rows

    def runs(self) -> Iterator[Run]:
        """Yield the data section, run by run; raise ``IngestError`` for damage and for a missing part."""
        try:
            self._take(len(MAGIC))
            try:
                yield from self._data()
                self._summary()
            except _TruncatedError as error:
                yield from self._finished_run()
                self._accept_truncation(str(error))
            self._check_complete()
        except IngestError:
            raise
        except Exception as error:
            reason = str(error) if isinstance(error, ValueError) else f"{type(error).__name__} {error}".strip()
            readable = f"{self.count} messages in {len(self.chunks)} chunks were readable before"
            message = f"truncated or damaged MCAP file: {reason}; {readable}"
            code = "checksum" if "checksum" in reason else "incomplete" if "missing" in reason else "damaged"
            raise IngestError(message, self.path, code=code, offset=self._start, hint=COPY_AGAIN) from error
        self.sha256 = self._sha.hexdigest()

    def _take(self, size: int) -> bytes:
        """Return the next bytes, and add them to the checksums."""
        data = self.stream.read(size)
        self._crc = zlib.crc32(data, self._crc)
        self._sha.update(data)
        self.position += len(data)
        if len(data) < size:
            raise _TruncatedError(f"it ends {size - len(data)} bytes before a record does")
        return data

    def _record(self) -> tuple[int, bytes, bytes]:
        """Return the kind, the head (nine bytes) and the content of the next record."""
        self._start, available = self.position, self.size - self.position - RECORD_HEAD
        if available == -RECORD_HEAD:
            raise _TruncatedError("it ends after a complete record; the recorder did not close it")
        head = self._take(RECORD_HEAD)
        opcode, length = _RECORD.unpack(head)
        if length > available:
            what = f"a record of kind {opcode} claims {length} bytes where {available} are left"
            raise _TruncatedError(what) if opcode in _KINDS else ValueError(what)
        if opcode == 0:
            raise ValueError("a record has the invalid kind 0")
        return opcode, head, self._take(length)

    def _data(self) -> Iterator[Run]:
        """Read to the end of the data section, and yield its runs."""
        while True:
            crc = self._crc
            opcode, head, content = self._record()
            if opcode == Opcode.MESSAGE:
                if not self._loose:
                    yield from self._finished_run()
                    self._run.offset, self._outside_chunks = self._start, True
                self._loose += [head, content]
                if self.position - self._run.offset >= RUN_SIZE:
                    yield from self._finished_run()
                continue
            if opcode != Opcode.MESSAGE_INDEX or self._loose:
                yield from self._finished_run()
            if opcode == Opcode.DATA_END:
                if self._run.records:
                    yield self._run
                return self._end_data(parsed(DataEnd, content).data_section_crc, crc)
            self._store_record(opcode, content)
            self._run.records.append((head, content))

    def _store_record(self, opcode: int, content: bytes) -> None:
        """Parse a record of the data section other than a message, and store its content."""
        if (self.header is None) != (opcode == Opcode.HEADER):
            message = f"no Header record: the first is of kind {opcode}" if not self.header else "a second Header"
            raise ValueError(message)
        if opcode == Opcode.HEADER:
            self.header = parsed(Header, content)
        elif opcode == Opcode.CHUNK:
            self._unpack(parsed(Chunk, content))
        elif opcode == Opcode.MESSAGE_INDEX:
            channel, offsets = message_index(content)
            self._run.index[channel] = offsets
        elif opcode in DEFINITIONS:
            self._outside_chunks = True
            self._define(opcode, content)
        elif opcode == Opcode.ATTACHMENT:
            self.attachments.append(attachment(content))
        elif opcode == Opcode.METADATA:
            self.metadata.append(parsed(Metadata, content))
        elif opcode in ONLY_IN_SUMMARY:
            raise ValueError(f"a record of kind {opcode} of the summary stands in the data")
        else:
            self._unknown_kinds = True

    def _unpack(self, chunk: Chunk) -> None:
        run = self._run
        run.offset, run.name = self._start, f"chunk {len(self.chunks) + 1}"
        run.data = unpack(chunk.data, chunk.uncompressed_size, chunk.compression)
        if chunk.uncompressed_crc and zlib.crc32(run.data) != chunk.uncompressed_crc:
            raise ValueError(f"the checksum of {run.name} is wrong")
        self._chunks_checked &= chunk.uncompressed_crc != 0
        self.chunks.append(self._start)

    def _finished_run(self) -> Iterator[Run]:
        """Yield the current run if it has messages, and start the next run."""
        run = self._run
        if self._loose:
            run.name, run.data, run.loose = "the messages outside chunks", b"".join(self._loose), True
            self._loose = []
        elif not run.name:
            return
        self._run = Run()
        definitions, run.rows = split(run)
        for opcode, content in definitions:
            if opcode in DEFINITIONS:
                self._define(opcode, content)
        for rows in run.rows:
            if rows.channel not in self.channels:
                message = f"messages of channel {rows.channel}, which no record before them defines: a part is missing"
                raise ValueError(message)
            self.counts[rows.channel] += len(rows.starts)
        yield run

    def _define(self, opcode: int, content: bytes | memoryview) -> None:
        """Store a message definition or a channel; a second one with the same number must be equal."""
        record = parsed(DEFINITIONS[Opcode(opcode)], content)
        known: dict[int, Any] = self.schemas if opcode == Opcode.SCHEMA else self.channels
        if known.setdefault(record.id, record) != record:
            raise ValueError(f"{type(record).__name__} {record.id} is defined twice, differently")

    def _end_data(self, given: int, crc: int) -> None:
        if self.header is None:
            raise ValueError("no Header record")
        if given and given != crc:
            raise ValueError("the checksum of the data is wrong")
        self._data_checked = bool(given)
        self._unknown_kinds &= not given

    def _summary(self) -> None:
        """Read and check the summary, to the end of the file."""
        start, self._crc, opcode = self.position, 0, 0
        while opcode != Opcode.FOOTER:
            crc = self._crc
            opcode, head, content = self._record()
            if opcode in ONLY_IN_DATA:
                raise ValueError(f"a record of kind {opcode} of the data stands after their end")
            if opcode in DEFINITIONS:
                self._define(opcode, content)
            elif opcode == Opcode.STATISTICS:
                self._statistics = parsed(Statistics, content)
            elif opcode == Opcode.CHUNK_INDEX:
                self._chunk_index.append(parsed(ChunkIndex, content).chunk_start_offset)
        self._check_footer(parsed(Footer, content), zlib.crc32(head + content[:16], crc), start)

    def _check_footer(self, footer: Footer, crc: int, start: int) -> None:
        """Check the checksum and the place of the summary, and the last bytes of the file."""
        if footer.summary_crc not in {0, crc}:
            raise ValueError("the checksum of the summary is wrong")
        if footer.summary_start not in {0, start}:
            raise ValueError(f"the summary begins at byte {start}, and the file says {footer.summary_start}")
        end = self._take(self.size - self.position)
        if len(end) < len(MAGIC) and MAGIC.startswith(end):
            raise _TruncatedError("its last bytes are missing")
        if end != MAGIC:
            raise ValueError("the file does not end where its data end: truncated, or another file was appended")
        if self._unknown_kinds and self._statistics is None:
            raise ValueError("records of an unknown kind, and no counts that tell whether messages are missing")

    def _accept_truncation(self, reason: str) -> None:
        """Accept the complete chunks of a truncated file, if that is allowed and a checksum covers each; else raise."""
        facts = f"truncated: {reason}; {self.count} messages in {len(self.chunks)} complete chunks are readable"
        unproven = "" if self.verified else "not every message lies in a chunk with a checksum"
        unproven = "records of an unknown kind" if self._unknown_kinds else unproven
        if self.allow_truncated and self.count and not unproven:
            self.truncated = facts
            for part in iter(lambda: self.stream.read(RUN_SIZE), b""):
                self._sha.update(part)
            return
        hint = f"{COPY_AGAIN}, or set ingest.mcap.allow_truncated=true to use the complete chunks"
        if self.allow_truncated:
            hint = f"{COPY_AGAIN}: {unproven or 'no chunk is complete'}"
        raise IngestError(facts, self.path, code="truncated", offset=self.size, hint=hint)

    def _check_complete(self) -> None:
        """Compare chunks and counts with the summary; raise ``ValueError`` if a part is missing."""
        lost = set(self._chunk_index) - set(self.chunks)
        if lost or (self._chunk_index and not self.truncated and sorted(self._chunk_index) != self.chunks):
            what = f"the summary lists {len(self._chunk_index)} chunks, and the file holds {len(self.chunks)}"
            raise ValueError(f"{what} at the stated places: a part is missing")
        stated = self._statistics
        if stated is None:
            return
        said = f"the summary says {stated.message_count} messages"
        if stated.message_count != self.count:
            raise ValueError(f"{said}, the file holds {self.count}: a part is missing")
        if stated.channel_message_counts and Counter(stated.channel_message_counts) != self.counts:
            raise ValueError(f"{said}, which the file does not hold by channel")
        found = (len(self.chunks), len(self.attachments), len(self.metadata))
        if (stated.chunk_count, stated.attachment_count, stated.metadata_count) != found:
            raise ValueError(
                f"the summary says {stated.chunk_count} chunks, {stated.attachment_count} attachments and "
                f"{stated.metadata_count} metadata records, the file holds {found[0]}, {found[1]} and {found[2]}"
            )


def check_magic(start: bytes, path: str) -> None:
    """Raise ``IngestError`` for a file that does not begin like an MCAP file, with the kind of file."""
    if start.startswith(MAGIC):
        return
    if not start:
        raise IngestError("the file is empty (0 bytes)", path, code="not_mcap")
    if MAGIC.startswith(start):
        raise IngestError(f"truncated: the file has only {len(start)} bytes", path, code="truncated")
    what = next((what for known, what in FOREIGN.items() if start.startswith(known) and known not in MAGIC), "")
    if not what and not start.strip(b"\0"):
        what = "zeros: data that a memory card lost"
    if not what:
        what = f"it starts with {start[:8].decode('ascii', 'replace')!r}"
        what += "; a text log needs the suffix .csv" if start.isascii() and b"\0" not in start else ""
    raise IngestError(f"not an MCAP file: {what}", path, code="not_mcap", offset=0)
