"""The rotation of a recording by each of its channels, in one form, so that they can be compared.

A table's angle or attitude gives the exact mean rate over the interval between two samples. A logged rate and a
gyroscope give the rate at the samples. Scales are compared by the weighted median of ratios. Its weights are cut off,
so that a few spikes do not change it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.core.errors import IngestError
from pipeline.core.records import (
    AXES,
    SENSORS,
    Mask,
    Recording,
    Values,
    conjugate_product,
    continuous,
    median,
    noise_of_steps,
    once,
    once_of_log,
)
from pipeline.core.settings import Settings
from pipeline.ingest.quality_flags import GAP_INTERVALS

EXPANDED = 3.0  # coverage of a stated standard uncertainty: 99.7 % of a normal distribution
OPPOSITE = 0.8  # correlation from which two channels differ in sign alone
SIGN_BLOCK = 8  # intervals over which both channels show the angle of a short move
SAMPLED = 0.05  # relative error of an angle summed up from the rate in moves of some samples (1.6 % in 3 deg)
MIN_GRAVITY_TURN_DEG = 60.0  # for gravity to determine an angle: biases of 0.1 g distort its phase by 6 deg
LEAST_SWING_G = 0.5  # radius of gravity's circle from which the axis is level
FASTEST_DEG = 90.0  # in one interval, beyond which the phase may lose a turn
LEAST_RATE_DPS = 1.0  # change of a rate from which it determines the gyroscope's scale


@dataclass(frozen=True)
class ChannelLimits:
    """How much an effect of the catalogue may make channels differ, and the names of channels in the files."""

    late_s: float  # time_offset and low_pass_lag
    clock: float  # relative
    rate: float  # relative
    rate_stated: float  # relative: three times the stated standard uncertainty of the table's rate
    angle_deg: float
    angle_stated_deg: float
    gain: float  # relative, of a gyroscope by its sensor file
    offset_dps: float  # of the gyroscope, by gravity
    columns: Mapping[str, Any]  # ingest.csv.columns

    @classmethod
    def of(cls, settings: Settings) -> ChannelLimits:
        """Return the limits by sensor model, table and ingest profile; those that are not stated are 0."""
        effects = [settings.sensor.of(s).effects for s in SENSORS]
        gyroscope = settings.sensor.gyroscope

        def most(name: str) -> float:
            return max(e.get(name, 0.0) for e in effects)

        stated = EXPANDED * settings.table.rate_accuracy
        angle = EXPANDED * settings.table.angle_accuracy_deg
        encoder = most("table_encoder_error")
        return cls(
            late_s=most("time_offset") + most("low_pass_lag"),
            clock=1e-6 * most("clock_rate"),
            rate=max(SAMPLED, most("table_rate_ripple") + np.radians(encoder) + 1e-6 * most("clock_rate") + stated),
            rate_stated=stated,
            angle_deg=encoder + 2.0 * most("table_backlash") + angle,
            angle_stated_deg=angle,
            gain=gyroscope.scale_factor + gyroscope.cross_axis,
            offset_dps=most("g_sensitivity") + most("g_squared_sensitivity"),
            columns=settings.ingest.csv.get("columns") or {},
        )

    def column(self, recording: Recording, channel: str) -> str:
        """Return the name of a channel in the recording's file."""
        if not str(recording.source.get("file", "")).endswith(".csv"):
            return channel
        ends = {"gyroscope": ("gyro_x", "gyro_z"), "table_attitude": ("table_qw", "table_qz")}.get(channel, (channel,))
        entries = [(c, self.columns.get(c)) for c in ends]
        return " .. ".join(str(e.get("column", c) or c) if isinstance(e, dict) else c for c, e in entries)


@dataclass(frozen=True)
class Channel:
    """The rotation by a channel of the table (``table_rate``, ``table_angle``, ``table_attitude``) or a sensor.

    ``low``, ``high``: (m,), rate at the n samples or over the n - 1 intervals, infinite where it is unknown.
    """

    name: str
    low: Values  # deg/s
    high: Values
    turned: Values  # (n - 1,), deg in each interval; 0 where it is unknown
    noise: float  # deg/s

    @property
    def of_intervals(self) -> bool:
        """Whether the rates are means over intervals."""
        return len(self.low) == len(self.turned)


def quantiles(values: Values, *shares: float) -> Values:
    """Return quantiles without interpolation; numpy partitions many equal values fast only at several places."""
    last = len(values) - 1
    places = [round(share * last) for share in shares]
    return np.asarray(np.partition(values, [*places, last], axis=0)[places])


@once_of_log
def gaps(recording: Recording) -> Mask:
    """Return which intervals are longer than 1.5 times the usual one: (n - 1,) array."""
    longest = GAP_INTERVALS * recording.interval * 1e9
    return np.asarray(np.diff(recording.time_ns) > longest)


@once_of_log
def of_table(recording: Recording) -> tuple[Channel, ...]:
    """Return the rotation by the table's log: rate and angle of a turn; of held-out motion |rate| and attitude."""
    channels, turns = [], recording.axis is not None
    rate, angle, attitude = recording.table_rate, recording.table_angle, recording.table_attitude
    if rate is not None:
        channels.append(of_rate(recording, "table_rate", rate if turns else np.abs(rate)))
    if turns and angle is not None:
        channels.append(_of_turned("table_angle", recording, np.diff(angle)))
    if not turns and attitude is not None:
        channels.append(_of_turned("table_attitude", recording, np.linalg.norm(spin(recording), axis=1)))
    return tuple(channels)


