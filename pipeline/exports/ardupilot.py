"""Parameters of ArduPilot, one ``NAME value`` a line.

    corrected = (raw - offset) * scale         (axis by axis; the gyroscope has no scale)

in m/s^2 and rad/s, raw without the thermal offset ``p(T) - p(CALTEMP)``, p(T) = (c_1 t + c_2 t^2 + c_3 t^3) 1e-6,
t = T - 35 degC. With CALTEMP = 25 degC a bias ``b + beta (T - 25) + gamma (T - 25)^2`` is ``c_1 = beta + 20 gamma``,
``c_2 = gamma``, times 1e6. Scale factors are those that stand best for the whole matrix; the remarks say what that
leaves. Source: ArduPilot, ``AP_InertialSensor_Backend::_rotate_and_correct_accel`` and ``_gyro``,
``AP_InertialSensor_tempcal.cpp``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.exports.sensors import (
    OF_THE_BIAS,
    STANDARD_GRAVITY,
    TEMPERATURES,
    axis_by_axis,
    before_use,
    bias_polynomial,
    calibrations,
    comment,
    final_errors,
    sensor_effects,
)
from pipeline.model.effects.base import REFERENCE_TEMPERATURE

if TYPE_CHECKING:
    from pipeline.records import SensorCalibration

FILE_NAME = "ardupilot.param"
TREF, MILLION = 35.0, 1e6
THERMAL = {"accelerometer": ("ACC", STANDARD_GRAVITY), "gyroscope": ("GYR", float(np.pi / 180.0))}
OF_THERMAL = [
    "Before that, raw - (p(T) - p(CALTEMP)), p(T) = (c1 t + c2 t^2) 1e-6, t = T - 35 degC. Narrow TMIN and TMAX, the",
    "widest for such parts, to what was recorded.",
]
NAMES = {
    "accelerometer_offset": "INS_ACCOFFS",
    "accelerometer_scale": "INS_ACCSCAL",
    "gyroscope_offset": "INS_GYROFFS",
}


def export(calibration: dict[str, Any], settings: dict[str, Any], validation: dict[str, Any] | None) -> str:
    """Return the parameter file's text."""
    del settings
    values, lost = axis_by_axis(calibration, OF_THE_BIAS)
    thermal = _thermal(calibrations(calibration))
    remarks = [
        f"Unit {calibration['unit']}: corrected = (raw - OFFS) * SCAL, m/s^2 and rad/s, axis by axis.",
        "Axes x y z are those of the calibration: they must be the sensor's after its own orientation.",
        "ArduPilot takes a new gyroscope offset at each start unless INS_GYR_CAL is 0.",
        *(OF_THERMAL if thermal else []),
        *before_use(calibration),
        *lost,
        *(f"With all of the calibration: {line}." for line in final_errors(validation)),
    ]
    lines = [
        f"{name}_{axis} {value:.9g}\n"
        for kind, name in NAMES.items()
        for axis, value in zip("XYZ", values.get(kind, ()), strict=False)
    ]
    return comment(remarks) + "".join([*lines, *thermal])


def _thermal(found: dict[str, SensorCalibration]) -> list[str]:
    """Return the parameters of biases that follow the temperature; none where none was fitted."""
    if not any(set(OF_THE_BIAS) & set(sensor_effects(c)) for c in found.values()):
        return []
    lines = ["INS_TCAL1_ENABLE 1\n", f"INS_TCAL1_TMIN {TEMPERATURES[0]:g}\n", f"INS_TCAL1_TMAX {TEMPERATURES[1]:g}\n"]
    for sensor, c in found.items():
        name, factor = THERMAL[sensor]
        lines.append(f"INS_{name}1_CALTEMP {REFERENCE_TEMPERATURE:g}\n")
        b = bias_polynomial(c) * factor * MILLION
        linear = b[:, 1] + 2.0 * (TREF - REFERENCE_TEMPERATURE) * b[:, 2]
        for order, values in enumerate((linear, b[:, 2], np.zeros(3)), 1):
            lines += [f"INS_TCAL1_{name}{order}_{a} {v:.9g}\n" for a, v in zip("XYZ", values, strict=True)]
    return lines
