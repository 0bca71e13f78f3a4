"""Effects in a recording or a session: rotations of its mounting, and zeros of the table's angle.

    mounting:      u' = exp([theta_k]x)^T u,   theta_k the rotation of the unit in recording or setup k, body frame
    encoder_zero:  u' = exp([zero_k e_a]x) u,  e_a the axis of turn k: the unit is at A - zero_k where the log says A

and ``reading = b + K u' + ...`` with u the truth by the log. Both have parameters for each recording, so that they are
bound to the recordings of a unit before they are fitted (``Effect.of_recordings``). They change the whole motion: the
other effects act on the motion in the frame of the rotated sensor.

A rotation that all recordings share cannot be distinguished from K. The prior ``theta_k ~ N(0, s^2)`` determines it:
the frame of the calibration is then the mean of the mountings. Gravity determines the other rotations: in turns about
three axes, the constant and the two first harmonics of the accelerometer are 27 numbers for 9 parameters of K, 3 of b
and 6 of the mountings.

Where the recordings come from several tables, mountings or switchings-on (sessions), an effect can act in one session:

    z = z_effect in the recordings of that session, 0 in the others

A procedure names the session of each recording (``setup``); ``<effect>@<setup>`` is the effect in that session.
Recordings of several sessions then give one estimate of a sensor, and the errors of each table. Two effects exist only
as effects of a session, because in a single session they are part of the matrix and of the bias:

    mounting : z = K (exp([theta]x)^T - 1) u: the unit is rotated by the vector theta, deg, against the other sessions
    bias     : z = db: the bias has changed, as after switching off and on

One session, the reference, has neither of them. The leans of a table's axes contain the mounting.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import replace
from functools import cache, partial
from types import MappingProxyType
from typing import Any, Self

import numpy as np

from pipeline.core.errors import ConfigurationError
from pipeline.core.records import MATRIX, Motion, Values
from pipeline.physics.effects.base import Effect, EffectParameter, Layout, Owner, truth, unit_of
from pipeline.physics.effects.formula_effect import DeclaredEffect
from pipeline.physics.kinematics import skew, turn_by_vector

ROTATION_ITERATIONS = 6  # of a fixed point; rotations of 10 deg converge by a factor of 30 in each
ROTATION_STEP_DEG = 1e-3  # of the central difference of a rotation: its error is (step^2 / 6) rad = 5e-11
VECTORS = ("specific_force", "angular_rate", "angular_acceleration", "specific_force_rate", "direction", "level")
SEPARATOR = "@"
EXPERIMENT = "the same turns in another setup"
AS_THE_BASE = (
    *("owner", "layout", "sensors", "unseen", "needs", "needs_clock", "needs_motion", "needs_both_directions"),
    "needs_swing",
    *("meaning", "excitation", "experiment", "source"),
)


def rotated(motion: Motion, rotation: Values) -> Motion:
    """Rotate the vectors of a motion in the body frame by a (3, 3) matrix, also at offsets in time."""
    found: dict[str, Any] = {n: v @ rotation.T for n in VECTORS if (v := getattr(motion, n)) is not None}
    for name in ("at_offset", "at_lag"):
        trajectory = getattr(motion, name)
        found[name] = None if trajectory is None else partial(_rotated_at, trajectory, rotation)
    return replace(motion, **found)


def rotation_columns(
    sensor: str, motion: Motion, K: Values, rotation: Callable[[Values], Values], values: Values
) -> Values:
    """Return the derivative of ``K R(p) u`` with respect to p angles, deg, by central differences: (n, 3, p) array.

    ``rotation``: (p, p) rows of angles to (p, 3, 3) rotations R.
    """
    steps = ROTATION_STEP_DEG * np.eye(len(values))
    slopes = (rotation(values + steps) - rotation(values - steps)) / (2.0 * ROTATION_STEP_DEG)
    u = truth(sensor, motion)
    return np.stack([u @ (K @ slope).T for slope in slopes], axis=2)


def turned_back(values: Values) -> Values:
    """Return ``exp([theta]x)^T`` of rotation vectors, deg: (..., 3) to (..., 3, 3) array."""
    return np.asarray(np.swapaxes(turn_by_vector(np.radians(values)), -1, -2))


def _rotated_at(trajectory: Callable[..., Motion], rotation: Values, **at: Any) -> Motion:  # noqa: ANN401
    return rotated(trajectory(**at), rotation)


class _OfRecordings(DeclaredEffect):
    """A rotation of the motion in each recording, by parameters in deg."""

    layout = Layout.SHARED
    of_turns = True
    recordings: tuple[str, ...] = ()
    suffixes: tuple[str, ...]
    what: str

    def of_recordings(self, setups: Mapping[str, str]) -> Self:
        bound = copy(self)
        bound.recordings = tuple(dict.fromkeys(self.owner_of(*pair) for pair in setups.items()))
        bound.definition = {"name": self.name, "recordings": list(bound.recordings)}
        return bound

    def owner_of(self, recording: str, setup: str) -> str:
        """Return the name under which a recording has parameters: its own."""
        return recording

    def covers(self, motion: Motion) -> bool:
        return self.owner_of(motion.recording, motion.setup) in self.recordings

    def parameters(self, sensor: str) -> tuple[EffectParameter, ...]:
        """Return the parameters of each recording, one recording after the other."""
        pairs = ((name, s, s.replace("_", " about body ")) for name in self.recordings for s in self.suffixes)
        return tuple(EffectParameter(f"{name}{s}", "deg", f"{self.what}{about}, {name}") for name, s, about in pairs)

    def rotation(self, motion: Motion, values: Values) -> Values:
        """Return the rotation of the vectors in the body frame by a recording's parameters: (..., 3, 3) array."""
        raise NotImplementedError

    def moved(self, motion: Motion, values: Values) -> Motion:
        """Return the motion in the frame of the rotated unit."""
        place = self._place(motion)
        return rotated(motion, self.rotation(motion, values[place])) if place.stop and np.any(values[place]) else motion

    def regressors(self, sensor: str, motion: Motion, K: Values, values: Values) -> Values:
        """Return the derivative of ``K u'`` with respect to each parameter, zeros for the other recordings."""
        columns = np.zeros((len(motion.time), 3, len(values)))
        place = self._place(motion)
        if place.stop:
            columns[:, :, place] = rotation_columns(sensor, motion, K, partial(self.rotation, motion), values[place])
        return columns

    def reading(self, sensor: str, motion: Motion, K: Values, values: Values) -> Values:
        """Return ``K (u' - u)``."""
        return np.asarray((truth(sensor, self.moved(motion, values)) - truth(sensor, motion)) @ K.T)

    def _place(self, motion: Motion) -> slice:
        """Return the slice of the parameters of a motion's recording; empty where it has none."""
        if not self.covers(motion):
            return slice(0, 0)
        size = len(self.suffixes)
        at = size * self.recordings.index(self.owner_of(motion.recording, motion.setup))
        return slice(at, at + size)


