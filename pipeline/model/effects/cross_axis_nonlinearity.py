"""Products of the specific forces along two axes.

    z_c = K_c,xy f_x f_y + K_c,yz f_y f_z + K_c,zx f_z f_x,    c = x, y, z

where K is (3, 3), 1/g, and f the specific force, g. Of the nine terms, those with the axis itself are the K_ip and K_io
of the standard, the third is K_po.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.model.effects.base import Effect, Layout, Owner, Parameter

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.records import Motion


class CrossAxisNonlinearity(Effect):
    """Cross-axis nonlinearity of an accelerometer: nine coefficients."""

    name = "cross_axis_nonlinearity"
    owner = Owner.SENSOR
    layout = Layout.EVERY_AXIS
    sensors = ("accelerometer",)
    meaning = "An accelerometer reads a product of the specific forces along two axes."
    excitation = "turns in which two axes are inclined at once (45 deg), about all three axes"
    experiment = "record rests in which all three axes are inclined at once, such as body diagonals up"
    source = "IEEE Std 1293-2018, K_ip, K_io and K_po (cross-coupling coefficients)"

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return K, axis by axis."""
        del sensor
        return tuple(
            Parameter(f"K_{a}_{pair}", "1/g", f"product of specific forces along {pair[0]} and {pair[1]}, {a} axis")
            for a in "xyz"
            for pair in ("xy", "yz", "zx")
        )

    def regressors(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return f_x f_y, f_y f_z and f_z f_x."""
        del sensor, K, values
        return motion.specific_force * np.roll(motion.specific_force, -1, axis=1)


EFFECT = CrossAxisNonlinearity()
