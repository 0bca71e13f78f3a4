"""Mounting of the unit in one turn: as stated in the configuration, and as found in the recording.

    A' = s (A - zero) + face

where

A    : angle that the table logs
s    : +1 where it counts right-handed about the body axis that the procedure names, else -1
zero : what the table logs while the upward face points up
face : 0, 90, 180 or 270 deg, the angle at which that face points up by the convention of ``pipeline``
A'   : angle by the convention, with which everything after ingest works

The mounting is found before any calibration. In a turn about a level axis the accelerometer reads

    f(A) = c + p cos A + q sin A,    p = K u,   q = K (u x a),   c = b + K (component of gravity along a) + d(r)

where

d : what goes with the rate r: lever arms (r^2), vibration (|r|), dependence on the rate (r), in a turn between rests;
    subtracted by least squares with 1, r, |r| and r^2
A : table angle, counted right-handed about body axis a
u : body axis that points up at A = 0
K : inverse of the calibration matrix, the unit matrix to a few percent; b: bias

so ``q x p`` points along the turn axis, and p and q give the upward face and the zero. An angle that counts the other
way turns the sign of q. The gyroscope's gain against the table's rate r in the same rows,

    k = sum((w - mean w) (r - mean r)) / sum((r - mean r)^2)

points along the turn axis as well. Means are subtracted because a bias of some deg/s may exceed a slow table's rate;
where the rate does not change, they stay, and only a rate beyond any bias tells something.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pipeline.model.kinematics import UP_AT_ZERO
from pipeline.records import AXES
from pipeline.signal.rests import still_samples

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pipeline.records import Mask, Recording, Values

FEWEST = 10  # samples, five times the unknowns of an angle
ACROSS = np.cross(UP_AT_ZERO, np.eye(3))  # u x a: what points up at 90 deg
# Smallest eigenvalue of the mean square of (cos A, sin A) beside a constant: reached by an arc of 110 deg. Below, a
# nonlinearity of 0.5 % (MPU-6050 product specification 3.4) would turn p by more than 3 deg.
LEAST_COVERAGE = 0.017
SMALLEST_SHARE = 1e-6  # of the largest eigenvalue, below which a function of the rate is one of the others
LARGEST_UNCERTAINTY = 0.02  # g, of p and q: 1 deg
CHANGING = 0.1  # standard deviation over largest rate, from which a rate changes enough to be followed
SLOWEST_DPS = 0.1  # standard deviation of a rate that can be followed
LARGEST_BIAS_DPS = 20.0  # zero-rate output of consumer MEMS (MPU-6050 product specification)
ALIKE = 0.9  # correlation of a gyroscope axis with the rate from which its gain is evidence


@dataclass(frozen=True)
class Bench:
    """How a recording's bench holds the unit, and how its table counts the angle."""

    axis: str  # body axis turned about
    up: str  # body axis, with its sign, that points up where the table logs ``zero_deg``
    sense: int = 1
    zero_deg: float = 0.0

    @property
    def vertical(self) -> bool:
        """Whether the turn axis points up or down, so that gravity stays as it is in the body."""
        return self.up[1] == self.axis

    @property
    def conventional(self) -> bool:
        """Whether the logged angle is the convention's."""
        return self.sense == 1 and self.zero_deg == 0.0 and self.up == usual_up(self.axis)

    @property
    def offset(self) -> float:
        """What is added to ``sense * A`` for the convention's angle, deg."""
        a, up = AXES.index(self.axis), signed_axis(self.up)
        face = 0.0 if self.vertical else float(np.degrees(np.arctan2(up @ ACROSS[a], up @ UP_AT_ZERO[a])))
        return face - self.sense * self.zero_deg


def stated_bench(entry: Mapping[str, Any], table: Mapping[str, Any], axis: str) -> Bench:
    """Return what a recording's entry in the procedure says of its bench; sense and zero are the table's else."""
    own = {k: table.get(k) if entry.get(k) is None else entry[k] for k in ("sense", "zero_deg")}
    return Bench(axis, entry.get("up") or usual_up(axis), int(own["sense"] or 1), float(own["zero_deg"] or 0.0))


