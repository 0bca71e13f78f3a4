"""Check that table angle, rate, attitude, gravity, gyroscope and time do not contradict each other.

Scales are checked first (``pipeline.checks.reference_scale``), then delays, then single samples and stretches.
Gain and bias of the gyroscope for these checks come from the unit's turns,
where they agree. A difference that no effect of the catalogue explains within its configured limit is refused. One
within these limits that exceeds noise and the table's stated accuracy gets the note ``N-REFERENCE``.

The delay d between the sensor and the table's log minimises the variance S(d) of the difference of two rates, both
averaged over steps of at least a twentieth of a second. If equal steps of a table give several such minima, the
smallest |d| is taken. The recording determines d to the interval in which

    n log(S(d) / S_min) <= 5 sqrt(4 d_max)

where n is the number of steps and d_max the largest delay tried, in steps: a window that is moved by d_max exchanges
2 d_max differences at each end, whose sum of squares has the standard deviation ``sqrt(4 d_max)`` in units of S_min.
A turn at one rate determines no delay: its interval covers every delay tried.

The effects ``time_offset`` and ``low_pass_lag`` allow a delay; for the sensor, ``clock_rate`` allows the drift of its
clock since power-on. All recordings of a unit have one offset and one clock. A recording is refused only if its whole
interval contradicts this.

Find samples and stretches in which one channel of a table's log contradicts all others.

A channel w contradicts a value c of another one (at a sample, or over an interval) where

    c > w_max + m b + d   or   c < w_min - m b - d

where b is the largest second difference of w near c: a short move may reach its rate between two samples of w. If w is
a channel of the table, w_min and w_max are both the mean of its two nearest values, and m = 3. If w is a sensor, they
are its extremes within the largest plausible delay, and m = 1. Stretches of 16 samples and of a twelfth of the
recording contradict each other where

    |sum (c - w) dt| > d_s + T range(w) + 3 sqrt(sum (dc dt / 2)^2 + sum (dw dt / 2)^2)

with the largest delay T. The last term is the error of a sum over a rate that changes between its samples. Noise and
the limits of the catalogue's effects allow d and d_s. A difference that exceeds only noise and the stated accuracy is
a doubt.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.checks.evidence import (
    LEAST_RATE_DPS,
    OPPOSITE,
    Channel,
    ChannelLimits,
    alike,
    axis_index,
    gravity_turned,
    largest_but,
    of_gravity,
    of_rate,
    of_table,
    place,
    quantiles,
    ratio_quantiles,
    refusal,
    spin,
)
from pipeline.checks.reference_scale import (
    check_intervals,
    check_scale_of_motion,
    check_scale_of_turn,
    doubt_of_angle,
    doubt_of_scale,
)
from pipeline.core.records import Index, Mask, Note, Recording, Values, median, once
from pipeline.core.settings import Settings

ByGravity = Callable[[], Channel | None]
Stretches = tuple[str, int, int, int]  # text with the places {name} and {names}; number of rows, first and last sample


BY_NOISE = 10.0  # standard deviations, as of disturbances (pipeline.ingest.disturbances)
BENDS = 3.0  # times the second difference: in a move as long as one interval, it is a quarter of the rate
SHORT_STRETCH_SAMPLES, LONG_STRETCHES = 16, 12  # samples of a short stretch; long ones in a recording
MANY_SAMPLES = 20  # samples, more than a spike or a jump changes
RESOLVED_DEG = 1e-3  # of a logged angle: the tenth of a common encoder's 0.01 deg
CURVED = 0.02  # relative error by nonlinearities of a gyroscope's gain that is fitted to the same turn
OF_SENSOR = ("gyroscope", "gravity")
PHASE = 0.2  # relative error of gravity's phase over some degrees: twice 0.1 g of bias
MIN_REFERENCE_SAMPLES = 32  # samples, two short stretches
# of the usual gain, which the axis turned about reaches; of an interval, between its end and its mean
MIN_SHARE_OF_USUAL_GAIN = 0.5
SAME_GAIN = 0.1  # relative difference between gains of one gyroscope in two turns
FURTHEST, FURTHEST_S = 25, 10.0  # samples of delay that are tried at least, and s at most
DELAY_STEP_S = 0.05  # step in which delays are tried; a parabola finds what lies between
CLOCKS = 4001  # rates of the clock that are tried: 5 us in 1 s where it may be off by 1 %
RESTING_RATE_SHARE = 0.01  # of the fastest rate of a turn, below which the table rests
QUARTER = 0.25  # of an interval, within which a delay between samples is known
BETTER = 0.5  # share of the power of the difference of two signals below which they are alike
NEARLY = 0.1  # share of the power by which one delay has to be better than a smaller one
SURE_END_DEVIATIONS = 5.0  # standard deviations of the sum of squares that the ends of the window add
ALIGN = "align the table's log with the sensor's rows, or give it a separate time column (ingest=table_log)"


class ChannelComparison:
    """The channels of one recording, compared with each other."""

    def __init__(self, recording: Recording, channels: Sequence[Channel], limits: ChannelLimits) -> None:
        self.recording, self.channels, self.limits = recording, channels, limits
        self.dt = recording.time_steps
        self.interval = recording.interval
        self._parts: dict[str, Values] = {}  # of the sums, by channel
        self._found: dict[tuple[frozenset[str], int], Values] = {}  # by two channels, in any order, and size
        self.known = np.ones(len(self.dt), bool)  # intervals in which every channel is known
        for channel in channels:
            finite = np.isfinite(channel.low)
            self.known &= finite if channel.of_intervals else finite[1:] & finite[:-1]

    def find(self, claim: Channel, by_gravity: ByGravity) -> tuple[bool, Note] | None:
        """Return whether no effect of the catalogue explains a contradiction, and the note on it; None without one.

        ``by_gravity``: called where the others contradict the table's angle, with which alone gravity is compared.
        """
        if claim.name in OF_SENSOR:
            return None
        others = [c for c in self.channels if c is not claim]
        found = self._contradiction(claim, others)
        if found and claim.name == "table_angle" and (gravity := by_gravity()):
            others.append(gravity)
            found = self._contradiction(claim, others)
        if not found:
            return None
        name, *names = (self.limits.column(self.recording, c.name) for c in (claim, *others))
        gross, (text, count, first, last) = found
        t, detail = self.recording.time, text.format(name=name, names=" and ".join(names))
        return gross, Note("N-REFERENCE", count, 0, 0, detail, float(t[first]), float(t[last]))

    def _contradiction(self, claim: Channel, others: list[Channel]) -> tuple[bool, Stretches] | None:
        """Return whether no effect explains the contradiction of a channel to all others, and its place."""
        alone = all(w.name in OF_SENSOR for w in others)
        rows, doubtful = list[tuple[Values, Values]](), True  # effects allow at least what the stated accuracy allows
        while len(rows) < len(others) and doubtful:
            rows.append(self._rows(claim, others[len(rows)], alone=alone))
            doubtful = bool((np.minimum.reduce([doubt for _, doubt in rows]) > 0.0).any())
        gross, doubt = zip(*rows, strict=True)
        if found := (doubtful and self._worst_row(claim, others, gross)) or self._worst_stretch(claim, others):
            return True, found
        found = self._worst_row(claim, others, doubt) if doubtful else None
        return (False, found) if found else None

    def _rows(self, claim: Channel, other: Channel, *, alone: bool) -> tuple[Values, Values]:
        """Return the excess of each value over what another channel allows: by effects, by accuracy: (m,) arrays."""
        limits, of_sensor = self.limits, other.name in OF_SENSOR
        reach = max(int(np.ceil(limits.late_s / self.interval)), 1) if of_sensor else 1
        low, high, bend = _near(other, claim, reach)
        if other.name == "gravity":  # a move between two samples of the angle may be split between two of the sensor
            low, high, bend = np.minimum(2.0 * low, 0.0), np.maximum(2.0 * high, 0.0), np.zeros_like(bend)
        size = np.maximum(np.abs(low), np.abs(high))
        size[np.isinf(size)] = np.nan
        noise = BY_NOISE * (claim.noise + other.noise) + RESOLVED_DEG / self.interval
        gross, stated = limits.rate * size, limits.rate_stated * size
        if claim.of_intervals:
            gross += limits.angle_deg / self.interval
            stated += limits.angle_stated_deg / self.interval
        if of_sensor:
            share = limits.rate + limits.gain
            gross += share * size + limits.offset_dps
            stated += (share if alone else CURVED) * size + limits.offset_dps
        with np.errstate(invalid="ignore"):
            off = np.maximum(claim.low - high, low - claim.high) - (bend if of_sensor else BENDS * bend) - noise
            gross, stated = off - gross, off - stated
        return np.where(np.isfinite(gross), gross, -np.inf), np.where(np.isfinite(stated), stated, -np.inf)

    def _worst_row(self, claim: Channel, others: list[Channel], excess: Sequence[Values]) -> Stretches | None:
        least = np.min(excess, axis=0)
        rows = np.flatnonzero(least > 0.0)
        if not rows.size:
            return None
        worst = int(np.argmax(least))
        group = rows[np.abs(rows - worst) <= SHORT_STRETCH_SAMPLES]
        low = others[int(np.argmin([e[worst] for e in excess]))].low
        first, last = int(group[0]), int(group[-1]) + (1 if claim.of_intervals else 0)
        looks = "it looks like a spike or a jump"
        if rows.size > MANY_SAMPLES:
            looks = "does it follow this motion, or is it frozen, reversed in time, or of another recording?"
        text = (
            f"{{name}} {'turns at' if claim.of_intervals else 'is'} {claim.low[worst]:.4g} deg/s in "
            f"{place(self.recording, first, last)}, while {{names}} show {low[min(worst, len(low) - 1)]:.4g} deg/s "
            f"({rows.size} such {'place' if rows.size == 1 else 'places'}): {looks}"
        )
        return text, rows.size, first, last

    def _worst_stretch(self, claim: Channel, others: list[Channel]) -> Stretches | None:
        n = len(self.dt)
        for size in sorted({SHORT_STRETCH_SAMPLES, max(n // LONG_STRETCHES, SHORT_STRETCH_SAMPLES)}):
            starts, excess = np.arange(0, max(n - size // 2, 1), size), list[Values]()
            for other in others:
                excess.append(self._excess(claim, other, size, starts))
                if (excess[-1] <= 0.0).all():
                    break
            else:
                off = np.min(excess, axis=0)
                rows = np.flatnonzero(off > 0.0)
                if not rows.size:
                    continue
                worst = int(np.argmax(off))
                nearest = others[int(np.argmin([e[worst] for e in excess]))]
                turned, shown = (self._sums(channel, starts)[0, worst] for channel in (claim, nearest))
                first, last = int(starts[rows[0]]), min(int(starts[rows[-1]]) + size, n)
                part = getattr(self.recording, claim.name)[first : last + 1]
                text = (
                    f"{{name}}{' stays the same and' if np.all(part == part[0]) else ''} contradicts {{names}} in "
                    f"{place(self.recording, first, last)}: it turns by {turned:.4g} deg and they by {shown:.4g} deg "
                    f"in one of {rows.size} such stretches"
                )
                return text, rows.size, first, last
        return None

    def _excess(self, claim: Channel, other: Channel, size: int, starts: Index) -> Values:
        """Return by how much two channels differ in each stretch beyond what is allowed: (k,) array, deg."""
        limits, key = self.limits, (frozenset((claim.name, other.name)), size)
        if key in self._found:
            return self._found[key]
        (turned, total, bends), (shown, shown_total, shown_bends) = (self._sums(c, starts) for c in (claim, other))
        most = np.maximum(total, shown_total)
        allowed = limits.rate * most + BENDS * np.sqrt(bends + shown_bends) + RESOLVED_DEG
        if claim.of_intervals or other.of_intervals:
            allowed += limits.angle_deg
        if other.name in OF_SENSOR:
            length = np.add.reduceat(np.where(self.known, self.dt, 0.0), starts)
            rate = np.where(self.known, other.low if other.of_intervals else other.low[1:], 0.0)
            swing = np.maximum.reduceat(rate, starts) - np.minimum.reduceat(rate, starts)
            share = PHASE if other.name == "gravity" else limits.gain
            noise = BY_NOISE * other.noise * self.interval * (1.0 if other.of_intervals else np.sqrt(size))
            allowed += share * most + limits.late_s * swing + limits.offset_dps * length + noise
        self._found[key] = np.abs(turned - shown) - allowed
        return self._found[key]

    def _sums(self, channel: Channel, starts: Index) -> Values:
        """Return for each stretch: angle, sum of its magnitudes, and squared error by bends: (3, k) array."""
        if channel.name not in self._parts:
            turned, bend = np.where(self.known, channel.turned, 0.0), np.zeros(len(self.dt))
            if not channel.of_intervals:
                steps = np.diff(np.where(np.isfinite(channel.low), channel.low, 0.0))
                bend = (np.where(self.known, 0.5 * steps, 0.0) * self.dt) ** 2
            self._parts[channel.name] = np.stack([turned, np.abs(turned), bend])
        return np.asarray(np.add.reduceat(self._parts[channel.name], starts, axis=1))


def _near(other: Channel, claim: Channel, reach: int) -> tuple[Values, Values, Values]:
    """Return smallest and largest value, and largest second difference, of a channel near each value of another."""
    m, n = len(other.low), len(claim.low)
    before, after = reach, reach + m - n  # n - 1 intervals next to n samples, or the reverse
    bend = np.zeros(m)
    with np.errstate(invalid="ignore"):
        bend[1:-1] = np.abs(other.low[2:] - 2.0 * other.low[1:-1] + other.low[:-2])
        mean = 0.5 * (other.low[1:] + other.low[:-1])
    bend[np.isnan(bend)] = np.inf
    bend = _slide(bend, before, after, n, np.maximum)
    if m == n or other.name in OF_SENSOR:
        low = _slide(other.low, before, after, n, np.minimum)
        return low, _slide(other.high, before, after, n, np.maximum), bend
    middle = mean if len(mean) == n else np.concatenate([[np.inf], mean, [np.inf]])
    return middle, middle, bend


def _slide(values: Values, before: int, after: int, count: int, better: np.ufunc) -> Values:
    """Return minimum or maximum of the values from ``k - before`` to ``k + after``, by doubling: (count,) array."""
    width, have = before + after + 1, 1
    beyond = np.inf if better is np.minimum else -np.inf
    out = np.concatenate([np.full(before, beyond), values, np.full(after + max(count - len(values), 0), beyond)])
    while have < width:
        step = min(have, width - have)
        out = better(out[:-step], out[step:])
        have += step
    return np.asarray(out[:count])


@dataclass(frozen=True)
class Delay:
    """Delay of the sensor against the table's log, s, positive if late, and the interval that the recording allows."""

    best: float
    low: float
    high: float

    def nearest(self, value: float) -> float:
        """Return the delay in the interval nearest to a value, s."""
        return min(max(value, self.low), self.high)


