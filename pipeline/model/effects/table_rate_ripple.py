"""Rate error of the table with one period a turn.

    gyroscope:      z = K e_a dA/dt (A_a cos A + B_a sin A)
    accelerometer:  z = -K (e_a x f) [A_a sin A + B_a (1 - cos A)]

for turns about axis a, where A_a and B_a are dimensionless, A the table angle, e_a the unit vector of the axis, f the
specific force, g, and K the inverse of the calibration matrix. The accelerometer sees the angle that the ripple sums
up to, where the log shows the commanded one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.model.effects.base import Effect, Layout, Owner, Parameter
from pipeline.model.rotation import ABOUT

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
        if motion.axis is None or motion.angle is None or motion.rate is None:
            return out
        cosine, sine = np.cos(np.radians(motion.angle))[:, None], np.sin(np.radians(motion.angle))[:, None]
        columns = out[:, :, 2 * motion.axis : 2 * motion.axis + 2]
        if sensor == "gyroscope":
            slope = motion.rate[:, None] * K[:, motion.axis]
            columns[:, :, 0], columns[:, :, 1] = slope * cosine, slope * sine
        else:
            slope = motion.specific_force @ (-K @ ABOUT[motion.axis]).T
            columns[:, :, 0], columns[:, :, 1] = slope * sine, slope * (1.0 - cosine)
        return out


EFFECT = TableRateRipple()
