"""Read a text log in blocks of whole lines: check the bytes, find the head, skip comments and empty lines.

The parser of numbers is strict, but it does not detect that a file ends inside a number (``9.81`` cut to ``9.`` is a
number), that a memory card wrote zeros, or that the file is no text. These checks of the bytes cost less than reading
the file.
"""

from __future__ import annotations

import csv
import hashlib
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import IO

import numpy as np

from imu_logs.errors import IngestError
from imu_logs.files import BINARY, UTF_16, is_binary, refuse_foreign
from imu_logs.log import Integers, Note
from imu_logs.profile import AUTO, COMMENTED, DROP, WHITESPACE, CsvFormat

BLOCK_BYTES = 1 << 20  # fits in the cache of the processor
MAX_LINE_BYTES = 1 << 24  # bytes of a line (one of 16 MB is no row of a table), and of the lines before the first row
NEWLINE = ord("\n")
BOM = b"\xef\xbb\xbf"
# A line, a carriage return without a newline, and (only as look-ahead) the line after it.
BROKEN = re.compile(rb"([^\r\n]+)\r(?!\n)(?=([^\r\n]+))")
BLANK_LINE = re.compile(rb"^[ \t]+$", re.MULTILINE)
DELIMITERS = ",;\t|"
ANY_DELIMITER = re.compile(rb"[,;\t|]| +")


@dataclass(frozen=True)
class Head:
    """The text before the rows: ``lines`` above the header, the header (None: no header), and names of the columns.

    Without a header, ``names`` are ``column 0`` ... ``line``: number of the header's line, or of the first row.
    """

    lines: list[str]
    header: str | None
    names: list[str]
    delimiter: str
    line: int

    def text(self, names: list[str]) -> str:
        """Return the lines before the rows, with other column names if they differ."""
        header = self.header
        if header is not None and names != self.names:
            mark = header[: len(header) - len(header.lstrip("#%/;! "))]
            cells = (f'"{name}"' if set(name) & {self.delimiter, '"'} else name for name in names)
            header = mark + self.delimiter.join(cells)
        return "".join(f"{line}\n" for line in [*self.lines, *([] if header is None else [header])])


