"""PX4's ULog, read by ``pyulog``: each logged message is a topic, and its fields are the columns.

A message that is logged several times is ``sensor_accel``, ``sensor_accel[1]``, ``sensor_accel[2]``. Times are
microseconds since power-on; the format states no units.
"""

from __future__ import annotations

import contextlib
import io
import re
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import IngestError
from pipeline.io.message_logs import Topic
from pipeline.records import Note

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

ELEMENT = re.compile(r"(.+)\[(\d+)\]")


def topics(path: Path, notes: list[Note]) -> Iterator[Topic]:
    """Yield the topics of a log; refuse one that ``pyulog`` finds damaged, and note where the logger lost data."""
    from pyulog import ULog  # noqa: PLC0415  (an extra)

    with path.open("rb") as stream, contextlib.redirect_stdout(io.StringIO()) as said:
        log = ULog(stream)
    complaint = said.getvalue().partition("\n")[0]
    if log.file_corruption or "corrupt" in complaint:
        message = f"damaged ULog file: {complaint or 'a part of it is no message'}"
        raise IngestError(message, str(path), hint="copy the file again from its source")
    if log.dropouts:
        lost = sum(d.duration for d in log.dropouts)
        notes.append(Note("N-DROPOUT", len(log.dropouts), 0, 0, f"the logger lost data for {lost} ms in all"))
    for data in log.data_list:
        name = f"{data.name}[{data.multi_id}]" if data.multi_id else data.name
        yield Topic(name, joined(data.data), recorded_ns=data.data["timestamp"].astype(np.int64) * 1000)


def joined(columns: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return columns in which the elements ``name[0]``, ``name[1]`` .. of a field are one (n, k) array."""
    out: dict[str, Any] = {}
    for name, values in columns.items():
        element = ELEMENT.fullmatch(name)
        if element is None:
            out[name] = values
        else:
            out.setdefault(element.group(1), []).append(values)
    return {n: np.column_stack(v) if isinstance(v, list) else v for n, v in out.items()}
