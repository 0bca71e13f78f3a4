"""A session on a simulated table: recordings of a known sensor, with any effect in it, from exact trajectories."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.signal import lfilter

from pipeline.core.records import AXES, Motion, Recording
from pipeline.physics.effects import effect
from pipeline.physics.effects.base import truth
from pipeline.simulation.campaign import Environment
from pipeline.simulation.description import Course, plan
from pipeline.simulation.sensor import ALTERATIONS, Scene, alter

if TYPE_CHECKING:
    from pipeline.simulation.trajectory import Planned

STOP_AND_GO = Course(step_deg=5.0, dwell_s=2.0, rates_dps=(30.0, 100.0), both_directions=True, turns=1, rest_s=5.0)
THESIS = replace(STOP_AND_GO, step_deg=1.0, dwell_s=1.0)
ONE_WAY = replace(STOP_AND_GO, both_directions=False)
CONTINUOUS = replace(STOP_AND_GO, accelerometer_rates_dps=(5.0, 30.0), both_directions=True)

WHITE = {"accelerometer": 8e-4, "gyroscope": 0.0102}  # noise densities of the MPU-6050 at 8.3 Hz
WANDER = {"accelerometer": 1e-4, "gyroscope": 0.003}
WANDER_S = 100.0
BIAS = {"accelerometer": np.array([0.03, -0.02, 0.05]), "gyroscope": np.array([1.2, -0.8, 0.5])}
K = {
    "accelerometer": np.array([[1.01, 0.004, -0.006], [0.002, 0.99, 0.005], [-0.003, 0.007, 1.02]]),
    "gyroscope": np.array([[0.99, 0.006, -0.002], [-0.004, 1.015, 0.003], [0.005, -0.001, 1.004]]),
}
# Sizes of the MPU-6000/6050 data sheet, or of design where it is silent; one number for all parameters.
SIZE = {
    "accelerometer": {
        "bias_temperature": 5e-4,
        "bias_temperature_quadratic": [5e-4, 3e-5] * 3,
        "scale_factor_temperature": 2e-4,
        "warm_up": [5e-3, -5e-3, 5e-3, 180.0],
        "bias_drift": 3e-6,
        "scale_factor_asymmetry": 3e-3,
        "quadratic_nonlinearity": 5e-3,
        "cubic_nonlinearity": 5e-3,
        "cross_axis_nonlinearity": 3e-3,
        "vibration_rectification": 2e-3 / 30,
        "hysteresis": 1e-3,
        "rate_dependence": 5e-5,
        "lever_arm": 0.05,
        "inner_lever_arms": 3e-3,
        "time_offset": 0.02,
        "low_pass_lag": [0.019],
        "clock_rate": [200.0],
        "table_tilt": 0.2,
        "table_axis_nonorthogonality": 0.1,
        "table_encoder_error": 0.1,
        "table_rate_ripple": 5e-3,
        "table_backlash": 0.1,
    },
    "gyroscope": {
        "bias_temperature": 0.16,
        "bias_temperature_quadratic": [0.16, 5e-3] * 3,
        "scale_factor_temperature": 3e-4,
        "warm_up": [0.3, -0.3, 0.3, 180.0],
        "bias_drift": 2e-4,
        "scale_factor_asymmetry": 2e-3,
        "quadratic_nonlinearity": 1.6e-5,
        "cubic_nonlinearity": 1.3e-7,
        "vibration_rectification": 0.05 / 100,
        "g_sensitivity": 0.1,
        "g_squared_sensitivity": 0.02,
        "earth_rotation": 0.0042,
        "time_offset": 0.02,
        "low_pass_lag": [0.019],
        "clock_rate": [200.0],
        "table_axis_nonorthogonality": 0.1,
        "table_encoder_error": 0.1,
        "table_rate_ripple": 5e-3,
    },
}


def values_of(sensor: str, name: str, rng: np.random.Generator) -> np.ndarray:
    """Return an effect's parameters at data-sheet size, with random signs where the size is one number."""
    size = SIZE[sensor][name]
    if isinstance(size, list):
        return np.array(size)
    return size * rng.choice([-1.0, 1.0], len(effect(name).parameters(sensor)))


@dataclass(frozen=True)
class Session:
    """What to simulate."""

    seed: int = 0
    course: Course = STOP_AND_GO
    effects: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)  # sensor to effect to values
    white: float = 1.0
    wander: float = 1.0
    interval: float = 0.12
    temperature: bool = True
    clock_shared: bool = True
    static: bool = False
    ramp: float = 0.0


