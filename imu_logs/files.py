"""Read files safely: kinds of files by their first bytes, files that do not change, texts within a limit.

Only regular files are opened: opening a FIFO would wait forever. Only the standard library is imported here: the
Snakefile of the calibration looks up the files of thousands of units while it is parsed.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple
from zipfile import BadZipFile, ZipFile

from imu_logs.errors import ConfigurationError, IngestError

ZIP = ".zip"  # of text logs
KINDS = {
    stat.S_IFDIR: "a directory",
    stat.S_IFIFO: "a FIFO",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}
TEXTS = (".csv", ".txt", ".tsv", ".dat", ".log")
LARGEST_MEMBER = 1 << 32  # bytes
PRINTABLE = 64  # first bytes of a text
BINARY = "a binary file of a kind that is not known: export it as text by the program that wrote it"
CONTROLS = bytes({*range(1, 32)} - {*b"\t\n\v\f\r\x1b"})  # that no text has
MOST_CONTROLS = 0.01  # of the bytes of a text; a memory card loses NUL bytes
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
    b"PK\x03\x04": "a zip or Excel file: give a zip of text logs the suffix .zip, export others as text",
    b"\xd0\xcf\x11\xe0": "an Excel file of the old kind: export it as text",
    b"SQLite format 3": "an SQLite database: give a ROS 2 bag the suffix .db3",
    b"#ROSBAG": "a ROS 1 bag: give it the suffix .bag",
    b"\x89HDF": "an HDF5 file: give it the suffix .h5",
    b"MATLAB 7.3": "a MATLAB file: give it the suffix .mat",
    b"MATLAB 5.0": "a MATLAB file: give it the suffix .mat",
    b"ULog\x01\x12\x35": "a ULog file: give it the suffix .ulg",
    b"\xa3\x95\x80\x80": "a DataFlash log: give it the suffix .bin",
    b"PAR1": "a Parquet file: export it as text",
    b"H Product:Blackbox": "a blackbox log of Betaflight or INAV: decode it by blackbox_decode (blackbox-tools) to CSV",
    b"TDSm": "a LabVIEW TDMS file: give it the suffix .tdms",
    b"\x93NUMPY": "a NumPy array: give it the suffix .npy",
    b"\xfa\xff": "an Xsens binary log: export it as text by MT Manager or MVN",
    b"\xb5b": "a u-blox binary log: export it as text",
    b"MD\xfc\x03": "a log of Axivity (CWA): export it as text by OmGui, or read it with actipy",
    b"Device Identity": "a log of GENEActiv: export it as text by its software, or read it with actipy",
    b'{"': "JSON: write its readings as a table, a row for each sample",
    b'[{"': "JSON: write its readings as a table, a row for each sample",
    b"$VN": "VectorNav's ASCII messages, each number with a checksum: export a table by its Control Center",
    b"RIFF": "a video or sound (RIFF), no log",
    b"\xff\xfe": UTF_16,
    b"\xfe\xff": UTF_16,
}
SECOND_PLACE = {b"ftyp": "a video (MP4): extract its telemetry by gpmf-parser or Gyroflow, as .gcsv"}  # from byte 4
MAVLINK = b"\xfd\xfe"  # starts of a packet of MAVLink 2 and 1, after a time in us, big endian
TLOG = "a MAVLink telemetry log: give it the suffix .tlog"
YEARS_US = (946_684_800_000_000, 4_102_444_800_000_000)  # 2000 to 2100


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
    ".tlog": MessageFormat("MAVLink telemetry", "pymavlink.mavutil", "ardupilot"),
    ".tdms": MessageFormat("TDMS", "nptdms", "tdms"),
    ".npy": MessageFormat("NumPy", "numpy", ""),
    ".npz": MessageFormat("NumPy", "numpy", ""),
}
SUFFIXES = (".csv", ".gcsv", ".mcap", *MESSAGE_FORMATS, ZIP, ".BIN")  # .BIN: as ArduPilot names its logs


def kind_of(start: bytes) -> str:
    """Return what a file is that is no text log, and what to do, by its first 18 bytes; empty for any other."""
    found = next((what for magic, what in FOREIGN.items() if start.startswith(magic)), "")
    time_us = int.from_bytes(start[:8], "big")
    if not found and start[8:9] and start[8] in MAVLINK and YEARS_US[0] < time_us < YEARS_US[1]:
        return TLOG
    return found or SECOND_PLACE.get(start[4:8], "")


def is_binary(data: bytes) -> bool:
    """Return whether bytes are no text, nor UTF-16, nor a text with NUL bytes."""
    kept = data.replace(b"\0", b"")
    return len(kept) - len(kept.translate(None, CONTROLS)) > MOST_CONTROLS * len(kept)


def is_message_log(path: Path) -> bool:
    """Return whether a file is a log of messages or arrays, by its suffix; a text with such a suffix is none."""
    suffix = path.suffix.lower()
    if suffix in MESSAGE_FORMATS and path.is_file():
        with path.open("rb") as stream:
            start = stream.read(PRINTABLE)
        return (
            start.startswith(b"MATLAB")
            or not start.decode("latin-1").replace("\n", "").replace("\t", "").replace("\r", "").isprintable()
        )
    return suffix in (".mcap", *MESSAGE_FORMATS)


def archive_of(path: Path) -> Path | None:
    """Return the zip file of a path to a text log in it, ``log.zip/Accelerometer.csv``; None for any other path."""
    return path.parent if path.parent.suffix.lower() == ZIP and path.parent.is_file() else None


def text_members(archive: Path) -> list[Path]:
    """Return the paths of the text logs in a zip file."""
    with _opened(archive) as opened:
        names = [i.filename for i in opened.infolist() if i.file_size and Path(i.filename).suffix.lower() in TEXTS]
    return [archive / Path(name).name for name in names if "__MACOSX" not in name]


def member(archive: Path, name: str) -> bytes:
    """Return the content of a text log in a zip file, of at most ``LARGEST_MEMBER`` bytes."""
    with _opened(archive) as opened:
        found = next((i for i in opened.infolist() if Path(i.filename).name == name), None)
        if found is None:
            raise IngestError(f"holds no {name}", str(archive), code="unreadable")
        if found.file_size > LARGEST_MEMBER:
            message = f"{name} has {found.file_size} bytes unpacked, and {LARGEST_MEMBER} are read"
            raise IngestError(message, str(archive), code="unreadable", hint="unpack the file")
        return opened.read(found)


@contextmanager
def _opened(archive: Path) -> Iterator[ZipFile]:
    """Open a zip file; raise ``IngestError`` where it is damaged or encrypted."""
    try:
        with ZipFile(archive) as opened:
            yield opened
    except (BadZipFile, RuntimeError, NotImplementedError) as error:
        raise IngestError(f"a zip file that cannot be read: {error}", str(archive)) from None


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
        with suppress(PermissionError):
            if status.st_size < LARGEST_POINTER and path.read_bytes().startswith(POINTER):
                return GIT_LFS
        return ""
    return f"is {KINDS.get(kind, 'no regular file')}; a regular file, or a symbolic link to one, is expected"


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


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a new file beside ``path``, which takes its place when it is complete."""
    new = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    yield new
    new.replace(path)


def refuse_foreign(start: bytes, path: str) -> None:
    """Raise ``IngestError`` for a file that begins like another kind of file."""
    what = kind_of(start)
    if what:
        raise IngestError(f"not a text log but {what}", path, code="utf16" if what == UTF_16 else "foreign")