def check_turns(recordings: Sequence[Recording], settings: Settings) -> tuple[list[Recording], dict[str, Delay]]:
    """Return the recordings of a unit with notes on the reference of their turns, and the delay of the sensor in each.

    Signs and directions are not compared: this check precedes that of the mounting, which wrong units would mislead.
    ``IngestError``: channels of a turn contradict each other by more than an effect of the catalogue explains.
    """
    limits, turns = ChannelLimits.of(settings), _turns(recordings)
    for recording in turns:
        check_scale_of_turn(recording, limits)
    check_intervals([r for r in recordings if r.samples >= MIN_REFERENCE_SAMPLES], limits)
    gyroscope = _Gyroscope(turns)
    found = {r.name: _check_turn(r, gyroscope, limits) for r in turns}
    return _with_notes(recordings, found), {name: delay for name, (_, delay) in found.items() if delay is not None}


def _turns(recordings: Sequence[Recording]) -> list[Recording]:
    logged = [r for r in recordings if r.samples >= MIN_REFERENCE_SAMPLES and r.role != "static"]
    return [r for r in logged if r.axis is not None and not (r.table_rate is None and r.table_angle is None)]


def check_motion(recordings: Sequence[Recording], delays: Mapping[str, Delay], settings: Settings) -> list[Recording]:
    """Return the recordings of a unit with notes on the reference of held-out motion.

    ``recordings``: with their turns by the convention; ``delays``: of the sensor in them. ``IngestError``: channels of
    held-out motion contradict each other, or the delay of a recording contradicts those of the others.
    """
    limits, gyroscope = ChannelLimits.of(settings), _Gyroscope(_turns(recordings))
    logged = [r for r in recordings if r.samples >= MIN_REFERENCE_SAMPLES and r.role != "static"]
    moved = [r for r in logged if r.axis is None and not (r.table_rate is None and r.table_attitude is None)]
    for turn in (r for r in logged if r.axis is not None and r.table_angle is None and r.table_rate is None):
        _check_attitude_of_turn(turn, limits)
    found = {r.name: _check_motion(r, gyroscope, limits) for r in moved}
    late = {**delays, **{name: delay for name, (_, delay) in found.items() if delay is not None}}
    _check_delays([(r, late[r.name]) for r in recordings if r.name in late], limits)
    return _with_notes(recordings, found)


