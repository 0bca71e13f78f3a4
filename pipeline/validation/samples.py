"""Held-out samples of a sensor, with the reference of each and the variance of its noise.

The reference of a filtered recording is taken at ``time - delay``. Its magnitude is

    accelerometer: gravity_g,      gyroscope: |table rate|

where the table rate is that of the log, else that of the attitude's derivative, else that of the angle where the unit
turns about one fixed axis; its error by the encoder's resolution counts as white noise. With Earth's rotation
configured, ``|omega + Omega| - |omega|`` is added to the rate, because the gyroscope measures that too.

The mean squared error of the magnitude of a vector t, given the covariance S of the vector's error x, is

    E(|t + x| - |t|)^2 = tr(W S),    W = u u' + g (1 - u u'),    u = t/|t|

where |t| is beyond 30 standard deviations of x, the norm is linear in x and g = 0. Nearer to zero (a gyroscope at rest)
g follows from the mean ``2 |t|^2 + tr S - 2 |t| E|t + x|``, with

    E|t + x| = 1/sqrt(pi) int_0^inf (1 - phi(v^2)) / v^2 dv
    phi(s) = prod_i (1 + 2 s l_i)^(-1/2) exp(-s t_i^2 / (1 + 2 s l_i))

with the eigenvalues l_i of S and the components t_i of t along its eigenvectors, by Gauss-Legendre quadrature after
``v = c tan(theta)``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.estimation.gauss_markov import variance_of_average
from pipeline.estimation.observations import filtered_motion
from pipeline.estimation.rest_means import rest_means, split_rests
from pipeline.model.effects.base import truth
from pipeline.model.effects.timing import shifted
from pipeline.model.kinematics import earth_of, table_motion
from pipeline.signal.encoder_rate import FEWEST, EncoderRate, rate_by_angle
from pipeline.signal.filters import filter_autocovariance, variance_of_mean
from pipeline.signal.quiet_motion import creep_of_rest, posterior_creep_rates

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.records import Mask, Motion, Noise, Recording, Values
    from pipeline.signal.rests import Rest

OTHER = {"accelerometer": "gyroscope", "gyroscope": "accelerometer"}
UNCALIBRATED_ERROR = 0.05  # of scale and axes before calibration: scale 3 %, cross-axis 2 % (data sheets)
OFF_AXIS_SHARE = 0.03  # of the rate about one axis; cross-axis sensitivity of data sheets, and effects, cause less
NODES, NODE_WEIGHTS = np.polynomial.legendre.leggauss(48)  # enough for the 0.4 % of a simulation (test_norm_error)
THETA, STEP = np.pi / 4.0 * (NODES + 1.0), np.pi / 4.0 * NODE_WEIGHTS
LINEAR_FROM = 30.0  # standard deviations from zero, beyond which the norm is linear to 1e-3


@dataclass(frozen=True)
class Samples:
    """Samples of one recording on which a calibration is judged."""

    sensor: str
    time: Values  # (n,), s
    reading: Values  # (n, 3), g or deg/s
    magnitude: Values  # (n,), that of the reference
    white_variance: Values  # (n, 3), of white noise after the filter, per reading axis; see ``variance``
    wander_variance: Values  # (n, 3)
    motion: Motion | None  # by the reference, where the attitude is known
    other: Values | None  # (n, 3), readings of the other sensor
    temperature: Values | None  # (n,), degC
    resting: bool = False  # whether each sample is the mean of a rest
    correlated_samples: float = 1.0  # that count as one independent sample of the noise after the filter
    setup: str = ""  # session of the recording
    earth_left_out: bool = False  # whether Earth's rotation is configured, but without an attitude not in the magnitude

    @property
    def variance(self) -> Values:
        """Of the noise of each sample, per reading axis: (n, 3) array, unit squared.

        White noise contains the resolution of the encoder and, of rests, what is not known of their creep.
        """
        return self.white_variance + self.wander_variance

    @property
    def known(self) -> Mask:
        """Whether reading and reference of each sample are there: (n,) array."""
        return np.asarray(np.isfinite(self.reading).all(axis=1) & np.isfinite(self.magnitude))


def samples_of_motion(
    sensor: str, recording: Recording, noise: Noise, table: Mapping[str, Any], *, smoothed: bool = False
) -> Samples | None:
    """Return a recording's samples, or None where it holds no readings of the sensor or no reference for them.

    With ``smoothed``, the reference goes through the recording's filter, where its attitude is known.
    """
    reading = recording.reading(sensor)
    if reading is None or recording.samples == 0:
        return None
    gravity = float(table.get("gravity_g") or 1.0)
    delay = float(recording.filter.get("delay_s", 0.0))
    motion, earth = table_motion(recording, table), earth_of(table)
    smoothed = smoothed and motion is not None and recording.filter["name"] != "none"
    if motion is not None:
        motion = filtered_motion(motion, recording) if smoothed else shifted(motion, -delay)
    magnitude = np.full(recording.samples, gravity)
    by_angle = _rate_by_angle(recording) if sensor == "gyroscope" else None
    if sensor == "gyroscope":
        rate = _rate(recording, motion, earth, delay, by_angle)
        if rate is None:
            return None
        magnitude = rate
    if smoothed and motion is not None:
        magnitude = np.linalg.norm(truth(sensor, motion), axis=1)
    temperature = recording.temperature if motion is None else motion.temperature
    n = recording.samples
    return Samples(
        sensor,
        recording.time,
        reading,
        magnitude,
        np.broadcast_to((float(recording.filter.get("noise_gain", 1.0)) * noise.white) ** 2, (n, 3))
        + (0.0 if by_angle is None else by_angle.noise[:, None] ** 2),
        np.broadcast_to(_wander_gain(recording) * noise.wander**2, (n, 3)),
        motion,
        recording.reading(OTHER[sensor]),
        temperature,
        correlated_samples=_correlated_samples(recording),
        setup=recording.setup,
        earth_left_out=sensor == "gyroscope" and earth is not None and motion is None,
    )


def samples_of_rests(
    sensor: str, recording: Recording, rests: Sequence[Rest], noise: Noise, table: Mapping[str, Any]
) -> Samples | None:
    """Return the mean readings of rests, or None where there are none.

    From those of a gyroscope the rate at which the unit creeps is subtracted, as far as the accelerometer shows it.
    What it does not show counts as white noise of the rest (``pipeline.signal.quiet_motion``).
    """
    reading, counts = rest_means(recording, rests, sensor)
    rests = [rest for rest, count in zip(rests, counts, strict=False) if count]
    if not rests:
        return None
    reading, counts = reading[counts > 0], counts[counts > 0]

    def means(values: Values | None) -> Values | None:
        return None if values is None else np.array([np.mean(values[r.start : r.stop]) for r in rests])

    other, _ = rest_means(recording, rests, OTHER[sensor])
    share = variance_of_mean(filter_autocovariance(recording), counts)
    averaged = variance_of_average(counts.astype(np.float64) * recording.interval, noise.correlation_time)
    wander = _wander_gain(recording) * noise.wander**2
    gravity = float(table.get("gravity_g") or 1.0) if sensor == "accelerometer" else 0.0
    time = means(recording.time)
    assert time is not None  # noqa: S101
    white = share[:, None] * noise.white**2
    if sensor == "gyroscope" and recording.accelerometer is not None:
        rate, unknown = _creep(recording, rests, other)
        reading, white = reading - rate, white + unknown
    return Samples(
        sensor,
        time,
        reading,
        np.full(len(rests), gravity),
        white,
        averaged[:, None] * wander,
        None,
        other if len(other) else None,
        means(recording.temperature),
        resting=True,
        setup=recording.setup,
    )


def _creep(recording: Recording, rests: Sequence[Rest], force: Values) -> tuple[Values, Values]:
    """Return the rate at which the unit creeps in each rest, deg/s, and the variance of what is not known of it."""
    creeps = {
        (r.start, r.stop): creep_of_rest(recording, r.start, r.stop) for r in (*split_rests(recording, 0).used, *rests)
    }
    rates, errors, about_gravity = posterior_creep_rates(list(creeps.values()))
    chosen = [list(creeps).index((rest.start, rest.stop)) for rest in rests]
    rate, error = rates[chosen], errors[chosen]
    upward = (force / np.linalg.norm(force, axis=1, keepdims=True)) ** 2
    across = error**2 + UNCALIBRATED_ERROR**2 * np.sum(rate**2, axis=1)
    nearest = np.eye(3)[np.argmax(upward, axis=1)]  # one error: shared out to three axes it would count as several
    return rate, across[:, None] * (1.0 - upward) + about_gravity**2 * nearest


def _wander_gain(recording: Recording) -> float:
    """Return the power gain of the filter at 0 Hz, from 0 (high-pass) to 1: the share of the wander's variance."""
    covariance = filter_autocovariance(recording)
    return float(np.clip(2.0 * covariance.sum() - covariance[0], 0.0, 1.0))


