"""Delay between the sensor and the channels of a table's log.

The delay d minimises the variance S(d) of the difference of two rates, both averaged over steps of at least a twentieth
of a second; where equal steps of a table give several such minima, the smallest |d| is taken. The recording determines
d to the interval in which

    n log(S(d) / S_min) <= 5 sqrt(4 d_max)

where n is the number of steps and d_max the largest delay tried, in steps: a window that is moved by d_max exchanges
2 d_max differences at each end, whose sum of squares has the standard deviation ``sqrt(4 d_max)`` in units of S_min.
A turn at one rate determines no delay: its interval covers every delay tried.

The effects ``time_offset`` and ``low_pass_lag`` allow a delay, and of the sensor ``clock_rate`` what its clock gains
after power-on. All recordings of a unit have one offset and one clock. A recording is refused only where its whole
interval contradicts this.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.preprocessing.evidence import refusal

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from pipeline.preprocessing.evidence import Channel, Limits
    from pipeline.records import Recording

    Array = NDArray[np.float64]

FURTHEST, FURTHEST_S = 25, 10.0  # samples of delay that are tried at least, and s at most
FINEST_S = 0.05  # step in which delays are tried; a parabola finds what lies between
CLOCKS = 4001  # rates of the clock that are tried: 5 us in 1 s where it may be off by 1 %
HALF = 0.5  # of an interval, between a rate at its end and the mean over it
QUARTER = 0.25  # of an interval, within which a delay between samples is known
BETTER = 0.5  # share of its power that a signal has to keep where it is no other's
NEARLY = 0.1  # share of the power by which one delay has to be better than a smaller one
SURE = 5.0  # standard deviations of what the ends of the window add
ALIGN = "align the table's log with the sensor's rows, or give it a time column of its own (ingest=table_log)"


@dataclass(frozen=True)
class Delay:
    """Delay of the sensor against the table's log, s, and the interval that the recording allows; positive: late."""

    best: float
    low: float
    high: float

    def nearest(self, value: float) -> float:
        """Return the delay of the interval that is nearest to a value, s."""
        return min(max(value, self.low), self.high)