def _with_notes(
    recordings: Sequence[Recording], found: Mapping[str, tuple[list[Note], Delay | None]]
) -> list[Recording]:
    return [r.noted(*found[r.name][0]) if r.name in found and found[r.name][0] else r for r in recordings]


class _Gyroscope:
    """Rough gain matrix and bias of a gyroscope, by the turns of a unit."""

    def __init__(self, turns: Sequence[Recording]) -> None:
        self.slopes: dict[str, Values] = {}  # of each turn: (2, 3), gain and bias of each axis; zeros if unknown
        found: list[tuple[int, float, Values, Values]] = []  # axis turned about, usual fastest rate, gain and bias
        for recording in turns:
            rate = recording.logged_rate
            if rate is None or recording.gyroscope is None:
                continue
            gain, bias = self.slopes[recording.name] = _slopes(recording)
            if np.all(gain):
                turned = int(np.argmax(np.abs(gain)))  # not the stated axis: the mounting is checked later
                found.append((turned, float(quantiles(np.abs(rate), 0.9)[0]), gain, bias))
        gains = [abs(gain[axis]) for axis, _, gain, _ in found]
        self.usual = float(median(np.array(gains))) if len(gains) > 2 else 1.0
        self.matrix = self.usual * np.eye(3)
        for axis in range(3):
            fitting = [f for f in found if f[0] == axis and abs(abs(f[2][axis]) / self.usual - 1.0) <= SAME_GAIN]
            if fitting:
                self.matrix[:, axis] = max(fitting, key=lambda f: f[1])[2]
        self.bias = median(np.array([bias for *_, bias in found])) if found else None

    def along(self, recording: Recording, axis: int) -> Values | None:
        """Return the rate about a turn axis with the bias of this recording: (n,) array, deg/s."""
        rate, slopes = recording.logged_rate, self.slopes.get(recording.name)
        if recording.gyroscope is None or rate is None or slopes is None:
            return None
        reading, gains = recording.gyroscope[:, axis], np.abs(slopes[0]) / self.usual
        if abs(gains[axis] - 1.0) <= SAME_GAIN:
            return np.asarray((reading - slopes[1, axis]) / slopes[0, axis])
        if max(gains) > MIN_SHARE_OF_USUAL_GAIN > gains[axis]:
            return None  # another axis turns: the check of the mounting decides
        gain = self.matrix[axis, axis]
        bias = np.median(reading - gain * rate) if self.bias is None else self.bias[axis]
        return np.asarray((reading - float(bias)) / gain)

    def vector(self, recording: Recording) -> Values | None:
        """Return the angular rate: (n, 3) array, deg/s; None if no turn determines the bias."""
        if recording.gyroscope is None or self.bias is None:
            return None
        return np.asarray((recording.gyroscope - self.bias) @ np.linalg.inv(self.matrix).T)


