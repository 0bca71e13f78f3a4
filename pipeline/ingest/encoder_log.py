"""Interpolate the log of a table's encoders that has a separate clock, and merge it with the log of a sensor.

    rate r and angle A of the turn     the gyroscope responds to r, the accelerometer to (cos A, sin A)
    attitude q                         the gyroscope responds to omega, the accelerometer to R(q)^T e_z

Between two samples the angle is the cubic through angle and rate at both ends, exact for constant acceleration. The
rate is linear, with one bend where the slopes on both sides require it. The attitude is the quintic spline of its
components.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from imu_logs.log import Log
from imu_logs.units import ATTITUDE, TABLE_CHANNELS, TABLE_TIME
from pipeline.core.errors import IngestError
from pipeline.core.records import conjugate_product, continuous, level_in_body

if TYPE_CHECKING:
    from collections.abc import Callable

    from pipeline.core.records import Mask, Values


ENCODER_STEP_S, FINEST_OF_ATTITUDE_S = 0.0025, 0.01  # steps of the grid; only the rate of one axis is known to bend
MOST_POINTS = 1 << 18  # bounds memory and the cost of correlation; a power of 2 for the transform
BENT_SLOPE_RATIO = 8.0  # times the median change of slope
RESTING_DPS = 0.5  # smallest range of the rate that is called a motion
SAME_SIGN = 0.9  # correlation of the logged rate with the slope of the angle


@dataclass(frozen=True)
class Signals:
    """Signals of a table's motion to which sensors respond, on a regular grid of time since the log's first sample."""

    step: float  # of the grid, s
    rates: Values  # (n, m), deg/s, for angular rates
    directions: Values  # (n, p), for specific forces; p is 0 where the log does not determine them
    interval: float  # median of the log, s
    magnitude: bool = False  # whether only the magnitude of the rate is known

    @property
    def duration(self) -> float:
        """Length of the log, s."""
        return self.step * (len(self.rates) - 1)

    @property
    def resting(self) -> bool:
        """Whether the table rests throughout."""
        return bool(np.ptp(self.rates, axis=0).max() < RESTING_DPS)

    def covers(self, tau: Values) -> Mask:
        """Return which times are within the log."""
        return np.asarray((tau >= 0) & (tau <= self.duration))

    def at(self, tau: Values) -> tuple[Values, Values, Values, Values]:
        """Return rates, directions, and their derivatives, at any times; constant beyond the ends of the log."""
        place = np.clip(tau / self.step, 0.0, len(self.rates) - 1.000001)
        k = place.astype(np.intp)
        x = (place - k)[:, None]
        inside = self.covers(tau)[:, None]
        r, r_next, u, u_next = self.rates[k], self.rates[k + 1], self.directions[k], self.directions[k + 1]
        slope = inside / self.step
        return r + (r_next - r) * x, u + (u_next - u) * x, (r_next - r) * slope, (u_next - u) * slope


def own_rows(table: Log) -> Log:
    """Return the table's channels of a log whose rows have a separate time of the table."""
    time = np.rint(table.values[TABLE_TIME]).astype(np.int64)
    new = np.concatenate([[True], time[1:] > np.maximum.accumulate(time)[:-1]])
    values = {c: table.values[c] for c in TABLE_CHANNELS if c in table.values}
    return Log(table.path, time, values, table.source, table.lines).select(new)


def unwrapped(table: Log) -> Log:
    """Make the table's angle continuous where the encoder restarts at 0 or 360 deg.

    A table turns by less than half a turn between two samples, so that a larger step is a restart of the encoder.
    """
    angle = table.values.get("table_angle")
    if angle is None or len(angle) < 2:
        return table
    rows = np.flatnonzero(np.abs(np.diff(angle)) > 180.0) + 1
    if not rows.size:
        return table
    values = {**table.values, "table_angle": np.asarray(np.unwrap(angle, period=360.0))}
    note = table.note("N-UNWRAP", rows, "the table's angle restarted at a full turn and was continued")
    return replace(table, values=values, notes=(*table.notes, note))


