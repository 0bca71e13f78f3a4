"""A table's log with a clock of its own, brought to the sensor's by the motion that both saw.

    tau = t + d + k (t - t_m)

    |w|(t) = a |r|(tau) + b + noise

where

    t, tau : the sensor's and the table's clock, s
    t_m    : middle of the time that both logs cover, s
    d, k   : offset and drift of the table's clock, s and 1
    w, r   : angular rate read by the sensor and that of the table, deg/s
    a, b   : scale and bias of the reading, not used further

``d`` is found by correlation on a grid, then all four by Gauss-Newton. What is left is no white noise: it is largest
where the rate changes, which is where the clocks are seen, and correlated by the sensor's filter. So the covariance is
taken from what the fit's blocks of a second say against each other,

    C = (J'J)^-1 (sum_b s_b s_b') (J'J)^-1,   s_b = J_b' e_b

where J are the derivatives and e the residuals. The table's channels are interpolated at the sensor's times; rows that
its log does not cover are left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.formats.channel_table import ChannelTable
from pipeline.formats.ingest_error import IngestError
from pipeline.formats.units import ATTITUDE, TRIADS
from pipeline.records import Note

if TYPE_CHECKING:
    from numpy.typing import NDArray

TABLE_TIME = "table_time"
CHANNELS = ("table_angle", "table_rate", *ATTITUDE)
GRID_S = 0.01
MOST_GRID_POINTS = 1 << 18
ALIKE = 0.9
BLOCK_S = 1.0
APART_S, AMBIGUOUS = 2.0, 0.98
STEPS = 12


@dataclass(frozen=True)
class ClockFit:
    """Offset (s) and drift (1) of the table's clock with standard uncertainties, and how alike the motions are."""

    offset: float
    drift: float
    offset_uncertainty: float
    drift_uncertainty: float
    middle: float
    correlation: float


def own_rows(table: ChannelTable) -> ChannelTable:
    """Return the table's channels of a log whose rows hold a time of the table's own."""
    time = np.rint(table.values[TABLE_TIME]).astype(np.int64)
    new = np.concatenate([[True], time[1:] > np.maximum.accumulate(time)[:-1]])
    values = {c: table.values[c][new] for c in CHANNELS if c in table.values}
    return ChannelTable(table.path, time[new], values, table.source, table.line_of)


def align(sensor: ChannelTable, log: ChannelTable) -> ChannelTable:
    """Return a sensor's log with the channels of a table's log at its own times.

    Parameters
    ----------
    sensor : ChannelTable
        With a gyroscope.
    log : ChannelTable
        With the table's rate or angle.

    Raises
    ------
    IngestError
        If the two logs do not show the same motion.
    """
    fit = fit_clocks(sensor, log)
    t = (sensor.time_ns - sensor.time_ns[0]) / 1e9
    tau = t + fit.offset + fit.drift * (t - fit.middle)
    own = (log.time_ns - log.time_ns[0]) / 1e9
    inside = np.flatnonzero((tau >= 0) & (tau <= own[-1]))
    if inside.size < 2:
        raise IngestError("no time is covered by both logs", log.path, fault="no_sync")
    start, stop = int(inside[0]), int(inside[-1]) + 1
    values = {c: v[start:stop] for c, v in sensor.values.items() if c not in (*CHANNELS, TABLE_TIME)}
    table = {c: np.interp(tau[start:stop], own, v) for c, v in log.values.items() if c in CHANNELS}
    if ATTITUDE[0] in table:
        table |= _attitude(log, own, tau[start:stop])
    offset_s = float(log.time_ns[0] - sensor.time_ns[0]) / 1e9 + fit.offset
    clock = {
        "offset_s": offset_s,
        "offset_uncertainty_s": fit.offset_uncertainty,
        "drift_ppm": fit.drift * 1e6,
        "drift_uncertainty_ppm": fit.drift_uncertainty * 1e6,
        "correlation": fit.correlation,
    }
    detail = (
        f"the table's clock is {offset_s:.6g} s (+- {fit.offset_uncertainty:.1g} s, one standard deviation) ahead of "
        f"the sensor's and gains {fit.drift * 1e6:.3g} ppm (+- {fit.drift_uncertainty * 1e6:.1g}); brought together by "
        f"the motion that both saw (correlation {fit.correlation:.4f})"
    )
    first, last = sensor.line_of(start), sensor.line_of(stop - 1)
    notes = [Note("N-SYNC", stop - start, first, last, detail, float(t[start]), float(t[stop - 1]))]
    lost = len(t) - (stop - start)
    if lost:
        notes.append(Note("N-CUT", lost, first, last, f"{lost} rows that the table's log does not cover were left out"))
    return ChannelTable(
        path=sensor.path,
        time_ns=sensor.time_ns[start:stop],
        values=values | table,
        source={**sensor.source, "table_log": log.source, "table_clock": clock},
        line_of=lambda row: sensor.line_of(row + start),
        encodings={c: e for c, e in sensor.encodings.items() if c in values},
        notes=(*sensor.notes, *log.notes, *notes) if log.source is not sensor.source else (*sensor.notes, *notes),
        flags=None if sensor.flags is None else sensor.flags[start:stop],
    )


