"""Parameters of PX4, as QGroundControl loads them.

    corrected = (raw - offset) * scale         (axis by axis; the gyroscope has no scale)

in m/s^2 and rad/s, in the frame of the sensor, before its rotation; raw is without the thermal offset
``X1 dT + X2 dT^2``, dT = T - TREF. Scale factors are those that stand best for the
whole matrix; the remarks say what that leaves. Source: PX4, ``sensor_calibration/Accelerometer.hpp`` and
``temperature_compensation``.
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

FILE_NAME = "px4.params"
INTEGER, FLOAT, VEHICLE, COMPONENT = 6, 9, 1, 1
THERMAL = {"accelerometer": ("TC_A", STANDARD_GRAVITY), "gyroscope": ("TC_G", float(np.pi / 180.0))}
OF_THERMAL = [
    "Before that, raw - (X1 dT + X2 dT^2), dT = T - TREF in degC. Set TC_A0_ID and TC_G0_ID too, and narrow TMIN and",
    "TMAX, the widest for such parts, to what was recorded.",
]
NAMES = {
    "accelerometer_offset": "CAL_ACC0_{}OFF",
    "accelerometer_scale": "CAL_ACC0_{}SCALE",
    "gyroscope_offset": "CAL_GYRO0_{}OFF",
}


def export(calibration: dict[str, Any], settings: dict[str, Any], validation: dict[str, Any] | None) -> str:
    """Return the parameter file's text."""
    del settings
    values, lost = axis_by_axis(calibration, OF_THE_BIAS)
    thermal = [line for c in calibrations(calibration).values() for line in _thermal(c)]
    remarks = [
        f"Unit {calibration['unit']}: corrected = (raw - OFF) * SCALE, m/s^2 and rad/s, axis by axis.",
        "Axes x y z are those of the calibration: they must be the sensor's own, before CAL_ACC0_ROT is applied.",
        "Set CAL_ACC0_ID and CAL_GYRO0_ID to your device's ids (PX4 ignores offsets of an id it does not know),",
        "and CAL_ACC0_PRIO and CAL_ACC0_ROT as they are in your vehicle.",
        *(OF_THERMAL if thermal else []),
        *before_use(calibration),
        *lost,
        *(f"With all of the calibration: {line}." for line in final_errors(validation)),
    ]
    lines = [
        _line(name.format(axis), f"{value:.9g}", FLOAT)
        for kind, name in NAMES.items()
        for axis, value in zip("XYZ", values.get(kind, ()), strict=False)
    ]
    return comment(remarks) + "".join([*lines, *thermal])


def _thermal(calibration: SensorCalibration) -> list[str]:
    """Return the parameters of a bias that follows the temperature; none where none was fitted."""
    if not set(OF_THE_BIAS) & set(sensor_effects(calibration)):
        return []
    name, factor = THERMAL[calibration.sensor]
    lines = [_line(f"{name}_ENABLE", "1", INTEGER)]
    bounds = (("TMIN", TEMPERATURES[0]), ("TMAX", TEMPERATURES[1]), ("TREF", REFERENCE_TEMPERATURE))
    lines += [_line(f"{name}0_{key}", f"{value:g}", FLOAT) for key, value in bounds]
    coefficients = bias_polynomial(calibration) * factor
    for order in range(4):
        for axis in range(3):
            value = coefficients[axis, order] if order in (1, 2) else 0.0  # the constant is the offset
            lines.append(_line(f"{name}0_X{order}_{axis}", f"{value:.9g}", FLOAT))
    return lines


def _line(name: str, value: str, kind: int) -> str:
    return f"{VEHICLE}\t{COMPONENT}\t{name}\t{value}\t{kind}\n"
