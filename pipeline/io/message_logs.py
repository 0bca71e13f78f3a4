"""Logs of other programs as messages: ROS bags by ``rosbags``, and arrays (``pipeline.io.array_logs``).

Arrays become messages of one length, so that fields, units, clocks and checks are those of MCAP (``pipeline.io.mcap``):

    message i = the bytes of row i of every array, little endian, one after the other

The readers' libraries are extras of the package, imported when a log of their format is read.
"""

from __future__ import annotations

import hashlib
import json
from contextlib import contextmanager
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
from mcap.records import Channel, Schema

from pipeline.errors import IngestError
from pipeline.io.array_logs import COPY_AGAIN, topics_of
from pipeline.io.files import MESSAGE_FORMATS, is_mat_5
from pipeline.io.mcap_channels import STATED
from pipeline.io.mcap_chunk import HEAD, Rows
from pipeline.io.mcap_reader import McapReader, MessageReader
from pipeline.io.message_decoder import ARRAYS

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from pipeline.records import Integers


RUN_SIZE = 4096  # messages of one topic of a bag that are decoded together


class LogReader(MessageReader):
    """One pass over a log of another program."""

    def __init__(self, path: Path, kind: str) -> None:
        super().__init__(str(path))
        self.file, self.kind = path, kind
        with path.open("rb") as stream:
            self.sha256 = hashlib.file_digest(stream, "sha256").hexdigest()

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
            raise IngestError(message, self.path, code="damaged", hint=COPY_AGAIN) from error

    def define(self, topic: str, encoding: str, schema: tuple[str, str, bytes], metadata: dict[str, str]) -> int:
        """Add a channel with its message definition (name, encoding, text), and return its number."""
        number = len(self.channels) + 1
        self.schemas[number] = Schema(number, schema[2], schema[1], schema[0])
        self.channels[number] = Channel(number, topic, encoding, metadata, number)
        return number


class ArrayReader(LogReader):
    """A log of arrays."""

    def messages(self) -> Iterator[Rows]:
        """Yield the arrays of each topic as messages."""
        for topic in topics_of(self.file, self.notes):
            self.has_recorder &= topic.recorded_ns is not None
            codes = {n: f"<{a.dtype.kind}{a.dtype.itemsize}" for n, a in topic.columns.items()}
            kind = np.dtype([(n, codes[n], a.shape[1:]) for n, a in topic.columns.items()])
            count, size = len(next(iter(topic.columns.values()))), kind.itemsize
            table, fields, places = np.empty(count, kind), dict(kind.fields or {}), []
            for name, array in topic.columns.items():
                table[name] = array
                places.append([name, fields[name][1], codes[name], array.shape[1] if array.ndim > 1 else None])
            metadata = {STATED + name: unit for name, unit in topic.units.items() if unit}
            channel = self.define(topic.name, ARRAYS, (self.kind, ARRAYS, json.dumps(places).encode()), metadata)
            times = np.zeros(count) if topic.recorded_ns is None else topic.recorded_ns
            data = table.view(np.uint8).reshape(-1) if size else np.empty(0, np.uint8)
            yield _rows(channel, data, np.arange(count, dtype=np.int64) * size, np.full(count, size), times)


class BagReader(LogReader):
    """A ROS 1 bag, or the SQLite file of a ROS 2 bag; the messages are decoded as those of an MCAP file.

    ROS 2 wrote no message definitions into a bag before version Iron; then those of ``rosbags`` for Humble are used.
    """

    def messages(self) -> Iterator[Rows]:
        """Yield the messages of each connection in runs, in the order of the recorder's times."""
        version = 1 if self.file.suffix.lower() == ".bag" else 2
        with import_module(f"rosbags.rosbag{version}").Reader(self.file) as bag:
            numbers = {c.id: self._channel(c, version) for c in bag.connections}
            waiting: dict[int, list[tuple[int, bytes]]] = {c.id: [] for c in bag.connections}
            for connection, time, data in bag.messages(bag.connections):
                run = waiting[connection.id]
                run.append((time, data))
                if len(run) == RUN_SIZE:
                    yield _joined(numbers[connection.id], run)
                    run.clear()
            for key, run in waiting.items():
                if run:
                    yield _joined(numbers[key], run)

    def _channel(self, connection: Any, version: int) -> int:  # noqa: ANN401  (rosbags.interfaces.Connection)
        text = connection.msgdef.data
        if version == 2 and connection.msgdef.format.name != "MSG":
            from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415  (an extra)

            store, name = get_typestore(Stores.ROS2_HUMBLE), connection.msgtype
            text = store.generate_msgdef(name, ros_version=2)[0] if name in store.fielddefs else ""
        schema = (connection.msgtype, f"ros{version}msg" if text else "no", text.encode())  # no: the topic is not read
        return self.define(connection.topic, "ros1" if version == 1 else "cdr", schema, {})


def _joined(channel: int, run: list[tuple[int, bytes]]) -> Rows:
    sizes = np.array([len(data) for _, data in run], np.int64)
    data = np.frombuffer(b"".join(data for _, data in run), np.uint8)
    return _rows(channel, data, np.cumsum(sizes) - sizes, sizes, np.array([time for time, _ in run], np.int64))


def _rows(channel: int, data: NDArray[np.uint8], starts: Integers, sizes: Integers, times: NDArray[Any]) -> Rows:
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
    library = "scipy.io" if is_mat_5(path) else known.library
    try:
        import_module(library)
    except ImportError as error:
        raise IngestError(
            f"reading {known.kind} needs the package {library.partition('.')[0]}, which is not installed ({error})",
            str(path),
            code="missing_extra",
            hint=f"pip install 'imu-calibration[{known.extra}]'",
        ) from error
    return (BagReader if known.extra == "ros" else ArrayReader)(path, known.kind)


@contextmanager
def open_reader(path: Path, *, allow_truncated: bool = False) -> Iterator[MessageReader]:
    """Open a log of messages of any format, MCAP included."""
    if path.suffix.lower() in MESSAGE_FORMATS:
        yield open_log(path)
        return
    with path.open("rb") as stream:
        yield McapReader(stream, str(path), allow_truncated=allow_truncated)
