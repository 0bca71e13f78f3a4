"""Rate error of the table with one period a turn.

    z = K e_a dA/dt (A_a cos A + B_a sin A)

for turns about axis a, where A_a and B_a are dimensionless, A the table angle, e_a the unit vector of the axis, and K
the inverse of the calibration matrix.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from pipeline.model.effects.base import Effect, Layout, Owner, Parameter

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.records import Motion

HARMONICS = (("A", "cos(angle)"), ("B", "sin(angle)"))


class TableRateRipple(Effect):
    """Rate error once a turn: two coefficients a turn axis."""

    name = "table_rate_ripple"
    owner = Owner.TABLE
    layout = Layout.SHARED
    needs = ("angle",)
    unseen: ClassVar[dict[str, str]] = {
        "accelerometer": "the angle is logged by itself; a ripple of the rate does not enter it",
    }
    meaning = "The table's rate is wrong in proportion, once around in a turn."
    excitation = "a full turn about each axis"
    experiment = "turn a second time with the unit remounted at another angle: the ripple stays with the table"
    source = "IEEE Std 952-2020, rate table tests; a gear or motor that sits off centre gives one period a turn"

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return A and B, axis by axis."""
        del sensor
        return tuple(Parameter(f"{s}_{a}", "1", f"rate error times {w}, axis {a}") for a in "xyz" for s, w in HARMONICS)

    def regressors(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the columns of the axis turned about, zeros for the others."""
        del values
        out = np.zeros((len(motion.time), 3, 6))
        if sensor == "gyroscope" and motion.axis is not None and motion.angle is not None and motion.rate is not None:
            slope = motion.rate[:, None] * K[:, motion.axis]
            angle = np.radians(motion.angle)[:, None]
            out[:, :, 2 * motion.axis] = slope * np.cos(angle)
            out[:, :, 2 * motion.axis + 1] = slope * np.sin(angle)
        return out


EFFECT = TableRateRipple()