def delay_of(recording: Recording, channels: Sequence[Channel], limits: Limits) -> Delay | None:
    """Return the delay of the sensor against the table's log; refuse a delay that no effect explains."""
    first, *others = (c for c in channels if c.name != "gravity")
    found = None
    for other in others:
        of_sensor = other.name == "gyroscope"
        allowed = limits.late_s + (limits.clock * float(recording.time[-1]) if of_sensor else 0.0)
        step, one, two = _thinned(first, other, recording)
        furthest = min(max(int(np.ceil(min(allowed, FURTHEST_S) / step)), FURTHEST), len(one) // 4)
        squares, steps = _variances(one[furthest : len(one) - furthest], two), len(one) - 2 * furthest
        power = min(float(np.var(one)), float(np.var(two)))
        if float(squares.min()) >= BETTER * power:
            continue  # nothing moves, or they are not alike at any delay
        interval = _interval(squares, NEARLY * power, steps)
        if interval is None:
            continue
        best, low, high = ((d - furthest) * step for d in interval)
        delay = Delay(best, low, high)
        if abs(delay.nearest(0.0)) > max(allowed, HALF * step) + QUARTER * step:
            raise refusal(
                recording,
                "reference_contradiction",
                f"{limits.column(recording, first.name)} runs {abs(best):.3g} s {'late' if best < 0 else 'early'} "
                f"against {limits.column(recording, other.name)}; the limits of time_offset, low_pass_lag"
                f"{' and clock_rate' if of_sensor else ''} allow {allowed:.3g} s",
                ALIGN,
            )
        found = delay if of_sensor else found
    return found


def _variances(fixed: Array, moved: Array) -> Array:
    """Return the variance of the difference to (n,) values of each n successive ones of (m,): (m - n + 1,) array."""
    n, one, two = len(fixed), fixed - fixed.mean(), moved - moved.mean()
    total, squares = (np.append(0.0, np.cumsum(v)) for v in (two, two * two))
    power = one @ one
    apart = power + squares[n:] - squares[:-n] - 2.0 * np.correlate(two, one, "valid")
    rounding = np.finfo(float).eps * power
    return np.asarray(np.maximum(apart - (total[n:] - total[:-n]) ** 2 / n, rounding) / n)


def check_delays(found: Sequence[tuple[Recording, Delay]], limits: Limits) -> None:
    """Refuse a recording whose delay is not that of the one offset and the one clock that a unit's recordings share.

    Some tau and e with ``|tau| <= time_offset + low_pass_lag`` and ``|e| <= clock_rate`` have to lie, as ``tau + e t``,
    in the interval of every recording at some time t of it. If not, the recording is refused whose removal allows it.
    """
    if len(found) < 2 or not all(r.clock_shared for r, _ in found):
        return
    known = QUARTER * np.array([max(r.interval, FINEST_S) for r, _ in found])
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


def _of_one_clock(intervals: Array, limits: Limits) -> bool:
    """Return whether one offset and one clock explain (r, 4) first and last times, least and largest delays, s."""
    start, end, low, high = intervals.T
    run_off = np.linspace(-limits.clock, limits.clock, CLOCKS)[:, None, None] * np.stack([start, end])
    least = np.maximum((low - run_off.max(axis=1)).max(axis=1), -limits.late_s)
    most = np.minimum((high - run_off.min(axis=1)).min(axis=1), limits.late_s)
    return bool(np.any(least <= most))


def _thinned(first: Channel, other: Channel, recording: Recording) -> tuple[float, Array, Array]:
    """Return the step, s, and the mean rates of two channels over steps of about a twentieth of a second at least."""
    one, two = (c.low if c.of_intervals else 0.5 * (c.low[1:] + c.low[:-1]) for c in (first, other))
    known = np.isfinite(one) & np.isfinite(two)
    one, two = np.where(known, one, 0.0), np.where(known, two, 0.0)
    size = max(1, int(FINEST_S / recording.interval))
    if size > 1:
        count = len(one) // size
        one, two = (v[: count * size].reshape(count, size).mean(axis=1) for v in (one, two))
    return size * recording.interval, one, two


def _interval(squares: Array, room: float, steps: int) -> tuple[float, float, float] | None:
    """Return the place of the minimum, and of the first and the last delay that the steps do not exclude.

    None where they exclude neither the first nor the last of all delays tried.
    """
    best = _nearest_minimum(squares, room)
    least = max(float(squares.min()), float(np.finfo(float).tiny))
    open_to = np.flatnonzero(steps * np.log(np.maximum(squares, least) / least) <= SURE * np.sqrt(2.0 * len(squares)))
    if open_to[0] == 0 and open_to[-1] == len(squares) - 1:
        return None
    return best, min(best, float(open_to[0])), max(best, float(open_to[-1]))


def _nearest_minimum(squares: Array, room: float) -> float:
    """Return the place, nearest to the middle, of a minimum that is not much above the least: equal steps repeat.

    Between the samples a minimum lies where the parabola through the least square and its neighbours is least.
    """
    a, b, c = squares[:-2], squares[1:-1], squares[2:]
    lowest = (b <= a) & (b <= c) & (a + c > 2.0 * b)
    at = 0.5 * (a - c) / np.where(lowest, a - 2.0 * b + c, np.inf)
    value = np.where(lowest, np.maximum(b - 0.25 * (a - c) * at, 0.0), np.inf)
    if not np.isfinite(value).any():
        return float(np.argmin(squares))
    places = np.flatnonzero(value <= value.min() + room)
    nearest = int(places[np.argmin(np.abs(places + 1 - len(squares) // 2))])
    return nearest + 1 + float(at[nearest])
