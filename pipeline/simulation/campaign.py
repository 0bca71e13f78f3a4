"""Simulate a campaign: the session of each unit on one clock since power-on, with the table's log, in files.

Every stream of random numbers has a separate generator, ``default_rng([seed, unit, stream])``, so that a change in one
(say, lost samples) does not change the others.

The table's log is in the sensor's rows, or in a file with the interval and the clock of the table's computer,

    tau = t + d + k t,    t, tau : the sensor's and the table's clock, s,    d, k : offset and drift, s and 1

For a table without encoders its program is written instead, as a separate procedure.

    <directory>/units.csv, campaign.yaml, simulation.yaml
    <directory>/raw/<unit>/<recording>.csv (or .mcap)
    <directory>/truth/<unit>.json     bias, matrix, effects and noise of each sensor

``truth`` is for tests and for the reader; no stage reads it.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import scipy
import yaml
from numpy.typing import NDArray

from imu_logs.units import SECOND_NS
from pipeline.core.errors import ConfigurationError
from pipeline.core.records import AXES, SENSORS, Recording, Values, continuous
from pipeline.core.settings import ProgramRest, ProgramTurn, Repeated, Sensor, Table
from pipeline.ingest.arrow import write_recording
from pipeline.ingest.clock_alignment import Program
from pipeline.ingest.recordings_sheet import COLUMNS, SHEET
from pipeline.physics.kinematics import earth_of
from pipeline.simulation.description import (
    BY_FILE,
    BY_PROGRAM,
    ONE_RECORDING,
    Course,
    Description,
    UnitDescription,
    course_of,
    plan,
    read_option,
    shipped_settings,
)
from pipeline.simulation.sensor import (
    Hidden,
    Scene,
    SimulatedSensor,
    alter,
    bias_wander,
    decimals_of,
    drawn_effects,
    drawn_sensors,
)
from pipeline.simulation.trajectory import (
    CommandedTurns,
    Gimbals,
    Planned,
    directions_of_shaft,
    random_errors,
    rotation_by,
)

STREAMS = ("unit", "effects", "motion", "table", "accelerometer", "gyroscope", "temperature", "link", "bench", "room")
ANGLE_DECIMALS, QUATERNION_DECIMALS, TEMPERATURE_DECIMALS = 6, 9, 3  # of CSV files: rounding far below any noise
MARGIN_S = 2.0  # by which a separate log begins earlier and ends later than the recording
LARGEST_OFFSET_S, DRIFT_PPM = 100.0, 50.0  # of a random clock; the drift is the standard deviation of quartz clocks
NO_TABLE: dict[str, Any] = {"table_angle": None, "table_rate": None, "table_attitude": None}
SHEET_FILE = f"{SHEET}.csv"
INGEST = "table_log"  # configs/ingest that reads a separate log
COMMENT = "# The table has no encoders: its program instead of its log. Written by python -m pipeline simulate.\n"
UNITS_CSV_COLUMNS = (
    "unit", "serial", "lot", "date", "sensor", "table", "procedure", "method", "ingest", "filter", "overrides",
)  # fmt: skip
CAMPAIGN_YAML = "# Hydra overrides for all units of this campaign.\noverrides: [{}]\n"


class Streams:
    """The generators of random numbers for one unit, one for each stream."""

    def __init__(self, seed: int, unit: int) -> None:
        self._key = (seed, unit)

    def __getitem__(self, stream: str) -> np.random.Generator:
        return np.random.default_rng([*self._key, STREAMS.index(stream)])


@dataclass(frozen=True)
class Environment:
    """Temperature over time, in degC, s and rad; ``noise``: of the thermometer.

        T(t) = ambient + warm_up (1 - exp(-t / warm_up_time)) + drift sum_k sin(2 pi t / p_k + phase_k) / 2 + ramp(t)

    where p_k are the two ``periods`` of the room, half an hour to two hours, and ``ramp(t)`` is the triangle of a
    thermal chamber: up, down below the room, and back; without end, or once in each of the ``soaks``.
    """

    ambient: float
    warm_up: float
    warm_up_time: float
    drift: float
    periods: Values
    phases: Values
    ramp: float = 0.0
    ramp_period: float = 3600.0
    soaks: tuple[tuple[float, float], ...] = ()  # s, start and end of each
    noise: float = 0.03

    def temperature(self, time: Values) -> Values:
        """Return the true temperature: (n,) array, degC; time in s since power-on."""
        room = np.sin(2.0 * np.pi * time[:, None] / self.periods + self.phases).sum(1) / 2.0
        phase = np.zeros(len(time)) if self.soaks else time / self.ramp_period
        for start, end in self.soaks:
            phase = phase + np.clip((time - start) / (end - start), 0.0, 1.0)
        triangle = 2.0 / np.pi * np.arcsin(np.sin(2.0 * np.pi * phase))
        warm = self.warm_up * (1.0 - np.exp(-time / self.warm_up_time))
        return np.asarray(self.ambient + warm + self.drift * room + self.ramp * triangle)

    def reading(self, time: Values, rng: np.random.Generator) -> Values:
        """Return the thermometer's reading: (n,) array, degC."""
        return self.temperature(time) + self.noise * rng.standard_normal(len(time))


