"""Angle error of the table with one period a turn, as of an encoder that sits off centre.

    z = -K (e_a x f) (pi/180) (A_a cos A + B_a sin A)

for turns about axis a, where A_a and B_a are deg, A the table angle, e_a the unit vector of the axis, f the specific
force, g, and K the inverse of the calibration matrix.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from pipeline.model.effects.base import Effect, Layout, Owner, Parameter

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.records import Motion

HARMONICS = (("A", "cos(angle)"), ("B", "sin(angle)"))


class TableEncoderError(Effect):
    """Angle error once a turn: two coefficients a turn axis."""

    name = "table_encoder_error"
    owner = Owner.TABLE
    layout = Layout.SHARED
    needs = ("angle",)
    unseen: ClassVar[dict[str, str]] = {
        "gyroscope": "the rate is logged by itself; an error of the angle does not enter it",
    }
    meaning = "The table's angle is wrong by some arcminutes, once around in a turn."
    excitation = "a full turn about each axis"
    experiment = "turn a second time with the unit remounted at another angle: the error stays with the table"
    source = "NIST, angle encoder calibration: eccentricity gives an error of one period a turn"

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return A and B, axis by axis."""
        del sensor
        return tuple(
            Parameter(f"{s}_{a}", "deg", f"angle error times {w}, axis {a}") for a in "xyz" for s, w in HARMONICS
        )

    def regressors(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the columns of the axis turned about, zeros for the others."""
        del values
        out = np.zeros((len(motion.time), 3, 6))
        if sensor == "accelerometer" and motion.axis is not None and motion.angle is not None:
            slope = -np.radians(1.0) * np.cross(np.eye(3)[motion.axis], motion.specific_force) @ K.T
            angle = np.radians(motion.angle)[:, None]
            out[:, :, 2 * motion.axis] = slope * np.cos(angle)
            out[:, :, 2 * motion.axis + 1] = slope * np.sin(angle)
        return out


EFFECT = TableEncoderError()
