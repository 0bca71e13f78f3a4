"""The table's log: in the sensor's rows, in a file with a clock of its own, or only the commanded program.

    tau = t + d + k t

where

t, tau : the sensor's and the table's clock, s
d, k   : offset and drift of the table's clock, s and 1

A file has the sampling interval of the table's computer. For a table without encoders only the program is known: it is
written as a procedure of its own.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from pipeline.errors import ConfigurationError
from pipeline.records import Recording, continuous
from pipeline.simulation.description import FILE, PROGRAM, course_of, read_config
from pipeline.simulation.procedures import ONE_RECORDING, plan
from pipeline.simulation.trajectory import Turn

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.records import Values
    from pipeline.simulation.description import UnitDescription
    from pipeline.simulation.procedures import Course
    from pipeline.simulation.rate_table import Program
    from pipeline.simulation.trajectory import Planned


MARGIN_S = 2.0  # by which a log of its own begins earlier and ends later than the recording
LARGEST_OFFSET_S, DRIFT_PPM = 100.0, 50.0  # of a clock at random: the drift is a standard deviation, that of a quartz
NANOSECONDS = 1_000_000_000  # in a second
NO_TABLE: dict[str, Any] = {"table_angle": None, "table_rate": None, "table_attitude": None}
INGEST = "table_log"  # configs/ingest that reads a log of its own
COMMENT = "# The table has no encoders: its program in place of its log. Written by python -m pipeline simulate.\n"


def with_table_log(
    unit: UnitDescription, planned: Sequence[Planned], recordings: list[Recording], rng: np.random.Generator
) -> tuple[list[Recording], dict[str, float] | None]:
    """Return recordings as they are laid out, and the clock of a table's log of its own.

    Logs of their own follow the recordings, each named after the one that it belongs to.
    """
    log = unit.log
    starts = [float(r.time[0]) for r in recordings]
    if unit.procedure == ONE_RECORDING:
        groups = [(_joined(recordings, planned, starts, wrapped=log.wrapped), planned, starts)]
    else:
        groups = [(r, [p], [s]) for r, p, s in zip(recordings, planned, starts, strict=True)]
    whole = [_wrapped(r) if log.wrapped else r for r, _, _ in groups]
    if log.kind == PROGRAM:
        return [replace(r, **NO_TABLE) if r.axis is not None else r for r in whole], None
    if log.kind != FILE:
        return whole, None
    offset, ppm = rng.uniform(0.0, LARGEST_OFFSET_S), DRIFT_PPM * rng.standard_normal()
    offset = float(offset if log.offset_s is None else log.offset_s)
    drift = 1e-6 * float(ppm if log.drift_ppm is None else log.drift_ppm)
    logs = []
    for recording, own, begins in groups:
        last = begins[-1] + own[-1].trajectory.duration
        begin, end = (t + offset + drift * t for t in (begins[0] - MARGIN_S, last + MARGIN_S))
        tau: Values = begin + log.interval_s * np.arange(int((end - begin) / log.interval_s), dtype=float)
        channels: dict[str, Any] = _logged(own, begins, (tau - offset) / (1.0 + drift), wrapped=log.wrapped)
        if unit.procedure != ONE_RECORDING:  # of a turn the encoder, else the attitude
            turn = isinstance(own[0].trajectory, Turn)
            known = ("table_angle", "table_rate") if turn else ("table_attitude",)
            channels = {name: channels[name] for name in known}
        time_ns = np.rint(tau * NANOSECONDS).astype(np.int64)
        logs.append(Recording(f"{recording.name}_table", "table", None, time_ns, **channels))
    return [*(replace(r, **NO_TABLE) for r in whole), *logs], {"offset_s": offset, "drift_ppm": 1e6 * drift}


def _wrapped(recording: Recording) -> Recording:
    angle = recording.table_angle
    return recording if angle is None else replace(recording, table_angle=np.mod(angle, 360.0))


def _joined(
    recordings: Sequence[Recording], planned: Sequence[Planned], starts: Sequence[float], *, wrapped: bool
) -> Recording:
    """Return recordings that follow each other as one, with the table's angle, rate and attitude throughout."""
    blocks: dict[str, Any] = {
        name: np.concatenate([getattr(r, name) for r in recordings])
        for name in ("time_ns", "accelerometer", "gyroscope", "temperature")
    }
    whole = replace(recordings[0], name="recording", role="session", axis=None, **blocks, **NO_TABLE)
    table: dict[str, Any] = _logged(planned, starts, whole.time, wrapped=wrapped)
    return replace(whole, **table)


