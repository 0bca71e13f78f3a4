"""The direction of gravity before and after every move, by the calibrated accelerometer.

    u = u_mean -+ (w x u_mean) T / 2,   or that of the half second next to the move where it differs by more than 4 s

where

    u_mean : direction of the rest's mean, T its length
    w      : rate at which the unit creeps (``pipeline.signal.creep.believed_rates``)
    s      : standard deviation of the mean of the half second by white noise, across u

A unit in a hand or on a soft support creeps after it was set down, not always steadily. The half second next to a move
then shows where the move ended, with more noise than the mean.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.estimation.multi_position.model import motion_of
from pipeline.estimation.multi_position.rests import ROLE, rests_of
from pipeline.estimation.rest_means import rest_means
from pipeline.model.effects import effect
from pipeline.model.measurement import compensate
from pipeline.signal.filters import filter_autocovariance, variance_of_mean
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
    """Gravity at every rest."""

    force: Values  # (m, 3), g; specific force of each rest's mean
    # each (m, 3); unit vectors along it where the move before ends and where the next one begins
    at_start: Values
    at_end: Values
    spread: Values  # (m,), g; standard deviation by the scatter of the accelerometer's rests
    ends: Values  # (m,), g; standard deviation of each end beyond that, by what is not known of the creep
    # (12, 12); errors of the accelerometer's bias and matrix, each of one standard uncertainty and independent, in
    # columns
    root: Values
    shared: Values  # (m, 3, 12), g; what they do to the force
    creeping: NDArray[np.bool_]  # (m,); whether the half second next to a move is off the mean by more than 4 s
    moved: Values  # (12,); by how many of these errors the calibration was moved before all this was computed


def observed_rests(
    recordings: Sequence[Recording],
    accelerometer: SensorCalibration,
    settings: Mapping[str, Any],
    role: str = ROLE,
    moved: Values | None = None,
) -> tuple[Rests, Gravity] | None:
    """Return the gyroscope's rests and gravity at them, or None where the recordings of a role hold none.

    ``moved`` is added to bias and matrix of the accelerometer, (12,): gravity is linear in their errors from there on.
    """
    of_force = rests_of("accelerometer", recordings, settings, accelerometer, role)
    of_rate = rests_of("gyroscope", recordings, settings, accelerometer, role)
    if of_force is None or of_rate is None:
        return None
    keys = [list(zip(r.recording.tolist(), r.span[:, 0].tolist(), strict=True)) for r in (of_force, of_rate)]
    both = set(keys[0]) & set(keys[1])
    of_force, of_rate = (
        r.select(np.array([key in both for key in k])) for r, k in zip((of_force, of_rate), keys, strict=True)
    )
    if len(of_rate.time) == 0:
        return None
    return of_rate, gravity_of(recordings, of_force, accelerometer, moved)


def gravity_of(
    recordings: Sequence[Recording], rests: Rests, accelerometer: SensorCalibration, moved: Values | None = None
) -> Gravity:
    """Return gravity at the rests of the accelerometer; ``moved`` as of ``observed_rests``."""
    root, moved = _root(accelerometer), np.zeros(12) if moved is None else moved
    accelerometer = replace(
        accelerometer, bias=accelerometer.bias + moved[:3], matrix=accelerometer.matrix + moved[3:].reshape(3, 3)
    )
    white = float(np.mean(rests.white**2))
    force = _force(rests.reading, rests, accelerometer)
    u = _unit(force)
    ends, creeping, noise = [], np.zeros(len(u), bool), rests.share.copy()
    for at_start in (True, False):
        reading, share = _near(recordings, rests, at_start=at_start)
        near = _unit(_force(reading, rests, accelerometer))
        half = (0.5 if at_start else -0.5) * rests.length[:, None]
        steady = _unit(u + half * np.cross(np.radians(rests.creep), u))  # du/dt = -w x u
        creeps = np.linalg.norm(near - steady, axis=1) > SIGNIFICANT * np.sqrt(share * white)
        ends.append(np.where(creeps[:, None], near, steady))
        noise = np.where(creeps, np.maximum(noise, share), noise)
        creeping |= np.linalg.norm(near - u, axis=1) > SIGNIFICANT * np.sqrt(share * white)
    between = [float(stage.details.get("scatter_between_rests") or 0.0) for stage in accelerometer.stages]
    spread = np.sqrt(noise * white + max(between, default=0.0) ** 2)
    unsure = np.linalg.norm(force, axis=1) * np.radians(rests.creep_error) * 0.5 * rests.length
    v = rests.reading - accelerometer.bias
    shared = -accelerometer.matrix @ root[:3] + np.einsum("mj,ijp->mip", v, root[3:].reshape(3, 3, -1))
    return Gravity(force, ends[0], ends[1], spread, unsure, root, shared, creeping, np.linalg.pinv(root) @ moved)


def _force(reading: Values, rests: Rests, accelerometer: SensorCalibration) -> Values:
    motion = motion_of(rests.time, reading, np.zeros_like(reading), rests.temperature, still=True)
    known = [e for e in accelerometer.effects if not effect(e.name).moves]
    return compensate(accelerometer, reading, motion, known)


def _unit(force: Values) -> Values:
    unit: Values = force / np.linalg.norm(force, axis=1, keepdims=True)
    return unit


def _near(recordings: Sequence[Recording], rests: Rests, *, at_start: bool) -> tuple[Values, Values]:
    """Return the mean reading next to a move, (m, 3), and its variance over that of a sample, (m,)."""
    reading, share = rests.reading.copy(), rests.share.copy()
    for index in np.unique(rests.recording):
        recording, own = recordings[index], np.flatnonzero(rests.recording == index)
        size = max(FEWEST_NEAR, round(NEAR_S / recording.interval))
        spans = [(a, min(a + size, b)) if at_start else (max(b - size, a), b) for a, b in rests.span[own].tolist()]
        means, counts = rest_means(recording, [Rest(a, b) for a, b in spans])
        known = counts > 0
        reading[own[known]] = means[known]
        share[own[known]] = variance_of_mean(filter_autocovariance(recording), counts[known])
    return reading, share


def _root(accelerometer: SensorCalibration) -> Values:
    """Return the root of the covariance of bias and matrix; zeros where there is none."""
    if accelerometer.covariance is None:
        return np.zeros((12, 12))
    values, vectors = np.linalg.eigh(accelerometer.covariance[:12, :12])
    root: Values = vectors * np.sqrt(np.clip(values, 0.0, None))
    return root
