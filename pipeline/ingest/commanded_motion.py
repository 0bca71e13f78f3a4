"""Reconstruct the motion of a table without encoders from its commanded program and the moves in the data.

    A(t) = P(tau),   r(t) = P'(tau),   tau = m_j + (1 + k) (t - t_j) + d_j       near move j

with the commanded angle P, deg, at the program's time tau. The middle m_j of move j is at the sensor's time t_j by
offset and drift of the whole program (``pipeline.ingest.clock_alignment``); d_j is the deviation of the move from that,
s. The drift k during moves is separate, because pauses between moves would bias it.

``d_j`` and ``k`` are fitted to the readings w = a P'(tau) + b of the gyroscope near the move, so that pauses between
moves may have any length. Lost steps of the motors are not observable; they are part of the table's accuracy.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from imu_logs.log import Log
from imu_logs.units import TRIADS
from pipeline.core.records import Index, Note, Values
from pipeline.core.settings import ProgramRest, ProgramTurn, Repeated
from pipeline.ingest.clock_alignment import fit_clocks, seconds_of

PROGRAM_STEP_S = 0.005  # grid of the program and of its derivative, half the interval of a log at 100 Hz
BEFORE_S = 1.0  # rest that is added at both ends
MAX_FIT_ITERATIONS = 12  # iterations at most; they end where no move changes by 1 us
MAX_SHARE_OF_REST = 0.5  # of the rest before or after a move


def follow_program(table: Log, program: Sequence[ProgramRest | ProgramTurn | Repeated]) -> Log:
    """Add the angle and rate of a table with this program to a log; the gyroscope must show the moves."""
    pause = ProgramRest(rest_s=BEFORE_S)
    commanded = Program([pause, *_flat(program), pause])
    times = np.arange(0.0, commanded.duration, PROGRAM_STEP_S)
    angle, rate, *_ = commanded.at(times)
    log = {"table_angle": angle, "table_rate": rate}
    fit = fit_clocks(table, Log(table.path, np.rint(times * 1e9).astype(np.int64), log, table.source))
    t = seconds_of(table)
    tau, shifts, drift, begun = _place(table, commanded, t, fit.table_time(t))
    angle, rate, *_ = commanded.at(tau)
    begun, farthest = round(begun, 3) + 0.0, float(np.abs(shifts).max())
    detail = (
        f"the table is followed from its program: {len(shifts)} move{'s'[: len(shifts) > 1]}, begun {begun:.3f} "
        f"s after the first sample by a clock that gains {drift * 1e6:.3g} ppm, each placed by the gyroscope "
        f"(up to {farthest:.2g} s off the program; correlation {fit.correlation:.5f}); angles and rates are those "
        "commanded"
    )
    note = Note("N-PROGRAM", len(shifts), 0, 0, detail, float(table.time_ns[0]) / 1e9, float(table.time_ns[-1]) / 1e9)
    values = {**table.values, "table_angle": angle, "table_rate": rate}
    source = {**table.source, "program": [step.json_value for step in program]}
    return replace(table, values=values, notes=(*table.notes, note), source=source)


class Program:
    """Commanded motion of one axis of a table: rests, and turns with a trapezoidal rate.

        A(t) = A_k + W_k s + a_k s^2 / 2,   dA/dt = W_k + a_k s,   s = t - t_k

    A turn by the angle D at the rate r with acceleration a ramps for r/a, holds r and ramps down; where |D| < r^2/a it
    does not reach r, and the ramps meet in the middle. The table rests before and after the program.

    ``knots``: (1 + 4 n, 4) array of time t_k
    (s), angle A_k (deg), rate W_k (deg/s) and acceleration a_k (deg/s^2), four rows for each of n moves. ``stops``:
    (n + 1,) array of the angles before each move and after the last, deg. ``duration``: in s.
    """

    def __init__(self, steps: Iterable[ProgramRest | ProgramTurn]) -> None:
        self.steps = list(steps)
        time, angle, rows = 0.0, 0.0, [(0.0, 0.0, 0.0, 0.0)]
        for step in self.steps:
            if isinstance(step, ProgramRest):
                time += step.rest_s
                continue
            turn = step.turn_deg
            if turn == 0.0:
                continue
            acceleration, sign = step.acceleration_dps2, float(np.sign(turn))
            top = min(step.rate_dps, float(np.sqrt(abs(turn) * acceleration)))
            ramp, hold = top / acceleration, abs(turn) / top - top / acceleration
            half = sign * 0.5 * top * ramp
            rows += [
                (time, angle, 0.0, sign * acceleration),
                (time + ramp, angle + half, sign * top, 0.0),
                (time + ramp + hold, angle + turn - half, sign * top, -sign * acceleration),
                (time + 2 * ramp + hold, angle + turn, 0.0, 0.0),
            ]
            time, angle = time + 2 * ramp + hold, angle + turn
        self.knots, self.duration = np.array(rows), time
        self.stops: Values = self.knots[::4, 1]

    def at(self, time: Values) -> tuple[Values, Values, Values, Index]:
        """Return angle, rate, acceleration and index of the present or last move (-1: before the first), (n,) each."""
        k = np.clip(np.searchsorted(self.knots[:, 0], time, side="right") - 1, 0, None)
        s = np.clip(time - self.knots[k, 0], 0.0, None)
        _, angle, rate, acceleration = self.knots[k].T
        return angle + (rate + 0.5 * acceleration * s) * s, rate + acceleration * s, acceleration, (k - 1) // 4


def _flat(program: Sequence[ProgramRest | ProgramTurn | Repeated]) -> Iterator[ProgramRest | ProgramTurn]:
    """Yield the steps of a program, with repetitions expanded."""
    for step in program:
        if isinstance(step, Repeated):
            yield from step.repeat * step.steps
        else:
            yield step


def _place(table: Log, program: Program, t: Values, tau: Values) -> tuple[Values, Values, float, float]:
    """Fit the time of each move to the readings of the gyroscope near it.

    Returns the program's time at the sensor's times, s; the deviation of each move, s; the drift; and the sensor's time
    at which the program began, s. ``tau`` is the program's time from offset and drift alone.
    """
    begin, end = program.knots[1::4, 0], program.knots[4::4, 0]
    gaps = begin[1:] - end[:-1]
    middle, n = (begin + end) / 2, len(begin)
    near = np.searchsorted(end[:-1] + gaps / 2, tau)  # the nearest move of each sample
    low, high = np.append(-np.inf, end[:-1])[near], np.append(begin[1:], np.inf)[near]  # between its neighbours
    at = np.interp(middle, tau, t)
    since = t - at[near]
    reach = MAX_SHARE_OF_REST * np.minimum(np.append(np.inf, gaps), np.append(gaps, np.inf))
    reach = np.minimum(reach, end - begin + 1.0)
    shifts, drift = np.zeros(n), 0.0
    for _ in range(MAX_FIT_ITERATIONS):
        now = np.clip(middle[near] + (1.0 + drift) * since + shifts[near], low, high)
        commanded = program.at(now)[1]
        sensed = _about_the_moves(table, commanded)
        slope = (program.at(now + PROGRAM_STEP_S)[1] - program.at(now - PROGRAM_STEP_S)[1]) / (2 * PROGRAM_STEP_S)
        off = slope * (sensed - commanded)
        info = np.bincount(near, slope**2, n)
        change = np.divide(np.bincount(near, off, n), info, out=np.zeros(n), where=info > 0)
        lever = since - np.divide(np.bincount(near, slope**2 * since, n), info, out=np.zeros(n), where=info > 0)[near]
        drift += float(np.sum(off * lever)) / max(float(np.sum((slope * lever) ** 2)), 1e-300)
        shifts = np.clip(shifts + change, -reach, reach)
        if float(np.abs(change).max()) < 1e-6:
            break
    begun = float(at[0]) - (float(middle[0] + shifts[0]) - BEFORE_S) / (1.0 + drift)
    return np.clip(middle[near] + (1.0 + drift) * since + shifts[near], low, high), shifts, drift, begun


def _about_the_moves(table: Log, commanded: Values) -> Values:
    """Return the rate about the axis of the moves by the gyroscope, corrected for scale and bias: (n,) array, deg/s."""
    rates = np.column_stack([table.values[c] for c in TRIADS["gyroscope"]])
    columns = np.column_stack([commanded, np.ones_like(commanded)])
    fitted = np.linalg.lstsq(columns, rates, rcond=None)[0]
    axis = int(np.argmax(np.abs(fitted[0])))
    scale, bias = fitted[:, axis]
    about: Values = (rates[:, axis] - bias) / scale
    return about
