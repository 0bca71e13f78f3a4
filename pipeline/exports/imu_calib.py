"""The parameters of ``dpkoch/imu_calib`` (ROS), which corrects the accelerometer.

    a = SM raw - bias',    SM = matrix,   bias' = matrix @ bias

with the bias after the matrix, in m/s^2. Source: imu_calib, ``accel_calib.cpp``.
"""

from __future__ import annotations

from typing import Any

from pipeline.exports.sensors import (
    STANDARD_GRAVITY,
    before_use,
    calibrations,
    comment,
    final_errors,
    left_out,
    yaml_text,
)

FILE_NAME = "imu_calib.yaml"


def export(calibration: dict[str, Any], settings: dict[str, Any], validation: dict[str, Any] | None) -> str | None:
    """Return the YAML text, None where the accelerometer is not calibrated."""
    del settings
    found = calibrations(calibration).get("accelerometer")
    if found is None:
        return None
    remarks = [
        f"Unit {calibration['unit']}: a = SM raw - bias in m/s^2, SM row by row; the bias comes after the matrix.",
        "Body frame x y z; at rest the upward axis reads + local gravity.",
        "The gyroscope is not in this format: imu_calib takes its mean at start for its bias.",
        *before_use(calibration),
        *left_out({"accelerometer": found}),
        *(f"The {line}." for line in final_errors(validation) if "accelerometer" in line),
    ]
    content = {
        "SM": found.matrix.ravel().tolist(),
        "bias": (found.matrix @ found.bias * STANDARD_GRAVITY).tolist(),
    }
    return comment(remarks) + yaml_text(content)
