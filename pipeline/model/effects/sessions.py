"""Effects of one session: of one table, one mounting or one switching-on, where the recordings come from several.

    z = z_effect in the recordings of that session, 0 in the others

A procedure names the session of each recording (``setup``); ``<effect>@<setup>`` is the effect there. Recordings of
several sessions then give one estimate of a sensor and the errors of each table. Two effects exist in a session only;
in a single session they are part of the matrix and of the bias:

    mounting : z = K (exp([theta]x)^T - 1) u: the unit is rotated by the vector theta, deg, against the other sessions
    bias     : z = db: the bias has changed, as after switching off and on

One session is without them: the reference of the others. The leans of a table's axes contain the mounting.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import ConfigurationError
from pipeline.model.effects.base import Effect, Layout, Owner, Parameter, truth, unit_of
from pipeline.model.effects.mounting import rotation_columns, turned_back

if TYPE_CHECKING:
    from pipeline.records import Motion, Values


SEPARATOR = "@"
EXPERIMENT = "the same turns in another setup"
AS_THE_BASE = (
    *("owner", "layout", "sensors", "unseen", "needs", "needs_clock", "needs_motion", "needs_both_directions"),
    *("meaning", "excitation", "experiment", "source"),
)


class _Mounting(Effect):
    """The mounting of a session against that of the others."""

    name = "mounting"
    owner = Owner.MOUNTING
    layout = Layout.SHARED
    meaning = "The unit sits turned in this setup, against the others."
    excitation = "turns about all three axes in this setup, and in another one that has no mounting of its own"
    experiment = EXPERIMENT
    source = "rotation of the body frame"

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return theta."""
        del sensor
        return tuple(Parameter(f"theta_{a}", "deg", f"turn of the unit, its part about body {a}") for a in "xyz")

    def regressors(self, sensor: str, motion: Motion, K: Values, values: Values) -> Values:
        """Return the derivative by differences that are exact to 1e-8."""
        return rotation_columns(sensor, motion, K, turned_back, values)

    def reading(self, sensor: str, motion: Motion, K: Values, values: Values) -> Values:
        """Return what the turn adds, however large it is."""
        return np.asarray(truth(sensor, motion) @ (K @ (turned_back(values) - np.eye(3))).T)


class _Bias(Effect):
    """The difference of the bias of a session to that of the others."""

    name = "bias"
    owner = Owner.MOUNTING
    layout = Layout.EVERY_AXIS
    meaning = "The bias in this setup is another one, as after switching off and on."
    excitation = "another setup that has no bias of its own"
    experiment = EXPERIMENT
    source = "IEEE Std 1554-2005, turn-on to turn-on repeatability"

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return db."""
        return tuple(Parameter(f"db_{a}", unit_of(sensor), f"difference of the bias of {a}") for a in "xyz")

    def regressors(self, sensor: str, motion: Motion, K: Values, values: Values) -> Values:
        """Return ones."""
        del sensor, K, values
        return np.ones((len(motion.time), 1))


OWN: dict[str, Effect] = {effect.name: effect for effect in (_Mounting(), _Bias())}


class _InSession(Effect):
    """An effect in one session, linear in its parameters; ``name`` is ``<base>@<session>``."""

    def __init__(self, name: str, base: Effect) -> None:
        self.base, self.session = base, name.partition(SEPARATOR)[2]
        for attribute in AS_THE_BASE:
            setattr(self, attribute, getattr(base, attribute))
        self.name = name

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return those of the effect."""
        return self.base.parameters(sensor)

    def regressors(self, sensor: str, motion: Motion, K: Values, values: Values) -> Values:
        """Return those of the effect in its session, zeros elsewhere."""
        found = self.base.regressors(sensor, motion, K, values)
        return found if motion.setup == self.session else np.zeros_like(found)

    def reading(self, sensor: str, motion: Motion, K: Values, values: Values) -> Values:
        """Return what the effect adds in its session, zeros elsewhere."""
        if motion.setup == self.session:
            return self.base.reading(sensor, motion, K, values)
        return np.zeros((len(motion.time), 3))


def in_session(name: str, base: Effect) -> Effect:
    """Return the effect ``<base>@<session>``.

    Raises
    ------
    ConfigurationError
        If the effect moves the motion in time, or is not linear in its parameters.
    """
    if base.moves or base.nonlinear:
        raise ConfigurationError(
            f"effect {name}: {base.name} cannot be one setup's own, as the fit is not linear in it; name {base.name}"
        )
    return _InSession(name, base)