def found_bench(fit: TurnFit, axis: str) -> Bench | None:
    """Return what gravity says of a turn about a known, level axis; None where it says nothing.

    The sense is that of q x p along the axis, the zero what turns p and q onto the nearest face with least squares.
    """
    if fit.gravity is None or fit.turn_axis is None:
        return None
    a = AXES.index(axis)
    sense = 1 if fit.turn_axis[a] > 0.0 else -1
    return bench_of(axis, sense, angle_ahead(a, fit.gravity.cosine, sense * fit.gravity.sine))


def angle_ahead(axis: int, p: Values, q: Values) -> float:
    """Return the angle of the rotation that turns u and u x a onto p and q with least squares, deg."""
    up, across = UP_AT_ZERO[axis], ACROSS[axis]
    return float(np.degrees(np.arctan2(p @ across - q @ up, p @ up + q @ across)))


def bench_of(axis: str, sense: int, at_zero: float) -> Bench:
    """Return the bench with the nearest face and the smallest zero; ``at_zero``: the convention's angle at angle 0."""
    a, face = AXES.index(axis), 90.0 * round(at_zero / 90.0)
    up = nearest_axis(np.cos(np.radians(face)) * UP_AT_ZERO[a] + np.sin(np.radians(face)) * ACROSS[a])
    return Bench(axis, up, sense, sense * (face - at_zero))


def off_at_rest(recording: Recording, bench: Bench) -> float | None:
    """Return by how much gravity is ahead of the stated bench while the table rests, deg; None where it never does.

    A bias of 0.1 g makes it 6 deg where all rests are at one angle.
    """
    angle, force = recording.table_angle, recording.accelerometer
    if angle is None or force is None:
        return None
    still = still_samples(recording.time, np.gradient(angle, recording.time)) & recording.valid
    if np.sum(still) < FEWEST:
        return None
    A = np.radians(bench.sense * angle[still] + bench.offset)
    return angle_ahead(AXES.index(bench.axis), np.cos(A) @ force[still], np.sin(A) @ force[still])


def by_convention(fit: TurnFit, bench: Bench) -> Gravity | None:
    """Return c, p and q of a turn against the convention's angle; None where gravity does not tell."""
    if fit.gravity is None or bench.vertical or fit.vertical is not None:
        return None
    c, s = np.cos(np.radians(bench.offset)), np.sin(np.radians(bench.offset))
    constant, cosine, sine = fit.gravity
    return Gravity(constant, c * cosine - bench.sense * s * sine, s * cosine + bench.sense * c * sine)


def usual_up(axis: str) -> str:
    """Return the body axis that points up at angle 0 by the convention."""
    return nearest_axis(UP_AT_ZERO[AXES.index(axis)])


def signed_axis(name: str) -> Values:
    """Return the unit vector of ``+x``, ``-z`` ..: (3,) array."""
    vector = np.zeros(3)
    vector[AXES.index(name[1])] = 1.0 if name[0] == "+" else -1.0
    return vector


def nearest_axis(direction: Values) -> str:
    """Return the signed axis that a direction is nearest to."""
    largest = int(np.argmax(np.abs(direction)))
    return f"{'+' if direction[largest] > 0.0 else '-'}{AXES[largest]}"


def off_axis_deg(direction: Values) -> float:
    """Return the angle between a direction and the signed axis that it is nearest to, deg."""
    return float(np.degrees(np.arccos(np.clip(np.max(np.abs(direction)) / np.linalg.norm(direction), -1.0, 1.0))))


class Gravity(NamedTuple):
    """c, p and q above: (3,) arrays, g."""

    constant: Values
    cosine: Values
    sine: Values


@dataclass(frozen=True)
class TurnFit:
    """Evidence of one recording."""

    gravity: Gravity | None  # None where the angle does not cover enough
    gain: Values | None  # (3,), k above; None where the rate does not tell
    mean_rate: float  # deg/s, of the angle over the samples; with a time offset it is a part of the zero
    arc: float  # deg
    unknown: str = ""  # why gravity tells nothing

    @cached_property
    def turn_axis(self) -> Values | None:
        """Unit vector about which the unit turns as the angle grows, by gravity: (3,) array, or None."""
        if self.gravity is None or self.vertical is not None:
            return None
        return unit(np.cross(self.gravity.sine, self.gravity.cosine))

    @cached_property
    def vertical(self) -> Values | None:
        """Direction of gravity's reaction where the turn leaves it as it is (a vertical axis): (3,) array, or None."""
        if self.gravity is None:
            return None
        staying, cosine, sine = self.gravity
        turning = float(np.hypot(np.linalg.norm(cosine), np.linalg.norm(sine)))
        return unit(staying) if turning < 0.25 * float(np.linalg.norm(staying)) else None


