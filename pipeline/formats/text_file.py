"""The bytes of a text log, looked through before any number is read.

Typed parsing of numbers is strict, but it cannot know that a file ends in the middle of a number (``9.81`` cut to
``9.`` still parses), that a card wrote zeros instead of data, or that the file is no text at all. These few looks at
the raw bytes cost less than reading the file.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pipeline.errors import InputError
from pipeline.records import Note

if TYPE_CHECKING:
    from pathlib import Path

BOM = b"\xef\xbb\xbf"
# First bytes of files that carry a wrong name, and what to do.
FOREIGN = {
    b"\x89MCAP": "an MCAP file: give it the suffix .mcap",
    b"\x1f\x8b": "a gzip file: decompress it first",
    b"\x28\xb5\x2f\xfd": "a zstd file: decompress it first",
    b"PK\x03\x04": "a zip or Excel file: export it as text",
    b"SQLite format 3": "an SQLite database (a ROS 2 bag of the old kind): convert it to MCAP",
    b"#ROSBAG": "a ROS 1 bag: convert it to MCAP",
    b"\x89HDF": "an HDF5 or MATLAB file: export it as text",
    b"MATLAB 5.0": "a MATLAB file: export it as text",
    b"PAR1": "a Parquet file: export it as text",
    b"\xff\xfe": "UTF-16 text: save it as UTF-8",
    b"\xfe\xff": "UTF-16 text: save it as UTF-8",
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


def read_bytes(path: Path) -> bytes:
    """Return a file's bytes, or say why they cannot be had."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}", str(path)) from error
    if not data:
        raise InputError("the file is empty (0 bytes)", str(path))
    return data


def load_text(path: Path) -> TextFile:
    """Read a text log and make its line ends uniform.

    Raises
    ------
    InputError
        If it cannot be read, is empty, holds NUL bytes or is no UTF-8 text.
    """
    raw = read_bytes(path)
    for start, what in FOREIGN.items():
        if raw.startswith(start):
            raise InputError(f"not a text log but {what}", str(path))
    notes: list[Note] = []
    data = raw
    if data.startswith(BOM):
        data = data[len(BOM) :]
        notes.append(Note("N-BOM", 1, 1, 1, "a byte order mark before the first line was skipped"))
    data = _without_nul(data, str(path), notes)
    _check_utf8(data, str(path))
    if b"\r" in data:
        data = _uniform_line_ends(data, notes)
    if not data.endswith(b"\n"):
        data = _without_open_line(data, notes)
    return TextFile(str(path), data, hashlib.sha256(raw).hexdigest(), tuple(notes))


def _without_nul(data: bytes, path: str, notes: list[Note]) -> bytes:
    if b"\0" not in data:
        return data
    kept = data.rstrip(b"\0")
    position = kept.find(b"\0")
    if position >= 0 or not kept:
        line = data.count(b"\n", 0, max(position, 0)) + 1
        count = kept.count(b"\0") if kept else len(data)
        raise InputError(
            f"{count} NUL bytes, the first at byte {max(position, 0)}: data that a memory card lost, or UTF-16 text; "
            "cut the file before them",
            f"{path}:{line}",
        )
    line = kept.count(b"\n") + 1
    notes.append(Note("N-NULTAIL", len(data) - len(kept), line, line, "NUL bytes at the end of the file were cut off"))
    return kept


def _check_utf8(data: bytes, path: str) -> None:
    if data.isascii():
        return
    try:
        data.decode("utf-8")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise InputError(
            f"byte {error.start} (0x{data[error.start]:02x}) is not UTF-8; save the file as UTF-8", f"{path}:{line}"
        ) from error


def _uniform_line_ends(data: bytes, notes: list[Note]) -> bytes:
    pairs, returns, newlines = data.count(b"\r\n"), data.count(b"\r"), data.count(b"\n")
    if not pairs == returns == newlines:
        detail = f"line ends are not uniform: {pairs} CRLF, {returns - pairs} CR, {newlines - pairs} LF"
        notes.append(Note("N-EOL", returns + newlines - pairs, 0, 0, detail))
    return data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")


def _without_open_line(data: bytes, notes: list[Note]) -> bytes:
    end = data.rfind(b"\n") + 1
    line, text = data.count(b"\n") + 1, data[end:].decode("utf-8")
    detail = f"the last line does not end in a newline and may be cut, so it was dropped: {text[:200]!r}"
    notes.append(Note("N-TAIL", 1, line, line, detail))
    return data[:end]
