"""How a bench is recorded, as the README of a new campaign: mounting, recordings, lengths, what they determine.

The recordings and their lengths are those of the simulated procedure; what they determine is that of its plan
(``pipeline.planning.plan``).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.estimation.rest_means import ROLE
from pipeline.model.kinematics import LEVEL_AT_ZERO
from pipeline.planning.plan import plan_of, share_text, size_text
from pipeline.records import AXES, SENSORS
from pipeline.signal.rests import SETTLING_S
from pipeline.simulation.description import course_of, read_config
from pipeline.simulation.procedures import FERRARIS, ONE_RECORDING, TRANSIT, plan

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pipeline.simulation.description import UnitDescription
    from pipeline.simulation.trajectory import Planned

COLUMNS = "time_s, accel_x_g, accel_y_g, accel_z_g, gyro_x_dps, gyro_y_dps, gyro_z_dps"
OPTIONAL = "temperature_degc, table_angle_deg, table_rate_dps, table_qw, table_qx, table_qy, table_qz"
BY_HAND = {
    "orientations_24": "24 rests: eight of them 45 deg apart about each axis",
    "six_positions": "six rests, each axis up and down",
    "multi_position": "rests in {positions} attitudes, as `guide` proposes them",
    FERRARIS: "rests on the six faces, then a turn by 360 deg and back about each axis, from rest to rest",
}


def readme(unit: UnitDescription, name: str) -> str:
    """Return the README of a campaign whose first unit is recorded so."""
    document, procedure = plan_of(unit), read_config("procedure", unit.procedure)
    planned = plan(unit.procedure, course_of(unit), np.random.default_rng(0))
    options = f"--sensor {unit.sensor} --table {unit.table} --procedure {unit.procedure}"
    text = RECORD.format(
        folder=procedure["folder"].replace("{unit}", unit.unit),
        minutes=document["minutes"],
        pause=course_of(unit).pause_s,
        columns=COLUMNS,
        optional=OPTIONAL,
    )
    lines = [f"# {name}: {unit.sensor} on {unit.table}, {unit.procedure}", "", *_mounting(unit), ""]
    lines += ["## Record", "", *_recordings(unit, procedure, planned), "", text]
    lines += ["## What the recordings determine", ""]
    for sensor in SENSORS:
        lines += [*_determined(sensor, document[sensor]), ""]
    lines += [PLANNED.format(options=options), "## What stays unseen", "", *_unseen(document), ""]
    return "\n".join(lines)


RECORD = """\
In `{folder}/`, {minutes:.0f} min from power-on; {pause:g} s between recordings. Record from power-on, or note how long
the unit had warmed up: its temperature is part of its bias. `.mcap` in place of `.csv` works for each, and so do the
formats of docs/formats.md.

