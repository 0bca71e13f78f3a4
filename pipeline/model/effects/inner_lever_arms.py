"""Size effect: the accelerometers of the three axes are not at one point.

    z_c = [omega x (omega x r_c) + alpha x r_c]_c / 9.80665,    c = x, y, z

where r_c is the place of the accelerometer of axis c from the axes of the table, m, omega the angular rate, rad/s, and
alpha the angular acceleration, rad/s^2. It contains the lever arm of the whole unit, as the r that the axes have in
common.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.model.effects.base import Effect, Layout, Owner, Parameter, matrix_parameters
from pipeline.model.effects.lever_arm import lever_matrix

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pipeline.records import Motion


class InnerLeverArms(Effect):
    """Places of the three accelerometers: nine coefficients."""

    name = "inner_lever_arms"
    owner = Owner.SENSOR
    layout = Layout.PER_AXIS
    sensors = ("accelerometer",)
    contains = ("lever_arm",)
    meaning = "The accelerometers of the three axes are not at one point."
    excitation = "turns about all three axes at 100 deg/s and more"
    experiment = "turn about all three axes at 100 to 200 deg/s while the accelerometer is recorded"
    source = "Kalibr, scale-misalignment-size-effect IMU model; IEEE Std 1293-2018, size effect"

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return r, axis by axis."""
        del sensor
        return matrix_parameters("r", "m", "place of the accelerometer")

    def regressors(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return row c of the matrix of the lever arm, for axis c."""
        del sensor, K, values
        return lever_matrix(motion.angular_rate, motion.angular_acceleration)


EFFECT = InnerLeverArms()
