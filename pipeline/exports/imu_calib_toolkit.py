"""The result file of imu-calib-toolkit, as JSON.

    acc = Ca (raw - ba),   gyro = Cg^-1 (raw - bg - Gg acc)          in m/s^2 and rad/s

Source: imu-calib-toolkit, ``apply_imu_calibration.py`` and ``result_summary.py``.
"""

from __future__ import annotations

import json
from typing import Any

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

FILE_NAME = "imu_calib_toolkit.json"


def export(calibration: dict[str, Any], settings: dict[str, Any], validation: dict[str, Any] | None) -> str | None:
    """Return the JSON text, None where either sensor is not calibrated: the consumer demands both."""
    if missing(calibration):
        return None
    found = calibrations(calibration)
    accelerometer, gyroscope = found["accelerometer"], found["gyroscope"]
    G = sensor_effects(gyroscope).get("g_sensitivity", np.zeros(9)).reshape(3, 3)
    notes = [
        f"Unit {calibration['unit']}: m/s^2 and rad/s, body frame x y z; at rest the upward axis reads +.",
        *before_use(calibration),
        *left_out(found, ("g_sensitivity",)),
        *(f"The {line}." for line in final_errors(validation)),
    ]
    content = {
        "model": {
            "forward": {"gyr": "omega_m = Cg * omega + bg + Gg * f", "acc": "a_m = Ca^-1 * a + ba"},
            "inverse": {"gyr": "omega = Cg^-1 * (omega_m - bg - Gg * f)", "acc": "a = Ca * (a_m - ba)"},
            "gsens_term": "calibrated accelerometer",
        },
        "core_outputs": {
            "bg": np.radians(gyroscope.bias).tolist(),
            "ba": (accelerometer.bias * STANDARD_GRAVITY).tolist(),
            "gravity_magnitude": settings["table"]["gravity_g"] * STANDARD_GRAVITY,
            "Ca": accelerometer.matrix.tolist(),
            "Cg": forward(gyroscope).tolist(),
            "Gg": (np.radians(G) / STANDARD_GRAVITY).tolist(),
            "temperature_model_status": "not_available",
            "allan_status": "not_available",
        },
        "summary": {},
        "temperature_model": {},
        "meta": {"unit": calibration["unit"], "notes": notes},
    }
    return json.dumps(content, indent=2, allow_nan=False) + "\n"
