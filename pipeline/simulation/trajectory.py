"""Attitude of the body over time: turns about one axis, rests with moves between them, motion of three gimbals.

Everything is evaluated analytically, at any time, from

    level(t)   rows are the level axes in the body frame, so v_level = level @ v_body
    omega(t)   angular rate of the body in the body frame, deg/s
    alpha(t)   its derivative, deg/s^2

A turn by A about the unit axis u (the same in body and level, since R_u u = u):

    level = level_0 R_u(A),   omega = u dA/dt,   alpha = u d2A/dt2

Random motion of a three-axis table: ``level = R_z(psi) R_y(theta) R_x(phi)``, each angle a steady turn plus a sum of
sinusoids:

    omega = (phi' - psi' sin theta,  theta' cos phi + psi' cos theta sin phi,  -theta' sin phi + psi' cos theta cos phi)

where phi, theta, psi are the angles of the gimbals about x (inner), y and z (outer), each a steady turn plus a sum of
sinusoids, and a dash is a time derivative.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.model.kinematics import LEVEL_AT_ZERO
from pipeline.model.rotation import attitude_matrix
from pipeline.simulation.rate_table import TurnErrors

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.simulation.rate_table import Program


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


SWING_RMS_DEG = np.array([60.0, 42.0, 60.0])


@dataclass(frozen=True)
class Gimbals:
    """Random motion of a three-axis table: each gimbal angle a steady turn plus a sum of sinusoids.

    Attributes
    ----------
    drift : (3,) array, deg/s
        Steady rates of the gimbals about x (inner), y, z (outer).
    amplitude, frequency, phase : (3, m) array, deg, Hz, rad
        Of their sinusoids.
    duration : float, s
    """

    drift: NDArray[np.float64]
    amplitude: NDArray[np.float64]
    frequency: NDArray[np.float64]
    phase: NDArray[np.float64]
    duration: float

    def angles(self, time: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        """Return the gimbal angles and their first two derivatives: three (3, n) arrays in deg and s."""
        w = 2.0 * np.pi * self.frequency[:, :, None]
        argument = w * time + self.phase[:, :, None]
        sine, cosine = np.sin(argument), np.cos(argument)
        a = self.amplitude[:, :, None]
        drift = self.drift[:, None]
        return drift * time + (a * sine).sum(1), drift + (a * w * cosine).sum(1), (-a * w * w * sine).sum(1)

    def quaternion(self, time: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the attitude, body to level: (n, 4) array, continuous in sign."""
        half = 0.5 * np.radians(self.angles(time)[0])
        (a, b, c), (x, y, z) = np.cos(half), np.sin(half)
        return np.stack(
            [
                a * b * c + x * y * z,
                x * b * c - a * y * z,
                a * y * c + x * b * z,
                a * b * z - x * y * c,
            ],
            -1,
        )

    def true(self, time: NDArray[np.float64]) -> Pose:
        """Return the pose."""
        angle, rate, acceleration = self.angles(time)
        (sx, sy, _), (cx, cy, _) = np.sin(np.radians(angle)), np.cos(np.radians(angle))
        p, q, r = np.radians(rate)
        dp, dq, dr = np.radians(acceleration)
        omega = np.stack([p - r * sy, q * cx + r * cy * sx, -q * sx + r * cy * cx], -1)
        alpha = np.stack(
            [
                dp - dr * sy - r * q * cy,
                dq * cx - q * p * sx + dr * cy * sx - r * q * sy * sx + r * p * cy * cx,
                -dq * sx - q * p * cx + dr * cy * cx - r * q * sy * cx - r * p * cy * sx,
            ],
            -1,
        )
        return Pose(attitude_matrix(self.quaternion(time)), np.degrees(omega), np.degrees(alpha))

    def commanded(self, time: NDArray[np.float64]) -> Pose:
        """Return the pose: the table follows its command."""
        return self.true(time)


