"""``calibration.json`` of Intel RealSense's IMU calibration.

    [x y z]_calibrated = [x y z -1] X,    X = (scale_and_alignment; bias), 4 x 3

in m/s^2 and rad/s: vectors are rows there, so scale_and_alignment is the matrix transposed, row by row, and the bias
comes after it, ``bias' = matrix @ bias``. Source: librealsense, ``rs-imu-calibration.py``.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.exports.sensors import STANDARD_GRAVITY, before_use, calibrations, final_errors, left_out, missing

if TYPE_CHECKING:
    from pipeline.records import SensorCalibration

FILE_NAME = "realsense_calibration.json"


def export(calibration: dict[str, Any], settings: dict[str, Any], validation: dict[str, Any] | None) -> str | None:
    """Return the JSON text, None where either sensor is not calibrated: the device takes both."""
    del settings
    if missing(calibration):
        return None
    found = calibrations(calibration)
    remarks = [
        f"Unit {calibration['unit']}: calibrated = [x y z -1] (scale_and_alignment; bias), rows, m/s^2 and rad/s.",
        "Body frame x y z, to which the camera's extrinsics must refer; at rest the upward axis reads +.",
        *before_use(calibration),
        *left_out(found),
        *(f"The {line}." for line in final_errors(validation)),
    ]
    factors = {"accelerometer": STANDARD_GRAVITY, "gyroscope": float(np.pi / 180.0)}
    imu = {sensor: _part(found[sensor], factor) for sensor, factor in factors.items()}
    return json.dumps({"comment": " ".join(remarks), "imus": [imu]}, indent=2, allow_nan=False) + "\n"


def _part(calibration: SensorCalibration, factor: float) -> dict[str, Any]:
    return {
        "scale_and_alignment": calibration.matrix.T.ravel().tolist(),
        "bias": (calibration.matrix @ calibration.bias * factor).tolist(),
    }
