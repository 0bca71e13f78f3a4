"""The IMU section of a Paparazzi airframe.

    scaled = (raw - NEUTRAL) * SENS        (axis by axis; raw in counts, scaled in 2^-10 m/s^2 and 2^-12 rad/s)

Source: Paparazzi, ``subsystems/imu.c``, ``ACCEL_BFP_OF_REAL`` and ``RATE_BFP_OF_REAL``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.exports.sensors import STANDARD_GRAVITY, before_use, calibrations, diagonal, final_errors, left_out

FILE_NAME = "paparazzi_imu.xml"
NAMES = {
    "accelerometer": ("ACCEL", STANDARD_GRAVITY * 2**10),
    "gyroscope": ("GYRO", float(np.pi / 180.0) * 2**12),
}


def export(calibration: dict[str, Any], settings: dict[str, Any], validation: dict[str, Any] | None) -> str | None:
    """Return the section's text, None where the counts of the sensors are not known."""
    found = calibrations(calibration)
    if not all(settings["sensor"][sensor].get("counts_per_unit") for sensor in found):
        return None
    remarks = [
        f"Unit {calibration['unit']}: (raw - NEUTRAL) * SENS, raw in counts, axis by axis.",
        "Axes x y z are those of the calibration: they must be the sensor's, before BODY_TO_IMU.",
        *before_use(calibration),
        *left_out(found),
    ]
    lines = []
    for sensor, c in found.items():
        name, factor = NAMES[sensor]
        counts = settings["sensor"][sensor]["counts_per_unit"]
        scale, error = diagonal(c)
        what = f"{error:.2g} g at 1 g" if sensor == "accelerometer" else f"{100 * error:.2g} % of the rate"
        remarks.append(f"Cross-axis terms of the {sensor} are left out: that leaves about {what}.")
        for a, neutral, sens in zip("XYZ", c.bias * counts, scale / counts * factor, strict=True):
            lines.append(f'  <define name="{name}_{a}_NEUTRAL" value="{neutral:.9g}"/>\n')
            lines.append(f'  <define name="{name}_{a}_SENS" value="{sens:.9g}" integer="16"/>\n')
    remarks += [f"With all of the calibration: {line}." for line in final_errors(validation)]
    text = "".join(f"  <!-- {_safe(r)} -->\n" for r in remarks)
    return f'<section name="IMU" prefix="IMU_">\n{text}{"".join(lines)}</section>\n'


def _safe(remark: str) -> str:
    return " ".join(remark.split()).replace("--", "- -")
