"""Where the body points at any time: turns about one axis, and rests with moves between them.

Everything is evaluated analytically, at any time, from

    level(t)   rows are the level axes in the body frame, so v_level = level @ v_body
    omega(t)   angular rate of the body in the body frame, deg/s
    alpha(t)   its derivative, deg/s^2

A turn by A about the unit axis u (the same in body and level, since R_u u = u):

    level = level_0 R_u(A),   omega = u dA/dt,   alpha = u d2A/dt2
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.model.kinematics import LEVEL_AT_ZERO
from pipeline.simulation.table_errors import TurnErrors

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.simulation.program import Program


@dataclass(frozen=True)
class Pose:
    """Attitude and its derivatives at n times.

    Attributes
    ----------
    level : (n, 3, 3) array
        Rows are the level axes in the body frame.
    omega, alpha : (n, 3) array, deg/s and deg/s^2, body frame
    angle, rate : (n,) array or None, deg and deg/s
        About the turn axis.
    direction : (n, 3) array or None
        Unit vector of the turn that goes on or, at rest, of the last one; zeros before the first.
    force : (n, 3) array or None, g, body frame
        Specific force of a shaking plate, beside gravity.
    """

    level: NDArray[np.float64]
    omega: NDArray[np.float64]
    alpha: NDArray[np.float64]
    angle: NDArray[np.float64] | None = None
    rate: NDArray[np.float64] | None = None
    direction: NDArray[np.float64] | None = None
    force: NDArray[np.float64] | None = None


def rotation_about(axis: NDArray[np.float64], angle_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``R_u(A) = I + sin A [u]x + (1 - cos A) [u]x^2``: (n, 3, 3) array.

    Parameters
    ----------
    axis : (3,) or (n, 3) array
        Unit vectors.
    angle_deg : (n,) array, deg
    """
    x, y, z = np.moveaxis(np.atleast_2d(axis), -1, 0)
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
    angle = np.radians(angle_deg)[:, None, None]
    rotation: NDArray[np.float64] = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)
    return rotation


@dataclass(frozen=True)
class Turn:
    """Turns about one body axis, as commanded by a program.

    Attributes
    ----------
    axis : int
    program : Program
    errors : TurnErrors
        What the table does otherwise than commanded.
    """

    axis: int
    program: Program
    errors: TurnErrors = field(default_factory=TurnErrors)

    @property
    def duration(self) -> float:
        """Length in s."""
        return self.program.duration

    def commanded(self, time: NDArray[np.float64]) -> Pose:
        """Return the commanded pose."""
        return self._pose(np.eye(3)[self.axis], *self.program.at(time))

    def true(self, time: NDArray[np.float64]) -> Pose:
        """Return the pose that the table really takes."""
        angle, rate, acceleration = self.errors.motion(self.program, time)
        move = self.program.at(time)[3]
        pose = self._pose(self.errors.turn_axis(self.axis), angle, rate, acceleration, move)
        return replace(pose, force=self.errors.force(self.program, time))

    def _pose(
        self,
        u: NDArray[np.float64],
        angle: NDArray[np.float64],
        rate: NDArray[np.float64],
        acceleration: NDArray[np.float64],
        move: NDArray[np.int64],
    ) -> Pose:
        level = LEVEL_AT_ZERO[self.axis] @ rotation_about(u, angle)
        direction = np.append(np.sign(np.diff(self.program.stops)), 0.0)[move]
        return Pose(level, rate[:, None] * u, acceleration[:, None] * u, angle, rate, direction[:, None] * u)


@dataclass(frozen=True)
class Moves:
    """Rests in several attitudes and moves between them, each a turn about an axis of its own.

    Attributes
    ----------
    program : Program
        Angle within each move from 0 on; move k turns from ``stops[k]`` to ``stops[k + 1]``.
    axes : (m, 3) array
        Unit axis of each move, body frame.
    start : (3, 3) array
        Level axes in the body frame, as rows, before the first move.
    """

    program: Program
    axes: NDArray[np.float64]
    start: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))

    @property
    def duration(self) -> float:
        """Length in s."""
        return self.program.duration

    def attitudes(self) -> NDArray[np.float64]:
        """Return the attitude before each move and after the last: (m + 1, 3, 3) array."""
        steps = rotation_about(self.axes, np.diff(self.program.stops))
        out = [self.start]
        for step in steps:
            out.append(out[-1] @ step)
        return np.array(out)

    def true(self, time: NDArray[np.float64]) -> Pose:
        """Return the pose."""
        angle, rate, acceleration, move = self.program.at(time)
        begun = move >= 0
        move = np.clip(move, 0, None)
        u = self.axes[move]
        level = self.attitudes()[move] @ rotation_about(u, angle - self.program.stops[move])
        direction = np.where(begun[:, None], u, 0.0)
        return Pose(level, rate[:, None] * u, acceleration[:, None] * u, direction=direction)

    def commanded(self, time: NDArray[np.float64]) -> Pose:
        """Return the pose; it is nobody's command, but known to the simulation."""
        return self.true(time)
