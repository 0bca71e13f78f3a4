"""Held-out samples of a sensor, with the reference of each and the variance of its noise.

The reference of a filtered recording is taken at ``time - delay``. Its magnitude is

    accelerometer: gravity_g,      gyroscope: |rate of the table|

The rate is that of the table's log, else of the attitude's derivative, else of the angle where the unit turns about one
fixed axis. Errors of the rate by the resolution of the encoder count as white noise. With Earth's rotation configured,
``|omega + Omega| - |omega|`` is added to the rate, because the gyroscope measures Earth's rotation as well.

The mean squared error of the magnitude of a vector t, given the covariance S of the vector's error x, is

    E(|t + x| - |t|)^2 = tr(W S),    W = u u' + g (I - u u'),    u = t/|t|

Where |t| is beyond 30 standard deviations of x, the norm is linear in x and g = 0. Nearer to zero (a gyroscope at rest)
g is such that the mean squared error is ``2 |t|^2 + tr S - 2 |t| E|t + x|``, with

    E|t + x| = 1/sqrt(pi) int_0^inf (1 - phi(v^2)) / v^2 dv
    phi(s) = prod_i (1 + 2 s l_i)^(-1/2) exp(-s t_i^2 / (1 + 2 s l_i))

with the eigenvalues l_i of S and the components t_i of t along its eigenvectors, by Gauss-Legendre quadrature after
``v = c tan(theta)``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from pipeline.core.records import Index, Mask, Motion, Noise, Recording, SensorCalibration, Values, finite_rows
from pipeline.core.settings import Settings, Table
from pipeline.estimation.gauss_markov import variance_of_average
from pipeline.estimation.observations import filtered_motion
from pipeline.estimation.rest_means import held_out_rests, rest_means, split_rests, variances_of_means
from pipeline.physics.effects.base import length, truth
from pipeline.physics.effects.equations import shifted
from pipeline.physics.kinematics import earth_in_body, earth_of, table_motion
from pipeline.physics.measurement import linear_truth
from pipeline.physics.signal.encoder_rate import MIN_RATE_SAMPLES, EncoderRate, rate_by_angle
from pipeline.physics.signal.filters import filter_autocovariance, temperature_rate_of
from pipeline.physics.signal.quiet_motion import creep_of_rest, posterior_creep_rates
from pipeline.physics.signal.rests import Rest

OTHER_SENSOR = {"accelerometer": "gyroscope", "gyroscope": "accelerometer"}
UNCALIBRATED_ERROR = 0.05  # of scale and axes before calibration: scale 3 %, cross-axis 2 % (data sheets)
OFF_AXIS_SHARE = 0.03  # of the rate about one axis; cross-axis sensitivity of data sheets, and effects, cause less
NODES, NODE_WEIGHTS = np.polynomial.legendre.leggauss(48)  # enough for the 0.4 % of a simulation (test_norm_error)
THETA, STEP = np.pi / 4.0 * (NODES + 1.0), np.pi / 4.0 * NODE_WEIGHTS
LINEAR_FROM = 30.0  # standard deviations from zero, beyond which the norm is linear to 1e-3
AT_ONCE = 10_000  # samples near zero whose quadratures are computed together: 10 MB an array
REPRESENTATIVE_SAMPLES = 2000  # samples that represent a recording: its directions and rates change slowly


@dataclass(frozen=True)
class Samples:
    """Samples of one recording on which the error of a calibration is computed."""

    sensor: str
    time: Values  # (n,), s
    reading: Values  # (n, 3), g or deg/s
    magnitude: Values  # (n,), of the reference
    white_variance: Values  # (n, 3), of white noise after the filter, per reading axis; see ``variance``
    wander_variance: Values  # (n, 3)
    motion: Motion | None  # of the reference, where the attitude is known
    other: Values | None  # (n, 3), readings of the other sensor, calibrated where its calibration is known
    temperature: Values | None  # (n,), degC
    resting: bool = False  # whether each sample is the mean of a rest
    correlated_samples: float = 1.0  # that count as one independent sample of the noise after the filter
    setup: str = ""  # session of the recording
    earth_left_out: bool = False  # whether Earth's rotation is configured, but is not in the magnitude
    temperature_rate: Callable[[], Values] | None = None  # returns (n,), degC/s; where the temperature is known

    @property
    def variance(self) -> Values:
        """Variance of the noise of each sample, per reading axis: (n, 3) array, unit squared.

        White noise contains the error by the encoder's resolution and, at rests, the uncertainty of their creep.
        """
        return self.white_variance + self.wander_variance

    @cached_property
    def known(self) -> Mask:
        """Whether a sample has reading and reference: (n,) array."""
        return np.asarray(finite_rows(self.reading) & np.isfinite(self.magnitude))

    @cached_property
    def representative(self) -> Index:
        """Indices of known samples that represent the recording."""
        known = np.flatnonzero(self.known)
        places = np.linspace(0, len(known) - 1, REPRESENTATIVE_SAMPLES).astype(int)
        return np.asarray(known[np.flatnonzero(np.bincount(places))])  # each place once


@dataclass(frozen=True)
class HeldOutCase:
    """A calibration, and the data from which its held-out error is computed.

    ``recordings``: all of the unit, filtered as for the fit; ``other``: calibration of the unit's other sensor, for
    effects that depend on its signal where no attitude is logged. Without it, the readings of the other sensor are
    used.
    """

    calibration: SensorCalibration
    recordings: Sequence[Recording]
    noise: Noise
    settings: Settings
    other: SensorCalibration | None = None

    @property
    def by_hand(self) -> bool:
        """Whether the unit was recorded in rests and moves by hand."""
        return any(r.role == "rests" for r in self.recordings)

    def held_out_samples(self, *, smoothed: bool = False) -> list[Samples]:
        """Return the samples of recordings of role ``validation``, else those of held-out rests.

        ``smoothed``: see ``samples_of_motion``.
        """
        found = self._in_motion("validation", smoothed=smoothed)
        if found or not self.by_hand:
            return found
        held_out = held_out_rests(self.recordings, self.settings.procedure)
        return self.at_rests(held_out) or self._at_rests_of("validation")

    def fit_samples(self, *, followed: bool = True) -> list[Samples]:
        """Return the samples that the fit used; ``followed``: see ``samples_of_motion``."""
        sensor = self.calibration.sensor
        return self._in_motion(sensor, followed=followed) or self._at_rests_of("rests") or self._at_rests_of(sensor)

    def at_rests(self, rests: Mapping[str, Sequence[Rest]]) -> list[Samples]:
        """Return the mean readings of given rests, by the name of their recording."""
        gyroscope = self.calibration.sensor == "gyroscope"
        chosen = (r for r in self.recordings if rests.get(r.name) and not (gyroscope and r.kind == "slow"))
        found = (self._means(r, rests[r.name]) for r in chosen)
        return [samples for samples in found if samples is not None]

    def _at_rests_of(self, role: str) -> list[Samples]:
        return self.at_rests({r.name: split_rests(r, 0).used for r in self.recordings if r.role == role})

    def _in_motion(self, role: str, *, smoothed: bool = False, followed: bool = True) -> list[Samples]:
        sensor, table, chosen = self.calibration.sensor, self.settings.table, self.recordings
        if self.by_hand:  # without a log of the motion the specific force between the rests is unknown
            logs = ("table_attitude", "table_rate", "table_angle")
            chosen = [r for r in chosen if any(getattr(r, log) is not None for log in logs)]
        known = partial(samples_of_motion, other=self.other, smoothed=smoothed, followed=followed)
        found = [known(sensor, r, self.noise, table) for r in chosen if r.role == role]
        return [s for s in found if s is not None and finite_rows(s.reading).any()]

    def _means(self, recording: Recording, rests: Sequence[Rest]) -> Samples | None:
        """Return the mean readings of the rests of a recording, or None without any.

        The rate at which the unit creeps, as far as the accelerometer shows it, is subtracted from the means of a
        gyroscope. Its uncertainty counts as white noise of the rest (``pipeline.physics.signal.quiet_motion``).
        """
        sensor, noise = self.calibration.sensor, self.noise
        reading, counts = rest_means(recording, rests, sensor)
        rests = [rest for rest, count in zip(rests, counts, strict=False) if count]
        if not rests:
            return None
        reading, counts = reading[counts > 0], counts[counts > 0]
        other, _ = rest_means(recording, rests, OTHER_SENSOR[sensor])
        share, own = variances_of_means(recording, counts, sensor)
        averaged = variance_of_average(counts.astype(np.float64) * recording.interval, noise.correlation_time)
        white = share[:, None] * noise.white**2 + own[:, None]
        if recording.kind == "slow":  # by the accelerations of the movement, as far as they scatter in the fit
            scatters = [stage.details.scatter_between_rests or 0.0 for stage in self.calibration.stages]
            white = white + max(scatters, default=0.0) ** 2
        if sensor == "gyroscope" and recording.accelerometer is not None:
            rate, unknown = _creep(recording, rests, other)
            reading, white = reading - rate, white + unknown

        def mean(values: Values) -> Values:
            return np.array([np.mean(values[r.start : r.stop]) for r in rests])

        gravity = self.settings.table.gravity_g
        return Samples(
            sensor,
            mean(recording.time),
            reading,
            np.full(len(rests), gravity if sensor == "accelerometer" else 0.0),
            white,
            averaged[:, None] * (_wander_gain(recording) * noise.wander**2),
            None,
            _truth_of_other(other, self.other) if len(other) else None,
            None if recording.temperature is None else mean(recording.temperature),
            resting=True,
            setup=recording.setup,
            temperature_rate=lambda: mean(temperature_rate_of(recording)),
        )


def samples_of_motion(
    sensor: str,
    recording: Recording,
    noise: Noise,
    table: Table,
    *,
    other: SensorCalibration | None = None,
    smoothed: bool = False,
    followed: bool = True,
) -> Samples | None:
    """Return the samples of a recording, or None without readings of the sensor or without a reference.

    ``other``: calibration of the other sensor. With ``smoothed``, a reference whose attitude is known passes the filter
    of the recording: the filter then causes no error. ``followed``: whether an attitude that is known is used.
    """
    reading, n = recording.reading(sensor), recording.samples
    if reading is None or n == 0:
        return None
    delay = float(recording.filter.get("delay_s", 0.0))
    motion, earth = table_motion(recording, table) if followed else None, earth_of(table)
    smoothed = smoothed and motion is not None and recording.filter["name"] != "none"
    if motion is not None:
        motion = filtered_motion(motion, recording) if smoothed else shifted(motion, -delay)
    white = np.broadcast_to((float(recording.filter.get("noise_gain", 1.0)) * noise.white) ** 2, (n, 3))
    magnitude = np.full(n, table.gravity_g)
    if sensor == "gyroscope":
        by_angle = _rate_by_angle(recording)
        rate = _rate(recording, motion, earth, delay, by_angle)
        if rate is None:
            return None
        magnitude = rate
        if by_angle is not None:
            white = white + by_angle.noise[:, None] ** 2
    if smoothed and motion is not None:
        magnitude = length(truth(sensor, motion))
    squares = filter_autocovariance(recording) ** 2
    return Samples(
        sensor,
        recording.time,
        reading,
        magnitude,
        white,
        np.broadcast_to(_wander_gain(recording) * noise.wander**2, (n, 3)),
        motion,
        _truth_of_other(recording.reading(OTHER_SENSOR[sensor]), other),
        recording.temperature if motion is None else motion.temperature,
        correlated_samples=float((2.0 * squares.sum() - squares[0]) / squares[0]),  # sum of r_l^2 / r_0^2 over lags l
        setup=recording.setup,
        earth_left_out=sensor == "gyroscope" and earth is not None and motion is None,
        temperature_rate=partial(temperature_rate_of, recording),
    )


def _truth_of_other(reading: Values | None, calibration: SensorCalibration | None) -> Values | None:
    """Return readings of the other sensor, without its bias and matrix where it is calibrated."""
    return reading if reading is None or calibration is None else linear_truth(calibration, reading)


def reference_vector(calibration: SensorCalibration, samples: Samples, at: Mask | Index) -> Values:
    """Return the reference's magnitude along its direction, else along the calibrated reading, at n samples: (n, 3)."""
    direction = np.full((len(samples.time), 3), np.nan)[at]
    if samples.motion is not None:
        direction = truth(samples.sensor, samples.motion)[at]
    if (unknown := ~finite_rows(direction)).any():
        direction = np.where(unknown[:, None], linear_truth(calibration, samples.reading[at]), direction)
    size = length(direction)[:, None]
    if not np.all(size > 0):
        direction, size = np.where(size > 0, direction, [1.0, 0.0, 0.0]), np.where(size > 0, size, 1.0)
    return np.asarray(samples.magnitude[at, None] * (direction / size))