def random_environment(rng: np.random.Generator) -> Environment:
    """Return a room at about 25 degC (Sudsanguan 2019, 5.1) in which the unit warms up by a few degrees."""
    ambient, warm_up, warm_up_time = 25.0 + rng.uniform(-1.0, 1.0), rng.uniform(3.0, 6.0), rng.uniform(200.0, 400.0)
    periods, phases = rng.uniform(1800.0, 7200.0, 2), rng.uniform(0.0, 2.0 * np.pi, 2)
    drift = 0.3  # of an air-conditioned room
    return Environment(ambient, warm_up=warm_up, warm_up_time=warm_up_time, drift=drift, periods=periods, phases=phases)


@dataclass(frozen=True)
class SimulatedBench:
    """Where a recording is made: the table, its errors, and the sensors as mounted on it."""

    table: Table
    imperfections: Mapping[str, Any]
    sensors: Mapping[str, SimulatedSensor]


def record(
    planned: Sequence[Planned],
    benches: Mapping[str, SimulatedBench],
    effects: Mapping[str, Hidden],
    *,
    environment: Environment,
    unit: UnitDescription,
    pause: float,
    streams: Streams,
) -> list[Recording]:
    """Simulate the recordings of a unit with its sampling interval and share of lost samples.

    ``benches``: by role, ``""`` for all others; ``effects``: by sensor, those of mounting, table and timing change the
    motion; ``pause``: s, between the recordings and before the first.
    """
    times = _times(planned, unit.interval_s, pause)
    seconds = [t / SECOND_NS for t in times]
    rng = {name: streams[name] for name in ("table", "temperature", "link", *SENSORS)}
    first = benches.get(planned[0].role, benches[""]).sensors
    wander = {s: bias_wander(seconds, first[s].data_sheet.wander_time_s, rng[s]) for s in SENSORS}
    out = []
    for k, (recording, time) in enumerate(zip(planned, seconds, strict=True)):
        bench = benches.get(recording.role, benches[""])
        scene = _scene(recording, bench, time[0], rng["table"])
        temperature = environment.temperature(time)
        plain = scene.motion(time, temperature)
        readings: dict[str, Any] = {}
        for s in SENSORS:
            sensor, altered = bench.sensors[s], alter(scene, {name: values for name, (_, values) in effects[s].items()})
            motion = plain if altered is scene else altered.motion(time, temperature)
            white = sensor.data_sheet.white(unit.interval_s) * rng[s].standard_normal((len(time), 3))
            reading = sensor.exact(motion) + white + sensor.data_sheet.bias_wander * wander[s][k]
            readings[s] = np.round(sensor.quantised(reading), decimals_of(sensor.data_sheet))
        whole = Recording(
            recording.name,
            recording.role,
            None if recording.axis is None else AXES[recording.axis],
            times[k],
            temperature=np.round(environment.reading(time, rng["temperature"]), TEMPERATURE_DECIMALS),
            kind=recording.kind,
            **readings,
            **_log(recording, bench, time - time[0]),
        )
        out.append(whole.select(received(len(time), unit.lost, rng["link"])) if unit.lost else whole)
    return out


