"""Check whether one common mounting explains all turns of a unit.

Each turn for the accelerometer gives three vectors (``pipeline.checks.bench``), by the convention

    p_k = K S_k^T u_k,   q_k = K S_k^T (u_k x a_k),   c_k = b + K (elevation of the turn axis) a_k

where

K, b     : inverse of the calibration matrix, and bias
S_k      : rotation of the unit in its seat in turn k, small; the rotation that all turns share is a part of K
u_k, a_k : upward face at angle 0 and turn axis

Three turns give 27 numbers for 9 of K, 3 of b and 6 of the seats. A zero of the angle is a seat about the turn axis.
Table tilt, and turn axes that are not at right angles, have the same signal as seats in p and q, and change the
elevation of the turn axes as well. If they explain the 27 numbers within their limits, and level seats do not, the
diagnosis of the unit names them.

A turn for the gyroscope gives the direction of its turn axis in the frame of the accelerometer, ``K^T (q x p)``,
whatever its zero and its time offset. The gyroscope alone cannot distinguish it from its misalignment.

Turns that no common mounting explains get the note ``N-SEATS``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.checks.bench import (
    UP_AT_QUARTER_TURN,
    FittedGravity,
    TurnFit,
    TurnMounting,
    angle_ahead,
    by_convention,
    unit,
)
from pipeline.core.records import (
    AFTER_BASE,
    AXES,
    BASE_COUNT,
    MATRIX_NAMES,
    Note,
    Recording,
    Values,
    cross,
    motion_at_rest,
)
from pipeline.core.settings import Sensor, Table
from pipeline.physics.effects import effect
from pipeline.physics.kinematics import UP_AT_ZERO, level_at_zero, skew, turn_about_axis, turn_by_vector

# Smaller seats are left to the diagnosis: hidden table effects of the blind study (tilt 0.26 deg, leans 0.13 deg) reach
# 0.2 deg.
SMALLEST_DEG = 0.3
TIMES_STATED = 3.0  # standard uncertainties of the table's orthogonality and angle
NOISE_PQ_G = 5e-4  # by wander, drift and nonlinearity in p and q in the blind study: 0.03 deg
NOISE_C_G = 4e-3  # likewise in c: half of a K2 of 6e-3 1/g (twice 0.3 %), or 8 degC at 5e-4 g/degC
# chi-square by which leans have to be better than seats: 1 sigma; 2 sigma with tilt
CLEAR_CHI_SQUARE, OF_TWO_MORE = 1.0, 4.0
MAX_SEAT_CHI_SQUARE = 33.0  # chi-square of at most 13 degrees of freedom with a probability of 0.002
GAUGE = 1e-6  # weight with which the seats have the smallest sum of squares
# Columns of the design of ``_fit``: K comes before the bias.
K_COLUMNS, BIAS_COLUMNS = slice(0, len(MATRIX_NAMES)), slice(len(MATRIX_NAMES), BASE_COUNT)
QUARTERS_DEG = np.array([0.0, 90.0, 180.0, 270.0])
TABLE_EFFECTS = ("table_tilt", "table_axis_nonorthogonality")
# Largest plausible tilt (deg), lean (deg) and time offset (s) where the sensor's config states none.
BENCH_LIMITS = {"table_tilt": 1.0, "table_axis_nonorthogonality": 1.0, "time_offset": 0.04}


@dataclass(frozen=True)
class TurnRecording:
    """A turn recording, its stated mounting and the one by gravity."""

    recording: Recording
    stated: TurnMounting
    fit: TurnFit
    found: TurnMounting | None  # None where gravity does not determine it
    configurable: bool  # whether the procedure has an entry of the recording's name
    tolerance_deg: float  # of the zero

    @property
    def name(self) -> str:
        """Name of the recording."""
        return self.recording.name


@dataclass(frozen=True)
class _Conventional:
    turn: TurnRecording
    bench: TurnMounting
    gravity: FittedGravity

    @property
    def axis(self) -> int:
        """Index of the turn axis."""
        return AXES.index(self.bench.axis)

    @property
    def ideal(self) -> tuple[Values, Values]:
        """Vectors p and q of an ideal sensor: u and u x a."""
        return UP_AT_ZERO[self.axis], UP_AT_QUARTER_TURN[self.axis]

    def normal(self, K: Values) -> Values:
        """Return the turn axis in the frame of K, ``K^T (q x p)`` with length 1: (3,) array."""
        return unit(K.T @ cross(self.gravity.sine, self.gravity.cosine))


@dataclass(frozen=True)
class _Seats:
    """Seats of the unit in the turns for the accelerometer."""

    K: Values  # includes the common seat if zeros explain the differences, else the mean of the seats
    seats: Values  # (n, 3), deg, rotation in each turn against the mean of all
    zeros: Values | None  # (n,), deg, of each turn, if one common seat and the zeros explain the turns


def _find_seats(turns: Sequence[_Conventional]) -> _Seats:
    """Return K and the seats that explain p and q of turns about all three axes, by Gauss-Newton steps."""
    n = len(turns)
    seats, K = np.zeros((n, 3)), np.eye(3)
    gauge = GAUGE * np.eye(9 + seats.size)[9:]
    ideal, found = (np.array(v) for v in ([t.ideal for t in turns], [t.gravity[1:] for t in turns]))
    for _ in range(4):
        d = ideal @ turn_by_vector(np.radians(seats))
        of_seats = np.zeros((n, 2, 3, n, 3))
        of_seats[range(n), :, :, range(n)] = np.radians(K @ skew(d))
        of_K = np.eye(3)[:, :, None] * d[:, :, None, None]
        design = np.concatenate([of_K.reshape(n, 2, 3, 9), of_seats.reshape(n, 2, 3, 3 * n)], axis=3)
        residual = found - d @ K.T
        rows = np.vstack([design.reshape(6 * n, -1), gauge])
        step = np.linalg.lstsq(rows, np.append(residual, -GAUGE * seats), rcond=None)[0]
        K, seats = K + step[:9].reshape(3, 3), seats + step[9:].reshape(-1, 3)
    # A common seat, and a zero of each turn that is a seat about its axis.
    about = np.zeros((n, 3, n))
    about[range(n), [turn.axis for turn in turns], range(n)] = 1.0
    design = np.column_stack([np.tile(np.eye(3), (n, 1)), about.reshape(3 * n, n)])
    found = np.linalg.lstsq(design, seats.ravel(), rcond=None)[0]
    common, zeros = seats.mean(axis=0), None
    if np.max(np.abs(seats.ravel() - design @ found)) < SMALLEST_DEG / 3.0:
        common, zeros = found[:3], np.asarray(-found[3:])
    return _Seats(K @ turn_by_vector(np.radians(common)).T, seats - seats.mean(axis=0), zeros)


def _table_explains(turns: Sequence[_Conventional], K: Values, limits: Sequence[float]) -> bool:
    """Return whether tilt, leaning axes and a time offset within limits explain the turns, and seats do not better."""
    tilt, lean = (np.stack([_columns_of(name, t) for t in turns]) for name in TABLE_EFFECTS)
    late = np.stack([_offset_columns(t) for t in turns])
    seat = np.zeros((len(turns), 3, 3, 3 * len(turns)))
    for k, turn in enumerate(turns):
        seat[k, 1:, :, 3 * k : 3 * k + 3] = [np.radians(skew(ideal)) for ideal in turn.ideal]
    level_seats = _fit(turns, K, seat, [np.inf] * 3 * len(turns))
    of_tilt, of_lean = [limits[0]] * 2, [limits[1]] * 6
    tilted = _fit(turns, K, np.concatenate([tilt, late], axis=3), [*of_tilt, limits[2]])
    if tilted < min(MAX_SEAT_CHI_SQUARE, level_seats):
        return True
    leaning = _fit(turns, K, np.concatenate([lean, late], axis=3), [*of_lean, limits[2]])
    both = _fit(turns, K, np.concatenate([tilt, lean, late], axis=3), [*of_tilt, *of_lean, limits[2]])
    return min(leaning, both + OF_TWO_MORE) < min(MAX_SEAT_CHI_SQUARE, level_seats - CLEAR_CHI_SQUARE)


def _fit(turns: Sequence[_Conventional], K: Values, columns: Values, limits: Sequence[float]) -> float:
    """Return chi-square of K, b and parameters of further columns; infinity where one exceeds its limit.

    ``columns`` is (n, 3, 3, m): of each turn c, p and q with K the unit matrix.
    """
    design = np.zeros((*columns.shape[:3], BASE_COUNT + columns.shape[3]))
    for k, turn in enumerate(turns):
        design[k, 1:, :, K_COLUMNS] = [np.kron(np.eye(3), ideal) for ideal in turn.ideal]
    design[:, 0, :, BIAS_COLUMNS] = np.eye(3)
    design[..., AFTER_BASE] = K @ columns
    weight = 1.0 / np.array([[NOISE_C_G], [NOISE_PQ_G], [NOISE_PQ_G]])
    A = (weight[..., None] * design).reshape(9 * len(turns), -1)
    y = (weight * np.array([turn.gravity for turn in turns])).ravel()
    values = np.linalg.lstsq(A, y, rcond=1e-9)[0]
    exceeded = np.any(np.abs(values[AFTER_BASE]) > np.array(limits))
    return float("inf") if exceeded else float(np.sum((y - A @ values) ** 2))


def _columns_of(name: str, turn: _Conventional) -> Values:
    """Return the derivative of c, p and q by the m parameters of a table effect, 1/deg: (3, 3, m) array."""
    force, level = (turn_about_axis(v, turn.axis, -QUARTERS_DEG) for v in (turn.ideal[0], level_at_zero(turn.axis)))
    rest = motion_at_rest(QUARTERS_DEG)
    motion = replace(rest, specific_force=force, level=level, axis=turn.axis, angle=QUARTERS_DEG, rate=np.zeros(4))
    of = effect(name)
    values = np.zeros(len(of.parameters("accelerometer")))
    at_0, at_90, at_180, at_270 = of.regressors("accelerometer", motion, np.eye(3), values)
    return np.stack([(at_0 + at_90 + at_180 + at_270) / 4.0, (at_0 - at_180) / 2.0, (at_90 - at_270) / 2.0])


def _offset_columns(turn: _Conventional) -> Values:
    """Return the derivative by a time offset, 1/s: (3, 3, 1) array; the angle is ahead by offset times mean rate."""
    (up, across), mean_rate = turn.ideal, turn.bench.sense * turn.turn.fit.mean_rate
    return np.asarray(np.radians(mean_rate) * np.stack([np.zeros(3), across, -up])[..., None])


def seat_notes(turns: Sequence[TurnRecording], table: Table, sensor: Sensor) -> dict[str, Note]:
    """Return the note on each recording that the common mounting does not explain, by name.

    The turns of one setup are compared, or all together if no setup has turns about all three axes. With
    ``table.seat_deg`` each turn has a separate mounting, which the fit estimates.
    """
    if table.seat_deg is not None:
        return {}
    allowed = max(SMALLEST_DEG, TIMES_STATED * float(np.hypot(table.orthogonality_deg, table.angle_accuracy_deg)))
    effects = sensor.accelerometer.effects
    limits = [effects.get(name, limit) for name, limit in BENCH_LIMITS.items()]
    details: dict[str, str] = {}
    names = dict.fromkeys(t.recording.setup for t in turns)
    setups = [_conventional([(t, t.stated) for t in turns if t.recording.setup == name]) for name in names]
    complete = [(every, slow) for every, slow in setups if {c.axis for c in slow} == set(range(3))]
    for every, slow in complete or [_conventional([(t, t.stated) for t in turns])]:
        in_doubt = any(note.code == "N-REFERENCE" for c in slow for note in c.turn.recording.notes)
        if in_doubt or {c.axis for c in slow} != set(range(3)):
            continue  # an angle in doubt is no evidence of seats
        found = _find_seats(slow)
        doubt = np.max(np.abs(found.seats)) > allowed and not _table_explains(slow, found.K, limits)
        if doubt:
            details |= dict.fromkeys((c.turn.name for c in slow), _seats_in_words(slow, found, allowed))
        for fast in (c for c in every if c.turn.recording.role == "gyroscope"):
            # Against the body axis, or the axis of another turn about it, whichever is nearer: if the table's axes
            # lean, the turns for the gyroscope lean with those for the accelerometer.
            alike = [] if doubt else [slower.normal(found.K) for slower in slow if slower.axis == fast.axis]
            rotations = np.degrees(cross(fast.normal(found.K), np.array([np.eye(3)[fast.axis], *alike])))
            off = min(rotations, key=lambda v: float(v @ v))
            if np.max(np.abs(off)) > allowed:
                details[fast.turn.name] = (
                    f"the mounting of the unit in {fast.turn.name} differs from that in the turns for the "
                    f"accelerometer, by more than {allowed:.2g} deg: by gravity it is rotated by {_in_words(off)}, and "
                    "the gyroscope's matrix is wrong by as much; set table.seat_deg=1 to estimate it (docs/mounting.md)"
                )
    return {t.name: Note("N-SEATS", t.recording.samples, 0, 0, details[t.name]) for t in turns if t.name in details}


def refined_zeros(turns: Sequence[TurnRecording]) -> dict[str, float]:
    """Return the zero of each turn, deg, by all turns: one alone leaves it uncertain by the misalignment of the axes.

    Empty where one seat does not explain the turns.
    """
    every, slow = _conventional([(t, t.found) for t in turns])
    found = _find_seats(slow) if {c.axis for c in slow} == set(range(3)) else None
    if found is None or found.zeros is None:
        return {}
    zeros = {}
    for c in every:
        p, q = np.linalg.solve(found.K, np.column_stack(c.gravity[1:])).T
        zeros[c.turn.name] = c.bench.zero_deg - c.bench.sense * angle_ahead(c.axis, p, q)
    return zeros


def _conventional(
    turns: list[tuple[TurnRecording, TurnMounting | None]],
) -> tuple[list[_Conventional], list[_Conventional]]:
    """Return the turns in which gravity turns, and those of them for the accelerometer."""
    known = [(t, bench, by_convention(t.fit, bench)) for t, bench in turns if bench is not None]
    every = [_Conventional(t, bench, gravity) for t, bench, gravity in known if gravity is not None]
    return every, [c for c in every if c.turn.recording.role == "accelerometer"]


def _in_words(rotation: Values) -> str:
    return ", ".join(f"{v:+.2f} deg about {a}" for a, v in zip(AXES, rotation, strict=True))


def _seats_in_words(slow: Sequence[_Conventional], found: _Seats, allowed: float) -> str:
    if found.zeros is None:
        seats = "; ".join(f"{c.turn.name} {_in_words(s)}" for c, s in zip(slow, found.seats, strict=True))
        return (
            f"the mounting of the unit differs between the turns, by more than {allowed:.2g} deg; its rotation against "
            f"the mean of the turns: {seats}; set table.seat_deg=1 to estimate it, or mount the unit once for all "
            "turns (docs/mounting.md)"
        )
    settings = ", ".join(
        f"procedure.recordings.{c.turn.name}.zero_deg={c.bench.zero_deg + c.bench.sense * z:.2f}"
        for c, z in zip(slow, found.zeros, strict=True)
        if abs(z) > SMALLEST_DEG / 3.0
    )
    text = f"the zeros of the turns do not fit together, by more than {allowed:.2g} deg"
    return f"{text}; gravity fits with {settings} (docs/mounting.md)"
