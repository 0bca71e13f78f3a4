"""Determine the unit of the angular rates from the rotation of gravity between rests.

In the sensor's axes,

    du/dt = -(s w) x u

with the direction u of the specific force, measured at rest before and after a move; the reading w of the gyroscope,
minus its mean in these rests; and the unknown s, deg/s per unit of the gyroscope. With the right s, the integral from u
before the move gives u after it. With any other possible unit (57.3 times, or another range of the sensor) the error is
tens of degrees.

Rotate readings from the sensor's axes to the body's axes.

    body[m_i] = s_i * reading_i,   axis_map[i] = s_i m_i

where axis i of the reading points along the body axis m_i with the sign s_i. Some chips have a left-handed
accelerometer frame and a right-handed gyroscope frame, so that each sensor may have a separate map.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from imu_logs.units import DEGREES, TRIADS
from pipeline.core.errors import ConfigurationError
from pipeline.core.records import AXES, Values

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from imu_logs.log import Log
    from pipeline.core.settings import Sensor


ROTATION_BLOCK_S = 0.25  # two blocks make the shortest rest, half a second
MIN_VARIANCE_SAMPLES = 5  # samples, for a variance
STILL_VARIANCE_RATIO = 9.0  # times the 10th percentile of the variance
MIN_RELATIVE_VARIANCE = 1e-7  # relative to the square of the specific force
LARGEST_DRIFT_DEG = 2.0  # between any two parts of a rest; more is slow motion
LARGEST_STEP_DEG = 0.5  # from block to block of a rest; a turn at 2 deg/s
BLOCK_NOISE = 5.0  # standard deviations between the means of two blocks; in 10^5 blocks noise exceeds it less than once
ROTATION_BINS = 64  # a half turn rotates by less than 3 deg in each
LONGEST_MOVE_S = 30.0  # a bias of 0.5 deg/s then adds 15 deg, the limit FITS_DEG
SMALLEST_TURN_DEG = 20.0  # above FITS_DEG, so that a prediction without rotation does not fit
MIN_MEDIAN_MOVES = 3  # for a median
MOST_MOVES = 40  # bounds the cost
MAX_ROTATION_SAMPLES = 200_000  # bounds the cost
FITS_DEG, FAILS_DEG = 15.0, 30.0  # the error of any other possible unit is tens of degrees
STRAIGHT = ("+x", "+y", "+z")


@dataclass(frozen=True)
class MoveByHand:
    """A move between two rests."""

    turns: Values  # integral of the angular rate over parts of the move, (64, 3), unit of the gyroscope times s
    before: Values  # direction of the specific force at rest
    after: Values

    @property
    def angle_deg(self) -> float:
        """Angle of gravity's rotation in the sensor's axes, deg."""
        return float(np.degrees(np.arccos(np.clip(self.before @ self.after, -1.0, 1.0))))

    @property
    def way(self) -> float:
        """Total angle of the move by the gyroscope, in its unit times s."""
        return float(np.linalg.norm(self.turns, axis=1).sum())


def interval_of(steps: Values) -> float:
    """Return the usual interval from the steps of time; the mean step forward where most times are written twice."""
    middle = float(np.median(steps))
    return middle if middle > 0 else float(np.mean(np.maximum(steps, 0.0)))


def rests_of(force: Values, interval_s: float) -> list[tuple[int, int]]:
    """Return start and stop of stretches of at least half a second at rest, from (n, 3) forces in any unit."""
    width = max(MIN_VARIANCE_SAMPLES, round(ROTATION_BLOCK_S / interval_s))
    count = len(force) // width
    if count < 4:
        return []
    blocks = force[: count * width].reshape(count, width, 3)
    means = blocks.mean(axis=1)
    scatter = blocks.var(axis=1).sum(axis=1)
    size = float(np.median(np.linalg.norm(means, axis=1)))
    still = scatter < max(STILL_VARIANCE_RATIO * float(np.quantile(scatter, 0.1)), MIN_RELATIVE_VARIANCE * size**2)
    noise = BLOCK_NOISE * float(np.sqrt(2.0 * np.quantile(scatter, 0.1) / width))
    slow = np.linalg.norm(np.diff(means, axis=0), axis=1) <= max(np.radians(LARGEST_STEP_DEG) * size, noise)
    still &= np.append(slow, False) | np.append(False, slow)
    edges = np.flatnonzero(np.diff(still.astype(np.int8), prepend=0, append=0))
    found = [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a >= 2]
    drift = max(np.radians(LARGEST_DRIFT_DEG) * size, noise)
    return [(a * width, b * width) for a, b in found if np.linalg.norm(means[a:b] - means[a], axis=1).max() <= drift]


def moves_of(force: Values, rate: Values, time_s: Values) -> list[MoveByHand]:
    """Return the moves between rests in which gravity rotated by more than 20 degrees; (n, 3) readings in any unit."""
    steps = np.diff(time_s, append=2 * time_s[-1] - time_s[-2])
    rests = rests_of(force, interval_of(steps))
    found: list[MoveByHand] = []
    for (a, b), (c, d) in itertools.pairwise(rests):
        if len(found) == MOST_MOVES or time_s[c] - time_s[b - 1] > LONGEST_MOVE_S:
            continue
        ends = [force[a:b].mean(axis=0), force[c:d].mean(axis=0)]
        before, after = (e / np.linalg.norm(e) for e in ends)
        start = max(a, b - 1)
        bias = (rate[a:b].mean(axis=0) + rate[c:d].mean(axis=0)) / 2
        turned = (rate[start : c + 1] - bias) * steps[start : c + 1, None]
        edges = np.linspace(0, len(turned), ROTATION_BINS + 1).astype(int)
        sums = np.concatenate([np.zeros((1, 3)), np.cumsum(turned, axis=0)])
        move = MoveByHand(np.diff(sums[edges], axis=0), before, after)
        if move.angle_deg > SMALLEST_TURN_DEG:
            found.append(move)
    return found


def misfit_deg(moves: Sequence[MoveByHand], scales: Sequence[float]) -> Values:
    """Return the median over moves of ``misfits_deg``: (len(scales),) array, deg."""
    return np.asarray(np.median(misfits_deg(moves, scales), axis=0))


def misfits_deg(moves: Sequence[MoveByHand], scales: Sequence[float]) -> Values:
    """Return the angle between predicted and measured gravity after each move, for each scale: (moves, scales) array.

    ``scales``: candidates of ``s``, deg/s per unit of the gyroscope.
    """
    factors = np.radians(np.asarray(scales, float))[None, :, None]
    direction = np.repeat(np.stack([m.before for m in moves])[:, None, :], len(scales), axis=1)
    for part in np.stack([m.turns for m in moves], axis=1):
        vector = -part[:, None, :] * factors
        angle = np.linalg.norm(vector, axis=2, keepdims=True)
        axis = vector / np.maximum(angle, 1e-12)
        along = np.sum(axis * direction, axis=2, keepdims=True)
        direction = (
            direction * np.cos(angle) + np.cross(axis, direction) * np.sin(angle) + axis * along * (1 - np.cos(angle))
        )
    after = np.stack([m.after for m in moves])[:, None, :]
    return np.asarray(np.degrees(np.arccos(np.clip(np.sum(direction * after, axis=2), -1.0, 1.0))))


def declared_scale(table: Log) -> tuple[float, str] | None:
    """Return the factor by which the angular rates are wrong, and the evidence; None if they are right or undecided."""
    if not {"accel_x", "gyro_x"} <= table.values.keys():
        return None
    part = slice(0, MAX_ROTATION_SAMPLES)
    force, rate = (np.column_stack([table.values[c][part] for c in TRIADS[s]]) for s in ("accelerometer", "gyroscope"))
    time_s = (table.time_ns[part] - table.time_ns[0]) / 1e9
    moves = moves_of(force, rate, time_s)
    if len(moves) < MIN_MEDIAN_MOVES:
        return None
    scales = (1.0, DEGREES, 1 / DEGREES)
    misfits = misfit_deg(moves, scales)
    best = int(np.argmin(misfits))
    if misfits[0] < FAILS_DEG or misfits[best] > FITS_DEG:
        return None
    return 1 / scales[best], (
        f"in {len(moves)} moves between rests gravity turns by the angle of the rates if they are multiplied by "
        f"{scales[best]:.4g} ({misfits[best]:.1f} deg error, {misfits[0]:.0f} deg as declared)"
    )


def axis_matrix(axis_map: Sequence[str]) -> Values:
    """Return the (3, 3) signed permutation ``B`` of an axis map, ``body = B @ reading``."""
    entries = [str(a) for a in axis_map]
    if [a for a in entries if a[:1] not in "+-" or a[1:] not in AXES] or sorted(a[1:] for a in entries) != list(AXES):
        raise ConfigurationError(
            f"sensor.axis_map is [{', '.join(entries)}]; it names the body axis that the sensor's x, y and z point "
            "along, each once and with its sign, for example [+y, -x, +z]"
        )
    matrix = np.zeros((3, 3))
    for reading, entry in enumerate(entries):
        matrix[AXES.index(entry[1:]), reading] = 1.0 if entry[0] == "+" else -1.0
    return matrix


def axis_maps(sensor: Sensor | None) -> dict[str, tuple[str, ...]]:
    """Return the axis map of each sensor: its own, else that of the sensor model; straight without a model."""
    return {s: STRAIGHT if sensor is None else tuple(sensor.of(s).axis_map or sensor.axis_map) for s in TRIADS}


def maps_of_log(log: Mapping[str, Any]) -> dict[str, tuple[str, ...]]:
    """Return the axis maps in the section ``log`` of a calibration: one per sensor, in older files one for both."""
    stated = log.get("axis_map") or STRAIGHT
    return {s: tuple(stated[s] if isinstance(stated, dict) else stated) for s in TRIADS}


def in_body_axes(axis_map: Sequence[str], readings: Values) -> Values:
    """Rotate (n, 3) readings to the body's axes; return the same array if the map is straight."""
    if tuple(axis_map) == STRAIGHT:
        return readings
    matrix = axis_matrix(axis_map)
    turned: Values = readings[:, np.argmax(np.abs(matrix), axis=1)] * matrix.sum(axis=1)
    return turned


def map_of_orientation(text: str) -> tuple[str, ...]:
    """Return the axis map of an orientation such as YxZ: body axis j is the reading named by letter j."""
    found = {name.lower(): ("+" if name.isupper() else "-") + body for name, body in zip(text, AXES, strict=True)}
    return tuple(found[axis] for axis in AXES)
