"""A C header for x-io's Fusion.

    calibrated = misalignment * ((uncalibrated - offset) .* sensitivity)         in g and deg/s

with sensitivity = diagonal of the matrix and misalignment = matrix with its columns divided by it. Source: x-io Fusion,
``FusionCalibration.h``, ``FusionCalibrationInertial``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.exports.sensors import before_use, calibrations, comment, final_errors, left_out, missing

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.records import SensorCalibration

FILE_NAME = "fusion_calibration.h"


def export(calibration: dict[str, Any], settings: dict[str, Any], validation: dict[str, Any] | None) -> str:
    """Return the header's text."""
    del settings
    found = calibrations(calibration)
    remarks = [
        f"Unit {calibration['unit']}: misalignment * ((uncalibrated - offset) .* sensitivity), g and deg/s.",
        "Body frame x y z; at rest the upward axis reads + local gravity. Include FusionMath.h before this.",
        *before_use(calibration),
        *(f"Left out: {line}." for line in missing(calibration)),
        *left_out(found),
        *(f"The {line}." for line in final_errors(validation)),
    ]
    return comment(remarks, "// ") + "".join(_declarations(c) for c in found.values())


def _declarations(calibration: SensorCalibration) -> str:
    sensitivity = np.diag(calibration.matrix)
    rows = (calibration.matrix / sensitivity).tolist()
    matrix = ", ".join(_number(x) for row in rows for x in row)
    return (
        f"static const FusionMatrix {calibration.sensor}Misalignment = {{.array = {{{matrix}}}}};\n"
        f"static const FusionVector {calibration.sensor}Sensitivity = {_vector(sensitivity)};\n"
        f"static const FusionVector {calibration.sensor}Offset = {_vector(calibration.bias)};\n"
    )


def _vector(values: NDArray[np.float64]) -> str:
    return "{.array = {" + ", ".join(_number(x) for x in values.tolist()) + "}}"


def _number(value: float) -> str:
    return f"{value!r}f" if "." in repr(value) or "e" in repr(value) else f"{value}.0f"