def _creep(recording: Recording, rests: Sequence[Rest], force: Values) -> tuple[Values, Values]:
    """Return the rate at which the unit creeps in each rest, deg/s, and the variance of its error."""
    every = *split_rests(recording, 0).used, *rests
    creeps = {(r.start, r.stop): creep_of_rest(recording, r.start, r.stop) for r in every}
    rates, errors, about_gravity = posterior_creep_rates(list(creeps.values()))
    chosen = [list(creeps).index((rest.start, rest.stop)) for rest in rests]
    rate, error = rates[chosen], errors[chosen]
    upward = (force / np.linalg.norm(force, axis=1, keepdims=True)) ** 2
    across = error**2 + UNCALIBRATED_ERROR**2 * np.sum(rate**2, axis=1)
    nearest = np.eye(3)[np.argmax(upward, axis=1)]  # one error: distributed to three axes it would count as several
    return rate, across[:, None] * (1.0 - upward) + about_gravity**2 * nearest


def _wander_gain(recording: Recording) -> float:
    """Return the power gain of the filter at 0 Hz, from 0 (high-pass) to 1: the share of the wander's variance."""
    covariance = filter_autocovariance(recording)
    return float(np.clip(2.0 * covariance.sum() - covariance[0], 0.0, 1.0))


def _rate(
    recording: Recording, motion: Motion | None, earth: Values | None, delay: float, by_angle: EncoderRate | None
) -> Values | None:
    """Return the magnitude of the rate that the gyroscope should measure: (n,) array, deg/s; None if it is unknown."""
    logged = recording.table_rate
    if motion is not None:
        rate = length(truth("gyroscope", motion))
        if logged is None:
            return rate if by_angle is None else np.where(by_angle.vague, np.nan, rate)
    elif by_angle is not None:
        logged = np.where(by_angle.vague, np.nan, by_angle.rate)
    if logged is None:
        return None
    if delay:
        logged = np.interp(recording.time - delay, recording.time, logged)
    if motion is None:
        return np.abs(logged)
    of_table = rate
    if earth is not None and motion.level is not None:
        of_table = length(motion.angular_rate - earth_in_body(earth, motion.level))
    return np.asarray(np.abs(logged) + (rate - of_table))


