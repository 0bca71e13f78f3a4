"""Find the mounting of the unit in one turn, and whether both sensors are read in one right-handed frame.

The logged table angle A becomes the angle of the convention of ``pipeline``:

    A' = s (A - zero) + face

where

s    : +1 if A counts right-handed about the body axis that the procedure names, else -1
zero : logged angle at which the upward face points up
face : 0, 90, 180 or 270 deg, the angle of the convention at which that face points up

Gravity determines them before any calibration. In a turn about a level axis the accelerometer reads

    f(A) = c + p cos A + q sin A + d(r),    p = K u,   q = K (u x a),   c = b + K (component of gravity along a)

where A counts right-handed about the body axis a, u points up at A = 0, K is the inverse of the calibration matrix (the
unit matrix to a few percent) and b the bias. In a turn between rests, d combines r (rate dependence), |r| (vibration)
and r^2 (lever arms) of the rate r.

``q x p`` points along the turn axis, and p and q determine face and zero. If the angle counts left-handed, q changes
its sign. The gain of the gyroscope against the table's rate points along the turn axis, too:

    k = sum((w - mean w) (r - mean r)) / sum((r - mean r)^2)

The means are subtracted because a bias of some deg/s may exceed the rate of a slow table. At constant rate they are not
subtracted, and only a rate above any bias is evidence.

If the sensors read ``M_a f`` and ``M_g w`` (signed permutations of the true vectors), gravity turns about
``n = det(M_a) M_a t`` in a turn about t, and the gyroscope's gain is ``k = M_g t``. So all turns have

    n = D k,   D = det(M_a) M_a M_g^T,   det D = det M_g

and D is the unit matrix where both sensors are read in one right-handed frame. On a table, the stated faces and turn
axes give M_a:

    M_a = signed permutation nearest to sum (p u^T + q (u x a)^T)

By hand, the gyroscope's rates rotate gravity from rest to rest with the right D: ``du/dt = -(D w) x u``. There, a
mirrored accelerometer cannot be detected, because the opposite of gravity rotates alike.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np

from pipeline.core.errors import IngestError
from pipeline.core.records import AXES, Recording, Values, axis_matrix, cross
from pipeline.core.settings import RecordingFile, Table
from pipeline.ingest.quality_flags import (
    FAILS_DEG,
    MAX_ROTATION_SAMPLES,
    MIN_MEDIAN_MOVES,
    MoveByHand,
    misfits_deg,
    moves_of,
)
from pipeline.physics.kinematics import UP_AT_ZERO
from pipeline.physics.signal.rests import still_samples

MIN_ANGLE_SAMPLES = 10  # samples, five times the unknowns of an angle
UP_AT_QUARTER_TURN = np.cross(UP_AT_ZERO, np.eye(3))  # u x a: what points up at 90 deg
# Smallest eigenvalue of the covariance of (cos A, sin A): that of an arc of 110 deg. For a shorter arc, a nonlinearity
# of 0.5 % (MPU-6050 product specification 3.4) would turn p by more than 3 deg.
LEAST_COVERAGE = 0.017
SMALLEST_SHARE = 1e-6  # of the largest eigenvalue, below which a function of the rate is one of the others
MAX_DIRECTION_UNCERTAINTY_G = 0.02  # g, of p and q: 1 deg
CHANGING = 0.1  # standard deviation over largest rate, from which a rate changes enough to be followed
MIN_FOLLOWED_RATE_DPS = 0.1  # standard deviation of a rate that can be followed
LARGEST_BIAS_DPS = 20.0  # zero-rate output of consumer MEMS (MPU-6050 product specification)
MIN_GAIN_CORRELATION = 0.9  # correlation of a gyroscope axis with the rate from which its gain is evidence
# From the nearest axis: beyond cross-axis sensitivity and seats, below the 45 deg between two axes.
CLEAR_DEG = 30.0
FEWEST_MISSED, CLEARLY_FEWER = 2, 4  # moves that gravity does not follow: one may be a knock


@dataclass(frozen=True)
class TurnMounting:
    """Mounting of the unit in one turn, and how the table counts the angle."""

    axis: str  # body axis turned about
    up: str  # body axis, with its sign, that points up where the table logs ``zero_deg``
    sense: int = 1
    zero_deg: float = 0.0

    @property
    def vertical(self) -> bool:
        """Whether the turn axis is vertical: gravity is then constant in the body."""
        return self.up[1] == self.axis

    @property
    def conventional(self) -> bool:
        """Whether the logged angle is that of the convention."""
        return self.sense == 1 and self.zero_deg == 0.0 and self.up == usual_up(self.axis)

    @cached_property
    def offset(self) -> float:
        """Convention's angle minus ``sense * A``, deg."""
        a, up = AXES.index(self.axis), signed_axis(self.up)
        face = 0.0 if self.vertical else float(np.degrees(np.arctan2(up @ UP_AT_QUARTER_TURN[a], up @ UP_AT_ZERO[a])))
        return face - self.sense * self.zero_deg


