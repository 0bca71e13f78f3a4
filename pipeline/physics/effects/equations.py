"""Effects that no formula describes: of the table, warm-up, errors of the time stamps, a lag, and free curves.

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

    warm_up:       z = A exp(-t / tau),  t the time since power-on, s; 0 at tau = 0
    time_offset:   reading(t) = model(t + tau)
    clock_rate:    reading(t) = model(t + 1e-6 e t)
    low_pass_lag:  reading(t) = model(u'),  u'(t) = integral_0^inf exp(-s / tau) / tau u(t - s) ds

In the last three z = K (u' - u), with u the truth, g or deg/s, and u' the truth at the changed time or behind the lag.
tau is in s: an offset is negative where the reading is late, a time constant is 0 or more. e is in ppm. The lag of a
turn's rate is exact; the lag of other signals is a Gauss-Laguerre sum, exact for polynomials of degree 7 in time.

Free curves represent physics outside the catalogue in the posterior (``pipeline.estimation.posterior``):

    other_temperature : sum over n = 1 to 5 of c_n P_n(x), x the temperature over its span
    other_rate        : the same of |omega|, and d_x omega_x^2 + d_y omega_y^2, which differ with the axis of the turn
    other_input       : sum over n = 2 to 5 of c_n P_n(x), x the axis' own input over its largest value
    other_angle       : sum over n = 1 to 8 of a_n cos(n A) + b_n sin(n A), A the table's angle

with Legendre polynomials P_n and coefficients for each axis. A curve has no limit by the sensor file: the unit of its
coefficients is the size of the noise, times the scales of ``pipeline.estimation.evidence``. The many coefficients lower
the evidence, so that a curve is more probable than an effect only if the residual of that effect is larger than noise.

The signal of an effect that depends on time is similar to that of a bend in the dependence on temperature. If an effect
of time or temperature is selected, ``other_temperature`` therefore has a second form with one coefficient for each
axis, ``c exp(-x / w)`` or ``c (1 - tanh(x / w))``, x the share of the span from one of its ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.polynomial.legendre import legvander

from pipeline.core.records import Motion, Values
from pipeline.physics.effects.base import (
    Effect,
    EffectParameter,
    Layout,
    Owner,
    axis_parameters,
    every_axis,
    length,
    truth,
    truth_rate,
    turning_direction,
    unit_of,
)
from pipeline.physics.effects.formula_effect import DeclaredEffect
from pipeline.physics.formula import c_number
from pipeline.physics.kinematics import ABOUT, UP_AT_ZERO, skew, turn_about_axis
from pipeline.physics.signal.encoder_rate import NODES, WEIGHTS

VERTICAL_SINE = 0.5  # sine of the elevation of the turn axis, which is 0 (level axis) or 1 (vertical axis)
SIGNS = np.array([[1.0], [-1.0]])  # of d_x and d_y in the equation above
STARTS_S = (60.0, 180.0, 500.0, 1500.0)  # from a part of some grams to a box of some kilograms, in factors of three
MIN_WARM_UP_S, MAX_WARM_UP_S = 1.0, 1e5  # a shorter warm-up is a step at the start, a longer one a drift
START_LAG_S = 0.005  # not 0, where a lag and a time offset have the same column; below the lag of a 30 Hz filter
PPM = 1e-6  # one part in a million
# of a difference: its rounding is 1e-9 of u per second, and its error 1e-5 of the slope where u bends, behind 5 ms
DIFFERENCE_STEP_S = 1e-7
OTHER_PREFIX = "other_"  # prefix of the names of free curves
BEND = ":bend"  # suffix of the name of the second form; answers state it under the name of the first
BEND_WIDTHS = np.geomspace(0.1, 0.5, 12)  # of a bend, shares of the span: sharper ones are steps, wider ones parabolas
# Prior probability of a bend over that of an effect. With it, a bend was an answer in all 54 simulated units (seed 61)
# that hid one and selected a slow effect, and below 0.5 in all 34 (seed 62) that hid the slow effect.
MAX_BEND_SHARE_OF_ROOM = 0.5
CURVE_DEGREE = 5  # up to four turning points over the span; faster changes are steps
MAX_CURVE_CYCLES = 8  # periods a turn


class TableTilt(DeclaredEffect):
    """Tilt of the table: two coefficients."""

    layout = Layout.SHARED
    of_samples = True
    needs = ("level",)
    unseen = MappingProxyType({"gyroscope": "the direction of gravity does not change a rate"})

    def regressors(self, sensor: str, motion: Motion, K: Values, values: Values) -> Values:
        """Return K times level y and minus level x in the body frame, times gravity; zeros for the gyroscope."""
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
        out = np.zeros((len(motion.time), 3, 3 * self.each))
        for parameter, column in self._columns(sensor, motion, K):
            out[:, :, parameter] = column
        return out

    def reading(self, sensor: str, motion: Motion, K: Values, values: Values) -> Values:
        added = np.zeros((len(motion.time), 3))
        for parameter, column in self._columns(sensor, motion, K):
            added += column * values[parameter]
        return added

    def _columns(self, sensor: str, motion: Motion, K: Values) -> list[tuple[int, Values]]:
        """Return index and column of the parameters of the turn axis; none outside a turn."""
        if motion.axis is None or motion.angle is None or motion.rate is None:
            return []
        return [*enumerate(self.in_turn(sensor, motion, motion.axis, K), self.each * motion.axis)]

    def in_turn(self, sensor: str, motion: Motion, axis: int, K: Values) -> tuple[Values, ...]:
        """Return the column of each parameter in a turn about an axis: (n, 3) arrays."""
        raise NotImplementedError


class TableAxisNonorthogonality(_OfTurns):
    """Non-orthogonality of the table's axes: six coefficients."""

    needs = ("level",)

    def in_turn(self, sensor: str, motion: Motion, axis: int, K: Values) -> tuple[Values, ...]:
        """Return the columns of the lean along the next axis and along the one after it."""
        assert motion.rate is not None  # noqa: S101
        leans = [np.radians(np.eye(3)[(axis + step) % 3]) for step in (1, 2)]
        if sensor == "gyroscope":
            return tuple(motion.rate[:, None] * (K @ lean) for lean in leans)
        assert motion.level is not None  # noqa: S101
        assert motion.angle is not None  # noqa: S101
        upright = abs(motion.level[0, 2, axis]) > VERTICAL_SINE
        up = motion.level[0, 2] if upright else UP_AT_ZERO[axis]
        f, columns = motion.specific_force, []
        for lean in leans:
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


