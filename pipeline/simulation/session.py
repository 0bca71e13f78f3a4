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
from pipeline.simulation.scene import Scene, alter
from pipeline.simulation.sensor import bias_wander, decimals_of
from pipeline.simulation.trajectory import Gimbals, Moves, Turn, rotation_by

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.records import Values
    from pipeline.simulation.description import UnitDescription
    from pipeline.simulation.sensor import Hidden, SimulatedSensor
    from pipeline.simulation.trajectory import Planned


STREAMS = ("unit", "effects", "motion", "table", "accelerometer", "gyroscope", "temperature", "link", "bench", "room")
NANOSECONDS = 1_000_000_000  # in a second
ANGLE_DECIMALS, QUATERNION_DECIMALS, TEMPERATURE_DECIMALS = 6, 9, 3  # of CSV files: far below any noise


class Streams:
    """The random numbers of one unit, a generator for each purpose."""

    def __init__(self, seed: int, unit: int) -> None:
        self._key = (seed, unit)

    def __getitem__(self, stream: str) -> np.random.Generator:
        return np.random.default_rng([*self._key, STREAMS.index(stream)])


@dataclass(frozen=True)
class Environment:
    """Temperature over time, in degC, s and rad; ``noise``: of the thermometer.

        T(t) = ambient + warm_up (1 - exp(-t / warm_up_time)) + drift sum_k sin(2 pi t / p_k + phase_k) / 2 + ramp(t)

    where p_k are the two ``periods`` of the room, half an hour to two hours, and ``ramp(t)`` is the triangle of a
    thermal chamber: up, down below the room, and back.
    """

    ambient: float
    warm_up: float
    warm_up_time: float
    drift: float
    periods: Values
    phases: Values
    ramp: float = 0.0
    ramp_period: float = 3600.0
    noise: float = 0.03

    def temperature(self, time: Values) -> Values:
        """Return the true temperature: (n,) array, degC; time in s since power-on."""
        room = np.sin(2.0 * np.pi * time[:, None] / self.periods + self.phases).sum(1) / 2.0
        triangle = 2.0 / np.pi * np.arcsin(np.sin(2.0 * np.pi * time / self.ramp_period))
        warm = self.warm_up * (1.0 - np.exp(-time / self.warm_up_time))
        total: Values = self.ambient + warm + self.drift * room + self.ramp * triangle
        return total

    def reading(self, time: Values, rng: np.random.Generator) -> Values:
        """Return the thermometer's reading: (n,) array, degC."""
        return self.temperature(time) + self.noise * rng.standard_normal(len(time))


def random_environment(rng: np.random.Generator, *, ramp: float = 0.0, ramp_period: float = 3600.0) -> Environment:
    """Return a room at about 25 degC (Sudsanguan 2019, 5.1) in which the unit warms up by a few degrees."""
    return Environment(
        ambient=25.0 + rng.uniform(-1.0, 1.0),
        warm_up=rng.uniform(3.0, 6.0),
        warm_up_time=rng.uniform(200.0, 400.0),
        drift=0.3,  # of an air-conditioned room
        periods=rng.uniform(1800.0, 7200.0, 2),
        phases=rng.uniform(0.0, 2.0 * np.pi, 2),
        ramp=ramp,
        ramp_period=ramp_period,
    )


@dataclass(frozen=True)
class Bench:
    """Where a recording is made: table, what it does otherwise than commanded, and the sensors as mounted there."""

    table: Mapping[str, Any]
    imperfections: Mapping[str, Any]
    sensors: Mapping[str, SimulatedSensor]


