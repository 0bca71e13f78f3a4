"""Read MCAP files in one pass from the first byte to the last, and check that they are complete.

    file   = magic | data section | summary | magic
    record = opcode (1 byte) | length (8 bytes) | content (length bytes)

The official library parses a record. It returns short data if a length is too large, ignores contradicting lengths,
does not check the checksum of attachments, and reads an index entry by entry; here such records are refused, and an
index is read as an array. Also checked are the checksums of each chunk, the data section and the summary (0: the
recorder computed none), and the counts in the summary. Every length is first compared with the number of remaining
bytes.

A run of records (a chunk, or the messages between chunks) is split by following the lengths from record to record:

    start_0 = 0,   start_{i+1} = start_i + 9 + length_i,   and the last record ends where the run ends

If all records have one length, the starts are an arithmetic series. If the file has an index, they are its offsets.
Else the lengths are followed one by one. numpy checks the first two with the rule above, so that a wrong index has no
effect. Messages are returned run by run, so that the largest chunk determines the memory. A file is known to be
complete only after the iteration has ended without an error.
"""

from __future__ import annotations

import hashlib
import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from io import BytesIO
from typing import Any, BinaryIO

import mcap.records as mcap
import numpy as np
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from imu_logs.errors import IngestError
from imu_logs.files import FOREIGN
from imu_logs.log import Index, Integers, Note

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
DEFINITIONS = {Opcode.SCHEMA: mcap.Schema, Opcode.CHANNEL: mcap.Channel}
ONLY_IN_DATA = frozenset({
    Opcode.HEADER, Opcode.MESSAGE, Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT, Opcode.METADATA,
    Opcode.DATA_END,
})  # fmt: skip
ONLY_IN_SUMMARY = frozenset(Opcode) - ONLY_IN_DATA - frozenset(DEFINITIONS)
_KINDS = frozenset(Opcode)
COPY_AGAIN = "copy the file again from its source"
RUN_SIZE = 1 << 20  # bytes of messages outside chunks that are returned together, as the recorders' usual chunk


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
        return _records(self.data, self.starts, layout)


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
    heads = _records(data, starts, HEAD)
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
    heads = _records(data, starts, HEAD)
    fitting = (heads["opcode"] == Opcode.MESSAGE) & (heads["length"] >= MESSAGE_HEAD) & (heads["length"] <= len(data))
    ends = starts + RECORD_HEAD + heads["length"].astype(np.int64)
    return starts if fitting.all() and np.array_equal(ends, np.append(starts[1:], len(data))) else None


def _records(data: NDArray[np.uint8], starts: Integers, layout: np.dtype[np.void]) -> NDArray[np.void]:
    return np.asarray(sliding_window_view(data, layout.itemsize)[starts].view(layout)[:, 0])


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
    if kind is not mcap.Chunk and not bytes(content).startswith(bytes_of([record])[RECORD_HEAD:]):
        raise ValueError(f"the lengths within a {kind.__name__} record contradict each other")
    return record


def attachment(content: bytes) -> mcap.Attachment:
    """Parse an attachment; raise ``ValueError`` if its checksum is neither right nor 0 (not computed)."""
    record: mcap.Attachment = mcap.Attachment.read(_Content(BytesIO(content)))
    written = bytes_of([record])[RECORD_HEAD:]  # with the right checksum, in its last four bytes
    body, crc = content[: len(written) - 4], content[len(written) - 4 : len(written)]
    if body != written[:-4] or crc not in {bytes(4), written[-4:]}:
        raise ValueError(f"the checksum of attachment {record.name!r} is wrong")
    return record


def bytes_of(records: Iterable[mcap.McapRecord]) -> bytes:
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
        self.schemas: dict[int, mcap.Schema] = {}
        self.channels: dict[int, mcap.Channel] = {}
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
        self.header: mcap.Header | None = None
        self.attachments: list[mcap.Attachment] = []
        self.metadata: list[mcap.Metadata] = []
        self.chunks: list[int] = []  # byte at which each begins
        self.position = 0  # bytes read so far
        self._statistics: mcap.Statistics | None = None
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
                return self._end_data(parsed(mcap.DataEnd, content).data_section_crc, crc)
            self._store_record(opcode, content)
            self._run.records.append((head, content))

    def _store_record(self, opcode: int, content: bytes) -> None:
        """Parse a record of the data section other than a message, and store its content."""
        if (self.header is None) != (opcode == Opcode.HEADER):
            message = f"no Header record: the first is of kind {opcode}" if not self.header else "a second Header"
            raise ValueError(message)
        if opcode == Opcode.HEADER:
            self.header = parsed(mcap.Header, content)
        elif opcode == Opcode.CHUNK:
            self._unpack(parsed(mcap.Chunk, content))
        elif opcode == Opcode.MESSAGE_INDEX:
            channel, offsets = message_index(content)
            self._run.index[channel] = offsets
        elif opcode in DEFINITIONS:
            self._outside_chunks = True
            self._define(opcode, content)
        elif opcode == Opcode.ATTACHMENT:
            self.attachments.append(attachment(content))
        elif opcode == Opcode.METADATA:
            self.metadata.append(parsed(mcap.Metadata, content))
        elif opcode in ONLY_IN_SUMMARY:
            raise ValueError(f"a record of kind {opcode} of the summary stands in the data")
        else:
            self._unknown_kinds = True

    def _unpack(self, chunk: mcap.Chunk) -> None:
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
                self._statistics = parsed(mcap.Statistics, content)
            elif opcode == Opcode.CHUNK_INDEX:
                self._chunk_index.append(parsed(mcap.ChunkIndex, content).chunk_start_offset)
        self._check_footer(parsed(mcap.Footer, content), zlib.crc32(head + content[:16], crc), start)

    def _check_footer(self, footer: mcap.Footer, crc: int, start: int) -> None:
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
