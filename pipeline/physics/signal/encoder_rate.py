"""Compute the rate of a table whose log holds the angle only; by the table's own clock where it has one.

A fine angle is differentiated: by a cubic spline, or by central differences where it bends between two samples. The
differentiation amplifies errors of the angle that are independent from sample to sample: the resolution q of an
encoder, its noise, or time stamps that scatter about the times of the samples. Where they are significant, the angle A
is smoothed,

    minimize  sum (y_i - A_i)^2 / R + sum (D^k A)_i^2 h / S,    R = q^2 / 12, or the variance that the log shows,

where D^k is the k-th divided difference over times h apart. S is the density of a random acceleration (k = 2), jerk (3)
or derivative of the jerk (4); k and S maximize the likelihood of the log. The covariance of A is
``(I / R + D^T D h / S)^-1``, the inverse of a band matrix. The rate is the central difference of A. In addition to its
covariance, the rate varies between the samples about this mean, by ``S h^(2k - 3) / (2 (2k - 1) (k - 1)!^2)``. Ramps
make k = 3 likely, which does not describe the ripple of a motor. So where most of a motion has a steady rate, the noise
is also estimated from that part alone, and the larger noise is used.

Source: H. L. Weinert, Fast Compact Algorithms and Software for Spline Smoothing, 2013; the likelihood is that of G.
Wahba, Annals of Statistics 13 (1985), 1378, for a noise of known variance.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from math import factorial

import numpy as np

from pipeline.core.records import Mask, Recording, Values, once_of_log
from pipeline.physics.signal.rests import RATE_AT_REST_DPS, runs

VAGUE_DPS = 0.01  # the noise of a gyroscope's sample; a smaller error of the rate does no harm
STEP_MULTIPLE_TOLERANCE = 1e-3  # of a step, to which the angles of an encoder are multiples of it: printed decimals
ORDERS = (2, 3, 4)  # a motor that ripples, a program of constant accelerations, motion by a wheel
ADDED_REST_SAMPLES = 5  # samples of rest added at both ends of a motion, which begins and ends at zero rate
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
    distinct = np.diff(np.unique(changes), prepend=0.0)
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
    lasts = time[starts + lengths - 1] - time[starts] > (step / RATE_AT_REST_DPS or ADDED_REST_SAMPLES * interval)
    moving = ~np.repeat(lasts, lengths)
    apart = (
        np.flatnonzero(np.diff(time) > MAX_ANGLE_GAP_INTERVALS * interval) + 1
    ).tolist()  # first samples after a gap
    ends = [[first, *(i for i in apart if first < i < last), last] for first, last in runs(moving)]
    vague = np.zeros(n, bool)
    for first, last in itertools.chain.from_iterable(map(itertools.pairwise, ends)):
        before, after = first in apart, last in apart
        around = slice(
            first if before else max(first - ADDED_REST_SAMPLES, 0),
            last if after else min(last + ADDED_REST_SAMPLES, n),
        )
        vague[first : first + ADDED_REST_SAMPLES * before] = vague[
            max(last - ADDED_REST_SAMPLES * after, first) : last
        ] = before or after
        part, span = slice(first - around.start, last - around.start), slice(first, last)
        if around.stop - around.start <= 2 * ADDED_REST_SAMPLES:
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
    """The smoothing of an angle for one order of difference."""

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
        return float(
            log_determinant + np.sum((self.angle - smooth) ** 2) / self.variance + np.sum(weight * difference**2)
        )
