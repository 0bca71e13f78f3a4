"""Align the log or the program of a table with the clock of a sensor, by the motion in the readings, and merge them.

    tau  = t + d + k (t - t_m)
    w(t) = A r(tau) + a + noise,   f(t) = B u(tau) + b + noise

with the sensor's and the table's clock t and tau, s; offset d and drift k of the table's clock, uncorrelated at t_m;
readings w and f; and the signals r and u of the table's log to which they respond.

``d`` is first found by correlation on a grid. The steps of a table repeat, but the directions of gravity at the steps
do not: of the offsets with similar correlation, the one with the smallest residual of the whole model is selected. The
table is assumed at rest before and after its log. If no offset fits with this assumption, only the times that both logs
cover are compared. Then d and k are refined by Gauss-Newton, with A, B, a, b eliminated by projection.

The residuals are not white: they are largest where the rate changes, and there the offset is determined. So the
covariance is a sandwich estimate from the scatter between blocks,

    C = H^-1 (sum_b s_b s_b') H^-1,   H = J'J,   s_b = J_b' e_b

with the projected derivatives J and the residuals e, enlarged for the effective number of blocks. It is computed with
blocks of 1 s and of 4 s. The uncertainty is the largest of both and that of white noise, combined with the error of the
interpolation, 0.5 % of the table's interval.

The log of the encoders is interpolated to the times of the readings:

    rate r and angle A of the turn     the gyroscope responds to r, the accelerometer to (cos A, sin A)
    attitude q                         the gyroscope responds to omega, the accelerometer to R(q)^T e_z

Between two samples the angle is the cubic through angle and rate at both ends, exact for constant acceleration. The
rate is linear, with one bend where the slopes on both sides require it. The attitude is the quintic spline of its
components.

``follow_program``: a table without encoders has its commanded program alone,

    A(t) = P(tau),   r(t) = P'(tau),   tau = m_j + (1 + k) (t - t_j) + d_j       near move j

with the commanded angle P, deg, at the program's time tau. The middle m_j of move j is at the sensor's time t_j by
offset and drift of the whole program, as above; d_j, s, is the deviation of the move from that. ``d_j`` and ``k`` are
fitted to the readings w = a P'(tau) + b of the gyroscope near the move, so that pauses between moves may have any
length. Lost steps of the motors are not observable; they are part of the table's accuracy.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from imu_logs.log import Log, Note
from imu_logs.units import ATTITUDE, TABLE_CHANNELS, TABLE_TIME, TRIADS
from pipeline.core.errors import IngestError
from pipeline.core.records import Index, Mask, Values, continuous, level_in_body, quintic_spline, rotation_deg
from pipeline.core.settings import ProgramRest, ProgramTurn, Repeated

ENCODER_STEP_S, FINEST_OF_ATTITUDE_S = 0.0025, 0.01  # steps of the grid; only the rate of one axis is known to bend
MOST_POINTS = 1 << 18  # bounds memory and the cost of correlation; a power of 2 for the transform
BENT_SLOPE_RATIO = 8.0  # times the median change of slope
RESTING_DPS = 0.5  # smallest range of the rate that is called a motion
SAME_SIGN = 0.9  # correlation of the logged rate with the slope of the angle
MIN_SPLINE_ROWS = 6  # for the quintic spline
SMALLEST_CORRELATION = 0.9  # at most 19 % of the variance of the rates is not explained, 1 - 0.9^2
BLOCKS_S = (1.0, 4.0)  # about the length of a ramp of the rate, and longer
COARSE_S = 0.01  # step of the grid of offsets
MOST_PLACES, WORTH_A_LOOK = 40, 0.3  # offsets refined, and their least correlation relative to the best
SAMPLES_OF_A_LOOK = 20_000  # bounds the cost of up to 40 offsets
AMBIGUOUS = 1.1  # ratio of the second-best mean squared residual to the best
MIN_SHARED_DURATION = 0.5  # share of the shorter log that both must cover
MAX_CLOCK_STEPS, ROUNDING_S = 20, 1e-9  # Gauss-Newton stops below 1 ns, the resolution of the times
MIN_CLOCK_BLOCKS = 3.0  # bounds the factor nu / (nu - 2), the variance of Student's t, for few blocks
RESOLVED = 0.005  # of the table's interval: between its samples the motion is interpolated
PROGRAM_STEP_S = 0.005  # grid of the program and of its derivative, half the interval of a log at 100 Hz
BEFORE_S = 1.0  # rest that is added at both ends
MAX_FIT_ITERATIONS = 12  # iterations at most; they end where no move changes by 1 us
MAX_SHARE_OF_REST = 0.5  # of the rest before or after a move


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
    """Continue the table's angle where the encoder restarts at 0 or 360 deg: a step of more than half a turn."""
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
        rates = rotation_deg(q, np.gradient(q, step, axis=0))
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
        spline = quintic_spline(log_time, continuous(np.column_stack([values[c] for c in ATTITUDE])))
        for index, channel in enumerate(ATTITUDE):
            out[channel] = lambda tau, i=index: _unit(spline(np.clip(tau, 0.0, log_time[-1])))[:, i]  # type: ignore[misc]
    return out


