"""Compute the true attitude of the body over time: turns of a rate table, rests and moves, motion of three gimbals.

All quantities are evaluated analytically, at any time. A turn by A about the unit axis u has

    level = level_0 R_u(A),   omega = u dA/dt,   alpha = u d2A/dt2

and the random motion of a three-axis table ``level = R_z(psi) R_y(theta) R_x(phi)``, each angle a steady turn plus a
sum of sinusoids,

    omega = (phi' - psi' sin theta,  theta' cos phi + psi' cos theta sin phi,  -theta' sin phi + psi' cos theta cos phi)

where

level      : (3, 3), rows are the level axes in the body frame, so v_level = level @ v_body
omega      : angular rate of the body in the body frame, deg/s; alpha is its derivative
phi, theta, psi : angles of the gimbals about x (inner), y and z (outer); a dash is a time derivative

A turn is commanded to the angle ``phi(t)`` and reaches

    theta = D_k + (phi - C_k) (D_k+1 - D_k) / (C_k+1 - C_k) + h(phi) + v(t)
    h(phi) = A cos phi + B sin phi + (180/pi) (a sin phi + b (1 - cos phi))

about the axis ``u = (e + d) / |e + d|``, where

C_k, D_k : commanded and true angle of stop k, deg: step quantisation, angle errors, lost steps (rate errors), backlash
A, B     : encoder error (eccentricity), deg
a, b     : rate ripple once a revolution: ``dtheta/dt = (1 + a cos phi + b sin phi) dphi/dt``, relative
v(t)     : vibration while the table moves, ``V sin(2 pi f t)``, deg; it also accelerates the plate, in g
d        : error of the axis direction, rad, across the nominal axis e

The true rate and acceleration are the derivatives of theta(t), by the chain rule. The Mark 2 table (Sudsanguan 2019,
sections 3.3 and 5.2.3) has all of them: acrylic parts, stepper motors, friction and an unbalanced load.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import scipy

from pipeline.core.records import Index, Values, attitude_matrix
from pipeline.core.settings import ProgramRest, ProgramTurn
from pipeline.ingest.clock_alignment import Program
from pipeline.physics.kinematics import level_at_zero, turn_by_vector

ProgramStep: TypeAlias = ProgramRest | ProgramTurn
SWING_RMS_DEG = np.array([60.0, 42.0, 60.0])  # 42 deg of the middle gimbal: uniform attitudes (``random_gimbals``)
PERIOD_S = 40.0  # longest period of the sinusoids before the speed is scaled; its value cancels
SINUSOIDS = 4  # for each gimbal
COMES_UP_S = 5.0  # time in which a table starts from rest, see ``Eased``


class Pose(NamedTuple):
    """Attitude and its derivatives at n times."""

    level: Values  # (n, 3, 3)
    omega: Values  # (n, 3), deg/s, body frame
    alpha: Values  # (n, 3), deg/s^2, body frame
    angle: Values | None = None  # (n,), deg, about the turn axis
    rate: Values | None = None  # (n,), deg/s
    direction: Values | None = None  # (n, 3), unit vector of the present or, at rest, the last turn; zeros before
    force: Values | None = None  # (n, 3), g, body frame: of the plate's vibration, in addition to gravity


def mounted(pose: Pose, rotation: Values) -> Pose:
    """Return the pose of a unit whose axes are the columns of a rotation, in the frame of the pose's body."""
    if np.array_equal(rotation, np.eye(3)):
        return pose
    vectors = {name: getattr(pose, name) for name in ("level", "omega", "alpha", "direction", "force")}
    return pose._replace(**{name: v @ rotation for name, v in vectors.items() if v is not None})


def rotation_about(axis: Values, angle_deg: Values) -> Values:
    """Return the rotations by (n,) angles about unit vectors, (3,) or (n, 3): (n, 3, 3) array."""
    return rotation_by(axis * np.asarray(angle_deg)[:, None])


