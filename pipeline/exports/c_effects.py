"""Write the effects of a calibration as C expressions for ``calibration.h``.

The header performs the operations of ``pipeline.model.compensation`` for one sample, in the same order. Double
precision without fused operations and without functions of the C library then gives the same last bit. Effects of only
time and temperature (``steady``) are subtracted once. Effects of the motion (``moving``) are subtracted by a
fixed-point iteration if they depend on the calibrated reading of the same sensor, also through the other sensor
(``circular_sensors``).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from pipeline.model.compensation import OF_THE_PAST, SMOOTHING_S, Steps, circular
from pipeline.model.effects import effect_of
from pipeline.model.effects.base import REFERENCE_TEMPERATURE
from pipeline.model.formula import c_number
from pipeline.model.log_motion import SIGNALS
from pipeline.model.measurement import sensor_effects
from pipeline.records import SENSORS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pipeline.exports.sensors import ExportedSensor
    from pipeline.records import FittedEffect, SensorCalibration

ROUNDS = 12  # of the fixed point: each gains about two digits, and a relative error of 1e-13 is the goal
IN_C = set(SIGNALS) - {"specific_force_rate"}


@dataclass
class SensorPlan:
    """The effects of one sensor as assignments in C, and the omitted effects with the reason."""

    bias: list[str]
    matrix: list[list[str]]
    steady: list[str] = field(default_factory=list)
    moving: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    with_time: list[str] = field(default_factory=list)


@dataclass
class Plan:
    """The contents of the header: the plan of each sensor, and the functions that it needs."""

    sensors: dict[str, SensorPlan]
    circular_sensors: set[str]
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
    plans, steps = {}, {}
    for sensor in SENSORS:
        calibration = sensors[sensor].calibration if sensor in sensors else None
        plans[sensor], steps[sensor] = _sensor_plan(sensor, calibration)
    circular_sensors = circular(steps)
    used = set().union(*(step.used for step in steps.values()))
    past = bool(used & OF_THE_PAST)
    return Plan(
        sensors=plans,
        circular_sensors=circular_sensors,
        past=past,
        temperature="temperature" in used,
        with_time=sorted({name for plan in plans.values() for name in plan.with_time}),
        rounds=ROUNDS if circular_sensors else 1,
        ends=ROUNDS if circular_sensors and past else 1,
    )


def _sensor_plan(sensor: str, calibration: SensorCalibration | None) -> tuple[SensorPlan, Steps]:
    """Return bias, matrix and effects of a sensor; without a calibration its readings are unchanged."""
    if calibration is None:
        unchanged = [[c_number(float(i == j)) for j in range(3)] for i in range(3)]
        return SensorPlan([c_number(0.0)] * 3, unchanged), Steps.of(sensor, ())
    matrix = [[c_number(x) for x in row] for row in calibration.matrix.tolist()]
    plan = SensorPlan([c_number(b) for b in calibration.bias.tolist()], matrix)
    included = []
    for fitted in sensor_effects(calibration):
        if why := _not_in_c(sensor, fitted):
            plan.left_out.append(f"{fitted.name} ({why})")
        else:
            included.append(fitted)
    steps = Steps.of(sensor, included)
    for effects, lines in ((steps.steady, plan.steady), (steps.moving, plan.moving)):
        for fitted in effects:
            with_time = bool(steps.fields[fitted.name] & ({"time"} | OF_THE_PAST))
            condition = "if (!m->alone) " if with_time else ""
            plan.with_time += [fitted.name] if with_time else []
            terms = effect_of(fitted).in_c(fitted.values) or ()
            lines += [f"{condition}r[{i}] -= {term}; /* {fitted.name} */" for i, term in enumerate(terms)]
    return plan, steps


def _not_in_c(sensor: str, fitted: FittedEffect) -> str:
    """Return the reason why the header omits an effect; empty if it contains the effect."""
    if fitted.definition and "python" in fitted.definition:
        return "it is in Python; python -m pipeline apply --python-effect subtracts it"
    effect = effect_of(fitted)
    if effect.in_c(fitted.values) is None:
        return "its equation has no form in C; python -m pipeline apply subtracts it"
    unknown = sorted(effect.fields(sensor, fitted.values) - IN_C)
    return f"it needs {', '.join(unknown)}, which this header does not know" if unknown else ""
