"""A table that is not level.

    z = K R^T g (pi/180) (-d_y, d_x, 0)

where d_x and d_y are small turns of the table about level x and y, deg, R the rotation from body to level, g the local
gravity, g, and K the inverse of the calibration matrix.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from pipeline.model.effects.base import Effect, Layout, Owner, Parameter

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.records import Motion

SIGNS = np.array([[1.0], [-1.0]])


class TableTilt(Effect):
    """Tilt of the table: two coefficients."""

    name = "table_tilt"
    owner = Owner.TABLE
    layout = Layout.SHARED
    needs = ("level",)
    unseen: ClassVar[dict[str, str]] = {
        "gyroscope": "the direction of gravity does not change a rate",
    }
    meaning = "The table is not level."
    excitation = "turns about all three axes"
    experiment = "turn the unit by 180 deg on its mount and repeat: the tilt stays with the table"
    source = "IEEE Std 1293-2018, multipoint tumble, dividing head levelling error"

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return d_x and d_y."""
        del sensor
        return tuple(Parameter(f"d_{a}", "deg", f"tilt of the table about level {a}") for a in "xy")

    def regressors(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return K times level y and minus level x in the body frame, times gravity; zeros for the gyroscope."""
        del values
        assert motion.level is not None  # noqa: S101
        if sensor == "gyroscope":
            return np.zeros((len(motion.time), 3, 2))
        gravity = np.linalg.norm(motion.specific_force, axis=1)[:, None, None]
        columns: NDArray[np.float64] = (
            np.radians(1.0) * gravity * (K @ (motion.level[:, [1, 0], :] * SIGNS).transpose(0, 2, 1))
        )
        return columns


EFFECT = TableTilt()
