"""One pass over an MCAP file from front to back, which is the only way that meets every checksum.

Compared are: the checksum of each chunk, of the data section, of the summary and of each attachment; what was met with
what the summary says (``pipeline.io.mcap_container``); that records fill their chunks; that data and file end
where they should. No length is believed before it is compared with what is left of the file.

Messages are handed on chunk by chunk, so that a file of any length takes the memory of a chunk. What was handed on is
proven only when the walk has ended without an error.
"""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING, BinaryIO

from pipeline.errors import IngestError
from pipeline.io import mcap_records as records
from pipeline.io.mcap_chunk import Run, split, unpack
from pipeline.io.mcap_container import Container
from pipeline.io.record_stream import RecordStream, Truncated

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from pipeline.io.mcap_chunk import Rows

COPY_AGAIN = "copy the file again from its source"
RUN_SIZE = 1 << 20  # bytes of messages outside chunks that are handed on at once
CHUNK_TIMES = 8 + 8  # bytes of a chunk's earliest and latest time


class Walk(RecordStream):
    """One pass over a file.

    Parameters
    ----------
    stream : binary file
        At its beginning.
    path : str
        For messages.
    allow_truncated : bool
        Whether the complete chunks of a file without end are read.

    Attributes
    ----------
    found : Container
        Grows during the walk.
    """

    def __init__(self, stream: BinaryIO, path: str, *, allow_truncated: bool = False) -> None:
        super().__init__(stream)
        self.path, self.allow_truncated = path, allow_truncated
        self.found = Container()
        self._loose: list[bytes] = []  # messages outside chunks, not yet handed on
        self._chunk: Run | None = None  # not yet handed on, because its index may follow
        self._bare = False  # messages or definitions lie outside chunks
        self._unknown = False  # records of kinds that the format does not know (yet)
        self._chunks_checked = True
        self._proven = False  # the data section is complete and every message lies under a checksum

    def rows(self) -> Iterator[Rows]:
        """Return the messages, run by run and channel by channel.

        Raises
        ------
        IngestError
            If a byte is damaged or missing; never anything else.
        """
        try:
            try:
                yield from self._data()
                self._summary()
            except Truncated as error:
                yield from self._flush()
                self._accept_truncation(str(error))
            self.found.check_complete()
        except IngestError:
            raise
        except Exception as error:
            reason = str(error) if isinstance(error, ValueError) else f"{type(error).__name__} {error}".strip()
            raise IngestError(
                f"truncated or damaged MCAP file: {reason}; {self.found.count} messages in {len(self.found.chunks)} "
                "chunks were readable before",
                self.path,
                fault="checksum" if "checksum" in reason else "incomplete" if "missing" in reason else "damaged",
                offset=self.position,
                hint=COPY_AGAIN,
            ) from error
        self.found.sha256 = self.sha256.hexdigest()

    def _data(self) -> Iterator[Rows]:
        """Read up to the end of the data section."""
        magic = self.take(len(records.MAGIC))
        if magic != records.MAGIC:
            raise ValueError(f"it begins with {magic!r}, and an MCAP file with {records.MAGIC!r}")
        self.absorb(magic)
        while True:
            opcode, head, content = self.record()
            if opcode == records.MESSAGE:
                self._bare = True
                if not self._loose:
                    yield from self._flush()
                self._loose += [head, content]
                self.waiting += len(head) + len(content)
                if self.waiting >= RUN_SIZE:
                    yield from self._flush()
                continue
            if opcode != records.MESSAGE_INDEX or self._loose:
                yield from self._flush()
            if opcode == records.DATA_END:
                return self._end_data(head, content)
            self._take_in(opcode, content)
            self.absorb(head, content)

    def _take_in(self, opcode: int, content: bytes) -> None:
        """Read a record of the data section other than a message."""
        found = self.found
        if found.header is None and opcode != records.HEADER:
            raise ValueError(f"no Header record: the first record is of kind {opcode}")
        if opcode == records.CHUNK:
            self._chunk = self._unpacked(content)
            found.chunks.append(self.position)
        elif opcode == records.MESSAGE_INDEX:
            channel, offsets = records.message_index(content)
            if self._chunk is not None:
                self._chunk.index[channel] = offsets
        elif opcode == records.HEADER:
            if found.header is not None:
                raise ValueError("a second Header record")
            found.header = records.header(content)
        elif opcode in (records.SCHEMA, records.CHANNEL):
            self._bare = True
            self._define(opcode, content)
        else:
            self._take_in_other(opcode, content)

    def _take_in_other(self, opcode: int, content: bytes) -> None:
        """Read a record that has nothing to do with messages."""
        if opcode == records.ATTACHMENT:
            self.found.attachments.append(records.attachment(content))
        elif opcode == records.METADATA:
            self.found.metadata.append(records.metadata(content))
        elif opcode in records.IN_SUMMARY:
            raise ValueError(f"a record of kind {opcode} of the summary stands in the data")
        else:
            self._unknown = True

    def _unpacked(self, content: bytes) -> Run:
        cursor = records.Cursor(content)
        cursor.take(CHUNK_TIMES)
        size, crc, packing = cursor.number(8), cursor.number(4), cursor.text()
        name = f"chunk {len(self.found.chunks) + 1}"
        data = unpack(bytes(cursor.take(cursor.number(8))), size, packing)
        if crc and zlib.crc32(data) != crc:
            raise ValueError(f"the checksum of {name} is wrong")
        self._chunks_checked &= crc != 0
        return Run(data, self.position, name)

    def _flush(self) -> Iterator[Rows]:
        """Hand on the messages that wait."""
        if self._chunk is not None:
            run, self._chunk = self._chunk, None
        elif self._loose:
            run = Run(b"".join(self._loose), self.position, "the messages outside chunks")
            self._loose, self.waiting = [], 0
            self.absorb(bytes(run.data))
        else:
            return
        others, found = split(run)
        for opcode, content in others:
            if opcode in (records.SCHEMA, records.CHANNEL):
                self._define(opcode, content)
        for rows in found:
            if rows.channel not in self.found.channels:
                raise ValueError(
                    f"messages of channel {rows.channel}, which no record before them defines: a part is missing"
                )
            self.found.counts[rows.channel] += len(rows.starts)
            yield rows

    def _define(self, opcode: int, content: bytes | memoryview) -> None:
        if opcode == records.SCHEMA:
            self.found.define_schema(records.schema(content))
        else:
            self.found.define_channel(records.channel(content))

    def _end_data(self, head: bytes, content: bytes) -> None:
        crc = records.Cursor(content).number(4)
        if self.found.header is None:
            raise ValueError("no Header record")
        if crc and crc != self.crc:
            raise ValueError("the checksum of the data is wrong")
        self.found.verified = self._proven = bool(crc) or (self._chunks_checked and not self._bare)
        self.absorb(head, content)
        self._unknown &= not crc

    def _summary(self) -> None:
        """Read from the end of the data to the end of the file."""
        found, start, opcode = self.found, self.position, 0
        self.crc = 0
        readers: dict[int, Callable[[bytes], None]] = {
            records.STATISTICS: self._take_statistics,
            records.CHUNK_INDEX: lambda c: found.chunk_index.append(int.from_bytes(c[16:24], "little")),
            records.SCHEMA: lambda c: self._define(records.SCHEMA, c),
            records.CHANNEL: lambda c: self._define(records.CHANNEL, c),
        }
        while opcode != records.FOOTER:
            opcode, head, content = self.record()
            if opcode in records.IN_DATA - records.IN_SUMMARY:
                raise ValueError(f"a record of kind {opcode} of the data stands after their end")
            if opcode in readers:
                readers[opcode](content)
            if opcode != records.FOOTER:
                self.absorb(head, content)
        self._close(head, content, start)

    def _take_statistics(self, content: bytes) -> None:
        self.found.statistics = records.statistics(content)

    def _close(self, head: bytes, content: bytes, start: int) -> None:
        footer = records.footer(content)
        crc = zlib.crc32(head + content[:16], self.crc)
        if footer.summary_crc and footer.summary_crc != crc:
            raise ValueError("the checksum of the summary is wrong")
        if footer.summary_start not in (0, start):
            raise ValueError(f"the summary begins at byte {start}, and the file says {footer.summary_start}")
        self.absorb(head, content)
        end = self.stream.read()
        self.absorb(end)
        if len(end) < len(records.MAGIC) and records.MAGIC.startswith(end):
            raise Truncated("its last bytes are missing")
        if end != records.MAGIC:
            raise ValueError("the file does not end where its data end: truncated, or another file was appended")
        if self._unknown and self.found.statistics is None:
            raise ValueError("records of an unknown kind, and no counts that tell whether messages are missing")

    def _accept_truncation(self, reason: str) -> None:
        """Take what is complete, where that is wanted and every chunk carries a checksum."""
        found = self.found
        facts = f"truncated: {reason}; {found.count} messages in {len(found.chunks)} complete chunks are readable"
        proven = self._proven or (self._chunks_checked and not self._bare)
        unproven = "" if proven else "not every message lies in a chunk with a checksum"
        unproven = "records of an unknown kind" if self._unknown else unproven
        if self.allow_truncated and found.count and not unproven:
            found.truncated = facts
            self.stream.seek(self.position)
            for part in iter(lambda: self.stream.read(RUN_SIZE), b""):
                self.sha256.update(part)
            return
        hint = f"{COPY_AGAIN}, or set ingest.mcap.allow_truncated=true to use the complete chunks"
        if self.allow_truncated:
            hint = f"{COPY_AGAIN}: {unproven or 'no chunk is complete'}"
        raise IngestError(facts, self.path, fault="truncated", offset=self.size, hint=hint)