def stated_bench(entry: RecordingFile | None, table: Table, axis: str) -> TurnMounting:
    """Return the mounting that a recording's entry in the procedure states; the table states sense and zero else."""
    sense = table.sense if entry is None or entry.sense is None else entry.sense
    zero_deg = table.zero_deg if entry is None or entry.zero_deg is None else entry.zero_deg
    return TurnMounting(axis, (entry and entry.up) or usual_up(axis), sense, zero_deg)


def found_bench(fit: TurnFit, axis: str) -> TurnMounting | None:
    """Return the mounting by gravity in a turn about a known level axis; None where gravity does not determine it."""
    if fit.gravity is None or fit.turn_axis is None:
        return None
    a = AXES.index(axis)
    sense = 1 if fit.turn_axis[a] > 0.0 else -1
    return bench_of(axis, sense, angle_ahead(a, fit.gravity.cosine, sense * fit.gravity.sine))


def angle_ahead(axis: int, p: Values, q: Values) -> float:
    """Return the angle of the rotation that turns u and u x a onto p and q with least squares, deg."""
    up, across = UP_AT_ZERO[axis], UP_AT_QUARTER_TURN[axis]
    return float(np.degrees(np.arctan2(p @ across - q @ up, p @ up + q @ across)))


def bench_of(axis: str, sense: int, at_zero: float) -> TurnMounting:
    """Return the mounting with the smallest zero; ``at_zero``: the convention's angle at logged angle 0, deg."""
    a, face = AXES.index(axis), 90.0 * round(at_zero / 90.0)
    up = nearest_axis(np.cos(np.radians(face)) * UP_AT_ZERO[a] + np.sin(np.radians(face)) * UP_AT_QUARTER_TURN[a])
    return TurnMounting(axis, up, sense, sense * (face - at_zero))


def off_at_rest(recording: Recording, bench: TurnMounting) -> float:
    """Return by how much gravity at rest is ahead of the stated mounting, deg; 0 where the table never rests.

    Where all rests are at one angle, a bias of 0.1 g changes it by 6 deg.
    """
    angle, force = recording.table_angle, recording.accelerometer
    if angle is None or force is None:
        return 0.0
    still = still_samples(recording.time, np.gradient(angle, recording.time)) & recording.valid
    if np.sum(still) < MIN_ANGLE_SAMPLES:
        return 0.0
    A = np.radians(bench.sense * angle[still] + bench.offset)
    return angle_ahead(AXES.index(bench.axis), np.cos(A) @ force[still], np.sin(A) @ force[still])


def by_convention(fit: TurnFit, bench: TurnMounting) -> FittedGravity | None:
    """Return c, p and q against the convention's angle; None where gravity does not turn or was not fitted."""
    if fit.gravity is None or bench.vertical or fit.vertical is not None:
        return None
    c, s = np.cos(np.radians(bench.offset)), np.sin(np.radians(bench.offset))
    constant, cosine, sine = fit.gravity
    return FittedGravity(constant, c * cosine - bench.sense * s * sine, s * cosine + bench.sense * c * sine)


def usual_up(axis: str) -> str:
    """Return the body axis that points up at angle 0 by the convention."""
    return nearest_axis(UP_AT_ZERO[AXES.index(axis)])


def signed_axis(name: str) -> Values:
    """Return the unit vector of ``+x``, ``-z`` ..: (3,) array."""
    return np.asarray(np.eye(3)[AXES.index(name[1])] * (1.0 if name[0] == "+" else -1.0))


