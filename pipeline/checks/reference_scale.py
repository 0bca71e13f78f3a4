"""Check that table angle, table rate, gyroscope, gravity and time agree in scale, to find wrong units.

In a turn about a level axis gravity turns in the body by the table's angle, whatever the units of the log:

    phi = atan2(f_w - c_w, f_v - c_v)

with v, w the axes across the turn axis and c the middle of each axis's readings. Each block of a recording gives the
angles turned by gravity (phi) and by the table's angle, and the sums of table rate and gyroscope over the time. The
weighted medians of their ratios are compared. Gravity determines which of two that differ is wrong:

    angle right, rate and gyroscope wrong alike by 1000 : the time
    angle right, rate and gyroscope wrong alike otherwise : both rates
    angle right, only the rate wrong : the rate
    rate right, angle wrong : the angle

If only the gyroscope differs, its scale factor explains it. Biases of the accelerometer distort phi by some degrees, at
most twice a turn.

An encoder with a wrong number of counts a turn, or a gear of another ratio, gives angle and rate the same small error
``s - 1``. No wrong unit does that, and the gyroscope agrees with it. Gravity does not:

    f_k = c_k + A_k cos(s a) + B_k sin(s a) + r_k

with table angle a, both axes k across the turn axis, and one s for both. The other dependences on the motion are in r:
harmonics up to the third, a delay (rate times the first harmonic), a lever arm, drifts of bias and scale.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pipeline.checks.evidence import (
    EXPANDED,
    ChannelLimits,
    axis_index,
    gaps,
    gravity_turned,
    largest_but,
    of_rate,
    of_table,
    place,
    ratio_quantiles,
    refusal,
)
from pipeline.core.errors import IngestError
from pipeline.core.records import MEDIAN_SIZE, Mask, Recording, Values, median
from pipeline.core.settings import Table

Units = Sequence[tuple[float, str]]


RATIO_BLOCKS = 96  # of a recording, so that each holds a part of a turn
GRAVITY_TOLERANCE = 0.2  # of a ratio to the angle by gravity: two times 6 deg in 60
WRONG_FACTORS = ((0.5, "is half of what it should be"), (2.0, "is twice what it should be"))
UNIT_MISTAKES = (
    (np.pi / 180.0, "looks like rad/s declared as deg/s"),
    (180.0 / np.pi, "looks like deg/s declared as rad/s"),
    (1.0 / 6.0, "looks like rpm declared as deg/s"),
    (6.0, "looks like deg/s declared as rpm"),
    (1.0 / 360.0, "looks like turns per second declared as deg/s"),
    *WRONG_FACTORS,
)
ANGLE_UNITS = (
    (np.pi / 180.0, "looks like rad declared as deg"),
    (180.0 / np.pi, "looks like deg declared as rad"),
    (1.0 / 360.0, "looks like turns declared as deg"),
    *WRONG_FACTORS,
)
TIME_UNIT_FACTORS = tuple((factor, f"{unit} declared as s") for factor, unit in ((1e3, "ms"), (1e6, "us"), (1e9, "ns")))
TIME_UNIT_FACTORS += ((1e-3, "s declared as ms"),)
# half of a turn's angle, from which gravity changes by up to 1.4 g; a change beyond gravity's that is no vibration
SMALL_HALF_ARC_DEG, FAR_MORE_G = 45.0, 0.5
OTHER_AXIS = 0.5  # the axis that turns reads more than twice as much as one that leans by up to 26 deg
LEAST_TOTAL_DEG = 1.0  # over a recording, for a ratio
# relative, between the quartiles of the blocks' ratios: beyond it the channels differ in more than scale
MAX_RATIO_SPREAD = 0.2
CONSTANT_RATE_CHANGE = 1e-2  # relative change of a constant rate
MIN_STEADY_INTERVALS = 10  # intervals at constant rate
MOSTLY_EVEN = 0.7  # of the angle that is turned
WHOLE_TURN_DEG = 330.0  # of gravity's phase, from which its harmonics are distinguished from its slope
ALIKE_SAMPLES = 64.0  # neighbours with correlated residuals, by which the variance of the slope is enlarged
SIGNIFICANT_UNCERTAINTIES = 6.0  # standard uncertainties, as in pipeline.physics.signal.rests
QUARTZ = 2e-4  # relative: two quartz clocks of +-100 ppm each
GRAVITY_TURNS = ("gravity's direction", 1e-2)  # relative: clocks without quartz, errors of its phase by lever arms
SAME_ANGLE = 2e-4  # relative: 0.07 deg in a turn, error of gravity's direction by an accelerometer's nonlinearities
# samples; blocks of a sandwich estimate; Gauss-Newton steps
FEWEST_OF_A_GEAR, BLOCKS_OF_A_GEAR, GEAR_ITERATIONS = 200, 24, 4
SURELY, LINEAR_G = 0.9, 0.03  # share of what is allowed, rms residual: see _gear
CONVERGED = 1e-12  # relative step, far below the uncertainty of any ratio
SHARES = np.arange(1, BLOCKS_OF_A_GEAR) / BLOCKS_OF_A_GEAR
UNIT_FACTOR_TOLERANCE = 0.1  # relative: how near a factor has to be to one of a unit to be called so


class _Ratio(NamedTuple):
    """Angle by one channel over that by another: weighted median over blocks, and whether the blocks agree."""

    value: float
    even: bool

    def off(self, tolerance: float) -> bool:
        return abs(self.value - 1.0) > tolerance

    def agrees(self, tolerance: float) -> bool:
        return self.even and not self.off(tolerance)

    @property
    def of_time(self) -> bool:
        """Whether a wrong unit of the time explains it."""
        return self.even and bool(_unit(self.value, TIME_UNIT_FACTORS))


def check_scale_of_turn(recording: Recording, limits: ChannelLimits) -> None:
    """Refuse a turn in which angle, rate, gyroscope, gravity and time contradict each other in scale.

    A turn about another axis than the stated one is not compared: the check of the mounting follows.
    """
    found = {c.name: _in_blocks(c.turned) for c in of_table(recording)}
    angle, rate = found.get("table_angle"), found.get("table_rate")
    ratio = _ratio(rate, angle)
    agree = ratio is not None and not (ratio.even and ratio.off(limits.rate))
    sensors = None if agree and not _gravity_turns_further(recording) else _turned(recording)
    if sensors is None:
        return
    gyro, gravity = sensors
    true_angle, true_rate, by_gyro = _ratio(angle, gravity), _ratio(rate, gravity), _ratio(rate, gyro)
    gyro_agrees = by_gyro is not None and by_gyro.agrees(GRAVITY_TOLERANCE)
    tolerance = limits.rate + GRAVITY_TOLERANCE
    if ratio is not None and not agree:
        angle_wrong = ratio.value > 1.0 and gyro_agrees and not ratio.of_time
        if true_angle is not None and true_rate is not None:
            angle_wrong = abs(true_rate.value - 1.0) < abs(true_angle.value - 1.0)
        if angle_wrong:
            raise _wrong_angle(recording, limits, 1.0 / ratio.value, "the table's rate")
        raise _wrong_rate(recording, limits, ratio, "the table's angle", gyro_agrees=gyro_agrees)
    if true_rate is not None and angle is None and true_rate.even and true_rate.off(tolerance):
        raise _wrong_rate(recording, limits, true_rate, "gravity", gyro_agrees=gyro_agrees)
    if angle is not None and (rate is None or agree):
        if true_angle is not None and true_angle.even and true_angle.off(tolerance):
            raise _wrong_angle(recording, limits, true_angle.value, "gravity")
        factor = _ratio(gyro, angle)
        if factor is not None and factor.of_time:
            raise _wrong_time(recording, limits, factor, "the gyroscope's readings sum up to")


def _gravity_turns_further(recording: Recording) -> bool:
    """Return whether the specific force changes by far more than gravity does over the range of the table's angle."""
    if recording.table_angle is None or recording.accelerometer is None or not recording.valid.any():
        return False
    half = 0.5 * float(np.ptp(recording.table_angle[recording.valid]))
    change = float(np.max(np.ptp(recording.accelerometer[recording.valid], axis=0)))
    return half < SMALL_HALF_ARC_DEG and change > 2.0 * np.sin(np.radians(half)) + FAR_MORE_G


