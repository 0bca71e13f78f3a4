"""A C99 header without dependencies that compensates one sample.

    truth = matrix * (raw - bias - effects(truth, temperature))

solved by fixed point where the effects depend on the truth, as ``pipeline.model.inversion`` does.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.exports.sensors import bench_effects, calibrations, final_errors, missing, sensor_effects
from pipeline.model.effects.base import REFERENCE_TEMPERATURE

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from pipeline.records import SensorCalibration

FILE_NAME = "calibration.h"
ROUNDS = 12  # fixed point; each gains about two digits
BAR = "\n * "
PAST = "needs more than one sample"
OWN = "an effect of the user's own; python -m pipeline apply takes it off"
PRODUCTS = ("{v}[0] * {v}[1]", "{v}[1] * {v}[2]", "{v}[2] * {v}[0]")


def export(calibration: dict[str, Any], settings: dict[str, Any], validation: dict[str, Any] | None) -> str:
    """Return the header's text."""
    del settings
    found = calibrations(calibration)
    remarks = [f"Calibration of unit {calibration['unit']} (sensor {calibration['sensor']})."]
    remarks += [
        "Units: g (9.80665 m/s^2), deg/s, degC. Frame: body, x y z. truth = matrix * (raw - bias - effects).",
        "At rest the upward axis reads + local gravity. Effects of mounting, table and timing are not in here.",
        "Define IMU_REAL as float before including this for single precision; the default is double.",
        "A sensor that is not calibrated passes through unchanged.",
        *missing(calibration),
    ]
    for sensor, c in found.items():
        own = {e.name for e in c.effects if e.definition}
        left = [e for e in sensor_effects(c) if e not in TERMS]
        remarks += [f"Left out, {sensor}: {e} ({OWN if e in own else PAST})." for e in left]
        remarks += [f"Of the bench, not of the {sensor}: {', '.join(bench_effects(c))}."] if bench_effects(c) else []
    remarks += [f"The {line}." for line in final_errors(validation)]
    tables = "\n".join(_tables(sensor, found.get(sensor)) for sensor in ("accelerometer", "gyroscope"))
    effects = {s: _effects(found.get(s)) for s in ("accelerometer", "gyroscope")}
    rounds = ROUNDS if any(effects.values()) else 1
    return TEMPLATE.format(
        remarks=BAR + BAR.join(_safe(r) for r in remarks),
        tables=tables,
        accelerometer=_sum("accelerometer", effects["accelerometer"]),
        gyroscope=_sum("gyroscope", effects["gyroscope"]),
        rounds=rounds,
        reference=_number(REFERENCE_TEMPERATURE),
    )


def _per_axis(expression: str) -> Callable[[NDArray[np.float64]], list[str]]:
    return lambda p: [f"{_number(p[i])} * {expression.format(u=f'u[{i}]')}" for i in range(3)]


def _every_axis(expressions: Sequence[str]) -> Callable[[NDArray[np.float64]], list[str]]:
    def terms(p: NDArray[np.float64]) -> list[str]:
        rows = p.reshape(3, len(expressions))
        return [" + ".join(f"{_number(x)} * {e}" for x, e in zip(row, expressions, strict=True)) for row in rows]

    return terms


TERMS: dict[str, Callable[[NDArray[np.float64]], list[str]]] = {
    "bias_temperature": _every_axis(["dt"]),
    "bias_temperature_quadratic": _every_axis(["dt", "(dt * dt)"]),
    "scale_factor_temperature": _per_axis("(dt * {u})"),
    "scale_factor_asymmetry": _per_axis("({u} < 0 ? -{u} : {u})"),
    "quadratic_nonlinearity": _per_axis("({u} * {u})"),
    "cubic_nonlinearity": _per_axis("({u} * {u} * {u})"),
    "cross_axis_nonlinearity": _every_axis([f"({e.format(v='f')})" for e in PRODUCTS]),
    "rate_dependence": _every_axis(["w[0]", "w[1]", "w[2]"]),
    "g_sensitivity": _every_axis(["f[0]", "f[1]", "f[2]"]),
    "g_squared_sensitivity": _every_axis(
        ["(f[0] * f[0])", "(f[1] * f[1])", *(f"({e.format(v='f')})" for e in PRODUCTS)]
    ),
}