@once
def _slopes(recording: Recording) -> Values:
    """Return gain and bias of each axis of a gyroscope by the table's rate: (2, 3) array; zeros if it is constant."""
    reading, rate = np.asarray(recording.gyroscope), np.asarray(recording.logged_rate)
    change = rate - median(rate)
    if largest_but(np.abs(change), 100) < LEAST_RATE_DPS:
        return np.zeros((2, 3))
    gain = ratio_quantiles(reading - median(reading), change, 100, 0.1, 0.5)[0]
    return np.stack([gain, median(reading - gain * rate[:, None])])


def _check_turn(recording: Recording, gyroscope: _Gyroscope, limits: ChannelLimits) -> tuple[list[Note], Delay | None]:
    channels, axis = [*of_table(recording)], axis_index(recording)
    if any(alike(c.turned, channels[0].turned) < -OPPOSITE for c in channels[1:]):
        rate, angle = (limits.column(recording, name) for name in ("table_rate", "table_angle"))
        problem = f"{rate} and the change of {angle} have opposite signs"
        hint = f"negate the column of one, or leave {rate} out (ingest.csv.columns.table_rate=null)"
        raise refusal(recording, "reference_contradiction", problem, hint)
    measured = gyroscope.along(recording, axis)
    if measured is not None:
        channels.append(of_rate(recording, "gyroscope", measured, recording.valid))

    def by_gravity() -> Channel | None:
        phase = gravity_turned(recording)
        return None if phase is None else of_gravity(recording, phase, channels)

    notes, delay = _compare(recording, channels, limits, by_gravity)
    ends = float(recording.time[0]), float(recording.time[-1])
    for doubt in filter(None, (doubt_of_scale(recording, limits), doubt_of_angle(recording, limits))):
        notes.append(Note("N-REFERENCE", recording.samples, 0, 0, doubt, *ends))
    return notes, delay