def _turned(recording: Recording) -> tuple[Values | None, Values | None] | None:
    """Return the angle turned in each block by gyroscope and gravity, (96,), deg; None if an axis not stated turns."""
    axis, gyro = axis_index(recording), None
    if recording.gyroscope is not None and recording.valid.any():
        spread = np.std(recording.gyroscope[recording.valid], axis=0)
        if spread[axis] < OTHER_AXIS * spread.max():
            return None
    if recording.gyroscope is not None:
        reading = still = recording.gyroscope[:, axis]
        if recording.table_rate is not None:
            still = reading[np.abs(recording.table_rate) <= np.min(np.abs(recording.table_rate))]
        gyro = of_rate(recording, "gyroscope", reading - np.median(still), recording.valid).turned
    return _in_blocks(gyro), _in_blocks(gravity_turned(recording))


def check_scale_of_motion(recording: Recording, size: Values | None, limits: ChannelLimits) -> None:
    """Refuse held-out motion whose rate, attitude and gyroscope (its calibrated ``size``) contradict each other."""
    found = {c.name: _in_blocks(c.turned) for c in of_table(recording)}
    rate, attitude = found.get("table_rate"), found.get("table_attitude")
    gyro = None if size is None else _in_blocks(of_rate(recording, "gyroscope", size, recording.valid).turned)
    tolerance = limits.rate + limits.gain
    by_gyro, ratio = _ratio(rate, gyro), _ratio(rate, attitude)
    if ratio is None and by_gyro is not None and by_gyro.even and by_gyro.off(tolerance):
        against = "the gyroscope, as the unit's turns calibrate it"
        raise _wrong_rate(recording, limits, by_gyro, against, gyro_agrees=False)
    if ratio is None or not ratio.even or not ratio.off(limits.rate):
        return
    if by_gyro is None or not by_gyro.agrees(tolerance):
        raise _wrong_rate(recording, limits, ratio, "the table's attitude", gyro_agrees=False)
    if ratio.of_time:
        raise _wrong_time(recording, limits, ratio, "the table's rate sums up to")
    turns = f"{limits.column(recording, 'table_attitude')} turns {1.0 / ratio.value:.4g} times as fast as"
    message = f"{turns} {limits.column(recording, 'table_rate')} and the gyroscope say"
    raise refusal(recording, "reference_scale", message, "is it the attitude of this recording, and is the time in s?")


