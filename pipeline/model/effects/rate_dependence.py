"""Accelerometer bias that depends on the angular rate.

    z = W omega

where W is (3, 3), g/(deg/s), and omega the angular rate, deg/s.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.model.effects.base import Effect, Layout, Owner, Parameter, matrix_parameters

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pipeline.records import Motion


class RateDependence(Effect):
    """Linear dependence of an accelerometer on the angular rate: nine coefficients."""

    name = "rate_dependence"
    owner = Owner.SENSOR
    layout = Layout.EVERY_AXIS
    sensors = ("accelerometer",)
    meaning = "An accelerometer reads a part of the angular rate."
    excitation = "turns at several rates about all three axes"
    experiment = "turn in the other direction too: this effect changes its sign, a vibration does not"
    source = "IEEE Std 1293-2018, angular rate sensitivity"

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return W, row by row."""
        del sensor
        return matrix_parameters("W", "g/(deg/s)", "specific force read per angular rate")

    def regressors(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return omega."""
        del sensor, K, values
        return motion.angular_rate


EFFECT = RateDependence()