def fit_clocks(sensor: ChannelTable, log: ChannelTable) -> ClockFit:
    """Return offset and drift of the table's clock, both times counted from the first sample of each log."""
    if "gyro_x" not in sensor.values:
        raise IngestError("a table's log with its own clock needs a gyroscope to be aligned", log.path, fault="no_sync")
    t, own = ((x.time_ns - x.time_ns[0]) / 1e9 for x in (sensor, log))
    w = np.sqrt(sum(sensor.values[c] ** 2 for c in TRIADS["gyroscope"]))
    r = np.abs(_table_rate(log, own))
    offset, rival = _coarse_offset(t, w, own, r)
    inside = (t + offset >= 0) & (t + offset <= own[-1])
    if inside.sum() < 20:
        raise _unlike(log, 0.0)
    t, w = t[inside], w[inside]
    fit = _refine((t, w), (own, r), offset, log)
    if rival > AMBIGUOUS:
        raise IngestError(
            "the motion repeats itself, and the table's log fits the gyroscope's at several times alike",
            log.path,
            fault="no_sync",
            hint="begin or end the recording with a turn of its own",
        )
    return fit


def _table_rate(log: ChannelTable, own: NDArray[np.float64]) -> NDArray[np.float64]:
    if "table_rate" in log.values:
        return np.asarray(log.values["table_rate"])
    if "table_angle" in log.values:
        return np.asarray(np.gradient(log.values["table_angle"], own))
    if ATTITUDE[0] in log.values:
        q = np.column_stack([log.values[c] for c in ATTITUDE])
        steps = 2 * np.degrees(np.arccos(np.clip(np.abs(np.sum(q[1:] * q[:-1], axis=1)), 0, 1))) / np.diff(own)
        return np.asarray(np.interp(own, (own[1:] + own[:-1]) / 2, steps))
    raise IngestError("the table's log holds neither rate, angle nor attitude", log.path, fault="no_sync")


def _coarse_offset(
    t: NDArray[np.float64], w: NDArray[np.float64], own: NDArray[np.float64], r: NDArray[np.float64]
) -> tuple[float, float]:
    """Return the lag at which the motions are most alike, s, and how alike they are elsewhere, relative to that."""
    step = max(GRID_S, (t[-1] + own[-1]) / MOST_GRID_POINTS)
    one, two = (np.interp(np.arange(0, x[-1], step), x, y) for x, y in ((t, w), (own, r)))
    size = len(one) + len(two)
    product = np.fft.irfft(np.fft.rfft(two - two.mean(), size) * np.conj(np.fft.rfft(one - one.mean(), size)), size)
    lag = int(np.argmax(product))
    away = np.roll(product, -lag)
    near = round(APART_S / step)
    rival = float(away[near:-near].max()) / float(max(product[lag], 1e-300)) if size > 2 * near else 0.0
    return float((lag if lag < len(two) else lag - size) * step), rival


def _refine(
    read: tuple[NDArray[np.float64], NDArray[np.float64]],
    moved: tuple[NDArray[np.float64], NDArray[np.float64]],
    offset: float,
    log: ChannelTable,
) -> ClockFit:
    """Fit offset and drift, given times and rates of both."""
    (t, w), (own, r) = read, moved
    middle = float(t[0] + t[-1]) / 2
    slope = np.gradient(r, own)
    d, k, a, b = offset, 0.0, 1.0, 0.0
    for _ in range(STEPS):
        tau = t + d + k * (t - middle)
        here, steep = np.interp(tau, own, r), np.interp(tau, own, slope)
        J = np.column_stack([a * steep, a * steep * (t - middle), here, np.ones_like(t)])
        size: NDArray[np.float64] = np.linalg.norm(J, axis=0)
        if np.any(size == 0):
            raise _unlike(log, 0.0)
        residual = w - (a * here + b)
        change = np.linalg.lstsq(J / size, residual, rcond=None)[0] / size
        d, k, a, b = d + change[0], k + change[1], a + change[2], b + change[3]
    spread = _standard_uncertainty(J / size, residual, t) / size
    correlation = float(np.corrcoef(w, here)[0, 1]) if np.ptp(here) * np.ptp(w) > 0 else 0.0
    if not correlation > ALIKE:
        raise _unlike(log, correlation)
    return ClockFit(float(d), float(k), float(spread[0]), float(spread[1]), middle, correlation)


def _standard_uncertainty(
    J: NDArray[np.float64], residual: NDArray[np.float64], t: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the standard uncertainties of parameters, by blocks of a second."""
    starts = np.flatnonzero(np.diff(np.floor((t - t[0]) / BLOCK_S), prepend=-1.0))
    scores = np.add.reduceat(J * residual[:, None], starts)
    R: NDArray[np.float64] = np.asarray(np.linalg.qr(J, mode="r"))
    inverse = np.linalg.solve(R, np.eye(J.shape[1]))
    spread: NDArray[np.float64] = np.linalg.norm(inverse @ (inverse.T @ scores.T), axis=1)
    return spread


def _unlike(log: ChannelTable, correlation: float) -> IngestError:
    return IngestError(
        f"the table's log does not show the motion that the gyroscope saw (correlation {correlation:.2f} at best)",
        log.path,
        fault="no_sync",
        hint="do both logs belong to one recording, and are their units right?",
    )


def _attitude(log: ChannelTable, own: NDArray[np.float64], tau: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """Return the attitude between two samples of the table: the normalised mean of the quaternions beside it."""
    q = np.column_stack([log.values[c] for c in ATTITUDE])
    signs = np.cumprod(np.concatenate([[1.0], np.where(np.sum(q[1:] * q[:-1], axis=1) < 0, -1.0, 1.0)]))
    q = q * signs[:, None]
    between = np.column_stack([np.interp(tau, own, q[:, i]) for i in range(4)])
    between /= np.linalg.norm(between, axis=1, keepdims=True)
    return {c: between[:, i] for i, c in enumerate(ATTITUDE)}
