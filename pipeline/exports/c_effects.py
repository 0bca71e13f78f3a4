"""What becomes of each effect in ``calibration.h``: C expressions, sorted by what they depend on.

The header does what ``pipeline.model.compensation`` does with one sample, in the same order, so that double
precision without fused operations gives the same last bit where no function of the C library is called. Effects of time
and temperature alone (``steady``) are taken off once; those of the motion (``moving``) by fixed point where a sensor's
effects depend, directly or through the other sensor, on what they change (``in_turn``).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from pipeline.model.compensation import OF_THE_PAST, OF_THE_ROOM, SMOOTHING_S
from pipeline.model.effects import effect_of, owner_of
from pipeline.model.effects.base import REFERENCE_TEMPERATURE, Owner
from pipeline.model.formula import c_number
from pipeline.model.log_motion import SIGNALS
from pipeline.records import SENSORS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pipeline.exports.sensors import ExportedSensor
    from pipeline.records import FittedEffect, SensorCalibration

ROUNDS = 12  # of the fixed point: each gains about two digits, and 1e-13 is asked for
ACROSS = {"accelerometer": {"specific_force"}, "gyroscope": {"angular_rate", "angular_acceleration", "direction"}}
IN_C = set(SIGNALS) - {"specific_force_rate"}


@dataclass
class SensorPlan:
    """The effects of one sensor: assignments in C, and what was left out, with the reason."""

    bias: list[str]
    matrix: list[list[str]]
    steady: list[str] = field(default_factory=list)
    moving: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    fields: set[str] = field(default_factory=set)
    depends_on: set[str] = field(default_factory=set)
    with_time: list[str] = field(default_factory=list)


@dataclass
class Plan:
    """The header's contents: of each sensor, and what they ask of the functions around them."""

    sensors: dict[str, SensorPlan]
    in_turn: set[str]
    past: bool
    temperature: bool
    with_time: list[str]
    rounds: int
    ends: int
    memory: float = SMOOTHING_S
    reference: str = c_number(REFERENCE_TEMPERATURE)

    def calls(self, function: str) -> bool:
        """Return whether an expression calls a function."""
        lines = [line for plan in self.sensors.values() for line in plan.steady + plan.moving]
        return any(f"{function}(" in line for line in lines)


def plan_of(sensors: Mapping[str, ExportedSensor]) -> Plan:
    """Return the plan of a header for the calibrated sensors."""
    plans = {s: _sensor_plan(sensors[s].calibration if s in sensors else None) for s in SENSORS}
    busy = {s for s, plan in plans.items() if plan.moving}
    in_turn = {
        s
        for s in busy
        if s in plans[s].depends_on or plans[s].depends_on & {o for o in busy if s in plans[o].depends_on}
    }
    fields = set().union(*(plan.fields for plan in plans.values()))
    past = bool(fields & OF_THE_PAST)
    return Plan(
        sensors=plans,
        in_turn=in_turn,
        past=past,
        temperature="temperature" in fields,
        with_time=sorted({name for plan in plans.values() for name in plan.with_time}),
        rounds=ROUNDS if in_turn else 1,
        ends=ROUNDS if in_turn and past else 1,
    )


def _sensor_plan(calibration: SensorCalibration | None) -> SensorPlan:
    """Return bias, matrix and effects of a sensor; one that is not calibrated passes through."""
    if calibration is None:
        return SensorPlan(["(imu_real)0.0"] * 3, [[c_number(float(i == j)) for j in range(3)] for i in range(3)])
    matrix = [[c_number(x) for x in row] for row in calibration.matrix.tolist()]
    plan = SensorPlan([c_number(b) for b in calibration.bias.tolist()], matrix)
    for fitted in calibration.effects:
        if owner_of(fitted) == Owner.SENSOR:
            _add(plan, calibration.sensor, fitted)
    return plan


def _add(plan: SensorPlan, sensor: str, fitted: FittedEffect) -> None:
    """Add the assignments of an effect, or the reason why there are none."""
    if fitted.definition and "python" in fitted.definition:
        why = "it is in Python; python -m pipeline apply --python-effect takes it off"
        plan.left_out.append(f"{fitted.name} ({why})")
        return
    effect = effect_of(fitted)
    terms, fields = effect.in_c(fitted.values), effect.fields(sensor, fitted.values)
    if terms is None:
        plan.left_out.append(f"{fitted.name} (its equation has no form in C; python -m pipeline apply takes it off)")
        return
    if fields - IN_C:
        plan.left_out.append(
            f"{fitted.name} (it needs {', '.join(sorted(fields - IN_C))}, which this header does not know)"
        )
        return
    alone = not fields & ({"time"} | OF_THE_PAST)
    condition = "" if alone else "if (!m->alone) "
    lines = [f"{condition}r[{i}] -= {term}; /* {fitted.name} */" for i, term in enumerate(terms)]
    plan.fields |= fields
    if fields - OF_THE_ROOM:
        plan.moving += lines
        plan.depends_on |= {s for s, own in ACROSS.items() if own & fields}
    else:
        plan.steady += lines
    if not alone:
        plan.with_time.append(fitted.name)
