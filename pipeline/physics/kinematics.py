"""Compute the motion of the body from the log of a table.

A turn about body axis ``a`` by the angle ``A(t)``:

    f = g * R_a(-A) up_a,   omega = dA/dt e_a,   df/dt = -omega x f

where ``R_a`` is the right-handed rotation about axis a, ``up_a`` the body axis that points up at angle 0 (z for turns
about x and y, x for turns about z), ``g`` the local gravity in g, and omega in rad/s.

An attitude ``q(t)`` (w, x, y, z; body to level with z up):

    f = g * R(q)^T e_z,   omega = 2 vec(conj(q) dq/dt),   alpha = 2 vec(conj(q) d2q/dt2)

with the derivatives of a quintic spline through the quaternion's components. At 0.12 s and 200 deg/s its truncation
error is below 1e-3 deg/s; a central difference would be wrong by 1 %.

Earth's rotation (15.041 deg/h) is added to omega where latitude and azimuth are given.

Interpolate the angle, rate and acceleration of a turn between the samples of the table's log.

A table's program consists of stretches of constant angular acceleration. They end at times between the samples of the
logged angle A and rate r. Between two samples, dt apart,

    no bend inside:   dA = (r_0 + r_1) dt / 2
    a bend at s:      dr = a s + b (dt - s),   dA = r_0 dt + a s (dt - s / 2) + b (dt - s)^2 / 2

where a and b are the accelerations before and after it. An interval without a bend has ``a = dr / dt``; one with a bend
takes a, b or both from its neighbours, which gives s. Where both are known, the second equation is a check; else the
next interval must begin with the acceleration with which this one ends. So ramps of a few samples are followed exactly.
Elsewhere, in smooth motion, angle, rate and acceleration come from the quintic that has the logged angle and rate at
both ends, and the acceleration from the five nearest rates.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from pipeline.core.errors import InputError
from pipeline.core.records import (
    AXES,
    Index,
    Mask,
    Motion,
    Recording,
    Values,
    conjugate_product,
    continuous,
    cross,
    level_in_body,
    median,
    once_of_log,
    quintic_spline,
)
from pipeline.core.settings import Table
from pipeline.physics.signal.encoder_rate import rate_by_angle, step_of
from pipeline.physics.signal.filters import temperature_of, temperature_rate_of
from pipeline.physics.signal.rests import still_samples

TIGHTEST_DEG, LOOSEST_DEG = 1e-5, 1e-3  # a good encoder's resolution; 17 ug of specific force
GENTLE_DEG, EXACT_DEG = 1e-4, 1e-6  # smooth motion, where no bend is looked for; and an interval without any
MOVING_DPS = 0.02  # exceeds the rate noise of a resting table
SAME_SHARE, SAME_DPS2 = 0.01, 0.1  # how nearly two neighbouring intervals must agree on an acceleration
LAG_ROUNDING_DPS = 1e-11  # some hundred roundings of a rate of 400 deg/s
LAG_GROUP = 16  # samples, through which a lag is followed one by one, in all groups at once
PRINTED_ROUNDING = 1e-9  # relative: some roundings of a printed number
MAX_DIFFERENT_MOVES = 10  # of a step: as many different changes are not those of equal moves
CLEARLY_ABOVE = 4.0  # times the step of an exact log: its angles may all be even multiples
MEMORY_S = 0.3  # fifteen time constants of the slowest filter of 20 ms
CORNER_DPS2 = 3.0  # over a filter of 20 ms: 0.06 deg/s
EARTH_RATE_DPS = 360.0 / 86164.0905  # a sidereal day, s
UP_AT_ZERO = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])  # see above
# Rows: level x, y, z axes in the body frame at table angle 0, for turns about x, y, z.
LEVEL_AT_ZERO = np.array([np.eye(3), np.eye(3), [[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]])
ABOUT = np.cross(np.eye(3)[:, None], np.eye(3)).transpose(0, 2, 1)  # ABOUT[a] @ u = e_a x u
NODES, WEIGHTS = np.polynomial.laguerre.laggauss(4)  # of integrals of exp(-x) u(x), for the lag of smooth signals


class Pieces(NamedTuple):
    """Pieces of rows of consecutive samples, over which a trajectory is averaged."""

    first: Index  # (k,); first sample of each piece
    last: Index  # (k,); last sample
    share: Values  # (k,); of the row's samples
    of_row: Index  # (m,); first piece of each row


class EncoderTrajectory:
    """Angle, rate and acceleration at any time, interpolated from a log.

    Parameters
    ----------
    time, angle, rate : (n,) array, s, deg, deg/s
        At least 6 samples.
    rate_logged : bool
        Whether the table logs the rate; False: it was computed from the angle.

    Attributes
    ----------
    explained : (n - 1,) array of bool
        Intervals that one or two stretches of constant acceleration reproduce.
    valid : (n - 1,) array of bool
        Explained intervals, and intervals of smooth motion: ``dA = (r_0 + r_1) dt / 2 - (r'_1 - r'_0) dt^2 / 12`` to
        1e-3 deg, to the noise of the log, or to its rounding. In other intervals the trajectory is not reliable.
    valid_samples : (n,) array of bool
        Samples followed by a valid interval, with only valid intervals in the 0.3 s before them, in which a filter
        inside the sensor settles. Samples at which a stretch ends are not valid.
    acceleration : (n,) array, deg/s^2
        At the samples.
    """

    def __init__(self, time: Values, angle: Values, rate: Values, *, rate_logged: bool = True) -> None:
        self.time, self.angle, self.rate = time, angle, rate
        self._step = np.diff(time)
        self._mean = np.diff(rate) / self._step
        excess = np.diff(angle) - 0.5 * (rate[1:] + rate[:-1]) * self._step
        self._tolerance = float(np.clip(10.0 * median(np.abs(excess)), TIGHTEST_DEG, LOOSEST_DEG))
        rounding = self._rounding() if rate_logged else np.zeros((2, len(self._step)))
        even = np.abs(excess) <= np.maximum(self._tolerance, rounding[0])
        self._bend, self._before, self._after, bent = self._bends(even)
        slope = nearest_slope(time, rate)
        miss = np.abs(excess + np.diff(slope) * self._step**2 / 12.0)
        gentle = np.convolve(miss > GENTLE_DEG, np.ones(3), "same") < 0.5
        gentle &= (np.abs(excess) > EXACT_DEG) & (rounding[0] < GENTLE_DEG)
        self.explained: Mask = np.logical_and(even | bent, np.logical_not(gentle))
        # At the samples from an adjacent explained interval, else from the nearest rates.
        known = np.append(self.explained, 0.0) + np.append(0.0, self.explained)
        total = np.append(self._before * self.explained, 0.0) + np.append(0.0, self._after * self.explained)
        self.acceleration: Values = np.where(known > 0.0, total / np.maximum(known, 1.0), slope)
        self.valid: Mask = self.explained | self._smooth(miss)
        self.valid_samples = self._filter_settled(rounding[1])

    def _filter_settled(self, rounding: Values) -> Mask:
        """Return ``valid_samples``; ``rounding``: of the acceleration."""
        lost = np.concatenate([[0], np.cumsum(~self.valid)])  # invalid intervals before each sample
        first = np.searchsorted(self.time, self.time - MEMORY_S, side="right") - 1
        past = lost - lost[np.maximum(first, 0)] == 0
        known: Mask = np.logical_and(past, np.append(self.valid, True))
        jump = np.abs(self._before[1:] - self._after[:-1])  # of the acceleration, where a stretch ends
        known[1:-1] &= ~(self.explained[1:] & self.explained[:-1] & (jump > CORNER_DPS2 + 2.0 * rounding[1:]))
        return known

    def _bends(self, even: Mask) -> tuple[Values, Values, Values, Mask]:
        """Return for each interval the time of its bend, the acceleration before and after it, and whether it bends."""
        step, mean = self._step, self._mean
        left, right = np.concatenate([[False], even[:-1]]), np.concatenate([even[1:], [False]])
        a, b = np.concatenate([mean[:1], mean[:-1]]), np.concatenate([mean[1:], mean[-1:]])
        r0, r1 = self.rate[:-1], self.rate[1:]
        dr, dA = np.diff(self.rate), np.diff(self.angle)
        with np.errstate(divide="ignore", invalid="ignore"):
            both = (dr - b * step) / (a - b)
            rest = 2.0 * (dA - r0 * step - 0.5 * a * step**2) / (dr - a * step)
            lead = 2.0 * (r1 * step - 0.5 * b * step**2 - dA) / (dr - b * step)
            s = np.where(left & right, both, np.where(left, step - rest, lead))
            b = np.where(left & ~right, (dr - a * s) / (step - s), b)
            a = np.where(right & ~left, (dr - b * (step - s)) / s, a)
            miss = np.abs(dA - r0 * step - a * s * (step - 0.5 * s) - 0.5 * b * (step - s) ** 2)
            bent = ~even & (left | right) & (s >= 0) & (s <= step) & (miss <= 3.0 * self._tolerance)
            # With one neighbour known, the second equation gives s and is no check: the next interval must continue
            # with the acceleration with which this one ends.
            same = np.abs(b[:-1] - a[1:]) <= SAME_SHARE * np.abs(b[:-1]) + SAME_DPS2
            checked = (left & right) | np.append(same & bent[1:], False) | np.append(False, same & bent[:-1])
            bent &= checked
        whole = ~bent
        return np.where(whole, step, s), np.where(whole, mean, a), np.where(whole, mean, b), bent

    def _smooth(self, miss: Values) -> Mask:
        moving = np.abs(self._mean) + np.abs(self.rate[1:]) + np.abs(self.rate[:-1]) > MOVING_DPS
        inside = np.convolve(moving, np.ones(7), "same") > 6.5
        noise = 4.0 * float(median(miss[inside])) if inside.sum() > 20 else 0.0
        return np.asarray(miss <= max(LOOSEST_DEG, noise))

    def _rounding(self) -> Values:
        """Return the largest errors of each interval by the printed digits, or the counts, of angle and rate.

        With the steps A and r, dA is wrong by up to A, its value by the rates by r dt / 2, and the acceleration by
        r / dt. At a constant rate the errors may all be equal, so that the median excess does not show them. An exact
        log has steps too if all stretches last multiples of a time g: r = a g and A = a g^2 / 2 = r^2 / (2 a).

        (2, n - 1) array: of the excess, deg, and of the acceleration, deg/s^2; zeros for a log that is not rounded.
        """
        changes, rates = np.abs(np.diff(self.angle)), np.abs(self.rate)
        angle = step_of(changes, PRINTED_ROUNDING * max(float(np.abs(self.angle).max()), 1.0))
        rate = step_of(rates, PRINTED_ROUNDING * max(float(rates.max()), 1.0))
        distinct = len(np.unique(np.rint(changes / angle))) if angle else 0
        exact = 0.5 * rate**2 / max(float(np.abs(self._mean).max()), MOVING_DPS)
        if distinct <= MAX_DIFFERENT_MOVES or angle <= CLEARLY_ABOVE * exact:
            return np.zeros((2, len(self._step)))
        return np.array([angle + np.minimum(0.5 * rate * self._step, angle), rate / self._step])

    def at(self, time: Values) -> tuple[Values, Values, Values]:
        """Return angle (deg), rate (deg/s) and acceleration (deg/s^2) at any times; (n,) arrays."""
        k = self._interval(time)
        x = time - self.time[k]
        angle, rate, acceleration = self._piecewise(k, x)
        smooth = ~self.explained[k]
        if smooth.any():
            angle[smooth], rate[smooth], acceleration[smooth] = self._quintic(k[smooth], x[smooth])
        return angle, rate, acceleration

    def angle_at(self, time: Values) -> Values:
        """Return the angle (deg) at any times: (n,) array."""
        k = self._interval(time)
        x = time - self.time[k]
        angle, smooth = self._angle(k, x, np.maximum(x - self._bend[k], 0.0)), ~self.explained[k]
        if smooth.any():
            angle[smooth] = self._quintic(k[smooth], x[smooth])[0]
        return angle

    def _interval(self, time: Values) -> Index:
        return np.clip(np.searchsorted(self.time, time, side="right") - 1, 0, len(self._step) - 1)

    def known_at(self, time: Values) -> Mask:
        """Return at which of n times, near the samples, the trajectory is valid: (n,) array.

        A time from ``MEMORY_S`` before its sample to the next sample is valid if the sample is in ``valid_samples``.
        Any other time must lie between two valid samples.
        """
        step, k = np.append(self._step, 0.0), self._interval(time)
        near = (time > self.time - MEMORY_S) & (time <= self.time + step)
        return np.where(near, self.valid_samples, self.valid_samples[k] & self.valid_samples[k + 1])

    def lagged(self, time: Values, lag: float) -> tuple[Values, Values]:
        """Return the rate (deg/s) behind a first-order lag, and its derivative (deg/s^2), at any times.

        In a stretch with the rate ``r + a x``, the output is ``r + a (x - lag) + (L - r + a lag) exp(-x / lag)``, where
        L is the output at x = 0. The time constant ``lag``, s, is above 0.
        """
        shown = self._lagged_samples(lag)
        k = self._interval(time)
        x = np.maximum(time - self.time[k], 0.0)
        through, gain = self._lag_step(k, x, lag)
        value = through + gain * shown[k]
        return value, (self._piecewise(k, x)[1] - value) / lag

    def means(self, pieces: Pieces, offset: float | Values, lag: float) -> tuple[Values, ...]:
        """Return means over rows of samples at ``time + offset``, behind a lag; ``offset``: of all or of each piece.

        Returns (m,) arrays of the angle, its rate and acceleration, and its cosine and sine. The mean of a derivative
        over a piece's time is the difference of its integral; behind a lag, the integral of the rate is ``A - lag r``.
        Others are by Simpson's rule. A piece of one sample has its values. The result equals the mean over the samples,
        dt apart, but for ``dt^2 / 24`` of the second derivative.
        """
        first, last, m = pieces.first, pieces.last, len(pieces.first)
        t0, t1 = self.time[first], self.time[last]
        beyond = 0.5 * (t1 - t0) / np.maximum(last - first, 1)
        t0, t1 = t0 - beyond + offset, t1 + beyond + offset
        points, size, one = np.concatenate([t0, 0.5 * (t0 + t1), t1]), t1 - t0, first == last
        angle, rate, acceleration = self.at(points)
        integral, turns, weights = angle, angle[None], np.ones(1)
        if lag > 0.0:
            rate, acceleration = self.lagged(points, lag)
            integral = angle - lag * rate
            turns, weights = np.array([self.angle_at(points - lag * node) for node in NODES]), WEIGHTS

        def slope(of: Values, values: Values) -> Values:
            return np.where(one, values[m : 2 * m], (of[2 * m :] - of[:m]) / np.where(one, 1.0, size))

        def mean(values: Values) -> Values:
            return np.asarray((values[:m] + 4.0 * values[m : 2 * m] + values[2 * m :]) / 6.0)

        turns = np.radians(turns)
        circle = mean(weights @ np.cos(turns)), mean(weights @ np.sin(turns))
        found = mean(angle), slope(integral, rate), slope(rate, acceleration), *circle
        return tuple(np.add.reduceat(pieces.share * values, pieces.of_row) for values in found)

    def known_in(self, pieces: Pieces, offset: float | Values) -> Mask:
        """Return in which rows of samples the trajectory is valid at all of ``time + offset``; see ``known_at``."""
        first, last = pieces.first, pieces.last
        lost = np.concatenate([[0], np.cumsum(~self.valid_samples)])
        start, stop = self._interval(self.time[first] + offset), self._interval(self.time[last] + offset)
        near = (np.asarray(offset) > -MEMORY_S) & (offset <= np.append(self._step, 0.0)[last])
        known = np.where(near, lost[last + 1] == lost[first], lost[stop + 2] == lost[start])
        return np.asarray(np.logical_and.reduceat(known, pieces.of_row))

    def _lagged_samples(self, lag: float) -> Values:
        """Return the output of a lag at the samples: ``y_i = v_i + g_i y_i-1``, by groups of samples."""
        v, g = np.zeros((2, -(-len(self.time) // LAG_GROUP) * LAG_GROUP))
        v[0] = self.rate[0]
        inside = slice(1, len(self.time))
        v[inside], g[inside] = self._lag_step(np.arange(len(self._step)), self._step, lag)
        v, g = (np.ascontiguousarray(each.reshape(-1, LAG_GROUP).T) for each in (v, g))
        for before, j in pairwise(range(LAG_GROUP)):  # g: from now on the weight of the output before the group
            v[j] += g[j] * v[before]
            g[j] *= g[before]
        ends, weight, back, largest = v[-1].copy(), g[-1].copy(), 1, float(np.abs(self.rate).max())
        while back < len(ends) and float(weight.max()) * largest > LAG_ROUNDING_DPS:  # twice as many groups each time
            ends[back:] += weight[back:] * ends[:-back]
            weight[back:] *= weight[:-back].copy()
            weight[:back] = 0.0
            back *= 2
        v[:, 1:] += g[:, 1:] * ends[:-1]
        return v.T.ravel()[: len(self.time)]

    def _lag_step(self, k: Index, x: Values, lag: float) -> tuple[Values, Values]:
        """Return the output of a lag at x into intervals: a value, and a factor on the output at x = 0."""
        a, b, s = self._before[k], self._after[k], self._bend[k]
        first, second = np.minimum(x, s), np.maximum(x - s, 0.0)
        fade, fade_after = np.exp(-first / lag), np.exp(-second / lag)
        middle = self.rate[k] + a * first
        own = middle - a * lag + (a * lag - self.rate[k]) * fade
        return middle + b * (second - lag) + (own - middle + b * lag) * fade_after, fade * fade_after

    def _piecewise(self, k: Index, x: Values) -> tuple[Values, Values, Values]:
        a, b, s = self._before[k], self._after[k], self._bend[k]
        past = np.maximum(x - s, 0.0)
        rate = self.rate[k] + a * x + (b - a) * past
        return self._angle(k, x, past), rate, np.where(x > s, b, a)

    def _angle(self, k: Index, x: Values, past: Values) -> Values:
        a, b = self._before[k], self._after[k]
        angle: Values = self.angle[k] + self.rate[k] * x + 0.5 * a * x**2 + 0.5 * (b - a) * past**2
        return angle

    def _quintic(self, k: Index, x: Values) -> tuple[Values, Values, Values]:
        h = self._step[k]
        r0, a0 = self.rate[k], self.acceleration[k]
        dA = self.angle[k + 1] - self.angle[k] - r0 * h - 0.5 * a0 * h**2
        dr = (self.rate[k + 1] - r0 - a0 * h) * h
        da = (self.acceleration[k + 1] - a0) * h**2
        c3, c4, c5 = 10 * dA - 4 * dr + 0.5 * da, -15 * dA + 7 * dr - da, 6 * dA - 3 * dr + 0.5 * da
        q = x / h
        angle = self.angle[k] + r0 * x + 0.5 * a0 * x**2 + q**3 * (c3 + q * (c4 + q * c5))
        rate = r0 + a0 * x + q**2 * (3 * c3 + q * (4 * c4 + q * 5 * c5)) / h
        return angle, rate, a0 + q * (6 * c3 + q * (12 * c4 + q * 20 * c5)) / h**2


def nearest_slope(time: Values, values: Values) -> Values:
    """Return the derivative at each of n >= 5 samples of the quartic through it and its four neighbours: (n,) array."""
    n = len(time)
    window = np.clip(np.arange(n) - 2, 0, n - 5) + np.arange(5)[:, None]
    t, v = time[window] - time, values[window]
    slope = np.zeros(n)
    for j in range(5):
        a, b, c, d = (t[m] for m in range(5) if m != j)
        spread = (t[j] - a) * (t[j] - b) * (t[j] - c) * (t[j] - d)
        # derivative at 0 of (x - a) (x - b) (x - c) (x - d): the sum of the products of three factors
        slope -= v[j] * (a * b * (c + d) + c * d * (a + b)) / spread
    return slope


def earth_rate(latitude_deg: float, azimuth_deg: float) -> Values:
    """Return Earth's rotation in the level frame: (3,) array, deg/s.

    ``Omega (cos L cos A, cos L sin A, sin L)`` with latitude L and azimuth A of level x, clockwise from north.
    """
    latitude, azimuth = np.radians([latitude_deg, azimuth_deg])
    horizontal = np.cos(latitude)
    direction = np.array([horizontal * np.cos(azimuth), horizontal * np.sin(azimuth), np.sin(latitude)])
    return EARTH_RATE_DPS * direction


def normal_gravity_g(latitude_deg: float) -> float:
    """Return gravity at sea level by WGS 84, g.

    ``9.7803253359 (1 + 0.00193185265241 s) / sqrt(1 - 0.00669437999014 s) m/s^2`` with ``s = sin^2 latitude``
    (NIMA TR8350.2, eq. 4-1).
    """
    s = float(np.sin(np.radians(latitude_deg))) ** 2
    return float(9.7803253359 * (1.0 + 0.00193185265241 * s) / np.sqrt(1.0 - 0.00669437999014 * s) / 9.80665)


def earth_of(table: Table) -> Values | None:
    """Return Earth's rotation in the level frame; None where the table's latitude or azimuth is not set."""
    latitude, azimuth = table.latitude_deg, table.azimuth_deg
    return None if latitude is None or azimuth is None else earth_rate(latitude, azimuth)


def table_motion(recording: Recording, table: Table) -> Motion | None:
    """Return ``reference_motion`` with gravity, latitude and azimuth of a table's configuration."""
    one_shaft = table.azimuth_of == "turn_axis"
    return reference_motion(recording, table.gravity_g, earth_of(table), one_shaft=one_shaft)