def _logged(planned: Sequence[Planned], starts: Sequence[float], time: Values, *, wrapped: bool) -> dict[str, Values]:
    """Return angle, rate and attitude of a table at increasing times of a session, in which ``planned`` start."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415  (few simulations need it)

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
    attitude = continuous(np.roll(Rotation.from_matrix(level).as_quat(), 1, axis=1))
    return {"table_angle": angle % 360.0 if wrapped else angle, "table_rate": rate, "table_attitude": attitude}


def as_program(program: Program) -> list[dict[str, Any]]:
    """Return a table's program as the steps of a procedure's ``program``: rests and turns, repeated ones together."""
    steps: list[dict[str, Any]] = []
    time = 0.0
    for ramp in np.flatnonzero((program.rate == 0) & (program.acceleration != 0)).tolist():
        hold, end = ramp + 1, ramp + 3
        if program.knots[ramp] > time + 1e-9:
            steps.append({"rest_s": round(float(program.knots[ramp] - time), 9)})
        turn = float(program.angle[end] - program.angle[ramp])
        steps.append({
            "turn_deg": round(turn, 9),
            "rate_dps": round(abs(float(program.rate[hold])), 9),
            "acceleration_dps2": round(abs(float(program.acceleration[ramp])), 9),
        })  # fmt: skip
        time = float(program.knots[end])
    steps.append({"rest_s": round(float(program.duration - time), 9)})
    return _folded(steps)


def _folded(steps: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return steps with a pair that repeats itself written once."""
    out: list[dict[str, Any]] = []
    i = 0
    while i < len(steps):
        pair, count = steps[i : i + 2], 1
        while len(pair) == 2 and steps[i + 2 * count : i + 2 * count + 2] == pair:
            count += 1
        if count > 2:
            out.append({"repeat": count, "steps": pair})
            i += 2 * count
        else:
            out.append(steps[i])
            i += 1
    return out


def columns_of(unit: UnitDescription) -> dict[str, str]:
    """Return the columns of ``units.csv`` that the layout asks for."""
    if unit.log.kind == FILE:
        return {"ingest": INGEST}
    return {"procedure": _commanded(unit)} if unit.log.kind == PROGRAM else {}


def _commanded(unit: UnitDescription) -> str:
    return f"{unit.procedure}_commanded"


def programs_of(units: Sequence[UnitDescription]) -> dict[str, str]:
    """Return the procedures of tables that log nothing, each with its program: name to YAML.

    Raises
    ------
    ConfigurationError
        If units of one procedure follow different programs.
    """
    found: dict[str, str] = {}
    for unit in units:
        if unit.log.kind == PROGRAM:
            text = _procedure_text(unit.procedure, course_of(unit))
            if found.setdefault(_commanded(unit), text) != text:
                raise ConfigurationError(
                    f"unit {unit.unit}: its table follows another program than those of the units before; simulate it "
                    "as a campaign of its own"
                )
    return found


def _procedure_text(name: str, course: Course) -> str:
    procedure = read_config("procedure", name)
    entries = {recording: dict(entry) for recording, entry in procedure["recordings"].items()}
    for planned in plan(name, course, np.random.default_rng(0)):
        if isinstance(planned.trajectory, Turn) and planned.name in entries:
            entries[planned.name]["program"] = as_program(planned.trajectory.program)
    return COMMENT + yaml.safe_dump({**procedure, "recordings": entries}, sort_keys=False, width=120)
