"""Motion of a table without encoders, from its commanded program and the moves in the data.

    A(t) = P(tau),   r(t) = P'(tau),   tau = m_j + (1 + k) (t - t_j) + d_j       near move j

with the commanded angle P, deg, by the program's time; the middle m_j of move j, which is at the sensor's time t_j by
offset and drift of the whole program (``pipeline.io.clock_alignment``); and the move's deviation d_j from that, s. The
drift k during moves is separate, as pauses between moves would look like a drift.

``d_j`` and ``k`` are fitted to the readings w = a P'(tau) + b of the gyroscope about the move, so a table that pauses
between moves is followed from rest to rest. Lost steps of the motors are not observable and belong to its accuracy.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.io.channel_table import ChannelTable
from pipeline.io.clock_alignment import fit_clocks
from pipeline.io.encoder_log import seconds_of
from pipeline.io.units import TRIADS
from pipeline.records import Note

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from pipeline.records import Index, Values


STEP_S = 0.005  # grid of the program and of its derivative, half the interval of a log at 100 Hz
BEFORE_S = 1.0  # rest that is added at both ends
ROUNDS = 12  # iterations at most; they end where no move changes by 1 us
FARTHEST = 0.5  # of the rest beside a move


def follow_program(table: ChannelTable, program: Sequence[Mapping[str, Any]]) -> ChannelTable:
    """Return a log with the angle and rate of a table that was commanded so; the gyroscope must show the moves.

    ``program`` has rests ``{rest_s}``, turns ``{turn_deg, rate_dps, acceleration_dps2}`` and ``{repeat, steps}``.
    """
    knots = knots_of(program)
    fit = fit_clocks(table, _as_log(table, knots))
    t = seconds_of(table)
    placed = _place(table, knots, t, fit.table_time(t))
    angle, rate = at(knots, placed.tau(t))
    shifts = placed.shifts
    begun, farthest = round(placed.begun, 3) + 0.0, float(np.abs(shifts).max())
    detail = (
        f"the table is followed from its program: {len(shifts)} move{'s'[: len(shifts) > 1]}, begun {begun:.3f} "
        f"s after the first sample by a clock that gains {placed.drift * 1e6:.3g} ppm, each placed by the gyroscope "
        f"(up to {farthest:.2g} s off the program; correlation {fit.correlation:.5f}); angles and rates are those "
        "commanded"
    )
    note = Note("N-PROGRAM", len(shifts), 0, 0, detail, float(table.time_ns[0]) / 1e9, float(table.time_ns[-1]) / 1e9)
    values = {**table.values, "table_angle": angle, "table_rate": rate}
    return replace(table, values=values, notes=(*table.notes, note))


def knots_of(program: Sequence[Mapping[str, Any]]) -> Values:
    """Return time (s), angle (deg), rate (deg/s) and acceleration (deg/s^2) at the knots of a program: (m, 4) array."""
    time, angle = BEFORE_S, 0.0
    rows = [(0.0, 0.0, 0.0, 0.0)]
    for step in _flat(program):
        if "rest_s" in step:
            time += float(step["rest_s"])
            continue
        turn, acceleration = float(step["turn_deg"]), float(step["acceleration_dps2"])
        sign = float(np.sign(turn))
        top = min(float(step["rate_dps"]), float(np.sqrt(abs(turn) * acceleration)))
        ramp, hold = top / acceleration, abs(turn) / top - top / acceleration
        half = sign * 0.5 * top * ramp
        rows += [
            (time, angle, 0.0, sign * acceleration),
            (time + ramp, angle + half, sign * top, 0.0),
            (time + ramp + hold, angle + turn - half, sign * top, -sign * acceleration),
            (time + 2 * ramp + hold, angle + turn, 0.0, 0.0),
        ]
        time, angle = time + 2 * ramp + hold, angle + turn
    rows.append((time + BEFORE_S, angle, 0.0, 0.0))
    return np.array(rows)


def _flat(program: Sequence[Mapping[str, Any]]) -> Iterator[Mapping[str, Any]]:
    for step in program:
        if "repeat" in step:
            for _ in range(int(step["repeat"])):
                yield from _flat(step["steps"])
        else:
            yield step


def at(knots: Values, time: Values) -> tuple[Values, Values]:
    """Return the commanded angle (deg) and rate (deg/s) at any times; it rests before and after."""
    k = np.clip(np.searchsorted(knots[:, 0], time, side="right") - 1, 0, len(knots) - 1)
    s = np.maximum(time - knots[k, 0], 0.0)
    rate: Values = knots[k, 2] + knots[k, 3] * s
    return knots[k, 1] + (knots[k, 2] + 0.5 * knots[k, 3] * s) * s, rate


def moves_of(knots: Values) -> list[tuple[float, float]]:
    """Return begin and end of each move, s of the program."""
    starts = [i for i in range(len(knots)) if knots[i, 2] == 0 and knots[i, 3] != 0]
    return [(float(knots[i, 0]), float(knots[i + 3, 0])) for i in starts]


def _as_log(table: ChannelTable, knots: Values) -> ChannelTable:
    own = np.arange(0.0, knots[-1, 0], STEP_S)
    angle, rate = at(knots, own)
    values = {"table_angle": angle, "table_rate": rate}
    return ChannelTable(table.path, np.rint(own * 1e9).astype(np.int64), values, table.source, table.line_of)


@dataclass(frozen=True)
class _Placed:
    """The moves of a program, placed: which move each sample is near to, and m_j, t_j, d_j and k."""

    near: Index
    middle: Values
    time: Values
    shifts: Values
    drift: float
    low: Values  # end of the move before, by the program
    high: Values  # begin of the move after

    @property
    def begun(self) -> float:
        """The sensor's time at which the program began, s."""
        since = float(self.middle[0] + self.shifts[0]) - BEFORE_S
        return float(self.time[0]) - since / (1.0 + self.drift)

    def tau(self, t: Values) -> Values:
        """Return the program's time of times of the sensor, s."""
        j = self.near
        tau: Values = self.middle[j] + (1.0 + self.drift) * (t - self.time[j]) + self.shifts[j]
        return np.clip(tau, self.low[j], self.high[j])


