"""The IMU's part of a Basalt calibration, to be merged into its ``value0``.

    a = (1 + S) raw - b_a,   S lower triangular;     w = (1 + G) raw - b_w          in m/s^2 and rad/s

in the frame i in which S is lower triangular: with ``matrix_a = Q^T (1 + S)``, Q a rotation, ``1 + G = Q matrix_w``.
``calib_accel_bias`` is (b_a, S_11, S_21, S_31, S_22, S_32, S_33), ``calib_gyro_bias`` is (b_w, columns of G). Source:
basalt-headers, ``calib_bias.hpp``.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from pipeline.exports.kalibr import noise, sampling_rate
from pipeline.exports.sensors import STANDARD_GRAVITY, before_use, calibrations, final_errors, left_out, missing

FILE_NAME = "basalt_imu.json"
LOWER = ([0, 1, 2, 1, 2, 2], [0, 0, 0, 1, 1, 2])


def export(calibration: dict[str, Any], settings: dict[str, Any], validation: dict[str, Any] | None) -> str | None:
    """Return the JSON text, None where either sensor is not calibrated: the format demands both."""
    if missing(calibration):
        return None
    found = calibrations(calibration)
    accelerometer, gyroscope = found["accelerometer"], found["gyroscope"]
    q, lower = _rotation_times_lower(accelerometer.matrix)
    full = q.T @ gyroscope.matrix
    remarks = [
        f"Unit {calibration['unit']}: a = (1 + S) raw - b, w = (1 + G) raw - b, m/s^2 and rad/s, in frame i;",
        "R_i_b takes body vectors (the table's axes) to frame i. At rest the upward axis reads +.",
        *before_use(calibration),
        *left_out(found),
        *(f"The {line}." for line in final_errors(validation)),
    ]
    sheet, rate = noise(settings), sampling_rate(calibration)
    content = {
        "comment": " ".join(remarks),
        "R_i_b": q.T.tolist(),
        "calib_accel_bias": [
            *(lower @ accelerometer.bias * STANDARD_GRAVITY).tolist(),
            *(lower - np.eye(3))[LOWER].tolist(),
        ],
        "calib_gyro_bias": [*np.radians(full @ gyroscope.bias).tolist(), *(full - np.eye(3)).T.ravel().tolist()],
        "imu_update_rate": rate,
        "accel_noise_std": [sheet["accelerometer_noise_density"]] * 3,
        "gyro_noise_std": [sheet["gyroscope_noise_density"]] * 3,
        "accel_bias_std": [sheet["accelerometer_random_walk"]] * 3,
        "gyro_bias_std": [sheet["gyroscope_random_walk"]] * 3,
    }
    return json.dumps(content, indent=2, allow_nan=False) + "\n"


def _rotation_times_lower(matrix: Any) -> tuple[Any, Any]:  # noqa: ANN401  (arrays)
    """Return Q (orthonormal) and L (lower triangular, positive diagonal) with ``matrix = Q L``."""
    q, r = np.linalg.qr(matrix[:, ::-1])
    sign = np.sign(np.diag(r))
    return (q * sign)[:, ::-1], (r * sign[:, None])[::-1, ::-1]
