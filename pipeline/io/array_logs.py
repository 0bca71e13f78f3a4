"""Logs of other programs that hold arrays: ULog, DataFlash, HDF5 and MATLAB, each topic by topic.

    ULog       (pyulog)     each logged message is a topic; no units
    DataFlash  (pymavlink)  each message type is a topic, with the units of the messages FMTU, UNIT and MULT
    HDF5, MATLAB 7.3 (h5py), MATLAB 5 (scipy.io)
                            a group (a struct) is a topic, its arrays are the fields; samples run along the longer
                            dimension; a unit is the attribute ``unit`` or ``units``

A message of several sensors is ``IMU``, ``IMU[1]``, ``IMU[2]``. Where the arrays of a group differ in length, those of
one length are a topic with the name of its first array. Times of ULog and DataFlash are microseconds since power-on.
"""

from __future__ import annotations

import contextlib
import io
import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import IngestError
from pipeline.io.files import is_mat_5
from pipeline.records import Note

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from numpy.typing import NDArray
    from pymavlink.DFReader import DFReader_binary

    from pipeline.records import Integers

COPY_AGAIN = "copy the file again from its source"
ELEMENT = re.compile(r"(.+)\[(\d+)\]")
HEAD = 3  # bytes of a DataFlash message before its fields: two marks and its type
MARKS, FORMAT, LENGTH_OF_FORMAT = b"\xa3\x95", 0x80, 89  # libraries/AP_Logger/LogStructure.h of ArduPilot
MOST_GARBAGE = 528  # bytes at the end of a log that was written in blocks, as pymavlink allows
TIME = "TimeUS"
FEWEST_ROWS = 2  # shorter arrays are settings, not samples
DEEPEST = 3  # dimensions: images, not read
WIDEST = 64  # columns; a wider array is an image or a matrix
BYTES_OF_A_DOUBLE = 8  # longer numbers are no reading of a converter


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
    recorded_ns: Integers | None = None


def topics_of(path: Path, notes: list[Note]) -> Iterator[Topic]:
    """Yield the topics of a log by its suffix; what was lost is added to ``notes``, a damaged log is refused."""
    suffix = path.suffix.lower()
    if suffix == ".ulg":
        return _of_ulog(path, notes)
    return _of_dataflash(path, notes) if suffix == ".bin" else _of_arrays(path)


def _of_ulog(path: Path, notes: list[Note]) -> Iterator[Topic]:
    from pyulog import ULog  # noqa: PLC0415  (an extra)

    with path.open("rb") as stream, contextlib.redirect_stdout(io.StringIO()) as said:
        log = ULog(stream)
    complaint = said.getvalue().partition("\n")[0]
    if log.file_corruption or "corrupt" in complaint:
        message = f"damaged ULog file: {complaint or 'a part of it is no message'}"
        raise IngestError(message, str(path), hint=COPY_AGAIN)
    if log.dropouts:
        lost = sum(d.duration for d in log.dropouts)
        notes.append(Note("N-DROPOUT", len(log.dropouts), 0, 0, f"the logger lost data for {lost} ms in all"))
    for data in log.data_list:
        columns: dict[str, Any] = {}
        for name, values in data.data.items():  # the elements name[0], name[1] .. of a field are one (n, k) array
            element = ELEMENT.fullmatch(name)
            if element:
                columns.setdefault(element.group(1), []).append(values)
            else:
                columns[name] = values
        columns = {n: np.column_stack(v) if isinstance(v, list) else v for n, v in columns.items()}
        yield Topic(_instance(data.name, data.multi_id), columns, {}, data.data["timestamp"].astype(np.int64) * 1000)


def _instance(name: str, number: int) -> str:
    return f"{name}[{number}]" if number else name


def _of_dataflash(path: Path, notes: list[Note]) -> Iterator[Topic]:
    """Yield the topics of a log; refuse one in which other bytes stand between messages."""
    from pymavlink.DFReader import DFReader_binary  # noqa: PLC0415  (an extra)

    content = path.read_bytes()
    _check_chain(content, str(path), notes)
    data = np.frombuffer(content, np.uint8)
    with DFReader_binary(str(path)) as log:
        yield from _messages(log, data)


def _check_chain(content: bytes, path: str, notes: list[Note]) -> None:
    """Refuse a log whose messages do not follow one another to its end; the lengths are those of its FMT messages."""
    lengths, at = {FORMAT: LENGTH_OF_FORMAT}, 0
    while at + HEAD <= len(content):
        if content[at : at + 2] != MARKS or content[at + 2] not in lengths:
            if len(content) - at < MOST_GARBAGE and at:
                break
            message = (
                f"damaged, or no DataFlash log: {content[at : at + HEAD].hex(' ')} begins no message that it defines"
            )
            raise IngestError(message, path, code="damaged", offset=at, hint=COPY_AGAIN)
        if content[at + 2] == FORMAT and at + LENGTH_OF_FORMAT <= len(content):
            lengths[content[at + 3]] = content[at + 4]
        at += max(lengths[content[at + 2]], HEAD)
    if at != len(content):
        what = f"the log ends within a message, or with bytes that are none ({abs(len(content) - at)} bytes)"
        notes.append(Note("N-TRUNCATED", 1, 0, 0, f"{what}; the complete messages were used"))


