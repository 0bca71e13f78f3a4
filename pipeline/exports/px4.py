"""Parameters of PX4, as QGroundControl loads them.

    corrected = (raw - offset) * scale         (axis by axis; the gyroscope has no scale)

in m/s^2 and rad/s, in the frame of the sensor, before its rotation. Scale factors are those that stand best for the
whole matrix; the remarks say what that leaves. Source: PX4, ``sensor_calibration/Accelerometer.hpp``.
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

FILE_NAME = "px4.params"
FLOAT, VEHICLE, COMPONENT = 9, 1, 1


def export(calibration: dict[str, Any], settings: dict[str, Any], validation: dict[str, Any] | None) -> str:
    """Return the parameter file's text."""
    del settings
    found = calibrations(calibration)
    remarks = [
        f"Unit {calibration['unit']}: corrected = (raw - OFF) * SCALE, m/s^2 and rad/s, axis by axis.",
        "Axes x y z are those of the calibration: they must be the sensor's own, before CAL_ACC0_ROT is applied.",
        "Set CAL_ACC0_ID and CAL_GYRO0_ID to your device's ids (PX4 ignores offsets of an id it does not know).",
        *(f"Left out: {line}." for line in missing(calibration)),
        *left_out(found),
    ]
    values: dict[str, float] = {}
    if "accelerometer" in found:
        scale, error = diagonal(found["accelerometer"])
        remarks.append(f"Cross-axis terms of the accelerometer are left out: that leaves about {error:.2g} g at 1 g.")
        for axis, offset, s in zip("XYZ", found["accelerometer"].bias * STANDARD_GRAVITY, scale, strict=True):
            values |= {f"CAL_ACC0_{axis}OFF": offset, f"CAL_ACC0_{axis}SCALE": s}
    if "gyroscope" in found:
        lost = np.linalg.norm(np.eye(3) - forward(found["gyroscope"])) / np.sqrt(3.0)
        remarks.append(f"The matrix of the gyroscope is left out: that leaves about {100 * lost:.2g} % of the rate.")
        rates = np.radians(found["gyroscope"].bias)
        values |= {f"CAL_GYRO0_{axis}OFF": value for axis, value in zip("XYZ", rates, strict=True)}
    remarks += [f"With all of the calibration: {line}." for line in final_errors(validation)]
    lines = [f"{VEHICLE}\t{COMPONENT}\t{name}\t{value:.9g}\t{FLOAT}\n" for name, value in values.items()]
    return comment(remarks) + "".join(lines)