def doubt_of_angle(recording: Recording, limits: ChannelLimits) -> str | None:
    """Return the doubt that a turn's angle differs from gravity's by a factor: an encoder's counts, a gear."""
    if recording.table_angle is None:
        return None
    allowed = limits.rate_stated + limits.angle_stated_deg / float(np.ptp(recording.table_angle)) + SAME_ANGLE
    found = _gear(recording, allowed)
    if found is None:
        return None
    ratio, spread = found
    if abs(ratio - 1.0) <= allowed + SIGNIFICANT_UNCERTAINTIES * spread:
        return None
    return (
        f"{limits.column(recording, 'table_angle')} turns {ratio:.6g} times as far as gravity does in the readings "
        f"(standard uncertainty {spread:.2g}; the stated accuracy allows {allowed:.2g}): are the encoder's counts a "
        "turn and the gear's ratio right? The matrix of the gyroscope is wrong by as much"
    )


def _gear(recording: Recording, allowed: float) -> tuple[float, float] | None:
    """Return the ratio of the table's angle to gravity's, and its standard uncertainty.

    None if it is unknown, or if the first step shows that it differs from 1 by less than is ``allowed`` or significant.
    A residual r below 0.03 g is that of a phase error p below 0.3 rad (r = p^2 / 2 on a third of the turn). Further
    steps change the first by p^2 / 6 at most, and r enlarges its six uncertainties by 5 % of it at most (200 samples).
    """
    angle, rate, force = recording.table_angle, recording.logged_rate, recording.accelerometer
    if recording.role != "gyroscope":  # in a turn of minutes, a bias that follows the temperature has the same signal
        return None
    if angle is None or rate is None or force is None:
        return None
    keep = recording.valid
    if np.count_nonzero(keep) < FEWEST_OF_A_GEAR or float(np.ptp(angle[keep])) < WHOLE_TURN_DEG:
        return None
    axis, w, t = axis_index(recording), np.radians(rate[keep]), recording.time[keep]
    y = force.compress(keep, axis=0).T[[(axis + 1) % 3, (axis + 2) % 3]]
    a = logged = np.radians(angle[keep] - float(np.mean(angle[keep])))
    slope, late = np.gradient(w, t), (t - t[0]) / (t[-1] - t[0])
    for iteration in range(GEAR_ITERATIONS):
        c, s = np.cos(a), np.sin(a)
        c2, s2 = c * c - s * s, 2.0 * c * s  # of the double angle
        columns = [np.ones_like(a), c, s, w * c, w * s, w * w, slope, late, late * late]
        columns += [c2, s2, c2 * c - s2 * s, s2 * c + c2 * s]
        Q, R = np.linalg.qr(np.stack(columns).T)
        _, cosine, sine = np.linalg.solve(R[:3, :3], Q[:, :3].T @ y.T)[..., None]
        drifts = np.stack([late, late * late], axis=1) * (cosine * c + sine * s)[..., None]
        own = np.linalg.qr(drifts - Q @ (Q.T @ drifts))[0]
        both = np.stack([a * (sine * c - cosine * s), y], axis=2)
        both -= Q @ (Q.T @ both)
        d, e = np.moveaxis(both - own @ (np.swapaxes(own, 1, 2) @ both), 2, 0)
        information = max(float(np.sum(d * d)), float(np.finfo(float).tiny))  # 0: gravity stays
        step = float(np.sum(d * e)) / information
        white = float(np.sqrt(max(np.mean(e * e) - step * step * information / e.size, 0.0) / information))
        small = np.mean(e * e) < LINEAR_G**2
        surely = small and abs(step) <= SURELY * (allowed + SIGNIFICANT_UNCERTAINTIES * white)
        if (iteration == 0 and surely) or gravity_turned(recording) is None:
            return None
        a = a * (1.0 + step)
        if abs(step) < CONVERGED:
            break
    # blocks of equal information: a turn may be a small part of the samples
    ends = np.searchsorted(np.cumsum(np.sum(d * d, axis=0)) / information, SHARES)
    scores = np.add.reduceat(np.sum(d * e, axis=0), np.unique([0, *ends]))
    # or of independent errors: the scores of few blocks may cancel
    return float(logged @ logged / (a @ logged)), max(float(np.linalg.norm(scores)) / information, white)


