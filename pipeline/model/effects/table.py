"""Effects of errors of the table: in its turns and in its level.

With K the inverse of the calibration matrix, f the specific force, g, A the table angle, e_a the unit vector of axis a,
and the parameters of ``configs/effect/`` (angles in deg):

    table_tilt:            accelerometer: z = K R^T |f| (pi/180) (-d_y, d_x, 0), R the rotation from body to level

    turns about axis a:
    table_axis_nonorthogonality, d_a: lean of the axis along the other two body axes at angle 0; R_a: a turn
                           accelerometer: z = K [theta x f - R_a(-A) (theta x f_0)] (pi/180),  theta = e_a x d_a
                           gyroscope:     z = K (pi/180) d_a dA/dt
    table_backlash, the angle lags by B_a in the direction s = +1 or -1 of the present or last turn
                           accelerometer: z = K (e_a x f) (pi/180) B_a s
    table_encoder_error, an eccentric encoder
                           accelerometer: z = -K (e_a x f) (pi/180) (A_a cos A + B_a sin A)
                           gyroscope:     z = K e_a dA/dt (pi/180) (B_a cos A - A_a sin A)
    table_rate_ripple; the accelerometer shows the integral of the ripple, the log shows the commanded angle
                           accelerometer: z = -K (e_a x f) [A_a sin A + B_a (1 - cos A)]
                           gyroscope:     z = K e_a dA/dt (A_a cos A + B_a sin A)
"""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from pipeline.model.effects.base import Layout, length, turning_direction
from pipeline.model.effects.formula_effect import DeclaredEffect
from pipeline.model.kinematics import ABOUT, UP_AT_ZERO, skew, turn_about_axis

if TYPE_CHECKING:
    from pipeline.records import Motion, Values


UPRIGHT = 0.5  # sine of the elevation of the turn axis, which is 0 (level axis) or 1 (vertical axis)
SIGNS = np.array([[1.0], [-1.0]])  # of d_x and d_y in the equation above


class TableTilt(DeclaredEffect):
    """Tilt of the table: two coefficients."""

    layout = Layout.SHARED
    needs = ("level",)
    unseen = MappingProxyType({"gyroscope": "the direction of gravity does not change a rate"})

    def regressors(self, sensor: str, motion: Motion, K: Values, values: Values) -> Values:
        """Return K times level y and minus level x in the body frame, times gravity; zeros for the gyroscope."""
        del values
        assert motion.level is not None  # noqa: S101
        if sensor == "gyroscope":
            return np.zeros((len(motion.time), 3, 2))
        gravity = np.linalg.norm(motion.specific_force, axis=1)[:, None, None]
        across = (motion.level[:, [1, 0], :] * SIGNS).transpose(0, 2, 1)
        return np.asarray(np.radians(1.0) * gravity * (K @ across))


class _OfTurns(DeclaredEffect):
    """An error in turns of the table, with the same number of parameters for each axis."""

    layout = Layout.SHARED
    needs: tuple[str, ...] = ("angle",)
    each = 2

    def regressors(self, sensor: str, motion: Motion, K: Values, values: Values) -> Values:
        """Return the columns of the turn axis, zeros for the others."""
        del values
        out = np.zeros((len(motion.time), 3, 3 * self.each))
        if motion.axis is not None and motion.angle is not None and motion.rate is not None:
            mine = out[:, :, self.each * motion.axis : self.each * (motion.axis + 1)]
            mine[:] = np.stack(self.in_turn(sensor, motion, motion.axis, K), axis=2)
        return out

    def in_turn(self, sensor: str, motion: Motion, axis: int, K: Values) -> tuple[Values, ...]:
        """Return the column of each parameter in a turn about an axis: (n, 3) arrays."""
        raise NotImplementedError


class TableAxisNonorthogonality(_OfTurns):
    """Non-orthogonality of the table's axes: six coefficients."""

    needs = ("level",)

    def in_turn(self, sensor: str, motion: Motion, axis: int, K: Values) -> tuple[Values, ...]:
        """Return the columns of the lean along the next axis and along the one after it."""
        assert motion.level is not None  # noqa: S101
        assert motion.rate is not None  # noqa: S101
        assert motion.angle is not None  # noqa: S101
        upright = abs(motion.level[0, 2, axis]) > UPRIGHT
        up = motion.level[0, 2] if upright else UP_AT_ZERO[axis]
        f, columns = motion.specific_force, []
        for step in (1, 2):
            lean = np.zeros(3)
            lean[(axis + step) % 3] = np.radians(1.0)
            if sensor == "gyroscope":
                columns.append(motion.rate[:, None] * (K @ lean))
                continue
            across = skew(ABOUT[axis] @ lean)  # across @ u = theta x u
            home = turn_about_axis(across @ up, axis, -motion.angle)
            columns.append((f @ across.T - length(f)[:, None] * home) @ K.T)
        return tuple(columns)


class TableBacklash(_OfTurns):
    """Backlash of the table: one coefficient for each turn axis."""

    each = 1
    needs_both_directions = True
    unseen = MappingProxyType({"gyroscope": "an angle that is behind by a constant does not change the rate"})

    def in_turn(self, sensor: str, motion: Motion, axis: int, K: Values) -> tuple[Values, ...]:
        """Return the derivative with respect to the angle times the direction; zeros for the gyroscope."""
        if sensor == "gyroscope":
            return (np.zeros((len(motion.time), 3)),)
        slope = motion.specific_force @ (np.radians(1.0) * K @ ABOUT[axis]).T
        return (slope * turning_direction(motion)[:, axis, None],)


class TableEncoderError(_OfTurns):
    """Angle error with a period of one turn: two coefficients for each turn axis."""

    def in_turn(self, sensor: str, motion: Motion, axis: int, K: Values) -> tuple[Values, ...]:
        """Return the columns of A and B."""
        cosine, sine, rate = _cosine_sine_rate(motion)
        if sensor == "gyroscope":
            slope = np.radians(rate) * K[:, axis]
            return -slope * sine, slope * cosine
        slope = motion.specific_force @ (-np.radians(1.0) * K @ ABOUT[axis]).T
        return slope * cosine, slope * sine


class TableRateRipple(_OfTurns):
    """Rate error with a period of one turn: two coefficients for each turn axis."""

    needs_motion = True

    def in_turn(self, sensor: str, motion: Motion, axis: int, K: Values) -> tuple[Values, ...]:
        """Return the columns of A and B."""
        cosine, sine, rate = _cosine_sine_rate(motion)
        if sensor == "gyroscope":
            slope = rate * K[:, axis]
            return slope * cosine, slope * sine
        slope = motion.specific_force @ (-K @ ABOUT[axis]).T
        return slope * sine, slope * (1.0 - cosine)


def _cosine_sine_rate(motion: Motion) -> tuple[Values, Values, Values]:
    """Return cosine and sine of the table angle, and its rate, deg/s: (n, 1) arrays."""
    assert motion.angle is not None  # noqa: S101
    assert motion.rate is not None  # noqa: S101
    angle = np.radians(motion.angle)[:, None]
    return np.cos(angle), np.sin(angle), motion.rate[:, None]