def _times(planned: Sequence[Planned], interval: float, pause: float) -> list[NDArray[np.int64]]:
    """Return the sample times: whole intervals since power-on, ns."""
    step = round(interval * SECOND_NS)
    out, now = [], pause
    for recording in planned:
        first = int(np.ceil(now / interval - 1e-9))
        count = int(recording.trajectory.duration / interval + 1e-9) + 1
        out.append((first + np.arange(count, dtype=np.int64)) * step)
        now = float(out[-1][-1]) / SECOND_NS + pause
    return out


def _scene(plan: Planned, bench: SimulatedBench, start: float, rng: np.random.Generator) -> Scene:
    """Return the scene of a recording on its bench, without hidden effects."""
    table, settings = bench.table, dict(bench.imperfections)
    trajectory = plan.trajectory
    if isinstance(trajectory, CommandedTurns) and table.motion != "none":
        stops_and_goes = np.all(np.abs(np.diff(trajectory.program.stops)) < 180.0)
        if plan.role == "accelerometer" and stops_and_goes:
            settings["rate_error"] = (0.0, 0.0, 0.0)  # motors lose steps in fast turns only
        errors = random_errors(trajectory.program, rng, settings, trajectory.axis)
        shaft = settings.get("sense", 1) if table.azimuth_of == "turn_axis" else 0
        trajectory = CommandedTurns(trajectory.axis, trajectory.program, errors, shaft)
    up = rotation_by(np.append(np.asarray(settings.get("tilt_deg", (0.0, 0.0)), float), 0.0))[2]
    earth = earth_of(table)
    mounting = rotation_by(np.asarray(settings.get("mounting_deg", {}).get(plan.name, np.zeros(3)), float))
    turning = np.zeros(3) if earth is None else earth
    return Scene(trajectory, start, plan.axis, table.gravity_g, up, turning, mounting=mounting)


def _log(plan: Planned, bench: SimulatedBench, time: Values) -> dict[str, Any]:
    trajectory = plan.trajectory
    if bench.table.motion == "none":
        return {}
    if isinstance(trajectory, CommandedTurns):
        angle, rate = trajectory.program.at(time)[:2]
        sense = bench.imperfections.get("sense", 1)
        angle, rate = sense * angle + bench.imperfections.get("zero_deg", {}).get(plan.name, 0.0), sense * rate
        return {"table_angle": np.round(angle, ANGLE_DECIMALS), "table_rate": np.round(rate, ANGLE_DECIMALS)}
    if isinstance(trajectory, Gimbals):
        rate = np.linalg.norm(trajectory.pose(time).omega, axis=1)
        attitude = np.round(trajectory.quaternion(time), QUATERNION_DECIMALS)
        return {"table_attitude": attitude, "table_rate": np.round(rate, ANGLE_DECIMALS)}
    return {"table_rate": np.zeros(len(time))} if plan.role == "static" else {}


