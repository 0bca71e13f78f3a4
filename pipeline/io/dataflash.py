"""ArduPilot's DataFlash logs (binary), indexed by ``pymavlink``: each message type is a topic, its numbers are columns.

The messages of several sensors are ``IMU``, ``IMU[1]``, ``IMU[2]`` (by the field that the log marks as instance). Units
are those of the messages FMTU, UNIT and MULT. Times are microseconds since power-on.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import IngestError
from pipeline.io.message_logs import Topic
from pipeline.records import Note

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray
    from pymavlink.DFReader import DFReader_binary

HEAD = 3  # bytes of a message before its fields: two marks and its type
MARKS, FORMAT, LENGTH_OF_FORMAT = b"\xa3\x95", 0x80, 89  # libraries/AP_Logger/LogStructure.h of ArduPilot
MOST_GARBAGE = 528  # bytes at the end of a log that was written in blocks, as pymavlink allows
TIME = "TimeUS"


def topics(path: Path, notes: list[Note]) -> Iterator[Topic]:
    """Yield the topics of a log; refuse one in which other bytes stand between messages."""
    from pymavlink.DFReader import DFReader_binary  # noqa: PLC0415  (an extra)

    content = path.read_bytes()
    _check_chain(content, str(path), notes)
    data = np.frombuffer(content, np.uint8)
    with DFReader_binary(str(path)) as log:
        yield from _topics(log, data)


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
            raise IngestError(message, path, code="damaged", offset=at, hint="copy the file again from its source")
        if content[at + 2] == FORMAT and at + LENGTH_OF_FORMAT <= len(content):
            lengths[content[at + 3]] = content[at + 4]
        at += max(lengths[content[at + 2]], HEAD)
    if at != len(content):
        what = f"the log ends within a message, or with bytes that are none ({abs(len(content) - at)} bytes)"
        notes.append(Note("N-TRUNCATED", 1, 0, 0, f"{what}; the complete messages were used"))


def _topics(log: DFReader_binary, data: NDArray[np.uint8]) -> Iterator[Topic]:
    for number, known in log.formats.items():
        starts = np.array(log.offsets[number], np.int64)
        starts = starts[starts + known.len <= len(data)]
        fields = np.dtype([(n, _code(c)) for n, c in zip(known.columns, known.format, strict=False)])
        if not len(starts) or TIME not in known.columns or fields.itemsize + HEAD != known.len:
            continue
        windows = np.lib.stride_tricks.sliding_window_view(data, known.len)[starts, HEAD:]
        table = np.ascontiguousarray(windows).view(fields)[:, 0]
        columns = {
            n: _scaled(table[n], m) for n, m in zip(known.columns, known.msg_mults, strict=True) if _number(table[n])
        }
        units = {n: known.get_unit(n) for n in columns}
        instance = table[known.instance_field] if known.instance_field in columns else np.zeros(len(table), np.int64)
        for sensor in np.unique(instance).tolist():
            own = instance == sensor
            name = f"{known.name}[{sensor}]" if sensor else known.name
            yield Topic(name, {n: c[own] for n, c in columns.items()}, units, table[TIME][own].astype(np.int64) * 1000)


def _code(letter: str) -> str:
    """Return numpy's type of a field by its letter in the format."""
    from pymavlink.DFReader import FORMAT_TO_STRUCT  # noqa: PLC0415  (an extra)

    code = FORMAT_TO_STRUCT[letter][0]
    return f"S{code[:-1]}" if code.endswith("s") else f"<{np.dtype(code).str[1:]}"


def _number(values: NDArray[Any]) -> bool:
    return values.dtype.kind in "iuf"


def _scaled(values: NDArray[Any], multiplier: float | None) -> NDArray[Any]:
    """Return the numbers of a field that is sent in hundredths, or another fraction, of its unit."""
    return values if multiplier is None else values / round(1.0 / multiplier)
