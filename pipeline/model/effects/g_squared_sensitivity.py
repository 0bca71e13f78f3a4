"""Gyroscope bias that depends on products of specific forces.

    z_c = G2_c . (f_x^2, f_y^2, f_x f_y, f_y f_z, f_z f_x),    c = x, y, z

where G2 is (3, 5), deg/s/g^2, and f the specific force, g. As f_x^2 + f_y^2 + f_z^2 = 1 g^2 at rest and on a table, the
sixth product is a bias and left out.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.model.effects.base import Effect, Layout, Owner, Parameter

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.records import Motion


class GSquaredSensitivity(Effect):
    """Quadratic acceleration sensitivity of a gyroscope: fifteen coefficients."""

    name = "g_squared_sensitivity"
    owner = Owner.SENSOR
    layout = Layout.EVERY_AXIS
    sensors = ("gyroscope",)
    meaning = "A gyroscope reads products of the specific forces along two axes."
    excitation = "turns about all three axes in which gravity moves through the body"
    experiment = "turn more than once about each axis, slowly: this effect has two periods a turn, a linear one has one"
    source = "IEEE Std 952-2020 and 528-2019, g-squared-sensitive drift (anisoelasticity)"

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return G2, axis by axis."""
        del sensor
        return tuple(
            Parameter(
                f"G2_{a}_{pair}", "deg/s/g^2", f"product of specific forces along {pair[0]} and {pair[1]}, {a} axis"
            )
            for a in "xyz"
            for pair in ("xx", "yy", "xy", "yz", "zx")
        )

    def regressors(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the five products."""
        del sensor, K, values
        f = motion.specific_force
        return np.column_stack([f[:, :2] ** 2, f * np.roll(f, -1, axis=1)])


EFFECT = GSquaredSensitivity()