def _messages(log: DFReader_binary, data: NDArray[np.uint8]) -> Iterator[Topic]:
    for number, known in log.formats.items():
        starts = np.array(log.offsets[number], np.int64)
        starts = starts[starts + known.len <= len(data)]
        fields = np.dtype([(n, _code(c)) for n, c in zip(known.columns, known.format, strict=False)])
        if not len(starts) or TIME not in known.columns or fields.itemsize + HEAD != known.len:
            continue
        windows = np.lib.stride_tricks.sliding_window_view(data, known.len)[starts, HEAD:]
        table = np.ascontiguousarray(windows).view(fields)[:, 0]
        columns = {  # a multiplier: the field is sent in hundredths, or another fraction, of its unit
            n: table[n] if m is None else table[n] / round(1.0 / m)
            for n, m in zip(known.columns, known.msg_mults, strict=True)
            if table[n].dtype.kind in "iuf"
        }
        units = {n: known.get_unit(n) for n in columns}
        instance = table[known.instance_field] if known.instance_field in columns else np.zeros(len(table), np.int64)
        for sensor in np.unique(instance).tolist():
            own = instance == sensor
            times = table[TIME][own].astype(np.int64) * 1000
            yield Topic(_instance(known.name, sensor), {n: c[own] for n, c in columns.items()}, units, times)


def _code(letter: str) -> str:
    """Return numpy's type of a DataFlash field by its letter in the format."""
    from pymavlink.DFReader import FORMAT_TO_STRUCT  # noqa: PLC0415  (an extra)

    code = FORMAT_TO_STRUCT[letter][0]
    return f"S{code[:-1]}" if code.endswith("s") else f"<{np.dtype(code).str[1:]}"


def _of_arrays(path: Path) -> Iterator[Topic]:
    if is_mat_5(path):
        from scipy.io import loadmat  # noqa: PLC0415  (few logs need it)

        content = loadmat(path, simplify_cells=True)
        yield from _of_group("", {n: v for n, v in content.items() if not n.startswith("__")})
    else:
        import h5py  # noqa: PLC0415  (an extra)

        with h5py.File(path, "r") as file:
            yield from _of_group("", _tree(file))


def _tree(group: Any) -> dict[str, Any]:  # noqa: ANN401  (h5py.Group)
    """Return the groups and arrays of an HDF5 file; an array with its unit is a pair."""
    found: dict[str, Any] = {}
    for name, item in group.items():
        if hasattr(item, "items"):
            found[name] = _tree(item) if name != "#refs#" else {}
        elif getattr(item, "ndim", DEEPEST) < DEEPEST:
            unit = next((item.attrs[k] for k in ("units", "unit") if k in item.attrs), "")
            found[name] = (item[()], unit.decode() if isinstance(unit, bytes) else str(unit))
    return found


def _of_group(place: str, tree: Mapping[str, Any]) -> Iterator[Topic]:
    """Yield the topics of a group, and of those in it."""
    arrays: dict[str, NDArray[Any]] = {}
    units: dict[str, str] = {}
    for name, item in tree.items():
        if isinstance(item, dict):
            yield from _of_group(f"{place}/{name}", item)
            continue
        value, unit = item if isinstance(item, tuple) else (item, "")
        array = np.asarray(value)
        if array.dtype.names:  # a table of named columns
            columns = {n: c for n in array.dtype.names if (c := _samples(array[n])) is not None}
            yield from _by_length(f"{place}/{name}", columns, {})
        elif (samples := _samples(array)) is not None:
            arrays[name], units[name] = samples, unit
    yield from _by_length(place, arrays, units)


def _by_length(place: str, arrays: Mapping[str, NDArray[Any]], units: Mapping[str, str]) -> Iterator[Topic]:
    """Yield the arrays of a group, those of one length together."""
    lengths = sorted({len(a) for a in arrays.values()})
    for length in lengths:
        own = {n: a for n, a in arrays.items() if len(a) == length}
        name = (place or "/") if len(lengths) == 1 else f"{place}/{min(own)}"
        yield Topic(name, own, {n: u for n, u in units.items() if n in own})


def _samples(array: NDArray[Any]) -> NDArray[Any] | None:
    """Return an array of numbers with its samples along the first dimension; None if it holds no samples."""
    if array.dtype.kind not in "iufb" or array.dtype.itemsize > BYTES_OF_A_DOUBLE:
        return None
    array = np.squeeze(array)
    if array.ndim == 2 and array.shape[0] < array.shape[1]:
        array = array.T
    if array.ndim not in (1, 2) or len(array) < FEWEST_ROWS or (array.ndim == 2 and array.shape[1] > WIDEST):
        return None
    return array.astype("u1") if array.dtype.kind == "b" else array