def signals_of(log: Log) -> Signals:
    """Return the signals of a table's motion; raise ``IngestError`` for a log without rate, angle and attitude."""
    log_time = seconds_of(log)
    found = interpolators(log)
    step = max(FINEST_OF_ATTITUDE_S if ATTITUDE[0] in found else ENCODER_STEP_S, log_time[-1] / MOST_POINTS)
    grid = step * np.arange(int(log_time[-1] / step) + 1)
    interval = float(np.median(np.diff(log_time)))
    if ATTITUDE[0] in found:
        q = np.column_stack([found[c](grid) for c in ATTITUDE])
        rates = np.degrees(2.0 * conjugate_product(q, np.gradient(q, step, axis=0)))  # 2 vec(conj(q) dq/dt)
        return Signals(step, rates, level_in_body(q), interval)
    if "table_angle" in found:
        angle = found["table_angle"](grid)
        rate = found["table_rate"](grid) if "table_rate" in found else np.gradient(angle, grid)
        turn = np.radians(angle)
        return Signals(step, rate[:, None], np.column_stack([np.cos(turn), np.sin(turn)]), interval)
    if "table_rate" in found:
        rate = found["table_rate"](grid)
        return Signals(step, rate[:, None], np.zeros((len(grid), 0)), interval, magnitude=bool(rate.min() >= 0))
    raise IngestError("the table's log holds neither rate, angle nor attitude", log.path, code="no_sync")


def seconds_of(table: Log) -> Values:
    """Return the times of a log since its first sample, s."""
    return np.asarray((table.time_ns - table.time_ns[0]) / 1e9)


def interpolators(log: Log) -> dict[str, Callable[[Values], Values]]:
    """Return an interpolating function of the table's time, s, for each channel."""
    log_time, values = seconds_of(log), log.values
    out: dict[str, Callable[[Values], Values]] = {}
    rate = values.get("table_rate")
    if rate is not None:
        out["table_rate"] = lambda tau: _bent_line(log_time, rate, tau)
    if "table_angle" in values:
        angle = values["table_angle"]
        slope = np.gradient(angle, log_time)
        if rate is not None and np.ptp(rate) > 0 and np.ptp(slope) > 0 and np.corrcoef(slope, rate)[0, 1] > SAME_SIGN:
            slope = rate  # it holds the sign as well
        from scipy.interpolate import CubicHermiteSpline  # noqa: PLC0415  (0.3 s, needed by tables' logs alone)

        cubic = CubicHermiteSpline(log_time, angle, slope)
        out["table_angle"] = lambda tau: cubic(np.clip(tau, log_time[0], log_time[-1]))
    if ATTITUDE[0] in values:
        from scipy.interpolate import make_interp_spline  # noqa: PLC0415  (0.3 s, needed by attitude logs alone)

        spline = make_interp_spline(log_time, continuous(np.column_stack([values[c] for c in ATTITUDE])), k=5)
        for index, channel in enumerate(ATTITUDE):
            out[channel] = lambda tau, i=index: _unit(spline(np.clip(tau, 0.0, log_time[-1])))[:, i]  # type: ignore[misc]
    return out


def _unit(q: Values) -> Values:
    return np.asarray(q / np.linalg.norm(q, axis=1, keepdims=True))


def _bent_line(log_time: Values, value: Values, tau: Values) -> Values:
    """Interpolate linearly, with a bend within an interval where the lines of its two neighbours meet in it.

    At a bend the slope changes by far more than elsewhere.
    """
    tau = np.clip(tau, log_time[0], log_time[-1])
    plain: Values = np.interp(tau, log_time, value)
    slope = np.diff(value) / np.diff(log_time)
    if len(slope) < 3:
        return plain
    change = np.abs(slope[2:] - slope[:-2])
    k = np.clip(np.searchsorted(log_time, tau, side="right") - 1, 1, len(log_time) - 3)
    before, after = slope[k - 1], slope[k + 1]
    left = value[k] + before * (tau - log_time[k])
    right = value[k + 1] + after * (tau - log_time[k + 1])
    ahead, h = value[k + 1] - value[k], log_time[k + 1] - log_time[k]
    meet = (before * h - ahead) * (after * h - ahead) <= 0  # the slope lies between the slopes on either side
    bent = meet & (change[k - 1] > BENT_SLOPE_RATIO * np.median(change)) & (tau >= log_time[1]) & (tau <= log_time[-2])
    return np.where(bent, np.where(before > after, np.minimum(left, right), np.maximum(left, right)), plain)