def record(
    planned: Sequence[Planned],
    benches: Mapping[str, Bench],
    effects: Mapping[str, Hidden],
    *,
    environment: Environment,
    unit: UnitDescription,
    pause: float,
    streams: Streams,
) -> list[Recording]:
    """Make the recordings of a unit, of which the sampling interval and the share of lost samples count.

    ``benches``: role to bench, ``""`` for all roles that are not named; ``effects``: sensor to its effects, of which
    those of mounting, table and timing change the motion; ``pause``: s, between the recordings and before the first.
    """
    times = _times(planned, unit.interval_s, pause)
    seconds = [t / NANOSECONDS for t in times]
    rng = {name: streams[name] for name in ("table", "temperature", "link", *SENSORS)}
    first = benches.get(planned[0].role, benches[""]).sensors
    wander = {s: bias_wander(seconds, first[s].sheet["wander_time_s"], rng[s]) for s in SENSORS}
    out = []
    for k, (plan, time) in enumerate(zip(planned, seconds, strict=True)):
        bench = benches.get(plan.role, benches[""])
        scene = _scene(plan, bench, time[0], rng["table"])
        temperature = environment.temperature(time)
        plain = scene.motion(time, temperature)
        readings: dict[str, Any] = {}
        for s in SENSORS:
            sensor, altered = bench.sensors[s], alter(scene, {name: values for name, (_, values) in effects[s].items()})
            motion = plain if altered is scene else altered.motion(time, temperature)
            white = sensor.white(unit.interval_s) * rng[s].standard_normal((len(time), 3))
            reading = sensor.exact(motion) + white + sensor.sheet["bias_wander"] * wander[s][k]
            readings[s] = _rounded(sensor.quantised(reading), decimals_of(sensor.sheet))
        whole = Recording(
            plan.name,
            plan.role,
            None if plan.axis is None else AXES[plan.axis],
            times[k],
            temperature=_rounded(environment.reading(time, rng["temperature"]), TEMPERATURE_DECIMALS),
            **readings,
            **_log(plan, bench, time - time[0]),
        )
        out.append(whole.select(received(len(time), unit.lost, rng["link"])) if unit.lost else whole)
    return out


def _times(planned: Sequence[Planned], interval: float, pause: float) -> list[NDArray[np.int64]]:
    """Return the sample times: whole intervals since power-on, ns."""
    step = round(interval * NANOSECONDS)
    out, now = [], pause
    for plan in planned:
        first = int(np.ceil(now / interval - 1e-9))
        count = int(plan.trajectory.duration / interval + 1e-9) + 1
        out.append((first + np.arange(count, dtype=np.int64)) * step)
        now = float(out[-1][-1]) / NANOSECONDS + pause
    return out


def _scene(plan: Planned, bench: Bench, start: float, rng: np.random.Generator) -> Scene:
    """Return the scene of a recording on its bench, without hidden effects."""
    table, settings = bench.table, dict(bench.imperfections)
    trajectory = plan.trajectory
    if isinstance(trajectory, Turn) and table["motion"] != "none":
        if plan.role == "accelerometer" and _stops_and_goes(trajectory):
            settings["rate_error"] = (0.0, 0.0, 0.0)  # motors lose steps in fast turns only
        errors = random_errors(trajectory.program, rng, settings, trajectory.axis)
        shaft = settings.get("sense", 1) if table.get("azimuth_of") == "turn_axis" else 0
        trajectory = Turn(trajectory.axis, trajectory.program, errors, shaft)
    up = rotation_by(np.append(np.asarray(settings.get("tilt_deg", (0.0, 0.0)), float), 0.0))[2]
    placed = table["latitude_deg"] is not None and table["azimuth_deg"] is not None
    earth = earth_rate(table["latitude_deg"], table["azimuth_deg"]) if placed else None
    mounting = rotation_by(np.asarray(settings.get("mounting_deg", {}).get(plan.name, np.zeros(3)), float))
    return Scene(trajectory, start, plan.axis, table["gravity_g"], up, earth, mounting=mounting)


def _stops_and_goes(turn: Turn) -> bool:
    return bool(np.all(np.abs(np.diff(turn.program.stops)) < 180.0))


def _log(plan: Planned, bench: Bench, time: Values) -> dict[str, Any]:
    """Return what the table logs: the commanded motion."""
    trajectory = plan.trajectory
    if bench.table["motion"] == "none":
        return {}
    if isinstance(trajectory, Turn):
        angle, rate = trajectory.program.at(time)[:2]
        sense = bench.imperfections.get("sense", 1)
        angle, rate = sense * angle + bench.imperfections.get("zero_deg", {}).get(plan.name, 0.0), sense * rate
        return {"table_angle": _rounded(angle, ANGLE_DECIMALS), "table_rate": _rounded(rate, ANGLE_DECIMALS)}
    if isinstance(trajectory, Gimbals):
        rate = np.linalg.norm(trajectory.pose(time).omega, axis=1)
        attitude = _rounded(trajectory.quaternion(time), QUATERNION_DECIMALS)
        return {"table_attitude": attitude, "table_rate": _rounded(rate, ANGLE_DECIMALS)}
    assert isinstance(trajectory, Moves)  # noqa: S101
    return {"table_rate": np.zeros(len(time))} if plan.role == "static" else {}


def received(count: int, lost: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return which samples the radio link delivers, all but a share of ``lost``; the first and the last always."""
    kept = rng.random(count) >= lost
    kept[[0, -1]] = True
    return kept


def _rounded(values: Values, decimals: int) -> Values:
    """Return what a reader of the printed values finds."""
    rounded: Values = np.rint(values * 10.0**decimals) / 10.0**decimals
    return rounded
