"""A table's log with times of its own, as signals that the sensor feels, at any time.

    rate of the turn r and angle A     the gyroscope reads along r, the accelerometer along (cos A, sin A)
    attitude q                         the gyroscope reads along omega, the accelerometer along R(q)^T e_z

Between two samples the angle is the cubic through angle and rate at both ends, which stretches of constant
acceleration are, the rate is linear and bends once where its slopes on either side ask for it, and the attitude is the
quintic spline of its components.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import IngestError
from pipeline.io.units import ATTITUDE
from pipeline.records import conjugate_product, continuous, level_in_body

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from pipeline.io.channel_table import ChannelTable

    Values = NDArray[np.float64]

FINEST_S, FINEST_OF_ATTITUDE_S = 0.0025, 0.01  # only the rate of one axis is known to bend
BENT = 8.0
MOST_POINTS = 1 << 18
RESTING_DPS = 0.5
SAME_SIGN = 0.9


@dataclass(frozen=True)
class Signals:
    """What a sensor would feel of a table's motion, on a regular grid of the table's own time.

    Attributes
    ----------
    step : float, s
        Of the grid, which begins at the log's first sample.
    rates : (n, m) array, deg/s
        Signals that angular rates follow.
    directions : (n, p) array
        Signals that specific forces follow; p is 0 where the log does not tell them.
    interval : float, s
        Median of the log's own.
    magnitude : bool
        Whether only the size of the rate is known.
    """

    step: float
    rates: Values
    directions: Values
    interval: float
    magnitude: bool = False

    @property
    def duration(self) -> float:
        """Length of the log, s."""
        return self.step * (len(self.rates) - 1)

    @property
    def resting(self) -> bool:
        """Whether the table rests throughout."""
        return bool(np.ptp(self.rates, axis=0).max() < RESTING_DPS)

    def covers(self, tau: Values) -> NDArray[np.bool_]:
        """Return which times lie within the log."""
        return np.asarray((tau >= 0) & (tau <= self.duration))

    def at(self, tau: Values) -> tuple[Values, Values, Values, Values]:
        """Return rates, directions, and their derivatives, at any times; the log's ends hold beyond it."""
        place = np.clip(tau / self.step, 0.0, len(self.rates) - 1.000001)
        k = place.astype(np.intp)
        x = (place - k)[:, None]
        inside = self.covers(tau)[:, None]
        r, r_next, u, u_next = self.rates[k], self.rates[k + 1], self.directions[k], self.directions[k + 1]
        slope = inside / self.step
        return r + (r_next - r) * x, u + (u_next - u) * x, (r_next - r) * slope, (u_next - u) * slope


def unwrapped(table: ChannelTable) -> ChannelTable:
    """Return a log whose table angle goes on where an encoder started again at 0 or 360 deg.

    Between two samples a table turns by less than half a turn, so that a larger step is the counter's.
    """
    angle = table.values.get("table_angle")
    if angle is None or len(angle) < 2:
        return table
    rows = np.flatnonzero(np.abs(np.diff(angle)) > 180.0) + 1
    if not rows.size:
        return table
    values = {**table.values, "table_angle": np.asarray(np.unwrap(angle, period=360.0))}
    note = table.note("N-UNWRAP", rows, "the table's angle started again at a full turn and was counted on")
    encodings = {c: e for c, e in table.encodings.items() if c != "table_angle"}
    return replace(table, values=values, encodings=encodings, notes=(*table.notes, note))


def signals_of(log: ChannelTable) -> Signals:
    """Return what a sensor would feel of a table's motion.

    Raises
    ------
    IngestError
        If the log holds neither rate, angle nor attitude.
    """
    own = seconds_of(log)
    found = interpolators(log)
    step = max(FINEST_OF_ATTITUDE_S if ATTITUDE[0] in found else FINEST_S, own[-1] / MOST_POINTS)
    grid = step * np.arange(int(own[-1] / step) + 1)
    interval = float(np.median(np.diff(own)))
    if ATTITUDE[0] in found:
        q = np.column_stack([found[c](grid) for c in ATTITUDE])
        rates = body_rates(q, step)
        return Signals(step, rates, level_in_body(q), interval)
    if "table_angle" in found:
        angle = found["table_angle"](grid)
        rate = found["table_rate"](grid) if "table_rate" in found else np.gradient(angle, grid)
        turn = np.radians(angle)
        return Signals(step, rate[:, None], np.column_stack([np.cos(turn), np.sin(turn)]), interval)
    if "table_rate" in found:
        rate = found["table_rate"](grid)
        return Signals(step, rate[:, None], np.zeros((len(grid), 0)), interval, magnitude=bool(rate.min() >= 0))
    raise IngestError("the table's log holds neither rate, angle nor attitude", log.path, fault="no_sync")


