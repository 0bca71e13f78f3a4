"""Read logs of other programs as messages: ROS bags by ``rosbags``, and logs of arrays.

    ULog       (pyulog)     each logged message is a topic; no units
    DataFlash  (pymavlink)  each message type is a topic, with the units of the messages FMTU, UNIT and MULT
    tlog       (pymavlink)  each type of MAVLink message is a topic, with the units of its definition
    HDF5, MATLAB 7.3 (h5py), MATLAB 5 (scipy.io), TDMS (nptdms), NumPy
                            a group (a struct) is a topic, its arrays are the fields; samples are along the longer
                            dimension; a unit is the attribute ``unit`` or ``units``

Arrays are converted to messages of one length. So ``message_read`` reads them with the same fields, units, clocks
and checks:

    message i = the bytes of row i of every array, little endian, one after the other

Messages of several sensors are the topics ``IMU``, ``IMU[1]``, ``IMU[2]``. Where the arrays of a group differ in
length, the arrays of each length are a topic with the name of its first array. Times of ULog and DataFlash are
microseconds since power-on. The libraries are extras of the package, imported when a log of their format is read.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import re
from collections.abc import Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from imu_logs.errors import IngestError
from imu_logs.files import BINARY, MESSAGE_FORMATS, PRINTABLE, MessageFormat, is_mat_5, kind_of
from imu_logs.log import Integers, Note
from imu_logs.mcap_file import COPY_AGAIN, HEAD, ChannelMessages, McapReader, MessageReader
from imu_logs.message_decoder import ARRAYS, STATED

Columns = Mapping[str, NDArray[Any]]

MESSAGES_OF_A_RUN = 4096  # messages of one topic of a bag that are decoded together
ELEMENT = re.compile(r"(.+)\[(\d+)\]")
MARKED = 3  # bytes of a DataFlash message before its fields: two marks and its type
MARKS, FORMAT, LENGTH_OF_FORMAT = b"\xa3\x95", 0x80, 89  # libraries/AP_Logger/LogStructure.h of ArduPilot
MOST_GARBAGE = 528  # bytes at the end of a log that was written in blocks, as pymavlink allows
TIMES_NS = {"TimeUS": 1000, "TimeMS": 1_000_000}  # of DataFlash; in ms before ArduPilot 3.3 of 2015
TIME_OF_TDMS = "time"
MIN_SAMPLE_ROWS = 2  # shorter arrays are settings, not samples
MAX_DIMENSIONS = 3  # dimensions: images, not read
MAX_COLUMNS = 64  # columns; a wider array is an image or a matrix
BYTES_OF_A_DOUBLE = 8  # longer numbers are no reading of a converter


class LogReader(MessageReader):
    """One pass over a log of another program: a bag, or arrays."""

    def __init__(self, path: Path, known: MessageFormat) -> None:
        super().__init__(str(path))
        self.file, self.kind = path, known.kind
        kinds = {".tlog": _of_telemetry, ".bin": _of_dataflash, ".ulg": _of_ulog, ".bag": _of_bag, ".db3": _of_bag}
        self.messages = kinds.get(path.suffix.lower(), _of_arrays)
        with path.open("rb") as stream:
            self.sha256 = hashlib.file_digest(stream, "sha256").hexdigest()

    def rows(self) -> Iterator[ChannelMessages]:
        """Yield the messages; any error of the format's library is raised as ``IngestError``."""
        try:
            for rows in self.messages(self):
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


def _of_columns(
    log: LogReader, name: str, columns: Columns, units: Mapping[str, str], recorded_ns: Integers | None = None
) -> ChannelMessages:
    """Convert the arrays of a topic, (n,) or (n, k) numbers by field, to messages.

    ``units``: stated in the file, by field; ``recorded_ns``: times of the logger.
    """
    log.has_recorder &= recorded_ns is not None
    codes = {n: f"<{a.dtype.kind}{a.dtype.itemsize}" for n, a in columns.items()}
    kind = np.dtype([(n, codes[n], a.shape[1:]) for n, a in columns.items()])
    count = len(next(iter(columns.values())))
    table, fields, places = np.empty(count, kind), dict(kind.fields or {}), []
    for field, array in columns.items():
        table[field] = array
        places.append([field, fields[field][1], codes[field], array.shape[1] if array.ndim > 1 else None])
    metadata = {STATED + field: unit for field, unit in units.items() if unit}
    channel = log.define(name, ARRAYS, (log.kind, ARRAYS, json.dumps(places).encode()), metadata)
    times = np.zeros(count) if recorded_ns is None else recorded_ns
    return _rows(channel, table.tobytes(), np.full(count, kind.itemsize, np.int64), times)


