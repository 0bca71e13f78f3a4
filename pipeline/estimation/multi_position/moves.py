"""Compute the rotation of gravity in moves between rests from the gyroscope's readings, and gravity at both ends.

    dR/dt = R [omega]x,   R[k+1] = R[k] exp [phi_k]x,   phi_k = (omega_k + omega_k+1) dt/2 + omega_k x omega_k+1 dt^2/12
    u_end = A_0 u_start,   A_k = R_end^T R_k,   du_end = u_end x sum_k A_k domega_k w_k

where

    omega : angular rate in the body frame, rad/s; linear between two samples (Savage 1998, coning term)
    u     : unit vector along the specific force, in the body frame
    A_k   : rotates vectors from the body at sample k to the body at the end of the move
    w_k   : weight of sample k in an integral by the trapezoidal rule, s

At low sampling rates a hand's accelerations begin and end between two samples. Where the rate bends there by s
(deg/s^2), a share p of an interval after the sample before, the second differences at both are ``d = (1 - p) s dt`` and
``d' = p s dt``, and the error of the rule is

    s dt^2 p (1 - p) / 2 = dt d d' / (d + d') / 2

It is subtracted from the readings where both exceed the noise. Two bends in one sense make four such differences in a
row; or three, where they share a sample and cannot be separated: that adds an error of 0.12 d dt (rms, both places
uniform) with the d that remains. More than four in a row are a rate that bends smoothly, and nothing is subtracted.

The direction of gravity before and after every move, by the calibrated accelerometer, is

    u = u_mean -+ (w x u_mean) T / 2,   or that of the half second next to the move where it differs by more than 4 s

where

    u_mean : direction of the rest's mean, T its length
    w      : rate at which the unit creeps (``pipeline.physics.signal.quiet_motion.posterior_creep_rates``)
    s      : standard deviation of the mean of the half second by white noise, across u

A unit in a hand or on a soft support creeps after it was set down, not always steadily. The half second next to a move
then shows where the move ended, with more noise than the mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from pipeline.core.records import (
    BASE,
    BASE_COUNT,
    BIAS,
    MATRIX,
    Index,
    Mask,
    Recording,
    SensorCalibration,
    Values,
    matrix_of,
)
from pipeline.core.settings import Procedure
from pipeline.estimation.engine import root_of
from pipeline.estimation.multi_position.model import motion_at_rests
from pipeline.estimation.rest_means import ROLE, Rests, rest_means, rests_of, sound_samples
from pipeline.physics.effects import effect
from pipeline.physics.kinematics import turn_by_vector
from pipeline.physics.measurement import compensate
from pipeline.physics.signal.filters import filter_autocovariance, variance_of_mean
from pipeline.physics.signal.rests import Rest

MAX_MOVE_S = 60.0  # see ``moves_of``
MAX_INTERPOLATED_INTERVALS = 3.5  # intervals without a sample, over which a rate is not interpolated
ENVELOPE = 10  # samples, of which one at least is stamped without delay
DROPPED = 0.5  # of an interval, by which a dropped sample makes at least one half of the stamps late
ROUNDED_STAMP_INTERVALS = 0.1  # of an interval, by which the digits of a file move stamps off a regular clock
CLEAR_CLOCK_GAIN = 20.0  # gain of twice a log likelihood by another clock
SMOOTH = 4  # bends in a row, see above
SHARED_BEND = 0.12  # rms, see above
BENT_RATE_RATIO = 8.0  # second difference over white noise; noise alone has 2.4
NEAR_S = 0.5  # see above
FEWEST_NEAR = 10  # samples
SIGNIFICANT_OFFSET_DEVIATIONS = 4.0  # standard deviations, see above


@dataclass(frozen=True)
class Moves:
    """The samples of all moves, padded to the longest."""

    # each (k,); rests between which each move lies
    before: Index
    after: Index
    # (k, s, 3), deg/s; minus the error of the trapezoidal rule by bends between samples; the last sample is repeated
    reading: Values
    time: Values  # (k, s), s
    # each (k, s), degC and degC/s; interpolated between the rests before and after; NaN where none was recorded
    temperature: Values
    temperature_rate: Values
    weight: Values  # (k, s), s; 0 beyond a move's end
    # (k, s, 3), deg; standard uncertainty of the angle in the readings' axes by bends that share a sample, along one
    # direction each
    doubt: Values

    def select(self, index: Mask) -> Moves:
        """Return some of the moves."""
        return Moves(**{f.name: getattr(self, f.name)[index] for f in fields(self)})

    @property
    def count(self) -> int:
        """Number of moves."""
        return len(self.before)


def spans_between(rests: Rests) -> list[tuple[int, int, slice]]:
    """Return the samples between consecutive rests of one recording, with the numbers of both rests."""
    span, joined = rests.span, np.flatnonzero(rests.recording[1:] == rests.recording[:-1]).tolist()
    return [(i, i + 1, slice(int(span[i, 1]) - 1, int(span[i + 1, 0]) + 1)) for i in joined]


def moves_of(recordings: Sequence[Recording], rests: Rests) -> Moves | None:
    """Return the moves that end at a rest of the fit, or None if there are none; ``rests``: all of the gyroscope.

    Moves with clipped, stuck or missing readings, with a gap, or longer than a minute are not used.
    """
    found = [(i, j, span) for i, j, span in spans_between(rests) if not rests.held_out[j]]
    found = [(i, j, span) for i, j, span in found if sound_span(recordings[rests.recording[j]], span)]
    if not found:
        return None
    before, after = np.array([[i, j] for i, j, _ in found]).T
    spans = [span for *_, span in found]
    at = padded(spans)
    reading, time = np.zeros((*at.shape, 3)), np.zeros(at.shape)
    for index in np.unique(rests.recording[after]):
        rows, recording = np.flatnonzero(rests.recording[after] == index), recordings[index]
        values = np.asarray(recording.gyroscope)
        clocks = clocks_of(recording.time, values, [spans[row] for row in rows], rests.white)
        reading[rows] = values[at[rows]]
        for row, clock in zip(rows.tolist(), clocks, strict=True):
            time[row] = clock[at[row] - spans[row].start]
    weight = trapezoids(time)
    excess, doubt = _bends(reading, weight, BENT_RATE_RATIO * float(np.linalg.norm(rests.white)))
    share = (time - rests.time[before][:, None]) / (rests.time[after] - rests.time[before])[:, None]
    pairs = [(v[before][:, None], v[after][:, None]) for v in (rests.temperature, rests.temperature_rate)]
    warmth, warming = (first + share * (last - first) for first, last in pairs)
    return Moves(before, after, reading - excess, time, warmth, warming, weight, doubt)


def clipped_moves(recordings: Sequence[Recording], rests: Rests) -> str:
    """Return how many of the moves between the rests hold clipped or stuck readings, as a clause; empty for none."""
    valid = [bool(recordings[rests.recording[j]].valid[span].all()) for _, j, span in spans_between(rests)]
    lost = valid.count(False)
    return f", and {lost} of the {len(valid)} moves hold clipped or stuck readings" if lost else ""


def padded(spans: Sequence[slice]) -> Index:
    """Return the samples of k spans, each padded with its last sample to the longest: (k, s) array."""
    start, stop = np.array([[span.start, span.stop] for span in spans], np.intp).T[:, :, None]
    return np.asarray(np.minimum(start + np.arange(np.max(stop - start)), stop - 1))


def trapezoids(time: Values) -> Values:
    """Return the weights of samples in integrals by the trapezoidal rule along the last axis, s."""
    return np.asarray(0.5 * (np.diff(time, prepend=time[..., :1]) + np.diff(time, append=time[..., -1:])))


def _bends(reading: Values, weight: Values, least: float) -> tuple[Values, Values]:
    """Return the excess of the trapezoidal rule by bends between samples, as rates, and its standard uncertainty.

    ``reading``: (k, s, 3), deg/s. ``weight``: (k, s), s. ``least``: deg/s, second differences below it are noise.
    """
    second = np.diff(np.pad(reading, ((0, 0), (1, 1), (0, 0)), mode="edge"), n=2, axis=1)
    second[np.linalg.norm(second, axis=2) < least] = 0.0
    both = second[:, :-1] + second[:, 1:]
    product = np.sum(second[:, :-1] * second[:, 1:], axis=2)
    same = product > 0.0
    place = np.zeros(weight.shape, np.intp)  # of each second difference in its run of one sense
    for j in range(1, weight.shape[1]):
        place[:, j] = np.where(same[:, j - 1], place[:, j - 1] + 1, 0)
    last = place.copy()
    for j in range(weight.shape[1] - 2, -1, -1):
        last[:, j] = np.where(same[:, j], last[:, j + 1], place[:, j])
    bend = same & (place[:, :-1] % 2 == 0) & (last[:, :-1] < SMOOTH)
    third = (place == 2) & (last == 2)  # the third of three
    interval = np.max(weight, axis=1)[:, None]
    weights = np.maximum(weight[:, :-1] + weight[:, 1:], 0.5 * interval)  # of the samples from which it is subtracted
    share = np.where(bend, 0.5 * interval * product / weights, 0.0) / np.maximum(np.sum(both**2, axis=2), 1e-300)
    rate = share[:, :, None] * both
    excess = np.zeros_like(reading)
    excess[:, :-1] += rate
    excess[:, 1:] += rate
    return excess, SHARED_BEND * interval[:, :, None] * np.where(third[:, :, None], second, 0.0)


def _regular_stamps(time: Values) -> Values | None:
    """Return the stamps of a regular clock for the samples: (s,) array; None if a sample was dropped.

    Stamps by arrival have random delays. A dropped sample delays all that follow: the lower envelope of the stamps,
    minus a straight line, then has a step.
    """
    n = np.arange(len(time)) - 0.5 * (len(time) - 1)
    line = time.mean() + n * float(n @ time) / float(n @ n)
    windows = np.lib.stride_tricks.sliding_window_view(time - line, min(ENVELOPE, len(time)))
    return line if np.ptp(windows.min(axis=1)) <= DROPPED * (line[1] - line[0]) else None


def _roughness(time: Values, rate: Values, white: Values) -> float:
    """Return the squared deviation of each reading from the line between its neighbours, over white noise."""
    share = ((time[1:-1] - time[:-2]) / np.maximum(time[2:] - time[:-2], 1e-9))[:, None]
    apart = rate[1:-1] - (1.0 - share) * rate[:-2] - share * rate[2:]
    return float(np.nansum(apart**2 / (white**2 * (1.0 + share**2 + (1.0 - share) ** 2))))


def clocks_of(time: Values, rate: Values, moves: Sequence[slice], white: Values) -> list[Values]:
    """Return the times of each move's samples: the stamps, or a regular clock if it makes the readings much smoother.

    The regular clock is of the whole recording; if that drifts or a sample was dropped, of each move. If the stamps
    differ from it only by the rounding of the file, it is used unless the readings contradict: with six digits, a clock
    with an interval of 9.999 ms has steps of 10 ms and sometimes one of 9 ms, over which the integral of 200 deg/s
    would be wrong by 0.2 deg.

    ``time``: (n,), s. ``rate``: (n, 3), deg/s. ``white``: (3,), deg/s, white noise of a sample.
    """
    whole = _regular_stamps(time)
    if whole is not None:
        rounded = np.abs(time - whole).max() <= ROUNDED_STAMP_INTERVALS * (whole[1] - whole[0])
        gain = _roughness(time, rate, white) - _roughness(whole, rate, white)
        regular = gain > (-CLEAR_CLOCK_GAIN if rounded else CLEAR_CLOCK_GAIN)
        return [(whole if regular else time)[span] for span in moves]
    pairs = [(span, _regular_stamps(time[span])) for span in moves]
    both = [(time[span], line, rate[span]) for span, line in pairs if line is not None]
    gain = sum(_roughness(stamps, own, white) - _roughness(line, own, white) for stamps, line, own in both)
    return [time[span] if line is None or gain <= CLEAR_CLOCK_GAIN else line for span, line in pairs]


def sound_span(recording: Recording, span: slice, longest: float = MAX_MOVE_S) -> bool:
    """Return whether the gyroscope's samples can be integrated: all valid, without a gap, for less than ``longest``."""
    time, gap = recording.time[span], MAX_INTERPOLATED_INTERVALS * recording.interval
    whole = bool(np.all(sound_samples(recording, "gyroscope")[span]))
    return whole and len(time) > 2 and time[-1] - time[0] < longest and np.diff(time).max() < gap


