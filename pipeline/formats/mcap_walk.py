"""One pass over an MCAP file from front to back, which is the only way that meets every checksum.

Compared are: the checksum of each chunk, of the data section, of the summary and of each attachment; what was met with
what the summary says (``pipeline.formats.mcap_container``); that records fill their chunks; that data and file end
where they should. No length is believed before it is compared with what is left of the file.

Messages are handed on chunk by chunk, so that a file of any length takes the memory of a chunk. What was handed on is
proven only when the walk has ended without an error.
"""

from __future__ import annotations

import hashlib
import os
import struct
import zlib
from io import BytesIO
from typing import TYPE_CHECKING, BinaryIO

from mcap.records import Message

from pipeline.formats import mcap_records as records
from pipeline.formats.ingest_error import IngestError
from pipeline.formats.mcap_chunk import Run, split, unpack
from pipeline.formats.mcap_container import Container

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from pipeline.formats.mcap_chunk import Rows

COPY_AGAIN = "copy the file again from its source"
RUN_SIZE = 1 << 20  # bytes of messages outside chunks that are handed on at once
CHUNK_TIMES = 8 + 8  # bytes of a chunk's earliest and latest time
_RECORD = struct.Struct("<BQ")


class _Truncated(Exception):  # noqa: N818  (becomes an IngestError, or a note)
    """The file ends before its data do."""


class Walk:
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
        self.stream, self.path, self.allow_truncated = stream, path, allow_truncated
        self.size = stream.seek(0, os.SEEK_END)
        stream.seek(0)
        self.found = Container()
        self.position = 0
        self._crc = 0
        self._sha256 = hashlib.sha256()
        self._loose: list[bytes] = []  # messages outside chunks, not yet handed on
        self._loose_size = 0
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
            except _Truncated as error:
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
        self.found.sha256 = self._sha256.hexdigest()

    def _take(self, size: int) -> bytes:
        data = self.stream.read(size)
        if len(data) < size:
            raise _Truncated(f"it ends {size - len(data)} bytes before a record does")
        return data

    def _absorb(self, *parts: bytes) -> None:
        """Count bytes as read, for the checksums of the data and of the file."""
        for part in parts:
            self._crc = zlib.crc32(part, self._crc)
            self._sha256.update(part)
            self.position += len(part)

    def _record(self) -> tuple[int, bytes, bytes]:
        """Return the next record: its kind, its first nine bytes, its content."""
        if self.position + self._loose_size == self.size:
            raise _Truncated("it ends after a complete record; the recorder did not close it")
        head = self._take(records.RECORD_HEAD)
        opcode, length = _RECORD.unpack(head)
        left = self.size - self.position - self._loose_size - records.RECORD_HEAD
        if length > left:
            what = f"a record of kind {opcode} claims {length} bytes where {left} are left"
            if opcode in records.IN_DATA | records.IN_SUMMARY:
                raise _Truncated(what)
            raise ValueError(what)
        if opcode == 0:
            raise ValueError("a record has the kind 0, which none has")
        return opcode, head, self._take(length)

    def _data(self) -> Iterator[Rows]:
        """Read up to the end of the data section."""
        magic = self._take(len(records.MAGIC))
        if magic != records.MAGIC:
            raise ValueError(f"it begins with {magic!r}, and an MCAP file with {records.MAGIC!r}")
        self._absorb(magic)
        while True:
            opcode, head, content = self._record()
            if opcode == records.MESSAGE:
                self._bare = True
                if not self._loose:
                    yield from self._flush()
                self._loose += [head, content]
                self._loose_size += len(head) + len(content)
                if self._loose_size >= RUN_SIZE:
                    yield from self._flush()
                continue
            if opcode != records.MESSAGE_INDEX or self._loose:
                yield from self._flush()
            if opcode == records.DATA_END:
                return self._end_data(head, content)
            self._take_in(opcode, content)
            self._absorb(head, content)

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
            self._loose, self._loose_size = [], 0
            self._absorb(bytes(run.data))
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
        if crc and crc != self._crc:
            raise ValueError("the checksum of the data is wrong")
        self.found.verified = self._proven = bool(crc) or (self._chunks_checked and not self._bare)
        self._absorb(head, content)
        self._unknown &= not crc

    def _summary(self) -> None:
        """Read from the end of the data to the end of the file."""
        found, start, opcode = self.found, self.position, 0
        self._crc = 0
        readers: dict[int, Callable[[bytes], None]] = {
            records.STATISTICS: self._take_statistics,
            records.CHUNK_INDEX: lambda c: found.chunk_index.append(int.from_bytes(c[16:24], "little")),
            records.SCHEMA: lambda c: self._define(records.SCHEMA, c),
            records.CHANNEL: lambda c: self._define(records.CHANNEL, c),
        }
        while opcode != records.FOOTER:
            opcode, head, content = self._record()
            if opcode in records.IN_DATA - records.IN_SUMMARY:
                raise ValueError(f"a record of kind {opcode} of the data stands after their end")
            readers.get(opcode, lambda _content: None)(content)
            if opcode != records.FOOTER:
                self._absorb(head, content)
        self._close(head, content, start)

    def _take_statistics(self, content: bytes) -> None:
        self.found.statistics = records.statistics(content)

    def _close(self, head: bytes, content: bytes, start: int) -> None:
        footer = records.footer(content)
        crc = zlib.crc32(head + content[:16], self._crc)
        if footer.summary_crc and footer.summary_crc != crc:
            raise ValueError("the checksum of the summary is wrong")
        if footer.summary_start not in (0, start):
            raise ValueError(f"the summary begins at byte {start}, and the file says {footer.summary_start}")
        self._absorb(head, content)
        end = self.stream.read()
        self._absorb(end)
        if len(end) < len(records.MAGIC) and records.MAGIC.startswith(end):
            raise _Truncated("its last bytes are missing")
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
                self._sha256.update(part)
            return
        hint = f"{COPY_AGAIN}, or set ingest.mcap.allow_truncated=true to use the complete chunks"
        if self.allow_truncated:
            hint = f"{COPY_AGAIN}: {unproven or 'no chunk is complete'}"
        raise IngestError(facts, self.path, fault="truncated", offset=self.size, hint=hint)


def read_container(data: bytes, path: str, *, allow_truncated: bool = False) -> Container:
    """Return all that an MCAP file holds, each message by itself.

    Parameters
    ----------
    data : bytes
        The whole file.
    path : str
        For messages.
    allow_truncated : bool
        Whether the complete chunks of a file without end are read.

    Raises
    ------
    IngestError
        If a byte is damaged or missing; never anything else.
    """
    walk = Walk(BytesIO(data), path, allow_truncated=allow_truncated)
    for rows in walk.rows():
        messages = walk.found.messages.setdefault(rows.channel, [])
        columns = [rows.heads[n].tolist() for n in ("log_time", "publish_time", "sequence")]
        for log_time, publish_time, sequence, payload in zip(*columns, rows.payloads(), strict=True):
            messages.append(
                Message(
                    channel_id=rows.channel,
                    log_time=log_time,
                    data=payload,
                    publish_time=publish_time,
                    sequence=sequence,
                )
            )
    return walk.found
