"""Compute the motion of a table from its logged angle: the rate by the angle alone, and all between the samples.

Where the log holds no rate, a fine angle is differentiated: by a cubic spline, or by central differences where it bends
between two samples; by the table's own clock where it has one. The differentiation amplifies errors of the angle that
are independent from sample to sample: the resolution q of an encoder, its noise, or time stamps that scatter about the
times of the samples. Where they are significant, the angle A is smoothed,

    minimize  sum (y_i - A_i)^2 / R + sum (D^k A)_i^2 h / S,    R = q^2 / 12, or the variance that the log shows,

where D^k is the k-th divided difference over times h apart. S is the density of a random acceleration (k = 2), jerk (3)
or derivative of the jerk (4); k and S maximize the likelihood of the log. The covariance of A is
``(I / R + D^T D h / S)^-1``, the inverse of a band matrix. The rate is the central difference of A. In addition to its
covariance, the rate varies between the samples about this mean, by ``S h^(2k - 3) / (2 (2k - 1) (k - 1)!^2)``. Ramps
make k = 3 likely, which does not describe the ripple of a motor. So where most of a motion has a steady rate, the noise
is also estimated from that part alone, and the larger noise is used.

``EncoderTrajectory``: a table's program consists of stretches of constant angular acceleration. They end at times
between the samples of the logged angle A and rate r. Between two samples, dt apart,

    no bend inside:   dA = (r_0 + r_1) dt / 2
    a bend at s:      dr = a s + b (dt - s),   dA = r_0 dt + a s (dt - s / 2) + b (dt - s)^2 / 2

where a and b are the accelerations before and after it. An interval without a bend has ``a = dr / dt``; one with a bend
takes a, b or both from its neighbours, which gives s. Where both are known, the second equation is a check; else the
next interval must begin with the acceleration with which this one ends. So ramps of a few samples are followed exactly.
Elsewhere, in smooth motion, angle, rate and acceleration come from the quintic that has the logged angle and rate at
both ends, and the acceleration from the five nearest rates.

Source: H. L. Weinert, Fast Compact Algorithms and Software for Spline Smoothing, 2013; the likelihood is that of G.
Wahba, Annals of Statistics 13 (1985), 1378, for a noise of known variance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import chain, pairwise
from math import factorial
from typing import NamedTuple

import numpy as np

from pipeline.core.records import Index, Mask, Recording, Values, median, once_of_log
from pipeline.physics.signal.rests import RATE_AT_REST_DPS, runs

VAGUE_DPS = 0.01  # the noise of a gyroscope's sample; a smaller error of the rate does no harm
STEP_MULTIPLE_TOLERANCE = 1e-3  # of a step, to which the angles of an encoder are multiples of it: printed decimals
ORDERS = (2, 3, 4)  # a motor that ripples, a program of constant accelerations, motion by a wheel
ADDED_REST = 5  # samples of rest added at both ends of a motion, which begins and ends at zero rate
FEWEST_MOVED = 100  # changes of the angle: their autocorrelation is known to 0.1
ROUNDING_AUTOCORRELATION = -0.35  # autocorrelation, half way between that of rounding errors and that of ramps
MAX_ROUNDING_RATIO = 1.5  # times the errors of rounding, above which errors are not rounding alone
# of the second differences, without the corners of ramps; their share of a normal variance
KEPT_SECOND_DIFFERENCES, KEPT_VARIANCE_SHARE = 0.95, 0.759
AROUND = 9  # second differences over which an acceleration is taken as constant
MIN_RATE_SAMPLES = 6  # samples from which a rate and its derivative follow
# of the median rate, within which a rate is steady; share of a motion with such a rate
STEADY, STEADY_SHARE = 0.05, 0.5
ACCELERATION_DENSITIES = (1e-6, 1e12)  # S, (deg/s)^2/s^(2k - 3): from a table at rest to 10,000 deg/s^2 in 0.1 s
MAX_ANGLE_GAP_INTERVALS = 1.5  # sampling intervals, above which the angle in between is unknown
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


@dataclass(frozen=True)
class EncoderRate:
    """Angle and rate of a table from the log of its angle: (n,) arrays."""

    angle: Values  # deg, smoothed where the encoder is coarse
    rate: Values  # deg/s
    noise: Values  # deg/s, standard deviation of the rate from the errors of the angle; 0 of a fine one and at rest
    vague: Mask  # where the rate is unreliable: at a bend of a fine angle, at a gap of a coarse one


@once_of_log
def rate_by_angle(recording: Recording) -> EncoderRate | None:
    """Return the rate from the angle; None where the table logs a rate or no angle, or below 6 samples."""
    angle = recording.table_angle
    if recording.table_rate is not None or angle is None or recording.samples < MIN_RATE_SAMPLES:
        return None
    return _rate_of(recording.time * recording.table_seconds, angle)


def _rate_of(time: Values, angle: Values) -> EncoderRate:
    step, error = _errors(time, angle)
    if np.sqrt(2.0) * error > VAGUE_DPS * 2.0 * float(np.median(np.diff(time))):
        return _smoothed(time, angle, step, error)
    from scipy.interpolate import make_interp_spline  # noqa: PLC0415  (0.3 s, needed without a rate log alone)

    spline, central = make_interp_spline(time, angle, k=3)(time, 1), np.gradient(angle, time)
    slope = np.abs(np.diff(angle) / np.diff(time))
    resting = np.maximum(np.append(slope[0], slope), np.append(slope, slope[-1])) < RATE_AT_REST_DPS
    miss = np.abs(spline - central)
    bent = miss > max(VAGUE_DPS, 8.0 * float(np.percentile(miss, 10.0)))
    vague = np.logical_and(np.convolve(bent, np.ones(9), "same") > 0.5, np.logical_not(resting))
    return EncoderRate(angle, np.where(bent | resting, central, spline), np.zeros(len(time)), vague)


def _errors(time: Values, angle: Values) -> tuple[float, float]:
    """Return the step of an encoder, deg, and the standard deviation of the angle's independent errors, deg.

    Independent errors are found by the second differences of the moving angle, minus their mean over neighbours, the
    acceleration: their autocorrelation at lag 1 is -2/3, while that of a program's ramps is positive. Both results are
    0 if there are none. The errors are rounding if all changes are multiples of a step and the second differences are
    not larger; else the step is 0.
    """
    rounding = 1e-9 * max(float(np.abs(angle).max()), 1.0)
    changes, intervals = np.abs(np.diff(angle)), np.diff(time)
    if np.count_nonzero(changes > rounding) < FEWEST_MOVED:
        return 0.0, 0.0
    usual = float(np.median(intervals))
    apart = intervals > MAX_ANGLE_GAP_INTERVALS * usual
    bent = np.where(apart[1:] | apart[:-1], 0.0, np.diff(np.diff(angle) / intervals) * usual)
    bent -= np.convolve(bent, np.full(AROUND, 1.0 / AROUND), "same")
    power = float(bent @ bent)
    if not (power > 0.0 and float(bent[1:] @ bent[:-1]) < ROUNDING_AUTOCORRELATION * power):
        return 0.0, 0.0
    moving = (changes[1:] > rounding) & (changes[:-1] > rounding)
    squares = np.sort(bent[moving] ** 2)[: max(int(KEPT_SECOND_DIFFERENCES * np.count_nonzero(moving)), 1)]
    error = float(np.sqrt(np.mean(squares) / (6.0 * KEPT_VARIANCE_SHARE))) if moving.any() else 0.0
    step = step_of(changes, rounding, printed=True)
    return (step, step / np.sqrt(12.0)) if step and error <= MAX_ROUNDING_RATIO * step / np.sqrt(12.0) else (0.0, error)


def step_of(changes: Values, rounding: float, *, printed: bool = False) -> float:
    """Return the step of which all changes from sample to sample are multiples, in their unit; 0 if there is none.

    ``changes``: absolute values, (n,). ``rounding``: the largest change that is a rounding error. ``printed``: whether
    the step may be known by a few decimals only, so that its error grows with the multiple.
    """
    distinct = np.diff(np.sort(changes), prepend=0.0)
    larger = distinct[distinct > rounding]
    if len(larger) == 0:
        return 0.0
    step = float(larger.min())
    multiples = changes / step
    most = STEP_MULTIPLE_TOLERANCE * max(1.0, float(multiples.max()) if printed else 1.0)
    return step if float(np.abs(multiples - np.rint(multiples)).max()) <= most else 0.0


def _smoothed(time: Values, angle: Values, step: float, error: float) -> EncoderRate:
    """Smooth the log of an angle with errors, separately in each stretch between rests.

    The table rests where the angle is constant for longer than a step takes at the rate that counts as rest or, for an
    angle without a step, for some samples. The errors are then estimated for each stretch.
    """
    n, interval = len(time), float(np.median(np.diff(time)))
    smooth, rate, noise = angle.copy(), np.zeros(n), np.zeros(n)
    starts = np.flatnonzero(np.diff(angle, prepend=np.nan) != 0.0)
    lengths = np.diff(np.append(starts, n))
    lasts = time[starts + lengths - 1] - time[starts] > (step / RATE_AT_REST_DPS or ADDED_REST * interval)
    moving = ~np.repeat(lasts, lengths)
    apart = (
        np.flatnonzero(np.diff(time) > MAX_ANGLE_GAP_INTERVALS * interval) + 1
    ).tolist()  # first samples after a gap
    ends = [[first, *(i for i in apart if first < i < last), last] for first, last in runs(moving)]
    vague = np.zeros(n, bool)
    for first, last in chain.from_iterable(map(pairwise, ends)):
        before, after = first in apart, last in apart
        around = slice(first if before else max(first - ADDED_REST, 0), last if after else min(last + ADDED_REST, n))
        ending = max(last - ADDED_REST * after, first)
        vague[first : first + ADDED_REST * before] = vague[ending:last] = before or after
        part, span = slice(first - around.start, last - around.start), slice(first, last)
        if around.stop - around.start <= 2 * ADDED_REST:
            rate[span], noise[span] = np.gradient(angle[around], time[around])[part], np.sqrt(0.5) * error / interval
            continue
        size = error if step else (_errors(time[around], angle[around])[1] or error)
        found, spread = _stretch(time[around], angle[around], size)
        slope = np.gradient(found, time[around])
        usual = float(np.median(slope))
        steady = runs(np.abs(slope - usual) < STEADY * abs(usual))
        start, stop = max(steady, key=lambda run: run[1] - run[0], default=(0, 0))
        if stop - start >= STEADY_SHARE * len(slope):
            spread = max(spread, _stretch(time[around][start:stop], angle[around][start:stop], size)[1])
        smooth[span], noise[span], rate[span] = found[part], spread, slope[part]
    return EncoderRate(smooth, rate, noise, vague)


def _stretch(time: Values, angle: Values, error: float) -> tuple[Values, float]:
    """Return the smoothed angle of one motion, and the standard deviation of its central differences, deg/s."""
    from scipy.linalg import cho_solve_banded  # noqa: PLC0415  (needed for a coarse encoder alone)
    from scipy.optimize import minimize_scalar  # noqa: PLC0415

    start = angle[0]
    smoothers = [_Smoother(time, angle - start, error**2, order) for order in ORDERS]
    low, high = np.log(ACCELERATION_DENSITIES)
    fits = [minimize_scalar(s.loss, bounds=(low, high), method="bounded", options={"xatol": 0.1}) for s in smoothers]
    best = int(np.argmin([fit.fun for fit in fits]))
    factor, smooth = smoothers[best].solve(fits[best].x)
    n, middle = len(time), len(time) // 2
    ends = np.zeros((n, 2))
    ends[[middle + 1, middle - 1], [0, 1]] = 1.0
    P = cho_solve_banded((factor, False), ends)[[middle + 1, middle - 1]]
    apart = float(time[middle + 1] - time[middle - 1])
    by_angle = (P[0, 0] + P[1, 1] - 2.0 * P[0, 1]) / apart**2
    order, density = ORDERS[best], float(np.exp(fits[best].x))
    within = 0.5 * density * (0.5 * apart) ** (2 * order - 3) / ((2 * order - 1) * factorial(order - 1) ** 2)
    return smooth + start, float(np.sqrt(by_angle + within))


class _Smoother:
    def __init__(self, time: Values, angle: Values, variance: float, order: int) -> None:
        self.angle, self.variance, self.order = angle, variance, order
        n = len(time)
        rows = np.ones((1, n))  # rows[j, i]: weight of A_(i + j) in the difference that begins at i
        for k in range(1, order + 1):
            apart = (time[k:] - time[:-k]) / k
            rows = (np.pad(rows[:, 1:], ((1, 0), (0, 0))) - np.pad(rows[:, :-1], ((0, 1), (0, 0)))) / apart
        self.rows, self.apart = rows, (time[order:] - time[:-order]) / order

    def solve(self, log_density: float) -> tuple[Values, Values]:
        """Return the banded Cholesky factor of ``I / R + D^T D h / S`` and the smoothed angle."""
        from scipy.linalg import cho_solve_banded, cholesky_banded  # noqa: PLC0415

        weight, n, k = self.apart * np.exp(-log_density), len(self.angle), self.order
        bands = np.zeros((k + 1, n))
        bands[k] = 1.0 / self.variance
        for i in range(k + 1):
            for j in range(i, k + 1):
                bands[k - (j - i), j : n - k + j] += weight * self.rows[i] * self.rows[j]
        factor = cholesky_banded(bands)
        return factor, cho_solve_banded((factor, False), self.angle / self.variance)

    def loss(self, log_density: float) -> float:
        """Return -2 log likelihood of the density, without its constant."""
        factor, smooth = self.solve(log_density)
        weight = self.apart * np.exp(-log_density)
        difference = sum(self.rows[j] * smooth[j : len(smooth) - self.order + j] for j in range(self.order + 1))
        log_determinant = 2.0 * np.log(factor[-1]).sum() - np.log(weight * self.rows[-1] ** 2).sum()
        misfit = np.sum((self.angle - smooth) ** 2) / self.variance
        return float(log_determinant + misfit + np.sum(weight * difference**2))


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
        """Return the angle (deg) at any times: array of their shape."""
        k = self._interval(time)
        x = time - self.time[k]
        angle, smooth = self._angle(k, x, np.maximum(x - self._bend[k], 0.0)), ~self.explained[k]
        if smooth.any():
            angle[smooth] = self._quintic(k[smooth], x[smooth])[0]
        return angle

    def _interval(self, time: Values) -> Index:
        """Return the interval of each time: computed where the samples are equidistant, else searched."""
        last = len(self._step) - 1
        steps = (time - self.time[0]) * ((last + 1) / (self.time[-1] - self.time[0]))
        k: Index = np.clip(steps, 0, last).astype(np.intp)
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

        unfiltered = cache(lambda: self.at(points))

        def line() -> tuple[Values, ...]:
            angle, rate, acceleration = unfiltered()
            if lag <= 0.0:
                return of_rows(mean(angle), slope(angle, rate), slope(rate, acceleration))
            rate, acceleration = self.lagged(points, lag)
            return of_rows(mean(angle), slope(angle - lag * rate, rate), slope(rate, acceleration))

        def circle() -> tuple[Values, ...]:
            turn = np.radians(unfiltered()[0]) if lag <= 0.0 else None
            both = self._circle(points, lag) if turn is None else (np.cos(turn), np.sin(turn))
            return of_rows(*map(mean, both))

        return cache(line), cache(circle)

    def _circle(self, time: Values, lag: float) -> tuple[Values, Values]:
        """Return cosine and sine of the angle behind a lag: (n,) arrays."""
        nodes, weights = (NODES, WEIGHTS) if lag > 0.0 else (np.zeros(1), np.ones(1))
        turns = np.radians(self.angle_at(time - lag * nodes[:, None]))
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
        v[inside], g[inside] = self._lag_step(slice(len(self._step)), self._step, lag)
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

    def _lag_step(self, k: Index | slice, x: Values, lag: float) -> tuple[Values, Values]:
        """Return the output of a lag at x into intervals: a value, and a factor on the output at x = 0."""
        a, s = self._before[k], self._bend[k]
        first, bent = np.minimum(x, s), np.flatnonzero(x > s)
        fade, slow = np.exp(first / -lag), lag * a
        own = self.rate[:-1][k] - slow
        middle = own + a * first
        own = np.subtract(middle, own * fade, out=own)
        b, second = self._after[k][bent], (x - s)[bent]
        fade_after, end = np.exp(-second / lag), (middle + slow)[bent]
        own[bent] = end + b * (second - lag) + (own[bent] - end) * fade_after + b * lag * fade_after
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
