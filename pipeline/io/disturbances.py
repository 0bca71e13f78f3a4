"""Samples that neither noise nor the table's motion can have made: a bus that glitched, a knock at the bench.

First what the log explains is taken off each channel, by least squares: of a specific force a constant and gravity in
the body (by attitude, or cosine and sine of the angle), of an angular rate a constant and the table's rate. A sample is
disturbed where what is left leaves the median m of the samples around it by

    |x - m| > 10 s + 1.5 L

where s is the larger of the noise of neighbours (``median |x[n+1] - x[n]| / 0.9539``) and of the scatter about m
(``1.4826 median |x - m|``; at rest that of most rests), and L is what a delay, a clock or a lever arm can do within
half a second: for a gyroscope the variation of the table's rate; for an accelerometer g times the angle turned in
0.2 s, and what 0.1 m of lever arm adds. So effects that shift a reading in time disturb nothing. The samples around are
those of the same rest, up to 2 s on either side, or half a second of motion.

Without a log, motion is that of the gyroscope, and only rests are looked at; of a static recording all of it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.io.quality_flags import GAP, UNIT_NAMES
from pipeline.records import conjugate_product, continuous, level_in_body, noise_of_steps

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from pipeline.records import Note, Recording

    Array = NDArray[np.float64]

BEYOND, ALLOWED, JUMP = 10.0, 1.5, 7.0
MEDIAN_SIZE = 1.4826
AROUND_S, FEWEST_AROUND = 0.5, 6  # on either side
REST_S, FEWEST_OF_REST = 2.0, 40
LATE_S = 0.1
WINDOWS = 40
LEVER_M, STANDARD_GRAVITY = 0.1, 9.80665
STILL_DEG = 0.05  # turned within a window that is at rest
STILL_BY_HAND_DEG = 0.5  # as a gyroscope with noise and bias adds it up
SAME_EVENT = 5  # samples between two that belong to one event; an event of several is widened by 2


def leave_out_disturbances(
    recording: Recording, note: Callable[[str, NDArray[np.intp], str], Note], largest_share: float
) -> Recording:
    """Return a recording without its disturbed samples, each event noted.

    Parameters
    ----------
    recording : Recording
    note : callable
        ``ChannelTable.note`` of its file.
    largest_share : float
        Of the samples. Where more would have to go, all are kept, and that is noted: it is how the bench behaves.
    """
    silent = recording.accelerometer is None and recording.gyroscope is None
    if silent or largest_share == 0 or recording.samples < 4 * FEWEST_AROUND:
        return recording
    excess, where = disturbed(recording)
    excess[~recording.valid] = 0.0  # no fit looks at them
    rows = np.flatnonzero(np.any(excess > 0, axis=1))
    if not rows.size:
        return recording
    row, column = np.unravel_index(int(np.argmax(excess)), excess.shape)
    sensor, axis = where[column]
    events = 1 + int(np.count_nonzero(np.diff(rows) > SAME_EVENT))
    worst = (
        f"largest: {sensor} {axis} is {excess[row, column]:.3g} {UNIT_NAMES[sensor]} beyond what noise and motion "
        f"allow at {recording.time_ns[row] / 1e9:.9g} s"
    )
    places = f"{rows.size} sample{'s' * (rows.size > 1)} in {events} place{'s' * (events > 1)}"
    if rows.size > largest_share * recording.samples:
        detail = (
            f"{places} look like glitches or knocks, more than the share of {largest_share:g} that "
            f"ingest.checks.disturbed_rows leaves out, so all are kept; does the bench vibrate, "
            f"or the log run on another clock? {worst}"
        )
        return replace(recording, notes=(*recording.notes, note("N-RESTLESS", rows, detail)))
    detail = f"{places} left out as glitches or knocks; {worst}"
    return without_rows(recording, rows, note("N-DISTURBED", rows, detail))


def without_rows(recording: Recording, rows: NDArray[np.intp], note: Note) -> Recording:
    """Return a recording without some samples, a gap before what follows them, and with the note that says so."""
    sound = np.ones(recording.samples, bool)
    sound[rows] = False
    flags = np.zeros(recording.samples, np.uint16) if recording.flags is None else recording.flags.copy()
    flags[np.minimum(rows + 1, recording.samples - 1)] |= GAP
    kept = replace(recording, flags=flags).select(sound)
    return replace(kept, notes=(*kept.notes, note))


def disturbed(recording: Recording) -> tuple[Array, list[tuple[str, str]]]:
    """Return by how much each reading exceeds what is allowed, (n, c) array, and sensor and axis of the columns.

    Samples around an event of several have the excess of a rounding error, so that they go with it.
    """
    found = [(s, r) for s in UNIT_NAMES if (r := recording.reading(s)) is not None]
    where = [(s, axis) for s, _ in found for axis in "xyz"]
    raw = np.concatenate([r for _, r in found], axis=1)
    excess = np.zeros_like(raw)
    if not np.isfinite(raw).all():
        return excess, where
    step = np.abs(np.diff(raw, axis=0))
    if not np.any(step > JUMP * _noise(step)):
        return excess, where
    motion = _Motion(recording)
    values = np.concatenate([motion.unexplained(s, r) for s, r in found], axis=1)
    change = {sensor: motion.change(sensor) for sensor, _ in found}
    step = np.abs(np.diff(values, axis=0))
    noise = _noise(step)
    jump = step - JUMP * noise
    for column in np.flatnonzero((jump > 0).any(axis=0)):
        allowed = change[where[column][0]]
        jumps = np.flatnonzero(jump[:, column] > np.minimum(allowed[:-1], allowed[1:]))
        usual = motion.scatter_of_rests(values[:, column]) if jumps.size else None
        for n in _beside(jumps, recording.samples):
            window, resting = motion.around(n)
            around = values[window, column]
            middle = float(np.median(around))
            scatter = usual if resting and usual is not None else _scatter(around)
            scatter = max(float(noise[column]), scatter)
            off = abs(float(values[n, column]) - middle) - BEYOND * scatter - ALLOWED * float(allowed[n])
            excess[n, column] = max(off, 0.0)
    return _widened(excess), where


def _noise(step: Array) -> Array:
    """Return the noise by the differences of neighbours; where most are equal, one count: (c,) array."""
    noise = noise_of_steps(step)
    if np.all(noise > 0):
        return noise
    return np.where(noise > 0, noise, np.where(step > 0, step, np.inf).min(axis=0))


def _scatter(values: Array) -> float:
    return MEDIAN_SIZE * float(np.median(np.abs(values - np.median(values))))


def _beside(jumps: NDArray[np.intp], samples: int) -> NDArray[np.intp]:
    """Return the samples on either side of each jump."""
    return np.unique(np.clip(np.concatenate([jumps, jumps + 1]), 0, samples - 1))


def _widened(excess: Array) -> Array:
    rows = np.flatnonzero(np.any(excess > 0, axis=1))
    for event in np.split(rows, np.flatnonzero(np.diff(rows) > SAME_EVENT) + 1):
        if len(event) > 2:
            inside = slice(max(event[0] - 2, 0), event[-1] + 3)
            excess[inside] = np.maximum(excess[inside], np.finfo(float).tiny)
    return excess


class _Motion:
    """What a recording says of its motion: by the table's log, by hand, or at rest."""

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        self.half = max(FEWEST_AROUND, int(np.ceil(AROUND_S / recording.interval)))
        self.long = max(FEWEST_OF_REST, int(np.ceil(REST_S / recording.interval)))
        rate = self._rate()
        self.unknown = rate is None
        self.by_hand = rate is not None and recording.table_rate is None and not self._logs() and not self._static()
        if rate is None:
            rate = np.zeros((recording.samples, 1))
        self.rate = rate
        self.still = STILL_BY_HAND_DEG if self.by_hand else STILL_DEG
        dt = np.diff(recording.time)
        turned = 0.5 * np.linalg.norm(rate[1:] + rate[:-1], axis=1) * dt
        changed = np.linalg.norm(np.diff(rate, axis=0), axis=1)
        speed = np.radians(np.linalg.norm(rate, axis=1))
        pulled = (np.radians(changed) / dt + np.abs(np.diff(speed**2))) * LEVER_M / STANDARD_GRAVITY
        self.turned, self.changed, self.pulled = (
            np.concatenate([[0.0], np.cumsum(v)]) for v in (turned, changed, pulled)
        )

    def _logs(self) -> bool:
        return self.recording.table_angle is not None or self.recording.table_attitude is not None

    def _static(self) -> bool:
        return self.recording.role == "static"

    def _rate(self) -> Array | None:
        """Return the rate: (n, 1) or (n, 3) array, deg/s; None where nothing tells it."""
        r = self.recording
        if r.table_attitude is not None and np.isfinite(r.table_attitude).all():
            q = continuous(r.table_attitude)
            rate = np.degrees(2.0 * conjugate_product(q[:-1], q[1:])) / np.diff(r.time)[:, None]
            return np.concatenate([rate, rate[-1:]])
        if r.table_rate is not None:
            return r.table_rate[:, None]
        if r.table_angle is not None:
            rate = np.diff(r.table_angle) / np.diff(r.time)
            return np.append(rate, rate[-1])[:, None]
        if self._static():
            return np.zeros((r.samples, 1))
        return None if r.gyroscope is None else r.gyroscope - np.median(r.gyroscope, axis=0)

    def unexplained(self, sensor: str, reading: Array) -> Array:
        """Return what the log does not explain of a sensor's readings: (n, 3) array."""
        r, columns = self.recording, [np.ones((self.recording.samples, 1))]
        if sensor == "gyroscope":
            columns += [] if self.by_hand or self.unknown else [self.rate]
        elif r.table_attitude is not None and np.isfinite(r.table_attitude).all():
            columns.append(level_in_body(r.table_attitude))
        elif r.table_angle is not None:
            angle = np.radians(r.table_angle)[:, None]
            columns += [np.cos(angle), np.sin(angle)]
        A = np.hstack(columns)
        if A.shape[1] == 1 or not np.isfinite(A).all():
            return reading
        return np.asarray(reading - A @ np.linalg.lstsq(A, reading, rcond=None)[0])

    def change(self, sensor: str) -> Array:
        """Return by how much the motion can change what is unexplained: (n,) array, infinite where nothing is known."""
        n = np.arange(self.recording.samples)
        low, high = np.maximum(n - self.half, 0), np.minimum(n + self.half, len(n) - 1)
        if self.unknown or (self.by_hand and sensor == "gyroscope"):
            return np.full(len(n), np.inf)
        if sensor == "gyroscope":
            return np.asarray(self.changed[high] - self.changed[low])
        turned = self.turned[high] - self.turned[low]
        late = max(1, round(LATE_S / self.recording.interval))
        soon = self.turned[np.minimum(n + late, n[-1])] - self.turned[np.maximum(n - late, 0)]
        most = np.max([soon[low], soon, soon[high]], axis=0)
        change = np.radians(np.minimum(most, turned)) + self.pulled[high] - self.pulled[low]
        return np.where(turned > STILL_BY_HAND_DEG, np.inf, change) if self.by_hand else change

    def around(self, n: int) -> tuple[slice, bool]:
        """Return the samples of the same rest, or in motion the nearest ones, and whether they are at rest."""
        last = self.recording.samples - 1
        for far in (self.long, self.long // 2, self.half):
            a, b = max(n - far, 0), min(n + far, last)
            if self.turned[b] - self.turned[a] <= self.still:
                return slice(a, b + 1), True
        a = max(int(np.searchsorted(self.turned, self.turned[n] - self.still)), n - self.long)
        b = min(int(np.searchsorted(self.turned, self.turned[n] + self.still, "right")), n + self.long)
        if b - a >= self.half:
            return slice(a, b), True
        return slice(max(n - self.half, 0), min(n + self.half, last) + 1), False

    def scatter_of_rests(self, values: Array) -> float | None:
        """Return the scatter in most rests, by some windows over the recording; None where hardly any is at rest."""
        windows = [self.around(n) for n in np.linspace(0, len(values) - 1, WINDOWS).astype(int)]
        scatters = [_scatter(values[window]) for window, resting in windows if resting]
        return float(np.median(scatters)) if len(scatters) >= WINDOWS // 4 else None