def fit_turn(recording: Recording) -> TurnFit:
    """Return what the rows of a turn recording, with the table's angle, its rate, or both, tell of its mounting."""
    angle, rate = recording.table_angle, recording.table_rate
    slope = None if angle is None or recording.samples < 2 else np.gradient(angle, recording.time)
    used = slope if rate is None else rate
    gain = _gain(recording, used)
    if gain is not None and rate is not None and slope is not None and float(rate @ slope) < 0.0:
        gain = -gain  # the rate counts against the angle: compared with gravity here, and refused as a reference
    if angle is None or recording.accelerometer is None:
        missing = "angle of the table" if angle is None else "accelerometer"
        return TurnFit(None, gain, 0.0, 0.0, f"the log holds no {missing}")
    keep = recording.valid
    A, reading = np.radians(angle[keep]), recording.accelerometer[keep]
    arc = float(np.ptp(angle)) if len(angle) else 0.0
    mean_rate = 0.0 if slope is None else float(np.mean(slope))
    other = _of_rate(used, keep)
    # Normal equations of both, those of the rate eliminated.
    columns = np.column_stack([other, np.cos(A), np.sin(A), reading])
    products, m = columns.T @ columns, other.shape[1]
    inverse = np.linalg.pinv(products[:m, :m], rcond=SMALLEST_SHARE, hermitian=True)
    left = products[m:, m:] - products[m:, :m] @ inverse @ products[:m, m:]
    normal = left[:2, :2]
    if len(A) < FEWEST or np.linalg.eigvalsh(normal / len(A))[0] < LEAST_COVERAGE:
        return TurnFit(None, gain, mean_rate, arc, f"the table angle covers {arc:.3g} deg only")
    found = np.linalg.solve(normal, left[:2, 2:])
    residual = np.diag(left[2:, 2:] - left[2:, :2] @ found) / len(A)
    scatter = float(np.sqrt(np.max(residual.clip(0.0)) * np.max(np.diag(np.linalg.inv(normal)))))
    if scatter > LARGEST_UNCERTAINTY:
        return TurnFit(None, gain, mean_rate, arc, "the accelerometer does not follow the table angle")
    constant = np.mean(reading, axis=0) - np.mean(columns[:, m : m + 2], axis=0) @ found
    return TurnFit(Gravity(constant, found[0], found[1]), gain, mean_rate, arc)


def _of_rate(rate: Values | None, keep: Mask) -> Values:
    """Return 1, r, |r| and r^2, with the largest |r| as unit: (n, at most 4) array."""
    r = np.zeros(int(keep.sum())) if rate is None else rate[keep] / (np.max(np.abs(rate), initial=0.0) or 1.0)
    return np.column_stack([np.ones_like(r), r, np.abs(r), r * r][: 4 if np.any(r) else 1])


def _gain(recording: Recording, rate: Values | None) -> Values | None:
    """Return k above where a gyroscope axis follows the rate."""
    if recording.gyroscope is None or rate is None:
        return None
    keep = recording.valid
    rate, gyro = rate[keep], recording.gyroscope[keep]
    changing = float(np.std(rate)) > CHANGING * float(np.max(np.abs(rate), initial=0.0))
    if changing:
        rate, gyro = rate - np.mean(rate), gyro - np.mean(gyro, axis=0)
    power = float(rate @ rate)
    if power <= len(rate) * (SLOWEST_DPS if changing else LARGEST_BIAS_DPS) ** 2:
        return None
    gain = rate @ gyro / power
    other = int(np.argmax(np.abs(gain)))
    alike = abs(gain[other]) * np.sqrt(power / max(float(gyro[:, other] @ gyro[:, other]), 1e-30))
    return np.asarray(gain) if alike >= ALIKE else None


def unit(vector: Values) -> Values:
    """Return a vector of length 1."""
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-30))