def doubt_of_scale(recording: Recording, limits: ChannelLimits) -> str | None:
    """Return the doubt that a turn's rate differs from that of its angle, or of gravity, by a factor."""
    found = rate_against_angle(recording)
    if found is None:
        return None
    ratio, spread, samples = found
    logged = recording.table_angle is not None
    against, least = (limits.column(recording, "table_angle"), QUARTZ) if logged else GRAVITY_TURNS
    if abs(ratio - 1.0) <= limits.rate_stated + least + SIGNIFICANT_UNCERTAINTIES * spread:
        return None
    return (
        f"{limits.column(recording, 'table_rate')} is {ratio:.6g} times the rate at which {against} turns, over "
        f"{samples} samples at constant rate (standard uncertainty {spread:.2g}; the stated accuracy allows "
        f"{limits.rate_stated:.2g}): one of them, or the clock of {limits.column(recording, 'time')}, is wrong by that"
    )


def rate_against_angle(recording: Recording) -> tuple[float, float, int] | None:
    """Return the ratio of a turn's rate to the change of its angle, its standard uncertainty, and the samples.

    At constant rate the angle's increment is exactly the rate times the interval. Without an angle the sum of the rate
    is regressed on gravity's phase and its first two harmonics, by which biases and cross-axis sensitivity distort it.
    """
    rate = recording.table_rate
    if rate is None:
        return None
    dt = recording.time_steps
    even = np.abs(np.diff(rate)) <= CONSTANT_RATE_CHANGE * np.abs(rate[1:])
    even &= (np.abs(rate[1:]) > LEAST_TOTAL_DEG) & ~gaps(recording)
    even[1:-1] &= even[2:] & even[:-2]  # two samples on either side of a short move's peak are equal by chance
    even[[0, -1]] = False
    samples = int(even.sum())
    if samples < MIN_STEADY_INTERVALS:
        return None
    if recording.table_angle is None:
        fit = _against_phase(recording, 0.5 * (rate[1:] + rate[:-1]) * dt, even)
        return None if fit is None else (*fit, samples)
    found = rate[1:][even] * dt[even] / np.diff(recording.table_angle)[even]
    ratio = float(median(found))
    return ratio, MEDIAN_SIZE * float(median(np.abs(found - ratio))) / np.sqrt(samples), samples


def rate_error(recordings: Sequence[Recording], table: Table) -> float:
    """Return the largest relative difference of rate and change of the angle in the gyroscope's turns.

    0 where it is insignificant, or within the rate's stated accuracy.
    """
    turns = [r for r in recordings if r.role == "gyroscope" and r.table_angle is not None]
    found = [(abs(ratio - 1.0), spread) for ratio, spread, _ in filter(None, map(rate_against_angle, turns))]
    error = max((off for off, spread in found if off > SIGNIFICANT_UNCERTAINTIES * spread), default=0.0)
    return error if error > EXPANDED * table.rate_accuracy else 0.0