@once_of_log
def spin(recording: Recording) -> Values:
    """Return the rotation vector, in the body, from each logged attitude to the next: (n - 1, 3) array, deg."""
    q = continuous(np.asarray(recording.table_attitude))
    sine = conjugate_product(q[:-1], q[1:])
    size = np.linalg.norm(sine, axis=1, keepdims=True)
    angle = 2.0 * np.arcsin(np.minimum(size, 1.0))
    return np.asarray(np.degrees(np.where(size > 0, sine * angle / np.where(size > 0, size, 1.0), 0.0)))


def _of_turned(name: str, recording: Recording, turned: Values) -> Channel:
    rate = turned / recording.time_steps
    lost = gaps(recording)
    return Channel(name, np.where(lost, -np.inf, rate), np.where(lost, np.inf, rate), np.where(lost, 0.0, turned), 0.0)


def of_rate(recording: Recording, name: str, rate: Values, known: Mask | None = None) -> Channel:
    """Return the rotation by rates at the samples; an unknown rate contradicts nothing."""
    turned = np.where(gaps(recording), 0.0, 0.5 * (rate[1:] + rate[:-1]) * recording.time_steps)
    low = high = rate
    if known is not None and not known.all():
        low, high = np.where(known, rate, -np.inf), np.where(known, rate, np.inf)
        turned = np.where(known[1:] & known[:-1], turned, 0.0)
    noise = float(noise_of_steps(np.abs(np.diff(rate)))) if name == "gyroscope" and len(rate) > 1 else 0.0
    return Channel(name, low, high, turned, noise)


def alike(one: Values, two: Values) -> float:
    """Return the correlation of two angles turned in blocks; 0 if one does not turn."""
    starts = np.arange(0, len(one), SIGN_BLOCK)
    a, b = np.add.reduceat(one, starts), np.add.reduceat(two, starts)
    size = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / size if size > 0.0 else 0.0


@once
def gravity_turned(recording: Recording) -> Values | None:
    """Return the angle by which gravity turned about the turn axis in each interval, deg; None if it does not turn."""
    force, axis = recording.accelerometer, axis_index(recording)
    if force is None:
        return None
    across = force[:, [(axis + 1) % 3, (axis + 2) % 3]]
    low, high = quantiles(across, 0.01, 0.99)
    centred = across - np.where(high - low > 3.0 * LEAST_SWING_G, (low + high) / 2.0, 0.0)
    if float(median(np.hypot(*centred.T))) < LEAST_SWING_G:
        return None
    turned = np.diff(np.degrees(np.arctan2(centred[:, 1], centred[:, 0])))
    turned -= 360.0 * np.rint(turned / 360.0)
    phase = np.append(0.0, np.cumsum(turned))
    if float(np.ptp(phase)) < MIN_GRAVITY_TURN_DEG or float(quantiles(np.abs(turned), 0.99)[0]) > FASTEST_DEG:
        return None
    turned[gaps(recording)] = 0.0
    return np.asarray(turned)


def of_gravity(recording: Recording, turned: Values, channels: Sequence[Channel]) -> Channel:
    """Return the rotation by gravity, with the sign of the gyroscope or, without it, of the most similar channel."""
    correlation = next((alike(turned, c.turned) for c in channels if c.name == "gyroscope"), 0.0)
    if abs(correlation) <= OPPOSITE:
        correlation = max((alike(turned, c.turned) for c in channels), key=abs)
    sign = -1.0 if correlation < 0.0 else 1.0
    noise = float(noise_of_steps(np.abs(np.diff(turned)))) / recording.interval
    return replace(_of_turned("gravity", recording, sign * turned), noise=noise)


def ratio_quantiles(one: Values, other: Values, cut: int, least: float, *shares: float) -> Values:
    """Return weighted quantiles of the ratios of (n,) or (n, k) values to a channel: (q,) or (q, k) array.

    The weights ``|other|`` are cut off at their (1 / cut) largest value; ratios below ``least`` of that are left out.
    """
    size = np.abs(other)
    largest = largest_but(size, cut)
    used = size > least * largest
    weight, ratio = np.minimum(size[used], largest), np.atleast_2d(one.compress(used, axis=0).T) / other[used]
    order = np.argsort(ratio, axis=1)
    total = np.cumsum(weight[order], axis=1) / weight.sum()
    rows = zip(ratio, order, total, strict=True)
    found = np.stack([values[places[np.searchsorted(sums, shares)]] for values, places, sums in rows], axis=1)
    return found if one.ndim > 1 else found[:, 0]


def largest_but(size: Values, cut: int) -> float:
    """Return the value that a share ``1 / cut`` of all values reaches."""
    place = len(size) - max(len(size) // cut, 1)
    return float(np.partition(size, (place, len(size) - 1))[place])  # as in ``quantiles``


def axis_index(recording: Recording) -> int:
    """Return the index of the axis that a recording turns about."""
    return AXES.index(str(recording.axis))


def place(recording: Recording, first: int, last: int) -> str:
    """Return numbers and times of samples in words; they are rows of the file if ingest left out none."""
    what = "row" if recording.samples == recording.source.get("rows") else "sample"
    t = recording.time
    if first == last:
        return f"{what} {first + 1} ({t[first]:.9g} s)"
    return f"{what}s {first + 1} to {last + 1} ({t[first]:.9g} to {t[last]:.9g} s)"


def refusal(recording: Recording, code: str, message: str, hint: str) -> IngestError:
    """Return the error that refuses a recording."""
    return IngestError(f"recording {recording.name}: {message}", recording.source.get("file"), code=code, hint=hint)
