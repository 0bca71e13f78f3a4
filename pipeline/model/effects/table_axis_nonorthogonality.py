"""Turn axes of the table that are not at right angles.

    accelerometer:  z = K [theta x f - R_a(-A) (theta x f_0)] (pi/180),    theta = e_a x d_a
    gyroscope:      z = K (pi/180) d_a dA/dt

for turns about axis a, where d_a is how far that axis leans, deg, along the other two body axes at angle 0, e_a its
unit vector, A the table angle, R_a the rotation about it, f the specific force, f_0 that at angle 0, and K the inverse
of the calibration matrix.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.model.effects.base import Effect, Layout, Owner, Parameter, length
from pipeline.model.kinematics import UP_AT_ZERO
from pipeline.model.rotation import ABOUT, skew, turn_about_axis

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.records import Motion

UPRIGHT = 0.5  # sine of the turn axis's elevation, which is 0 or 1: gravity turns with the angle, or not at all
LEANS = (
    ("x", "y"),
    ("x", "z"),
    ("y", "z"),
    ("y", "x"),
    ("z", "x"),
    ("z", "y"),
)  # the axis, and the other two in cyclic order


class TableAxisNonorthogonality(Effect):
    """Non-orthogonality of the table's axes: six coefficients."""

    name = "table_axis_nonorthogonality"
    owner = Owner.TABLE
    layout = Layout.SHARED
    needs = ("level",)
    meaning = "The axes that the table turns about are not at right angles."
    excitation = "turns about all three axes"
    experiment = "turn the unit on its mount by 90 deg and repeat, or take the axes in another order"
    source = "Acutronic AC33xx specification, orthogonality; first-order geometry of a turn"

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return d, axis by axis."""
        del sensor
        return tuple(Parameter(f"d_{a}{b}", "deg", f"lean of table axis {a} toward {b}") for a, b in LEANS)

    def regressors(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the columns of the axis turned about, zeros for the others."""
        del values
        out = np.zeros((len(motion.time), 3, 6))
        if motion.axis is None or motion.angle is None or motion.rate is None:
            return out
        axis, f = motion.axis, motion.specific_force
        assert motion.level is not None  # noqa: S101
        upright = abs(motion.level[0, 2, axis]) > UPRIGHT
        up = motion.level[0, 2] if upright else UP_AT_ZERO[axis]
        gravity = length(f)[:, None] if sensor == "accelerometer" else None
        for step in (1, 2):
            lean = np.zeros(3)
            lean[(axis + step) % 3] = np.radians(1.0)
            if gravity is None:
                out[:, :, 2 * axis + step - 1] = motion.rate[:, None] * (K @ lean)
                continue
            across = skew(ABOUT[axis] @ lean)  # across @ u = theta x u
            home = turn_about_axis(across @ up, axis, -motion.angle)
            out[:, :, 2 * axis + step - 1] = (f @ across.T - gravity * home) @ K.T
        return out


EFFECT = TableAxisNonorthogonality()
