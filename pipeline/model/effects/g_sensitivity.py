"""Gyroscope bias that depends on specific force.

    z = G f

where G is (3, 3), deg/s/g, and f the specific force in g (IEEE Std 528-2019, "g-sensitive drift").
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.model.effects.base import Effect, Owner, Parameter, every_axis

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pipeline.records import Motion


class GSensitivity(Effect):
    """Linear acceleration sensitivity of a gyroscope: nine coefficients."""

    name = "g_sensitivity"
    owner = Owner.SENSOR
    sensors = ("gyroscope",)
    excitation = "turns about all three axes in which gravity moves through the body"
    source = "IEEE Std 528-2019; MPU-6000/6050 product specification 3.4, linear acceleration sensitivity"

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return G, row by row."""
        del sensor
        meaning = "rate read per g"
        return tuple(Parameter(f"G_{a}{b}", "deg/s/g", f"{a} {meaning} along {b}") for a in "xyz" for b in "xyz")

    def columns(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return f for each axis."""
        del sensor, K, values
        return every_axis(motion.specific_force)


EFFECT = GSensitivity()