def nearest_axis(direction: Values) -> str:
    """Return the signed axis nearest to a direction."""
    largest = int(np.argmax(np.abs(direction)))
    return f"{'+' if direction[largest] > 0.0 else '-'}{AXES[largest]}"


def off_axis_deg(direction: Values) -> float:
    """Return the angle between a direction and the nearest signed axis, deg."""
    return float(np.degrees(np.arccos(min(float(np.max(np.abs(direction)) / np.linalg.norm(direction)), 1.0))))


def unit(vector: Values) -> Values:
    """Return a vector of length 1."""
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-30))


class FittedGravity(NamedTuple):
    """The fitted c, p and q: (3,) arrays, g."""

    constant: Values
    cosine: Values
    sine: Values


@dataclass(frozen=True)
class TurnFit:
    """What gravity and gyroscope show of the mounting in one turn."""

    gravity: FittedGravity | None  # None where the angle covers too little
    gain: Values | None  # k, (3,) array; None where no axis follows the rate
    mean_rate: float = 0.0  # deg/s, of the angle over the samples; times a time offset it adds to the zero
    arc: float = 0.0  # deg
    unknown: str = ""  # why gravity determines nothing

    @cached_property
    def turn_axis(self) -> Values | None:
        """Unit vector about which the unit turns as the angle grows, by gravity: (3,) array, or None."""
        if self.gravity is None or self.vertical is not None:
            return None
        return unit(cross(self.gravity.sine, self.gravity.cosine))

    @cached_property
    def vertical(self) -> Values | None:
        """Direction of the specific force in a turn about a vertical axis, which does not change it: (3,), or None."""
        if self.gravity is None:
            return None
        constant, cosine, sine = self.gravity
        turning = float(np.hypot(np.linalg.norm(cosine), np.linalg.norm(sine)))
        return unit(constant) if turning < 0.25 * float(np.linalg.norm(constant)) else None


def fit_turn(recording: Recording) -> TurnFit:
    """Return c, p, q and k of a turn whose log has the table's angle, its rate, or both."""
    angle, rate = recording.table_angle, recording.table_rate
    used = recording.logged_rate
    gain = _gain(recording, used)
    if gain is not None and rate is not None and angle is not None and float(rate[1:] @ np.diff(angle)) < 0.0:
        gain = -gain  # the rate counts against the angle: here the angle counts; the check of the reference refuses it
    if angle is None or recording.accelerometer is None:
        missing = "angle of the table" if angle is None else "accelerometer"
        return TurnFit(None, gain, unknown=f"the log holds no {missing}")
    keep = recording.valid
    A = np.radians(angle[keep])
    arc = float(np.ptp(angle)) if len(angle) else 0.0
    mean_rate = float((angle[-1] - angle[0]) / np.ptp(recording.time)) if recording.samples > 1 else 0.0
    terms = [np.ones_like(A)]
    if used is not None and np.any(used[keep]):
        r = used[keep] / np.max(np.abs(used))
        terms += [r, np.abs(r), r * r]
    # Normal equations of all terms; the constant and the terms of the rate are eliminated.
    rows, m = np.stack([*terms, np.cos(A), np.sin(A), *recording.accelerometer.compress(keep, axis=0).T]), len(terms)
    products = rows @ rows.T
    powers, vectors = np.linalg.eigh(products[:m, :m])
    vectors = vectors[:, powers > SMALLEST_SHARE * powers[-1]]
    inverse = vectors / powers[m - vectors.shape[1] :] @ vectors.T
    reduced = products[m:, m:] - products[m:, :m] @ inverse @ products[:m, m:]
    normal = reduced[:2, :2]
    if len(A) < MIN_ANGLE_SAMPLES or np.linalg.eigvalsh(normal / len(A))[0] < LEAST_COVERAGE:
        return TurnFit(None, gain, mean_rate, arc, f"the table angle covers {arc:.3g} deg only")
    inverse = np.linalg.inv(normal)
    p_and_q = inverse @ reduced[:2, 2:]
    variance = np.diag(reduced[2:, 2:] - reduced[2:, :2] @ p_and_q) / len(A)
    scatter = float(np.sqrt(np.max(variance.clip(0.0)) * np.max(np.diag(inverse))))
    if scatter > MAX_DIRECTION_UNCERTAINTY_G:
        return TurnFit(None, gain, mean_rate, arc, "the accelerometer does not follow the table angle")
    means = products[0, m:] / len(A)
    constant = means[2:] - means[:2] @ p_and_q
    return TurnFit(FittedGravity(constant, *p_and_q), gain, mean_rate, arc)


