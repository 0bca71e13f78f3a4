"""The messages of an MCAP file, complete and undamaged, or an error.

The official reader walks the data section from front to back, which is the only way that meets every checksum. What it
does not compare is compared here: the summary's checksum, the message counts of the summary's statistics, that the data
and the file end where they should, and that a chunk does not claim to be larger than any log is.
"""

from __future__ import annotations

import zlib
from collections import Counter
from dataclasses import dataclass, field
from io import BytesIO
from typing import TYPE_CHECKING

from mcap.records import Channel, Chunk, DataEnd, Footer, McapRecord, Message, Schema, Statistics
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk

from pipeline.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator

LARGEST_CHUNK = 1 << 30  # bytes; recorders write about 1 MiB
LARGEST_EXPANSION = 1000
FOOTER_TAIL = 4 + 8  # the summary's checksum and the closing magic bytes


@dataclass
class Container:
    """What an MCAP file holds.

    Attributes
    ----------
    schemas : dict of int to Schema
    channels : dict of int to Channel
    messages : dict of int to list of Message
        Channel to its messages, in the order of the file.
    verified : bool
        Whether every message lies under a checksum; a file may be written without.
    """

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    messages: dict[int, list[Message]] = field(default_factory=dict)
    verified: bool = True

    def add(self, record: McapRecord, path: str) -> None:
        """Take in a record of the data section."""
        if isinstance(record, Message):
            self.messages.setdefault(record.channel_id, []).append(record)
            return
        known: dict[int, Schema] | dict[int, Channel]
        if isinstance(record, Schema):
            known = self.schemas
        elif isinstance(record, Channel):
            known = self.channels
        else:
            return
        if known.setdefault(record.id, record) != record:  # type: ignore[arg-type]
            raise InputError(f"{type(record).__name__} {record.id} is defined twice, differently", path)

    @property
    def count(self) -> int:
        """Number of messages."""
        return sum(map(len, self.messages.values()))


def read_container(data: bytes, path: str) -> Container:
    """Read all messages of an MCAP file.

    Parameters
    ----------
    data : bytes
        The whole file.
    path : str
        For messages.

    Raises
    ------
    InputError
        If a byte is damaged or missing; never anything else.
    """
    container = Container()
    try:
        _walk(data, path, container)
    except InputError:
        raise
    except CRCValidationError as error:
        raise InputError(
            f"damaged: the checksum of a {type(error.record).__name__} after {container.count} messages is wrong; "
            "copy the file again from its source",
            path,
        ) from error
    except Exception as error:
        reason = f"{type(error).__name__} {error}".strip()
        raise InputError(
            f"truncated or damaged MCAP file ({reason}); {container.count} messages were readable before; "
            "copy the file again from its source, or run `mcap recover` and look at what it keeps",
            path,
        ) from error
    return container


def _walk(data: bytes, path: str, container: Container) -> None:
    stream = BytesIO(data)
    reader = StreamReader(stream, emit_chunks=True, validate_crcs=True, record_size_limit=len(data))
    footer: Footer | None = None
    statistics: Statistics | None = None
    checked, ended, loose = True, False, False
    for record in reader.records:
        if isinstance(record, DataEnd):
            ended = True
            container.verified = record.data_section_crc != 0 or (checked and not loose)
        elif isinstance(record, Statistics):
            statistics = record
        elif isinstance(record, Footer):
            footer = record
        elif isinstance(record, Chunk):
            checked &= record.uncompressed_crc != 0
            for inner in _records(record, len(data), path):
                container.add(inner, path)
        elif not ended:
            loose |= isinstance(record, Message)
            container.add(record, path)
    if footer is None or not ended or stream.tell() != len(data):
        raise InputError("the file does not end where its data end: truncated, or another file was appended", path)
    _check_summary(data, path, footer, statistics, container)


def _records(chunk: Chunk, size: int, path: str) -> Iterator[McapRecord]:
    claimed = chunk.uncompressed_size
    if claimed > min(LARGEST_CHUNK, LARGEST_EXPANSION * size):
        raise InputError(f"a chunk claims to hold {claimed} bytes, in a file of {size}: damaged, or no log", path)
    yield from breakup_chunk(chunk, validate_crc=True)


def _check_summary(data: bytes, path: str, footer: Footer, statistics: Statistics | None, container: Container) -> None:
    start = footer.summary_start or len(data) - FOOTER_TAIL - 8 - 8 - 9  # no summary: the footer alone
    if footer.summary_crc and zlib.crc32(data[start:-FOOTER_TAIL]) != footer.summary_crc:
        raise InputError("damaged: the checksum of the summary is wrong; copy the file again from its source", path)
    if statistics is None:
        return
    found = Counter({channel: len(messages) for channel, messages in container.messages.items()})
    said = Counter(statistics.channel_message_counts)
    if statistics.message_count != container.count or (said and said != found):
        raise InputError(
            f"the summary says {statistics.message_count} messages, the file holds {container.count}: "
            "a part is missing",
            path,
        )
