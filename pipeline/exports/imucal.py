"""imucal's JSON, ``CalibrationInfo.from_json_file``.

    acc = R_a^-1 K_a^-1 (raw - b_a),   gyr = R_g^-1 K_g^-1 (raw - K_ga acc - b_g)

where K is diagonal, the rows of R have unit length, raw is in g and deg/s, acc in m/s^2 and gyr in deg/s. With
``reading = bias + F truth`` (F in reading units per output unit) ``F = K R``, K the lengths of the rows of F. Source:
imucal, ``calibration_info.py`` and ``ferraris_calibration_info.py``, format version 2.0.0.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.exports.sensors import (
    STANDARD_GRAVITY,
    before_use,
    calibrations,
    final_errors,
    forward,
    left_out,
    missing,
    sensor_effects,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

FILE_NAME = "imucal.json"


def export(calibration: dict[str, Any], settings: dict[str, Any], validation: dict[str, Any] | None) -> str | None:
    """Return the JSON text, None where either sensor is not calibrated: the format demands both."""
    del settings
    found = calibrations(calibration)
    if missing(calibration):
        return None
    K_a, R_a = _scale_and_rows(forward(found["accelerometer"]) / STANDARD_GRAVITY)
    K_g, R_g = _scale_and_rows(forward(found["gyroscope"]))
    G = sensor_effects(found["gyroscope"]).get("g_sensitivity", np.zeros(9)).reshape(3, 3)
    remarks = [
        f"Unit {calibration['unit']}. acc = inv(R_a) inv(K_a) (raw - b_a), raw in g, acc in m/s^2;",
        "gyr = inv(R_g) inv(K_g) (raw - K_ga acc - b_g) in deg/s. Body frame x y z; at rest the upward axis reads +.",
        *before_use(calibration),
        *left_out(found, ("g_sensitivity",)),
        *(f"The {line}." for line in final_errors(validation)),
    ]
    content = {
        "acc_unit": "m/s^2",
        "gyr_unit": "deg/s",
        "from_acc_unit": "g",
        "from_gyr_unit": "deg/s",
        "comment": " ".join(remarks),
        "K_a": K_a.tolist(),
        "R_a": R_a.tolist(),
        "b_a": found["accelerometer"].bias.tolist(),
        "K_g": K_g.tolist(),
        "R_g": R_g.tolist(),
        "K_ga": (G / STANDARD_GRAVITY).tolist(),
        "b_g": found["gyroscope"].bias.tolist(),
        "cal_type": "Turntable",
        "_format_version": "2.0.0",
    }
    return json.dumps(content, indent=4, allow_nan=False) + "\n"


def _scale_and_rows(F: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    length = np.linalg.norm(F, axis=1)
    return np.diag(length), F / length[:, None]