def record(session: Session) -> list[Recording]:
    """Return the recordings of both sensors."""
    rng = np.random.default_rng(session.seed)
    mean, phase = 25.0 + rng.uniform(-1, 1), rng.uniform(0, 6, 2)
    air = Environment(mean, 4.5, 300.0, 0.3, np.array([2100.0, 4700.0]), phase, session.ramp, 2000.0)
    course = replace(session.course, static_s=session.course.static_s if session.static else 0.0)
    planned, start, plans = plan("three_axis_turns", course, rng), 30.0, []
    for item in planned:
        n = int(item.trajectory.duration / session.interval) + 1
        plans.append((item, start, start + session.interval * np.arange(n)))
        start += item.trajectory.duration + course.pause_s
    noise = {s: _noise(s, [t for _, _, t in plans], session, rng) for s in WHITE}
    return [
        _recording(session, item, clock, air, {s: noise[s][k] for s in noise}, rng)
        for k, (item, *clock) in enumerate(plans)
    ]


def _recording(  # noqa: PLR0917  (one of everything that a recording is made of)
    session: Session,
    item: Planned,
    clock: tuple[float, np.ndarray],
    air: Environment,
    noise: dict[str, np.ndarray],
    rng: np.random.Generator,
) -> Recording:
    readings = {}
    start, time = clock
    for sensor in WHITE:
        hidden = session.effects.get(sensor, {})
        scene = alter(Scene(item.trajectory, start, item.axis), hidden)
        motion = scene.motion(time, air.temperature(time))
        readings[sensor] = BIAS[sensor] + truth(sensor, motion) @ K[sensor].T + noise[sensor]
        for name, values in hidden.items():
            if name not in ALTERATIONS:
                readings[sensor] += effect(name).reading(sensor, motion, K[sensor], values)
    pose = item.trajectory.pose(time - start)
    attitude = None
    if item.axis is None:
        attitude = item.trajectory.quaternion(time - start) if hasattr(item.trajectory, "quaternion") else None
    shown = time if session.clock_shared else time - time[0]
    return Recording(
        item.name,
        item.role,
        None if item.axis is None else AXES[item.axis],
        np.round(shown * 1e9).astype(np.int64),
        readings["accelerometer"],
        readings["gyroscope"],
        air.reading(time, rng) if session.temperature else None,
        pose.angle,
        pose.rate,
        attitude,
        clock_shared=session.clock_shared,
    )


def _noise(sensor: str, times: list[np.ndarray], session: Session, rng: np.random.Generator) -> list[np.ndarray]:
    time = np.concatenate(times)
    grid = np.arange(time[0], time[-1] + session.interval, session.interval)
    wander = gauss_markov(rng, len(grid), session.interval / WANDER_S)
    at = [np.clip(np.searchsorted(grid, t), 0, len(grid) - 1) for t in times]
    return [
        session.white * WHITE[sensor] * rng.standard_normal((len(t), 3)) + session.wander * WANDER[sensor] * wander[i]
        for t, i in zip(times, at, strict=True)
    ]


def gauss_markov(rng: np.random.Generator, n: int, step: float) -> np.ndarray:
    """Return n values of standard deviation 1 on three axes, ``step`` correlation times apart: (n, 3) array."""
    keep = np.exp(-step)
    drive = rng.standard_normal((n, 3)) * np.sqrt(1 - keep**2)
    drive[0] = rng.standard_normal(3)
    return np.asarray(lfilter([1.0], [1.0, -keep], drive, axis=0))


def random_motion(seed: int) -> Motion:
    """Return five samples at which every signal has a random value."""
    rng, n = np.random.default_rng(seed), 5
    level = np.linalg.qr(rng.standard_normal((n, 3, 3)))[0]
    return Motion(
        time=np.sort(rng.uniform(0, 3600, n)),
        specific_force=rng.uniform(-2, 2, (n, 3)),
        angular_rate=rng.uniform(-300, 300, (n, 3)),
        angular_acceleration=rng.uniform(-500, 500, (n, 3)),
        specific_force_rate=rng.uniform(-3, 3, (n, 3)),
        temperature=rng.uniform(-30, 80, n),
        angle=rng.uniform(-400, 400, n),
        rate=rng.uniform(-200, 200, n),
        axis=int(rng.integers(3)),
        still=np.zeros(n, bool),
        level=level,
        direction=np.linalg.qr(rng.standard_normal((n, 3, 3)))[0][:, 0],
        temperature_rate=rng.uniform(-0.1, 0.1, n),
    )
