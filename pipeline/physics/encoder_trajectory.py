"""Interpolate the angle, rate and acceleration of a turn between the samples of the table's log.

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
from functools import cache, cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from pipeline.core.records import Index, Mask, Values, median
from pipeline.physics.signal.encoder_rate import step_of

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
NODES, WEIGHTS = np.polynomial.laguerre.laggauss(4)  # of integrals of exp(-x) u(x), for the lag of smooth signals


class Pieces(NamedTuple):
    """Pieces of rows of consecutive samples, over which a trajectory is averaged."""

    first: Index  # (k,); first sample of each piece
    last: Index  # (k,); last sample
    share: Values  # (k,); of the row's samples
    of_row: Index  # (m,); first piece of each row


class EncoderTrajectory:
    """Angle, rate and acceleration at any time, interpolated from a log.

    ``time, angle, rate``: (n,) arrays, s, deg, deg/s, of at least 6 samples. ``rate_logged``: whether the table logs
    the rate; False: it was computed from the angle. Attributes:

    ``explained``: (n - 1,) bool, intervals that one or two stretches of constant acceleration reproduce.
    ``valid``: (n - 1,) bool, explained intervals, and intervals of smooth motion: ``dA = (r_0 + r_1) dt / 2 -
    (r'_1 - r'_0) dt^2 / 12`` to 1e-3 deg, to the noise of the log, or to its rounding. In other intervals the
    trajectory is not reliable.
    ``valid_samples``: (n,) bool, samples followed by a valid interval, with only valid intervals in the 0.3 s before
    them, in which a filter inside the sensor settles. Samples at which a stretch ends are not valid.
    ``acceleration``: (n,), deg/s^2, at the samples.
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
        """Return the interval of each time: computed where the samples are equidistant, else searched."""
        last = len(self._step) - 1
        k: Index = np.clip((time - self.time[0]) * ((last + 1) / (self.time[-1] - self.time[0])), 0, last).astype(
            np.intp
        )
        lost = ((time < self.time[k]) & (k > 0)) | ((time >= self.time[k + 1]) & (k < last))
        k[lost] = np.clip(np.searchsorted(self.time, time[lost], side="right") - 1, 0, last)
        return k

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

    def means(
        self, pieces: Pieces, offset: float | Values, lag: float
    ) -> tuple[Callable[[], tuple[Values, ...]], Callable[[], tuple[Values, ...]]]:
        """Return means over rows of samples at ``time + offset``, behind a lag; ``offset``: of all or of each piece.

        Returns two functions, which compute them once: of the angle, its rate and acceleration, and of its cosine and
        sine, (m,) arrays. The mean of a derivative over a piece's time is the difference of its integral; behind a lag,
        the integral of the rate is ``A - lag r``. Others are by Simpson's rule. A piece of one sample has its values.
        The result equals the mean over the samples, dt apart, but for ``dt^2 / 24`` of the second derivative.
        """
        first, last, m = pieces.first, pieces.last, len(pieces.first)
        t0, t1 = self.time[first], self.time[last]
        beyond = 0.5 * (t1 - t0) / np.maximum(last - first, 1)
        t0, t1 = t0 - beyond + offset, t1 + beyond + offset
        points, size, one = np.concatenate([t0, 0.5 * (t0 + t1), t1]), t1 - t0, first == last

        def slope(of: Values, values: Values) -> Values:
            return np.where(one, values[m : 2 * m], (of[2 * m :] - of[:m]) / np.where(one, 1.0, size))

        def mean(values: Values) -> Values:
            return np.asarray((values[:m] + 4.0 * values[m : 2 * m] + values[2 * m :]) / 6.0)

        def of_rows(*means: Values) -> tuple[Values, ...]:
            return tuple(np.add.reduceat(pieces.share * values, pieces.of_row) for values in means)

        def line() -> tuple[Values, ...]:
            angle, rate, acceleration = self.at(points)
            if lag <= 0.0:
                return of_rows(mean(angle), slope(angle, rate), slope(rate, acceleration))
            rate, acceleration = self.lagged(points, lag)
            return of_rows(mean(angle), slope(angle - lag * rate, rate), slope(rate, acceleration))

        def circle() -> tuple[Values, ...]:
            return of_rows(*map(mean, self._circle(points, lag)))

        return cache(line), cache(circle)

    def _circle(self, time: Values, lag: float) -> tuple[Values, Values]:
        """Return cosine and sine of the angle behind a lag: (n,) arrays."""
        nodes, weights = (NODES, WEIGHTS) if lag > 0.0 else (np.zeros(1), np.ones(1))
        turns = np.radians([self.angle_at(time - lag * node) for node in nodes])
        return weights @ np.cos(turns), weights @ np.sin(turns)

    def path(
        self, offset: float | Values, lag: float, pieces: Pieces | None
    ) -> tuple[Callable[[], tuple[Values, ...]], Callable[[], tuple[Values, ...]], Callable[[], Mask]]:
        """Return the functions of ``means``, of rows or else of samples, and that of where the trajectory is valid."""
        if pieces is not None:
            return *self.means(pieces, offset, lag), lambda: self.known_in(pieces, offset)
        if lag <= 0.0 and not np.any(offset):
            turns = np.radians
            return (
                lambda: (self.angle, self.rate, self.acceleration),
                lambda: (np.cos(turns(self.angle)), np.sin(turns(self.angle))),
                lambda: self.valid_samples,
            )
        time = self.time + offset

        def line() -> tuple[Values, ...]:
            return (self.angle_at(time), *self.lagged(time, lag)) if lag > 0.0 else self.at(time)

        return cache(line), cache(lambda: self._circle(time, lag)), lambda: self.known_at(time)

    @cached_property
    def _lost(self) -> Index:
        """The number of samples before each sample, and of all, that are not valid."""
        return np.concatenate([[0], np.cumsum(~self.valid_samples)])

    def known_in(self, pieces: Pieces, offset: float | Values) -> Mask:
        """Return in which rows of samples the trajectory is valid at all of ``time + offset``; see ``known_at``."""
        first, last = pieces.first, pieces.last
        lost = self._lost
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
        rate, a, s = self.rate[k], self._before[k], self._bend[k]
        first, bent = np.minimum(x, s), np.flatnonzero(x > s)
        fade = np.exp(-first / lag)
        middle = rate + a * first
        own = middle - a * lag + (a * lag - rate) * fade
        b, second = self._after[k[bent]], (x - s)[bent]
        fade_after = np.exp(-second / lag)
        own[bent] = middle[bent] + b * (second - lag) + (own - middle)[bent] * fade_after + b * lag * fade_after
        fade[bent] *= fade_after
        return own, fade

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
