"""Boards with several chips by geometry alone: positions are differentiated numerically, no lever-arm formula is used.

p(t) = R(t) r,   f = R^T (g_up + linear acceleration + p''),   omega = log(R(t - h)^T R(t + h)) / 2h
reading = bias + K (axes of the chip)(f or omega) + white noise + Gauss-Markov wander
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from bench_session import gauss_markov
from hand_session import fitted
from scipy.spatial.transform import Rotation
from unit_settings import settings_of, with_noise

from pipeline.core.records import Recording
from pipeline.estimation.chips import Chip
from pipeline.estimation.stages import fit_stage
from pipeline.simulation.description import shipped_settings

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

Array = np.ndarray
G = 9.80665
H = 2e-4  # s, of the differences
SLOW = 8.0  # deg/s: at a place 5 cm off the axis that adds 0.1 mg
WHITE = {"accelerometer": 2.8e-3, "gyroscope": 0.035}
WANDER = {"accelerometer": 1e-4, "gyroscope": 3e-3}


@dataclass(frozen=True)
class Path:
    """Attitude (body to level) and linear acceleration, m/s^2 in level axes, at any times."""

    time: Array
    attitude: Callable[[Array], Rotation]
    linear: Callable[[Array], Array]
    info: dict[str, Any] = field(default_factory=dict)


def by_hand(
    rng: np.random.Generator, rests: int = 24, *, turn: tuple[float, float] = (50, 140), axis: Array | None = None
) -> Path:
    """Rests of 3 s and moves of 1 s, each about an axis at random (or one axis) while the hand shakes; 100 Hz."""
    starts, base, turns = [], [Rotation.from_rotvec(rng.uniform(-1, 1, 3))], []
    t = 3.0
    for _ in range(rests - 1):
        direction = rng.standard_normal(3) if axis is None else axis
        vector = np.radians(rng.uniform(*turn) * rng.choice([-1, 1])) * direction / np.linalg.norm(direction)
        starts.append(t)
        turns.append(vector)
        base.append(base[-1] * Rotation.from_rotvec(vector))
        t += 1.0 + rng.uniform(2.5, 3.5)
    time = np.arange(0.01, t, 0.01)
    begin, moves, shake = np.array(starts), np.array(turns), rng.uniform(1, 3, (rests, 3))
    quats = np.array([b.as_quat() for b in base])

    def place(at: Array) -> tuple[Array, Array]:
        k = np.searchsorted(begin, at, side="right") - 1
        s = np.where(k < 0, 0.0, np.clip(at - begin[np.maximum(k, 0)], 0.0, 1.0))
        return np.maximum(k, 0), s

    def attitude(at: Array) -> Rotation:
        k, s = place(at)
        smooth = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
        return Rotation.from_quat(quats[k]) * Rotation.from_rotvec(moves[k] * smooth[:, None])

    def linear(at: Array) -> Array:
        k, s = place(at)
        return 0.5 * (np.sin(np.pi * s) ** 2)[:, None] * np.sin(2 * np.pi * s[:, None] * shake[k])

    return Path(time, attitude, linear)


def felt(path: Path, r: Array, *, shift: float = 0.0) -> dict[str, Array]:
    """Return specific force, g, at the place r, m, and the angular rate, deg/s, in body axes."""
    t = path.time + shift
    before, now, after = (path.attitude(t + h) for h in (-H, 0.0, H))
    acceleration = (after.apply(r) - 2.0 * now.apply(r) + before.apply(r)) / H**2
    force = now.inv().apply(np.array([0.0, 0.0, G]) + path.linear(t) + acceleration) / G
    return {"accelerometer": force, "gyroscope": np.degrees((before.inv() * after).as_rotvec() / (2.0 * H))}


@dataclass(frozen=True)
class TrueChip:
    """A chip: rotation from body axes to its own, place in body axes, bias and K of each sensor in its own axes."""

    axes: Array
    place: Array
    bias: dict[str, Array]
    K: dict[str, Array]
    delay: float = 0.0


def draw_chip(rng: np.random.Generator, axes: Array, place: Array, delay: float = 0.0) -> TrueChip:
    model = shipped_settings(sensor="mpu6050").sensor
    bias = {s: 0.3 * model.of(s).bias * rng.uniform(-1, 1, 3) for s in WHITE}
    K = {s: np.eye(3) + 0.02 * rng.uniform(-1, 1, (3, 3)) for s in WHITE}
    K["accelerometer"] = np.tril(K["accelerometer"])  # in axes that it defines itself
    return TrueChip(axes, place, bias, K, delay)


def read(chip: TrueChip, truth: dict[str, Array], rng: np.random.Generator, interval: float) -> dict[str, Array]:
    found = {}
    for sensor, values in truth.items():
        slow = WANDER[sensor] * gauss_markov(rng, len(values), interval / 100.0)
        clean = chip.bias[sensor] + values @ (chip.K[sensor] @ chip.axes).T
        found[sensor] = clean + slow + WHITE[sensor] * rng.standard_normal(values.shape)
    return found


def hand_board(rng: np.random.Generator, chips: Sequence[TrueChip], path: Path) -> list[Chip]:
    """Return the chips of a board that was moved by hand, calibrated each by itself."""
    settings, found = settings_of(sensor="mpu6050", table="hand", procedure={"holdout_every": 3}), []
    for number, chip in enumerate(chips):
        readings = read(chip, felt(path, chip.place, shift=chip.delay), rng, float(np.diff(path.time).mean()))
        recordings = [Recording("recording", "rests", None, np.round(path.time * 1e9).astype(np.int64), **readings)]
        fits = {s: fitted(s, recordings, settings) for s in WHITE}
        found.append(Chip(f"chip{number}", recordings, fits, settings.sensor))
    return found


UP = {"x": [0, 0, 1], "y": [0, 0, 1], "z": [1, 0, 0]}


def table_path(axis: str, rates: Sequence[float], rate: float, turn_s: float = 4.0) -> Path:
    """Return a turn about one axis: rest, ramp, turn, ramp, rest for each rate."""
    knots = [(0.0, 0.0)]
    for w in rates:
        for length, end in ((2.0, 0.0), (0.5, w), (turn_s, w), (0.5, 0.0), (1.0, 0.0)):
            knots.append((knots[-1][0] + length, end))
    at, w = np.array(knots).T

    lengths, changes = np.diff(at), np.diff(w)
    angles = np.append(0.0, np.cumsum(lengths * (w[:-1] + 0.5 * changes)))

    def place(x: Array) -> tuple[Array, Array]:
        k = np.clip(np.searchsorted(at, x, side="right") - 1, 0, len(at) - 2)
        return k, np.clip((x - at[k]) / lengths[k], 0.0, 1.0)

    def smooth_rate(x: Array) -> Array:
        k, s = place(x)
        return w[k] + changes[k] * s * s * (3.0 - 2.0 * s)

    def angle_at(x: Array) -> Array:  # the integral of 3 s^2 - 2 s^3 is s^3 - s^4 / 2
        k, s = place(x)
        return angles[k] + lengths[k] * (w[k] * s + changes[k] * (s**3 - 0.5 * s**4))

    j = "xyz".index(axis)
    up = np.array(UP[axis], float)
    turn = np.eye(3)[j]
    level = Rotation.align_vectors([[0.0, 0.0, 1.0]], [up])[0]

    def attitude(x: Array) -> Rotation:
        return level * Rotation.from_rotvec(np.radians(angle_at(x))[:, None] * turn)

    time = np.arange(0.02, at[-1] - 0.02, 1.0 / rate)
    return Path(time, attitude, lambda x: np.zeros((len(x), 3)), {"angle": angle_at(time), "rate": smooth_rate(time)})


def table_board(
    rng: np.random.Generator, chips: Sequence[TrueChip], plans: dict[str, Sequence[float]], rate: float = 50.0,
    **table: float,
) -> list[Chip]:  # fmt: skip
    """Return the chips of a board that was turned on a table, calibrated each by itself against the table's log.

    ``plans``: turn axis to the rates of the gyroscope's recordings; the accelerometer's turn slowly.
    """
    settings = settings_of(sensor="mpu6050", table="acutronic", procedure={"holdout_every": 3})
    settings, found = settings_of(settings, table=table), []
    paths = [("accelerometer", a, table_path(a, [SLOW, -SLOW], rate, 360.0 / SLOW)) for a in "xyz"]
    paths += [("gyroscope", a, table_path(a, rates, rate)) for a, rates in plans.items()]
    for number, chip in enumerate(chips):
        recordings, start = [], 1.0
        for role, axis, path in paths:
            readings = read(chip, felt(path, chip.place), rng, 1.0 / rate)
            stamps = np.round((path.time + start) * 1e9).astype(np.int64)
            start += float(path.time[-1]) + 10.0
            name = ("accel_" if role == "accelerometer" else "gyro_") + axis
            recordings.append(Recording(name, role, axis, stamps, **readings, table_angle=path.info["angle"],
                                        table_rate=path.info["rate"]))  # fmt: skip
        fits = {
            s: fit_stage(s, "reference_least_squares", with_noise(recordings, settings), None, settings) for s in WHITE
        }
        found.append(Chip(f"chip{number}", recordings, fits, settings.sensor))
    return found