Columns of a canonical CSV: {columns}, and optionally {optional}. Other columns, units and raw counts: `python -m
pipeline check FILE` proposes an ingest profile.
"""
PLANNED = """\
By the noise of the data sheet, for half of the units. `python -m pipeline plan {options}` also names the additional
recordings that help most.
"""


def _mounting(unit: UnitDescription) -> list[str]:
    """Return how the unit is mounted."""
    table = read_config("table", unit.table)
    if table["motion"] == "none":
        lines = [
            "Set the unit down, or hold it still against something firm. A rest counts where it lasts 4 s or more."
        ]
        if unit.procedure in {"multi_position", FERRARIS}:
            folder = read_config("procedure", unit.procedure)["folder"].replace("{unit}", unit.unit)
            command = f"`python -m pipeline guide {folder}/recording.csv --follow`"
            lines.append(
                f"While you record, {command}, run in this folder, proposes what comes next and says when it is"
            )
            lines.append("enough.")
        return ["## Set down", "", *lines]
    up = ", ".join(f"{_up(axis)} for turns about {name}" for axis, name in enumerate(AXES))
    lines = [f"At table angle 0 the body axis that points up is {up}. The angle counts right-handed about the body"]
    lines.append("axis: the gyroscope then reads a positive rate. Another face, sense or zero: docs/mounting.md.")
    once = "Mount the unit once for all turns. If you must mount it anew, state `table.seat_deg`."
    logged = (
        "Log the table's angle in the same rows (`table_angle_deg`), or by a clock of its own (docs/table_logs.md)."
    )
    if table.get("seat_deg"):
        once = f"Mount the unit anew for each turn axis, to {table['seat_deg']:g} deg (`table.seat_deg`, one standard "
        once += "deviation): the rotation of each mounting is estimated."
    if table["motion"] == "commanded":
        logged = "The table does not log its motion: write its program into a procedure of the campaign, or log the "
        logged += "commanded angle (docs/table_logs.md)."
    lines += [once, logged]
    if unit.procedure == "thermal_ramp":
        swing = course_of(unit).thermal_ramp_degc
        lines.append(f"In a thermal chamber, heat and cool the unit by {swing:g} degC during the session.")
    return ["## Mount", "", *lines]


def _up(axis: int) -> str:
    up = LEVEL_AT_ZERO[axis][2]
    i = int(np.argmax(np.abs(up)))
    return f"{'+' if up[i] > 0 else '-'}{AXES[i]}"


def _recordings(unit: UnitDescription, procedure: Mapping[str, Any], planned: list[Planned]) -> list[str]:
    """Return the table of the recordings."""
    lines, lengths = ["| file | what | length |", "|---|---|---|"], {p.name: p for p in planned}
    if unit.procedure == ONE_RECORDING:
        total = sum(p.trajectory.duration for p in planned)
        parts = "; ".join(_what(unit, p) for p in planned if p.name != TRANSIT)
        return [*lines, f"| `recording.csv` | one after the other, with rests between: {parts} | {total:.0f} s |"]
    for name, entry in procedure["recordings"].items():
        what, seconds = _held_out(procedure), ""
        if name in lengths:
            what, seconds = _what(unit, lengths[name]), f"{lengths[name].trajectory.duration:.0f} s"
        lines.append(f"| `{entry['file']}.csv`{' (optional)' * entry['optional']} | {what} | {seconds} |")
    return lines


def _what(unit: UnitDescription, planned: Planned) -> str:
    """Return what one recording holds."""
    course, table = course_of(unit), read_config("table", unit.table)
    axis = 0 if planned.axis is None else planned.axis
    if planned.role == "accelerometer":
        turn = f"{_up(axis)} up at angle 0; turn about {AXES[axis]} by 360 deg in steps of {course.step_deg:g} deg"
        return f"{turn}, rest {course.dwell_s:g} s at each (its first {SETTLING_S:g} s are left out)"
    if planned.role == "gyroscope":
        rates, turns = ", ".join(f"{rate:g}" for rate in course.rates_dps), f"{course.turns} turn"
        turns += f"{'s' * (course.turns > 1)} about {AXES[axis]} at {rates} deg/s"
        return f"rest {course.warm_up_rest_s:g} s, {turns}, rest {course.rest_s:g} s after each"
    if planned.role == "static":
        return "the unit lies still: determines its noise"
    if planned.role == ROLE:
        return BY_HAND[unit.procedure].format(positions=course.positions) + f", {course.dwell_s:g} s each"
    fast = f"at up to {course.validation_rate_dps:g} deg/s; the table logs"
    if table.get("seat_deg"):
        return f"the unit askew on the turn axis, turned to and fro {fast} its rate or angle; held out of every fit"
    return f"random motion about all axes {fast} the magnitude of its rate, or its attitude; held out of every fit"


def _held_out(procedure: Mapping[str, Any]) -> str:
    """Return what judges a calibration by hand."""
    every, turns = procedure["holdout_every"], procedure.get("turns")
    without = f"every {every}. rest is held out" if every else "nothing is held out, and no error is published"
    if turns:
        without = f"every {turns['holdout_every']}. turn about an axis is held out, between rests of 4 s and more"
    return f"other rests{' or turns' if turns else ''}, held out of every fit; without this file {without}"


def _unseen(document: Mapping[str, Any]) -> list[str]:
    """Return the effects that the recordings cannot show, by the reason."""
    reasons: dict[tuple[str, str], list[str]] = {}
    for sensor in SENSORS:
        for entry in document[sensor]["not_observable"]:
            reasons.setdefault((sensor, entry["reason"]), []).append(entry["effect"])
    return [f"- {sensor}, {', '.join(effects)}: {reason}" for (sensor, reason), effects in reasons.items()]


def _determined(sensor: str, part: Mapping[str, Any]) -> list[str]:
    """Return what the recordings determine of a sensor."""
    if part["reason"]:
        return [f"{sensor}: nothing: {part['reason']}"]
    lines = [f"{sensor}: bias and matrix; and a missing effect, from this size on:", ""]
    lines += ["| effect | smallest size | of its limit |", "|---|---|---|"]
    for entry in part["effects"]:
        size, share = size_text(entry["smallest"], entry["unit"]), share_text(entry["share_of_limit"])
        lines.append(f"| {entry['effect']} | {size} | {share} |")
    return lines
