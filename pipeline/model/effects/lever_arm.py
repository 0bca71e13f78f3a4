"""A unit that does not sit on the axes of the table.

    z = K [omega x (omega x r) + alpha x r] / 9.80665

where r is (3,), m, the place of the unit from the point in which the table's axes meet, in the body frame, omega the
angular rate, rad/s, alpha the angular acceleration, rad/s^2, and K the inverse of the calibration matrix.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.model.effects.base import STANDARD_GRAVITY, Effect, Layout, Owner, Parameter

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.records import Motion


def lever_matrix(rate_dps: NDArray[np.float64], acceleration_dps2: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``L`` such that ``L @ r`` is the specific force at lever arm r: (n, 3, 3) array, g/m.

    ``L = (omega omega^T - |omega|^2 I + [alpha x]) / 9.80665``.

    Parameters
    ----------
    rate_dps : (n, 3) array, deg/s
    acceleration_dps2 : (n, 3) array, deg/s^2
    """
    omega = np.radians(rate_dps)
    alpha = np.radians(acceleration_dps2)
    lever = omega[:, :, None] * omega[:, None, :]
    lever[:, [0, 1, 2], [0, 1, 2]] -= (omega[:, 0] ** 2 + omega[:, 1] ** 2 + omega[:, 2] ** 2)[:, None]
    lever[:, [2, 0, 1], [1, 2, 0]] += alpha
    lever[:, [1, 2, 0], [2, 0, 1]] -= alpha
    lever /= STANDARD_GRAVITY
    return lever


class LeverArm(Effect):
    """Lever arm of the whole unit: three coefficients."""

    name = "lever_arm"
    owner = Owner.MOUNTING
    layout = Layout.SHARED
    sensors = ("accelerometer",)
    meaning = "The unit does not sit on the axes of the table, so turning adds a specific force."
    excitation = "turns at 30 deg/s and more while the accelerometer is recorded"
    experiment = "turn about all three axes at 100 to 200 deg/s while the accelerometer is recorded"
    source = "rigid-body kinematics; Sudsanguan 2019, section 2 (mounting offset from the axis)"

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return r."""
        del sensor
        return tuple(Parameter(f"r_{a}", "m", f"place of the unit from the table's axes along {a}") for a in "xyz")

    def regressors(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return K times the matrix of the lever arm."""
        del sensor, values
        columns: NDArray[np.float64] = K @ lever_matrix(motion.angular_rate, motion.angular_acceleration)
        return columns


EFFECT = LeverArm()