class TextLog:
    """The rows of a text log, block by block, with their line numbers, counted from 1.

    ``keep_open_line``: a last line without a newline is a row; else it is dropped with a note, as it may be cut.
    ``head`` is None until the header, or the first row of a log without header, was read.
    """

    def __init__(
        self, stream: IO[bytes], path: str, settings: CsvFormat, *,
        keep_open_line: bool = False, block_bytes: int | None = None,
    ) -> None:  # fmt: skip
        self.stream, self.path, self.settings = stream, path, settings
        self.size, self.keep_open_line = block_bytes or BLOCK_BYTES, keep_open_line
        self.head: Head | None = None
        self.comments: list[int] = []
        self.digest = hashlib.sha256()
        self.line, self.offset = 1, 0  # the next ones
        self.ends = {"CRLF": 0, "CR": 0, "LF": 0}
        self.first_notes: list[Note] = []
        self.last_notes: list[Note] = []

    @property
    def sha256(self) -> str:
        """Digest of the bytes that were read."""
        return self.digest.hexdigest()

    @property
    def notes(self) -> list[Note]:
        """Notes on repairs and dropped lines; complete after all rows were read."""
        notes = [*self.first_notes]
        if self.ends["CRLF"] or self.ends["CR"]:
            listed = ", ".join(f"{count} {name}" for name, count in self.ends.items() if count)
            notes.append(Note("N-EOL", sum(self.ends.values()), 0, 0, f"line ends other than LF alone: {listed}"))
        notes += self.last_notes
        if self.comments:
            detail = f"lines that start with {self.settings.comment!r} are no data"
            notes.append(Note("N-COMMENT", len(self.comments), self.comments[0], self.comments[-1], detail))
        return notes

    def __iter__(self) -> Iterator[tuple[bytes, Integers]]:
        """Yield blocks of at least one row, each row with a newline at its end."""
        before = b""
        for block, numbers in self._blocks():
            data = block
            if self.head is None:
                before += block
                start = self._find_head(before)
                if self.head is None and len(before) > MAX_LINE_BYTES:
                    raise self.no_rows()
                data = before[start:]
                numbers = range(1 + before.count(b"\n", 0, start), numbers.stop)  # noqa: PLW2901
            if self.head is not None:
                body, lines = self._rows(data, numbers)
                if len(lines):
                    yield body, lines

    def no_rows(self) -> IngestError:
        """Return the refusal of a log without rows."""
        skipped = self.settings.skip_lines
        if self.line <= skipped:
            message = f"the file ends within the {skipped} lines that ingest.csv.skip_lines skips"
            return IngestError(message, self.path, code="no_rows")
        found = f"header on line {self.head.line}, " if self.head and self.head.header is not None else ""
        return IngestError(f"{found}0 data rows; at least 2 are needed", self.path, code="no_rows")

    def _is_comment(self, line: bytes) -> bool:
        return self.settings.comment is not None and line.lstrip().startswith(self.settings.comment.encode())

    def _find_head(self, text: bytes) -> int:
        """Find the head in the first lines; return the offset of the first row."""
        settings, start, lines = self.settings, 0, list[str]()
        self.comments = []
        while (end := text.find(b"\n", start)) >= 0:
            line = text[start:end]
            if len(lines) >= settings.skip_lines and line.strip() and not self._is_comment(line):
                break
            self.comments += [len(lines) + 1] if len(lines) >= settings.skip_lines and line.strip() else []
            lines.append(line.decode())
            start = end + 1
        else:
            return start
        number, header, shown = len(lines) + 1, None, line.decode()
        if settings.header is True:
            header, start = shown, end + 1
        elif settings.header == COMMENTED:
            if not self.comments:
                message = (
                    f"no line that starts with {settings.comment!r} stands before the data, where ingest.csv.header "
                    "looks for the column names"
                )
                raise IngestError(message, self.path, code="no_header")
            header = lines.pop(self.comments[-1] - 1)
            shown = header.lstrip().removeprefix(settings.comment or "")
        if settings.delimiter == WHITESPACE:
            shown = " ".join(shown.split())
        delimiter = find_delimiter(settings, shown)
        names = [name.strip() for name in next(csv.reader([shown], delimiter=delimiter, skipinitialspace=True), [])]
        if header is None:
            names = [f"column {i}" for i in range(len(names))]
        if header is not None:
            self._fit_names(names, text, start, delimiter)
        self.head = Head(lines, header, names, delimiter, number)
        return start

    def _fit_names(self, names: list[str], text: bytes, start: int, delimiter: str) -> None:
        """Add or remove a last name without text, where the rows or the header alone end in a separator."""
        end = text.find(b"\n", start)
        if end < 0 or self._is_comment(text[start:end]):
            return
        cells = next(csv.reader([text[start:end].decode("utf-8", "replace")], delimiter=delimiter), [])
        if len(cells) == len(names) + 1 and not cells[-1].strip():
            names.append("")
        elif len(cells) == len(names) - 1 and not names[-1]:
            names.pop()

    def _rows(self, data: bytes, numbers: range) -> tuple[bytes, Integers]:
        """Remove comments and empty lines; return the other lines and their numbers."""
        lines = np.arange(numbers.start, numbers.stop)
        comment = self.settings.comment
        if self.settings.delimiter == WHITESPACE:
            data = _single_blanks(data)
        each = np.frombuffer(data, np.uint8)
        before = each[np.flatnonzero(each == NEWLINE) - 1]  # the byte before a newline; before the first, the last
        empty = bool(np.any(before == NEWLINE)) or (b" "[0] in before and BLANK_LINE.search(data) is not None)
        if empty or (comment is not None and comment.encode() in data):
            parts = data.split(b"\n")[:-1]
            is_comment = np.array([self._is_comment(part) for part in parts], bool)
            self.comments += lines[is_comment].tolist()
            keep = ~is_comment & np.array([bool(part.strip()) for part in parts], bool)
            data = b"".join(part + b"\n" for part, kept in zip(parts, keep.tolist(), strict=True) if kept)
            lines = lines[keep]
        return data, lines

    def _blocks(self) -> Iterator[tuple[bytes, range]]:
        """Yield blocks of whole lines in UTF-8, each with a newline at its end, and the numbers of the lines."""
        rest = b""
        for chunk in self._chunks():
            end = chunk.rfind(b"\n") + 1
            if not end:  # lines may end in carriage returns alone; the last may be the first half of CRLF
                chunk, rest = rest + chunk, b""  # noqa: PLW2901
                end = chunk.rfind(b"\r", 0, len(chunk) - 1) + 1
            block = b"".join((rest, memoryview(chunk)[:end])) if end else b""
            rest = chunk[end:]
            if len(rest) > MAX_LINE_BYTES:
                message = f"not a text log: no line ends within {MAX_LINE_BYTES} bytes"
                raise IngestError(message, f"{self.path}:{self.line}", code="foreign")
            if block:
                yield self._lines(block)
        if rest:
            data, numbers = self._lines(rest)
            if not data.endswith(b"\n"):
                data = self._whole_lines(data)
                numbers = range(numbers.start, numbers.start + data.count(b"\n"))
            if data:
                yield data, numbers

    def _chunks(self) -> Iterator[bytes]:
        """Yield the bytes of the file without byte order mark and without NUL bytes at its end."""
        position, remaining = 0, self.stream.seek(0, os.SEEK_END)  # a file that grows is not followed
        self.stream.seek(0)
        while chunk := self.stream.read(min(self.size, remaining)):
            remaining -= len(chunk)
            self.digest.update(chunk)
            if position == 0:
                refuse_foreign(chunk[:18], self.path)
                if chunk.startswith(BOM):
                    detail = "a byte order mark before the first line was skipped"
                    self.first_notes.append(Note("N-BOM", 1, 1, 1, detail))
                    chunk = chunk.removeprefix(BOM)
            if b"\0" in chunk:
                rest = self.stream.read(remaining)
                self.digest.update(rest)
                data = self._without_nul(chunk + rest, position)
                yield from (data[start : start + self.size] for start in range(0, len(data), self.size))
                return
            yield chunk
            position += len(chunk)

    def _without_nul(self, data: bytes, position: int) -> bytes:
        """Remove NUL bytes at the end of the file; raise ``IngestError`` for others that are not allowed."""
        kept = data.rstrip(b"\0")
        first = max(kept.find(b"\0"), 0)
        inside = b"\0" in kept
        if is_binary(kept):
            raise IngestError(f"{BINARY} (it starts with the bytes {data[:4].hex(' ')})", self.path, code="foreign")
        if inside and data[1::2].count(0) > len(data) // 8 > data[::2].count(0):
            raise IngestError(f"not a text log but {UTF_16}", self.path, code="utf16")
        if (not kept and position == 0) or (inside and self.settings.bad_rows != DROP):
            count = kept.count(b"\0") if kept else len(data)
            message = (
                f"{count} NUL bytes, the first at byte {position + first}: data that a memory card lost, or UTF-16"
            )
            hint = "cut the file before them, or set ingest.csv.bad_rows=drop to leave a gap in their place"
            place = f"{self.path}:{self.line + data.count(NEWLINE, 0, first)}"
            raise IngestError(f"{message} text", place, code="nul", hint=hint)
        if len(kept) < len(data):
            line = self.line + kept.count(b"\n")
            detail = "NUL bytes at the end of the file were cut off"
            self.first_notes.append(Note("N-NULTAIL", len(data) - len(kept), line, line, detail))
        return kept

    def _lines(self, data: bytes) -> tuple[bytes, range]:
        """Return lines with newlines as line ends, and their numbers."""
        if not data.isascii():
            self._check_utf8(data)
        self.offset += len(data)
        if b"\r" in data:
            pairs, returns, newlines = data.count(b"\r\n"), data.count(b"\r"), data.count(b"\n")
            if newlines and returns > pairs:
                self._refuse_broken_line(data)
            data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
        else:
            newlines = int(np.count_nonzero(np.frombuffer(data, np.uint8) == NEWLINE))
            pairs = returns = 0
        for name, count in (("CRLF", pairs), ("CR", returns - pairs), ("LF", newlines - pairs)):
            self.ends[name] += count
        first = self.line
        self.line += returns + newlines - pairs
        return data, range(first, self.line)

    def _check_utf8(self, data: bytes) -> None:
        try:
            data.decode("utf-8")
        except UnicodeDecodeError as error:
            place = f"{self.path}:{self.line + data.count(NEWLINE, 0, error.start)}"
            byte = f"byte {self.offset + error.start} (0x{data[error.start]:02x})"
            raise IngestError(
                f"{byte} is not UTF-8; save the file as UTF-8 (iconv -f LATIN1 -t UTF-8)", place, code="not_utf8"
            ) from error

    def _refuse_broken_line(self, data: bytes) -> None:
        r"""Raise ``IngestError`` for a carriage return inside a line: ``0\r.025`` was one number, ``0`` is another.

        In a file with newlines, a single carriage return is accepted as a line end if the lines on both sides have the
        same number of separators.
        """
        for found in BROKEN.finditer(data):
            left, right = found.group(1), found.group(2)
            if not left.startswith(b"#") and len(ANY_DELIMITER.findall(left)) != len(ANY_DELIMITER.findall(right)):
                place = f"{self.path}:{self.line + data.count(NEWLINE, 0, found.start())}"
                message = "a carriage return inside a line: it parts a row, perhaps a number, in two"
                hint = "remove the byte 0x0d or the whole line; carriage returns that end lines are read"
                raise IngestError(message, place, code="bad_row", hint=hint)

    def _whole_lines(self, data: bytes) -> bytes:
        """Complete or drop a last line without a newline."""
        if self.keep_open_line:
            return data + b"\n"
        end = data.rfind(b"\n") + 1
        text = data[end:].decode("utf-8", "replace")
        detail = f"the last line does not end in a newline and may be cut, so it was dropped: {text[:200]!r}"
        self.last_notes.append(Note("N-TAIL", 1, self.line, self.line, detail))
        return data[:end]


def find_delimiter(settings: CsvFormat, line: str) -> str:
    """Return the separator; for ``auto``, the one that occurs most often in a line."""
    if settings.delimiter == WHITESPACE:
        return " "
    if settings.delimiter != AUTO:
        return settings.delimiter
    counts = {d: line.count(d) for d in DELIMITERS if d != settings.decimal}
    found = max(counts, key=lambda d: counts[d])
    return found if counts[found] else " "


def _single_blanks(body: bytes) -> bytes:
    """Replace every run of blanks and tabs by one blank, and remove them at the ends of lines."""
    body = body.replace(b"\t", b" ")
    while b"  " in body:
        body = body.replace(b"  ", b" ")
    return body.replace(b"\n ", b"\n").replace(b" \n", b"\n").lstrip(b" ")