def random_gimbals(duration: float, peak_rate: float, rng: np.random.Generator, sinusoids: int = 4) -> Gimbals:
    """Return a random motion whose |angular rate| peaks at ``peak_rate``.

    The inner gimbal turns on and the middle one swings by 42 deg rms, which is what makes the mean squares of the three
    components of the vertical equal: the attitudes cover the sphere evenly. How fast that path is run through is chosen
    so that the rate peaks where it should.

    Parameters
    ----------
    duration : float, s
    peak_rate : float, deg/s
    rng : Generator
    sinusoids : int
        For each gimbal; their frequencies lie within a factor of three.
    """
    frequency = np.exp(rng.uniform(0.0, np.log(3.0), (3, sinusoids))) / 40.0
    weight = rng.uniform(0.5, 1.0, (3, sinusoids))
    swing = np.sqrt(2.0) * SWING_RMS_DEG[:, None]
    amplitude = swing * weight / np.linalg.norm(weight, axis=1, keepdims=True)
    phase = rng.uniform(0.0, 2.0 * np.pi, (3, sinusoids))
    drift = np.array([0.6 * 360.0 / 40.0, 0.0, 0.0]) * rng.choice([-1.0, 1.0])

    def at_speed(speed: float) -> Gimbals:
        return Gimbals(drift * speed, amplitude, frequency * speed, phase, duration)

    time = np.linspace(0.0, duration, max(50, int(2.0 * duration)))
    low, high = 1e-3, 1e3  # a faster run shows more of the path, so its peak grows with the speed, if not in proportion
    for _ in range(24):
        middle = float(np.sqrt(low * high))
        peak = np.linalg.norm(at_speed(middle).true(time).omega, axis=1).max()
        low, high = (middle, high) if peak < peak_rate else (low, middle)
    return at_speed(low)


def axis_and_angle(rotation: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Return the unit axis and the angle in deg, 0 to 180, of a rotation matrix.

    The quaternion is the eigenvector of Bar-Itzhack's matrix for its largest eigenvalue; it is good at 180 deg too.
    """
    d, off = rotation, np.array([rotation[2, 1], rotation[0, 2], rotation[1, 0]])
    skew = off - np.array([d[1, 2], d[2, 0], d[0, 1]])
    matrix = np.empty((4, 4))
    matrix[0, 0] = np.trace(d)
    matrix[0, 1:] = matrix[1:, 0] = skew
    matrix[1:, 1:] = d + d.T - np.trace(d) * np.eye(3)
    q = np.linalg.eigh(matrix)[1][:, -1]
    q = q if q[0] >= 0.0 else -q
    size = float(np.linalg.norm(q[1:]))
    if size == 0.0:  # none: any axis will do
        return np.array([1.0, 0.0, 0.0]), 0.0
    return q[1:] / size, float(np.degrees(2.0 * np.arctan2(size, q[0])))


def orientations_24() -> NDArray[np.float64]:
    """Return eight attitudes 45 deg apart about each axis: (24, 3, 3) array; for z, body x points up at the first."""
    angles = np.linspace(0.0, 315.0, 8)
    x, y, z = np.eye(3)
    upright = rotation_about(y, np.array([-90.0]))[0]  # body x up
    turns = [rotation_about(x, angles), rotation_about(y, angles), upright @ rotation_about(z, angles)]
    return np.concatenate(turns)


def six_positions() -> NDArray[np.float64]:
    """Return six attitudes with each axis up and down: (6, 3, 3) array."""
    x, y, _ = np.eye(3)
    return np.concatenate([rotation_about(x, np.linspace(0.0, 270.0, 4)), rotation_about(y, np.array([-90.0, 90.0]))])


def random_attitudes(count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return attitudes that are uniform over all rotations: (count, 3, 3) array."""
    q = rng.standard_normal((count, 4))
    return attitude_matrix(q / np.linalg.norm(q, axis=1, keepdims=True))


@dataclass(frozen=True)
class Planned:
    """One recording to be made: its name, role, turn axis (index or None) and trajectory."""

    name: str
    role: str
    axis: int | None
    trajectory: Turn | Moves | Gimbals
