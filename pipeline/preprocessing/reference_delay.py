"""How late the sensor and the channels of a table's log are against each other.

The delay is that at which the mean rates over steps of a twentieth of a second or more differ least; where equal steps
of a table make several delays alike, the smallest of them. Within one recording ``time_offset`` and ``low_pass_lag``
allow a delay, and ``clock_rate`` what the sensor's clock has run off since power-on; all recordings of a unit share
one offset and one clock.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.preprocessing.evidence import column, refusal

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.preprocessing.evidence import Channel, Limits
    from pipeline.records import Recording

    Array = NDArray[np.float64]

FURTHEST, FURTHEST_S = 25, 10.0  # samples of delay that are tried at least, and s at most
FINEST_S = 0.05  # step in which delays are tried; a parabola finds what lies between
FEWEST_DELAYS = 4  # recordings, of which one alone may be late
HALF = 0.5  # of an interval, between a rate at its end and the mean over it
QUARTER = 0.25  # of an interval, within which a delay between samples is known
BETTER = 0.5  # share of its power that a signal has to keep where it is no other's
NEARLY = 0.1  # share of the power by which one delay has to be better than a smaller one


def delay_of(
    recording: Recording, channels: Sequence[Channel], limits: Limits, settings: Mapping[str, Any]
) -> float | None:
    """Return how late the sensor is against the table's log, s; refuse what no effect explains.

    Between two channels of the table ``time_offset`` and ``low_pass_lag`` allow a delay; the sensor's clock, which runs
    off by ``clock_rate`` since power-on, adds to that of the sensor.
    """
    first, *others = (c for c in channels if c.name != "gravity")
    found = None
    for other in others:
        of_sensor = other.name == "gyroscope"
        allowed = limits.late_s + (limits.clock * float(recording.time[-1]) if of_sensor else 0.0)
        step, one, two = _thinned(first, other, recording)
        furthest = min(max(int(np.ceil(min(allowed, FURTHEST_S) / step)), FURTHEST), len(one) // 4)
        windows = np.lib.stride_tricks.sliding_window_view(two, len(two) - 2 * furthest)
        squares = np.mean((windows - one[furthest : len(one) - furthest]) ** 2, axis=1)
        power = min(float(np.var(one)), float(np.var(two)))
        if float(squares.min()) >= BETTER * power:
            continue  # nothing moves, or they are not alike at any delay
        delay = (_nearest_minimum(squares, NEARLY * power) - furthest) * step
        if abs(delay) > max(allowed, HALF * step) + QUARTER * step:
            raise refusal(
                recording,
                "reference_contradiction",
                f"{column(recording, first.name, settings)} runs {abs(delay):.3g} s {'late' if delay < 0 else 'early'} "
                f"against {column(recording, other.name, settings)}; the limits of time_offset, low_pass_lag"
                f"{' and clock_rate' if of_sensor else ''} allow {allowed:.3g} s",
                "align the table's log with the sensor's rows, or give it a time column of its own (ingest=table_log)",
            )
        found = delay if of_sensor else found
    return found


def check_delays(found: Sequence[tuple[Recording, float]], limits: Limits) -> None:
    """Refuse a recording whose delay is not that of one offset and one clock, as all recordings of a unit share them.

    d = tau + e t, |tau| <= time_offset + low_pass_lag, |e| <= clock_rate; e by the median of the slopes between pairs.
    """
    if len(found) < FEWEST_DELAYS or not all(r.clock_shared for r, _ in found):
        return
    time = np.array([float(r.time[r.samples // 2]) for r, _ in found])
    delay = np.array([d for _, d in found])
    one, two = np.triu_indices(len(time), 1)
    apart = time[two] - time[one]
    slope = float(np.median((delay[two] - delay[one]) / np.where(apart == 0.0, np.inf, apart)))
    rate = float(np.clip(slope, -limits.clock, limits.clock))
    offset = delay - rate * time
    usual = float(np.median(offset))
    for (recording, late), tau in zip(found, offset, strict=True):
        room = limits.late_s + QUARTER * max(recording.interval, FINEST_S)
        if abs(tau) > room and (abs(tau - usual) > room or abs(usual) > room):
            raise refusal(
                recording,
                "reference_contradiction",
                f"the table's log and the gyroscope are {abs(late):.3g} s apart, and {usual + rate * time.min():.3g} s "
                f"at the beginning of the unit's recordings; time_offset and low_pass_lag allow {limits.late_s:.3g} s, "
                f"and a clock would run off evenly",
                "align the table's log with the sensor's rows, or give it a time column of its own (ingest=table_log)",
            )


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