class WarmUp(DeclaredEffect):
    """Exponential settling of the bias: one amplitude an axis and one time constant."""

    layout = Layout.EVERY_AXIS
    of_samples = True
    needs_clock = True
    nonlinear = ("time_constant",)

    def starts(self, sensor: str) -> list[Values]:
        """Return a small grid of time constants."""
        return [np.array([0.0, 0.0, 0.0, tau]) for tau in STARTS_S]

    def stepped(self, values: Values, step: Values) -> Values:
        """Return ``values + step`` with the time constant at most halved or doubled."""
        new = values + step
        new[3] = np.clip(new[3], max(values[3] / 2.0, MIN_WARM_UP_S), min(values[3] * 2.0, MAX_WARM_UP_S))
        return new

    def regressors(self, sensor: str, motion: Motion, K: Values, values: Values) -> Values:
        """Return ``exp(-t / tau)``."""
        tau = values[3]
        decay = np.exp(-motion.time / tau) if tau > 0 else np.zeros_like(motion.time)
        return np.asarray(decay[:, None])

    def columns(self, sensor: str, motion: Motion, K: Values, values: Values) -> Values:
        """Return the columns of A, and the column of tau, ``A t / tau^2 exp(-t / tau)``."""
        decay = self.regressors(sensor, motion, K, values)
        tau = values[3]
        slope = decay[:, 0] * motion.time / tau**2 if tau > 0 else np.zeros_like(motion.time)
        return np.concatenate([every_axis(decay), (slope[:, None] * values[:3])[:, :, None]], axis=2)

    def reading(self, sensor: str, motion: Motion, K: Values, values: Values) -> Values:
        """Return ``A exp(-t / tau)``."""
        return self.regressors(sensor, motion, K, values) * values[:3]

    def in_c(self, values: Values) -> list[str]:
        """Return ``A exp(-t / tau)`` of each axis as C expressions."""
        decay = f"(imu_real)exp(-m->time / {c_number(values[3])})" if values[3] > 0 else "0"
        return [f"{c_number(a)} * {decay}" for a in values[:3]]


