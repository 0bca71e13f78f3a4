"""All recordings of a procedure in one file: what is moved between them is in it too, and the table's log of all.

Held-out motion begins and ends at rest here, where a file of its own begins and ends within it: its path is run through
at the time

    s(t) = T u^4 (5/2 - 3 u + u^2),   u = t / T,   ds/dt = u^3 (10 - 15 u + 6 u^2)

while it begins, and likewise backwards while it ends,

where

T : how long it takes to come up to speed, s
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.simulation.rate_table import ProgramBuilder
from pipeline.simulation.table_logs import logged
from pipeline.simulation.trajectory import Gimbals, Moves, Planned, axis_and_angle

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from pipeline.records import Recording

TRANSIT = "transit"
TRANSIT_RATE_DPS = 20.0
LEAST_ANGLE_DEG = 1e-6
COMES_UP_S = 5.0


@dataclass(frozen=True)
class Eased(Gimbals):
    """Motion of a table that begins and ends at rest."""

    def angles(self, time: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        """Return the gimbal angles and their first two derivatives: three (3, n) arrays in deg and s."""
        since, left = (np.clip(t / COMES_UP_S, 0.0, 1.0) for t in (time, self.duration - time))
        between = np.clip(time - COMES_UP_S, 0.0, self.duration - 2.0 * COMES_UP_S)
        run = COMES_UP_S * (_path(since) + 0.5 - _path(left)) + between
        speed = _speed(since) * _speed(left)
        change = (_growth(since) - _growth(left)) / COMES_UP_S
        angle, rate, acceleration = super().angles(run)
        return angle, rate * speed, acceleration * speed**2 + rate * change


def _path(u: NDArray[np.float64]) -> NDArray[np.float64]:
    return u**4 * (2.5 - 3.0 * u + u**2)


def _speed(u: NDArray[np.float64]) -> NDArray[np.float64]:
    return u**3 * (10.0 - 15.0 * u + 6.0 * u**2)


def _growth(u: NDArray[np.float64]) -> NDArray[np.float64]:
    return 30.0 * (u * (1.0 - u)) ** 2


def _eased(plan: Planned) -> Planned:
    """Return a recording that begins and ends at rest; held-out motion is longer by that."""
    motion = plan.trajectory
    if not isinstance(motion, Gimbals):
        return plan
    parts = {f.name: getattr(motion, f.name) for f in fields(motion)}
    return replace(plan, trajectory=Eased(**{**parts, "duration": max(motion.duration, COMES_UP_S) + COMES_UP_S}))


def with_transits(planned: Sequence[Planned], pause: float, acceleration: float) -> list[Planned]:
    """Return recordings with what lies between them: half a pause, the move to where the next begins, half a pause.

    Parameters
    ----------
    planned : sequence of Planned
    pause : float, s
    acceleration : float, deg/s^2
    """
    planned = [_eased(p) for p in planned]
    out = [planned[0]]
    for one, two in pairwise(planned):
        axis, angle = axis_and_angle(_level(one, at_end=True).T @ _level(two, at_end=False))
        builder = ProgramBuilder(acceleration).rest(pause / 2)
        if angle > LEAST_ANGLE_DEG:
            builder.turn(angle, TRANSIT_RATE_DPS).rest(pause / 2)
        move = Moves(builder.build(), axis[None], _level(one, at_end=True))
        out += [Planned(TRANSIT, TRANSIT, None, move), two]
    return out


def _level(plan: Planned, *, at_end: bool) -> NDArray[np.float64]:
    """Return the attitude at the beginning or at the end of a recording: (3, 3) array."""
    time = np.array([plan.trajectory.duration if at_end else 0.0])
    level: NDArray[np.float64] = plan.trajectory.commanded(time).level[0]
    return level


def joined(recordings: Sequence[Recording], planned: Sequence[Planned], *, wrapped: bool) -> Recording:
    """Return recordings that follow each other as one, with the table's angle, rate and attitude throughout."""
    first = recordings[0]
    blocks: dict[str, Any] = {
        name: np.concatenate([getattr(r, name) for r in recordings])
        for name in ("time_ns", "accelerometer", "gyroscope", "temperature")
    }
    starts = [float(r.time[0]) for r in recordings]
    whole = replace(first, name="recording", role="session", axis=None, **blocks, table_angle=None, table_rate=None)
    table: dict[str, Any] = dict(logged(planned, starts, whole.time, wrapped=wrapped))
    return replace(whole, **table)
