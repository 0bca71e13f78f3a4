"""Detect rotation within a rest: creep, and turns about the vertical.

Creep is the slow, steady tilt of a unit within a rest: its support yields, or a hand drifts.

In a body that turns at the rate omega, the direction of gravity u changes by ``du/dt = -omega x u``. The accelerometer
thus shows the two components of omega across gravity:

    omega_across = (du/dt) x u

du/dt is the slope of the readings of a rest; with white noise s of a sample, n samples and a rest of T seconds its
standard deviation is ``s sqrt(12 / n) / T`` on each axis. s follows from the readings minus a parabola in time, so that
creep does not count as noise. The mean of a vector whose direction has the variance v (rad^2, both axes together) is
too short by the share v/2.

In turns about the vertical, and at the ends of moves, the unit turns while the accelerometer is quiet.

With the mean rate m and the variance v of a short window about each sample, the unit turns where

    max_c |m_c - r_c| > max(q s_c / sqrt(n), q d_c)    or    sum_c v_c > q^2 V

where

    n   : samples of the window, 0.2 s and at least 3
    r   : median of m in the stretch in which the accelerometer is quiet; it contains bias, g-sensitivity and a steady
          creep. Where it differs from the median of the stretches around it by more than the limit of a rest's rate,
          the stretch is mostly a turn, and that median replaces it. With one or two stretches only, the mean of the
          first and last window of a stretch is used for this, if the two agree
    s_c : white noise of a sample, by the differences of successive samples
    d_c : 1.4826 times the median of |m_c - r_c| in the stretch: the standard deviation of m, tremor of a hand included,
          where the unit rests for more than half of the stretch; q d_c is limited to a hand's largest tremor
    V   : median of sum_c v_c in the stretch: noise and tremor
    q   : 6: of 10^5 windows of three axes, noise alone passes in 6e-4

Readings that are coarse against their noise repeat their value: the limit of a mean is at least one count, and V at
least the variance of rounding, ``sum_c count_c^2 / 12``, in which a single flip of a count stays below the limit.

For a stretch that is mostly a turn, d and V are the medians of all stretches. A stretch is cut where the unit turns. Of
pieces between which it turned by less than the limit of a rest, only the longest is used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.core.records import MEDIAN_SIZE, Mask, Recording, Values, finite_rows, median, noise_of_steps, once
from pipeline.physics.signal.filters import filter_autocovariance, variance_of_mean

Spans = list[tuple[int, int]]

PARABOLA_DEGREE = 2  # of the parabola
SIGNIFICANT_CREEP = 4.0  # standard deviations: of the two components, noise alone passes it in 3e-4
FEWEST_OF_A_SLOPE = 8  # samples from which a slope has five degrees of freedom
QUIET_WINDOW_S, MIN_WINDOW_SAMPLES = 0.2, 3  # shorter than a move; samples that have a variance
SIGNIFICANT_TURN = 6.0  # q above
NEIGHBOUR_STRETCHES = 5  # stretches: their median withstands two that turned
LINE_BLOCKS = 5  # of a third of a rest: noise alone passes q in 6e-9, a tremor that differs from block to block in 3 %
RATE_LIMIT_DPS = 0.7  # of a stretch against those around it: hand-held rests differ by g-sensitivity and creep
# Of a window's mean, whatever the tremor of the stretch. The rests of a published MPU-6050 recording in a hand reach
# 1.7 except at the ends of moves; its moves reach 60 (see tests/signal/test_rests.py).
TREMOR_DPS = 2.5
SAME_DEG = 2.0  # the limit of a rest in ``pipeline.physics.signal.rests``
ROUNDING_TERMS = 1000  # harmonics, with which u^2 of readings without noise is 6e-4 too small
COARSE = float(np.sqrt(0.25 + 1.0 / 12.0))  # steps, scatter of readings with noise of half a step
OF_A_STEP = 256  # differences, in which readings finer than their noise show that
DIFFERENCE_BLOCK, MIN_DIFFERENCE_BLOCKS = 16, 8  # differences of a block; blocks of a recording that show its noise
DECIMAL_ROUNDING = 1e-6  # relative, of a difference of decimals


@dataclass(frozen=True)
class Creep:
    """The tilt within one rest."""

    rate: Values  # (3,), deg/s, omega across gravity, in the axes of the readings; zero where it is not significant
    measured: Values  # (3,), deg/s, the same, also where it is not significant
    uncertainty: float  # deg/s, standard uncertainty of each of its two components
    shortening: float  # share by which the mean of the readings is too short; 0 where the rate is zero
    squares: Values  # (3,), sum of squares of the readings about their parabola
    freedom: int  # degrees of freedom of the squares of each axis


def posterior_creep_rates(creeps: Sequence[Creep]) -> tuple[Values, Values, float]:
    """Return the posterior rates across gravity in the rests of one recording.

    With the variance c^2 of a component between the rests, estimated from rates w of standard uncertainty e,

        rate = w c^2 / (c^2 + e^2),   error^2 = c^2 e^2 / (c^2 + e^2),   c^2 = mean(|w|^2 / 2 - e^2)

    and c = 0 where noise alone explains the rates: ``|w|^2 / (2 e^2)`` then has mean and variance 1. The rate about
    gravity, which the accelerometer does not show, is given the same standard deviation c.

    Returns the rates, (m, 3), the standard uncertainty of each of their two components, (m,), and c, all deg/s.
    """
    w, e = np.array([c.measured for c in creeps]).reshape(-1, 3), np.array([c.uncertainty for c in creeps])
    known = e > 0.0
    half = 0.5 * np.sum(w**2, axis=1)
    if not known.any() or np.mean(half[known] / e[known] ** 2) <= 1.0 + SIGNIFICANT_CREEP / np.sqrt(known.sum()):
        return np.zeros_like(w), np.zeros(len(w)), 0.0
    variance = max(float(np.mean(half[known] - e[known] ** 2)), 0.0)
    share = np.where(known, variance / (variance + e**2), 0.0)
    return w * share[:, None], np.where(known, e * np.sqrt(share), np.sqrt(variance)), float(np.sqrt(variance))


def component_along_gravity(time: Values, force: Values) -> tuple[Values, bool]:
    """Return the readings of a rest along their mean, (n,) array, g, and whether the unit creeps in the rest.

    A tilt by theta changes the component along gravity by theta times the bias across gravity, which is unknown here.
    So where the unit creeps, a parabola in time is subtracted.
    """
    mean = force.mean(axis=0)
    along = force @ (mean / np.linalg.norm(mean))
    creeps = bool(creep_of_readings(time, force).rate.any())
    if creeps:
        basis = _parabolas(time)[:, 1:]
        along = along - basis @ (basis.T @ along)
    return along, creeps


def _parabolas(time: Values) -> Values:
    """Return an orthonormal basis of the parabolas in time: (n, 3) array, the constant first."""
    x = 2.0 * (time - time[0]) / (time[-1] - time[0]) - 1.0
    return np.linalg.qr(np.polynomial.legendre.legvander(x, PARABOLA_DEGREE))[0]


@once
def creep_of_rest(recording: Recording, start: int, stop: int) -> Creep:
    """Return the creep in the samples ``start <= n < stop`` of a recording, without flagged and missing ones."""
    force = recording.accelerometer
    assert force is not None  # noqa: S101
    good = (recording.valid[start:stop]) & finite_rows(force[start:stop])
    count = np.array([max(int(good.sum()), 1)])
    share = float(variance_of_mean(filter_autocovariance(recording), count)[0])
    return creep_of_readings(recording.time[start:stop][good], force[start:stop][good], share)


def creep_of_readings(time: Values, force: Values, share: float = 0.0) -> Creep:
    """Return the creep within a rest from n readings of the accelerometer, g.

    ``share`` is the variance of their mean over the variance of one reading, for white noise; 0 stands for 1/n.
    """
    n = len(time)
    mean = force.mean(axis=0) if n else np.zeros(3)
    length = float(np.linalg.norm(mean))
    if n < FEWEST_OF_A_SLOPE or length == 0.0 or time[-1] <= time[0]:
        return Creep(np.zeros(3), np.zeros(3), 0.0, 0.0, np.sum((force - mean) ** 2, axis=0), max(n - 1, 0))
    u, span = mean / length, float(time[-1] - time[0])
    basis = _parabolas(time)
    along = basis.T @ force
    squares = np.sum((force - basis @ along) ** 2, axis=0)
    freedom = n - PARABOLA_DEGREE - 1
    across = along - np.outer(along @ u, u)  # the change of direction
    path, line = basis[:, 1:] @ across[1:], basis[:, 1:2] @ across[1:2]
    white = float(np.sqrt(squares.sum() / (3 * freedom)))
    error = white * np.sqrt(12.0 * max(share, 1.0 / n)) / span
    slope = (line[-1] - line[0]) / span
    measured, uncertainty = np.degrees(np.cross(slope, u) / length), float(np.degrees(error / length))
    if np.linalg.norm(slope) <= SIGNIFICANT_CREEP * error:
        return Creep(np.zeros(3), measured, uncertainty, 0.0, squares, freedom)
    variance = float(np.mean(np.sum(path**2, axis=1))) / length**2
    return Creep(measured, measured, uncertainty, 0.5 * variance, squares, freedom)


def quiet_pieces(rate: Values, stretches: Sequence[tuple[int, int]], interval: float, shortest: int) -> Spans:
    """Cut stretches in which the accelerometer is quiet at the samples where the gyroscope turns.

    ``rate``: (n, 3), deg/s, finite in the stretches; ``stretches``: start and stop of each, in order; ``interval``:
    mean time between samples, s; ``shortest``: samples of the shortest piece that is a rest.
    """
    size = max(MIN_WINDOW_SAMPLES, round(QUIET_WINDOW_S / interval))
    if not stretches or min(stop - start for start, stop in stretches) < size:
        return list(stretches)
    parts = [rate[start:stop] for start, stop in stretches]
    of_parts = [windows(part, size) for part in parts]
    medians = np.array([median(mean) for mean, _ in of_parts])
    reference, resting = _references(medians, np.array([mean[[0, -1]] for mean, _ in of_parts]))
    off = [np.abs(mean - r) for (mean, _), r in zip(of_parts, reference, strict=True)]
    differences = np.concatenate([np.abs(np.diff(part, axis=0)) for part in parts])
    white = noise_of_steps(differences) / np.sqrt(size)
    spread = MEDIAN_SIZE * np.array([median(own) for own in off])
    noise = np.array([median(variance) for _, variance in of_parts])
    spread = np.where(resting[:, None], spread, np.median(spread, axis=0))
    count = counts_of(differences)
    limit = np.minimum(SIGNIFICANT_TURN * np.maximum(white, spread), np.maximum(SIGNIFICANT_TURN * white, TREMOR_DPS))
    limit = np.maximum(limit, count * (1.0 + DECIMAL_ROUNDING))
    loud = SIGNIFICANT_TURN**2 * np.maximum(np.where(resting, noise, np.median(noise)), np.sum(count**2) / 12.0)
    pieces: Spans = []
    for i, (start, stop) in enumerate(stretches):
        turns = np.any(off[i] > limit[i], axis=1) | (of_parts[i][1] > loud[i])
        # Samples farther than half a window from the middle of each window in which the unit turns.
        near = 2 * (size // 2) + 1
        count = np.cumsum(np.pad(turns, (near, near - 1)))
        quiet = (count[near:] == count[:-near])[: stop - start]
        turned = np.vstack([np.zeros(3), np.cumsum((parts[i] - reference[i]) * interval, axis=0)])
        found = _rests(quiet, turned, shortest)
        if not (found or resting[i]):
            found = [(0, stop - start)]  # the caller refuses it, with the reason
        pieces += [(start + a, start + b) for a, b in found]
    return pieces


def before_slow_motion(rate: Values, pieces: Spans, interval: float, shortest: int) -> Spans:
    """Cut the rests of a recording of one turn where the turn begins or ends slowly.

    A rest ends where a window differs by q standard deviations from the third of the rest that is farthest from the
    turn. ``quiet_pieces`` takes such motion for a tremor: a turn of 26 s that begins smoothly loses 3 deg by it. Where
    blocks of that third follow a line to its end, by q of its standard uncertainties, the piece is no rest.
    """
    size, out = max(MIN_WINDOW_SAMPLES, round(QUIET_WINDOW_S / interval)), []
    for start, stop in pieces:
        before = start + stop < len(rate)
        part = rate[start:stop] if before else rate[start:stop][::-1]
        mean, far = windows(part, size)[0], max(shortest, len(part) // 3)
        if len(part) > far:
            off = np.abs(mean - median(mean[:far]))
            steps = np.abs(np.diff(part[:far], axis=0))
            if _follows_a_line(part[:far], noise_of_steps(steps)):
                continue
            noise = np.maximum(noise_of_steps(steps) / np.sqrt(size), MEDIAN_SIZE * median(off[:far]))
            limit = np.maximum(SIGNIFICANT_TURN * noise, counts_of(steps) * (1.0 + DECIMAL_ROUNDING))
            turns = np.flatnonzero(np.any(off > limit, axis=1))
            kept = max(int(turns[0]), shortest) if turns.size else len(part)
            part = part[:kept]
        out.append((start, start + len(part)) if before else (stop - len(part), stop))
    return out


def _follows_a_line(rate: Values, white: Values) -> bool:
    """Return whether the means of blocks of a rate, (n, 3), follow a line; ``white``: (3,), noise of a sample."""
    size = len(rate) // LINE_BLOCKS
    mean = rate[: LINE_BLOCKS * size].reshape(LINE_BLOCKS, size, 3).mean(axis=1)
    x = np.arange(LINE_BLOCKS) - 0.5 * (LINE_BLOCKS - 1)
    slope = x @ mean / (x @ x)
    left = mean - mean.mean(axis=0) - np.outer(x, slope)
    noise = np.maximum(np.sqrt(np.sum(left**2, axis=0) / (LINE_BLOCKS - 2)), white / np.sqrt(size))
    return bool(np.any(np.abs(slope) > SIGNIFICANT_TURN * noise / np.sqrt(x @ x)))


def counts_of(differences: Values) -> Values:
    """Return the smallest nonzero step between successive readings of each axis, (k,), from their steps' sizes (n, k).

    In coarse readings it is one count; in fine ones it is negligible against their noise.
    """
    smallest = np.where(differences > 0.0, differences, np.inf).min(axis=0, initial=np.inf)
    return np.asarray(np.where(np.isfinite(smallest), smallest, 0.0))


@once
def step_and_noise(recording: Recording, sensor: str, rows: int | None = None) -> tuple[Values, Values]:
    """Return the step and the noise of each axis of a sensor's readings; infinite where unknown.

    The noise is the first quartile of the white noise of blocks, that of the quietest. ``rows``: that show the step.
    """
    unknown = np.full(3, np.inf)
    values = np.asarray(recording.reading(sensor))
    if not (finite := np.isfinite(values)).all():
        values = values[finite.all(axis=1)]
    differences = np.abs(np.diff(np.asfortranarray(values), axis=0))  # numpy is fast along a contiguous axis
    count = len(differences) // DIFFERENCE_BLOCK
    if count < MIN_DIFFERENCE_BLOCKS:
        return unknown, unknown
    step = counts_of(differences[:rows])
    blocks = differences[: count * DIFFERENCE_BLOCK].T.reshape(3, count, DIFFERENCE_BLOCK)
    mean_squares = np.einsum("cbi,cbi->bc", blocks, blocks) / DIFFERENCE_BLOCK
    squares, place = np.sort(mean_squares, axis=0), 0.25 * (count - 1)  # np.quantile is slow
    low = squares[int(place)]
    noise = np.sqrt(0.5 * (low + place % 1.0 * (squares[int(place) + 1] - low)))
    return np.where(step > 0.0, step, np.inf), noise


def rounding_of_readings(recordings: Sequence[Recording], sensor: str) -> tuple[Values, Values]:
    """Return ``rounding_of`` of recordings; the step of some rows, at least that of all, mostly excludes coarse."""
    own = [r for r in recordings if r.reading(sensor) is not None]
    parts = (step_and_noise(r, sensor, OF_A_STEP) for r in own)
    least = [np.min(values, axis=0) for values in zip(*parts, strict=True)]
    if least and np.all(COARSE * least[0] <= least[1]):
        return np.zeros(3), np.zeros(3)
    return rounding_of([step_and_noise(r, sensor) for r in own])


def rounding_of(found: Sequence[tuple[Values, Values]]) -> tuple[Values, Values]:
    """Return the step of coarse readings, and the standard uncertainty of their means by rounding: (3,) arrays.

    Both are 0 on an axis whose noise is above half a step. ``found``: ``step_and_noise`` of each recording; the
    quietest counts. White noise s in steps of d scatters by ``sqrt(s^2 + d^2 / 12)``, 0.58 d for half a step. For a
    value anywhere in a step, ``u^2 = d^2 / (2 pi^2) sum_k exp(-(2 pi k s / d)^2) / k^2``, however many readings a mean
    has: ``d^2 / 12`` without noise and 4e-6 d^2 for half a step (Widrow & Kollar 2008, Quantization Noise: by the
    characteristic function of the noise).
    """
    unknown = np.full(3, np.inf), np.full(3, np.inf)
    step, noise = (np.min(values, axis=0) for values in zip(unknown, *found, strict=True))
    coarse, u = np.isfinite(step) & (noise < COARSE * step), np.zeros(3)
    k = np.arange(1, ROUNDING_TERMS + 1)[:, None]
    variance = np.maximum((noise[coarse] / step[coarse]) ** 2 - 1.0 / 12.0, 0.0)  # s^2 / d^2 (Sheppard 1898)
    harmonics = np.sum(np.exp(-((2.0 * np.pi * k) ** 2) * variance) / k**2, axis=0)
    u[coarse] = step[coarse] * np.sqrt(0.5 * harmonics) / np.pi
    return np.where(coarse, step, 0.0), u


def windows(values: Values, size: int) -> tuple[Values, Values]:
    """Return the mean of each window of ``size`` rows, (m, k), and its variance summed over the columns, (m,)."""
    middle = median(values)
    centred = values - middle
    sums, squares = (np.pad(np.cumsum(v, axis=0), ((1, 0), (0, 0))) for v in (centred, centred**2))
    total, power = sums[size:] - sums[:-size], squares[size:] - squares[:-size]
    variance = np.maximum((power - total**2 / size).sum(axis=1), 0.0) / (size - 1)
    return total / size + middle, variance


def _references(medians: Values, ends: Values) -> tuple[Values, Mask]:
    """Return the rate at rest of each stretch, and which are mostly rest; ``ends``: means of end windows, (m, 2, 3)."""
    out, resting = medians.copy(), np.ones(len(medians), bool)
    if len(medians) <= 2:
        middle = ends.mean(axis=1)
        still = np.abs(ends[:, 0] - ends[:, 1]).max(axis=1) < RATE_LIMIT_DPS
        resting = ~(still & (np.abs(medians - middle).max(axis=1) > RATE_LIMIT_DPS))
        return np.where(resting[:, None], medians, middle), resting
    for i, median_rate in enumerate(medians):
        first = int(np.clip(i - NEIGHBOUR_STRETCHES // 2, 0, max(len(medians) - NEIGHBOUR_STRETCHES, 0)))
        around = median(medians[first : first + NEIGHBOUR_STRETCHES])
        if np.abs(median_rate - around).max() > RATE_LIMIT_DPS:
            out[i], resting[i] = around, False
    return out, resting


def _rests(quiet: Mask, turned: Values, shortest: int) -> Spans:
    """Return the quiet runs; of runs between which the unit did not turn, only the longest."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], quiet, [False]]).astype(np.int8)))
    out: Spans = []
    for a, b in edges.reshape(-1, 2).tolist():
        if b - a < shortest:
            continue
        if out and np.linalg.norm(turned[a] - turned[out[-1][1]]) < SAME_DEG:
            if b - a > out[-1][1] - out[-1][0]:
                out[-1] = (a, b)
        else:
            out.append((a, b))
    return out