def rotation_by(vector_deg: Values) -> Values:
    """Return the rotations by vectors, deg: (..., 3) array to (..., 3, 3)."""
    return turn_by_vector(np.radians(vector_deg))


def rest(seconds: float) -> ProgramStep:
    """Return a rest as a step of a program."""
    return ProgramRest(rest_s=seconds)


def turn(angle: float, rate: float, acceleration: float) -> ProgramStep:
    """Return a turn as a step of a program: angle in deg, signed; largest rate in deg/s; ramps in deg/s^2."""
    return ProgramTurn(turn_deg=angle, rate_dps=rate, acceleration_dps2=acceleration)


def turn_with_plateau(angle: float, rate: float, acceleration: float) -> ProgramStep:
    """Return a turn that covers ``angle`` at full ``rate``, plus the ramps before and after."""
    return turn(angle + float(np.sign(angle)) * rate**2 / acceleration, rate, acceleration)


@dataclass(frozen=True)
class TurnErrors:
    """Errors of turns about one axis; none by default."""

    encoder: Values = field(default_factory=lambda: np.zeros(2))  # A and B above, deg
    ripple: Values = field(default_factory=lambda: np.zeros(2))  # a and b above, relative
    stops: Values | None = None  # (moves + 1,), deg: angle error D_k - C_k of each stop of the program
    backlash: float = 0.0  # lag of the angle in the direction of the last move, deg
    direction: Values = field(default_factory=lambda: np.zeros(2))  # d along the next two axes, cyclically, rad
    vibration: float = 0.0  # amplitude V, deg
    shaking: float = 0.0  # g, of the vibration along each body axis, 120 deg apart in phase
    vibration_frequency: float = 0.0  # Hz

    def turn_axis(self, axis: int) -> Values:
        """Return the true turn axis: (3,) unit vector, body frame."""
        u = np.zeros(3)
        u[[axis, (axis + 1) % 3, (axis + 2) % 3]] = 1.0, *self.direction
        return np.asarray(u / np.linalg.norm(u))

    def force(self, program: Program, time: Values) -> Values | None:
        """Return the specific force of the plate's vibration: (n, 3) array, g, or None without vibration."""
        if not self.shaking:
            return None
        phase = 2.0 * np.pi * (self.vibration_frequency * time[:, None] + np.arange(3) / 3.0)
        moving = program.at(time)[1] != 0.0
        return np.asarray(self.shaking * moving[:, None] * np.sin(phase))

    def motion(self, program: Program, time: Values) -> tuple[Values, Values, Values]:
        """Return the true angle (deg), rate (deg/s) and acceleration (deg/s^2): (n,) arrays."""
        phi, rate, acceleration, move = program.at(time)
        base, slope = self._stops(program, phi, move)
        theta, first, second = self._harmonics(phi)
        theta, first = theta + base, first + slope
        angle, true_rate, true_acceleration = theta, first * rate, first * acceleration + second * rate**2
        if self.vibration:
            w = 2.0 * np.pi * self.vibration_frequency
            swing = np.where(rate != 0.0, self.vibration, 0.0)
            angle = angle + swing * np.sin(w * time)
            true_rate = true_rate + swing * w * np.cos(w * time)
            true_acceleration = true_acceleration - swing * w**2 * np.sin(w * time)
        return angle, true_rate, true_acceleration

    def _stops(self, program: Program, phi: Values, move: Index) -> tuple[Values, Values]:
        """Return the angle interpolated between the true stops, and its derivative by the commanded angle."""
        if (self.stops is None and not self.backlash) or len(program.stops) < 2:
            return phi, np.ones_like(phi)
        error = np.zeros_like(program.stops) if self.stops is None else self.stops
        commanded = np.diff(program.stops)
        k = np.clip(move, 0, None)
        slope = 1.0 + np.diff(error)[k] / commanded[k]
        lag = np.where(move >= 0, -self.backlash * np.sign(commanded[k]), 0.0)
        return program.stops[k] + error[k] + (phi - program.stops[k]) * slope + lag, slope

    def _harmonics(self, phi: Values) -> tuple[Values, Values, Values]:
        """Return h (deg) and its first (deg/deg) and second (1/deg) derivative."""
        sine, cosine = np.sin(np.radians(phi)), np.cos(np.radians(phi))
        (A, B), (a, b) = self.encoder, self.ripple
        value = A * cosine + B * sine + np.degrees(a * sine + b * (1.0 - cosine))
        first = np.radians(B * cosine - A * sine) + a * cosine + b * sine
        second = np.radians(np.radians(-A * cosine - B * sine) + b * cosine - a * sine)
        return value, first, second