def shifted(motion: Motion, offset: float | Values) -> Motion:
    """Return the motion at ``time + offset``, s, a float or (n,) array; without a trajectory by a straight line."""
    if not np.any(offset):
        return motion
    if motion.at_offset is not None:
        return _seen_from(motion, motion.at_offset(offset=offset))
    by = np.broadcast_to(offset, motion.time.shape)[:, None]
    return replace(
        motion,
        specific_force=motion.specific_force + motion.specific_force_rate * by,
        angular_rate=motion.angular_rate + motion.angular_acceleration * by,
    )


def _seen_from(motion: Motion, moved: Motion) -> Motion:
    """Return a moved motion with the rests and directions of the logged motion."""
    return moved.changed(still=motion.still, direction=motion.direction)


class _Timing(DeclaredEffect):
    """An effect that moves the motion in time: it adds K times the change of the truth."""

    layout = Layout.SHARED
    needs_motion = True

    def regressors(self, sensor: str, motion: Motion, K: Values, values: Values) -> Values:
        """Return K times the derivative of the truth with respect to the only parameter."""
        slope = self.slope(sensor, self.moved(motion, values), values)
        assert slope is not None  # noqa: S101
        return np.asarray(slope @ K.T)[:, :, None]

    def reading(self, sensor: str, motion: Motion, K: Values, values: Values) -> Values:
        """Return ``K (u' - u)``."""
        change = truth(sensor, self.moved(motion, values)) - truth(sensor, motion)
        return np.asarray(change @ K.T)


class TimeOffset(_Timing):
    """A constant time offset: one coefficient."""

    nonlinear = ("tau",)

    def slope(self, sensor: str, moved: Motion, values: Values) -> Values:
        """Return ``du/dt``."""
        return truth_rate(sensor, moved)

    def moved(self, motion: Motion, values: Values) -> Motion:
        """Return the motion at ``t + tau``."""
        return shifted(motion, values[0])


class ClockRate(_Timing):
    """A rate error of the clock: one coefficient."""

    needs_clock = True
    nonlinear = ("e",)

    def slope(self, sensor: str, moved: Motion, values: Values) -> Values:
        """Return ``1e-6 t du/dt``."""
        return PPM * moved.time[:, None] * truth_rate(sensor, moved)

    def moved(self, motion: Motion, values: Values) -> Motion:
        """Return the motion at ``t + 1e-6 e t``."""
        return shifted(motion, PPM * values[0] * motion.time)


class LowPassLag(_Timing):
    """A first-order lag: one coefficient."""

    nonlinear = ("tau",)

    def starts(self, sensor: str) -> list[Values]:
        """Return a short lag: at 0 its column equals that of a time offset."""
        return [np.array([START_LAG_S])]

    def stepped(self, values: Values, step: Values) -> Values:
        """Return ``values + step``, not below zero."""
        return np.maximum(values + step, 0.0)

    def slope(self, sensor: str, moved: Motion, values: Values) -> Values:
        """Return ``du'/dtau``: ``-du/dt`` at a lag of 0, else a difference."""
        if values[0] <= DIFFERENCE_STEP_S:
            return -truth_rate(sensor, moved)
        later = self.moved(moved, values + DIFFERENCE_STEP_S)
        return (truth(sensor, later) - truth(sensor, moved)) / DIFFERENCE_STEP_S

    def moved(self, motion: Motion, values: Values) -> Motion:
        """Return the motion behind a first-order lag, which replaces another one."""
        if values[0] <= 0.0:
            return motion
        if motion.at_lag is not None:
            return _seen_from(motion, motion.at_lag(lag=float(values[0])))
        nodes = [shifted(motion, -values[0] * node) for node in NODES]
        names = ("specific_force", "angular_rate", "angular_acceleration", "specific_force_rate")

        def mean(name: str) -> Values:
            return np.asarray(sum(w * getattr(n, name) for w, n in zip(WEIGHTS, nodes, strict=True)))

        means: dict[str, Any] = {name: partial(mean, name) for name in names}

        def at(offset: float | Values = 0.0, lag: float = float(values[0])) -> Motion:
            return self.moved(shifted(motion, offset), np.array([lag]))

        return motion.changed(**means, at_offset=at, at_lag=at)