def _of_bag(log: LogReader) -> Iterator[ChannelMessages]:
    """Yield the messages of a ROS 1 bag, or of the SQLite file of a ROS 2 bag, in runs by connection."""
    version = 1 if log.file.suffix.lower() == ".bag" else 2
    with import_module(f"rosbags.rosbag{version}").Reader(log.file) as bag:
        numbers = {}
        for connection in bag.connections:
            text = _definition(connection, version)
            schema = (connection.msgtype, f"ros{version}msg" if text else "no", text.encode())  # no: not readable
            numbers[connection.id] = log.define(connection.topic, "ros1" if version == 1 else "cdr", schema, {})
        waiting: dict[int, list[tuple[int, bytes]]] = {c.id: [] for c in bag.connections}
        for connection, time, data in bag.messages(bag.connections):
            run = waiting[connection.id]
            run.append((time, data))
            if len(run) == MESSAGES_OF_A_RUN:
                yield _run_of(numbers[connection.id], run)
                run.clear()
        yield from (_run_of(numbers[key], run) for key, run in waiting.items() if run)


def _run_of(channel: int, run: list[tuple[int, bytes]]) -> ChannelMessages:
    times, messages = zip(*run, strict=True)
    sizes = np.array([*map(len, messages)], np.int64)
    return _rows(channel, b"".join(messages), sizes, np.array(times, np.int64))


def _definition(connection: Any, version: int) -> str:  # noqa: ANN401  (rosbags.interfaces.Connection)
    """Return the message definition; bags before ROS 2 Iron have none, for them that of Humble by ``rosbags``."""
    if version == 1 or connection.msgdef.format.name == "MSG":
        return str(connection.msgdef.data)
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415  (an extra)

    store, name = get_typestore(Stores.ROS2_HUMBLE), connection.msgtype
    return store.generate_msgdef(name, ros_version=2)[0] if name in store.fielddefs else ""


def _rows(channel: int, data: bytes | memoryview, sizes: Integers, times: NDArray[Any]) -> ChannelMessages:
    """Return messages that follow each other in ``data``; ``times``: of the recorder, ns."""
    heads = np.zeros(len(sizes), HEAD)
    heads["channel"], heads["log_time"] = channel, times
    stride = int(sizes[0]) if len(sizes) and bool((sizes == sizes[0]).all()) else 0
    starts = np.cumsum(sizes) - sizes
    return ChannelMessages(channel, np.frombuffer(data, np.uint8), heads, starts, sizes, stride, "the log", 0)


@contextlib.contextmanager
def open_reader(path: Path, *, allow_truncated: bool = False) -> Iterator[MessageReader]:
    """Open a log of messages by its suffix; raise ``IngestError`` if the package for the format is not installed."""
    known = MESSAGE_FORMATS.get(path.suffix.lower())
    if known is None:
        with path.open("rb") as stream:
            yield McapReader(stream, str(path), allow_truncated=allow_truncated)
        return
    library = "scipy.io" if is_mat_5(path) else known.library
    try:
        import_module(library)
    except ImportError as error:
        package = library.partition(".")[0]
        raise IngestError(
            f"reading {known.kind} needs the package {package}, which is not installed ({error})",
            str(path),
            code="missing_extra",
            hint=f"pip install 'imu-calibration[{known.extra}]'" if known.extra else f"pip install {package}",
        ) from error
    yield LogReader(path, known)


def _of_ulog(log: LogReader) -> Iterator[ChannelMessages]:
    from pyulog import ULog  # noqa: PLC0415  (an extra)

    with log.file.open("rb") as stream, contextlib.redirect_stdout(io.StringIO()) as output:
        ulog = ULog(stream)
    complaint = output.getvalue().partition("\n")[0]
    if ulog.file_corruption or "corrupt" in complaint:
        message = f"damaged ULog file: {complaint or 'a part of it is no message'}"
        raise IngestError(message, log.path, hint=COPY_AGAIN)
    if ulog.dropouts:
        lost = sum(d.duration for d in ulog.dropouts)
        log.notes.append(Note("N-DROPOUT", len(ulog.dropouts), 0, 0, f"the logger lost data for {lost} ms in all"))
    for data in ulog.data_list:
        columns: dict[str, Any] = {}
        for name, values in data.data.items():  # the elements name[0], name[1] .. of a field are one (n, k) array
            element = ELEMENT.fullmatch(name)
            if element:
                columns.setdefault(element.group(1), []).append(values)
            else:
                columns[name] = values
        columns = {n: np.column_stack(v) if isinstance(v, list) else v for n, v in columns.items()}
        times = data.data["timestamp"].astype(np.int64) * 1000
        yield _of_columns(log, _instance(data.name, data.multi_id), columns, {}, times)


