"""The rows of a text log as numbers, whichever way they were read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pipeline.io.csv_layout import LineNumbers
    from pipeline.io.ingest_settings import Column
    from pipeline.records import Note


@dataclass(frozen=True)
class Rows:
    """The numbers of a text log.

    Attributes
    ----------
    path, sha256 : str
    names : list of str
        All columns, for messages.
    columns : list of (Column, int)
        The channels that the file holds and the index of their column.
    numbers : dict of int to (n,) array
        Those columns, by index.
    exact_ns : (n,) array of int64, ns, or None
        Times from their decimal digits, where doubles are too coarse.
    line_of : LineNumbers
    notes : tuple of Note
    repaired : int
        Rows that were dropped, out of the budget.
    restarts : tuple of int
        Rows before which a header stood again.
    """

    path: str
    sha256: str
    names: list[str]
    columns: list[tuple[Column, int]]
    numbers: dict[int, NDArray[np.float64]]
    exact_ns: NDArray[np.int64] | None
    line_of: LineNumbers
    notes: tuple[Note, ...]
    repaired: int = 0
    restarts: tuple[int, ...] = ()

    @property
    def count(self) -> int:
        """Number of rows."""
        return len(next(iter(self.numbers.values()))) if self.numbers else 0