def reference_motion(
    recording: Recording, gravity_g: float = 1.0, earth_rate_level: Values | None = None, *, one_shaft: bool = False
) -> Motion | None:
    """Return the motion of a recording by the log of the table; None where the recording has no such log.

    ``recording``: with ``table_angle`` and an axis, or with ``table_attitude``. ``earth_rate_level``: Earth's rotation
    in the level frame, (3,), deg/s, or None. ``one_shaft``: level x is the axis about which the encoder counts
    right-handed, the same in all turns (``table.azimuth_of``), not the body axis at angle 0. Raises ``InputError`` if
    there are too few samples to differentiate the log.
    """
    earth = None if earth_rate_level is None else tuple(earth_rate_level.tolist())
    return _reference_motion(recording, gravity_g, earth, one_shaft=one_shaft)


@once_of_log
def _reference_motion(
    recording: Recording, gravity_g: float, earth: tuple[float, ...] | None, *, one_shaft: bool
) -> Motion | None:
    if recording.axis is not None and recording.table_angle is not None:
        build: Callable[..., Motion] = partial(_motion_of_turn, shaft=recording.sense if one_shaft else 0)
    elif recording.table_attitude is not None:
        build = _motion_of_attitude
    else:
        return None
    if recording.samples < 6:
        raise InputError(
            f"recording {recording.name} has {recording.samples} samples; at least 6 are needed to follow the table",
            recording.source.get("file"),
        )
    warm = recording.temperature is not None
    own_clock = "table" if "table_clock" in recording.source else "sensor"
    logged = partial(
        Motion.changed,
        temperature=temperature_of(recording) if warm else None,
        temperature_rate=temperature_rate_of(recording) if warm else None,
        timed_by=own_clock if recording.table_rate is None else "",
        recording=recording.name,
        setup=recording.setup,
    )
    return build(recording, gravity_g, None if earth is None else np.array(earth), logged)