class Mounting(_OfRecordings):
    """The rotation of the unit in each recording, or in all recordings of a setup: three parameters each."""

    suffixes = ("_x", "_y", "_z")
    what = "rotation of the unit"

    def owner_of(self, recording: str, setup: str) -> str:
        """Return the setup, or the recording where no setup is named."""
        return setup or recording

    def rotation(self, motion: Motion, values: Values) -> Values:
        """Return ``exp([theta]x)^T``."""
        return turned_back(values)


def in_mean_frame(K: Values, values: Values) -> tuple[Values, Values]:
    """Return K and the rotations of the unit, deg, in the frame in which the mean of the rotations is 0."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415  (0.1 s that only fits of mountings pay)

    found, turned = Rotation.from_rotvec(values.reshape(-1, 3), degrees=True), Rotation.identity()
    for _ in range(ROTATION_ITERATIONS):  # each lowers the mean by the square of the largest rotation, rad
        turned = turned * Rotation.from_rotvec(-(found * turned).as_rotvec().mean(axis=0))
    return K @ turned.as_matrix(), (found * turned).as_rotvec(degrees=True).ravel()


def errors_in_mean_frame(K: Values, values: Values, at: slice, count: int) -> Values:
    """Return the matrix that maps small errors of a fit to the frame of the mean mounting: (count, count) array.

    A rotation phi of the frame does not change the readings: ``K' = K exp([phi]x)``, ``exp([theta_k']x) =
    exp([theta_k]x) exp([phi]x)``. With G the derivative of all parameters with respect to phi and A the matrix that
    takes the mean of the rotations, the map is ``1 - G (A G)^-1 A`` (S-transformation; Baarda, Publ. Geodesy 5, 1973).

    ``values``: (3 m,) rotations of the unit, deg, the parameters ``at``; those of the matrix are K, row by row.
    """
    from scipy.spatial.transform import Rotation  # noqa: PLC0415  (0.1 s that only fits of mountings pay)

    steps = Rotation.from_rotvec(ROTATION_STEP_DEG * np.eye(3), degrees=True)
    G, mean = np.zeros((count, 3)), np.zeros((3, count))
    G[MATRIX] = np.stack([np.radians(1.0) * (K @ turn).ravel() for turn in skew(np.eye(3))], axis=1)
    theta = values.reshape(-1, 3)
    moved = [(Rotation.from_rotvec(t, degrees=True) * steps).as_rotvec(degrees=True) - t for t in theta]
    G[at] = np.concatenate([change.T for change in moved]) / ROTATION_STEP_DEG
    mean[:, at] = np.tile(np.eye(3), len(theta)) / len(theta)
    return np.asarray(np.eye(count) - G @ np.linalg.solve(mean @ G, mean))


class EncoderZero(_OfRecordings):
    """The zero of the table's angle in each turn: one parameter for each recording."""

    suffixes = ("",)
    what = "zero of the table's angle"
    unseen = MappingProxyType({"gyroscope": "a zero of the angle does not change the rate"})

    def rotation(self, motion: Motion, values: Values) -> Values:
        """Return ``exp([zero e_a]x)``."""
        assert motion.axis is not None  # noqa: S101
        return turn_by_vector(np.radians(values) * np.eye(3)[motion.axis])