def _gain(recording: Recording, rate: Values | None) -> Values | None:
    """Return k where a gyroscope axis follows the rate."""
    if recording.gyroscope is None or rate is None:
        return None
    keep = recording.valid
    rate, gyro = rate[keep], recording.gyroscope.compress(keep, axis=0)
    largest, n = float(np.max(np.abs(rate), initial=0.0)), max(len(rate), 1)
    change = rate - np.sum(rate) / n
    changing = float(np.sqrt(change @ change / n)) > CHANGING * largest
    if changing:
        rate, gyro = change, gyro - np.sum(gyro, axis=0) / n
    power = float(rate @ rate)
    if power <= len(rate) * (MIN_FOLLOWED_RATE_DPS if changing else LARGEST_BIAS_DPS) ** 2:
        return None
    gain = rate @ gyro / power
    axis = int(np.argmax(np.abs(gain)))
    alike = abs(gain[axis]) * np.sqrt(power / max(float(gyro[:, axis] @ gyro[:, axis]), 1e-30))
    return np.asarray(gain) if alike >= MIN_GAIN_CORRELATION else None


def check_frames(
    turns: Sequence[tuple[Recording, TurnFit]], accelerometer: Values | None, maps: Mapping[str, Sequence[str]]
) -> None:
    """Refuse turns in which gravity and the gyroscope turn about different axes; ``accelerometer`` is M_a."""
    axes: list[tuple[Recording, str, str]] = []  # n and k
    for recording, fit in turns:
        n, k = fit.turn_axis, fit.gain
        if n is not None and k is not None and max(off_axis_deg(n), off_axis_deg(k)) < CLEAR_DEG:
            axes.append((recording, nearest_axis(n), nearest_axis(k)))
    wrong = [entry for entry in axes if entry[1] != entry[2]]
    if not wrong:
        return
    recording, gravity, gyro = wrong[0]
    names = ", ".join(r.name for r, _, _ in wrong)
    agreeing = ", ".join(r.name for r, n, k in axes if n == k)
    # Pairs k = +x, n; D where the unit was turned about all three axes, and no two recordings disagree.
    pairs = {(k[1], n if k[0] == "+" else n.translate(str.maketrans("+-", "-+"))) for _, n, k in axes}
    columns = [signed_axis(n) for _, n in sorted(pairs)]
    D = np.column_stack(columns) if [k for k, _ in sorted(pairs)] == list(AXES) else np.zeros((3, 3))
    raise IngestError(
        f"accelerometer and gyroscope contradict each other in {names}"
        + (f" (not in {agreeing})" if agreeing else "")
        + f": in {recording.name} gravity turns as in a turn about body {gravity}, and the gyroscope reads a turn "
        f"about {gyro}; both belong in one right-handed frame",
        recording.source.get("file"),
        code="mirrored_axes",
        hint=_cure(D if abs(np.linalg.det(D)) > 0.5 else None, accelerometer, maps),
    )


def check_frames_by_hand(recording: Recording, maps: Mapping[str, Sequence[str]]) -> None:
    """Refuse rests and moves by hand in which the gyroscope's rates rotate gravity only with other axes."""
    if recording.accelerometer is None or recording.gyroscope is None:
        return
    part = slice(0, MAX_ROTATION_SAMPLES)
    moves = moves_of(recording.accelerometer[part], recording.gyroscope[part], recording.time[part])
    contradiction = other_axes(moves)
    if contradiction is None:
        return
    text, D = contradiction
    message = f"accelerometer and gyroscope contradict each other: {text}; both belong in one right-handed frame"
    file = recording.source.get("file")
    raise IngestError(message, file, code="mirrored_axes", hint=_cure(D, None, maps))


