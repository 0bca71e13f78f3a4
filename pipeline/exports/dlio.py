"""The IMU intrinsics of DLIO (direct lidar-inertial odometry), ``dlio/imu/intrinsics``.

    a = sm raw - bias',   sm = matrix,   bias' = matrix @ bias;     w = raw - bias

The gyroscope has no matrix there: the remarks say what that leaves. Source: DLIO, ``odom.cc``, ``callbackImu``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.exports.sensors import (
    STANDARD_GRAVITY,
    before_use,
    calibrations,
    comment,
    final_errors,
    left_out,
    missing,
    no_gyroscope_matrix,
    yaml_text,
)

FILE_NAME = "dlio.yaml"


def export(calibration: dict[str, Any], settings: dict[str, Any], validation: dict[str, Any] | None) -> str:
    """Return the YAML text."""
    del settings
    found = calibrations(calibration)
    remarks = [
        f"Unit {calibration['unit']}: a = sm raw - bias in m/s^2, sm row by row; w = raw - bias in rad/s.",
        "The bias of the accelerometer comes after the matrix.",
        "Body frame x y z, to which DLIO's extrinsics must refer; at rest the upward axis reads + local gravity.",
        *(f"Left out: {line}." for line in missing(calibration)),
        *before_use(calibration),
        *left_out(found),
    ]
    intrinsics: dict[str, Any] = {}
    if "accelerometer" in found:
        c = found["accelerometer"]
        intrinsics["accel"] = {
            "bias": (c.matrix @ c.bias * STANDARD_GRAVITY).tolist(),
            "sm": c.matrix.ravel().tolist(),
        }
    if "gyroscope" in found:
        c = found["gyroscope"]
        remarks.append(no_gyroscope_matrix(c))
        intrinsics["gyro"] = {"bias": np.radians(c.bias).tolist()}
    remarks += [f"With all of the calibration: {line}." for line in final_errors(validation)]
    content = {"dlio": {"imu": {"intrinsics": intrinsics}}}
    return comment(remarks) + yaml_text(content)