def _check_motion(
    recording: Recording, gyroscope: _Gyroscope, limits: ChannelLimits
) -> tuple[list[Note], Delay | None]:
    vector = gyroscope.vector(recording)
    size = None if vector is None else np.linalg.norm(vector, axis=1)
    check_scale_of_motion(recording, size, limits)
    channels = [*of_table(recording)]
    if size is not None:
        channels.append(of_rate(recording, "gyroscope", size, recording.valid))
    found = _compare(recording, channels, limits)
    if vector is not None and recording.table_attitude is not None:
        _check_directions(recording, vector, limits)
    return found


def _compare(
    recording: Recording, channels: Sequence[Channel], limits: ChannelLimits, by_gravity: ByGravity = lambda: None
) -> tuple[list[Note], Delay | None]:
    """Compare each channel of the table's log with all others; return notes, and the delay of the sensor."""
    if len(channels) < 2:
        return [], None
    delay = _delay_of(recording, channels, limits)
    late = abs(delay.nearest(0.0)) if delay else 0.0
    if late > limits.late_s:  # a clock that drifts: it adds nearly the same delay throughout the recording
        limits = replace(limits, late_s=late + limits.late_s)
    notes, comparison = [], ChannelComparison(recording, channels, limits)
    for gross, note in filter(None, (comparison.find(channel, by_gravity) for channel in channels)):
        if gross:
            hint = "correct or leave out these rows of the table's log, or record again"
            raise refusal(recording, "reference_contradiction", note.detail, hint)
        notes.append(note)
    return notes, delay