def _instance(name: str, number: int) -> str:
    return f"{name}[{number}]" if number else name


def _check_chain(content: bytes, log: LogReader) -> None:
    """Raise ``IngestError`` for a log with other bytes between messages; FMT messages state the lengths."""
    lengths, at = {FORMAT: LENGTH_OF_FORMAT}, 0
    while at + MARKED <= len(content):
        if content[at : at + 2] != MARKS or content[at + 2] not in lengths:
            if len(content) - at < MOST_GARBAGE and at:
                break
            if not at and not content.startswith(MARKS[:1]):
                kind = kind_of(content[:PRINTABLE]) or BINARY
                message = f"no DataFlash log, as which .bin is read, but {kind} (it starts with {content[:4].hex(' ')})"
                raise IngestError(message, log.path, code="foreign")
            message = (
                f"damaged, or no DataFlash log: {content[at : at + MARKED].hex(' ')} begins no message that it defines"
            )
            raise IngestError(message, log.path, code="damaged", offset=at, hint=COPY_AGAIN)
        if content[at + 2] == FORMAT and at + LENGTH_OF_FORMAT <= len(content):
            lengths[content[at + 3]] = content[at + 4]
        at += max(lengths[content[at + 2]], MARKED)
    if at != len(content):
        what = f"the log ends within a message, or with bytes that are none ({abs(len(content) - at)} bytes)"
        log.notes.append(Note("N-TRUNCATED", 1, 0, 0, f"{what}; the complete messages were used"))


def _of_dataflash(log: LogReader) -> Iterator[ChannelMessages]:
    """Yield the topics of a log; raise ``IngestError`` if it has other bytes between messages."""
    from pymavlink.DFReader import FORMAT_TO_STRUCT, DFReader_binary  # noqa: PLC0415  (an extra)

    content = log.file.read_bytes()
    _check_chain(content, log)
    data = np.frombuffer(content, np.uint8)
    codes = {letter: code for letter, (code, *_) in FORMAT_TO_STRUCT.items()}  # as of ``struct``, texts as 16s
    kinds = {c: f"S{code[:-1]}" if code[-1:] == "s" else f"<{np.dtype(code).str[1:]}" for c, code in codes.items()}
    with DFReader_binary(log.path) as known_by_library:
        formats, offsets = known_by_library.formats, known_by_library.offsets
    for number, known in formats.items():
        starts = np.array(offsets[number], np.int64)
        starts = starts[starts + known.len <= len(data)]
        fields = np.dtype([(n, kinds[c]) for n, c in zip(known.columns, known.format, strict=False)])
        time = next((t for t in TIMES_NS if t in known.columns), None)
        if not len(starts) or time is None or fields.itemsize + MARKED != known.len:
            continue
        windows = np.lib.stride_tricks.sliding_window_view(data, known.len)[starts, MARKED:]
        table = np.ascontiguousarray(windows).view(fields)[:, 0]
        columns = {  # a multiplier: the field is sent in hundredths, or another fraction, of its unit
            n: table[n] if m is None else table[n] / round(1.0 / m)
            for n, m in zip(known.columns, known.msg_mults, strict=True)
            if table[n].dtype.kind in "iuf"
        }
        units = {n: known.get_unit(n) for n in columns}
        instance = table[known.instance_field] if known.instance_field in columns else np.zeros(len(table), np.int64)
        for sensor in np.unique(instance).tolist():
            of_sensor = instance == sensor
            times = table[time][of_sensor].astype(np.int64) * TIMES_NS[time]
            part = {n: c[of_sensor] for n, c in columns.items()}
            yield _of_columns(log, _instance(known.name, sensor), part, units, times)


def _of_telemetry(log: LogReader) -> Iterator[ChannelMessages]:
    """Yield the topics of a MAVLink telemetry log: packets, each after the time of the receiver in us."""
    from pymavlink import mavutil  # noqa: PLC0415  (an extra)

    found: dict[str, list[Any]] = {}
    connection = mavutil.mavlink_connection(log.path)
    try:
        while (message := connection.recv_msg()) is not None:
            if message.get_type() != "BAD_DATA":
                found.setdefault(message.get_type(), []).append(message)
    finally:
        connection.close()
    for name, messages in found.items():
        first = messages[0]
        columns = {f: np.array([getattr(m, f) for m in messages]) for f in first.get_fieldnames()}
        columns = {f: column for f, column in columns.items() if column.dtype.kind in "iuf" and column.ndim == 1}
        units = {f: unit for f, unit in first.fieldunits_by_name.items() if f in columns}
        recorded = np.rint(np.array([m._timestamp for m in messages]) * 1e6).astype(np.int64) * 1000  # noqa: SLF001
        if columns:
            yield _of_columns(log, name, columns, units, recorded)


