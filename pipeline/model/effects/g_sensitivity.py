"""Gyroscope bias that depends on specific force.

    z = G f

where G is (3, 3), deg/s/g, and f the specific force in g.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.model.effects.base import Effect, Layout, Owner, Parameter, matrix_parameters

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pipeline.records import Motion


class GSensitivity(Effect):
    """Linear acceleration sensitivity of a gyroscope: nine coefficients."""

    name = "g_sensitivity"
    owner = Owner.SENSOR
    layout = Layout.EVERY_AXIS
    sensors = ("gyroscope",)
    meaning = "A gyroscope reads a part of the specific force."
    excitation = "turns about all three axes in which gravity moves through the body, or rests in several attitudes"
    experiment = (
        "turn the table's home about the vertical: Earth's rotation stays with Earth, the sensitivity with the unit"
    )
    source = (
        "IEEE Std 528-2019, g-sensitive drift; MPU-6000/6050 product specification 6.1, linear acceleration sensitivity"
    )

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return G, row by row."""
        del sensor
        return matrix_parameters("G", "deg/s/g", "rate read per specific force")

    def regressors(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return f."""
        del sensor, K, values
        return motion.specific_force


EFFECT = GSensitivity()