def _check_attitude_of_turn(recording: Recording, limits: ChannelLimits) -> None:
    """Compare the attitude of a turn without angle and rate with the gyroscope, whose bias is its median at rest."""
    if recording.table_attitude is None or recording.gyroscope is None:
        return
    speed = np.linalg.norm(spin(recording), axis=1) / recording.time_steps
    fastest = float(quantiles(speed, 0.99)[0])
    moving, resting = speed > MIN_SHARE_OF_USUAL_GAIN * fastest, speed < RESTING_RATE_SHARE * fastest
    if min(np.count_nonzero(moving), np.count_nonzero(resting)) >= MIN_REFERENCE_SAMPLES:
        vector = recording.gyroscope - median(recording.gyroscope[1:][resting])
        _check_directions(recording, vector, limits, moving)


def _check_directions(
    recording: Recording, vector: Values, limits: ChannelLimits, where: Mask | slice = slice(None)
) -> None:
    """Refuse an attitude whose rotation has another direction in the body than the gyroscope's."""
    logged = (spin(recording) / recording.time_steps[:, None])[where]
    measured = 0.5 * (vector[1:] + vector[:-1])[where]
    off, size = np.linalg.norm(logged - measured, axis=1), np.linalg.norm(measured, axis=1)
    change = np.linalg.norm(np.diff(vector, axis=0), axis=1)[where] / recording.interval
    allowed = (limits.gain + limits.rate) * size + limits.late_s * change + limits.offset_dps
    usual_off, usual_size = float(median(off)), float(median(size))
    if usual_off > float(median(allowed)) + 0.5 * usual_size:
        way = f"{limits.column(recording, 'table_attitude')} turns about other body axes than the gyroscope reads"
        message = f"{way}: their angular rates differ by {usual_off:.3g} deg/s at the median, at {usual_size:.3g} deg/s"
        hint = "is it the attitude of this recording, from body to level, in the order w, x, y, z?"
        raise refusal(recording, "reference_contradiction", message, hint)


