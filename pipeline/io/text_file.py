"""The bytes of a text log, looked through before any number is read.

Typed parsing of numbers is strict, but it cannot know that a file ends in the middle of a number (``9.81`` cut to
``9.`` still parses), that a card wrote zeros instead of data, or that the file is no text at all. These few looks at
the raw bytes cost less than reading the file.
"""

from __future__ import annotations

import hashlib
import re
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pipeline.errors import IngestError
from pipeline.io.file_access import not_regular
from pipeline.records import Note

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

BOM = b"\xef\xbb\xbf"
UTF_16 = "UTF-16 text: save it as UTF-8"
# A line, a carriage return that no newline follows, and (looked at only) the line after it.
BETWEEN = re.compile(rb"([^\r\n]+)\r(?!\n)(?=([^\r\n]+))")
DELIMITER = re.compile(rb"[,;\t|]| +")
# First bytes of files that carry a wrong name, and what to do.
FOREIGN = {
    b"\x89MCAP": "an MCAP file: give it the suffix .mcap",
    b"\x1f\x8b": "a gzip file: decompress it first",
    b"\x28\xb5\x2f\xfd": "a zstd file: decompress it first",
    b"BZh": "a bzip2 file: decompress it first",
    b"\xfd7zXZ": "an xz file: decompress it first",
    b"PK\x03\x04": "a zip or Excel file: export it as text",
    b"\xd0\xcf\x11\xe0": "an Excel file of the old kind: export it as text",
    b"SQLite format 3": "an SQLite database (a ROS 2 bag of the old kind): convert it to MCAP",
    b"#ROSBAG": "a ROS 1 bag: convert it to MCAP",
    b"\x89HDF": "an HDF5 or MATLAB file: export it as text",
    b"MATLAB 7.3": "an HDF5 file (MATLAB 7.3): export it as text",
    b"MATLAB 5.0": "a MATLAB file: export it as text",
    b"PAR1": "a Parquet file: export it as text",
    b"\xff\xfe": UTF_16,
    b"\xfe\xff": UTF_16,
}


@dataclass(frozen=True)
class TextFile:
    """A text log whose lines all end in a single newline.

    Attributes
    ----------
    path : str
    data : bytes
        UTF-8, without byte order mark, with one newline character after every line.
    sha256 : str
        Of the file as it lies on the disk.
    notes : tuple of Note
    """

    path: str
    data: bytes
    sha256: str
    notes: tuple[Note, ...]


@contextmanager
def unchanged(path: Path) -> Iterator[None]:
    """Refuse what is no regular file, cannot be opened, is empty, or is written to while it is read."""
    try:
        other = not_regular(path)
        if other:
            raise IngestError(other, str(path), fault="unreadable")
        before = path.stat()
        if before.st_size == 0:
            raise IngestError("the file is empty (0 bytes)", str(path), fault="empty")
        yield
        after = path.stat()
    except OSError as error:
        raise IngestError(f"cannot be read: {error.strerror or error}", str(path), fault="unreadable") from error
    if (before.st_size, before.st_mtime_ns, before.st_ino) != (after.st_size, after.st_mtime_ns, after.st_ino):
        raise IngestError(
            f"the file changed while it was read ({before.st_size} bytes, then {after.st_size})",
            str(path),
            fault="changed",
            hint="is it still being recorded or copied? Run again when that is done",
        )


def read_bytes(path: Path) -> bytes:
    """Return a file's bytes, or say why they cannot be had."""
    with unchanged(path):
        return path.read_bytes()


def refuse_foreign(start: bytes, path: str) -> None:
    """Refuse a file whose first bytes are those of another kind of file."""
    for magic, what in FOREIGN.items():
        if start.startswith(magic):
            fault = "utf16" if what == UTF_16 else "foreign"
            raise IngestError(f"not a text log but {what}", path, fault=fault)