class _Mounting(Effect):
    """The rotation of the mounting in one session against the other sessions."""

    name = "mounting"
    owner = Owner.MOUNTING
    layout = Layout.SHARED
    meaning = "The unit sits turned in this setup, against the others."
    excitation = "turns about all three axes in this setup, and in another one that has no mounting of its own"
    experiment = EXPERIMENT
    source = "rotation of the body frame"

    def parameters(self, sensor: str) -> tuple[EffectParameter, ...]:
        return tuple(EffectParameter(f"theta_{a}", "deg", f"turn of the unit, its part about body {a}") for a in "xyz")

    def regressors(self, sensor: str, motion: Motion, K: Values, values: Values) -> Values:
        return rotation_columns(sensor, motion, K, turned_back, values)

    def reading(self, sensor: str, motion: Motion, K: Values, values: Values) -> Values:
        """Return ``K (exp([theta]x)^T - 1) u``."""
        return np.asarray(truth(sensor, motion) @ (K @ (turned_back(values) - np.eye(3))).T)


class _Bias(Effect):
    """The difference between the bias in one session and in the other sessions."""

    name = "bias"
    owner = Owner.MOUNTING
    layout = Layout.EVERY_AXIS
    meaning = "The bias in this setup is another one, as after switching off and on."
    excitation = "another setup that has no bias of its own"
    experiment = EXPERIMENT
    source = "IEEE Std 1554-2005, turn-on to turn-on repeatability"

    def parameters(self, sensor: str) -> tuple[EffectParameter, ...]:
        return tuple(EffectParameter(f"db_{a}", unit_of(sensor), f"difference of the bias of {a}") for a in "xyz")

    def regressors(self, sensor: str, motion: Motion, K: Values, values: Values) -> Values:
        return np.ones((len(motion.time), 1))


SETUP_EFFECTS: dict[str, Effect] = {effect.name: effect for effect in (_Mounting(), _Bias())}


class _InSession(Effect):
    """An effect that acts in one session only; ``name`` is ``<base>@<session>``."""

    def __init__(self, name: str, base: Effect) -> None:
        self.base, self.session = base, name.partition(SEPARATOR)[2]
        for attribute in AS_THE_BASE:
            setattr(self, attribute, getattr(base, attribute))
        self.name = name

    def parameters(self, sensor: str) -> tuple[EffectParameter, ...]:
        return self.base.parameters(sensor)

    def regressors(self, sensor: str, motion: Motion, K: Values, values: Values) -> Values:
        found = self.base.regressors(sensor, motion, K, values)
        return found if motion.setup == self.session else np.zeros_like(found)

    def reading(self, sensor: str, motion: Motion, K: Values, values: Values) -> Values:
        if motion.setup == self.session:
            return self.base.reading(sensor, motion, K, values)
        return np.zeros((len(motion.time), 3))


@cache
def in_session(name: str, base: Effect) -> Effect:
    """Return ``<base>@<session>``; raise ``ConfigurationError`` if the effect moves in time or is not linear."""
    if base.moves or base.nonlinear:
        raise ConfigurationError(
            f"effect {name}: {base.name} cannot be one setup's own, as the fit is not linear in it; name {base.name}"
        )
    return _InSession(name, base)
