"""Find the rests in a recording: from the log of a table, or from the readings of the sensor.

From the readings (after Tedaldi, Pretto & Menegatti, ICRA 2014, section IV), a sample is at rest where the variance of
the specific force in a short window, summed over the axes, is below a multiple of the sensor's noise,

    v[n] = sum_axes var(f[n .. n+W-1]) < m v_0

where

    W   : window, 0.5 s and at least 5 samples
    v_0 : the noise: the 5th percentile of v, so that no part of the recording must be known to be a rest; at least the
          variance of rounding, by the smallest step between successive readings
    m   : the multiple, from the widest range over which the number of rests stays the same

A rest is trimmed by W at its start. A gyroscope must be quiet, too (``pipeline.physics.signal.quiet_motion``), as a
turn about the vertical does not change the specific force. A rest is refused if its angular rate differs from that of
the neighbouring rests, the direction of the specific force moves, or the readings scatter more than noise. A turn by
theta shortens the mean of a vector by theta^2 / 24, for 2 deg by 5e-5: 0.05 mg.

An accelerometer with a slow filter still settles when a rest begins: its readings are off towards those of the rest
before, by ``A exp(-t / T)`` on average over the rests. The start of every rest is left out until the rest of it changes
no mean by a tenth of the noise that all means have together (``Settling``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from pipeline.core.records import (
    BETWEEN_ATTITUDES_S,
    Mask,
    Recording,
    Values,
    finite_rows,
    median,
    noise_of_steps,
    once,
    runs_of,
)
from pipeline.physics.signal.filters import filter_autocovariance, stretch_starts
from pipeline.physics.signal.quiet_motion import (
    RATE_LIMIT_DPS,
    Spans,
    before_slow_motion,
    counts_of,
    creep_of_rest,
    quiet_pieces,
    windows,
)

RATE_AT_REST_DPS = 0.02  # above the rate noise of a resting table
SETTLING_S = 0.3  # fifteen time constants of the slowest filter of 20 ms, as in ``pipeline.physics.kinematics``

WINDOW_S = 0.5  # shorter than a rest, longer than a tremor's period (8 to 12 Hz)
GAP_S = 1.0  # longer than any regular interval of a log
SHORTEST_REST_S = 1.0  # two windows
VARIANCE_MULTIPLES = np.geomspace(4.0, 1000.0, 25)  # of a variance: 2 to 30 times the noise, in steps of an eighth
MIN_NOISE_VARIANCE_G2 = 1e-12  # g^2, keeps the multiple of a noise-free recording above rounding
NEIGHBOUR_RESTS = 5  # rests: their median is robust against two that turned
TURN_LIMIT_DEG = 2.0  # 0.05 mg, see above
# A steady tilt is modelled up to this rate (``pipeline.physics.signal.quiet_motion``); units in a hand or on a soft
# support creep by up to 0.3 deg/s.
CREEP_LIMIT_DPS, STEADY_LIMIT_DEG = 0.5, 10.0
SCATTER_LIMIT = 3.0  # times the noise; noise alone stays below 1.3 in the 100 samples of a rest at 100 Hz
SMALLEST_SCATTER_G2 = 3e-6  # 1 mg on each axis, so that a quiet sensor may settle by 0.1 deg
SIGNIFICANT_REST_DEVIATIONS = 6.0  # standard deviations
REST_EDGE_S, FEWEST_TO_SETTLE = 0.5, 6  # edge of a rest that may move, at most a third of it; samples that this needs
SETTLED_DIFFERENCE_DEVIATIONS = 8.0  # of the noise between successive samples: white noise passes in 1e-14

SETTLING_BLOCK_S, SETTLING_BLOCKS, FEWEST_SETTLING = 0.1, 20, 8  # blocks from the start of rests; rests that show it
APART_G = 0.2  # between two rests, by which the direction of the settling is known
SETTLES_DEVIATIONS = 6.0  # standard deviations by the scatter between rests; published recordings reach 2.6
SETTLING_TIMES_S = np.geomspace(0.05, 3.0, 40)  # T; shorter ones have settled where the variance is low
SETTLED_SHARE = 0.1  # of the noise of the mean of all rests, see above

RESTS = "rests"  # in the source of a recording on a table (of a sheet): start and stop of each rest by its log
RATE_AT_REST = "rate_at_rest_dps"  # in the source of a turn: what the gyroscope reads in the recordings at rest
SLOW_PARTS, SLOW_PART_S = 400, 0.2  # parts of slow movement: a turn at 30 deg/s shortens their mean by 0.5 mg
SOAK_PARTS = 40  # of a soak: over a span of 80 degC, 2 degC each


@dataclass(frozen=True)
class Rest:
    """One rest of a recording: samples ``start <= n < stop``, and the reason where its mean may not be used."""

    start: int
    stop: int
    accepted: bool = True
    reason: str = ""


@dataclass(frozen=True)
class Settling:
    """How the readings of the accelerometer settle after moves; see the module."""

    time_s: float  # T
    left_out_s: float  # at the start of each rest, as far as a rest of 1 s remains
    left_g: float  # mean error of the rests that remains
    clear: bool  # whether this error is larger than the noise of the mean of all rests


def runs(mask: Mask) -> Spans:
    """Return the (start, stop) index pairs of the runs of True in a mask."""
    return [(start, stop) for start, stop in runs_of(mask).tolist()]


def still_samples(time: Values, rate: Values, settling: float = SETTLING_S) -> Mask:
    """Return which samples are at rest and settled, by a table's rate in deg/s: (n,) array of bool.

    A rest begins where |rate| falls below 0.02 deg/s. Its first ``settling`` seconds are not included, unless the
    recording begins with the rest.
    """
    still = np.abs(rate) < RATE_AT_REST_DPS
    starts, stops = runs_of(still).T
    settled = np.repeat(time[starts] + settling, stops - starts)
    if still[:1].any():
        settled[: stops[0]] = -np.inf
    still[still] = time[still] >= settled
    return still


@once
def still_on_table(recording: Recording) -> Mask:
    """Return which samples are in the rests of ``rests_from_table``: (n,) array of bool."""
    rate = recording.logged_rate
    if rate is None:
        return np.zeros(recording.samples, bool)
    return still_samples(recording.time, rate, SETTLING_S + float(recording.filter.get("delay_s", 0.0)))


@once
def rests_from_table(recording: Recording) -> list[Rest]:
    """Return the rests by the rate of the table, or by the derivative of its angle; none without such a log.

    Their first 0.3 s, and the delay of the recording's filter, are not included.
    """
    return [Rest(start, stop) for start, stop in runs(still_on_table(recording))]


@once
def find_rests(recording: Recording) -> list[Rest]:
    """Find the rests of a hand-held recording from its readings, in order of time, each at least 1 s long.

    A rest in which the sensor moved is marked as refused, with the reason. If a sheet states the kind of the recording,
    ``rest`` is one rest, the longest or, if none is found, the whole; ``soak`` parts of equal length, in which the
    temperature hardly changes; ``table`` those by the log; ``slow`` short parts, for the length of gravity alone;
    ``attitudes`` the blocks of rows.
    """
    if recording.kind == "table":
        return [Rest(start, stop) for start, stop in recording.source.get(RESTS, ())]
    if recording.kind == "soak":
        edges = np.linspace(0, recording.samples, min(SOAK_PARTS, recording.samples) + 1).astype(int)
        return [Rest(a, b) for a, b in pairwise(edges.tolist())]
    if recording.kind == "slow":
        size = max(5, round(SLOW_PART_S / _interval(recording))) if recording.samples > 1 else 1
        count = max(min(SLOW_PARTS, recording.samples // size), 1)
        starts = np.linspace(0, max(recording.samples - size, 0), count).astype(int)
        return [Rest(a, min(a + size, recording.samples)) for a in starts.tolist()]
    if recording.kind == "attitudes":
        starts = np.flatnonzero(np.diff(recording.time_ns) > 0.5 * BETWEEN_ATTITUDES_S * 1e9) + 1
        return [Rest(a, b) for a, b in pairwise([0, *starts.tolist(), recording.samples])]
    found = _rests_by_readings(recording)
    if recording.kind != "rest":
        return found
    longest = max((r for r in found if r.accepted), key=lambda r: r.stop - r.start, default=None)
    return [longest or Rest(0, recording.samples)]


def _rests_by_readings(recording: Recording) -> list[Rest]:
    pieces, noise = _quiet_parts(recording)
    settling = settling_of(recording)
    if settling is not None:
        interval = _interval(recording)
        cut, shortest = round(settling.left_out_s / interval), _shortest(recording)
        pieces = [(max(a, min(a + cut, b - shortest)), b) for a, b in pieces]
    if recording.accelerometer is None:
        return _at_the_ends(recording, pieces)
    return assess_rests(recording, pieces, noise)


@once
def _quiet_parts(recording: Recording) -> tuple[Spans, float]:
    """Return the parts in which both sensors are quiet, and the noise: variance of the specific force, g^2.

    In a turn of a sheet the gyroscope may be alone: the parts are those of an even rate.
    """
    alone = recording.accelerometer is None and recording.kind == "turn"
    readings = recording.gyroscope if alone else recording.accelerometer
    size = max(5, round(WINDOW_S / _interval(recording))) if recording.samples > 1 else 5
    if readings is None or recording.samples < 2 * size:
        return [], 0.0
    variance = windows(readings, size)[1]
    steps = np.abs(np.diff(readings[finite_rows(readings)], axis=0))
    rounding = float(np.sum(counts_of(steps) ** 2)) / 12.0
    noise = max(float(np.percentile(variance, 5.0)), rounding, MIN_NOISE_VARIANCE_G2)
    variance[_spoilt(recording, size)] = np.inf
    found = [_below(variance, multiple * noise, recording, size) for multiple in VARIANCE_MULTIPLES]
    quiet = found[_plateau([len(rests) for rests in found])]
    if recording.gyroscope is not None and quiet:
        cut = recording.gyroscope, _interval(recording), _shortest(recording)
        quiet = quiet_pieces(cut[0], quiet, *cut[1:])
        if recording.kind == "turn":
            quiet = before_slow_motion(cut[0], quiet, *cut[1:])
    return quiet, noise


@once
def settling_of(recording: Recording) -> Settling | None:
    """Return how the accelerometer settles after the moves of a recording by hand; None where that is not seen."""
    pieces, _ = _quiet_parts(recording)
    block = max(1, round(SETTLING_BLOCK_S / _interval(recording))) if pieces else 1
    force = recording.accelerometer
    if force is None or len(pieces) <= FEWEST_SETTLING:
        return None
    level = np.array([force[(a + b) // 2 : b].mean(axis=0) for a, b in pieces])
    apart = level[:-1] - level[1:]
    size = np.linalg.norm(apart, axis=1)
    off = np.full((len(apart), SETTLING_BLOCKS), np.nan)  # of each block towards the rest before
    for k, (a, b) in enumerate(pieces[1:]):
        count = min((b - a) // 2 // block, SETTLING_BLOCKS) if size[k] > APART_G else 0
        readings = (force[a : a + count * block] - level[k + 1]) @ apart[k]
        off[k, :count] = readings.reshape(count, block).mean(axis=1) / size[k] if count else 0.0
    seen = np.isfinite(off).sum(axis=0)
    off = off[:, seen >= FEWEST_SETTLING]
    if off.shape[1] < 2 or np.nanmean(off[:, 0]) <= 0.0:
        return None
    mean, spread = np.nanmean(off, axis=0), np.nanstd(off, axis=0, ddof=1) / np.sqrt(seen[: off.shape[1]])
    if mean[0] <= SETTLES_DEVIATIONS * spread[0]:
        return None
    lengths = np.array([b - a for a, b in pieces]) * _interval(recording)
    half = 0.5 * float(np.median(lengths))
    middle = (np.arange(len(mean)) + 0.5) * block * _interval(recording)
    shapes = np.exp(-middle / SETTLING_TIMES_S[:, None])
    of_level = SETTLING_TIMES_S / half * np.exp(-half / SETTLING_TIMES_S) * (1.0 - np.exp(-half / SETTLING_TIMES_S))
    shapes -= of_level[:, None]
    size_of = shapes @ mean / np.sum(shapes**2, axis=1)
    best = int(np.argmax(size_of * (shapes @ mean)))
    T, A = float(SETTLING_TIMES_S[best]), float(size_of[best])
    white = float(spread[-1] * np.sqrt(block * _interval(recording) / (2.0 * half)))
    left_out = max(T * float(np.log(A * T / (2.0 * half * SETTLED_SHARE * white))), 0.0)
    kept = np.maximum(lengths - left_out, np.minimum(SHORTEST_REST_S, lengths))
    left = float(np.mean(A * T / kept * np.exp(-(lengths - kept) / T)))
    return Settling(T, left_out, left, clear=left > white)


def _shortest(recording: Recording) -> int:
    interval = _interval(recording)
    return max(5, round(WINDOW_S / interval), round(SHORTEST_REST_S / interval))


def _at_the_ends(recording: Recording, quiet: Spans) -> list[Rest]:
    """Return the rests of a turn that the gyroscope alone recorded: it reads the same before and after the turn.

    Without recordings at rest, and with one rest or two that differ, an even rate is not told from a rest.
    """
    if RATE_AT_REST not in recording.source:
        means = [np.asarray(recording.gyroscope)[a:b].mean(axis=0) for a, b in (quiet[:1] + quiet[-1:])]
        if len(quiet) < 2 or np.max(np.abs(means[0] - means[1])) > RATE_LIMIT_DPS:
            return []
        source = {**recording.source, RATE_AT_REST: np.mean(means, axis=0).tolist()}
        recording = replace(recording, source=source)
    rests = [Rest(start, stop) for start, stop in quiet]
    return [replace(r, accepted=not why, reason=why) for r, why in zip(rests, _reasons(recording, rests), strict=True)]


def _interval(recording: Recording) -> float:
    """Return the mean time between samples, s, without gaps; the median would be wrong for stamps in bursts."""
    steps = np.diff(recording.time_ns)
    short = steps[steps < GAP_S * 1e9]
    return float(short.mean()) / 1e9 if short.size else recording.interval


def assess_rests(recording: Recording, intervals: Sequence[tuple[int, int]], noise_variance: float) -> list[Rest]:
    """Return rests of given ends, refused where the sensor moved; ``noise_variance``: of all axes of the force, g^2."""
    rests = [Rest(start, stop) for start, stop in intervals]
    pairs = zip(rests, _reasons(recording, rests), strict=True)
    reasons = [_turn(recording, r) or _scatter(recording, r, noise_variance) or of_rate for r, of_rate in pairs]
    return [replace(r, accepted=not why, reason=why) for r, why in zip(rests, reasons, strict=True)]


def _spoilt(recording: Recording, size: int) -> Mask:
    """Return the windows with a clipped, stuck or missing reading, or over a gap as long as a window."""
    bad = ~recording.valid
    for readings in (recording.accelerometer, recording.gyroscope):
        if readings is not None:
            bad |= ~finite_rows(readings)
    bad[1:] |= np.diff(recording.time_ns) > size * _interval(recording) * 1e9
    total = np.concatenate([[0], np.cumsum(bad)])
    return total[size:] > total[:-size]


def _below(variance: Values, threshold: float, recording: Recording, size: int) -> Spans:
    """Return the trimmed stretches whose windows are below a threshold, if they are long enough."""
    interval = _interval(recording)
    lag = int(np.ceil(5.0 * float(recording.filter.get("delay_s", 0.0)) / interval))
    shortest = _shortest(recording)
    trimmed = ((start + size + lag, stop - 1) for start, stop in runs(variance < threshold))
    return [(start, stop) for start, stop in trimmed if stop - start >= shortest]


def _plateau(counts: Sequence[int]) -> int:
    """Return an index in the lower third of the longest run of equal counts above zero."""
    steps = np.flatnonzero(np.diff(counts)) + 1
    edges = [0, *steps.tolist(), len(counts)]
    best = max(range(len(edges) - 1), key=lambda i: (counts[edges[i]] > 0, edges[i + 1] - edges[i]))
    return int(edges[best] + (edges[best + 1] - edges[best]) // 3)


def _scatter(recording: Recording, rest: Rest, noise_variance: float) -> str:
    assert recording.accelerometer is not None  # noqa: S101
    creep = creep_of_rest(recording, rest.start, rest.stop)
    variance = float(creep.squares.sum()) / max(creep.freedom, 1)
    ratio = np.sqrt(variance / max(noise_variance, SMALLEST_SCATTER_G2))
    if ratio <= SCATTER_LIMIT:
        return ""
    return f"specific force scatters {ratio:.1f} times the noise (limit {SCATTER_LIMIT:g})"


def _turn(recording: Recording, rest: Rest) -> str:
    """Compare the directions of the four quarters of a rest, after subtraction of a steady creep."""
    assert recording.accelerometer is not None  # noqa: S101
    force = recording.accelerometer[rest.start : rest.stop]
    creep = creep_of_rest(recording, rest.start, rest.stop)
    rate, span = float(np.linalg.norm(creep.rate)), float(recording.time[rest.stop - 1] - recording.time[rest.start])
    if 0.0 < rate <= CREEP_LIMIT_DPS and rate * span <= STEADY_LIMIT_DEG:
        steady = np.cross(force.mean(axis=0), np.radians(creep.rate))  # du/dt = -omega x u
        force = force - np.outer(recording.time[rest.start : rest.stop] - recording.time[rest.start], steady)
    quarter = len(force) // 4
    if quarter == 0:
        return ""
    blocks = force[: 4 * quarter].reshape(4, quarter, 3)
    means, length = blocks.mean(axis=1), float(np.linalg.norm(force.mean(axis=0)))
    moved = float(np.max(np.linalg.norm(means[:, None] - means[None], axis=2)))
    angle = np.degrees(moved / length) if length > 0 else 0.0
    if angle <= TURN_LIMIT_DEG:
        return ""
    noise = float(np.sqrt(blocks.var(axis=1).sum(axis=1).mean() / quarter))
    if moved <= SIGNIFICANT_REST_DEVIATIONS * noise:
        return ""
    return f"direction of the specific force moves by {angle:.1f} deg (limit {TURN_LIMIT_DEG:g} deg)"


def _reasons(recording: Recording, rests: Sequence[Rest]) -> list[str]:
    """Compare the mean angular rate of each rest with the median of its neighbours in time, or with other recordings.

    Not of all rests of a recording, because the bias changes with the temperature.
    """
    rate = recording.gyroscope
    if rate is None or (len(rests) < 3 and RATE_AT_REST not in recording.source):
        return [""] * len(rests)
    parts = [rate[r.start : r.stop] for r in rests]
    means = np.array([part.mean(axis=0) for part in parts])
    reasons = []
    for i, part in enumerate(parts):
        first = int(np.clip(i - NEIGHBOUR_RESTS // 2, 0, max(len(rests) - NEIGHBOUR_RESTS, 0)))
        usual = recording.source.get(RATE_AT_REST) or median(means[first : first + NEIGHBOUR_RESTS])
        off = float(np.max(np.abs(means[i] - usual)))
        noise = float(np.max(part.std(axis=0))) / np.sqrt(len(part))
        text = f"angular rate is {off:.2f} deg/s off that of other rests (limit {RATE_LIMIT_DPS:g} deg/s)"
        reasons.append(text if off > max(RATE_LIMIT_DPS, SIGNIFICANT_REST_DEVIATIONS * noise) else "")
    return reasons


def stretches_of(recording: Recording, mask: Mask) -> Spans:
    """Return the runs of True in a mask, cut at gaps in time."""
    cuts = np.array(stretch_starts(recording)[1:-1], int)
    spans = runs(mask)
    if not cuts.size:
        return spans
    return [each for a, b in spans for each in pairwise([a, *cuts[(cuts > a) & (cuts < b)].tolist(), b])]


def usable(recording: Recording, values: Values) -> Mask:
    """Return which samples are neither missing nor flagged by ingest: (n,) array."""
    return finite_rows(values) & recording.valid


def rest_readings(recording: Recording, sensor: str, *, whole_recording: bool) -> list[tuple[Values, Values]]:
    """Return the times and readings of each rest of a recording."""
    values = recording.reading(sensor)
    assert values is not None  # noqa: S101
    still = usable(recording, values)
    if whole_recording:  # a gap does not end a static rest: the likelihood uses the times
        return [(recording.time[still], values.compress(still, axis=0))] if still.any() else []
    settled = _settled(recording, values, stretches_of(recording, still & _resting(recording)))
    return [(recording.time[a:b], values[a:b]) for a, b in settled if b - a > 2]


@once
def _resting(recording: Recording) -> Mask:
    """Return which samples are of accepted rests, for both sensors: (n,) array."""
    found = rests_from_table(recording)
    if not found and recording.role == "rests":
        found = find_rests(recording)
    resting = np.zeros(recording.samples, bool)
    memory = len(filter_autocovariance(recording)) - 1  # samples for which the output depends on earlier readings
    ahead = memory if recording.filter.get("zero_phase") else 0
    for rest in found:
        first = rest.start + memory * (rest.start > 0)
        resting[first : rest.stop - ahead * (rest.stop < recording.samples)] = rest.accepted
    return resting


def _settled(recording: Recording, values: Values, stretches: Spans) -> Spans:
    """Remove samples that still move at the edges of rests: the clocks of sensor and table may differ."""
    ends = np.array(stretches, int).reshape(-1, 2)
    lengths = ends[:, 1] - ends[:, 0]
    edges = np.minimum(int(REST_EDGE_S / recording.interval) + 1, lengths // 3)
    for edge in np.unique(edges[lengths >= FEWEST_TO_SETTLE]).tolist():
        alike = np.flatnonzero((edges == edge) & (lengths >= FEWEST_TO_SETTLE))
        length = int(lengths[alike].min())
        inside = values.take(ends[alike, :1] + np.arange(length), axis=0)  # a quarter of the time of an index
        inside = inside.transpose(2, 0, 1).copy()  # numpy is fast along rows
        spread = noise_of_steps(np.abs(np.diff(inside)), axis=2, keepdims=True)[:, None]
        inwards = np.arange(3 * edge)
        rows = np.stack([ends[alike, :1] + inwards, ends[alike, 1:] - 1 - inwards])
        ordered = values.take(rows, axis=0).transpose(3, 0, 1, 2).copy()  # by axis, end and rest
        middle = median(ordered[..., edge:], axis=3, keepdims=True)
        moving = (np.abs(ordered[..., :edge] - middle) > SETTLED_DIFFERENCE_DEVIATIONS * spread) & (spread > 0)
        if moving.any():
            cut = np.where(moving.any(axis=0), np.arange(1, edge + 1), 0).max(axis=2)
            ends[alike] += np.stack([cut[0], -cut[1]], axis=1)
    return [(a, b) for a, b in ends.tolist()]