def load_text(path: Path, *, keep_nul: bool = False) -> TextFile:
    """Read a text log and make its line ends uniform.

    Parameters
    ----------
    path : Path
    keep_nul : bool
        Whether lines with NUL bytes inside are kept, to be dropped with other bad rows.

    Raises
    ------
    IngestError
        If it cannot be read, is empty, holds NUL bytes or is no UTF-8 text.
    """
    raw = read_bytes(path)
    refuse_foreign(raw[:16], str(path))
    notes: list[Note] = []
    data = raw
    if data.startswith(BOM):
        data = data[len(BOM) :]
        notes.append(Note("N-BOM", 1, 1, 1, "a byte order mark before the first line was skipped"))
    data = _without_nul(data, str(path), notes, keep_nul=keep_nul)
    _check_utf8(data, str(path))
    if b"\r" in data:
        data = _uniform_line_ends(data, str(path), notes)
    if not data.endswith(b"\n"):
        data = _without_open_line(data, notes)
    return TextFile(str(path), data, hashlib.sha256(raw).hexdigest(), tuple(notes))


def _without_nul(data: bytes, path: str, notes: list[Note], *, keep_nul: bool) -> bytes:
    if b"\0" not in data:
        return data
    kept = data.rstrip(b"\0")
    position = kept.find(b"\0")
    if position >= 0 and data[1::2].count(0) > len(data) // 8 > data[::2].count(0):
        raise IngestError(f"not a text log but {UTF_16}", path, fault="utf16")
    if not kept or (position >= 0 and not keep_nul):
        line = data.count(b"\n", 0, max(position, 0)) + 1
        count = kept.count(b"\0") if kept else len(data)
        raise IngestError(
            f"{count} NUL bytes, the first at byte {max(position, 0)}: data that a memory card lost, or UTF-16 text",
            f"{path}:{line}",
            fault="nul",
            hint="cut the file before them, or set ingest.csv.bad_rows=drop to leave a gap in their place",
        )
    if len(kept) < len(data):
        line = kept.count(b"\n") + 1
        detail = "NUL bytes at the end of the file were cut off"
        notes.append(Note("N-NULTAIL", len(data) - len(kept), line, line, detail))
    return kept


def _check_utf8(data: bytes, path: str) -> None:
    if data.isascii():
        return
    try:
        data.decode("utf-8")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise IngestError(
            f"byte {error.start} (0x{data[error.start]:02x}) is not UTF-8; save the file as UTF-8",
            f"{path}:{line}",
            fault="not_utf8",
        ) from error


def _uniform_line_ends(data: bytes, path: str, notes: list[Note]) -> bytes:
    pairs, returns, newlines = data.count(b"\r\n"), data.count(b"\r"), data.count(b"\n")
    if newlines and returns > pairs:
        _refuse_broken_line(data, path)
    found = {"CRLF": pairs, "CR": returns - pairs, "LF": newlines - pairs}
    listed = ", ".join(f"{count} {name}" for name, count in found.items() if count)
    notes.append(Note("N-EOL", returns + newlines - pairs, 0, 0, f"line ends other than LF alone: {listed}"))
    return data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")


def _refuse_broken_line(data: bytes, path: str) -> None:
    r"""Refuse a carriage return inside a line: ``0\r.025`` was one number, and ``0`` is another.

    Beside newlines, a lone carriage return is believed to end a line where what it parts is alike.
    """
    for found in BETWEEN.finditer(data):
        left, right = found.group(1), found.group(2)
        if not left.startswith(b"#") and len(DELIMITER.findall(left)) != len(DELIMITER.findall(right)):
            line = data.count(b"\n", 0, found.start()) + 1
            raise IngestError(
                "a carriage return inside a line: it parts a row, perhaps a number, in two",
                f"{path}:{line}",
                fault="bad_row",
                hint="remove the byte 0x0d or the whole line; carriage returns that end lines are read",
            )


def _without_open_line(data: bytes, notes: list[Note]) -> bytes:
    end = data.rfind(b"\n") + 1
    line, text = data.count(b"\n") + 1, data[end:].decode("utf-8", "replace")
    detail = f"the last line does not end in a newline and may be cut, so it was dropped: {text[:200]!r}"
    notes.append(Note("N-TAIL", 1, line, line, detail))
    return data[:end]
