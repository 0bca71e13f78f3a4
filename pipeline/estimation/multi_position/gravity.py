"""The direction of gravity before and after every move, by the calibrated accelerometer.

    u = u_mean -+ (w x u_mean) T / 2,   or that of the half second next to the move where it is off by more than 4 s

where

    u_mean : direction of the rest's mean, T its length
    w      : rate at which the unit creeps, as far as the rests show one (``pipeline.signal.creep.believed_rates``);
             what is not known of it is an error of each end
    s      : standard deviation that white noise gives the mean of the half second, across u

A unit in a hand, or on a soft support, creeps after it was set down, and not always steadily. Then half a second of the
accelerometer is where the move ended, but is noisier than the mean, so that it is taken only where it differs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.estimation.multi_position.model import motion_of
from pipeline.estimation.multi_position.rests import ROLE, rests_of
from pipeline.estimation.rest_means import rest_means
from pipeline.model.effects import effect
from pipeline.model.measurement import compensate
from pipeline.signal.filter_noise import filter_autocovariance, variance_of_mean
from pipeline.signal.rests import Rest

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from typing import Any

    from numpy.typing import NDArray

    from pipeline.estimation.multi_position.rests import Rests
    from pipeline.records import Recording, SensorCalibration

    Values = NDArray[np.float64]

NEAR_S = 0.5
FEWEST_NEAR = 10  # samples
SIGNIFICANT = 4.0


@dataclass(frozen=True)
class Gravity:
    """Gravity at every rest.

    Attributes
    ----------
    force : (m, 3) array, g
        Specific force of each rest's mean.
    at_start, at_end : (m, 3) array
        Unit vectors along it where the move before ends and where the next one begins.
    spread : (m,) array, g
        Standard deviation by the scatter of the accelerometer's rests.
    ends : (m,) array, g
        Standard deviation of each end beyond that, by what is not known of the creep.
    shared : (m, 3, 12) array, g
        What the errors of the accelerometer's calibration, each of its standard uncertainty, do to the force.
    creeping : (m,) array of bool
        Whether the half second next to a move is off the mean by more than 4 s.
    """

    force: Values
    at_start: Values
    at_end: Values
    spread: Values
    ends: Values
    shared: Values
    creeping: NDArray[np.bool_]


def observed_rests(
    recordings: Sequence[Recording], accelerometer: SensorCalibration, settings: Mapping[str, Any], role: str = ROLE
) -> tuple[Rests, Gravity] | None:
    """Return the gyroscope's rests and gravity at them, or None where the recordings of a role hold none."""
    felt = rests_of("accelerometer", recordings, settings, accelerometer, role)
    turned = rests_of("gyroscope", recordings, settings, accelerometer, role)
    if felt is None or turned is None:
        return None
    keys = [list(zip(r.recording.tolist(), r.span[:, 0].tolist(), strict=True)) for r in (felt, turned)]
    both = set(keys[0]) & set(keys[1])
    felt, turned = (r.select(np.array([key in both for key in k])) for r, k in zip((felt, turned), keys, strict=True))
    if len(turned.time) == 0:
        return None
    return turned, gravity_of(recordings, felt, accelerometer)


def gravity_of(recordings: Sequence[Recording], felt: Rests, accelerometer: SensorCalibration) -> Gravity:
    """Return gravity at the rests of the accelerometer.

    Parameters
    ----------
    recordings : sequence of Recording
    felt : Rests
    accelerometer : SensorCalibration
    """
    white = float(np.mean(felt.white**2))
    force = _force(felt.reading, felt, accelerometer)
    u = _unit(force)
    ends, moved, noise = [], np.zeros(len(u), bool), felt.share.copy()
    for at_start in (True, False):
        reading, share = _near(recordings, felt, at_start=at_start)
        near = _unit(_force(reading, felt, accelerometer))
        half = (0.5 if at_start else -0.5) * felt.length[:, None]
        steady = _unit(u + half * np.cross(np.radians(felt.creep), u))  # du/dt = -w x u
        creeps = np.linalg.norm(near - steady, axis=1) > SIGNIFICANT * np.sqrt(share * white)
        ends.append(np.where(creeps[:, None], near, steady))
        noise = np.where(creeps, np.maximum(noise, share), noise)
        moved |= np.linalg.norm(near - u, axis=1) > SIGNIFICANT * np.sqrt(share * white)
    between = [float(stage.details.get("scatter_between_rests") or 0.0) for stage in accelerometer.stages]
    spread = np.sqrt(noise * white + max(between, default=0.0) ** 2)
    unsure = np.linalg.norm(force, axis=1) * np.radians(felt.creep_error) * 0.5 * felt.length
    return Gravity(force, ends[0], ends[1], spread, unsure, _of_calibration(accelerometer, felt.reading), moved)


def _force(reading: Values, felt: Rests, accelerometer: SensorCalibration) -> Values:
    motion = motion_of(felt.time, reading, np.zeros_like(reading), felt.temperature, still=True)
    known = [e for e in accelerometer.effects if not effect(e.name).moves]
    return compensate(accelerometer, reading, motion, known)


def _unit(force: Values) -> Values:
    unit: Values = force / np.linalg.norm(force, axis=1, keepdims=True)
    return unit


def _near(recordings: Sequence[Recording], felt: Rests, *, at_start: bool) -> tuple[Values, Values]:
    """Return the mean reading next to a move, (m, 3), and its variance over that of a sample, (m,)."""
    reading, share = felt.reading.copy(), felt.share.copy()
    for index in np.unique(felt.recording):
        recording, own = recordings[index], np.flatnonzero(felt.recording == index)
        size = max(FEWEST_NEAR, round(NEAR_S / recording.interval))
        spans = [(a, min(a + size, b)) if at_start else (max(b - size, a), b) for a, b in felt.span[own].tolist()]
        means, counts = rest_means(recording, [Rest(a, b) for a, b in spans])
        known = counts > 0
        reading[own[known]] = means[known]
        share[own[known]] = variance_of_mean(filter_autocovariance(recording), counts[known])
    return reading, share


def _of_calibration(accelerometer: SensorCalibration, reading: Values) -> Values:
    """Return what errors of one standard uncertainty, independent of each other, do to the force: (m, 3, 12) array."""
    if accelerometer.covariance is None:
        return np.zeros((len(reading), 3, 12))
    values, vectors = np.linalg.eigh(accelerometer.covariance[:12, :12])
    root = vectors * np.sqrt(np.clip(values, 0.0, None))
    v = reading - accelerometer.bias
    change: Values = -accelerometer.matrix @ root[:3] + np.einsum("mj,ijp->mip", v, root[3:].reshape(3, 3, -1))
    return change
