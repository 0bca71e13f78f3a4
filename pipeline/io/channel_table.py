"""The channels of one file in house units, and their rotation from the sensor's axes to the body's axes.

    body[m_i] = s_i * reading_i,   axis_map[i] = s_i m_i

where axis i of the reading points along the body axis m_i with the sign s_i. Some chips have a left-handed
accelerometer frame and a right-handed gyroscope frame, so that each sensor may have a separate map.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import ConfigurationError, IngestError
from pipeline.io.units import COUNTS, TRIADS, to_house_unit
from pipeline.records import AXES, Note

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.io.ingest_settings import ChannelSource
    from pipeline.records import Index, Integers, Values
    from pipeline.settings import Sensor

STRAIGHT = ("+x", "+y", "+z")


@dataclass(frozen=True)
class ChannelTable:
    """The samples of one file.

    ``values`` are in house units, by channel (``pipeline.io.units.CHANNELS``). ``lines``: the line of each row, counted
    from 1; None for a format without lines. ``flags``: quality flags from the reader. ``count_sizes``: one count in the
    house unit, for channels that are logged as counts.
    """

    path: str
    time_ns: Integers
    values: dict[str, Values]
    source: dict[str, Any]
    lines: Integers | None = None
    count_sizes: dict[str, float] = field(default_factory=dict)
    notes: tuple[Note, ...] = ()
    flags: NDArray[np.uint16] | None = None

    def place(self, row: int) -> str:
        """Return ``path:line`` of a row, or the path for a format without lines."""
        return self.path if self.lines is None else f"{self.path}:{self.lines[row]}"

    def note(self, code: str, rows: Index, detail: str) -> Note:
        """Return a note on rows, with their first and last line and time."""
        first, last = int(rows[0]), int(rows[-1])
        start, end = float(self.time_ns[first]) / 1e9, float(self.time_ns[last]) / 1e9
        lines = (0, 0) if self.lines is None else (int(self.lines[first]), int(self.lines[last]))
        return Note(code, int(rows.size), *lines, detail, start, end)

    def select(self, rows: Index | slice, *notes: Note) -> ChannelTable:
        """Select rows, and add notes."""
        return replace(
            self,
            time_ns=self.time_ns[rows],
            values={channel: values[rows] for channel, values in self.values.items()},
            lines=None if self.lines is None else self.lines[rows],
            notes=(*self.notes, *notes),
            flags=None if self.flags is None else self.flags[rows],
        )


def in_house_unit(source: ChannelSource, numbers: Values) -> Values:
    """Convert the numbers of a channel (not the time) to g, deg/s, deg or degC."""
    if source.unit == COUNTS:
        return (numbers - source.offset) * (1.0 / source.counts_per_unit)
    return to_house_unit(source.channel, numbers, source.unit)


def joined(tables: Sequence[ChannelTable]) -> ChannelTable:
    """Join files row by row; raise ``IngestError`` if they were not logged at the same times."""
    first, *others = tables
    same = "parts of one recording need the same times"
    for other in others:
        rows = min(len(first.time_ns), len(other.time_ns))
        differs = np.flatnonzero(first.time_ns[:rows] != other.time_ns[:rows])
        if differs.size:
            row = int(differs[0])
            times = f"time {other.time_ns[row] / 1e9:.9g} s differs from {first.time_ns[row] / 1e9:.9g} s"
            hint = "a table's log with a clock of its own is marked own_clock: true"
            message = f"{times} in {first.place(row)}; {same}"
            raise IngestError(message, other.place(row), code="other_times", hint=hint)
        if len(first.time_ns) != len(other.time_ns):
            message = f"{other.source['rows']} rows, but {first.path} has {first.source['rows']}; {same}"
            raise IngestError(message, other.path, code="other_times")
    if not others:
        return first
    return replace(
        first,
        values={k: v for t in tables for k, v in t.values.items()},
        source={**first.source, "joined": [t.source for t in others]},
        count_sizes={k: v for t in tables for k, v in t.count_sizes.items()},
        notes=tuple(n for t in tables for n in t.notes),
    )


def axis_matrix(axis_map: Sequence[str]) -> Values:
    """Return the (3, 3) signed permutation ``B`` of an axis map, ``body = B @ reading``."""
    entries = [str(a) for a in axis_map]
    if [a for a in entries if a[:1] not in "+-" or a[1:] not in AXES] or sorted(a[1:] for a in entries) != list(AXES):
        raise ConfigurationError(
            f"sensor.axis_map is [{', '.join(entries)}]; it names the body axis that the sensor's x, y and z point "
            "along, each once and with its sign, for example [+y, -x, +z]"
        )
    matrix = np.zeros((3, 3))
    for reading, entry in enumerate(entries):
        matrix[AXES.index(entry[1:]), reading] = 1.0 if entry[0] == "+" else -1.0
    return matrix


def axis_maps(sensor: Sensor | None) -> dict[str, tuple[str, ...]]:
    """Return the axis map of each sensor: its own, else that of the sensor model; straight without a model."""
    return {s: STRAIGHT if sensor is None else tuple(sensor.of(s).axis_map or sensor.axis_map) for s in TRIADS}


def maps_of_log(log: Mapping[str, Any]) -> dict[str, tuple[str, ...]]:
    """Return the axis maps in the section ``log`` of a calibration: one per sensor, in older files one for both."""
    stated = log.get("axis_map") or STRAIGHT
    return {s: tuple(stated[s] if isinstance(stated, dict) else stated) for s in TRIADS}


def in_body_axes(axis_map: Sequence[str], readings: Values) -> Values:
    """Rotate (n, 3) readings to the body's axes; return the same array if the map is straight."""
    if tuple(axis_map) == STRAIGHT:
        return readings
    matrix = axis_matrix(axis_map)
    turned: Values = readings[:, np.argmax(np.abs(matrix), axis=1)] * matrix.sum(axis=1)
    return turned


def map_of_orientation(text: str) -> tuple[str, ...]:
    """Return the axis map of an orientation such as YxZ: body axis j is the reading named by letter j."""
    found = {name.lower(): ("+" if name.isupper() else "-") + body for name, body in zip(text, AXES, strict=True)}
    return tuple(found[axis] for axis in AXES)
