"""Propose additional recordings for a procedure, and write the README of a new campaign.

Each proposed change is planned like the procedure itself. Changes with options can be planned and simulated by these
options. The others are further recordings, to be named in the procedure's configuration.

The README states how to mount and record a unit, the lengths of the recordings, and what they determine. It takes the
recordings and lengths from the simulated procedure, and what they determine from its plan
(``pipeline.app.planning.plan``).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.app.planning.plan import Document, plan_of, share_text, size_text
from pipeline.core.records import AXES, SENSORS
from pipeline.output.pages.pages import template
from pipeline.physics.effects import effect
from pipeline.physics.effects.base import Owner
from pipeline.physics.kinematics import LEVEL_AT_ZERO
from pipeline.physics.signal.rests import SETTLING_S
from pipeline.simulation.description import TABLE_PROCEDURES, Course, UnitDescription, course_of, plan, shipped_settings
from pipeline.simulation.trajectory import Gimbals, Planned, random_gimbals

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence


FASTER_DPS = (100.0, 200.0)  # proposed rates, within a low-cost range of 250 deg/s
CLEARLY_FASTER = 1.3  # least proposed rate over the procedure's fastest rate
USABLE_RANGE_SHARE = 0.9  # of the gyroscope's full scale: its bias needs the remainder
MOTION_S, MOTION_DPS = 120.0, 100.0  # of the proposed random motion
UPRIGHT_DPS = 60.0  # one turn about an upright z in 6 s
LONG_REST_S = 600.0  # six correlation times of a typical wander (configs/sensor)
POSITIONS = 2  # proposed number of rests over that of the procedure
CLEARLY_SMALLER = 99.5  # per cent
PRINTED_CHANGES = 3  # changes that are printed


@dataclass(frozen=True)
class ProcedureChange:
    """A change of the procedure or an additional recording."""

    what: str  # as advice to the reader
    options: str  # of the command line, empty if no option has this effect
    unit: UnitDescription
    extra: tuple[Planned, ...] = ()


def changes(unit: UnitDescription) -> list[ProcedureChange]:
    """Return the proposed changes of a unit's procedure."""
    course, on_table = course_of(unit), unit.procedure in TABLE_PROCEDURES
    full = shipped_settings(sensor=unit.sensor).sensor.gyroscope.full_scale
    fixed = replace(unit, samples=None, course=asdict(course))
    found: list[ProcedureChange] = []

    def propose(what: str, options: str, **values: Any) -> None:  # noqa: ANN401  (any attribute of the course)
        found.append(ProcedureChange(what, options, replace(fixed, course={**fixed.course, **values})))

    if on_table and not course.both_directions:
        propose("make every turn in the other direction too", "--both-directions", both_directions=True)
    faster = [r for r in FASTER_DPS if CLEARLY_FASTER * max(course.rates_dps) < r <= USABLE_RANGE_SHARE * full]
    if on_table and faster:
        rates = (*course.rates_dps, *faster)
        what = f"turn at {' and '.join(f'{r:g}' for r in faster)} deg/s too, both sensors recorded"
        propose(what, "--rate " + " ".join(f"{r:g}" for r in rates), rates_dps=rates)
    if on_table:
        propose("make twice as many turns", f"--turns {2 * course.turns}", turns=2 * course.turns)
    if not (on_table and course.accelerometer_rates_dps):
        dwell = 2.0 * course.dwell_s
        propose("rest twice as long at each stop", f"--dwell {dwell:g}", dwell_s=dwell)
    if unit.procedure == "three_axis_turns":
        what = f"heat and cool the unit by {course.thermal_ramp_degc:g} degC meanwhile, in a thermal chamber"
        found.append(ProcedureChange(what, "--procedure thermal_ramp", replace(fixed, procedure="thermal_ramp")))
    if on_table:
        found += _further(fixed, course, full)
    elif unit.procedure == "multi_position":
        more = POSITIONS * course.positions
        propose(f"rest in {more} positions", f"--positions {more}", positions=more)
    else:
        what = f"instead of these, rest in {course.positions} positions, each with another inclination"
        found.append(ProcedureChange(what, "--procedure multi_position", replace(fixed, procedure="multi_position")))
    if course.static_s < LONG_REST_S:
        what = f"a long rest of {LONG_REST_S / 60.0:g} min, to determine the noise"
        propose(what, f"--static {LONG_REST_S:g}", static_s=LONG_REST_S)
    return found