class FreeCurve(Effect):
    """A curve of one covariate with free coefficients."""

    owner = Owner.RECORDING
    meaning, excitation, experiment, source = "Physics outside the catalogue.", "", "", ""

    def __init__(self, covariate: str, low: float, high: float) -> None:
        self.covariate, self.name = covariate, f"{OTHER_PREFIX}{covariate}"
        self.contains = (self.name + BEND,)
        self.middle, self.half = 0.5 * (low + high), 0.5 * (high - low)
        self.layout = Layout.PER_AXIS if covariate == "input" else Layout.EVERY_AXIS
        counts = {"input": CURVE_DEGREE - 1, "angle": 2 * MAX_CURVE_CYCLES, "rate": CURVE_DEGREE + 2}
        self.count = counts.get(covariate, CURVE_DEGREE)

    def parameters(self, sensor: str) -> tuple[EffectParameter, ...]:
        """Return a coefficient for each curve and axis."""
        names = [f"c{k}_{axis}" for axis in "xyz" for k in range(self.count)]
        return tuple(EffectParameter(name, unit_of(sensor), "coefficient") for name in names)

    def regressors(self, sensor: str, motion: Motion, K: Values, values: Values) -> Values:
        """Return the curves; zeros for a recording without the covariate."""
        if self.covariate == "input":
            return np.asarray(legvander(truth(sensor, motion) / self.half, CURVE_DEGREE)[..., 2:])
        known = {"temperature": motion.temperature, "angle": motion.angle, "rate": length(motion.angular_rate)}
        covariate = known[self.covariate]
        if covariate is None:
            return np.zeros((len(motion.time), self.count))
        if self.covariate == "angle":
            turns = np.radians(covariate)[:, None] * np.arange(1, MAX_CURVE_CYCLES + 1)
            return np.concatenate([np.cos(turns), np.sin(turns)], axis=1)
        found = legvander((covariate - self.middle) / self.half, CURVE_DEGREE)[:, 1:]
        if self.covariate == "rate":
            found = np.concatenate([found, (motion.angular_rate[:, :2] / self.half) ** 2], axis=1)
        return np.asarray(found)


class Bend(Effect):
    """A bend in the dependence on temperature, from one end of the span, with a coefficient for each axis."""

    name, needs = f"{OTHER_PREFIX}temperature{BEND}", ("temperature",)
    owner, layout = Owner.RECORDING, Layout.EVERY_AXIS
    meaning, excitation, experiment, source = "Physics outside the catalogue.", "", "", ""

    def __init__(self, forms: Sequence[tuple[float, float, bool]], form: int = 0) -> None:
        self.forms = forms  # end of the span, degC, signed width, degC, and whether the form is that of tanh
        self.end, self.width, self.soft = forms[form]

    def parameters(self, sensor: str) -> tuple[EffectParameter, ...]:
        """Return a coefficient for each axis."""
        return axis_parameters("c", unit_of(sensor), "coefficient")

    def regressors(self, sensor: str, motion: Motion, K: Values, values: Values) -> Values:
        """Return the bend."""
        assert motion.temperature is not None  # noqa: S101  (by ``needs``)
        x = (motion.temperature - self.end) / self.width
        return np.asarray((1.0 - np.tanh(x) if self.soft else np.exp(-x))[:, None])


def free_curves(sensor: str, motions: Sequence[Motion], *, bent: bool) -> list[Effect]:
    """Return the free curves of the covariates that vary in motions; ``bent``: also bends of the temperature."""
    spans: dict[str, list[Values | None]] = {
        "temperature": [m.temperature for m in motions],
        "rate": [length(m.angular_rate) for m in motions],
        "angle": [m.angle for m in motions],
    }
    curves: list[Effect] = []
    for covariate, values in spans.items():
        known = [v for v in values if v is not None and len(v)]
        low, high = (min(v.min() for v in known), max(v.max() for v in known)) if known else (0.0, 0.0)
        if high > low and (covariate != "temperature" or len(known) == len(values)):
            curves.append(FreeCurve(covariate, float(low), float(high)))
            if bent and covariate == "temperature":
                ends = (float(low), 1.0), (float(high), -1.0)
                forms = product(ends, (False, True), BEND_WIDTHS * (high - low))
                curves.append(Bend([(end, sign * width, soft) for (end, sign), soft, width in forms]))
    largest = max(float(np.abs(truth(sensor, m)).max()) for m in motions)
    return [*curves, *([FreeCurve("input", -largest, largest)] if largest > 0.0 else [])]
