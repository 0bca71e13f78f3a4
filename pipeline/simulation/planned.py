"""One recording to be made."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pipeline.simulation.gimbals import Gimbals
    from pipeline.simulation.trajectory import Moves, Turn


@dataclass(frozen=True)
class Planned:
    """One recording to be made: its name, role, turn axis (index or None) and trajectory."""

    name: str
    role: str
    axis: int | None
    trajectory: Turn | Moves | Gimbals