def _effects(calibration: SensorCalibration | None) -> dict[str, list[str]]:
    if calibration is None:
        return {}
    return {name: TERMS[name](values) for name, values in sensor_effects(calibration).items() if name in TERMS}


def _sum(sensor: str, effects: dict[str, list[str]]) -> str:
    own = "f" if sensor == "accelerometer" else "w"
    lines = [f"    const imu_real *u = {own};", "    (void)u; (void)f; (void)w; (void)dt;"]
    for i in range(3):
        lines.append(f"    e[{i}] = 0;")
        lines += [f"    e[{i}] += {terms[i]}; /* {name} */" for name, terms in effects.items()]
    return "\n".join(lines)


def _tables(sensor: str, calibration: SensorCalibration | None) -> str:
    bias = [0.0] * 3 if calibration is None else calibration.bias.tolist()
    rows = [[float(i == j) for j in range(3)] for i in range(3)] if calibration is None else calibration.matrix.tolist()
    matrix = ",\n    ".join("{" + ", ".join(map(_number, row)) + "}" for row in rows)
    numbers = ", ".join(map(_number, bias))
    return (
        f"static const imu_real imu_{sensor}_bias[3] = {{{numbers}}};\n"
        f"static const imu_real imu_{sensor}_matrix[3][3] = {{\n    {matrix}}};\n"
    )


def _number(value: float) -> str:
    return f"(imu_real){float(value)!r}"


def _safe(text: str) -> str:
    return text.replace("*/", "* /").replace("\n", " ")


TEMPLATE = """\
/*{remarks}
 */
#ifndef IMU_CALIBRATION_H
#define IMU_CALIBRATION_H

#ifndef IMU_REAL
#define IMU_REAL double
#endif
typedef IMU_REAL imu_real;

{tables}
/* What the effects add to a reading of the accelerometer: f in g, w in deg/s, dt from {reference} degC. */
static inline void imu_accelerometer_effects(const imu_real f[3], const imu_real w[3], imu_real dt, imu_real e[3])
{{
{accelerometer}
}}

/* Likewise of the gyroscope. */
static inline void imu_gyroscope_effects(const imu_real f[3], const imu_real w[3], imu_real dt, imu_real e[3])
{{
{gyroscope}
}}

static inline void imu_linear(const imu_real matrix[3][3], const imu_real bias[3], const imu_real raw[3],
                              const imu_real e[3], imu_real out[3])
{{
    int i;
    for (i = 0; i < 3; ++i)
        out[i] = matrix[i][0] * (raw[0] - bias[0] - e[0]) + matrix[i][1] * (raw[1] - bias[1] - e[1])
               + matrix[i][2] * (raw[2] - bias[2] - e[2]);
}}

/* Compensate one sample. raw_f, f: specific force, g; raw_w, w: angular rate, deg/s. */
static inline void imu_compensate(const imu_real raw_f[3], const imu_real raw_w[3], imu_real temperature_degc,
                                  imu_real f[3], imu_real w[3])
{{
    const imu_real dt = temperature_degc - {reference};
    imu_real ef[3] = {{0, 0, 0}}, ew[3] = {{0, 0, 0}};
    int round;
    imu_linear(imu_accelerometer_matrix, imu_accelerometer_bias, raw_f, ef, f);
    imu_linear(imu_gyroscope_matrix, imu_gyroscope_bias, raw_w, ew, w);
    for (round = 0; round < {rounds}; ++round) {{
        imu_accelerometer_effects(f, w, dt, ef);
        imu_gyroscope_effects(f, w, dt, ew);
        imu_linear(imu_accelerometer_matrix, imu_accelerometer_bias, raw_f, ef, f);
        imu_linear(imu_gyroscope_matrix, imu_gyroscope_bias, raw_w, ew, w);
    }}
}}

#endif
"""
