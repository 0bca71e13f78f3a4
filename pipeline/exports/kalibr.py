"""Kalibr's IMU result (``imu0``).

    a_meas = M_a f_i + b_a,   w_meas = M_g C w_i + A C f_i + b_w

where M_a and M_g are lower triangular (``accelerometers.M``, ``gyroscopes.M``), C is a rotation (``C_gyro_i``), A the
g-sensitivity, and f_i, w_i the truth in Kalibr's IMU frame, which its accelerometer defines. With ``reading = bias +
K truth`` in the body frame, LQ factors give

    K_a = M_a Q_a,   f_i = Q_a f,   K_g Q_a^T = M_g C,   A = G Q_a^T C^T

so nothing of the calibration is lost; Q_a stands in ``T_i_b``. Source: Kalibr, ``IccSensors.py``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.exports.sensors import (
    STANDARD_GRAVITY,
    before_use,
    calibrations,
    comment,
    final_errors,
    forward,
    left_out,
    missing,
    sensor_effects,
    yaml_text,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

FILE_NAME = "kalibr.yaml"
HEADER = """\
Kalibr IMU result. Units: m/s^2, rad/s, s. Each M says measurement = M * truth + b: take off b, then apply the inverse.
Frame i is the one that Kalibr ties to the accelerometer; T_i_b takes body vectors (the table's axes) to it.
OpenVINS reads the same under other names: kalibr_imu_chain.yaml beside this file.
Noise densities and random walks are those of the sensor's configuration; the walks stand for a bias that wanders.
Set rostopic to your driver's; b is not read by Kalibr, subtract it yourself or let the filter find it.
"""


def export(calibration: dict[str, Any], settings: dict[str, Any], validation: dict[str, Any] | None) -> str:
    """Return the YAML text."""
    remarks = [f"Unit {calibration['unit']}.", *HEADER.splitlines()]
    remarks += [*before_use(calibration), *missing(calibration)]
    remarks += [*left_out(calibrations(calibration), ("g_sensitivity",)), *final_errors(validation)]
    return comment(remarks) + yaml_text({"imu0": entry(calibration, settings)})


def entry(calibration: dict[str, Any], settings: dict[str, Any]) -> dict[str, Any]:
    """Return what stands under ``imu0``."""
    found = calibrations(calibration)
    imu: dict[str, Any] = {
        "rostopic": "/imu0",
        "update_rate": sampling_rate(calibration),
        "model": "scale-misalignment",
    }
    imu |= noise(settings)
    rotation = np.eye(3)
    if "accelerometer" in found:
        lower, rotation = lower_times_rotation(forward(found["accelerometer"]))
        bias = found["accelerometer"].bias * STANDARD_GRAVITY
        imu["accelerometers"] = {"M": lower.tolist(), "b": bias.tolist()}
    if "gyroscope" in found:
        imu["gyroscopes"] = _gyroscope(found["gyroscope"], rotation)
    imu["T_i_b"] = np.block([[rotation, np.zeros((3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]]).tolist()
    imu["time_offset"] = 0.0
    return imu


def noise(settings: dict[str, Any]) -> dict[str, float]:
    """Return Kalibr's four noise parameters, from the sensor's configuration: m/s^2, rad/s and their densities."""
    found = {}
    for sensor, unit in (("accelerometer", STANDARD_GRAVITY), ("gyroscope", np.pi / 180.0)):
        sheet = settings["sensor"][sensor]
        found[f"{sensor}_noise_density"] = float(sheet["noise_density"] * unit)
        found[f"{sensor}_random_walk"] = float(sheet["bias_wander"] * np.sqrt(2.0 / sheet["wander_time_s"]) * unit)
    return found


def lower_times_rotation(K: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return L (lower triangular, positive diagonal) and Q (orthonormal) with ``K = L Q``."""
    q, r = np.linalg.qr(K.T)
    sign = np.sign(np.diag(r))
    return (r * sign[:, None]).T, (q * sign).T


def _gyroscope(calibration: Any, rotation: NDArray[np.float64]) -> dict[str, Any]:  # noqa: ANN401
    lower, turn = lower_times_rotation(forward(calibration) @ rotation.T)
    G = sensor_effects(calibration).get("g_sensitivity", np.zeros(9)).reshape(3, 3)
    A = np.radians(G) / STANDARD_GRAVITY @ rotation.T @ turn.T
    bias = np.radians(calibration.bias)
    return {"M": lower.tolist(), "C_gyro_i": turn.tolist(), "A": A.tolist(), "b": bias.tolist()}


def sampling_rate(calibration: dict[str, Any]) -> float:
    """Return the sampling rate of the unit's recordings, Hz; 0 where none is known."""
    rates = [i["rate_hz"] for i in calibration.get("inputs", []) if i.get("rate_hz")]
    return float(rates[0]) if rates else 0.0
