"""The true motion that a sensor feels in one recording: trajectory, place, mounting and timing.

    f = g up + [omega x (omega x r) + alpha x r] / 9.80665 + shaking,   omega_sensed = omega + level^T Omega_earth

at the time that the sensor's clock really shows,

    t' = t + tau + epsilon t

where

up     : (3,) the true vertical in the body frame; in the table's own level frame it is tilted
r      : (3,) position of the accelerometer from the turn axes, m, body frame
tau    : time offset, s: the reading at t shows the motion at t + tau
epsilon : relative error of the sensor's clock

A lag is a first-order low pass of what the sensor feels, ``y(t) = integral_0^inf exp(-s) u(t - lag s) ds``, by Gauss'
rule on short panels: the corners of a ramp lie anywhere in the past, and no smooth rule would follow them.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from pipeline.records import Motion
from pipeline.signal.rests import still_samples

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.simulation.trajectory import Pose

STANDARD_GRAVITY = 9.80665
# Edges of the panels in s: beyond 20 time constants nothing is left.
PANELS = np.concatenate([np.linspace(0.0, 2.0, 21), np.linspace(2.25, 6.0, 16), np.linspace(7.0, 20.0, 14)])


class Trajectory(Protocol):
    """Anything that knows its pose at any time."""

    @property
    def duration(self) -> float:
        """Length in s."""

    def true(self, time: NDArray[np.float64]) -> Pose:
        """Return the true pose."""

    def commanded(self, time: NDArray[np.float64]) -> Pose:
        """Return the pose that the log shows."""


@dataclass(frozen=True)
class Scene:
    """What one sensor feels in one recording.

    Attributes
    ----------
    trajectory : Trajectory
    start : float, s
        Time since power-on at which the trajectory begins.
    axis : int or None
        Turn axis.
    gravity : float, g
    up : (3,) array
        The true vertical in the table's level frame, unit vector.
    earth : (3,) array or None, deg/s
        Earth's rotation in the level frame.
    lever_arm : (3,) array, m
    offset : float, s
    clock : float
        epsilon above.
    lag : float, s
    """

    trajectory: Trajectory
    start: float = 0.0
    axis: int | None = None
    gravity: float = 1.0
    up: NDArray[np.float64] = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    earth: NDArray[np.float64] | None = None
    lever_arm: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    offset: float = 0.0
    clock: float = 0.0
    lag: float = 0.0

    def motion(self, time: NDArray[np.float64], temperature: NDArray[np.float64] | None = None) -> Motion:
        """Return the motion that the sensor shows at times of the log: s since power-on, (n,) array."""
        shown = time + self.offset + self.clock * time
        felt = self._felt(shown, temperature)
        if self.lag > 0.0:
            nodes, weights = lag_rule()
            past = [self._felt(shown - self.lag * node, None) for node in nodes]
            names = ("specific_force", "angular_rate", "angular_acceleration", "specific_force_rate")
            felt = replace(
                felt,
                **{name: sum(w * getattr(p, name) for w, p in zip(weights, past, strict=True)) for name in names},
            )
        return replace(felt, time=time, at_offset=lambda offset=0.0: self.motion(time + offset, temperature))

    def _felt(self, time: NDArray[np.float64], temperature: NDArray[np.float64] | None) -> Motion:
        pose = self.trajectory.true(time - self.start)
        gravity = self.gravity * (self.up @ pose.level)
        force = gravity
        if np.any(self.lever_arm):
            force = force + lever_arm_force(pose, self.lever_arm)
        if pose.force is not None:
            force = force + pose.force
        omega = pose.omega if self.earth is None else pose.omega + self.earth @ pose.level
        rate = np.linalg.norm(pose.omega, axis=1)
        return Motion(
            time=time,
            specific_force=force,
            angular_rate=omega,
            angular_acceleration=pose.alpha,
            specific_force_rate=-np.cross(np.radians(pose.omega), gravity),
            temperature=temperature,
            angle=pose.angle,
            rate=pose.rate,
            axis=self.axis,
            still=still_samples(time, rate),
            level=pose.level,
            direction=pose.direction,
        )


def lag_rule() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return nodes s and weights of the integral of ``exp(-s) u(s)``, two a panel: (m,) arrays; weights sum to 1."""
    middle, half = (PANELS[1:] + PANELS[:-1]) / 2.0, np.diff(PANELS) / 2.0
    nodes = np.concatenate([middle - half / np.sqrt(3.0), middle + half / np.sqrt(3.0)])
    weights = np.tile(half, 2) * np.exp(-nodes)
    return nodes, weights / weights.sum()


def lever_arm_force(pose: Pose, r: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``[omega x (omega x r) + alpha x r] / 9.80665`` in g: (n, 3) array; r in m."""
    omega, alpha = np.radians(pose.omega), np.radians(pose.alpha)
    force: NDArray[np.float64] = np.cross(omega, np.cross(omega, r)) + np.cross(alpha, r)
    return force / STANDARD_GRAVITY