def received(count: int, lost: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Draw which samples the radio link delivers: all but a share ``lost``; always the first and the last."""
    kept = rng.random(count) >= lost
    kept[[0, -1]] = True
    return kept


def with_table_log(
    unit: UnitDescription, planned: Sequence[Planned], recordings: list[Recording], rng: np.random.Generator
) -> tuple[list[Recording], dict[str, float] | None]:
    """Arrange recordings and the table's log as the unit's ``TableLog`` states; return the clock of a separate log.

    Separate logs follow the recordings, each with the name of its recording.
    """
    log = unit.log
    starts = [float(r.time[0]) for r in recordings]
    if unit.procedure == ONE_RECORDING:
        groups = [(_joined(recordings, planned, starts), planned, starts)]
    else:
        groups = [(r, [p], [s]) for r, p, s in zip(recordings, planned, starts, strict=True)]
    whole = [recording for recording, _, _ in groups]
    if log.kind == BY_PROGRAM:
        return [replace(r, **NO_TABLE) if r.axis is not None else r for r in whole], None
    if log.kind != BY_FILE:
        return [_wrapped(r) if log.wrapped else r for r in whole], None
    offset, ppm = rng.uniform(0.0, LARGEST_OFFSET_S), DRIFT_PPM * rng.standard_normal()
    offset = float(offset if log.offset_s is None else log.offset_s)
    drift = 1e-6 * float(ppm if log.drift_ppm is None else log.drift_ppm)
    logs = []
    for recording, plans, plan_starts in groups:
        last = plan_starts[-1] + plans[-1].trajectory.duration
        begin, end = (t + offset + drift * t for t in (plan_starts[0] - MARGIN_S, last + MARGIN_S))
        tau: Values = begin + log.interval_s * np.arange(int((end - begin) / log.interval_s), dtype=float)
        channels: dict[str, Any] = _logged(plans, plan_starts, (tau - offset) / (1.0 + drift))
        if unit.procedure != ONE_RECORDING:  # a turn has the encoder, other motion the attitude
            turn = isinstance(plans[0].trajectory, CommandedTurns)
            known = ("table_angle", "table_rate") if turn else ("table_attitude",)
            channels = {name: channels[name] for name in known}
        time_ns = np.rint(tau * SECOND_NS).astype(np.int64)
        logged = Recording(f"{recording.name}_table", "table", None, time_ns, **channels)
        logs.append(_wrapped(logged) if log.wrapped else logged)
    return [*(replace(r, **NO_TABLE) for r in whole), *logs], {"offset_s": offset, "drift_ppm": 1e6 * drift}


def _wrapped(recording: Recording) -> Recording:
    angle = recording.table_angle
    return recording if angle is None else replace(recording, table_angle=np.mod(angle, 360.0))


def _joined(recordings: Sequence[Recording], planned: Sequence[Planned], starts: Sequence[float]) -> Recording:
    """Join successive recordings to one, with the table's angle, rate and attitude throughout."""
    channels = ("time_ns", "accelerometer", "gyroscope", "temperature")
    blocks: dict[str, Any] = {name: np.concatenate([getattr(r, name) for r in recordings]) for name in channels}
    whole = replace(recordings[0], name="recording", role="session", axis=None, **blocks, **NO_TABLE)
    table: dict[str, Any] = _logged(planned, starts, whole.time)
    return replace(whole, **table)


def _logged(planned: Sequence[Planned], starts: Sequence[float], time: Values) -> dict[str, Values]:
    """Return angle, rate and attitude of a table at increasing times of a session, in which ``planned`` start."""
    angle, rate, level = np.zeros(len(time)), np.zeros(len(time)), np.zeros((len(time), 3, 3))
    which = np.clip(np.searchsorted(starts, time, side="right") - 1, 0, None)
    last = 0.0
    for k in np.unique(which):
        here = which == k
        pose = planned[k].trajectory.pose(time[here] - starts[k])
        angle[here] = last if pose.angle is None else pose.angle
        rate[here] = np.linalg.norm(pose.omega, axis=1) if pose.rate is None else pose.rate
        level[here] = pose.level
        last = float(angle[here][-1])
    attitude = continuous(np.roll(scipy.spatial.transform.Rotation.from_matrix(level).as_quat(), 1, axis=1))
    return {"table_angle": angle, "table_rate": rate, "table_attitude": attitude}


def as_program(program: Program) -> list[ProgramRest | ProgramTurn | Repeated]:
    """Return a table's program as the steps of a procedure's ``program``; a repeated pair of steps has a count."""
    rounded = [step.replaced(**{k: round(v, 9) for k, v in step.json_value.items()}) for step in program.steps]
    steps = [step for step in rounded if not (isinstance(step, ProgramRest) and step.rest_s == 0.0)]
    out: list[ProgramRest | ProgramTurn | Repeated] = []
    i = 0
    while i < len(steps):
        pair, count = steps[i : i + 2], 1
        while len(pair) == 2 and steps[i + 2 * count : i + 2 * count + 2] == pair:
            count += 1
        if count > 2:
            out.append(Repeated(repeat=count, steps=pair))
            i += 2 * count
        else:
            out.append(steps[i])
            i += 1
    return out


def columns_of(unit: UnitDescription) -> dict[str, str]:
    """Return the columns of ``units.csv`` that the unit's table log requires."""
    columns = {BY_FILE: {"ingest": INGEST}, BY_PROGRAM: {"procedure": f"{unit.procedure}_commanded"}}
    return columns.get(unit.log.kind, {})


def programs_of(units: Sequence[UnitDescription]) -> dict[str, str]:
    """Return the procedures of tables without a log, name to YAML; refuse units of one with different programs."""
    found: dict[str, str] = {}
    for unit in units:
        if unit.log.kind == BY_PROGRAM:
            text = _procedure_text(unit.procedure, course_of(unit))
            if found.setdefault(columns_of(unit)["procedure"], text) != text:
                problem = f"unit {unit.unit}: its table follows another program than those of the units before"
                raise ConfigurationError(f"{problem}; simulate it as a separate campaign")
    return found


def _procedure_text(name: str, course: Course) -> str:
    procedure = read_option("procedure", name)
    entries = {recording: dict(entry) for recording, entry in procedure["recordings"].items()}
    for planned in plan(name, course, np.random.default_rng(0)):
        if isinstance(planned.trajectory, CommandedTurns) and planned.name in entries:
            entries[planned.name]["program"] = [s.json_value for s in as_program(planned.trajectory.program)]
    return COMMENT + yaml.safe_dump({**procedure, "recordings": entries}, sort_keys=False, width=120)


def write_campaign(
    description: Description,
    directory: Path,
    progress: Callable[[str], None] = lambda _: None,
    *,
    sheet_only: bool = False,
) -> None:
    """Simulate every unit of a description and write the campaign; files of the same names are replaced.

    ``progress`` gets a line for each unit. ``sheet_only``: no recordings and truth, which the campaign's run makes.
    """
    for name, text in programs_of(description.units).items():
        path = directory / "configs" / "procedure" / f"{name}.yaml"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    names = [unit.unit for unit in description.units]
    for unit in () if sheet_only else description.units:
        if (unit.copy_of or unit.unit) not in names:
            raise ConfigurationError(f"unit {unit.unit}: copy_of names {unit.copy_of}, which is not among the units")
        origin = names.index(unit.copy_of or unit.unit)
        original = replace(description.units[origin], table_log=unit.table_log)
        recordings, truth = simulate_unit(original, description.seed, origin)
        sensor_model = shipped_settings(sensor=unit.sensor).sensor
        folder = directory / "raw" / unit.unit
        folder.mkdir(parents=True, exist_ok=True)
        for recording in recordings:
            _write_recording(folder, recording, unit.format, sensor_model)
        if sheet := sheet_of(unit):
            (folder / SHEET_FILE).write_text(sheet, encoding="utf-8")
        path = directory / "truth" / f"{unit.unit}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({**truth, "unit": unit.unit}, indent=1) + "\n", encoding="utf-8")
        progress(f"{unit.unit}: {sum(r.samples for r in recordings)} samples in {len(recordings)} recordings")
    table = pd.DataFrame(_sheet_rows(description), dtype=object)
    columns = [*(c for c in UNITS_CSV_COLUMNS if c in table), *(c for c in table if c not in UNITS_CSV_COLUMNS)]
    text = table.to_csv(columns=columns, index=False, lineterminator="\n")
    (directory / "units.csv").write_text(text, encoding="utf-8")
    if not (directory / "campaign.yaml").exists():
        moves = all(unit.procedure == "multi_position" for unit in description.units)
        overrides = "method=rests_and_moves" if moves else ""  # as ``new`` writes it: the moves calibrate the gyroscope
        (directory / "campaign.yaml").write_text(CAMPAIGN_YAML.format(overrides), encoding="utf-8")


def _sheet_rows(description: Description) -> list[dict[str, Any]]:
    """Return the rows of ``units.csv``: units, variants with the recordings of a unit, further rows."""
    keys = ("unit", "sensor", "table", "procedure")
    units = description.units
    rows: list[dict[str, Any]] = [{k: getattr(u, k) for k in keys} | columns_of(u) | u.columns for u in units]
    variants = []
    for variant, row in product(description.variants or (), rows):
        changed = {**row, **variant.columns, "unit": f"{row['unit']}{variant.suffix}"}
        overrides = [changed.get("overrides"), f"procedure.folder=raw/{row['unit']}"]
        variants.append(changed | {"overrides": "; ".join(o for o in overrides if o)})
    return rows + variants + list(description.rows or ())


def simulate_unit(
    unit: UnitDescription, seed: int, number: int, extra: Sequence[Planned] = ()
) -> tuple[list[Recording], dict[str, Any]]:
    """Return the recordings of one unit, those of ``extra`` after those of its procedure, and its true parameters.

    The seed and the unit's number in its campaign determine every random number.
    """
    streams, course = Streams(seed, number), course_of(unit)
    benches, effects = _drawn(unit, streams)
    by_hand = benches[""].table.angle_accuracy_deg if benches[""].table.motion == "none" else 0.0
    mover = streams["motion"] if unit.motion is None else Streams(seed, unit.motion)["motion"]
    planned = [*_selected(unit, plan(unit.procedure, course, mover, by_hand)), *extra]
    total = sum(p.trajectory.duration + course.pause_s for p in planned)
    pause = unit.interval_s if unit.procedure == ONE_RECORDING else course.pause_s
    times = zip(planned, _times(planned, unit.interval_s, pause), strict=True)
    soaks = tuple((t[0] / SECOND_NS, t[-1] / SECOND_NS) for p, t in times if p.kind == "soak")
    ramp = course.thermal_ramp_degc if soaks or unit.procedure == "thermal_ramp" else 0.0
    of_ramp = {"ramp": ramp, "ramp_period": total / 1.5, "soaks": soaks}
    environment = replace(random_environment(streams["room"]), **{**of_ramp, **unit.temperature})
    truth = true_parameters(unit, seed, number)
    made = record(planned, benches, effects, environment=environment, unit=unit, pause=pause, streams=streams)
    recordings, clock = with_table_log(unit, planned, made, streams["link"])
    return recordings, truth | ({"table_clock": clock} if clock else {})


def sheet_of(unit: UnitDescription) -> str:
    """Return the sheet of a unit's recordings, as CSV; empty where its procedure has none."""
    planned = _selected(unit, plan(unit.procedure, course_of(unit), np.random.default_rng(0)))
    rows = [f"{p.name}.{unit.format},{p.row}" for p in planned if p.row]
    return "\n".join([",".join(COLUMNS), *rows, ""]) if rows else ""


def true_parameters(unit: UnitDescription, seed: int, number: int) -> dict[str, Any]:
    """Return the true parameters of one unit, without its recordings."""
    benches, effects = _drawn(unit, Streams(seed, number))
    bench = benches[""]
    return {
        "seed": [seed, number],
        **{name: getattr(unit, name) for name in ("sensor", "table", "procedure", "interval_s", "lost")},
        **{s: _truth(bench.sensors[s], effects[s], unit.interval_s) for s in SENSORS},
        "imperfections": {k: np.asarray(v).tolist() for k, v in bench.imperfections.items()},
    }


def _drawn(unit: UnitDescription, streams: Streams) -> tuple[dict[str, SimulatedBench], dict[str, Hidden]]:
    """Return the bench of each recording (``""``: of all others), and the effects of each sensor."""
    sensor_model = shipped_settings(sensor=unit.sensor).sensor
    effects = drawn_effects(unit.effects, sensor_model, streams["effects"])

    def bench_of(other: Mapping[str, Any]) -> SimulatedBench:
        """Return the bench of the description, changed by ``other`` settings; with the same sensors."""
        table = shipped_settings(table=other.get("table", unit.table)).table
        rng, stated = streams["bench"], other.get("imperfections", {}) if other else unit.imperfections
        rate_error, off = rng.standard_normal(3), table.orthogonality_deg * rng.standard_normal((3, 2))
        one_shaft = table.azimuth_of == "turn_axis"
        imperfections = {
            "angle_accuracy_deg": table.angle_accuracy_deg,
            "rate_error": table.rate_accuracy * rate_error,
            "direction_deg": directions_of_shaft(off[0], stated.get("sense", 1)) if one_shaft else off,
            **stated,
        }
        given = {s: {**getattr(unit, s), **other.get(s, {})} for s in SENSORS}
        return SimulatedBench(table, imperfections, drawn_sensors(sensor_model, given, effects, streams["unit"]))

    held_out = dict.fromkeys(("validation", "static"), bench_of(unit.held_out)) if unit.held_out else {}
    return {"": bench_of({}), **held_out}, effects


def _selected(unit: UnitDescription, planned: list[Planned]) -> list[Planned]:
    unknown = set(unit.recordings) - {p.name for p in planned}
    if unknown:
        known = ", ".join(p.name for p in planned)
        raise ConfigurationError(
            f"unit {unit.unit}: recordings {', '.join(sorted(unknown))} are not made; made: {known}"
        )
    return [p for p in planned if not unit.recordings or p.name in unit.recordings]


def _write_recording(folder: Path, recording: Recording, kind: str, sensor_model: Sensor) -> None:
    """Write one recording as ``<name>.csv`` or ``<name>.mcap``, in the axes of the unit's body."""
    if kind == "mcap":
        write_recording(folder / f"{recording.name}.mcap", recording)
        return
    wanted = {f"accel_{a}_g": decimals_of(sensor_model.accelerometer) for a in AXES}
    wanted |= {f"gyro_{a}_dps": decimals_of(sensor_model.gyroscope) for a in AXES}
    wanted |= {"temperature_degc": TEMPERATURE_DECIMALS}
    wanted |= dict.fromkeys(("table_angle_deg", "table_rate_dps"), ANGLE_DECIMALS)
    wanted |= {f"table_q{c}": QUATERNION_DECIMALS for c in "wxyz"}
    write_recording(folder / f"{recording.name}.csv", recording, wanted)


def _truth(sensor: SimulatedSensor, effects: Hidden, interval: float) -> dict[str, Any]:
    defined = {name: kind.definition for name, (kind, _) in effects.items() if kind.definition}
    return {
        "bias": sensor.bias.tolist(),
        "matrix": sensor.matrix.tolist(),
        "effects": {
            name: {p.name: float(v) for p, v in zip(kind.parameters(sensor.sensor), values, strict=True)}
            for name, (kind, values) in effects.items()
        },
        **({"definitions": defined} if defined else {}),
        "noise": {
            "white": sensor.data_sheet.white(interval),
            "wander": sensor.data_sheet.bias_wander,
            "correlation_time": sensor.data_sheet.wander_time_s,
        },
    }
