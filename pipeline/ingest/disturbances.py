"""Find samples that neither noise nor motion explains: bus glitches, shocks, and disturbed rests.

**Disturbances.** The motion by the log is removed from each channel by least squares: from a specific force a constant
and gravity in the body (by attitude, or cosine and sine of the angle), from an angular rate a constant and the table's
rate. A sample is disturbed where the residual x differs from the median m of the samples around it by

    |x - m| > 10 s + 1.5 L

where s is the larger of the noise between neighbours and the scatter about m (at rest, the median scatter of the
rests), and L is the largest change by a delay, a clock error or a lever arm within half a second: for a gyroscope the
variation of the table's rate; for an accelerometer g times the angle turned in 0.2 s, and the acceleration at a lever
arm of 0.1 m. So effects that shift a reading in time are no disturbances. The samples around are the same rest, up to 2
s on either side, or half a second of motion. Without a table's log, the motion is taken from the gyroscope, and only
rests are searched; a static recording is searched as a whole.

**Disturbed rests.** A rest by the table's log is cut into pieces of at most 2 s. Its first and last 0.3 s are not used,
because a sensor with a delay reads the move there. A whole piece is left out where

    chi^2 = sum over its n samples and the 3 axes of (x - m)^2 / s^2 > 4 nu  and  > nu + 6 sqrt(2 nu) + 18

with ``nu = 3 (n - 1)``, m the mean of the piece and s the median scatter of an axis over the pieces of the recording
(at least half a count), without the most distant sample, which may be a glitch. Rests by hand are tested in
``pipeline.physics.signal.rests``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from imu_logs.units import STANDARD_GRAVITY
from pipeline.core.records import (
    MEDIAN_SIZE,
    SENSOR_UNITS,
    Index,
    Note,
    Recording,
    Values,
    continuous,
    level_in_body,
    median,
    noise_of_steps,
    rotation_deg,
    runs_of,
)
from pipeline.ingest.quality_flags import GAP

# 10 and 7 standard deviations: below 3e-12 by chance for normal noise; half of L as a margin.
MAX_DEVIATIONS, ALLOWED, JUMP = 10.0, 1.5, 7.0
AROUND_S, FEWEST_AROUND = 0.5, 6  # on either side
REST_S, MIN_REST_MEDIAN_SAMPLES = 2.0, 40  # where the unit rests, more samples make the median more precise
LATE_S = 0.1  # a delay of a low-cost filter or of the log
WINDOWS = 40  # of a recording, to find the usual scatter of its rests
LEVER_M = 0.1  # of the accelerometer from the turn axis, a usual fixture
STILL_DEG = 0.05  # turned within a window that is at rest
STILL_BY_HAND_DEG = 0.5  # integral of a gyroscope's noise and bias
SAME_EVENT = 5  # samples between two that belong to one event; an event of several is widened by 2

PIECE_S, SETTLING_S = 2.0, 0.3  # as the module's description states
AT_REST_DPS = 0.02  # assumed noise of the rates of table encoders at rest
MIN_PIECE_SAMPLES = 4  # samples of a piece
FEWEST_PIECES = 8  # by which the usual scatter is known
RATIO = 4.0  # a scatter twice the usual one
# P(chi^2 > nu + 6 sqrt(2 nu) + 18) < exp(-9) (Laurent and Massart 2000, lemma 1)
SIGNIFICANT_DEVIATIONS, CHI_SQUARE_TAIL = 6.0, 18.0
LARGEST_SHARE = 0.1  # of the pieces


def leave_out_disturbances(recording: Recording, note: Callable[[str, Index, str], Note], most: float) -> Recording:
    """Remove the disturbed samples of a recording, and note them by ``note``, the method of its ``Log``.

    Of more than the share ``most``, a property of the bench, none is removed, and that is noted.
    """
    if not recording.readings or most == 0 or recording.samples < 4 * FEWEST_AROUND:
        return recording
    excess, where = disturbed(recording)
    excess[~recording.valid] = 0.0  # no fit looks at them
    if not excess.any():
        return recording
    rows = np.flatnonzero(np.any(excess > 0, axis=1))
    row, column = np.unravel_index(int(np.argmax(excess)), excess.shape)
    sensor, axis = where[column]
    events = 1 + int(np.count_nonzero(np.diff(rows) > SAME_EVENT))
    worst = f"largest: {sensor} {axis} is {excess[row, column]:.3g} {SENSOR_UNITS[sensor]} beyond what noise and motion"
    worst += f" allow at {recording.time_ns[row] / 1e9:.9g} s"
    places = f"{rows.size} sample{'s' * (rows.size > 1)} in {events} place{'s' * (events > 1)}"
    if rows.size > most * recording.samples:
        detail = (
            f"{places} look like glitches or knocks, more than the share of {most:g} that "
            f"ingest.checks.disturbed_rows leaves out, so all are kept; does the bench vibrate, "
            f"or the log run on another clock? {worst}"
        )
        return recording.noted(note("N-RESTLESS", rows, detail))
    detail = f"{places} left out as glitches or knocks; {worst}"
    return without_rows(recording, rows, note("N-DISTURBED", rows, detail))


def without_rows(recording: Recording, rows: Index, note: Note) -> Recording:
    """Remove samples from a recording, flag a gap before the following sample, and add the note."""
    undisturbed = np.ones(recording.samples, bool)
    undisturbed[rows] = False
    flags = np.zeros(recording.samples, np.uint16) if recording.flags is None else recording.flags.copy()
    flags[np.minimum(rows + 1, recording.samples - 1)] |= GAP
    return replace(recording, flags=flags).select(undisturbed).noted(note)


def disturbed(recording: Recording) -> tuple[Values, list[tuple[str, str]]]:
    """Return the excess of each reading over its limit, (n, c) array, and sensor and axis of the columns.

    Samples next to an event of several samples are given the smallest positive excess, so that they are removed, too.
    """
    found = recording.readings
    where = [(s, axis) for s in found for axis in "xyz"]
    raw = np.concatenate([*found.values()], axis=1)
    excess = np.zeros_like(raw)
    if not np.isfinite(raw).all():
        return excess, where
    step = np.abs(raw[1:] - raw[:-1])
    if not any((s > JUMP * _noise(s)).any() for s in step.T[:, :, None]):  # mostly the first column of a move
        return excess, where
    motion = _Motion(recording)
    values = np.concatenate([motion.unexplained(s, r) for s, r in found.items()], axis=1)
    step = np.abs(values[1:] - values[:-1])
    noise = _noise(step)
    jump = step - JUMP * noise
    columns = np.flatnonzero((jump > 0).any(axis=0))
    change = {sensor: motion.change(sensor) for sensor in dict.fromkeys(where[c][0] for c in columns)}
    for column in columns:
        allowed = change[where[column][0]]
        jumps = np.flatnonzero(jump[:, column] > np.minimum(allowed[:-1], allowed[1:]))
        usual, known = None, False
        for n in np.unique(np.concatenate([jumps, jumps + 1])):  # on either side
            window, resting = motion.around(n)
            around = values[window, column]
            away, least = abs(float(values[n, column] - median(around))), ALLOWED * float(allowed[n])
            if away - MAX_DEVIATIONS * float(noise[column]) - least <= 0.0:
                continue
            if not known:
                usual, known = motion.scatter_of_rests(values[:, column]), True
            scatter = usual if resting and usual is not None else _scatter(around)
            scatter = max(float(noise[column]), scatter)
            excess[n, column] = max(away - MAX_DEVIATIONS * scatter - least, 0.0)
    return (_widened(excess) if excess.any() else excess), where


def _noise(step: Values) -> Values:
    """Return the noise from the differences of neighbours; one count where most are equal: (c,) array."""
    noise = noise_of_steps(step)
    if np.all(noise > 0):
        return noise
    return np.where(noise > 0, noise, np.where(step > 0, step, np.inf).min(axis=0))


def _scatter(values: Values) -> float:
    return MEDIAN_SIZE * float(median(np.abs(values - median(values))))


def _widened(excess: Values) -> Values:
    rows = np.flatnonzero(np.any(excess > 0, axis=1))
    for event in np.split(rows, np.flatnonzero(np.diff(rows) > SAME_EVENT) + 1):
        if len(event) > 2:
            inside = slice(max(event[0] - 2, 0), event[-1] + 3)
            excess[inside] = np.maximum(excess[inside], np.finfo(float).tiny)
    return excess


class _Motion:
    """The motion in a recording: by the table's log, by hand, or at rest."""

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        self.half = max(FEWEST_AROUND, int(np.ceil(AROUND_S / recording.interval)))
        self.long = max(MIN_REST_MEDIAN_SAMPLES, int(np.ceil(REST_S / recording.interval)))
        rate = self._rate()
        self.unknown = rate is None
        by_table = [recording.table_rate, recording.table_angle, recording.table_attitude]
        self.by_hand = rate is not None and recording.role != "static" and all(log is None for log in by_table)
        if rate is None:
            rate = np.zeros((recording.samples, 1))
        self.rate = rate
        self.still = STILL_BY_HAND_DEG if self.by_hand else STILL_DEG

    @cached_property
    def sums(self) -> Sequence[Values]:
        """Angle turned, deg, changes of the rate, deg/s, and of the pull at the lever arm, g, up to each sample."""
        rate, dt = self.rate, self.recording.time_steps
        turned = 0.5 * np.linalg.norm(rate[1:] + rate[:-1], axis=1) * dt
        changed = np.linalg.norm(rate[1:] - rate[:-1], axis=1)
        speed = np.linalg.norm(rate, axis=1)
        pulled = (np.radians(changed) / dt + np.abs(np.diff(np.radians(speed) ** 2))) * LEVER_M / STANDARD_GRAVITY
        return [np.append(0.0, np.cumsum(v)) for v in (turned, changed, pulled)]

    def _rate(self) -> Values | None:
        """Return the rate: (n, 1) or (n, 3) array, deg/s; None if it is unknown."""
        r = self.recording
        if r.table_attitude is not None and np.isfinite(r.table_attitude).all():
            q = continuous(r.table_attitude)
            rate = rotation_deg(q[:-1], q[1:]) / r.time_steps[:, None]
            return np.concatenate([rate, rate[-1:]])
        if r.table_rate is not None:
            return r.table_rate[:, None]
        if r.table_angle is not None:
            rate = np.diff(r.table_angle) / r.time_steps
            return np.append(rate, rate[-1])[:, None]
        if r.role == "static":
            return np.zeros((r.samples, 1))
        return None if r.gyroscope is None else r.gyroscope - median(r.gyroscope)

    def unexplained(self, sensor: str, reading: Values) -> Values:
        """Return the residual of a sensor's readings after the fit of the motion by the log: (n, 3) array."""
        r, columns = self.recording, [np.ones((self.recording.samples, 1))]
        if sensor == "gyroscope":
            columns += [] if self.by_hand or self.unknown else [self.rate]
        elif r.table_attitude is not None and np.isfinite(r.table_attitude).all():
            columns.append(level_in_body(r.table_attitude))
        elif r.table_angle is not None:
            angle = np.radians(r.table_angle)[:, None]
            columns += [np.cos(angle), np.sin(angle)]
        A = np.concatenate(columns, axis=1)
        if A.shape[1] == 1 or not np.isfinite(A).all():
            return reading
        return np.asarray(reading - A @ np.linalg.lstsq(A.T @ A, A.T @ reading, rcond=None)[0])

    def change(self, sensor: str) -> Values:
        """Return the largest change of the residual by the motion: (n,) array, infinite if the motion is unknown."""
        n = np.arange(self.recording.samples)
        low, high = np.maximum(n - self.half, 0), np.minimum(n + self.half, len(n) - 1)
        if self.unknown or (self.by_hand and sensor == "gyroscope"):
            return np.full(len(n), np.inf)
        summed, changed, pulled = self.sums
        if sensor == "gyroscope":
            return np.asarray(changed[high] - changed[low])
        turned = summed[high] - summed[low]
        late = max(1, round(LATE_S / self.recording.interval))
        soon = summed[np.minimum(n + late, n[-1])] - summed[np.maximum(n - late, 0)]
        most = np.max([soon[low], soon, soon[high]], axis=0)
        change = np.radians(np.minimum(most, turned)) + pulled[high] - pulled[low]
        return np.where(turned > STILL_BY_HAND_DEG, np.inf, change) if self.by_hand else change

    def around(self, n: int) -> tuple[slice, bool]:
        """Return the samples around n, of the same rest or in motion the nearest, and whether they are at rest."""
        last, turned = self.recording.samples - 1, self.sums[0]
        for far in (self.long, self.long // 2, self.half):
            a, b = max(n - far, 0), min(n + far, last)
            if turned[b] - turned[a] <= self.still:
                return slice(a, b + 1), True
        a = max(int(np.searchsorted(turned, turned[n] - self.still)), n - self.long)
        b = min(int(np.searchsorted(turned, turned[n] + self.still, "right")), n + self.long)
        if b - a >= self.half:
            return slice(a, b), True
        return slice(max(n - self.half, 0), min(n + self.half, last) + 1), False

    def scatter_of_rests(self, values: Values) -> float | None:
        """Return the median scatter of windows at rest; None if too few of the windows are at rest."""
        windows = [self.around(n) for n in np.linspace(0, len(values) - 1, WINDOWS).astype(int)]
        scatters = [_scatter(values[window]) for window, resting in windows if resting]
        return float(np.median(scatters)) if len(scatters) >= WINDOWS // 4 else None


def leave_out_shaken_rests(recording: Recording, note: Callable[[str, Index, str], Note]) -> Recording:
    """Remove shaken pieces of rests from a recording on a table, and note them as ``N-SHAKEN``."""
    pieces = _pieces(recording)
    if len(pieces) < FEWEST_PIECES:
        return recording
    found = {s: r for s, r in recording.readings.items() if np.isfinite(r).all()}
    if not found:
        return recording
    excess, scatter = _excess(np.concatenate([*found.values()], axis=1), pieces[:, :2])
    shaken = np.any(excess > 0.0, axis=1)
    count = int(shaken.sum())
    if count == 0 or count > max(1.0, LARGEST_SHARE * len(pieces)):
        return recording
    rows = np.concatenate([np.arange(a, b) for a, b in pieces[shaken, 2:]])
    sensor, first = divmod(int(np.argmax(excess.T)), len(pieces))
    worst = f"the {[*found][sensor]} scatters {scatter[first, sensor]:.1f} times as usual"
    detail = f"{count} of {len(pieces)} pieces of rests left out, in which the unit was shaken or leant on;"
    detail += f" {worst} at {recording.time[pieces[first, 0]]:.6g} s"
    return without_rows(recording, rows, note("N-SHAKEN", rows, detail))


def _pieces(recording: Recording) -> Index:
    """Return start and stop of each piece of a rest, and of the samples to remove with it: (p, 4) array."""
    none = np.zeros((0, 4), np.intp)
    if recording.samples < MIN_PIECE_SAMPLES * FEWEST_PIECES or recording.role in ("rests", "static"):
        return none
    if recording.table_rate is not None:
        still = np.abs(recording.table_rate) < AT_REST_DPS
    elif recording.table_angle is not None:
        step = np.abs(np.diff(recording.table_angle, prepend=recording.table_angle[0]))
        still = np.maximum(step, np.append(step[1:], 0.0)) < AT_REST_DPS * recording.interval
    else:
        return none
    size = max(MIN_PIECE_SAMPLES, round(PIECE_S / recording.interval))
    settling = int(np.ceil(SETTLING_S / recording.interval))
    rests = runs_of(still)
    rests = rests[rests[:, 1] - rests[:, 0] >= MIN_PIECE_SAMPLES + 2 * settling]
    length = rests[:, 1] - rests[:, 0] - 2 * settling
    parts = -(-length // size)
    of = np.repeat(np.arange(len(rests)), parts)  # the rest of each piece
    k = np.arange(len(of)) - (np.cumsum(parts) - parts)[of]
    begin, end, length, parts = rests[of, 0], rests[of, 1], length[of], parts[of]
    start, stop = (begin + settling + length * n // parts for n in (k, k + 1))
    pieces = np.stack([start, stop, np.where(k == 0, begin, start), np.where(k + 1 == parts, end, stop)], axis=1)
    return np.asarray(pieces[stop - start >= MIN_PIECE_SAMPLES], np.intp)


def _excess(readings: Values, pieces: Index) -> tuple[Values, Values]:
    """Return the excess of each piece's chi^2, and its scatter over the usual, of s sensors: (n, 3 s) to (p, s)."""
    count = np.diff(pieces, axis=1).astype(float)
    bounds = pieces.ravel()
    centred = np.append(readings - readings.mean(axis=0), np.zeros((1, readings.shape[1])), axis=0)
    sums, squares = (np.add.reduceat(v, bounds, axis=0)[::2] for v in (centred, centred**2))
    about_mean = np.maximum(squares - sums**2 / count, 0.0)
    freedom = 3.0 * (count - 1.0)
    most = np.maximum(RATIO * freedom, freedom + SIGNIFICANT_DEVIATIONS * np.sqrt(2.0 * freedom) + CHI_SQUARE_TAIL)
    usual = median(about_mean / (count - 1.0))

    def chi_squares() -> Values:
        return np.asarray(np.sum((about_mean / usual).reshape(len(pieces), -1, 3), axis=2))

    if usual.all() and np.all((chi := chi_squares()) <= most):
        return np.zeros(chi.shape), np.sqrt(chi / freedom)  # rounding makes the usual scatter larger
    step = np.abs(np.diff(readings, axis=0))
    rounding = np.where(step > 0.0, step, np.inf).min(axis=0) ** 2 / 4.0  # between two counts
    usual = np.maximum(usual, rounding)
    chi = chi_squares()
    for piece, sensor in np.argwhere(chi > most):
        (start, stop), of_sensor = pieces[piece], slice(3 * sensor, 3 * sensor + 3)
        own = readings[start:stop, of_sensor]
        squares = np.sum((own - own.mean(axis=0)) ** 2 / usual[of_sensor], axis=1)
        chi[piece, sensor] -= float((squares * count[piece] / (count[piece] - 1.0)).max())
    return np.maximum(chi - most, 0.0), np.sqrt(chi / freedom)
