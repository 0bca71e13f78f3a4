"""Parameters of PX4, as QGroundControl loads them.

    corrected = (raw - offset) * scale         (axis by axis; the gyroscope has no scale)

in m/s^2 and rad/s, in the frame of the sensor, before its rotation. Scale factors are those that stand best for the
whole matrix; the remarks say what that leaves. Source: PX4, ``sensor_calibration/Accelerometer.hpp``.
"""

from __future__ import annotations

from typing import Any

from pipeline.exports.sensors import axis_by_axis, comment, final_errors

FILE_NAME = "px4.params"
FLOAT, VEHICLE, COMPONENT = 9, 1, 1
NAMES = {
    "accelerometer_offset": "CAL_ACC0_{}OFF",
    "accelerometer_scale": "CAL_ACC0_{}SCALE",
    "gyroscope_offset": "CAL_GYRO0_{}OFF",
}


def export(calibration: dict[str, Any], settings: dict[str, Any], validation: dict[str, Any] | None) -> str:
    """Return the parameter file's text."""
    del settings
    values, lost = axis_by_axis(calibration)
    remarks = [
        f"Unit {calibration['unit']}: corrected = (raw - OFF) * SCALE, m/s^2 and rad/s, axis by axis.",
        "Axes x y z are those of the calibration: they must be the sensor's own, before CAL_ACC0_ROT is applied.",
        "Set CAL_ACC0_ID and CAL_GYRO0_ID to your device's ids (PX4 ignores offsets of an id it does not know).",
        *lost,
        *(f"With all of the calibration: {line}." for line in final_errors(validation)),
    ]
    lines = [
        f"{VEHICLE}\t{COMPONENT}\t{name.format(axis)}\t{value:.9g}\t{FLOAT}\n"
        for kind, name in NAMES.items()
        for axis, value in zip("XYZ", values.get(kind, ()), strict=False)
    ]
    return comment(remarks) + "".join(lines)
