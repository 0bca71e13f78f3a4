"""imu_tk's ``.calib`` of the gyroscope: as that of the accelerometer, in rad/s."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.exports.imu_tk_accelerometer import triad
from pipeline.exports.sensors import calibrations

FILE_NAME = "imu_tk_gyro.calib"


def export(calibration: dict[str, Any], settings: dict[str, Any], validation: dict[str, Any] | None) -> str | None:
    """Return the file's text, None where the gyroscope is not calibrated."""
    del settings
    found = calibrations(calibration).get("gyroscope")
    return None if found is None else triad(calibration, found, float(np.pi / 180.0), validation)