@dataclass(frozen=True)
class CommandedTurns:
    """Turns about one body axis by a commanded program, with the table's errors."""

    axis: int
    program: Program
    errors: TurnErrors = field(default_factory=TurnErrors)
    shaft: int = 0  # 1 or -1: level x is the body axis times this in all turns, by the sense of the encoder

    @property
    def duration(self) -> float:
        """Length in s."""
        return self.program.duration

    def pose(self, time: Values) -> Pose:
        """Return the pose at (n,) times, s."""
        angle, rate, acceleration = self.errors.motion(self.program, time)
        u = self.errors.turn_axis(self.axis)
        level = level_at_zero(self.axis, shaft=self.shaft) @ rotation_about(u, angle)
        move = self.program.at(time)[3]
        direction = np.append(np.sign(np.diff(self.program.stops)), 0.0)[move]
        force = self.errors.force(self.program, time)
        return Pose(level, rate[:, None] * u, acceleration[:, None] * u, angle, rate, direction[:, None] * u, force)


@dataclass(frozen=True)
class RestsAndMoves:
    """Rests in several attitudes and moves between them, each a turn about its axis."""

    program: Program  # move k turns from stops[k] to stops[k + 1]
    axes: Values  # (m, 3), unit axis of each move, body frame
    start: Values = field(default_factory=lambda: np.eye(3))  # (3, 3), level before the first move

    @property
    def duration(self) -> float:
        """Length in s."""
        return self.program.duration

    def attitudes(self) -> Values:
        """Return the attitude before each move and after the last: (m + 1, 3, 3) array."""
        out = [self.start]
        for step in rotation_about(self.axes, np.diff(self.program.stops)):
            out.append(out[-1] @ step)
        return np.array(out)

    def pose(self, time: Values) -> Pose:
        """Return the pose at (n,) times, s."""
        angle, rate, acceleration, move = self.program.at(time)
        begun = move >= 0
        move = np.clip(move, 0, None)
        u = self.axes[move]
        level = self.attitudes()[move] @ rotation_about(u, angle - self.program.stops[move])
        direction = np.where(begun[:, None], u, 0.0)
        return Pose(level, rate[:, None] * u, acceleration[:, None] * u, direction=direction)


@dataclass(frozen=True)
class Gimbals:
    """Random motion of a three-axis table: each gimbal angle is a steady turn plus a sum of m sinusoids."""

    drift: Values  # (3,), deg/s, steady rates of the gimbals about x (inner), y, z (outer)
    amplitude: Values  # (3, m), deg
    frequency: Values  # (3, m), Hz
    phase: Values  # (3, m), rad
    duration: float  # s

    def angles(self, time: Values) -> tuple[Values, ...]:
        """Return the gimbal angles and their first two derivatives: three (3, n) arrays in deg and s."""
        w = 2.0 * np.pi * self.frequency[:, :, None]
        argument = w * time + self.phase[:, :, None]
        sine, cosine = np.sin(argument), np.cos(argument)
        a = self.amplitude[:, :, None]
        drift = self.drift[:, None]
        return drift * time + (a * sine).sum(1), drift + (a * w * cosine).sum(1), (-a * w * w * sine).sum(1)

    def quaternion(self, time: Values) -> Values:
        """Return the attitude, body to level: (n, 4) array, continuous in sign."""
        half = 0.5 * np.radians(self.angles(time)[0])
        (a, b, c), (x, y, z) = np.cos(half), np.sin(half)
        return np.stack(
            [a * b * c + x * y * z, x * b * c - a * y * z, a * y * c + x * b * z, a * b * z - x * y * c], -1
        )

    def pose(self, time: Values) -> Pose:
        """Return the pose at (n,) times, s."""
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

    def eased(self) -> Eased:
        """Return the same motion with a start and an end at rest; it is longer."""
        duration = max(self.duration, COMES_UP_S) + COMES_UP_S
        return Eased(self.drift, self.amplitude, self.frequency, self.phase, duration)