def _motion_of_turn(
    recording: Recording, gravity_g: float, earth: Values | None, logged: Callable[[Motion], Motion], *, shaft: int
) -> Motion:
    assert recording.axis is not None  # noqa: S101
    assert recording.table_angle is not None  # noqa: S101
    time, angle, rate = recording.time, recording.table_angle, recording.table_rate
    by_angle = rate_by_angle(recording)
    if by_angle is not None:
        angle, rate = by_angle.angle, by_angle.rate
    assert rate is not None  # noqa: S101
    log = EncoderTrajectory(time, angle, rate, rate_logged=by_angle is None)
    if by_angle is not None:
        log.valid_samples &= ~by_angle.vague
    axis = AXES.index(recording.axis)
    home, still = level_at_zero(axis, recording.up, shaft), still_samples(time, rate)

    def at(
        before: float | Values, lag: float = 0.0, offset: float | Values = 0.0, rows: Pieces | None = None
    ) -> Motion:
        """Return the motion at ``time + before + offset``, filtered by a first-order lag in s.

        ``rows``: over which it is averaged; time, temperature and rests are those of all samples.
        """
        offset = before + offset
        moved = bool(np.any(offset))
        if rows is not None:
            angle, rate, acceleration, cosine, sine = log.means(rows, offset, lag)
            turned, known = partial(turn_by, axis=axis, cosine=cosine, sine=-sine), log.known_in(rows, offset)
        elif lag > 0.0:
            angle = log.angle_at(time + offset) if moved else log.angle
            rate, acceleration = log.lagged(time + offset, lag)
            past = np.radians([-log.angle_at(time + offset - lag * node) for node in NODES])
            turned = partial(turn_by, axis=axis, cosine=WEIGHTS @ np.cos(past), sine=WEIGHTS @ np.sin(past))
        else:
            angle, rate, acceleration = log.at(time + offset) if moved else (log.angle, log.rate, log.acceleration)
            turned = partial(turn_about_axis, axis=axis, angle_deg=-angle)
        if rows is None:
            known = log.known_at(time + offset) if moved else log.valid_samples

        def force() -> Values:
            return gravity_g * turned(home[2])

        deferred: dict[str, Any] = {
            "specific_force": force,
            "angular_rate": lambda: _along(axis, rate) + (0.0 if earth is None else earth_in_body(earth, turned(home))),
            "angular_acceleration": lambda: _along(axis, acceleration),
            "specific_force_rate": lambda: -np.radians(rate)[:, None] * (force() @ ABOUT[axis].T),
            "level": partial(turned, home),
        }
        return logged(
            Motion(
                time=time,
                temperature=None,
                angle=angle,
                rate=rate,
                axis=axis,
                still=still,
                at_offset=partial(at, offset, lag),
                at_lag=partial(at, offset),
                reference_valid=known,
                **deferred,
            )
        )

    return at(0.0)


