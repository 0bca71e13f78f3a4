"""Whether table angle, table rate, gyroscope, gravity and time agree in scale: wrong units.

In a turn about a level axis gravity turns in the body by the table's angle, whatever the units of the log:

    phi = atan2(f_w - c_w, f_v - c_v)

with v, w the axes across the turn axis and c the middle of each axis's readings. For blocks of a recording the turned
angles by gravity (phi), by the table's angle, and by the sums of table rate and gyroscope over the time are compared by
the weighted median of their ratios. Gravity tells which of two that differ is wrong:

    angle right, rate and gyroscope wrong alike by 1000 : the time
    angle right, rate and gyroscope wrong alike otherwise : both rates
    angle right, rate wrong alone : the rate
    rate right, angle wrong : the angle

A gyroscope that is wrong alone is a matter of its scale factor. Biases of the accelerometer distort phi twice a turn at
most, by some degrees.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from pipeline.preprocessing.evidence import (
    axis_index,
    column,
    gaps,
    gravity_turned,
    of_angle,
    of_attitude,
    of_rate,
    place,
    refusal,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from pipeline.preprocessing.evidence import Limits
    from pipeline.records import Recording

    Array = NDArray[np.float64]

BLOCKS = 96
GRAVITY_TOLERANCE = 0.2  # of a ratio to the angle by gravity: two times 6 deg in 60
UNITS = (
    (np.pi / 180.0, "looks like rad/s declared as deg/s"),
    (180.0 / np.pi, "looks like deg/s declared as rad/s"),
    (1.0 / 6.0, "looks like rpm declared as deg/s"),
    (6.0, "looks like deg/s declared as rpm"),
    (1.0 / 360.0, "looks like turns per second declared as deg/s"),
    (0.5, "is half of what it should be"),
    (2.0, "is twice what it should be"),
)
ANGLE_UNITS = (
    (np.pi / 180.0, "looks like rad declared as deg"),
    (180.0 / np.pi, "looks like deg declared as rad"),
    (1.0 / 360.0, "looks like turns declared as deg"),
    (0.5, "is half of what it should be"),
    (2.0, "is twice what it should be"),
)
TIMES = ((1e3, "ms declared as s"), (1e6, "us declared as s"), (1e9, "ns declared as s"), (1e-3, "s declared as ms"))
LEAST_TOTAL_DEG = 1.0  # over a recording, for a ratio
SPREAD = 0.2  # relative, between the quartiles of the blocks' ratios: beyond it the channels differ in more than scale
EVEN = 1e-2  # relative change of a rate that is constant
FEWEST = 10  # intervals at constant rate
MOSTLY_EVEN = 0.7  # of the angle that is turned
WHOLE_TURN_DEG = 330.0  # of gravity's phase, from which its harmonics are told apart from its slope
ALIKE_SAMPLES = 64.0  # neighbours whose residuals go together, by which the variance of the slope is enlarged
MEDIAN_SIZE = 1.4826  # of a normal distribution, standard deviation over median deviation
SIGNIFICANT = 6.0  # standard uncertainties, as in pipeline.signal.rests
QUARTZ = 2e-4  # relative: two quartz clocks of +-100 ppm each
CURVED_PHASE = 1e-2  # relative: clocks without quartz, and what lever arms leave of gravity's phase
ALIKE = 0.1  # relative: how near a factor has to be to one of a unit to be called so


def check_scale_of_turn(recording: Recording, limits: Limits, settings: Mapping[str, Any]) -> None:
    """Refuse a turn in which angle, rate, gyroscope, gravity and time contradict each other in scale.

    Raises
    ------
    IngestError
    """
    found = _turned(recording)
    angle, rate, gyro, gravity = (found.get(k) for k in ("table_angle", "table_rate", "gyroscope", "gravity"))
    true_angle, true_rate = _ratio(angle, gravity), _ratio(rate, gravity)
    ratio, by_gyro = _ratio(rate, angle), _ratio(rate, gyro)
    if ratio is not None:
        if not ratio.off(limits.rate) or not ratio.even:
            return
        if true_angle is None or true_rate is None:
            angle_wrong = ratio.value > 1.0 and _agrees(by_gyro) and not _of_time(ratio)
        else:
            angle_wrong = abs(true_rate.value - 1.0) < abs(true_angle.value - 1.0)
        if angle_wrong:
            _refuse_angle(recording, settings, 1.0 / ratio.value, "the table's rate")
        _refuse_rate(recording, settings, ratio, by_gyro, "the table's angle")
    tolerance = limits.rate + GRAVITY_TOLERANCE
    if true_rate is not None and angle is None and true_rate.even and true_rate.off(tolerance):
        _refuse_rate(recording, settings, true_rate, by_gyro, "gravity")
    if angle is not None and rate is None:
        if true_angle is not None and true_angle.even and true_angle.off(tolerance):
            _refuse_angle(recording, settings, true_angle.value, "gravity")
        factor = _ratio(gyro, angle)
        if factor is not None and _of_time(factor):
            _refuse_time(recording, settings, factor, "the gyroscope's readings sum up to")


def check_scale_of_motion(
    recording: Recording, size: Array | None, limits: Limits, settings: Mapping[str, Any]
) -> None:
    """Refuse held-out motion whose rate, attitude and gyroscope contradict each other in scale.

    Parameters
    ----------
    recording : Recording
    size : (n,) array or None, deg/s
        Of the angular rate by the calibrated gyroscope.
    limits : Limits
    settings : mapping
    """
    found: dict[str, Array] = {}
    if recording.table_rate is not None:
        found["rate"] = of_rate(recording, "table_rate", np.abs(recording.table_rate)).turned
    if recording.table_attitude is not None:
        found["attitude"] = of_attitude(recording, recording.table_attitude).turned
    if size is not None:
        found["gyro"] = of_rate(recording, "gyroscope", size, recording.valid).turned
    blocks = {k: _in_blocks(v) for k, v in found.items()}
    rate, attitude, gyro = (blocks.get(k) for k in ("rate", "attitude", "gyro"))
    tolerance = limits.rate + limits.gain
    by_gyro, ratio = _ratio(rate, gyro), _ratio(rate, attitude)
    gyro_agrees = by_gyro is not None and by_gyro.even and not by_gyro.off(tolerance)
    if ratio is not None and ratio.even and ratio.off(limits.rate):
        if gyro_agrees and _of_time(ratio):
            _refuse_time(recording, settings, ratio, "the table's rate sums up to")
        if gyro_agrees:
            raise refusal(
                recording,
                "reference_scale",
                f"{column(recording, 'table_attitude', settings)} turns {1.0 / ratio.value:.4g} times as fast as "
                f"{column(recording, 'table_rate', settings)} and the gyroscope say",
                "is it the attitude of this recording, and is the time in s?",
            )
        _refuse_rate(recording, settings, ratio, None, "the table's attitude")
    if ratio is None and by_gyro is not None and by_gyro.even and by_gyro.off(tolerance):
        _refuse_rate(recording, settings, by_gyro, None, "the gyroscope, as the unit's turns calibrate it")


def doubt_of_scale(recording: Recording, limits: Limits, settings: Mapping[str, Any]) -> tuple[float, str] | None:
    """Return how many times a turn's rate is that of its angle, or of gravity, and a sentence, where that is not 1.

    At constant rate the angle's increment is the rate times the interval, exactly. Without an angle the sum of the rate
    is regressed on gravity's phase and its first two harmonics, in which biases and cross-axis sensitivity distort it.
    """
    rate = recording.table_rate
    if rate is None:
        return None
    dt = np.diff(recording.time)
    even = np.abs(np.diff(rate)) <= EVEN * np.abs(rate[1:])
    even &= (np.abs(rate[1:]) > LEAST_TOTAL_DEG) & ~gaps(recording)
    even[1:-1] &= even[2:] & even[:-2]  # two samples on either side of a short move's peak are alike by chance
    even[[0, -1]] = False
    if even.sum() < FEWEST:
        return None
    name, time = (column(recording, c, settings) for c in ("table_rate", "time"))
    if recording.table_angle is not None:
        found = rate[1:][even] * dt[even] / np.diff(recording.table_angle)[even]
        ratio = float(np.median(found))
        spread = MEDIAN_SIZE * float(np.median(np.abs(found - ratio))) / np.sqrt(len(found))
        against, least = column(recording, "table_angle", settings), QUARTZ
    else:
        fit = _against_phase(recording, rate, dt, even)
        if fit is None:
            return None
        (ratio, spread), against, least = fit, "gravity's direction", CURVED_PHASE
    if abs(ratio - 1.0) <= limits.rate_stated + least + SIGNIFICANT * spread:
        return None
    return ratio, (
        f"{name} is {ratio:.6g} times the rate at which {against} turns, over {int(even.sum())} samples at constant "
        f"rate (standard uncertainty {spread:.2g}; the stated accuracy allows {limits.rate_stated:.2g}): one of "
        f"them, or the clock of {time}, is wrong by that"
    )


def _against_phase(recording: Recording, rate: Array, dt: Array, even: NDArray[np.bool_]) -> tuple[float, float] | None:
    """Return the slope of the summed rate in gravity's phase, and its standard uncertainty."""
    turned = gravity_turned(recording, axis_index(recording))
    steps = np.abs(0.5 * (rate[1:] + rate[:-1]) * dt)
    if turned is None or float(steps[even].sum()) < MOSTLY_EVEN * float(steps.sum()):
        return None
    phase, summed = (np.concatenate([[0.0], np.cumsum(v)]) for v in (turned, 0.5 * (rate[1:] + rate[:-1]) * dt))
    if float(np.ptp(phase)) < WHOLE_TURN_DEG:
        return None
    a = np.radians(phase)
    A = np.column_stack([phase, np.ones_like(a), np.cos(a), np.sin(a), np.cos(2.0 * a), np.sin(2.0 * a)])
    x, *_ = np.linalg.lstsq(A, summed, rcond=None)
    left = summed - A @ x
    spread = float(np.sqrt(np.mean(left**2) / np.sum((phase - phase.mean()) ** 2) * ALIKE_SAMPLES))
    return abs(float(x[0])), spread


