"""Bias that a vibration leaves behind, here the vibration of the turning table.

    z = V |omega|

where V is (3,), g/(deg/s) or dimensionless, and omega the angular rate, deg/s. The vibration itself is above the
sampling rate; its strength is taken to grow with the rate of the turn.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.model.effects.base import Effect, Layout, Owner, Parameter, axis_parameters, length

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pipeline.records import Motion


class VibrationRectification(Effect):
    """Rectified vibration: one coefficient an axis."""

    name = "vibration_rectification"
    owner = Owner.SENSOR
    layout = Layout.EVERY_AXIS
    meaning = "The bias shifts while the table turns, as its vibration is rectified."
    excitation = "turns at several rates, in both directions"
    experiment = "turn in the other direction too: a vibration does not know the direction, a dependence on rate does"
    source = "IEEE Std 1293-2018, vibration rectification; IEEE Std 528-2019, vibration rectification error"

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return V, axis by axis."""
        unit = "g/(deg/s)" if sensor == "accelerometer" else "1"
        return axis_parameters("V", unit, "bias per rate of turn")

    def regressors(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return |omega|."""
        del sensor, K, values
        return length(motion.angular_rate)[:, None]


EFFECT = VibrationRectification()
