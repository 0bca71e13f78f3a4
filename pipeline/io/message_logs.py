"""Logs of other programs as messages: the one interface between a format's reader and the decoding of messages.

A reader of a format yields the arrays of each topic (``Topic``), or the messages of ROS (``pipeline.io.ros_bag``).
Arrays become messages of one length, so that fields, units, clocks and checks are those of MCAP (``pipeline.io.mcap``):

    message i = the bytes of row i of every array, little endian, one after the other

The readers' libraries are extras of the package, imported when a log of their format is read.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
from mcap.records import Channel, Schema

from pipeline.errors import IngestError
from pipeline.io.files import MESSAGE_FORMATS
from pipeline.io.mcap_channels import STATED
from pipeline.io.mcap_chunk import HEAD, Rows
from pipeline.io.mcap_reader import McapReader
from pipeline.io.message_decoder import ARRAYS

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from pipeline.io.mcap_channels import AnyReader
    from pipeline.records import Note


@dataclass(frozen=True)
class Topic:
    """The messages of one topic as arrays.

    Attributes
    ----------
    name : str
        Of the topic; where a log holds it several times, ``name[1]``, ``name[2]`` from the second one on.
    columns : mapping of str to array
        Field to (n,) or (n, k) numbers, all of the same n.
    units : mapping of str to str
        Field to the unit that the file states, as it writes it.
    recorded_ns : (n,) array of int64, optional
        Times of the logger.
    """

    name: str
    columns: Mapping[str, NDArray[Any]]
    units: Mapping[str, str] = field(default_factory=dict)
    recorded_ns: NDArray[np.int64] | None = None


class LogReader:
    """One pass over a log; attributes as of ``McapReader``.

    ``notes`` are those of the format. ``has_recorder``: whether the messages have times of the logger.
    """

    verified, truncated = False, ""

    def __init__(self, path: Path, kind: str) -> None:
        self.file, self.path, self.kind = path, str(path), kind
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.counts: Counter[int] = Counter()
        self.notes: list[Note] = []
        self.has_recorder = True
        with path.open("rb") as stream:
            self.sha256 = hashlib.file_digest(stream, "sha256").hexdigest()

    @property
    def count(self) -> int:
        """Number of messages so far."""
        return self.counts.total()

    def messages(self) -> Iterator[Rows]:
        """Yield the messages; a subclass reads them from arrays or bytes."""
        raise NotImplementedError

    def rows(self) -> Iterator[Rows]:
        """Yield the messages; what the format's library refuses raises ``IngestError``."""
        try:
            for rows in self.messages():
                self.counts[rows.channel] += len(rows.starts)
                yield rows
        except IngestError:
            raise
        except Exception as error:
            reason = f"{type(error).__name__}: {error}".strip()
            message = f"damaged, or no {self.kind} file: {reason}; {self.count} messages were readable before"
            raise IngestError(message, self.path, code="damaged", hint="copy the file again from its source") from error

    def define(self, topic: str, encoding: str, schema: tuple[str, str, bytes], metadata: dict[str, str]) -> int:
        """Add a channel with its message definition (name, encoding, text), and return its number."""
        number = len(self.channels) + 1
        self.schemas[number] = Schema(number, schema[2], schema[1], schema[0])
        self.channels[number] = Channel(number, topic, encoding, metadata, number)
        return number


class ArrayReader(LogReader):
    """A log whose reader ``topics(path, notes)`` yields arrays."""

    def messages(self) -> Iterator[Rows]:
        """Yield the arrays of each topic as messages."""
        for topic in _topics(self.file, self.notes):
            self.has_recorder &= topic.recorded_ns is not None
            table = _table(topic.columns)
            fields: Mapping[str, Any] = table.dtype.fields or {}
            places = [[name, place[1], *_type(place[0])] for name, place in fields.items()]
            metadata = {STATED + name: unit for name, unit in topic.units.items() if unit}
            definition = (self.kind, ARRAYS, json.dumps(places).encode())
            yield _rows(self.define(topic.name, ARRAYS, definition, metadata), table, topic.recorded_ns)