def to_the_end(rate: Values, time: Values) -> Values:
    """Return A_k of every sample of every move, (k, s, 3, 3), by rates (k, s, 3), deg/s, and times (k, s), s."""
    omega, dt = np.radians(rate), np.diff(time, axis=1)[:, :, None]
    phi = 0.5 * (omega[:, 1:] + omega[:, :-1]) * dt + np.cross(omega[:, :-1], omega[:, 1:]) * dt**2 / 12.0
    k, n = phi.shape[:2]
    size = int(np.ceil(np.sqrt(n + 1)))  # of a block: products within all blocks at once, then of the blocks
    count = -(-(n + 1) // size)
    back = np.tile(np.eye(3), (k, count * size, 1, 1))
    back[:, :n] = turn_by_vector(-phi)
    A = back.reshape(k, count, size, 3, 3)
    for j in range(size - 2, -1, -1):
        A[:, :, j] = A[:, :, j + 1] @ A[:, :, j]
    for j in range(count - 2, -1, -1):
        A[:, j] = A[:, j + 1, :1] @ A[:, j]
    return A.reshape(k, -1, 3, 3)[:, : n + 1]


def tangents(u: Values) -> Values:
    """Return two unit vectors across each of (k, 3) unit vectors: (k, 2, 3) array."""
    first = np.cross(u, np.eye(3)[np.argmin(np.abs(u), axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(u, first)], axis=1)


@dataclass(frozen=True)
class GravityAtRests:
    """Gravity at every rest."""

    force: Values  # (m, 3), g; specific force of each rest's mean
    # each (m, 3); unit vectors along gravity where the move before ends and where the next one begins
    at_start: Values
    at_end: Values
    spread: Values  # (m,), g; standard deviation by the scatter of the accelerometer's rests
    ends: Values  # (m,), g; additional standard deviation of each end by the uncertainty of the creep
    # (12, 12); errors of the accelerometer's bias and matrix in columns, independent, each of one standard uncertainty
    root: Values
    shared: Values  # (m, 3, 12), g; change of the force by each of these errors
    creeping: Mask  # (m,); whether the half second next to a move is off the mean by more than 4 s
    moved: Values  # (12,); by how many of these errors the calibration was moved before all this was computed


def observed_rests(
    recordings: Sequence[Recording],
    accelerometer: SensorCalibration | None,
    procedure: Procedure,
    role: str = ROLE,
    moved: Values | None = None,
) -> tuple[Rests, GravityAtRests] | None:
    """Return the gyroscope's rests and gravity at them, or None where the recordings of a role hold none.

    Without an accelerometer gravity is unknown, and zero.

    ``moved`` is added to bias and matrix of the accelerometer, (12,): gravity is linear in their errors from there on.
    """
    of_force = rests_of("accelerometer", recordings, procedure, accelerometer, role)
    of_rate = rests_of("gyroscope", recordings, procedure, accelerometer, role)
    if of_rate is None or (accelerometer is not None and of_force is None):
        return None
    if accelerometer is None or of_force is None:
        count, errors = len(of_rate.time), np.zeros((BASE_COUNT, BASE_COUNT))
        zeros, none, shared = np.zeros((count, 3)), np.zeros(count), np.zeros((count, 3, BASE_COUNT))
        steady, moved = np.zeros(count, bool), np.zeros(BASE_COUNT)
        return of_rate, GravityAtRests(zeros, zeros, zeros, none, none, errors, shared, steady, moved)
    pair = of_force, of_rate
    keys = [list(zip(r.recording.tolist(), r.span[:, 0].tolist(), strict=True)) for r in pair]
    both = set(keys[0]) & set(keys[1])
    of_force, of_rate = (r.select(np.array([k in both for k in of])) for r, of in zip(pair, keys, strict=True))
    if len(of_rate.time) == 0:
        return None
    return of_rate, gravity_of(recordings, of_force, accelerometer, moved)


def gravity_of(
    recordings: Sequence[Recording], rests: Rests, accelerometer: SensorCalibration, moved: Values | None = None
) -> GravityAtRests:
    """Return gravity at the rests of the accelerometer, in a soak the mean; ``moved``: see ``observed_rests``."""
    root = root_of(accelerometer.parameters.covariance[BASE, BASE])
    moved = np.zeros(BASE_COUNT) if moved is None else moved
    bias, matrix = accelerometer.bias + moved[BIAS], accelerometer.matrix + matrix_of(moved)
    accelerometer = replace(accelerometer, bias=bias, matrix=matrix)
    effects = [e for e in accelerometer.effects if not effect(e.name).moves]

    def force_of(reading: Values) -> Values:
        found = compensate(accelerometer, reading, motion_at_rests(rests, reading), effects)
        for own in rests.soaked & (rests.recording == np.unique(rests.recording[rests.soaked])[:, None]):
            found[own] = found[own].mean(axis=0)  # its attitude is fixed
        return found

    white = float(np.mean(rests.white**2))
    force = force_of(rests.reading)
    u = _unit(force)
    ends, creeping, noise = [], np.zeros(len(u), bool), rests.share.copy()
    for at_start in (True, False):
        reading, share = _near(recordings, rests, at_start=at_start)
        near = _unit(force_of(reading))
        half = (0.5 if at_start else -0.5) * rests.length[:, None]
        steady = _unit(u + half * np.cross(np.radians(rests.creep), u))  # du/dt = -w x u
        creeps = np.linalg.norm(near - steady, axis=1) > SIGNIFICANT_OFFSET_DEVIATIONS * np.sqrt(share * white)
        ends.append(np.where(creeps[:, None], near, steady))
        noise = np.where(creeps, np.maximum(noise, share), noise)
        creeping |= np.linalg.norm(near - u, axis=1) > SIGNIFICANT_OFFSET_DEVIATIONS * np.sqrt(share * white)
    between = [stage.details.scatter_between_rests or 0.0 for stage in accelerometer.stages]
    of_means = rests.own + np.mean(rests.rounding**2, axis=1)
    spread = np.sqrt(noise * white + of_means + max(between, default=0.0) ** 2)
    unsure = np.linalg.norm(force, axis=1) * np.radians(rests.creep_error) * 0.5 * rests.length
    v = rests.reading - accelerometer.bias
    shared = -accelerometer.matrix @ root[BIAS] + np.einsum("mj,ijp->mip", v, root[MATRIX].reshape(3, 3, -1))
    return GravityAtRests(force, ends[0], ends[1], spread, unsure, root, shared, creeping, np.linalg.pinv(root) @ moved)


def _unit(force: Values) -> Values:
    return np.asarray(force / np.linalg.norm(force, axis=1, keepdims=True))


def _near(recordings: Sequence[Recording], rests: Rests, *, at_start: bool) -> tuple[Values, Values]:
    """Return the mean reading next to a move, (m, 3), and its variance over that of a sample, (m,)."""
    reading, share = rests.reading.copy(), rests.share.copy()
    for index in np.unique(rests.recording):
        recording, rows = recordings[index], np.flatnonzero(rests.recording == index)
        size = max(FEWEST_NEAR, round(NEAR_S / recording.interval))
        spans = [(a, min(a + size, b)) if at_start else (max(b - size, a), b) for a, b in rests.span[rows].tolist()]
        means, counts = rest_means(recording, [Rest(a, b) for a, b in spans])
        known = counts > 0
        reading[rows[known]] = means[known]
        share[rows[known]] = variance_of_mean(filter_autocovariance(recording), counts[known])
    return reading, share
