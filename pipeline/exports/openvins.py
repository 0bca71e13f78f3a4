"""The IMU's part of an OpenVINS configuration, ``kalibr_imu_chain.yaml``.

    w_i = R_IMUtoGYRO^T Tw^-1 (w_meas - Tg a_i - b_w),   a_i = R_IMUtoACC^T Ta^-1 (a_meas - b_a)

in the frame i that the accelerometer defines. It is Kalibr's result (``pipeline.exports.kalibr``) under other names:
Tw = M_g, R_IMUtoGYRO = C, Ta = M_a, R_IMUtoACC = 1 and Tg = A C, as Kalibr's A acts on the specific force in the frame
of the gyroscope and Tg in frame i. Source: OpenVINS, ``VioManagerOptions.h`` and its documentation of IMU intrinsics.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.exports import kalibr
from pipeline.exports.sensors import before_use, calibrations, comment, final_errors, left_out, missing, yaml_text

FILE_NAME = "kalibr_imu_chain.yaml"
HEADER = """\
OpenVINS. w_i = R_IMUtoGYRO^T Tw^-1 (w_meas - Tg a_i - b), a_i = R_IMUtoACC^T Ta^-1 (a_meas - b), m/s^2 and rad/s.
Frame i is the one that the accelerometer defines; T_i_b takes body vectors (the table's axes) to it.
The filter finds the biases itself; they are given here as remarks.
"""


def export(calibration: dict[str, Any], settings: dict[str, Any], validation: dict[str, Any] | None) -> str:
    """Return the YAML text."""
    imu = kalibr.entry(calibration, settings)
    found = calibrations(calibration)
    one, nothing = np.eye(3).tolist(), np.zeros((3, 3)).tolist()
    accelerometer, gyroscope = imu.pop("accelerometers", {"M": one}), imu.pop("gyroscopes", None)
    gyroscope = gyroscope or {"M": one, "C_gyro_i": one, "A": nothing}
    imu |= {
        "model": "kalibr",
        "Tw": gyroscope["M"],
        "R_IMUtoGYRO": gyroscope["C_gyro_i"],
        "Ta": accelerometer["M"],
        "R_IMUtoACC": one,
        "Tg": (np.array(gyroscope["A"]) @ np.array(gyroscope["C_gyro_i"])).tolist(),
    }
    parts = {"accelerometer": accelerometer, "gyroscope": gyroscope}
    biases = [f"b of the {sensor}: {part['b']}" for sensor, part in parts.items() if "b" in part]
    remarks = [f"Unit {calibration['unit']}.", *HEADER.splitlines(), *biases]
    remarks += [*before_use(calibration), *missing(calibration)]
    remarks += [*left_out(found, ("g_sensitivity",)), *final_errors(validation)]
    return "%YAML:1.0\n" + comment(remarks) + yaml_text({"imu0": imu})