def _rate_by_angle(recording: Recording) -> EncoderRate | None:
    """Return the rate by the table's angle, where the table logs nothing better and turns about one fixed axis."""
    by_angle = rate_by_angle(recording)
    if by_angle is None or recording.axis is not None:
        return by_angle
    if recording.table_attitude is not None or recording.gyroscope is None:
        return None
    finite = recording.gyroscope[finite_rows(recording.gyroscope)]
    if len(finite) < MIN_RATE_SAMPLES:
        return None
    spread = np.linalg.eigvalsh(np.cov(finite.T))
    return by_angle if spread[1] <= OFF_AXIS_SHARE**2 * spread[2] else None


def squared_norm_errors(truth: Values, matrix: Values, variance: Values) -> Values:
    """Return ``E(|t + M n| - |t|)^2`` of each sample, unit squared: (n,) array.

    ``truth``: (n, 3), g or deg/s; ``matrix``: M; ``variance``: (n, 3), of the noise n of each reading axis.
    """
    if np.all(variance == variance[:1]):  # of samples, not of means over rests
        return mean_squares(truth, (matrix * variance[0]) @ matrix.T)[0]
    kinds, which = np.unique(variance, axis=0, return_inverse=True)
    out = np.empty(len(truth))
    for kind, var in enumerate(kinds):
        mine = which.reshape(-1) == kind
        out[mine] = mean_squares(truth[mine], (matrix * var) @ matrix.T)[0]
    return out