def _correlated_samples(recording: Recording) -> float:
    """Return ``sum_l r_l^2 / r_0^2`` of the filter's autocovariance r, over all lags l."""
    covariance = filter_autocovariance(recording) ** 2
    return float((2.0 * covariance.sum() - covariance[0]) / covariance[0])


def _rate(
    recording: Recording, motion: Motion | None, earth: Values | None, delay: float, by_angle: EncoderRate | None
) -> Values | None:
    """Return the magnitude of the rate that the gyroscope should measure: (n,) array, deg/s."""
    by_attitude = None if motion is None else np.linalg.norm(truth("gyroscope", motion), axis=1)
    of_table = by_attitude
    if motion is not None and earth is not None and motion.level is not None:
        of_table = np.linalg.norm(motion.angular_rate - np.einsum("i,nij->nj", earth, motion.level), axis=1)
    if by_attitude is not None and recording.table_rate is None:
        return by_attitude if by_angle is None else np.where(by_angle.vague, np.nan, by_attitude)
    logged = recording.table_rate
    if by_angle is not None:
        logged = np.where(by_angle.vague, np.nan, by_angle.rate)
    if logged is None:
        return None
    if delay:
        logged = np.interp(recording.time - delay, recording.time, logged)
    logged = np.abs(logged)
    return logged if by_attitude is None or of_table is None else logged + (by_attitude - of_table)


def _rate_by_angle(recording: Recording) -> EncoderRate | None:
    """Return the rate by the table's angle, where the table logs nothing better and turns about one fixed axis."""
    by_angle = rate_by_angle(recording)
    if by_angle is None or recording.axis is not None:
        return by_angle
    if recording.table_attitude is not None or recording.gyroscope is None:
        return None
    finite = recording.gyroscope[np.isfinite(recording.gyroscope).all(axis=1)]
    if len(finite) < FEWEST:
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
    size, total = np.linalg.norm(truth, axis=1), float(np.trace(S))
    u = truth / np.where(size > 0.0, size, 1.0)[:, None]
    along = np.einsum("ni,ij,nj->n", u, S, u)
    squares, g = along.copy(), np.zeros(len(truth))
    near = (size <= LINEAR_FROM * np.sqrt(total)) & (total > 0.0)
    if near.any():
        squares[near] = _near_zero(truth[near], size[near], S)
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
