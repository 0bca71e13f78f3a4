"""A session: one unit goes through all recordings of its procedure, on one clock since power-on.

Every stream of random numbers has its own generator, ``default_rng([seed, unit, stream])``, so that a change in one
(say, lost samples) leaves the others as they are.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.model.kinematics import earth_rate
from pipeline.records import AXES, SENSORS, Recording
from pipeline.simulation.rate_table import random_errors
from pipeline.simulation.scene import ALTERATIONS, Scene, alter
from pipeline.simulation.sensor import bias_wander
from pipeline.simulation.trajectory import Gimbals, Moves, Turn, rotation_about

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from pipeline.records import Motion
    from pipeline.simulation.sensor import Environment, SimulatedSensor
    from pipeline.simulation.trajectory import Planned

STREAMS = ("unit", "effects", "motion", "table", "accelerometer", "gyroscope", "temperature", "link", "bench", "room")
NANOSECONDS = 1_000_000_000
ANGLE_DECIMALS, QUATERNION_DECIMALS, TEMPERATURE_DECIMALS = 6, 9, 3


class Streams:
    """The random numbers of one unit, a generator for each purpose."""

    def __init__(self, seed: int, unit: int) -> None:
        self._key = (seed, unit)

    def __getitem__(self, stream: str) -> np.random.Generator:
        return np.random.default_rng([*self._key, STREAMS.index(stream)])


@dataclass(frozen=True)
class Bench:
    """Where a recording is made: table, what it does otherwise than commanded, and the sensors as mounted there."""

    table: Mapping[str, Any]
    imperfections: Mapping[str, Any]
    sensors: Mapping[str, SimulatedSensor]


@dataclass(frozen=True)
class Session:
    """A unit's recordings to be.

    Attributes
    ----------
    planned : list of Planned
    benches : dict of str to Bench
        Role to bench; the key ``""`` is for all roles that are not named.
    alterations : dict of str to dict of str to array
        Sensor to its effects of mounting, table and timing.
    environment : Environment
    interval : float, s
    pause : float, s
    lost : float
    """

    planned: list[Planned]
    benches: dict[str, Bench]
    alterations: dict[str, dict[str, NDArray[np.float64]]]
    environment: Environment
    interval: float
    pause: float
    lost: float

    def recordings(self, streams: Streams) -> list[Recording]:
        """Make the recordings."""
        times = self._times()
        seconds = [t / NANOSECONDS for t in times]
        rng = {name: streams[name] for name in ("table", "temperature", "link", *SENSORS)}
        benches = [self.benches.get(p.role, self.benches[""]) for p in self.planned]
        scenes = [
            _scene(p, b, time[0], rng["table"]) for p, b, time in zip(self.planned, benches, seconds, strict=True)
        ]
        wander = {s: bias_wander(seconds, benches[0].sensors[s].sheet["wander_time_s"], rng[s]) for s in SENSORS}
        out = []
        for k, (plan, bench, scene) in enumerate(zip(self.planned, benches, scenes, strict=True)):
            motions = self._motions(scene, seconds[k])
            accelerometer, gyroscope = (
                self._reading(bench.sensors[s], motions[s], wander[s][k], rng[s]) for s in SENSORS
            )
            log = _log(plan, bench, seconds[k] - seconds[k][0])
            whole = Recording(
                plan.name,
                plan.role,
                None if plan.axis is None else AXES[plan.axis],
                times[k],
                accelerometer=accelerometer,
                gyroscope=gyroscope,
                temperature=_rounded(self.environment.reading(seconds[k], rng["temperature"]), TEMPERATURE_DECIMALS),
                table_angle=log.get("table_angle"),
                table_rate=log.get("table_rate"),
                table_attitude=log.get("table_attitude"),
            )
            out.append(whole.select(received(len(times[k]), self.lost, rng["link"])) if self.lost else whole)
        return out

    def _times(self) -> list[NDArray[np.int64]]:
        """Return the sample times: whole intervals since power-on."""
        step = round(self.interval * NANOSECONDS)
        out, now = [], self.pause
        for plan in self.planned:
            first = int(np.ceil(now / self.interval - 1e-9))
            count = int(plan.trajectory.duration / self.interval + 1e-9) + 1
            out.append((first + np.arange(count, dtype=np.int64)) * step)
            now = float(out[-1][-1]) / NANOSECONDS + self.pause
        return out

    def _motions(self, scene: Scene, time: NDArray[np.float64]) -> dict[str, Motion]:
        temperature = self.environment.temperature(time)
        plain = scene.motion(time, temperature)
        return {
            s: alter(scene, self.alterations[s]).motion(time, temperature) if self.alterations[s] else plain
            for s in SENSORS
        }

    def _reading(
        self, sensor: SimulatedSensor, motion: Motion, wander: NDArray[np.float64], rng: np.random.Generator
    ) -> NDArray[np.float64]:
        white = sensor.white(self.interval) * rng.standard_normal((len(motion.time), 3))
        reading = sensor.exact(motion) + white + sensor.sheet["bias_wander"] * wander
        return _rounded(sensor.quantised(reading), sensor.decimals)


def _scene(plan: Planned, bench: Bench, start: float, rng: np.random.Generator) -> Scene:
    """Return the scene of a recording on its bench, without hidden effects."""
    table, settings = bench.table, dict(bench.imperfections)
    trajectory = plan.trajectory
    if isinstance(trajectory, Turn) and table["motion"] != "none":
        if plan.role == "accelerometer" and _stops_and_goes(trajectory):
            settings["rate_error"] = (0.0, 0.0, 0.0)  # steps are counted: what is lost is lost while it turns fast
        errors = random_errors(trajectory.program, rng, settings, trajectory.axis)
        trajectory = Turn(trajectory.axis, trajectory.program, errors)
    tilt = np.append(np.asarray(settings.get("tilt_deg", (0.0, 0.0)), float), 0.0)
    size = float(np.linalg.norm(tilt))
    up = rotation_about(tilt / size, np.array([size]))[0][2] if size else np.array([0.0, 0.0, 1.0])
    placed = table["latitude_deg"] is not None and table["azimuth_deg"] is not None
    earth = earth_rate(table["latitude_deg"], table["azimuth_deg"]) if placed else None
    return Scene(trajectory, start, plan.axis, table["gravity_g"], up, earth)


def _stops_and_goes(turn: Turn) -> bool:
    return bool(np.all(np.abs(np.diff(turn.program.stops)) < 180.0))


def _log(plan: Planned, bench: Bench, time: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """Return what the table logs: the commanded motion."""
    trajectory = plan.trajectory
    if bench.table["motion"] == "none":
        return {}
    if isinstance(trajectory, Turn):
        angle, rate = trajectory.program.at(time)[:2]
        return {"table_angle": _rounded(angle, ANGLE_DECIMALS), "table_rate": _rounded(rate, ANGLE_DECIMALS)}
    if isinstance(trajectory, Gimbals):
        rate = np.linalg.norm(trajectory.true(time).omega, axis=1)
        attitude = _rounded(trajectory.quaternion(time), QUATERNION_DECIMALS)
        return {"table_attitude": attitude, "table_rate": _rounded(rate, ANGLE_DECIMALS)}
    assert isinstance(trajectory, Moves)  # noqa: S101
    return {"table_rate": np.zeros(len(time))} if plan.role == "static" else {}


def received(count: int, lost: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return which samples the radio link delivers; the first and the last always."""
    kept = rng.random(count) >= lost
    kept[[0, -1]] = True
    return kept


def _rounded(values: NDArray[np.float64], decimals: int) -> NDArray[np.float64]:
    """Return what a reader of the printed values finds."""
    rounded: NDArray[np.float64] = np.rint(values * 10.0**decimals) / 10.0**decimals
    return rounded


def hidden(effects: dict[str, dict[str, NDArray[np.float64]]]) -> dict[str, dict[str, NDArray[np.float64]]]:
    """Return the effects that are not the sensors' own, per sensor."""
    return {s: {n: v for n, v in own.items() if n in ALTERATIONS} for s, own in effects.items()}