def _of_arrays(log: LogReader) -> Iterator[ChannelMessages]:
    if log.kind == "NumPy":
        try:
            content = np.load(log.file, allow_pickle=False)
            arrays = dict(content) if isinstance(content, np.lib.npyio.NpzFile) else {log.file.stem: content}
        except ValueError as error:
            if "allow_pickle" not in str(error):
                raise
            message = "holds Python objects, which are not loaded, as they may run code: save arrays of numbers"
            raise IngestError(message, log.path, code="foreign") from None
        yield from _of_group(log, "", arrays)
    elif log.kind == "TDMS":
        from nptdms import TdmsFile  # noqa: PLC0415  (an extra)

        for group in TdmsFile.read(log.file).groups():
            channels = {c.name: (c[:], str(c.properties.get("unit_string", ""))) for c in group.channels() if len(c)}
            steps = {c.properties["wf_increment"] for c in group.channels() if "wf_increment" in c.properties}
            if len(steps) == 1 and TIME_OF_TDMS not in channels:  # a waveform: its times are counted
                rows = max(len(values) for values, _ in channels.values())
                channels[TIME_OF_TDMS] = (np.arange(rows) * float(steps.pop()), "s")
            yield from _of_group(log, f"/{group.name}", channels)
    elif is_mat_5(log.file):
        from scipy.io import loadmat  # noqa: PLC0415  (few logs need it)

        content = loadmat(log.file, simplify_cells=True)
        yield from _of_group(log, "", {n: v for n, v in content.items() if not n.startswith("__")})
    else:
        import h5py  # noqa: PLC0415  (an extra)

        with h5py.File(log.file, "r") as file:
            yield from _of_group(log, "", _tree(file))


def _tree(group: Any) -> dict[str, Any]:  # noqa: ANN401  (h5py.Group)
    """Return the groups and arrays of an HDF5 file; an array is a pair with its unit."""
    found: dict[str, Any] = {}
    for name, item in group.items():
        if hasattr(item, "items"):
            found[name] = _tree(item) if name != "#refs#" else {}
        elif getattr(item, "ndim", MAX_DIMENSIONS) < MAX_DIMENSIONS:
            unit = next((item.attrs[k] for k in ("units", "unit") if k in item.attrs), "")
            found[name] = (item[()], unit.decode() if isinstance(unit, bytes) else str(unit))
    return found


def _of_group(log: LogReader, place: str, tree: Mapping[str, object]) -> Iterator[ChannelMessages]:
    """Yield the topics of a group and of the groups in it."""
    arrays: dict[str, NDArray[Any]] = {}
    units: dict[str, str] = {}
    for name, item in tree.items():
        if isinstance(item, dict):
            yield from _of_group(log, f"{place}/{name}", item)
            continue
        value, unit = item if isinstance(item, tuple) else (item, "")
        array = np.asarray(value)
        if array.dtype.names:  # a table of named columns
            columns = {n: c for n in array.dtype.names if (c := _samples(array[n])) is not None}
            yield from _by_length(log, f"{place}/{name}", columns, {})
        elif (samples := _samples(array)) is not None:
            arrays[name], units[name] = samples, unit
    yield from _by_length(log, place, arrays, units)


def _by_length(log: LogReader, place: str, arrays: Columns, units: Mapping[str, str]) -> Iterator[ChannelMessages]:
    """Yield the arrays of a group as topics, one for each length."""
    lengths = sorted({len(a) for a in arrays.values()})
    for length in lengths:
        of_length = {n: a for n, a in arrays.items() if len(a) == length}
        name = (place or "/") if len(lengths) == 1 else f"{place}/{min(of_length)}"
        yield _of_columns(log, name, of_length, {n: u for n, u in units.items() if n in of_length})


def _samples(array: NDArray[Any]) -> NDArray[Any] | None:
    """Return an array of numbers with its samples along the first dimension; None if it has no samples."""
    if array.dtype.kind not in "iufb" or array.dtype.itemsize > BYTES_OF_A_DOUBLE:
        return None
    array = np.squeeze(array)
    if array.ndim == 2 and array.shape[0] < array.shape[1]:
        array = array.T
    if array.ndim not in (1, 2) or len(array) < MIN_SAMPLE_ROWS or (array.ndim == 2 and array.shape[1] > MAX_COLUMNS):
        return None
    return array.astype("u1") if array.dtype.kind == "b" else array
