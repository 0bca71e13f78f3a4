"""Read files safely: kinds of files by their first bytes, files that do not change, texts within a limit.

Only regular files are opened: opening a FIFO would wait forever. Only the standard library is imported here: the
Snakefile of the calibration looks up the files of thousands of units while it is parsed.
"""

from __future__ import annotations

import os
import stat
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, NamedTuple

from imu_logs.errors import ConfigurationError, IngestError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


class MessageFormat(NamedTuple):
    """A kind of log other than text and MCAP: its name, and the module and the extra of the package that read it."""

    kind: str
    library: str
    extra: str


MESSAGE_FORMATS = {
    ".bag": MessageFormat("ROS 1 bag", "rosbags.rosbag1", "ros"),
    ".db3": MessageFormat("ROS 2 bag (SQLite)", "rosbags.rosbag2", "ros"),
    ".ulg": MessageFormat("ULog", "pyulog", "ulog"),
    ".bin": MessageFormat("DataFlash", "pymavlink.DFReader", "ardupilot"),
    ".h5": MessageFormat("HDF5", "h5py", "hdf5"),
    ".hdf5": MessageFormat("HDF5", "h5py", "hdf5"),
    ".mat": MessageFormat("MATLAB", "h5py", "hdf5"),
}
SUFFIXES = (".csv", ".gcsv", ".mcap", *MESSAGE_FORMATS, ".BIN")  # .BIN: as ArduPilot names its logs
KINDS = {
    stat.S_IFDIR: "a directory",
    stat.S_IFIFO: "a FIFO",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}
UTF_16 = "UTF-16 text: save it as UTF-8"
# A text of less than 1024 bytes that Git LFS keeps in place of a file (git-lfs, docs/spec.md, "The Pointer").
POINTER, LARGEST_POINTER = b"version https://git-lfs.github.com/spec/", 1024
GIT_LFS = "is a Git LFS pointer, not the file itself: run git lfs pull"
# First bytes of files that are no text logs, and what to do.
FOREIGN = {
    b"\x89MCAP": "an MCAP file: give it the suffix .mcap",
    b"\x1f\x8b": "a gzip file: decompress it first",
    b"\x28\xb5\x2f\xfd": "a zstd file: decompress it first",
    b"BZh": "a bzip2 file: decompress it first",
    b"\xfd7zXZ": "an xz file: decompress it first",
    b"PK\x03\x04": "a zip or Excel file: export it as text",
    b"\xd0\xcf\x11\xe0": "an Excel file of the old kind: export it as text",
    b"SQLite format 3": "an SQLite database: give a ROS 2 bag the suffix .db3",
    b"#ROSBAG": "a ROS 1 bag: give it the suffix .bag",
    b"\x89HDF": "an HDF5 file: give it the suffix .h5",
    b"MATLAB 7.3": "a MATLAB file: give it the suffix .mat",
    b"MATLAB 5.0": "a MATLAB file: give it the suffix .mat",
    b"ULog\x01\x12\x35": "a ULog file: give it the suffix .ulg",
    b"\xa3\x95\x80\x80": "a DataFlash log: give it the suffix .bin",
    b"PAR1": "a Parquet file: export it as text",
    b"\xff\xfe": UTF_16,
    b"\xfe\xff": UTF_16,
}


def is_mat_5(path: Path) -> bool:
    """Return whether a file is a MATLAB file before version 7.3, which is no HDF5."""
    if path.suffix.lower() != ".mat":
        return False
    with path.open("rb") as stream:
        return stream.read(10) != b"MATLAB 7.3"


def not_regular(path: Path) -> str:
    """Return why a path cannot be read as a file; empty for a regular file with its content, or a link to one.

    Raises ``OSError`` if the path does not exist.
    """
    try:
        status = path.stat()
    except FileNotFoundError:
        if not os.path.lexists(path):
            raise
        return f"is a symbolic link to {path.readlink()}, which does not exist; correct the link or remove it"
    kind = stat.S_IFMT(status.st_mode)
    if kind == stat.S_IFREG:
        return GIT_LFS if status.st_size < LARGEST_POINTER and _starts_with(POINTER, path) else ""
    return f"is {KINDS.get(kind, 'no regular file')}; a regular file, or a symbolic link to one, is expected"


def _starts_with(start: bytes, path: Path) -> bool:
    """Return whether a file starts with these bytes; False for one without the permission to read it."""
    with suppress(PermissionError), path.open("rb") as stream:
        return stream.read(len(start)) == start
    return False


def read_text(path: Path, largest: int, what: str) -> str:
    """Read a UTF-8 text file of at most ``largest`` bytes; ``what`` it contains is named in errors."""
    try:
        other = not_regular(path)
        if other:
            raise ConfigurationError(other, str(path))
        with path.open("rb") as stream:
            content = stream.read(largest + 1)
    except OSError as error:
        raise ConfigurationError(f"cannot be read: {error}", str(path)) from None
    if len(content) > largest:
        raise ConfigurationError(f"has more than {largest} bytes, the limit for {what}", str(path))
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        utf_16 = content[:2] in (b"\xff\xfe", b"\xfe\xff")
        reason = "it is UTF-16" if utf_16 else f"byte {error.start} is not UTF-8"
        raise ConfigurationError(f"cannot be read: {reason}; save it as UTF-8 text", str(path)) from None


@contextmanager
def unchanged(path: Path) -> Iterator[None]:
    """Raise ``IngestError`` if a log is no regular file, cannot be opened, is empty, or changes while it is read."""
    try:
        other = not_regular(path)
        if other:
            raise IngestError(other, str(path), code="git_lfs" if other == GIT_LFS else "unreadable")
        before = path.stat()
        if before.st_size == 0:
            raise IngestError("the file is empty (0 bytes)", str(path), code="empty")
        yield
        after = path.stat()
    except OSError as error:
        raise IngestError(f"cannot be read: {error.strerror or error}", str(path), code="unreadable") from error
    if (before.st_size, before.st_mtime_ns, before.st_ino) != (after.st_size, after.st_mtime_ns, after.st_ino):
        message = f"the file changed while it was read ({before.st_size} bytes, then {after.st_size})"
        hint = "is it still being recorded or copied? Run again when that is done"
        raise IngestError(message, str(path), code="changed", hint=hint)


def refuse_foreign(start: bytes, path: str) -> None:
    """Raise ``IngestError`` for a file that begins like another kind of file."""
    for magic, what in FOREIGN.items():
        if start.startswith(magic):
            code = "utf16" if what == UTF_16 else "foreign"
            raise IngestError(f"not a text log but {what}", path, code=code)