def _along(axis: int, values: Values) -> Values:
    """Return vectors along a body axis: (n, 3) array."""
    return np.asarray(values[:, None] * np.eye(3)[axis])


def earth_in_body(earth: Values, level: Values) -> Values:
    """Return Earth's rotation, (3,), in the body frame: (n, 3) array; ``level``: see ``Motion``."""
    return np.asarray(np.einsum("i,nij->nj", earth, level))


def level_at_zero(axis: int, up: str = "", shaft: int = 0) -> Values:
    """Return the level axes in the body frame at table angle 0, as rows: (3, 3) array.

    Where the turn axis is vertical, ``up`` is the body axis, with its sign, that always points up; level x is then the
    next body axis in cyclic order. Where one level shaft turns the unit about each axis, level x is the body axis times
    ``shaft``, 1 or -1, about which its encoder counts right-handed: the level frame is then fixed in the room.
    """
    if not up and not shaft:
        return np.asarray(LEVEL_AT_ZERO[axis])
    if not up:
        along, upward = shaft * np.eye(3)[axis], UP_AT_ZERO[axis]
        return np.array([along, np.cross(upward, along), upward])
    upward = np.eye(3)[AXES.index(up[1])] * (1.0 if up[0] == "+" else -1.0)
    level_x = np.eye(3)[(AXES.index(up[1]) + 1) % 3]
    return np.array([level_x, np.cross(upward, level_x), upward])


