"""Parameters of ArduPilot, one ``NAME value`` a line.

    corrected = (raw - offset) * scale         (axis by axis; the gyroscope has no scale)

in m/s^2 and rad/s. Scale factors are those that stand best for the whole matrix; the remarks say what that leaves.
Source: ArduPilot, ``AP_InertialSensor_Backend::_rotate_and_correct_accel`` and ``_gyro``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.exports.sensors import (
    STANDARD_GRAVITY,
    calibrations,
    comment,
    diagonal,
    final_errors,
    forward,
    left_out,
    missing,
)

FILE_NAME = "ardupilot.param"


def export(calibration: dict[str, Any], settings: dict[str, Any], validation: dict[str, Any] | None) -> str:
    """Return the parameter file's text."""
    del settings
    found = calibrations(calibration)
    remarks = [
        f"Unit {calibration['unit']}: corrected = (raw - OFFS) * SCAL, m/s^2 and rad/s, axis by axis.",
        "Axes x y z are those of the calibration: they must be the sensor's after its own orientation, forward right "
        "down.",
        "ArduPilot takes a new gyroscope offset at each start unless INS_GYR_CAL is 0.",
        *(f"Left out: {line}." for line in missing(calibration)),
        *left_out(found),
    ]
    values: dict[str, float] = {}
    if "accelerometer" in found:
        scale, error = diagonal(found["accelerometer"])
        remarks.append(f"Cross-axis terms of the accelerometer are left out: that leaves about {error:.2g} g at 1 g.")
        for axis, offset, s in zip("XYZ", found["accelerometer"].bias * STANDARD_GRAVITY, scale, strict=True):
            values |= {f"INS_ACCOFFS_{axis}": offset, f"INS_ACCSCAL_{axis}": s}
    if "gyroscope" in found:
        lost = np.linalg.norm(np.eye(3) - forward(found["gyroscope"])) / np.sqrt(3.0)
        remarks.append(f"The matrix of the gyroscope is left out: that leaves about {100 * lost:.2g} % of the rate.")
        rates = np.radians(found["gyroscope"].bias)
        values |= {f"INS_GYROFFS_{axis}": value for axis, value in zip("XYZ", rates, strict=True)}
    remarks += [f"With all of the calibration: {line}." for line in final_errors(validation)]
    return comment(remarks) + "".join(f"{name} {value:.9g}\n" for name, value in values.items())