def mean_squares(truth: Values, S: Values) -> tuple[Values, Values]:
    """Return ``E(|t + x| - |t|)^2`` and its weight g, for (n, 3) truths and errors x of covariance S: (n,) arrays."""
    size, total = length(truth), float(np.trace(S))
    u = truth / np.where(size > 0.0, size, 1.0)[:, None]
    along = np.einsum("ij,ij->i", u @ S, u)
    squares, g = along.copy(), np.zeros(len(truth))
    near = (size <= LINEAR_FROM * np.sqrt(total)) & (total > 0.0)
    if near.any():
        pieces = np.array_split(np.flatnonzero(near), 1 + np.count_nonzero(near) // AT_ONCE)
        squares[near] = np.concatenate([_near_zero(truth[at], size[at], S) for at in pieces])
        g[near] = np.clip((squares - along)[near] / np.maximum(total - along[near], 1e-12 * total), 0.0, 1.0)
    return squares, g


def _near_zero(truth: Values, size: Values, S: Values) -> Values:
    """Return ``E(|t + x| - |t|)^2`` by quadrature: (n,) array."""
    l, V = np.linalg.eigh(S)
    l = np.clip(l, 0.0, None)
    t = (truth @ V) ** 2
    c = 1.0 / np.sqrt(l.sum() + size**2)
    s = (c[:, None] * np.tan(THETA)) ** 2
    spread = 1.0 + 2.0 * s[:, :, None] * l
    phi = np.exp(-np.sum(s[:, :, None] * t[:, None, :] / spread, axis=2)) / np.sqrt(np.prod(spread, axis=2))
    mean_norm = np.sum(STEP * (1.0 - phi) / np.sin(THETA) ** 2, axis=1) / (c * np.sqrt(np.pi))
    return np.asarray(2.0 * size**2 + l.sum() - 2.0 * size * mean_norm)