@dataclass(frozen=True)
class Eased(Gimbals):
    """Motion of a table that begins and ends at rest: the motion of ``Gimbals`` at the time s(t).

    At the start, ``s(t) = T u^4 (5/2 - 3 u + u^2)``, ``u = t / T``, with ``T = COMES_UP_S``; at the end likewise.
    """

    def angles(self, time: Values) -> tuple[Values, ...]:
        """Return the gimbal angles and their first two derivatives: three (3, n) arrays in deg and s."""
        since, remaining = (np.clip(t / COMES_UP_S, 0.0, 1.0) for t in (time, self.duration - time))
        between = np.clip(time - COMES_UP_S, 0.0, self.duration - 2.0 * COMES_UP_S)
        run = COMES_UP_S * (_path(since) + 0.5 - _path(remaining)) + between
        speed = _speed(since) * _speed(remaining)
        change = (_growth(since) - _growth(remaining)) / COMES_UP_S
        angle, rate, acceleration = super().angles(run)
        return angle, rate * speed, acceleration * speed**2 + rate * change


def _path(u: Values) -> Values:
    return u**4 * (2.5 - 3.0 * u + u**2)


def _speed(u: Values) -> Values:
    return u**3 * (10.0 - 15.0 * u + 6.0 * u**2)


def _growth(u: Values) -> Values:
    return 30.0 * (u * (1.0 - u)) ** 2


@dataclass(frozen=True)
class Planned:
    """One recording to simulate: its name, role, turn axis (index or None) and trajectory.

    ``row``: its cells in a sheet of recordings behind the file; empty for a procedure without a sheet.
    """

    name: str
    role: str
    axis: int | None
    trajectory: CommandedTurns | RestsAndMoves | Gimbals
    row: str = ""

    @property
    def kind(self) -> str:
        """Kind of the recording in the sheet."""
        return self.row.partition(",")[0]


def random_gimbals(duration: float, peak_rate: float, rng: np.random.Generator) -> Gimbals:
    """Draw a random motion whose |angular rate| has the maximum ``peak_rate`` (deg/s).

    The inner gimbal turns steadily and the middle one swings by 42 deg rms. Then the mean squares of the three
    components of the vertical are equal: the attitudes cover the sphere evenly.
    """
    frequency = np.exp(rng.uniform(0.0, np.log(3.0), (3, SINUSOIDS))) / PERIOD_S
    weight = rng.uniform(0.5, 1.0, (3, SINUSOIDS))
    swing = np.sqrt(2.0) * SWING_RMS_DEG[:, None]
    amplitude = swing * weight / np.linalg.norm(weight, axis=1, keepdims=True)
    phase = rng.uniform(0.0, 2.0 * np.pi, (3, SINUSOIDS))
    drift = np.array([0.6 * 360.0 / PERIOD_S, 0.0, 0.0]) * rng.choice([-1.0, 1.0])

    def at_speed(speed: float) -> Gimbals:
        return Gimbals(drift * speed, amplitude, frequency * speed, phase, duration)

    time = np.linspace(0.0, duration, max(50, int(2.0 * duration)))
    low, high = 1e-3, 1e3  # a faster motion covers more of the path: its maximum grows with the speed
    for _ in range(24):
        middle = float(np.sqrt(low * high))
        peak = np.linalg.norm(at_speed(middle).pose(time).omega, axis=1).max()
        low, high = (middle, high) if peak < peak_rate else (low, middle)
    return at_speed(low)


