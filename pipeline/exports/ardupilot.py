"""Parameters of ArduPilot, one ``NAME value`` a line.

    corrected = (raw - offset) * scale         (axis by axis; the gyroscope has no scale)

in m/s^2 and rad/s. Scale factors are those that stand best for the whole matrix; the remarks say what that leaves.
Source: ArduPilot, ``AP_InertialSensor_Backend::_rotate_and_correct_accel`` and ``_gyro``.
"""

from __future__ import annotations

from typing import Any

from pipeline.exports.sensors import axis_by_axis, comment, final_errors

FILE_NAME = "ardupilot.param"
NAMES = {
    "accelerometer_offset": "INS_ACCOFFS",
    "accelerometer_scale": "INS_ACCSCAL",
    "gyroscope_offset": "INS_GYROFFS",
}


def export(calibration: dict[str, Any], settings: dict[str, Any], validation: dict[str, Any] | None) -> str:
    """Return the parameter file's text."""
    del settings
    values, lost = axis_by_axis(calibration)
    remarks = [
        f"Unit {calibration['unit']}: corrected = (raw - OFFS) * SCAL, m/s^2 and rad/s, axis by axis.",
        "Axes x y z are those of the calibration: they must be the sensor's after its own orientation.",
        "ArduPilot takes a new gyroscope offset at each start unless INS_GYR_CAL is 0.",
        *lost,
        *(f"With all of the calibration: {line}." for line in final_errors(validation)),
    ]
    lines = [
        f"{name}_{axis} {value:.9g}\n"
        for kind, name in NAMES.items()
        for axis, value in zip("XYZ", values.get(kind, ()), strict=False)
    ]
    return comment(remarks) + "".join(lines)
