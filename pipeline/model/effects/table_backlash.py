"""Play of the table: the angle is behind in the direction of the turn.

    z = K (e_a x f) (pi/180) B_a s

for turns about axis a, where B_a is deg, s = +1 or -1 the direction of the turn (at rest of the last one), e_a the unit
vector of the axis, f the specific force, g, and K the inverse of the calibration matrix.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from pipeline.model.effects.base import Effect, Layout, Owner, Parameter, turning_direction
from pipeline.model.rotation import ABOUT

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.records import Motion


class TableBacklash(Effect):
    """Play of the table: one coefficient a turn axis."""

    name = "table_backlash"
    owner = Owner.TABLE
    layout = Layout.SHARED
    needs = ("angle",)
    unseen: ClassVar[dict[str, str]] = {
        "gyroscope": "an angle that is behind by a constant does not change the rate",
    }
    meaning = "The table's angle is behind in the direction of the turn."
    excitation = "turns in both directions about each axis"
    experiment = "turn in the other direction too: play changes its sign, an error of the home angle does not"
    source = "ISO 230-2, reversal error of a rotary axis"

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return B, axis by axis."""
        del sensor
        return tuple(Parameter(f"B_{a}", "deg", f"half the play, axis {a}") for a in "xyz")

    def regressors(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the column of the axis turned about, zeros for the others."""
        del values
        out = np.zeros((len(motion.time), 3, 3))
        if sensor == "accelerometer" and motion.axis is not None:
            slope = motion.specific_force @ (np.radians(1.0) * K @ ABOUT[motion.axis]).T
            out[:, :, motion.axis] = slope * turning_direction(motion)[:, motion.axis, None]
        return out


EFFECT = TableBacklash()
