"""How recordings are laid out in files: the table's log in the rows, beside them or not at all; all in one file."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from pipeline.errors import ConfigurationError
from pipeline.simulation.description import read_config
from pipeline.simulation.one_session import joined
from pipeline.simulation.procedures import ONE_RECORDING, plan
from pipeline.simulation.table_logs import as_program, clock_of, own_log, table_log_of
from pipeline.simulation.trajectory import Turn

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.records import Recording
    from pipeline.simulation.description import UnitDescription
    from pipeline.simulation.planned import Planned
    from pipeline.simulation.procedures import Course

FILE, PROGRAM = "file", "program"
INGEST = "table_log"
NO_TABLE: dict[str, Any] = {"table_angle": None, "table_rate": None, "table_attitude": None}


def with_table_log(
    unit: UnitDescription, planned: Sequence[Planned], recordings: list[Recording], rng: np.random.Generator
) -> tuple[list[Recording], dict[str, float] | None]:
    """Return recordings as they are laid out, and the clock of a table's log of its own.

    Logs of their own follow the recordings, each named after the one that it belongs to.
    """
    log = table_log_of(unit.table_log)
    starts = [float(r.time[0]) for r in recordings]
    if unit.procedure == ONE_RECORDING:
        groups = [(joined(recordings, planned, wrapped=log.wrapped), planned, starts)]
    else:
        groups = [(r, [p], [s]) for r, p, s in zip(recordings, planned, starts, strict=True)]
    whole = [_wrapped(r) if log.wrapped else r for r, _, _ in groups]
    if log.kind == FILE:
        clock = clock_of(log, rng)
        logs = [own_log(f"{r.name}_table", p, s, log, clock) for r, p, s in groups]
        truth = {"offset_s": clock.offset_s, "drift_ppm": 1e6 * clock.drift}
        return [*(replace(r, **NO_TABLE) for r in whole), *logs], truth
    if log.kind == PROGRAM:
        return [replace(r, **NO_TABLE) if r.axis is not None else r for r in whole], None
    return whole, None


def _wrapped(recording: Recording) -> Recording:
    angle = recording.table_angle
    return recording if angle is None else replace(recording, table_angle=np.mod(angle, 360.0))


def columns_of(unit: UnitDescription) -> dict[str, str]:
    """Return the columns of ``units.csv`` that the layout asks for."""
    kind = table_log_of(unit.table_log).kind
    if kind == FILE:
        return {"ingest": INGEST}
    return {"procedure": _commanded(unit)} if kind == PROGRAM else {}


def _commanded(unit: UnitDescription) -> str:
    return f"{unit.procedure}_commanded"


def programs_of(units: Sequence[UnitDescription], courses: Sequence[Course]) -> dict[str, str]:
    """Return the procedures of tables that log nothing, each with its program: name to YAML.

    Parameters
    ----------
    units : sequence of UnitDescription
    courses : sequence of Course
        Of each unit.

    Raises
    ------
    ConfigurationError
        If units of one procedure follow different programs.
    """
    found: dict[str, str] = {}
    for unit, course in zip(units, courses, strict=True):
        if table_log_of(unit.table_log).kind == PROGRAM:
            text = _procedure_text(unit.procedure, course)
            if found.setdefault(_commanded(unit), text) != text:
                raise ConfigurationError(
                    f"unit {unit.unit}: its table follows another program than those of the units before; simulate it "
                    "as a campaign of its own"
                )
    return found


def _procedure_text(name: str, course: Course) -> str:
    procedure = read_config("procedure", name)
    programs = {
        p.name: as_program(p.trajectory.program)
        for p in plan(name, course, np.random.default_rng(0))
        if isinstance(p.trajectory, Turn)
    }
    entries: dict[str, Any] = {
        recording: {**entry, **({"program": programs[recording]} if recording in programs else {})}
        for recording, entry in procedure["recordings"].items()
    }
    comment = "# The table has no encoders: its program in place of its log. Written by python -m pipeline simulate.\n"
    return comment + yaml.safe_dump({**procedure, "recordings": entries}, sort_keys=False, width=120)