def _unit(q: Values) -> Values:
    return np.asarray(q / np.linalg.norm(q, axis=1, keepdims=True))


def _bent_line(log_time: Values, value: Values, tau: Values) -> Values:
    """Interpolate linearly, with a bend where the lines of both neighbours meet in an interval and differ clearly."""
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


@dataclass(frozen=True)
class ClockFit:
    """Offset (s) and drift (1) of the table's clock with standard uncertainties, and the correlation of the motions.

    ``middle`` is t_m; both times count from the first sample of each log.
    """

    offset: float
    drift: float
    offset_uncertainty: float
    drift_uncertainty: float
    middle: float
    correlation: float

    def table_time(self, t: Values) -> Values:
        """Convert times of the sensor to the table's time, s."""
        return np.asarray(t + self.offset + self.drift * (t - self.middle))


@dataclass(frozen=True)
class SensorSignals:
    """Times (s), readings (n, 3 or 6), the number of rates among them, and the noise of each."""

    time: Values
    readings: Values
    rates: int
    noise: Values

    def part(self, rows: slice | Mask) -> SensorSignals:
        """Return some of the samples."""
        return SensorSignals(self.time[rows], self.readings[rows], self.rates, self.noise)


def fit_clocks(sensor: Log, log: Log, signals: Signals) -> ClockFit:
    """Return offset and drift of the clock of a table's ``log``; the times count from the first sample of each log.

    Raises ``IngestError`` for a sensor without gyroscope, and for logs that do not show the same motion, or that fit
    equally well at several offsets.
    """
    if "gyro_x" not in sensor.values:
        raise IngestError("a table's log with its own clock needs a gyroscope to be aligned", log.path, code="no_sync")
    sensed = _sensor_signals(sensor, signals)
    look = sensed.part(slice(None, None, max(1, len(sensed.time) // SAMPLES_OF_A_LOOK)))
    places = _places(look, signals)
    for resting in (True, False):
        residuals = np.array([_left(look, signals, place, beyond=resting) for place in places])
        order = np.argsort(residuals)
        best = places[int(order[0])]
        fit = _refine(sensed if resting else sensed.part(signals.covers(sensed.time + best)), signals, best)
        if fit.correlation > SMALLEST_CORRELATION:
            break
    if not fit.correlation > SMALLEST_CORRELATION:
        message = f"the table's log does not show the motion that the gyroscope read (correlation {fit.correlation:.2f}"
        message += " at best)"
        hint = "do both logs belong to one recording, and are their units right?"
        raise IngestError(message, log.path, code="no_sync", hint=hint)
    if len(order) > 1 and residuals[order[1]] < AMBIGUOUS * residuals[order[0]]:
        message = f"the motion repeats itself: the offsets {best:.3f} and {places[int(order[1])]:.3f} s fit as well"
        hint = "log the table during the whole recording, or begin and end it with a turn unlike the others"
        raise IngestError(message, log.path, code="no_sync", hint=hint)
    return fit


def _sensor_signals(sensor: Log, signals: Signals) -> SensorSignals:
    rates = np.column_stack([sensor.values[c] for c in TRIADS["gyroscope"]])
    if signals.magnitude:
        rates = np.linalg.norm(rates - np.median(rates, axis=0), axis=1)[:, None]
    forces = np.zeros((len(rates), 0))
    if signals.directions.shape[1] and "accel_x" in sensor.values:
        forces = np.column_stack([sensor.values[c] for c in TRIADS["accelerometer"]])
    readings = np.column_stack([rates, forces])
    noise = np.maximum(np.median(np.abs(np.diff(readings, axis=0)), axis=0), 1e-3 * np.std(readings, axis=0))
    m = rates.shape[1]
    noise[:m], noise[m:] = noise[:m].max(initial=0.0), noise[m:].max(initial=0.0)
    return SensorSignals(seconds_of(sensor), readings, m, np.maximum(noise, 1e-12))


def _places(sensed: SensorSignals, signals: Signals) -> list[float]:
    """Return the offsets with the highest correlation of the rates, s."""
    stride = max(1, round(COARSE_S / signals.step))
    step, rates = stride * signals.step, signals.rates[::stride]
    grid = step * np.arange(int(sensed.time[-1] / step) + 1)
    size = len(grid) + len(rates)
    size = 1 << (size - 1).bit_length()
    score = np.zeros(size)
    for r in rates.T:
        transformed = np.fft.rfft(r - r.mean(), size)
        for w in sensed.readings[:, : sensed.rates].T:
            one = np.interp(grid, sensed.time, w)
            score += np.fft.irfft(transformed * np.conj(np.fft.rfft(one - one.mean(), size)), size) ** 2
    peaks = np.flatnonzero((score >= np.roll(score, 1)) & (score > np.roll(score, -1)))
    peaks = peaks[score[peaks] > WORTH_A_LOOK**2 * score.max()]
    best = peaks[np.argsort(-score[peaks])][:MOST_PLACES]
    lags = np.where(best < len(rates), best, best - size)
    return [float(lag) * step for lag in lags] or [0.0]


def _left(sensed: SensorSignals, signals: Signals, offset: float, *, beyond: bool) -> float:
    """Return the mean squared residual over the noise; infinite if the logs share less than half of the shorter."""
    inside = signals.covers(sensed.time + offset)
    shared = float(np.mean(inside)) * sensed.time[-1]
    if shared < MIN_SHARED_DURATION * min(sensed.time[-1], signals.duration):
        return np.inf
    covered = sensed if beyond else sensed.part(inside)
    rates, directions, *_ = signals.at(covered.time + offset)
    total = 0.0
    for columns, readings, noise in _groups(covered, rates, directions):
        Q = np.linalg.qr(columns)[0]
        total += float(np.sum(((readings - Q @ (Q.T @ readings)) / noise) ** 2))
    return total / len(covered.time)


def _groups(sensed: SensorSignals, rates: Values, directions: Values) -> list[tuple[Values, Values, Values]]:
    """Return columns, readings and noise of the rates and, if there are any, of the forces."""
    ones = np.ones((len(sensed.time), 1))
    m = sensed.rates
    out = [(np.hstack([rates, ones]), sensed.readings[:, :m], sensed.noise[:m])]
    if sensed.readings.shape[1] > m:
        out.append((np.hstack([directions, ones]), sensed.readings[:, m:], sensed.noise[m:]))
    return out


def _refine(sensed: SensorSignals, signals: Signals, offset: float) -> ClockFit:
    d, k, middle = offset, 0.0, float(sensed.time[-1]) / 2
    for _ in range(MAX_CLOCK_STEPS):
        J, e, weight, correlation = _linearised(sensed, signals, d + k * (sensed.time - middle), middle)
        moved = float(np.average(sensed.time, weights=weight)) if weight.sum() > 0 else middle
        if abs(moved - middle) > 1e-3 * sensed.time[-1]:
            d, middle = d + k * (moved - middle), moved
            continue
        size = np.linalg.norm(J, axis=0)
        if not np.all(size > 0):
            return ClockFit(d, k, np.inf, np.inf, middle, 0.0)
        change = np.linalg.lstsq(J / size, e, rcond=None)[0] / size
        d, k = d + float(change[0]), k + float(change[1])
        if abs(change[0]) + abs(change[1]) * sensed.time[-1] < ROUNDING_S:
            break
    floor = RESOLVED * signals.interval * np.array([1.0, 1.0 / max(sensed.time[-1], 1e-9)])
    inverse = np.linalg.lstsq(np.linalg.qr(J, mode="r"), np.eye(2), rcond=None)[0]
    by_blocks = [_uncertainties_by_blocks(J, e, sensed, inverse @ inverse.T, length) for length in BLOCKS_S]
    spread = np.max([np.linalg.norm(inverse, axis=1) * np.sqrt(np.mean(e**2)), *by_blocks], axis=0)
    spread = np.hypot(spread, floor)
    return ClockFit(d, k, float(spread[0]), float(spread[1]), middle, correlation)


def _linearised(
    sensed: SensorSignals, signals: Signals, shift: Values, middle: float
) -> tuple[Values, Values, Values, float]:
    """Return projected derivatives to d and k, residuals (in noise), the weight of each time, and the correlation."""
    rates, directions, rate_slopes, direction_slopes = signals.at(sensed.time + shift)
    lever = sensed.time - middle
    derivatives: list[Values] = []
    residuals: list[Values] = []
    weight = np.zeros(len(lever))
    correlation = 0.0
    slopes = (rate_slopes, direction_slopes)
    for (columns, readings, noise), slope in zip(_groups(sensed, rates, directions), slopes, strict=False):
        Q, R = np.linalg.qr(columns)
        B = np.linalg.lstsq(R, Q.T @ readings, rcond=None)[0]
        residual = readings - columns @ B
        if not residuals:
            spread = readings - readings.mean(axis=0)
            explained = 1.0 - float(np.sum(residual**2)) / max(float(np.sum(spread**2)), 1e-300)
            correlation = float(np.sqrt(max(explained, 0.0)))
        steep = slope @ B[:-1]
        weight += np.sum((steep / noise) ** 2, axis=1)
        for column in range(readings.shape[1]):
            both = np.column_stack([steep[:, column], steep[:, column] * lever])
            derivatives.append((both - Q @ (Q.T @ both)) / noise[column])
            residuals.append(residual[:, column] / noise[column])
    return np.concatenate(derivatives), np.concatenate(residuals), weight, correlation


def _uncertainties_by_blocks(J: Values, e: Values, sensed: SensorSignals, covariance: Values, length: float) -> Values:
    channels = sensed.readings.shape[1]
    starts = np.flatnonzero(np.diff(np.floor(sensed.time / length), prepend=-1.0))
    scores = np.add.reduceat((J * e[:, None]).reshape(channels, len(sensed.time), 2).sum(axis=0), starts)
    information = np.add.reduceat((J**2).reshape(channels, len(sensed.time), 2).sum(axis=0), starts)
    spread = np.linalg.norm(covariance @ scores.T, axis=1)
    blocks = information.sum(axis=0) ** 2 / np.sum(information**2, axis=0)
    return np.asarray(spread * np.sqrt(blocks / np.maximum(blocks - 2.0, 1.0 / MIN_CLOCK_BLOCKS)))


def align(sensor: Log, log: Log) -> Log:
    """Add the channels of a table's log, interpolated at the sensor's times; refuse logs of different motions.

    Rows that the table's log does not cover are dropped. If the table rests throughout, no result depends on the
    alignment, and both logs are assumed to begin together.
    """
    log = unwrapped(log)
    t, log_time = seconds_of(sensor), seconds_of(log)
    if len(log_time) < MIN_SPLINE_ROWS:
        message = f"the table's log has {len(log_time)} rows; at least {MIN_SPLINE_ROWS} are needed"
        raise IngestError(message, log.path, code="no_sync")
    signals = signals_of(log)
    if signals.resting:
        tau = np.clip(t, 0.0, log_time[-1])
        note = Note("N-SYNC", len(t), 0, 0, "the table rests throughout its log: there is no motion to align by")
        return _merged(sensor, log, slice(0, len(t)), tau, {}, [note])
    fit = fit_clocks(sensor, log, signals)
    tau = fit.table_time(t)
    inside = np.flatnonzero((tau >= 0) & (tau <= log_time[-1]))
    if inside.size < 2:
        raise IngestError("no time is covered by both logs", log.path, code="no_sync")
    rows = slice(int(inside[0]), int(inside[-1]) + 1)
    offset = float(log.time_ns[0] - sensor.time_ns[0]) / 1e9 + fit.offset
    clock = {"offset_s": offset, "offset_uncertainty_s": fit.offset_uncertainty, "drift_ppm": fit.drift * 1e6}
    clock |= {"drift_uncertainty_ppm": fit.drift_uncertainty * 1e6, "at_s": fit.middle, "correlation": fit.correlation}
    return _merged(sensor, log, rows, tau[rows], clock, _notes(sensor, rows, fit, clock["offset_s"]))


def _notes(sensor: Log, rows: slice, fit: ClockFit, offset_s: float) -> list[Note]:
    detail = (
        f"the table's clock is {offset_s:.7g} s (+- {_one_digit(fit.offset_uncertainty)} s, one standard deviation) "
        f"ahead of the sensor's {fit.middle:.4g} s after its first sample and gains {fit.drift * 1e6:.3g} ppm "
        f"(+- {_one_digit(fit.drift_uncertainty * 1e6)}); aligned by the motion in both logs (correlation "
        f"{fit.correlation:.5f})"
    )
    sync = sensor.note("N-SYNC", np.arange(rows.start, rows.stop), detail)
    lost = len(sensor.time_ns) - sync.count
    detail = f"{lost} rows that the table's log does not cover were left out"
    return [sync, *([Note("N-CUT", lost, sync.first, sync.last, detail)] if lost else [])]


def _one_digit(value: float) -> str:
    return np.format_float_positional(float(f"{value:.1g}"), trim="-")


def _merged(sensor: Log, log: Log, rows: slice, tau: Values, clock: dict[str, float], notes: list[Note]) -> Log:  # noqa: PLR0917
    hashes = {entry.get("sha256") for entry in (sensor.source, *sensor.source.get("joined", []))} - {None}
    same, found = log.source is sensor.source or log.source.get("sha256") in hashes, interpolators(log)
    part = sensor.select(rows, *(() if same else log.notes), *notes)
    joined = {} if same else {"joined": [*sensor.source.get("joined", []), log.source]}
    sensor_channels = {c: v for c, v in part.values.items() if c not in log.values and c != TABLE_TIME}
    source = sensor.source | ({"table_clock": clock} if clock else {}) | joined
    return replace(part, values=sensor_channels | {c: at(tau) for c, at in found.items()}, source=source)


def follow_program(table: Log, program: Sequence[ProgramRest | ProgramTurn | Repeated]) -> Log:
    """Add the angle and rate of a table with this program to a log; the gyroscope must show the moves."""
    pause = ProgramRest(rest_s=BEFORE_S)
    commanded = Program([pause, *_flat(program), pause])
    times = np.arange(0.0, commanded.duration, PROGRAM_STEP_S)
    angle, rate, *_ = commanded.at(times)
    values = {"table_angle": angle, "table_rate": rate}
    log = Log(table.path, np.rint(times * 1e9).astype(np.int64), values, table.source)
    fit = fit_clocks(table, log, signals_of(log))
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
    """Commanded motion of one axis of a table: rests, and turns with a trapezoidal rate; at rest before and after.

        A(t) = A_k + W_k s + a_k s^2 / 2,   dA/dt = W_k + a_k s,   s = t - t_k

    A turn by the angle D at the rate r with acceleration a ramps for r/a, holds r and ramps down; where |D| < r^2/a it
    does not reach r, and the ramps meet in the middle. ``knots``: (1 + 4 n, 4), t_k (s), A_k (deg), W_k (deg/s) and a_k
    (deg/s^2), four rows for each of n moves. ``stops``: (n + 1,), deg, before each move and after the last.
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
    return np.asarray((rates[:, axis] - bias) / scale)
