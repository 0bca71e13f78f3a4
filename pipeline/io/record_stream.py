"""Records of an MCAP file in their order, and the checksums of the bytes that were read."""

from __future__ import annotations

import hashlib
import os
import struct
import zlib
from typing import BinaryIO

from pipeline.errors import IngestError
from pipeline.io import mcap_records as records
from pipeline.io.text_file import FOREIGN

_RECORD = struct.Struct("<BQ")


class Truncated(Exception):  # noqa: N818  (becomes an IngestError, or a note)
    """The file ends before its data do."""


class RecordStream:
    """The records of a file.

    Parameters
    ----------
    stream : binary file
        Read from its beginning.

    Attributes
    ----------
    size : int
        Bytes of the file.
    position : int
        Bytes that were absorbed.
    waiting : int
        Bytes that were read after them and wait to be absorbed.
    crc : int
        Checksum of what was absorbed since it was set to 0.
    sha256
        Of all that was absorbed.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self.stream = stream
        self.size = stream.seek(0, os.SEEK_END)
        stream.seek(0)
        self.position = self.waiting = self.crc = 0
        self.sha256 = hashlib.sha256()

    def take(self, size: int) -> bytes:
        """Return the next bytes."""
        data = self.stream.read(size)
        if len(data) < size:
            raise Truncated(f"it ends {size - len(data)} bytes before a record does")
        return data

    def absorb(self, *parts: bytes) -> None:
        """Count bytes as read, for the checksums of the data and of the file."""
        for part in parts:
            self.crc = zlib.crc32(part, self.crc)
            self.sha256.update(part)
            self.position += len(part)

    def record(self) -> tuple[int, bytes, bytes]:
        """Return the next record: its kind, its first nine bytes, its content."""
        if self.position + self.waiting == self.size:
            raise Truncated("it ends after a complete record; the recorder did not close it")
        head = self.take(records.RECORD_HEAD)
        opcode, length = _RECORD.unpack(head)
        left = self.size - self.position - self.waiting - records.RECORD_HEAD
        if length > left:
            what = f"a record of kind {opcode} claims {length} bytes where {left} are left"
            if opcode in records.IN_DATA | records.IN_SUMMARY:
                raise Truncated(what)
            raise ValueError(what)
        if opcode == 0:
            raise ValueError("a record has the kind 0, which none has")
        return opcode, head, self.take(length)


def check_magic(start: bytes, path: str) -> None:
    """Say what a file is that is no MCAP file."""
    if start.startswith(records.MAGIC):
        return
    if not start:
        raise IngestError("the file is empty (0 bytes)", path, fault="not_mcap")
    if records.MAGIC.startswith(start):
        raise IngestError(f"truncated: the file has only {len(start)} bytes", path, fault="truncated")
    what = next((what for known, what in FOREIGN.items() if start.startswith(known) and known not in records.MAGIC), "")
    if not what and not start.strip(b"\0"):
        what = "zeros: data that a memory card lost"
    if not what:
        what = f"it starts with {start[:8].decode('ascii', 'replace')!r}"
        what += "; a text log needs the suffix .csv" if start.isascii() and b"\0" not in start else ""
    raise IngestError(f"not an MCAP file: {what}", path, fault="not_mcap", offset=0)