def _against_phase(recording: Recording, steps: Values, even: Mask) -> tuple[float, float] | None:
    """Return the slope of the summed rate in gravity's phase, and its standard uncertainty."""
    turned, sizes = gravity_turned(recording), np.abs(steps)
    if turned is None or float(sizes[even].sum()) < MOSTLY_EVEN * float(sizes.sum()):
        return None
    phase, summed = (np.concatenate([[0.0], np.cumsum(v)]) for v in (turned, steps))
    if float(np.ptp(phase)) < WHOLE_TURN_DEG:
        return None
    a = np.radians(phase)
    A = np.column_stack([phase, np.ones_like(a), np.cos(a), np.sin(a), np.cos(2.0 * a), np.sin(2.0 * a)])
    x = np.linalg.lstsq(A, summed, rcond=None)[0]
    variance = np.mean((summed - A @ x) ** 2) / np.sum((phase - phase.mean()) ** 2)
    return abs(float(x[0])), float(np.sqrt(variance * ALIKE_SAMPLES))


def check_intervals(recordings: Sequence[Recording], limits: ChannelLimits) -> None:
    """Refuse a recording whose interval differs from that of the unit's others as by a wrong unit of the time."""
    if len(recordings) < 3:
        return
    middle = float(np.median([r.interval for r in recordings]))
    for recording in recordings:
        if what := _unit(recording.interval / middle, TIME_UNIT_FACTORS):
            both = f"{recording.interval:.6g} s, and {middle:.6g} s in the unit's other recordings"
            message = f"{limits.column(recording, 'time')} looks like {what}: the interval between samples is {both}"
            raise refusal(recording, "reference_time", message, "correct ingest.csv.columns.time.unit")


def _in_blocks(turned: Values | None) -> Values | None:
    """Return the angle turned in each block of a recording: (96,) array, deg."""
    if turned is None:
        return None
    count = min(RATIO_BLOCKS, len(turned))
    starts = (np.arange(count) * (len(turned) / count)).astype(int)
    return np.asarray(np.add.reduceat(turned, starts))


def _ratio(one: Values | None, other: Values | None) -> _Ratio | None:
    """Return the ratio of two channels over the blocks in which the other turned; None if it did not turn."""
    if one is None or other is None:
        return None
    size = np.abs(other)
    if not float(np.sum(np.minimum(size, largest_but(size, 10)))) > LEAST_TOTAL_DEG:
        return None
    low, middle, high = np.abs(ratio_quantiles(one, other, 10, 0.3, 0.25, 0.5, 0.75))
    return _Ratio(float(middle), bool(middle > 0.0 and abs(high - low) <= MAX_RATIO_SPREAD * middle))


def _unit(value: float, units: Units) -> str:
    """Return the wrong unit that explains a factor, in words; empty for none."""
    return next((what for factor, what in units if abs(value / factor - 1.0) <= UNIT_FACTOR_TOLERANCE), "")


def _wrong_angle(recording: Recording, limits: ChannelLimits, factor: float, against: str) -> IngestError:
    what = _unit(factor, ANGLE_UNITS) or f"is {factor:.4g} times what it should be"
    message = f"{limits.column(recording, 'table_angle')} {what}: over {place(recording, 0, recording.samples - 1)} it"
    message += f" turns {factor:.4g} times as far as {against} says"
    return refusal(recording, "reference_scale", message, "correct ingest.csv.columns.table_angle.unit")


def _wrong_rate(
    recording: Recording, limits: ChannelLimits, ratio: _Ratio, against: str, *, gyro_agrees: bool
) -> IngestError:
    """Return the refusal of the table's rate, or of the time or both rates if the gyroscope agrees with it."""
    if gyro_agrees and ratio.of_time:
        return _wrong_time(recording, limits, ratio, "the table's rate sums up to")
    name, keys = limits.column(recording, "table_rate"), "ingest.csv.columns.table_rate.unit"
    what = _unit(ratio.value, UNIT_MISTAKES) or f"is {ratio.value:.4g} times what it should be"
    if gyro_agrees and what.startswith("looks"):
        keys += " and those of gyro_x, gyro_y, gyro_z"
        name, what = f"{name} and {limits.column(recording, 'gyroscope')}", what.replace("looks", "look", 1)
    seen = f"the rate sums up to {ratio.value:.4g} times the angle by {against}"
    whole = place(recording, 0, recording.samples - 1)
    return refusal(recording, "reference_scale", f"{name} {what}: over {whole} {seen}", f"correct {keys}")


def _wrong_time(recording: Recording, limits: ChannelLimits, ratio: _Ratio, seen: str) -> IngestError:
    name, what = limits.column(recording, "time"), _unit(ratio.value, TIME_UNIT_FACTORS)
    over = place(recording, 0, recording.samples - 1)
    message = f"{name} looks like {what}: {seen} {ratio.value:.4g} times the angle that the table turned over {over}"
    return refusal(recording, "reference_time", message, "correct ingest.csv.columns.time.unit")
