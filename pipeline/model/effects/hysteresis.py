"""Hysteresis: the reading lags behind the direction in which the specific force last changed.

    z_c = H_c tanh(s_c / 0.05),    s = -e x f,    c = x, y, z

where H is (3,), g, e the unit vector of the turn (at rest of the last one) and f the specific force, g, so that s is
the change of f per radian of that turn; the tanh smooths its sign.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.model.effects.base import Effect, Layout, Owner, Parameter, axis_parameters, turning_direction

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.records import Motion


class Hysteresis(Effect):
    """Hysteresis of an accelerometer: one coefficient an axis."""

    name = "hysteresis"
    owner = Owner.SENSOR
    layout = Layout.PER_AXIS
    sensors = ("accelerometer",)
    meaning = "The reading depends on the direction in which the specific force last changed."
    excitation = "turns in steps or at a steady rate, each axis rising and falling"
    experiment = "reach the same inclinations from both sides: turn in the other direction too"
    source = "IEEE Std 1293-2018, hysteresis error"

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return H, axis by axis."""
        del sensor
        return axis_parameters("H", "g", "half the width of the loop")

    def regressors(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return tanh(s / 0.05)."""
        del sensor, K, values
        change = -np.cross(turning_direction(motion), motion.specific_force)
        return np.tanh(change / 0.05)[:, :, None]


EFFECT = Hysteresis()
