"""A setting of Betaflight's command line.

    acc = raw - zero        (in counts)

Source: Betaflight, ``sensors/acceleration.c``: ``acc_calibration = x,y,z,1`` (1: the calibration is complete).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.exports.sensors import before_use, calibrations, comment, final_errors, forward, left_out

FILE_NAME = "betaflight.txt"


def export(calibration: dict[str, Any], settings: dict[str, Any], validation: dict[str, Any] | None) -> str | None:
    """Return the command, None where the accelerometer is not calibrated or its counts are not known."""
    found = calibrations(calibration)
    counts = settings["sensor"]["accelerometer"].get("counts_per_unit")
    if "accelerometer" not in found or not counts:
        return None
    c = found["accelerometer"]
    share = float(np.linalg.norm(np.eye(3) - forward(c))) / np.sqrt(3.0)
    remarks = [
        f"Unit {calibration['unit']}: acc = raw - zero in whole counts, for a driver with {counts:g} counts per g.",
        "Axes x y z are those of the calibration: they must be the sensor's, before align_acc.",
        "The gyroscope is not in here: Betaflight takes its mean at start for its bias.",
        *before_use(calibration),
        *left_out({"accelerometer": c}),
        f"The matrix of the accelerometer is left out: that leaves about {share:.2g} g at 1 g.",
        *(f"With all of the calibration: {line}." for line in final_errors(validation) if "accelerometer" in line),
    ]
    zero = ",".join(str(round(b * counts)) for b in c.bias.tolist())
    return comment(remarks) + f"set acc_calibration = {zero},1\nsave\n"
