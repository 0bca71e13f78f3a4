"""True motion of a sensor in one recording: trajectory, place, mounting and timing.

    f = g up + [omega x (omega x r) + alpha x r] / 9.80665 + shaking,   omega_sensed = omega + level^T Omega_earth

at the true time of the sensor's clock, ``t' = t + tau + epsilon t``, where

up      : (3,) the true vertical in the body frame; in the table's own level frame it is tilted
r       : (3,) position of the accelerometer from the turn axes, m, body frame
tau     : time offset, s: the reading at t shows the motion at t + tau
epsilon : relative error of the sensor's clock

A lag is a first-order low pass of the true motion, ``y(t) = integral_0^inf exp(-s) u(t - lag s) ds``, by Gauss'
rule on short panels: the corners of a ramp lie anywhere in the past, and no smooth rule would follow them.

Effects of place, mounting, table and timing use exact geometry instead of the linear columns that the estimation uses.
Each of ``ALTERATIONS`` takes a scene and the parameters (in units of ``configs/effect``), and returns the scene
with that effect.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.records import Motion
from pipeline.signal.rests import still_samples
from pipeline.simulation.trajectory import Turn, mounted, rotation_by

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from pipeline.records import Values
    from pipeline.simulation.trajectory import Gimbals, Moves, Pose

    Alteration = Callable[["Scene", Values], "Scene"]

STANDARD_GRAVITY = 9.80665  # m/s^2, CGPM 1901
# Edges of the panels in time constants: exp(-20) is 2e-9.
PANELS = np.concatenate([np.linspace(0.0, 2.0, 21), np.linspace(2.25, 6.0, 16), np.linspace(7.0, 20.0, 14)])


@dataclass(frozen=True)
class Scene:
    """The motion of one sensor in one recording."""

    trajectory: Turn | Moves | Gimbals
    start: float = 0.0  # s since power-on at which the trajectory begins
    axis: int | None = None  # of the turn
    gravity: float = 1.0  # g
    up: Values = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))  # the true vertical in the level frame
    earth: Values | None = None  # (3,), deg/s, Earth's rotation in the level frame
    lever_arm: Values = field(default_factory=lambda: np.zeros(3))  # r, m
    offset: float = 0.0  # tau, s
    clock: float = 0.0  # epsilon
    lag: float = 0.0  # time constant, s
    mounting: Values = field(default_factory=lambda: np.eye(3))  # columns: axes of the unit in the trajectory's body

    def motion(self, time: Values, temperature: Values | None = None) -> Motion:
        """Return the motion that the sensor shows at times of the log: s since power-on, (n,) array."""
        shown = time + self.offset + self.clock * time
        motion = self._without_lag(shown, temperature)
        if self.lag > 0.0:
            nodes, weights = _lag_rule()
            past = [self._without_lag(shown - self.lag * node, None) for node in nodes]
            names = ("specific_force", "angular_rate", "angular_acceleration", "specific_force_rate")
            motion = replace(
                motion,
                **{name: sum(w * getattr(p, name) for w, p in zip(weights, past, strict=True)) for name in names},
            )
        return replace(motion, time=time, at_offset=lambda offset=0.0: self.motion(time + offset, temperature))

    def _without_lag(self, time: Values, temperature: Values | None) -> Motion:
        pose = mounted(self.trajectory.pose(time - self.start), self.mounting)
        gravity = self.gravity * (self.up @ pose.level)
        force = gravity
        if np.any(self.lever_arm):
            force = force + _lever_arm_force(pose, self.lever_arm)
        if pose.force is not None:
            force = force + pose.force
        omega = pose.omega if self.earth is None else pose.omega + self.earth @ pose.level
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
            still=still_samples(time, np.linalg.norm(pose.omega, axis=1)),
            level=pose.level,
            direction=pose.direction,
        )


def _lag_rule() -> tuple[Values, Values]:
    """Return nodes s and weights of the integral of ``exp(-s) u(s)``, two a panel: (m,) arrays; weights sum to 1."""
    middle, half = (PANELS[1:] + PANELS[:-1]) / 2.0, np.diff(PANELS) / 2.0
    nodes = np.concatenate([middle - half / np.sqrt(3.0), middle + half / np.sqrt(3.0)])
    weights = np.tile(half, 2) * np.exp(-nodes)
    return nodes, weights / weights.sum()


def _lever_arm_force(pose: Pose, r: Values) -> Values:
    omega, alpha = np.radians(pose.omega), np.radians(pose.alpha)
    force: Values = np.cross(omega, np.cross(omega, r)) + np.cross(alpha, r)
    return force / STANDARD_GRAVITY


def _earth_rotation(scene: Scene, values: Values) -> Scene:
    before = np.zeros(3) if scene.earth is None else scene.earth
    return replace(scene, earth=before + np.pad(values, (0, 3 - len(values))))


def _table_tilt(scene: Scene, values: Values) -> Scene:
    """Tilt the table about its level x and y; deg."""
    return replace(scene, up=scene.up @ rotation_by(np.append(values, 0.0)))


def _added(field_name: str, factor: float = 1.0) -> Alteration:
    """Return an effect that adds its parameters, in units of ``factor``, to a field of the scene."""

    def altered(scene: Scene, values: Values) -> Scene:
        added = factor * (values if len(values) > 1 else values[0])
        return replace(scene, **{field_name: getattr(scene, field_name) + added})

    return altered


def _of_turn(field_name: str, shape: tuple[int, ...] = (3, 2)) -> Alteration:
    """Return an effect that adds its parameters, one row an axis, to a field of the errors of a turn."""

    def altered(scene: Scene, values: Values) -> Scene:
        turn = scene.trajectory
        if scene.axis is None or not isinstance(turn, Turn):
            return scene
        values = np.radians(values) if field_name == "direction" else values
        added = getattr(turn.errors, field_name) + values.reshape(shape)[scene.axis]
        return replace(scene, trajectory=replace(turn, errors=replace(turn.errors, **{field_name: added})))

    return altered


ALTERATIONS: dict[str, Alteration] = {
    "lever_arm": _added("lever_arm"),
    "time_offset": _added("offset"),
    "clock_rate": _added("clock", 1e-6),
    "low_pass_lag": _added("lag"),
    "earth_rotation": _earth_rotation,
    "table_tilt": _table_tilt,
    "table_axis_nonorthogonality": _of_turn("direction"),
    "table_encoder_error": _of_turn("encoder"),
    "table_rate_ripple": _of_turn("ripple"),
    "table_backlash": _of_turn("backlash", (3,)),
}


def alter(scene: Scene, effects: Mapping[str, Values]) -> Scene:
    """Return the scene with those of the effects in it that are not the sensor's own."""
    for name, values in effects.items():
        if name in ALTERATIONS:
            scene = ALTERATIONS[name](scene, values)
    return scene