def _delay_of(recording: Recording, channels: Sequence[Channel], limits: ChannelLimits) -> Delay | None:
    """Return the delay of the sensor against the table's log; refuse a delay that no effect explains."""
    first, *others = channels
    found = None
    for other in others:
        of_sensor = other.name == "gyroscope"
        allowed = limits.late_s + (limits.clock * float(recording.time[-1]) if of_sensor else 0.0)
        step, one, two = _thinned(first, other, recording)
        furthest = min(max(int(np.ceil(min(allowed, FURTHEST_S) / step)), FURTHEST), len(one) // 4)
        one, two = one - one.mean(), two - two.mean()
        squares, steps = _variances(one[furthest : len(one) - furthest], two), len(one) - 2 * furthest
        power = min(float(one @ one), float(two @ two)) / len(one)
        if float(squares.min()) >= BETTER * power:
            continue  # nothing moves, or they are not alike at any delay
        interval = _interval(squares, NEARLY * power, steps, unless=None if of_sensor else furthest)
        if interval is None:
            continue
        best, low, high = ((d - furthest) * step for d in interval)
        delay = Delay(best, low, high)
        if abs(delay.nearest(0.0)) > max(allowed, MIN_SHARE_OF_USUAL_GAIN * step) + QUARTER * step:
            a, b = (limits.column(recording, channel.name) for channel in (first, other))
            late = f"{a} runs {abs(best):.3g} s {'late' if best < 0 else 'early'} against {b}"
            limiting = f"the limits of time_offset, low_pass_lag{' and clock_rate' if of_sensor else ''}"
            message = f"{late}; {limiting} allow {allowed:.3g} s"
            raise refusal(recording, "reference_contradiction", message, ALIGN)
        found = delay if of_sensor else found
    return found


def _variances(fixed: Values, moved: Values) -> Values:
    """Return the variance of (n,) values minus each n successive ones of (m,) values of mean 0: (m - n + 1,) array."""
    n, one = len(fixed), fixed - fixed.mean()
    end, power = len(moved) - n, one @ one
    total, squares = (np.cumsum(np.append(v[:n].sum(), v[n:] - v[:end])) for v in (moved, moved * moved))
    difference = power + squares - 2.0 * np.correlate(moved, one, "valid")
    rounding = np.finfo(float).eps * power
    return np.asarray(np.maximum(difference - total**2 / n, rounding) / n)


def _check_delays(found: Sequence[tuple[Recording, Delay]], limits: ChannelLimits) -> None:
    """Refuse a recording whose delay contradicts the one offset and the one clock of a unit's recordings.

    For some tau and e with ``|tau| <= time_offset + low_pass_lag`` and ``|e| <= clock_rate``, ``tau + e t`` has to be
    in the interval of every recording at some time t of it. If not, the recording whose removal allows it is refused.
    """
    if len(found) < 2 or not all(r.clock_shared for r, _ in found):
        return
    known = QUARTER * np.array([max(r.interval, DELAY_STEP_S) for r, _ in found])
    intervals = np.array([[r.time[0], r.time[-1], d.low, d.high] for r, d in found])
    intervals[:, 2:] += np.outer(known, [-1.0, 1.0])
    if _of_one_clock(intervals, limits):
        return
    alone = [i for i in range(len(found)) if _of_one_clock(np.delete(intervals, i, axis=0), limits)]
    recording, late = found[alone[0] if alone else int(np.argmax([abs(d.nearest(0.0)) for _, d in found]))]
    others = [d.best for r, d in found if r is not recording]
    raise refusal(
        recording,
        "reference_contradiction",
        f"the sensor is {late.best:.3g} s late against the table's log ({late.low:.3g} to {late.high:.3g} s), and "
        f"{min(others):.3g} to {max(others):.3g} s in the other recordings of the unit; one offset of at most "
        f"{limits.late_s:.3g} s (time_offset, low_pass_lag) and one clock_rate of at most {limits.clock:.3g} do not "
        "explain both",
        ALIGN,
    )


def _of_one_clock(intervals: Values, limits: ChannelLimits) -> bool:
    """Return whether one offset and one clock explain (r, 4) first and last times, least and largest delays, s."""
    start, end, low, high = intervals.T
    if max(low.max(), -limits.late_s) <= min(high.min(), limits.late_s):  # without any drift
        return True
    drift = np.linspace(-limits.clock, limits.clock, CLOCKS)[:, None, None] * np.stack([start, end])
    least = np.maximum((low - drift.max(axis=1)).max(axis=1), -limits.late_s)
    most = np.minimum((high - drift.min(axis=1)).min(axis=1), limits.late_s)
    return bool(np.any(least <= most))


def _thinned(first: Channel, other: Channel, recording: Recording) -> tuple[float, Values, Values]:
    """Return the step, s, and the mean rates of two channels over steps of about a twentieth of a second at least."""
    one, two = (c.low if c.of_intervals else 0.5 * (c.low[1:] + c.low[:-1]) for c in (first, other))
    known = np.isfinite(one) & np.isfinite(two)
    one, two = np.where(known, one, 0.0), np.where(known, two, 0.0)
    size = max(1, int(DELAY_STEP_S / recording.interval))
    if size > 1:
        count = len(one) // size
        one, two = (v[: count * size].reshape(count, size).mean(axis=1) for v in (one, two))
    return size * recording.interval, one, two


def _interval(squares: Values, room: float, steps: int, unless: int | None = None) -> tuple[float, float, float] | None:
    """Return the index of the minimum, and of the first and the last delay that the steps do not exclude.

    None if they exclude neither the first nor the last of all delays tried, or not the delay ``unless``.
    """
    least = max(float(squares.min()), float(np.finfo(float).tiny))
    over = np.log(np.maximum(squares, least)) - np.log(least)  # their quotient may exceed the largest number
    open_to = np.flatnonzero(steps * over <= SURE_END_DEVIATIONS * np.sqrt(2.0 * len(squares)))
    if (open_to[0] == 0 and open_to[-1] == len(squares) - 1) or unless in open_to:
        return None
    best = _nearest_minimum(squares, room)
    return best, min(best, float(open_to[0])), max(best, float(open_to[-1]))


def _nearest_minimum(squares: Values, room: float) -> float:
    """Return the index, nearest to the middle, of a minimum at most ``room`` above the least: equal steps repeat.

    A minimum between samples is that of the parabola through the least sample and its neighbours.
    """
    a, b, c = squares[:-2], squares[1:-1], squares[2:]
    lowest = (b <= a) & (b <= c) & (a + c > 2.0 * b)
    shift = 0.5 * (a - c) / np.where(lowest, a - 2.0 * b + c, np.inf)
    value = np.where(lowest, np.maximum(b - 0.25 * (a - c) * shift, 0.0), np.inf)
    if not np.isfinite(value).any():
        return float(np.argmin(squares))
    minima = np.flatnonzero(value <= value.min() + room)
    nearest = int(minima[np.argmin(np.abs(minima + 1 - len(squares) // 2))])
    return nearest + 1 + float(shift[nearest])
