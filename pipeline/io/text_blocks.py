"""The bytes of a text log in blocks of whole lines, in UTF-8 and with a newline after each line.

The parser of numbers is strict, but it cannot know that a file ends inside a number (``9.81`` cut to ``9.`` still
parses), that a memory card wrote zeros, or that the file is no text. These checks of the bytes cost less than reading
the file.
"""

from __future__ import annotations

import hashlib
import os
import re
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import IngestError
from pipeline.io.files import UTF_16, refuse_foreign
from pipeline.records import Note

if TYPE_CHECKING:
    from collections.abc import Iterator
    from io import BufferedReader

# A block of this size stays in the cache of the processor while it is hashed, checked and parsed.
BLOCK_BYTES = 1 << 20
LONGEST_LINE = 1 << 24  # a line of 16 MB is no row of a table
NEWLINE = ord("\n")
BOM = b"\xef\xbb\xbf"
# A line, a carriage return that no newline follows, and (looked ahead only) the line after it.
BROKEN = re.compile(rb"([^\r\n]+)\r(?!\n)(?=([^\r\n]+))")
DELIMITER = re.compile(rb"[,;\t|]| +")


class TextBlocks:
    """Blocks of a text log, in order, each with the numbers of its lines, counted from 1.

    Parameters
    ----------
    stream : binary stream
        At the beginning of the file.
    keep_nul : bool
        Whether lines with NUL bytes are kept; otherwise they are refused.
    """

    def __init__(self, stream: BufferedReader, path: str, *, keep_nul: bool = False) -> None:
        self._stream, self._path, self._keep_nul = stream, path, keep_nul
        self._digest = hashlib.sha256()
        self._line, self._offset = 1, 0
        self._ends = {"CRLF": 0, "CR": 0, "LF": 0}
        self._first_notes: list[Note] = []
        self._last_notes: list[Note] = []

    def __iter__(self) -> Iterator[tuple[bytes, range]]:
        """Yield the blocks.

        Raises
        ------
        IngestError
            If the file is of another kind, holds NUL bytes or is no UTF-8 text.
        """
        rest = b""
        for chunk in self._chunks():
            end = chunk.rfind(b"\n") + 1
            if not end:  # lines may end in carriage returns alone; the last may be the first half of CRLF
                chunk, rest = rest + chunk, b""  # noqa: PLW2901
                end = chunk.rfind(b"\r", 0, len(chunk) - 1) + 1
            block = b"".join((rest, memoryview(chunk)[:end])) if end else b""
            rest = chunk[end:]
            if len(rest) > LONGEST_LINE:
                message = f"not a text log: no line ends within {LONGEST_LINE} bytes"
                raise IngestError(message, f"{self._path}:{self._line}", code="foreign")
            if block:
                yield self._lines(block)
        if rest:
            data, lines = self._lines(rest)
            if not data.endswith(b"\n"):
                data = self._without_open_line(data)
            if data:
                yield data, lines

    @property
    def sha256(self) -> str:
        """Digest of the bytes that were read."""
        return self._digest.hexdigest()

    @property
    def notes(self) -> list[Note]:
        """What was repaired, complete once all blocks were read."""
        ends = []
        if self._ends["CRLF"] or self._ends["CR"]:
            listed = ", ".join(f"{count} {name}" for name, count in self._ends.items() if count)
            ends = [Note("N-EOL", sum(self._ends.values()), 0, 0, f"line ends other than LF alone: {listed}")]
        return [*self._first_notes, *ends, *self._last_notes]

    def _chunks(self) -> Iterator[bytes]:
        """Yield the bytes of the file without byte order mark and without NUL bytes at its end."""
        position, left = 0, os.fstat(self._stream.fileno()).st_size  # a file that grows is not followed
        while chunk := self._stream.read(min(BLOCK_BYTES, left)):
            left -= len(chunk)
            self._digest.update(chunk)
            if position == 0:
                refuse_foreign(chunk[:16], self._path)
                if chunk.startswith(BOM):
                    self._first_notes.append(
                        Note("N-BOM", 1, 1, 1, "a byte order mark before the first line was skipped")
                    )
                    chunk = chunk.removeprefix(BOM)
            if b"\0" in chunk:
                rest = self._stream.read(left)
                self._digest.update(rest)
                data = self._without_nul(chunk + rest, position)
                yield from (data[start : start + BLOCK_BYTES] for start in range(0, len(data), BLOCK_BYTES))
                return
            yield chunk
            position += len(chunk)

    def _without_nul(self, data: bytes, position: int) -> bytes:
        """Return data, to the end of the file, without the NUL bytes at their end."""
        kept = data.rstrip(b"\0")
        first = max(kept.find(b"\0"), 0)
        inside = b"\0" in kept
        if inside and data[1::2].count(0) > len(data) // 8 > data[::2].count(0):
            raise IngestError(f"not a text log but {UTF_16}", self._path, code="utf16")
        if (not kept and position == 0) or (inside and not self._keep_nul):
            count = kept.count(b"\0") if kept else len(data)
            line = self._line + data.count(b"\n", 0, first)
            message = (
                f"{count} NUL bytes, the first at byte {position + first}: data that a memory card lost, or UTF-16 text"
            )
            hint = "cut the file before them, or set ingest.csv.bad_rows=drop to leave a gap in their place"
            raise IngestError(message, f"{self._path}:{line}", code="nul", hint=hint)
        if len(kept) < len(data):
            line = self._line + kept.count(b"\n")
            detail = "NUL bytes at the end of the file were cut off"
            self._first_notes.append(Note("N-NULTAIL", len(data) - len(kept), line, line, detail))
        return kept

    def _lines(self, data: bytes) -> tuple[bytes, range]:
        """Return lines with uniform ends, and their numbers."""
        if not data.isascii():
            self._check_utf8(data)
        self._offset += len(data)
        if b"\r" in data:
            pairs, returns, newlines = data.count(b"\r\n"), data.count(b"\r"), data.count(b"\n")
            if newlines and returns > pairs:
                self._refuse_broken_line(data)
            data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
        else:
            newlines = int(np.count_nonzero(np.frombuffer(data, np.uint8) == NEWLINE))
            pairs = returns = 0
        for name, count in (("CRLF", pairs), ("CR", returns - pairs), ("LF", newlines - pairs)):
            self._ends[name] += count
        first = self._line
        self._line += returns + newlines - pairs
        return data, range(first, self._line)

    def _check_utf8(self, data: bytes) -> None:
        try:
            data.decode("utf-8")
        except UnicodeDecodeError as error:
            line = self._line + data.count(b"\n", 0, error.start)
            message = (
                f"byte {self._offset + error.start} (0x{data[error.start]:02x}) is not UTF-8; save the file as UTF-8"
            )
            raise IngestError(message, f"{self._path}:{line}", code="not_utf8") from error

    def _refuse_broken_line(self, data: bytes) -> None:
        r"""Refuse a carriage return inside a line: ``0\r.025`` was one number, and ``0`` is another.

        Beside newlines, a lone carriage return is accepted as a line end where the lines on both sides have the same
        number of separators.
        """
        for found in BROKEN.finditer(data):
            left, right = found.group(1), found.group(2)
            if not left.startswith(b"#") and len(DELIMITER.findall(left)) != len(DELIMITER.findall(right)):
                line = self._line + data.count(b"\n", 0, found.start())
                message = "a carriage return inside a line: it parts a row, perhaps a number, in two"
                hint = "remove the byte 0x0d or the whole line; carriage returns that end lines are read"
                raise IngestError(message, f"{self._path}:{line}", code="bad_row", hint=hint)

    def _without_open_line(self, data: bytes) -> bytes:
        end = data.rfind(b"\n") + 1
        text = data[end:].decode("utf-8", "replace")
        detail = f"the last line does not end in a newline and may be cut, so it was dropped: {text[:200]!r}"
        self._last_notes.append(Note("N-TAIL", 1, self._line, self._line, detail))
        return data[:end]