def check_intervals(recordings: list[Recording], settings: Mapping[str, Any]) -> None:
    """Refuse a recording whose interval is a thousand or a million times that of the unit's others."""
    usual = {r.name: r.interval for r in recordings if r.samples > 1}
    if len(usual) < 3:
        return
    middle = float(np.median(np.array(list(usual.values()))))
    for recording in recordings:
        factor = usual.get(recording.name, middle) / middle
        for unit, what in TIMES:
            if abs(factor / unit - 1.0) <= ALIKE:
                raise refusal(
                    recording,
                    "reference_time",
                    f"{column(recording, 'time', settings)} looks like {what}: the interval between samples is "
                    f"{usual[recording.name]:.6g} s, and {middle:.6g} s in the unit's other recordings",
                    "correct ingest.csv.columns.time.unit",
                )


def _turned(recording: Recording) -> dict[str, Array]:
    """Return the angle turned in each block of a turn, by each channel: (96,) arrays, deg."""
    axis = axis_index(recording)
    found: dict[str, Array] = {}
    if recording.table_angle is not None:
        found["table_angle"] = of_angle(recording, recording.table_angle).turned
    if recording.table_rate is not None:
        found["table_rate"] = of_rate(recording, "table_rate", recording.table_rate).turned
    if recording.gyroscope is not None:
        reading = recording.gyroscope[:, axis]
        still = reading
        if recording.table_rate is not None:
            still = reading[np.abs(recording.table_rate) <= np.min(np.abs(recording.table_rate))]
        found["gyroscope"] = of_rate(recording, "gyroscope", reading - np.median(still, axis=0), recording.valid).turned
    phase = gravity_turned(recording, axis)
    if phase is not None:
        found["gravity"] = phase
    return {k: _in_blocks(v) for k, v in found.items()}


