"""The moves of a table in a recording, and which of them belong together.

    moving        |r| > 0.02 deg/s, by the table's log
    turn about i  sum_n (w_i[n] - b_i)^2 > 0.8 sum_n |w[n] - b|^2 in a move
    step, turn    a move by less than half a turn, or by more

where

    r    : rate of the table: logged, or that of its angle or attitude
    w, b : angular rate read by the sensor, and its median while the table rests
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.records import rate_of_attitude
from pipeline.signal.rests import RATE_AT_REST_DPS, runs

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from pipeline.records import Recording

ONE_AXIS = 0.8
ENCODER_AGREES_DEG, ENCODER_AGREES = 5.0, 0.1
HALF_A_TURN_DEG = 180.0
HANDLED_DPS, NEAR_A_MOVE_S = 3.0, 0.5


@dataclass(frozen=True)
class Move:
    """One move of the table: its samples, axis (None for several), angle (deg) and largest rate (deg/s)."""

    start: int
    stop: int
    axis: int | None
    angle: float
    rate: float

    @property
    def kind(self) -> str:
        """What it is a part of."""
        if self.axis is None:
            return "free"
        return "turn" if self.angle >= HALF_A_TURN_DEG else "step"


def rate_of_table(recording: Recording) -> NDArray[np.float64] | None:
    """Return the rate of the table, its size where only that is known: (n,) array, deg/s."""
    if recording.table_rate is not None:
        return recording.table_rate
    if recording.table_angle is not None:
        return np.asarray(np.gradient(recording.table_angle, recording.time))
    if recording.table_attitude is None:
        return None
    return rate_of_attitude(recording.time, recording.table_attitude)


def find_moves(recording: Recording, rate: NDArray[np.float64], gyro: NDArray[np.float64]) -> list[Move]:
    """Return the moves of the table, in order of time.

    Parameters
    ----------
    recording : Recording
    rate : (n,) array, deg/s
        Of the table.
    gyro : (n, 3) array, deg/s
        Read by the sensor.
    """
    moving = np.abs(rate) > RATE_AT_REST_DPS
    bias = np.median(gyro[~moving], axis=0) if np.any(~moving) else np.median(gyro, axis=0)
    step = np.gradient(recording.time)
    found = []
    for start, stop in runs(moving):
        energy = np.sum((gyro[start:stop] - bias) ** 2, axis=0)
        axis = int(np.argmax(energy))
        angle = float(np.sum(np.abs(rate[start:stop]) * step[start:stop]))
        alone = energy[axis] > ONE_AXIS * energy.sum() and _encoder_agrees(recording, start, stop, angle)
        found.append(Move(start, stop, axis if alone else None, angle, float(np.abs(rate[start:stop]).max())))
    return found


def _encoder_agrees(recording: Recording, start: int, stop: int, angle: float) -> bool:
    """Return whether the logged angle moves as the rate says: else another gimbal turns than the one that is logged."""
    if recording.table_angle is None:
        return True
    passed = float(np.sum(np.abs(np.diff(recording.table_angle[max(start - 1, 0) : stop + 1]))))
    return abs(passed - angle) < ENCODER_AGREES_DEG + ENCODER_AGREES * angle


def handled_samples(recording: Recording, rate: NDArray[np.float64], gyro: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return the samples at which the sensor turns and the table does not."""
    moving = np.abs(rate) > RATE_AT_REST_DPS
    if moving.all():
        return np.zeros(len(moving), bool)
    width = 2 * int(np.ceil(NEAR_A_MOVE_S / recording.interval)) + 1
    near = np.convolve(moving, np.ones(width), "same") > 0.5
    resting = gyro[~moving]
    off = np.linalg.norm(gyro - np.median(resting, axis=0), axis=1)
    noise = float(np.median(np.linalg.norm(resting - np.median(resting, axis=0), axis=1)))
    return np.asarray((off > max(HANDLED_DPS, 10.0 * noise)) & ~near)


def groups_of(moves: Sequence[Move], handled: NDArray[np.bool_]) -> list[list[Move]]:
    """Return moves of one kind about one axis that follow each other, unless the sensor was mounted anew between."""
    groups: list[list[Move]] = []
    for move in moves:
        last = groups[-1][-1] if groups else None
        same = last is not None and (last.axis, last.kind) == (move.axis, move.kind)
        if same and last is not None and not handled[last.stop : move.start].any():
            groups[-1].append(move)
        else:
            groups.append([move])
    return groups