def _topics(path: Path, notes: list[Note]) -> Iterator[Topic]:
    """Yield the arrays of a log by the module of its format."""
    suffix = path.suffix.lower()
    if suffix == ".ulg":
        from pipeline.io import ulog  # noqa: PLC0415  (each log needs one of the three)

        return ulog.topics(path, notes)
    if suffix == ".bin":
        from pipeline.io import dataflash  # noqa: PLC0415

        return dataflash.topics(path, notes)
    from pipeline.io import array_file  # noqa: PLC0415

    return array_file.topics(path, notes)


def _table(columns: Mapping[str, NDArray[Any]]) -> NDArray[np.void]:
    """Return arrays side by side as the items of one packed array."""
    types = [(n, np.dtype(f"<{a.dtype.kind}{a.dtype.itemsize}"), a.shape[1:]) for n, a in columns.items()]
    table = np.empty(len(next(iter(columns.values()))), np.dtype(types))
    for name, array in columns.items():
        table[name] = array
    return table


def _type(kind: np.dtype[Any]) -> tuple[str, int | None]:
    """Return the type of a field's numbers, and their count; None for a single one."""
    if kind.subdtype is None:
        return kind.str.replace("|", "<"), None
    return kind.subdtype[0].str.replace("|", "<"), int(np.prod(kind.subdtype[1]))


def _rows(channel: int, table: NDArray[np.void], recorded_ns: NDArray[np.int64] | None) -> Rows:
    count, size = len(table), table.dtype.itemsize
    data = table.view(np.uint8).reshape(-1) if size else np.empty(0, np.uint8)
    starts = np.arange(count, dtype=np.int64) * size
    return rows_of(channel, data, starts, np.full(count, size), np.zeros(count) if recorded_ns is None else recorded_ns)


def rows_of(
    channel: int, data: NDArray[np.uint8], starts: NDArray[np.int64], sizes: NDArray[np.int64], times: NDArray[Any]
) -> Rows:
    """Return messages in ``data`` as ``McapReader`` does; ``times`` are the recorder's, ns."""
    heads = np.zeros(len(starts), HEAD)
    heads["channel"], heads["log_time"] = channel, times
    same = len(sizes) and bool((sizes == sizes[0]).all()) and bool((np.diff(starts) == sizes[0]).all())
    return Rows(channel, data, heads, starts, sizes, int(sizes[0]) if same else 0, "the log", 0)


def open_log(path: Path) -> LogReader:
    """Return the reader of a log other than MCAP, by its suffix.

    Raises
    ------
    IngestError
        If the package that reads the format is not installed; the error names the extra.
    """
    known = MESSAGE_FORMATS[path.suffix.lower()]
    library = library_of(path)
    try:
        import_module(library)
    except ImportError as error:
        raise IngestError(
            f"reading {known.kind} needs the package {library.partition('.')[0]}, which is not installed ({error})",
            str(path),
            code="missing_extra",
            hint=f"pip install 'imu-calibration[{known.extra}]'",
        ) from error
    if known.extra == "ros":
        from pipeline.io.ros_bag import BagReader  # noqa: PLC0415  (few logs need it)

        return BagReader(path, known.kind)
    return ArrayReader(path, known.kind)


@contextmanager
def open_reader(path: Path, *, allow_truncated: bool = False) -> Iterator[AnyReader]:
    """Open a log of messages of any format, MCAP included."""
    if path.suffix.lower() in MESSAGE_FORMATS:
        yield open_log(path)
        return
    with path.open("rb") as stream:
        yield McapReader(stream, str(path), allow_truncated=allow_truncated)


def library_of(path: Path) -> str:
    """Return the module that reads a log, ``scipy.io`` for MATLAB files before version 7.3, which are no HDF5."""
    library = MESSAGE_FORMATS[path.suffix.lower()].library
    if path.suffix.lower() == ".mat":
        with path.open("rb") as stream:
            return library if stream.read(10) == b"MATLAB 7.3" else "scipy.io"
    return library
