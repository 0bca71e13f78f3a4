"""Settings of INAV's command line.

    accADC = (raw - acczero) * accgain / 4096        (axis by axis, in counts)

Source: INAV, ``sensors/acceleration.c``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.exports.sensors import axis_by_axis, before_use, calibrations, comment, final_errors

FILE_NAME = "inav.txt"
ONE = 4096


def export(calibration: dict[str, Any], settings: dict[str, Any], validation: dict[str, Any] | None) -> str | None:
    """Return the commands, None where the accelerometer is not calibrated or its counts are not known."""
    found = calibrations(calibration)
    counts = settings["sensor"]["accelerometer"].get("counts_per_unit")
    if "accelerometer" not in found or not counts:
        return None
    values, lost = axis_by_axis(calibration)
    zero = np.rint(found["accelerometer"].bias * counts).astype(int).tolist()
    gain = np.rint(values["accelerometer_scale"] * ONE).astype(int).tolist()
    gravity = round(980.665 * settings["table"]["gravity_g"])
    remarks = [
        f"Unit {calibration['unit']}: (raw - acczero) * accgain / {ONE}, axis by axis, for a driver with",
        f"{counts:g} counts per g (scale acczero where yours has others).",
        "Whole numbers: up to half a count and 1.2e-4 of the scale are lost.",
        "Axes x y z are those of the calibration: they must be the sensor's, before align_acc.",
        "The gyroscope is not in here: INAV takes its mean at start for its bias.",
        *before_use(calibration),
        *lost,
        *(f"With all of the calibration: {line}." for line in final_errors(validation)),
    ]
    lines = [f"set acczero_{a} = {z}\n" for a, z in zip("xyz", zero, strict=True)]
    lines += [f"set accgain_{a} = {g}\n" for a, g in zip("xyz", gain, strict=True)]
    return comment(remarks) + "".join(lines) + f"set ins_gravity_cmss = {gravity}\nsave\n"