def _motion_of_attitude(
    recording: Recording, gravity_g: float, earth: Values | None, logged: Callable[[Motion], Motion]
) -> Motion:
    assert recording.table_attitude is not None  # noqa: S101
    time, attitude = recording.time, continuous(recording.table_attitude)
    clock = recording.table_seconds
    spline = quintic_spline(time * clock, attitude)

    def at(before: float | Values, offset: float | Values = 0.0) -> Motion:
        offset = before + offset
        table_time = (time + offset) * clock
        q = spline(table_time) if np.any(offset) else attitude
        omega = np.degrees(2.0 * conjugate_product(q, spline(table_time, 1)))

        deferred: dict[str, Any] = {
            "specific_force": lambda: gravity_g * level_in_body(q),
            "angular_rate": lambda: omega if earth is None else omega + earth_in_body(earth, attitude_matrix(q)),
            "angular_acceleration": lambda: np.degrees(2.0 * conjugate_product(q, spline(table_time, 2))),
            "specific_force_rate": lambda: gravity_g * cross(level_in_body(q), np.radians(omega)),
            "level": partial(attitude_matrix, q),
        }
        return logged(
            Motion(
                time=time,
                temperature=None,
                angle=None,
                rate=None,
                axis=None,
                still=still_samples(time, np.linalg.norm(omega, axis=1)),
                at_offset=partial(at, offset),
                **deferred,
            )
        )

    return at(0.0)