def axis_and_angle(rotation: Values) -> tuple[Values, float]:
    """Return the unit axis and the angle in deg, 0 to 180, of a rotation matrix."""
    vector = scipy.spatial.transform.Rotation.from_matrix(rotation).as_rotvec(degrees=True)
    angle = float(np.linalg.norm(vector))
    return (vector / angle, angle) if angle > 0.0 else (np.array([1.0, 0.0, 0.0]), 0.0)


def orientations_24() -> Values:
    """Return eight attitudes 45 deg apart about each axis: (24, 3, 3) array; for z, body x points up at the first."""
    angles = np.linspace(0.0, 315.0, 8)
    x, y, z = np.eye(3)
    upright = rotation_about(y, np.array([-90.0]))[0]  # body x up
    turns = [rotation_about(x, angles), rotation_about(y, angles), upright @ rotation_about(z, angles)]
    return np.concatenate(turns)


def six_positions() -> Values:
    """Return six attitudes with each axis up and down: (6, 3, 3) array."""
    x, y, _ = np.eye(3)
    return np.concatenate([rotation_about(x, np.linspace(0.0, 270.0, 4)), rotation_about(y, np.array([-90.0, 90.0]))])


def random_attitudes(count: int, rng: np.random.Generator) -> Values:
    """Return attitudes that are uniform over all rotations: (count, 3, 3) array."""
    q = rng.standard_normal((count, 4))
    return attitude_matrix(q / np.linalg.norm(q, axis=1, keepdims=True))


def directions_of_shaft(off: Values, sense: int) -> Values:
    """Return the deviations of each turn axis in the body, (3, 2), where one shaft turns the unit about all of them.

    ``off``: (2,), of the shaft along level y and z, in the unit of the result. ``sense``: of its encoder, 1 or -1.
    """
    turned = [sense * level_at_zero(axis, shaft=sense).T @ [0.0, *off] for axis in range(3)]
    return np.array([[u[(axis + 1) % 3], u[(axis + 2) % 3]] for axis, u in enumerate(turned)])


def random_errors(program: Program, rng: np.random.Generator, settings: Mapping[str, Any], axis: int) -> TurnErrors:
    """Draw the errors of one recording about an axis of a table.

    ``settings``, each 0 by default: ``angle_accuracy_deg`` (standard deviation of each stop), ``rate_error`` (3,)
    (relative error of every move), ``step_deg`` (of the motor), ``ripple`` (relative amplitude), ``direction_deg``
    (3, 2), ``vibration_deg``, ``shaking_g``, ``vibration_hz``.
    """
    phase = rng.uniform(0.0, 2.0 * np.pi)
    travelled = np.cumsum(np.diff(program.stops) * settings.get("rate_error", np.zeros(3))[axis])
    scatter = settings.get("angle_accuracy_deg", 0.0) * rng.standard_normal(len(program.stops))
    stops = np.concatenate([[0.0], travelled]) + scatter
    step = settings.get("step_deg", 0.0)
    if step > 0.0:
        stops = np.round((program.stops + stops) / step) * step - program.stops
    return TurnErrors(
        ripple=settings.get("ripple", 0.0) * np.array([np.cos(phase), np.sin(phase)]),
        stops=stops,
        direction=np.radians(np.asarray(settings.get("direction_deg", np.zeros((3, 2))), float)[axis]),
        vibration=settings.get("vibration_deg", 0.0),
        shaking=settings.get("shaking_g", 0.0),
        vibration_frequency=settings.get("vibration_hz", 0.0),
    )
