"""How the bench holds the unit in a turn: as stated in the configuration, and as found in the recording.

    A' = s (A - zero) + face

where

A    : angle that the table logs
s    : +1 where it counts right-handed about the body axis that the procedure names, else -1
zero : what the table logs while the upward face points up
face : 0, 90, 180 or 270 deg, the angle at which that face points up by the convention of ``pipeline``
A'   : angle by the convention, with which everything after ingest works
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.model.kinematics import UP_AT_ZERO
from pipeline.records import AXES
from pipeline.signal.rests import still_samples

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from pipeline.preprocessing.turn_fit import TurnFit
    from pipeline.records import Recording

FEWEST_AT_REST = 10
ACROSS = np.cross(UP_AT_ZERO, np.eye(3))  # u x a: what points up at 90 deg


@dataclass(frozen=True)
class Bench:
    """How a recording's bench holds the unit.

    Attributes
    ----------
    axis : str
        Body axis turned about.
    up : str
        Body axis, with its sign, that points up where the table logs ``zero_deg``.
    sense : int
    zero_deg : float, deg
    """

    axis: str
    up: str
    sense: int = 1
    zero_deg: float = 0.0

    @property
    def vertical(self) -> bool:
        """Whether the turn axis points up or down, so that gravity stays as it is in the body."""
        return self.up[1] == self.axis

    @property
    def conventional(self) -> bool:
        """Whether the logged angle is the convention's."""
        return self.sense == 1 and self.zero_deg == 0.0 and self.up == usual_up(self.axis)

    @property
    def offset(self) -> float:
        """What is added to ``sense * A`` for the convention's angle, deg."""
        return self._face - self.sense * self.zero_deg

    @property
    def _face(self) -> float:
        return 0.0 if self.vertical else float(np.degrees(angle_of(signed_axis(self.up), self.axis)))


def stated_bench(entry: Mapping[str, Any], table: Mapping[str, Any], axis: str) -> Bench:
    """Return what the configuration says of a recording's bench.

    Parameters
    ----------
    entry : mapping
        The recording's entry in the procedure: ``up``, ``sense``, ``zero_deg``; what is None is the table's.
    table : mapping
        ``sense`` and ``zero_deg``, for every recording that does not state its own.
    axis : str
    """
    own = {k: table.get(k) if entry.get(k) is None else entry[k] for k in ("sense", "zero_deg")}
    return Bench(axis, entry.get("up") or usual_up(axis), int(own["sense"] or 1), float(own["zero_deg"] or 0.0))


def found_bench(fit: TurnFit, axis: str) -> Bench | None:
    """Return what gravity says of a turn about a known, level axis; None where it says nothing.

    The sense is that of q x p along the axis, the zero what turns p and q onto the nearest face with least squares.
    """
    if fit.turn_axis is None or fit.cosine is None or fit.sine is None:
        return None
    a = AXES.index(axis)
    sense = 1 if fit.turn_axis[a] > 0.0 else -1
    up, across = UP_AT_ZERO[a], ACROSS[a]
    along = fit.cosine @ up + sense * (fit.sine @ across)
    beside = fit.cosine @ across - sense * (fit.sine @ up)
    return bench_of(axis, sense, float(np.degrees(np.arctan2(beside, along))))


def bench_of(axis: str, sense: int, at_zero: float) -> Bench:
    """Return the bench with the nearest face and the smallest zero.

    Parameters
    ----------
    axis : str
    sense : int
    at_zero : float, deg
        The convention's angle where the table logs 0.
    """
    a, face = AXES.index(axis), 90.0 * round(at_zero / 90.0)
    up = nearest_axis(np.cos(np.radians(face)) * UP_AT_ZERO[a] + np.sin(np.radians(face)) * ACROSS[a])
    return Bench(axis, up, sense, sense * (face - at_zero))


def off_at_rest(recording: Recording, bench: Bench) -> float | None:
    """Return by how much gravity is ahead of the stated bench while the table rests, deg; None where it never does.

    A bias of 0.1 g makes it 6 deg where all rests are at one angle.
    """
    angle, force = recording.table_angle, recording.accelerometer
    if angle is None or force is None:
        return None
    still = still_samples(recording.time, np.gradient(angle, recording.time)) & recording.valid
    if np.sum(still) < FEWEST_AT_REST:
        return None
    up, across = UP_AT_ZERO[AXES.index(bench.axis)], ACROSS[AXES.index(bench.axis)]
    A = np.radians(bench.sense * angle[still] + bench.offset)
    c, s, along, beside = np.cos(A), np.sin(A), force[still] @ up, force[still] @ across
    return float(np.degrees(np.arctan2(c @ beside - s @ along, c @ along + s @ beside)))


def by_convention(fit: TurnFit, bench: Bench) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return p and q of a turn against the convention's angle: two (3,) arrays, or None where gravity does not tell."""
    if fit.cosine is None or fit.sine is None or bench.vertical or fit.vertical is not None:
        return None
    at_zero = np.radians(bench.offset)
    c, s = np.cos(at_zero), np.sin(at_zero)
    return c * fit.cosine - bench.sense * s * fit.sine, s * fit.cosine + bench.sense * c * fit.sine


def angle_of(direction: NDArray[np.float64], axis: str) -> float:
    """Return the convention's angle at which a body direction points up, rad."""
    a = AXES.index(axis)
    return float(np.arctan2(direction @ ACROSS[a], direction @ UP_AT_ZERO[a]))


def usual_up(axis: str) -> str:
    """Return the body axis that points up at angle 0 by the convention."""
    return nearest_axis(UP_AT_ZERO[AXES.index(axis)])


def signed_axis(name: str) -> NDArray[np.float64]:
    """Return the unit vector of ``+x``, ``-z`` ..: (3,) array."""
    vector = np.zeros(3)
    vector[AXES.index(name[1])] = 1.0 if name[0] == "+" else -1.0
    return vector


def nearest_axis(direction: NDArray[np.float64]) -> str:
    """Return the signed axis that a direction is nearest to."""
    largest = int(np.argmax(np.abs(direction)))
    return f"{'+' if direction[largest] > 0.0 else '-'}{AXES[largest]}"


def off_axis_deg(direction: NDArray[np.float64]) -> float:
    """Return the angle between a direction and the signed axis that it is nearest to, deg."""
    return float(np.degrees(np.arccos(np.clip(np.max(np.abs(direction)) / np.linalg.norm(direction), -1.0, 1.0))))
