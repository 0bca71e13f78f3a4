"""A C99 header without dependencies that compensates a sensor's samples as they come.

    truth = matrix * (raw - bias - effects(truth, temperature, time))

It does what ``pipeline.model.compensation_stream`` does with one sample, in the same order, so that double precision
without fused operations gives the same last bit where no function of the C library is called. Formulas of a user's own
effects become expressions in C.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from pipeline.exports import c_template as text
from pipeline.exports.sensors import before_use, bench_effects, calibrations, final_errors, missing
from pipeline.model.compensation import SMOOTHING_S
from pipeline.model.compensation_stream import OF_THE_PAST, OF_THE_ROOM
from pipeline.model.effects import effect_of, owner_of
from pipeline.model.effects.base import REFERENCE_TEMPERATURE, Owner
from pipeline.model.formula import c_number
from pipeline.model.log_motion import SIGNALS
from pipeline.records import SENSORS

if TYPE_CHECKING:
    from pipeline.records import SensorCalibration

FILE_NAME = "calibration.h"
ROUNDS = 12  # of the fixed point; each gains about two digits
BAR = "\n * "
IN_PYTHON = "it is in Python; python -m pipeline apply --python-effect takes it off"
NOT_IN_C = "its equation has no form in C; python -m pipeline apply takes it off"
ACROSS = {"accelerometer": {"specific_force"}, "gyroscope": {"angular_rate", "angular_acceleration", "direction"}}


@dataclass
class _Plan:
    """What becomes of the effects of one sensor."""

    steady: list[str] = field(default_factory=list)
    moving: list[str] = field(default_factory=list)
    used: set[str] = field(default_factory=set)
    looks_at: set[str] = field(default_factory=set)
    of_the_time: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)


def export(calibration: dict[str, Any], settings: dict[str, Any], validation: dict[str, Any] | None) -> str:
    """Return the header's text."""
    del settings
    found = calibrations(calibration)
    plans = {s: _plan(found[s]) if s in found else _Plan() for s in SENSORS}
    busy = {s for s, plan in plans.items() if plan.moving}
    turns = {
        s for s in busy if s in plans[s].looks_at or plans[s].looks_at & {o for o in busy if s in plans[o].looks_at}
    }
    used = set().union(*(plan.used for plan in plans.values()))
    past = bool(used & OF_THE_PAST)
    of_the_time = sorted({name for plan in plans.values() for name in plan.of_the_time})
    body = [text.LINEAR, text.FOLLOW if past else ""]
    body += [_effects(s, kind, getattr(plans[s], kind)) for s in SENSORS for kind in ("steady", "moving")]
    functions = [t for name, t in text.FUNCTIONS.items() if any(f"{name}(" in part for part in body)]
    smooth = "imu_smooth(state, (double)temperature_degc, time_s)"
    return "".join(
        [
            text.HEAD.format(
                remarks=BAR + BAR.join(_safe(r) for r in _remarks(calibration, found, plans, validation)),
                tables="\n".join(_tables(sensor, found.get(sensor)) for sensor in SENSORS),
                rounds=ROUNDS if turns else 1,
                ends=ROUNDS if turns and past else 1,
                turn_accelerometer=int("accelerometer" in turns),
                turn_gyroscope=int("gyroscope" in turns),
                memory=SMOOTHING_S,
            ),
            *(f"{function}\n" for function in functions),
            *body,
            text.LINE if "temperature" in used else "",
            text.MAIN.format(
                past=text.PAST if past else "",
                temperature=f"IMU_TEMPERATURE_MEMORY > 0 ? (imu_real){smooth} : temperature_degc"
                if "temperature" in used
                else "temperature_degc",
                alone=f";\n * without {', '.join(of_the_time)}, which time or the sample before tells"
                if of_the_time
                else "",
            ),
        ]
    )


def _plan(calibration: SensorCalibration) -> _Plan:
    """Sort the effects of a sensor: those that look at time and temperature alone go first."""
    plan = _Plan()
    for fitted in (e for e in calibration.effects if owner_of(e) == Owner.SENSOR):
        if fitted.definition and "python" in fitted.definition:
            plan.left_out.append(f"{fitted.name} ({IN_PYTHON})")
            continue
        effect = effect_of(fitted)
        terms, fields = effect.in_c(fitted.values), effect.fields(calibration.sensor, fitted.values)
        unknown = sorted((fields - set(SIGNALS)) | (fields & {"specific_force_rate"}))
        if terms is None or unknown:
            why = f"it needs {', '.join(unknown)}, which this header does not know" if unknown else NOT_IN_C
            plan.left_out.append(f"{fitted.name} ({why})")
            continue
        alone = not fields & ({"time"} | OF_THE_PAST)
        lines = [f"{'' if alone else 'if (!m->alone) '}r[{i}] -= {t}; /* {fitted.name} */" for i, t in enumerate(terms)]
        (plan.moving if fields - OF_THE_ROOM else plan.steady).extend(lines)
        plan.used |= fields
        if fields - OF_THE_ROOM:
            plan.looks_at |= {s for s, own in ACROSS.items() if own & fields}
        if not alone:
            plan.of_the_time.append(fitted.name)
    return plan


def _remarks(
    document: dict[str, Any],
    found: dict[str, SensorCalibration],
    plans: dict[str, _Plan],
    validation: dict[str, Any] | None,
) -> list[str]:
    remarks = [
        f"Calibration of unit {document['unit']} (sensor {document['sensor']}).",
        "Units: g (9.80665 m/s^2), deg/s, degC, s. Frame: body, x y z. truth = matrix * (raw - bias - effects).",
        "At rest the upward axis reads + local gravity. Effects of mounting, table and timing are not in here.",
        *before_use(document),
        "Use: imu_state state = {0}; then imu_update(&state, ...) for each sample of a sensor, in their order;",
        "or imu_compensate(...), which looks at one sample by itself.",
        "Define IMU_REAL as float before including this for single precision; the default is double.",
        "A sensor that is not calibrated passes through unchanged.",
        *missing(document),
    ]
    for sensor, c in found.items():
        remarks += [f"Left out, {sensor}: {name}." for name in plans[sensor].left_out]
        remarks += [f"Of the bench, not of the {sensor}: {', '.join(bench_effects(c))}."] if bench_effects(c) else []
    return remarks + [f"The {line}." for line in final_errors(validation)]


def _effects(sensor: str, kind: str, lines: list[str]) -> str:
    which = "effects of time and temperature" if kind == "steady" else "effects of the motion"
    return text.EFFECTS.format(
        sensor=sensor,
        kind=kind,
        which=which,
        own="f" if sensor == "accelerometer" else "w",
        reference=c_number(REFERENCE_TEMPERATURE),
        lines="\n".join(f"    {line}" for line in lines),
    )


def _tables(sensor: str, calibration: SensorCalibration | None) -> str:
    bias = [0.0] * 3 if calibration is None else calibration.bias.tolist()
    rows = [[float(i == j) for j in range(3)] for i in range(3)] if calibration is None else calibration.matrix.tolist()
    matrix = ",\n    ".join("{" + ", ".join(map(c_number, row)) + "}" for row in rows)
    numbers = ", ".join(map(c_number, bias))
    return (
        f"static const imu_real imu_{sensor}_bias[3] = {{{numbers}}};\n"
        f"static const imu_real imu_{sensor}_matrix[3][3] = {{\n    {matrix}}};\n"
    )


def _safe(remark: str) -> str:
    return remark.replace("*/", "* /").replace("\n", " ")
