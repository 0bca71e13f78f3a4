"""Random motion of a three-axis table, analytic at any time.

Gimbals ``level = R_z(psi) R_y(theta) R_x(phi)``, each angle a steady turn plus a sum of sinusoids:

    omega = (phi' - psi' sin theta,  theta' cos phi + psi' cos theta sin phi,  -theta' sin phi + psi' cos theta cos phi)

where phi, theta, psi are the angles of the gimbals about x (inner), y and z (outer), and a dash is a time derivative.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.model.rotation import attitude_matrix
from pipeline.simulation.trajectory import Pose

if TYPE_CHECKING:
    from numpy.typing import NDArray

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
