"""imu_tk's ``.calib`` of the accelerometer.

    x = T K (raw - B),    T K = matrix,   T_ii = 1,   K diagonal

The file is T, K and B as plain numbers, row by row; what follows them is not read, so remarks stand there. imu_tk
itself fits an upper triangular T, for its frame is bound to the sensor; here T is full, for the frame is the table's.
Source: imu_tk, ``calibration.h``, ``CalibratedTriad_::load``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.exports.sensors import STANDARD_GRAVITY, before_use, calibrations, comment, final_errors, left_out

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.records import SensorCalibration

FILE_NAME = "imu_tk_acc.calib"


def export(calibration: dict[str, Any], settings: dict[str, Any], validation: dict[str, Any] | None) -> str | None:
    """Return the file's text, None where the accelerometer is not calibrated."""
    del settings
    found = calibrations(calibration).get("accelerometer")
    return None if found is None else triad(calibration, found, STANDARD_GRAVITY, validation)


def triad(
    document: dict[str, Any], calibration: SensorCalibration, factor: float, validation: dict[str, Any] | None
) -> str:
    """Return T, K and B of one sensor, its bias times ``factor``, and remarks behind them."""
    sensor = calibration.sensor
    scale = np.diag(calibration.matrix)
    remarks = [
        f"Unit {document['unit']}, {sensor}: T (misalignment), K (scale factors), B (bias); x = T K (raw - B).",
        f"raw and x in {'m/s^2' if sensor == 'accelerometer' else 'rad/s'}, body frame x y z; T is not triangular.",
        "At rest the upward axis of the accelerometer reads + local gravity.",
        *before_use(document),
        *left_out({sensor: calibration}),
        *(f"The {line}." for line in final_errors(validation) if sensor in line),
    ]
    blocks = [calibration.matrix / scale, np.diag(scale), calibration.bias[:, None] * factor]
    return "\n".join(_numbers(block) for block in blocks) + "\n" + comment(remarks)


def _numbers(block: NDArray[np.float64]) -> str:
    return "".join(" ".join(f"{value:.17g}" for value in row) + "\n" for row in block)