def _place(table: ChannelTable, knots: Values, t: Values, tau: Values) -> _Placed:
    """Place each move by the readings of the gyroscope about it."""
    begin, end = np.array(moves_of(knots)).T
    gaps = begin[1:] - end[:-1]
    middle, n = (begin + end) / 2, len(begin)
    near = np.searchsorted(end[:-1] + gaps / 2, tau)
    low, high = np.append(-np.inf, end[:-1]), np.append(begin[1:], np.inf)
    placed = _Placed(near, middle, np.interp(middle, tau, t), np.zeros(n), 0.0, low, high)
    reach = FARTHEST * np.minimum(np.append(np.inf, gaps), np.append(gaps, np.inf))
    reach = np.minimum(reach, end - begin + 1.0)
    for _ in range(ROUNDS):
        now = placed.tau(t)
        commanded = at(knots, now)[1]
        sensed = _about_the_moves(table, commanded)
        slope = (at(knots, now + STEP_S)[1] - at(knots, now - STEP_S)[1]) / (2 * STEP_S)
        off = slope * (sensed - commanded)
        info = np.bincount(near, slope**2, n)
        change = np.divide(np.bincount(near, off, n), info, out=np.zeros(n), where=info > 0)
        since = t - placed.time[near]
        lever = since - np.divide(np.bincount(near, slope**2 * since, n), info, out=np.zeros(n), where=info > 0)[near]
        gain = float(np.sum(off * lever)) / max(float(np.sum((slope * lever) ** 2)), 1e-300)
        shifts = np.clip(placed.shifts + change, -reach, reach)
        placed = replace(placed, shifts=shifts, drift=placed.drift + gain)
        if float(np.abs(change).max()) < 1e-6:
            break
    return placed


def _about_the_moves(table: ChannelTable, commanded: Values) -> Values:
    """Return what the gyroscope reads about the axis of the moves, its scale and bias taken out: (n,) array, deg/s."""
    rates = np.column_stack([table.values[c] for c in TRIADS["gyroscope"]])
    columns = np.column_stack([commanded, np.ones_like(commanded)])
    fitted = np.linalg.lstsq(columns, rates, rcond=None)[0]
    axis = int(np.argmax(np.abs(fitted[0])))
    scale, bias = fitted[:, axis]
    about: Values = (rates[:, axis] - bias) / scale
    return about
