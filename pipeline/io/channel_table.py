"""What a reader of one file format hands on: channels in house units, still along the sensor's own axes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from pipeline.records import Note

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

    from pipeline.records import Encoding


@dataclass(frozen=True)
class ChannelTable:
    """The samples of one file.

    ``values`` are in house units, by channel (``pipeline.io.units.CHANNELS``). ``line_of`` maps a row, counted from 0,
    to the line of the file, counted from 1; 0 where a format has no lines. ``flags``: what the reader itself marks.
    """

    path: str
    time_ns: NDArray[np.int64]
    values: dict[str, NDArray[np.float64]]
    source: dict[str, Any]
    line_of: Callable[[int], int]
    encodings: dict[str, Encoding] = field(default_factory=dict)
    notes: tuple[Note, ...] = ()
    flags: NDArray[np.uint16] | None = None

    def place(self, row: int) -> str:
        """Return ``path:line`` of a row, or the path where there are no lines."""
        line = self.line_of(row)
        return f"{self.path}:{line}" if line else self.path

    def note(self, code: str, rows: NDArray[np.intp], detail: str) -> Note:
        """Return a note on some rows, with their first and last line and time."""
        first, last = int(rows[0]), int(rows[-1])
        start, end = float(self.time_ns[first]) / 1e9, float(self.time_ns[last]) / 1e9
        return Note(code, int(rows.size), self.line_of(first), self.line_of(last), detail, start, end)