def turn_about_axis(vector: Values, axis: int, angle_deg: Values) -> Values:
    """Turn (..., 3) vectors about coordinate axis 0, 1 or 2 by each of n angles (right-handed): (n, ..., 3) array."""
    angle = np.radians(angle_deg)
    return turn_by(vector, axis, np.cos(angle), np.sin(angle))


def turn_by(vector: Values, axis: int, cosine: Values, sine: Values) -> Values:
    """Return ``turn_about_axis`` by n angles of known cosine and sine, or by the mean of several turns: of both.

    The mean of turns leaves what is along the axis.
    """
    j, k = (axis + 1) % 3, (axis + 2) % 3
    c, s = (v.reshape(-1, *[1] * (vector.ndim - 1)) for v in (cosine, sine))
    out = np.empty((len(c), *vector.shape))
    out[..., axis] = vector[..., axis]
    out[..., j] = c * vector[..., j] - s * vector[..., k]
    out[..., k] = s * vector[..., j] + c * vector[..., k]
    return out


def turn_by_vector(phi: Values) -> Values:
    """Return the rotations by vectors, ``exp [phi]x`` (Rodrigues): (..., 3) array, rad, to (..., 3, 3)."""
    angle = np.linalg.norm(phi, axis=-1)
    small = angle < 1e-6
    safe = np.where(small, 1.0, angle)
    s = np.where(small, 1.0, np.sin(safe) / safe)
    c = np.where(small, 0.5, (1.0 - np.cos(safe)) / safe**2)
    cross = skew(phi)
    return np.asarray(np.eye(3) + s[..., None, None] * cross + c[..., None, None] * (cross @ cross))


def skew(v: Values) -> Values:
    """Return ``[v]x``, with ``[v]x u = v x u``: (..., 3) array to (..., 3, 3)."""
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def attitude_matrix(q: Values) -> Values:
    """Return the rotation matrices of unit quaternions: (n, 4) to (n, 3, 3), body vectors to level vectors."""
    w, x, y, z = q.T
    rows = (
        *(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        *(2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        *(2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    return np.stack(rows, axis=1).reshape(-1, 3, 3)