def _further(unit: UnitDescription, course: Course, full: float) -> Iterator[ProcedureChange]:
    """Yield recordings for which the procedure has no option."""
    planned = plan(unit.procedure, replace(course, validation_s=0.0, static_s=0.0), np.random.default_rng(0))
    repeated = tuple(replace(p, name=f"{p.name}_again") for p in planned)
    yield ProcedureChange("run the whole procedure a second time, once the unit is warm", "", unit, repeated)
    if unit.table == "single_axis":
        return
    rate = min(MOTION_DPS, USABLE_RANGE_SHARE * full)
    motion = random_gimbals(MOTION_S, rate, np.random.default_rng(0))
    what = f"random motion about all axes up to {rate:g} deg/s for {MOTION_S / 60.0:g} min, attitude logged, in the fit"
    yield ProcedureChange(what, "", unit, (Planned("motion", "gyroscope", None, motion),))
    still = np.zeros((3, 1))
    turn = Gimbals(np.array([0.0, 0.0, UPRIGHT_DPS]), still, still, still, 360.0 / UPRIGHT_DPS)
    what = "turn about z with z upright, attitude logged, in the fit"
    yield ProcedureChange(what, "", unit, (Planned("upright_z", "gyroscope", None, turn),))


@dataclass(frozen=True)
class PlanGain:
    """The improvement of a plan by a change."""

    change: ProcedureChange
    minutes: float  # additional time
    shown: tuple[str, ...]  # ``sensor.effect`` that become observable; of the table only if neither sensor showed it
    distinguished: tuple[str, ...]  # those that are no longer taken for a look-alike
    factor: float  # geometric mean of new over old smallest size, of effects that are observable in both


def best_changes(unit: UnitDescription, before: Document) -> list[PlanGain]:
    """Return the gain of each change, the most helpful first; ``before`` is the plan of the unit's procedure.

    The order is by the number of effects that become observable for each additional minute (at least one, to set up),
    then by the reduction of the smallest sizes for each minute, as a logarithm.
    """
    if all(before[sensor]["reason"] for sensor in SENSORS):
        return []
    gains = [_gain(change, before, plan_of(change.unit, change.extra, half_only=True)) for change in changes(unit)]

    def order(gain: PlanGain) -> tuple[float, float]:
        minutes = max(gain.minutes, 1.0)
        return -len(gain.shown) / minutes, float(np.log(gain.factor)) / minutes

    return sorted(gains, key=order)


def _gain(change: ProcedureChange, before: Document, after: Document) -> PlanGain:
    old, new = (  # observable effects by ``sensor.effect``
        {f"{s}.{entry['effect']}": entry for s in SENSORS for entry in document[s]["effects"]}
        for document in (before, after)
    )
    of_table = {entry["effect"] for entry in old.values() if effect(entry["effect"]).owner == Owner.TABLE}
    both = [key for key in new if key in old]
    ratios = [np.log(new[key]["smallest"] / old[key]["smallest"]) for key in both]
    return PlanGain(
        change,
        after["minutes"] - before["minutes"],
        tuple(key for key, entry in new.items() if key not in old and entry["effect"] not in of_table),
        tuple(key for key in both if old[key]["taken_for"] and not new[key]["taken_for"]),
        float(np.exp(np.mean(ratios))) if ratios else 1.0,
    )


def helps_most(gains: Sequence[PlanGain]) -> list[str]:
    """Return the first changes that help as lines."""
    useful = [gain for gain in gains if gain.shown or gain.distinguished or 100.0 * gain.factor < CLEARLY_SMALLER]
    if not useful:
        return ["additional recordings: none of those examined shows more"] if gains else []
    lines = ["additional recordings, the most helpful first:"]
    for number, gain in enumerate(useful[:PRINTED_CHANGES], start=1):
        options = f" ({gain.change.options})" if gain.change.options else ""
        lines.append(f"  {number}. {gain.change.what}{options}: {gain.minutes:+.1f} min")
        parts = [f"shows {_listed(gain.shown)}"] if gain.shown else []
        parts += [f"distinguishes {_listed(gain.distinguished)} from similar effects"] if gain.distinguished else []
        percent = 100.0 * gain.factor
        size = f"at {percent:.0f} % of the size" if percent < CLEARLY_SMALLER else "at the same size"
        parts.append(f"finds {'the others' if parts else 'effects'} {size}")
        lines.append(f"     {'; '.join(parts)}")
    return lines


def _listed(keys: Sequence[str]) -> str:
    by_sensor = {s: [k.partition(".")[2] for k in keys if k.startswith(f"{s}.")] for s in SENSORS}
    return " and ".join(f"{', '.join(names)} of the {sensor}" for sensor, names in by_sensor.items() if names)


def readme(unit: UnitDescription, name: str) -> str:
    """Return the README of a campaign with the description of its first unit."""
    settings, course = shipped_settings(procedure=unit.procedure, table=unit.table), course_of(unit)
    ups = LEVEL_AT_ZERO[:, 2]  # the vertical in the body frame at table angle 0, for turns about each axis
    text: str = template("campaign_readme.md").render(
        name=name,
        unit=unit,
        course=course,
        table=settings.table,
        procedure=settings.procedure,
        folder=settings.procedure.folder.replace("{unit}", unit.unit),
        planned=plan(unit.procedure, course, np.random.default_rng(0)),
        plan=plan_of(unit),
        axes=AXES,
        up=[f"{'+' if up[i] > 0 else '-'}{AXES[i]}" for up in ups for i in [int(np.argmax(np.abs(up)))]],
        settling_s=SETTLING_S,
        size_text=size_text,
        share_text=share_text,
    )
    return text
