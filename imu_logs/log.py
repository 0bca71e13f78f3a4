"""The record of a log: the channels of one file, or of several files of one clock, in g, deg/s, deg and degC."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from imu_logs.errors import IngestError
from imu_logs.units import CANONICAL, COUNTS, SECOND_NS, UNITS

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pandas as pd
    import pyarrow as pa
    from numpy.typing import NDArray

    from imu_logs.profile import ChannelSource

# Types of arrays: quantities, masks of samples, integers, indices of samples.
Values: TypeAlias = "NDArray[np.float64]"
Mask: TypeAlias = "NDArray[np.bool_]"
Integers: TypeAlias = "NDArray[np.int64]"
Index: TypeAlias = "NDArray[np.intp]"

REPAIRED = np.uint16(8)  # bit of ``Log.flags``: the row was moved


@dataclass(frozen=True)
class Note:
    """A machine-readable remark on an input: what was found or repaired, how often and where.

    ``first`` and ``last`` are line numbers in the file, from 1, or 0 if lines do not apply. ``start_s`` and ``end_s``
    are the times of the first and the last sample concerned, in the clock of the file. ``settings``: the overrides that
    state what was found, so that it is no longer noted; alternatives, each of one or more overrides.
    """

    code: str
    count: int
    first: int
    last: int
    detail: str
    start_s: float | None = None
    end_s: float | None = None
    settings: tuple[tuple[str, ...], ...] = ()

    @classmethod
    def of(cls, entry: dict[str, Any]) -> Note:
        """Return the note of an entry that ``to_json`` made."""
        return cls(**{**entry, "settings": tuple(map(tuple, entry.get("settings", ())))})

    def to_json(self) -> dict[str, Any]:
        """Return the fields, without empty ``settings``."""
        return {key: value for key, value in vars(self).items() if key != "settings" or value}


@dataclass(frozen=True)
class Log:
    """A log that was read; channels are those of ``imu_logs.units.CHANNELS``."""

    path: str  # of the file, for messages
    time_ns: Integers  # (n,), time of each row, ns, in the clock of the log: since power-on, or since 1970
    values: dict[str, Values]  # channel to (n,) array, in the unit of ``units``
    source: dict[str, Any]  # ``file``, ``sha256`` and ``rows`` of the file; ``joined``: those of further files
    lines: Integers | None = None  # (n,), line of each row, counted from 1; None for a format without lines
    count_sizes: dict[str, float] = field(default_factory=dict)  # one count of channels that are logged as counts
    notes: tuple[Note, ...] = ()  # what was found or repaired
    flags: NDArray[np.uint16] | None = None  # (n,), ``REPAIRED`` where the row was moved
    apart: tuple[Log, ...] = ()  # logs of the recording with a clock of their own, such as that of a table

    @property
    def units(self) -> dict[str, str]:
        """The unit of each channel: g, deg/s, deg, degC, or 1 for a quaternion."""
        return {channel: next(iter(UNITS[channel])) for channel in self.values}

    @property
    def time(self) -> Values:
        """Time of each row, s: (n,) array. Times since 1970 keep 2e-7 s only; ``time_ns`` is exact."""
        return np.asarray(self.time_ns // SECOND_NS + (self.time_ns % SECOND_NS) / SECOND_NS)

    def to_pandas(self) -> pd.DataFrame:
        """Return a DataFrame with the columns of the canonical CSV: ``time_s``, ``accel_x_g`` .. ``gyro_z_dps`` ..

        ``attrs`` holds ``units`` by column, ``source`` and ``notes``.
        """
        import pandas as pd  # noqa: PLC0415  (who calls this has imported it)

        frame = pd.DataFrame({CANONICAL["time"]: self.time} | {CANONICAL[c]: v for c, v in self.values.items()})
        frame.attrs["units"] = {CANONICAL["time"]: "s"} | {CANONICAL[c]: unit for c, unit in self.units.items()}
        frame.attrs["source"], frame.attrs["notes"] = self.source, [note.to_json() for note in self.notes]
        return frame

    def to_arrow(self) -> pa.Table:
        """Return an Arrow table with ``time_ns`` (int64) and the columns of ``to_pandas`` (double).

        Each field states its ``unit`` in its metadata; the metadata of the table are ``source`` and ``notes``, as JSON.
        """
        import pyarrow as pa  # noqa: PLC0415  (only where it is needed)

        columns = {"time_ns": self.time_ns} | {CANONICAL[c]: v for c, v in self.values.items()}
        units = {"time_ns": "ns"} | {CANONICAL[c]: unit for c, unit in self.units.items()}
        fields = [pa.field(n, pa.from_numpy_dtype(v.dtype), metadata={"unit": units[n]}) for n, v in columns.items()]
        told = {"source": json.dumps(self.source), "notes": json.dumps([note.to_json() for note in self.notes])}
        return pa.Table.from_arrays(list(map(pa.array, columns.values())), schema=pa.schema(fields, metadata=told))

    def place(self, row: int) -> str:
        """Return ``path:line`` of a row, or the path for a format without lines."""
        return self.path if self.lines is None else f"{self.path}:{self.lines[row]}"

    def note(self, code: str, rows: Index, detail: str) -> Note:
        """Return a note on rows, with their first and last line and time."""
        first, last = int(rows[0]), int(rows[-1])
        start, end = float(self.time_ns[first]) / 1e9, float(self.time_ns[last]) / 1e9
        lines = (0, 0) if self.lines is None else (int(self.lines[first]), int(self.lines[last]))
        return Note(code, int(rows.size), *lines, detail, start, end)

    def select(self, rows: Index | slice, *notes: Note) -> Log:
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
    multiplier, divisor = UNITS[source.channel][source.unit]
    if multiplier != 1.0:
        numbers = numbers * multiplier
    return numbers / divisor if divisor != 1.0 else numbers


def joined(tables: Sequence[Log]) -> Log:
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
        apart=tuple(log for t in tables for log in t.apart),
    )