def _in_blocks(turned: Array) -> Array:
    count = min(BLOCKS, len(turned))
    starts = np.linspace(0, len(turned), count, endpoint=False).astype(int)
    sums: Array = np.add.reduceat(turned, starts)
    return sums


@dataclass(frozen=True)
class Ratio:
    """How many times as far one channel turns as another: weighted median over blocks, and whether all blocks agree."""

    value: float
    even: bool

    def off(self, tolerance: float) -> bool:
        """Return whether it is not 1."""
        return abs(self.value - 1.0) > tolerance

    def near(self, unit: float) -> bool:
        """Return whether it is a factor, within a tenth."""
        return self.even and abs(self.value / unit - 1.0) <= ALIKE


def _ratio(one: Array | None, other: Array | None) -> Ratio | None:
    """Return the ratio of two channels over the blocks in which the other turned; None where it did not."""
    if one is None or other is None:
        return None
    size = np.abs(other)
    largest = np.partition(size, -max(len(size) // 10, 1))[-max(len(size) // 10, 1)]
    if not float(np.sum(np.minimum(size, largest))) > LEAST_TOTAL_DEG:
        return None
    used = size > 0.3 * largest
    weight = np.minimum(size[used], largest)
    ratio = one[used] / other[used]
    order = np.argsort(ratio)
    total = np.cumsum(weight[order]) / weight.sum()
    low, middle, high = np.abs(ratio[order[np.searchsorted(total, [0.25, 0.5, 0.75])]])
    return Ratio(float(middle), bool(middle > 0.0 and abs(high - low) <= SPREAD * middle))


def _agrees(ratio: Ratio | None) -> bool:
    return ratio is not None and ratio.even and not ratio.off(GRAVITY_TOLERANCE)


def _of_time(ratio: Ratio) -> bool:
    return any(ratio.near(f) for f, _ in TIMES)


def _whole(recording: Recording) -> str:
    return place(recording, 0, recording.samples - 1)


def _refuse_rate(
    recording: Recording, settings: Mapping[str, Any], ratio: Ratio, of_gyro: Ratio | None, against: str
) -> NoReturn:
    """Refuse the table's rate, or the time or both rates where the gyroscope agrees with it."""
    gyro_agrees = _agrees(of_gyro)
    if gyro_agrees and _of_time(ratio):
        _refuse_time(recording, settings, ratio, "the table's rate sums up to")
    name = column(recording, "table_rate", settings)
    what = next((w for f, w in UNITS if ratio.near(f)), f"is {ratio.value:.4g} times what it should be")
    keys = "ingest.csv.columns.table_rate.unit"
    if gyro_agrees and what.startswith("looks"):
        keys += " and those of gyro_x, gyro_y, gyro_z"
        name, what = f"{name} and {column(recording, 'gyroscope', settings)}", what.replace("looks", "look", 1)
    raise refusal(
        recording,
        "reference_scale",
        f"{name} {what}: over {_whole(recording)} the rate sums up to {ratio.value:.4g} times the angle by {against}",
        f"correct {keys}",
    )


def _refuse_angle(recording: Recording, settings: Mapping[str, Any], factor: float, against: str) -> NoReturn:
    name = column(recording, "table_angle", settings)
    what = next(
        (w for f, w in ANGLE_UNITS if abs(factor / f - 1.0) <= ALIKE), f"is {factor:.4g} times what it should be"
    )
    raise refusal(
        recording,
        "reference_scale",
        f"{name} {what}: over {_whole(recording)} it turns {factor:.4g} times as far as {against} says",
        "correct ingest.csv.columns.table_angle.unit",
    )


def _refuse_time(recording: Recording, settings: Mapping[str, Any], ratio: Ratio, seen: str) -> NoReturn:
    what = next(w for f, w in TIMES if ratio.near(f))
    raise refusal(
        recording,
        "reference_time",
        f"{column(recording, 'time', settings)} looks like {what}: {seen} {ratio.value:.4g} times the angle that the "
        f"table turned over {_whole(recording)}",
        "correct ingest.csv.columns.time.unit",
    )