def other_axes(moves: Sequence[MoveByHand]) -> tuple[str, Values | None] | None:
    """Return the evidence that only other axes rotate gravity rightly, and D if one alone does; None without it."""

    def missed(D: Values) -> int:
        return int(np.sum(misfits_deg([replace(m, turns=m.turns @ D.T) for m in moves], [1.0]) > FAILS_DEG))

    as_read = missed(np.eye(3)) if len(moves) >= MIN_MEDIAN_MOVES else 0
    if as_read < FEWEST_MISSED:
        return None
    permutations = signed_permutations()
    counts = [missed(D) for D in permutations]
    fewest = min(counts)
    if fewest > as_read / CLEARLY_FEWER:
        return None
    text = f"in {as_read} of {len(moves)} moves between rests the angular rates miss gravity's rotation by more than"
    text += f" {FAILS_DEG:g} deg, with other axes of the gyroscope in {fewest or 'none'}"
    return text, permutations[counts.index(fewest)] if counts.count(fewest) == 1 else None


@cache
def signed_permutations() -> list[Values]:
    """Return the 48 maps of axes onto signed axes: (3, 3) arrays."""
    orders = itertools.product(itertools.permutations(AXES), itertools.product("+-", repeat=3))
    return [axis_matrix([s + a for s, a in zip(signs, order, strict=True)]) for order, signs in orders]


def nearest_permutation(total: Values) -> Values | None:
    """Return the signed permutation near to a matrix of the order of 1, or None."""
    scale = np.linalg.norm(total, axis=0)
    if np.min(scale) < 0.25:
        return None
    return next((found for found in signed_permutations() if np.max(np.abs(total / scale - found)) <= 0.5), None)


def as_map(matrix: Values) -> str:
    """Return a signed permutation in the form of the setting ``axis_map``."""
    return f"[{','.join(nearest_axis(column) for column in np.asarray(matrix).T)}]"


def _cure(D: Values | None, accelerometer: Values | None, maps: Mapping[str, Sequence[str]]) -> str:
    """Return which sensor is mirrored or turned, as far as it is known, and the setting that corrects it."""
    if D is None:
        return "set sensor.accelerometer.axis_map or sensor.gyroscope.axis_map after the data sheet (docs/mounting.md)"
    now = {sensor: axis_matrix(entries) for sensor, entries in maps.items()}
    mirrored = np.linalg.det(D) < 0.0
    right = {"accelerometer": now["accelerometer"], "gyroscope": D @ now["gyroscope"]}
    if accelerometer is None:
        ways = [("gyroscope", right["gyroscope"])]
        # the rotation of gravity is the same for either sign of the accelerometer
        ways += [] if mirrored else [("accelerometer", sign * D.T @ now["accelerometer"]) for sign in (-1.0, 1.0)]
        ways.sort(key=lambda way: int(np.sum(np.any(way[1] != now[way[0]], axis=0))))
        settings = [f"sensor.{sensor}.axis_map={as_map(matrix)}" for sensor, matrix in ways]
        which = "the gyroscope is mirrored" if mirrored else "one sensor is read in other axes"
        return (
            f"{which}: gravity agrees with {' or '.join(settings)}; the data sheet shows which is right, and an axis "
            "of the accelerometer that points up at rest reads +1 g"
        )
    if np.linalg.det(accelerometer) > 0.0:
        which = "the gyroscope is mirrored" if mirrored else "the gyroscope is read in other axes"
    elif mirrored:
        which = "both sensors are mirrored"
        right = {s: M.T @ now[s] for s, M in (("accelerometer", accelerometer), ("gyroscope", -D.T @ accelerometer))}
    else:
        which = "the accelerometer is mirrored"
        right = {"accelerometer": -D.T @ now["accelerometer"], "gyroscope": now["gyroscope"]}
    changed = {s: M for s, M in right.items() if not np.array_equal(M, now[s])}
    settings = [f"sensor.{s}.axis_map={as_map(M)}" for s, M in changed.items()]
    if len(changed) == 2 and np.array_equal(right["accelerometer"], right["gyroscope"]):
        settings = [f"sensor.axis_map={as_map(right['gyroscope'])}"]
    return f"by the faces that are stated {which}: set {' and '.join(settings)}"
