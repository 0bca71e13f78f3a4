"""Recordings by hand, drawn at random, with the faults of real ones; nothing of the product's own simulation.

    f = R^T g_up + linear acceleration (in moves alone),   R' = R [omega]x
    reading = bias + K truth + effects + white noise + Gauss-Markov wander

A recording alternates rests and moves. A move turns by a smooth profile about any axis, sometimes about the vertical;
in its last 0.3 s it may still turn at 0.7 to 3 deg/s, slowing down. In a rest the unit may creep.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.signal
from unit_settings import settings_of

from pipeline.core.records import Recording

if TYPE_CHECKING:
    from pipeline.core.settings import Settings

Array = np.ndarray
FINE = 4  # steps of the attitude's integral in a sample
TAIL_S = 0.3
GRAVITY_DPS = np.degrees(1.0)


@dataclass(frozen=True)
class Hand:
    """How a recording is made.

    ``white``: standard deviation of a sample, g and deg/s. ``effects``: ``quadratic`` ((3,), 1/g) and ``drift`` ((3,),
    g/s) of the accelerometer, ``g_sensitivity`` ((3, 3), deg/s/g) and ``gyro_drift`` ((3,), deg/s/s) of the gyroscope.
    """

    rests: int = 40
    rest_s: float = 4.0  # typical; each is drawn between 0.8 and 1.3 times
    move_s: float = 1.6  # likewise
    rate_hz: float = 100.0
    vertical: float = 0.0  # share of moves about the vertical
    tail_dps: tuple[float, float] = (0.0, 0.0)  # rate at which a move ends; 0 for none
    creep_dps: float = 0.0  # standard deviation of the rate in a rest, about each axis; at most 0.3
    settle_deg: float = 0.0  # standard deviation, per axis, of what the ends of each move are off gravity
    slow_s: float = 0.0  # time constant of a first-order filter in the accelerometer, before its noise; 0 for none
    jitter: float = 0.0  # share of a sampling interval by which stamps are late, at most; they come in bursts of three
    wander: dict[str, float] = field(default_factory=lambda: {"accelerometer": 1e-4, "gyroscope": 3e-3})
    white: dict[str, float] = field(default_factory=lambda: {"accelerometer": 2.8e-3, "gyroscope": 0.035})
    effects: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Drawn:
    """A recording with its truth: bias and matrix of each sensor, and which samples rest."""

    recording: Recording
    bias: dict[str, Array]
    matrix: dict[str, Array]
    still: Array
    settings: Settings


def products(q: Array) -> Array:
    """Return the running products of unit quaternions (w, x, y, z): (n, 4) array."""
    q = q.copy()
    step = 1
    while step < len(q):
        q[step:] = multiply(q[:-step], q[step:])
        step *= 2
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def multiply(p: Array, q: Array) -> Array:
    """Return the products of quaternions: (n, 4) array."""
    (w, x, y, z), (a, b, c, d) = p.T, q.T
    vector = [w * b + a * x + (y * d - z * c), w * c + a * y + (z * b - x * d), w * d + a * z + (x * c - y * b)]
    return np.stack([w * a - (x * b + y * c + z * d), *vector], axis=1)


def level_up(q: Array) -> Array:
    """Return the vertical in the body frame of attitudes, body to level: (n, 3) array."""
    w, x, y, z = q.T
    return np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)


def draw(hand: Hand, seed: int) -> Drawn:
    return draw_together(hand, seed, 1)[0]


def draw_together(hand: Hand, seed: int, units: int) -> list[Drawn]:
    """Draw units that are moved together, and one recording of each: sensors and noise differ, the motion is one."""
    rng = np.random.default_rng(seed)
    step = 1.0 / hand.rate_hz
    fine = step / FINE
    rate, still, felt = [], [], []
    attitude = np.array([[1.0, 0.0, 0.0, 0.0]])
    parts = []
    for k in range(hand.rests):
        n = FINE * round(hand.rest_s * rng.uniform(0.8, 1.3) / step)
        creep = np.clip(hand.creep_dps * rng.standard_normal(3), -0.3, 0.3)
        parts.append((np.tile(creep, (n, 1)), True))
        if k + 1 < hand.rests:
            parts.append((None, False))
    for given, resting in parts:
        values = _move(hand, rng, fine, level_up(attitude)[0]) if given is None else given
        q = _steps(values, fine)
        path = products(np.vstack([attitude, q]))
        attitude = path[-1:]
        up = level_up(path[:-1])
        shake = np.zeros_like(up)
        if not resting:
            s = np.arange(len(up)) / len(up)
            shake = 0.05 * np.sin(np.pi * s[:, None]) ** 2 * np.sin(2 * np.pi * (s[:, None] * rng.uniform(1, 4, 3)))
        rate.append(values)
        felt.append(up + shake)
        still.append(np.full(len(up), resting))
    rate, felt, still = (np.concatenate(v)[::FINE] for v in (rate, felt, still))
    if hand.settle_deg:  # gravity that the accelerometers feel is off by an angle common to a rest and a move
        edges = np.flatnonzero(np.diff(still.astype(int)) != 0)
        off = hand.settle_deg / GRAVITY_DPS * rng.standard_normal((hand.rests + 1, 3))
        felt = felt + np.cross(off[np.searchsorted(edges, np.arange(len(still))) // 2], felt)
    if hand.slow_s:
        keep = np.exp(-step / hand.slow_s)
        felt = scipy.signal.lfilter([1.0 - keep], [1.0, -keep], felt, axis=0, zi=keep * felt[:1])[0]
    return [_read(hand, rng, rate, felt, still) for _ in range(units)]


def _move(hand: Hand, rng: np.random.Generator, fine: float, up: Array) -> Array:
    """Return the rates of one move, deg/s: a turn by a bell of rate, and its end."""
    n = round(hand.move_s * rng.uniform(0.8, 1.3) / fine)
    axis = up if rng.random() < hand.vertical else rng.standard_normal(3)
    axis = axis / np.linalg.norm(axis)
    other = np.cross(axis, rng.standard_normal(3))
    s = (np.arange(n) + 0.5) / n
    bell = 30.0 * s**2 * (1.0 - s) ** 2 / (n * fine)
    turn = rng.uniform(50.0, 140.0) * rng.choice([-1.0, 1.0])
    rates = turn * bell[:, None] * axis
    if not np.allclose(axis, up / np.linalg.norm(up)):
        rates = rates + rng.uniform(-20.0, 20.0) * (bell * np.sin(2 * np.pi * s))[:, None] * other
    low, high = hand.tail_dps
    if high:
        m = round(TAIL_S / fine)
        tail = rng.standard_normal(3)
        slowing = rng.uniform(low, high) * (1.0 - 0.7 * (np.arange(m) + 0.5) / m)
        rates = np.vstack([rates, slowing[:, None] * tail / np.linalg.norm(tail)])
    return rates[: len(rates) // FINE * FINE]


def _steps(rate: Array, fine: float) -> Array:
    """Return the rotation over each step as quaternions, of the rate at its middle."""
    half = 0.5 * fine * np.radians(rate)
    size = np.linalg.norm(half, axis=1, keepdims=True)
    return np.hstack([np.cos(size), np.sinc(size / np.pi) * half])


def _read(hand: Hand, rng: np.random.Generator, rate: Array, felt: Array, still: Array) -> Drawn:
    n, step = len(rate), 1.0 / hand.rate_hz
    time = np.arange(n) * step
    settings = settings_of(sensor="mpu6050", table="hand", procedure={"holdout_every": 3})
    truths = {"accelerometer": felt, "gyroscope": rate}
    readings, biases, matrices = {}, {}, {}
    for sensor in ("accelerometer", "gyroscope"):
        sheet = settings.sensor.of(sensor)
        bias = 0.5 * sheet.bias * rng.uniform(-1, 1, 3)
        K = np.eye(3) + np.diag(0.6 * sheet.scale_factor * rng.uniform(-1, 1, 3))
        K += 0.6 * sheet.cross_axis * rng.uniform(-1, 1, (3, 3)) * (1 - np.eye(3))
        if sensor == "accelerometer":
            K = np.linalg.inv(np.tril(np.linalg.inv(K)))  # the calibration's own frame
        x = truths[sensor] @ K.T + bias
        x += _effects(sensor, hand, felt, time)
        keep = np.exp(-step / sheet.wander_time_s)
        drive = hand.wander[sensor] * np.sqrt(1 - keep**2) * rng.standard_normal((n, 3))
        level = hand.wander[sensor] * rng.standard_normal((1, 3))
        wander = scipy.signal.lfilter([1.0], [1.0, -keep], drive, axis=0, zi=keep * level)[0]
        readings[sensor] = x + wander + hand.white[sensor] * rng.standard_normal((n, 3))
        biases[sensor], matrices[sensor] = bias, np.linalg.inv(K)
    stamps = time
    if hand.jitter:
        stamps = time + hand.jitter * step * rng.random(n) * (np.arange(n) % 3 != 2)
        stamps = np.maximum.accumulate(stamps) + np.arange(n) * 1e-9
    recording = Recording("recording", "rests", None, np.round(stamps * 1e9).astype(np.int64) + 30_000_000_000,
                          accelerometer=readings["accelerometer"], gyroscope=readings["gyroscope"])  # fmt: skip
    return Drawn(recording, biases, matrices, still, settings)


def _effects(sensor: str, hand: Hand, felt: Array, time: Array) -> Array:
    total = np.zeros_like(felt)
    if sensor == "accelerometer":
        total = total + felt**2 * np.asarray(hand.effects.get("quadratic", np.zeros(3)))
        total = total + (time - time.mean())[:, None] * np.asarray(hand.effects.get("drift", np.zeros(3)))
    else:
        total = total + felt @ np.asarray(hand.effects.get("g_sensitivity", np.zeros((3, 3)))).T
        total = total + (time - time.mean())[:, None] * np.asarray(hand.effects.get("gyro_drift", np.zeros(3)))
    return total


def one_sensor(drawn: Drawn, sensor: str) -> Drawn:
    """Return a unit whose log holds one sensor alone."""
    other = {"accelerometer": "gyroscope", "gyroscope": "accelerometer"}[sensor]
    return replace(drawn, recording=replace(drawn.recording, **{other: None}))