def seconds_of(table: ChannelTable) -> Values:
    """Return the times of a log from its first sample on, s."""
    seconds: Values = (table.time_ns - table.time_ns[0]) / 1e9
    return seconds


def interpolators(log: ChannelTable) -> dict[str, Callable[[Values], Values]]:
    """Return functions of the table's own time, s, one for each channel."""
    own, values = seconds_of(log), log.values
    out: dict[str, Callable[[Values], Values]] = {}
    rate = values.get("table_rate")
    if rate is not None:
        out["table_rate"] = lambda tau: _bent_line(own, rate, tau)
    if "table_angle" in values:
        angle = values["table_angle"]
        slope = np.gradient(angle, own)
        if rate is not None and np.ptp(rate) > 0 and np.ptp(slope) > 0 and np.corrcoef(slope, rate)[0, 1] > SAME_SIGN:
            slope = rate  # and not its size only
        out["table_angle"] = lambda tau: _cubic(own, angle, slope, tau)
    if ATTITUDE[0] in values:
        from scipy.interpolate import make_interp_spline  # noqa: PLC0415  (0.3 s, needed by attitude logs alone)

        spline = make_interp_spline(own, continuous(np.column_stack([values[c] for c in ATTITUDE])), k=5)
        for index, channel in enumerate(ATTITUDE):
            out[channel] = lambda tau, i=index: _unit(spline(np.clip(tau, 0.0, own[-1])))[:, i]  # type: ignore[misc]
    return out


def _unit(q: Values) -> Values:
    unit: Values = q / np.linalg.norm(q, axis=1, keepdims=True)
    return unit


def _bent_line(own: Values, value: Values, tau: Values) -> Values:
    """Return a line from sample to sample, which bends within an interval where the lines on either side meet in it.

    A bend is what changes the slope by far more than it changes elsewhere.
    """
    tau = np.clip(tau, own[0], own[-1])
    plain: Values = np.interp(tau, own, value)
    slope = np.diff(value) / np.diff(own)
    if len(slope) < 3:
        return plain
    change = np.abs(slope[2:] - slope[:-2])
    k = np.clip(np.searchsorted(own, tau, side="right") - 1, 1, len(own) - 3)
    before, after = slope[k - 1], slope[k + 1]
    left = value[k] + before * (tau - own[k])
    right = value[k + 1] + after * (tau - own[k + 1])
    ahead, h = value[k + 1] - value[k], own[k + 1] - own[k]
    meet = (before * h - ahead) * (after * h - ahead) <= 0  # the slope between lies between those on either side
    bent = meet & (change[k - 1] > BENT * np.median(change)) & (tau >= own[1]) & (tau <= own[-2])
    return np.where(bent, np.where(before > after, np.minimum(left, right), np.maximum(left, right)), plain)


def _cubic(own: Values, value: Values, slope: Values, tau: Values) -> Values:
    """Return the cubic through value and slope at both ends of the interval that each time falls into."""
    k = np.clip(np.searchsorted(own, tau, side="right") - 1, 0, len(own) - 2)
    h = own[k + 1] - own[k]
    x = np.clip((tau - own[k]) / h, 0.0, 1.0)
    rise = value[k + 1] - value[k] - slope[k] * h
    bend = (slope[k + 1] - slope[k]) * h
    found: Values = value[k] + x * slope[k] * h + x * x * (3 * rise - bend) + x**3 * (bend - 2 * rise)
    return found


def body_rates(q: Values, step: float) -> Values:
    """Return ``omega = 2 vec(conj(q) dq/dt)`` of attitudes on a regular grid: (n, 3) array, deg/s."""
    rates: Values = np.degrees(2.0 * conjugate_product(q, np.gradient(q, step, axis=0)))
    return rates
