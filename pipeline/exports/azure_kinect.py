"""The inertial sensors of an Azure Kinect calibration.

    calibrated = MixingMatrix(T) raw + Bias(T)         in m/s^2 and rad/s

with polynomials of third order in the temperature, degC, low orders first. The bias comes after the matrix and is
added: ``Bias(T) = -matrix @ bias(T)``. A scale factor that follows the temperature is inverted to third order,
``(K + D dT)^-1 = M - M D M dT + ...``. Source: Azure Kinect Sensor SDK, ``calibration.h`` and ``imu.c``.
"""

from __future__ import annotations

import json
from math import comb
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.exports.sensors import (
    OF_THE_BIAS,
    STANDARD_GRAVITY,
    TEMPERATURES,
    before_use,
    bias_polynomial,
    calibrations,
    final_errors,
    left_out,
    missing,
    sensor_effects,
)
from pipeline.model.effects.base import REFERENCE_TEMPERATURE

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.records import SensorCalibration

FILE_NAME = "azure_kinect.json"
ORDER = 4
ORDERS = range(ORDER)
TYPES = {"accelerometer": "Accelerometer", "gyroscope": "Gyro"}
SCALE = "scale_factor_temperature"


def export(calibration: dict[str, Any], settings: dict[str, Any], validation: dict[str, Any] | None) -> str:
    """Return the JSON text."""
    found = calibrations(calibration)
    remarks = [
        f"Unit {calibration['unit']}: calibrated = MixingMatrix(T) raw + Bias(T), m/s^2 and rad/s, T in degC.",
        "Body frame x y z; Rt is the identity. At rest the upward axis reads + local gravity.",
        *before_use(calibration),
        *(f"Left out: {line}." for line in missing(calibration)),
        *left_out(found, (*OF_THE_BIAS, SCALE)),
        *(f"To third order of the temperature, {s}: {SCALE}." for s, c in found.items() if SCALE in sensor_effects(c)),
        "TemperatureBounds are the widest for such parts; narrow them to what was recorded.",
        *(f"The {line}." for line in final_errors(validation)),
    ]
    factors = {"accelerometer": STANDARD_GRAVITY, "gyroscope": float(np.pi / 180.0)}
    sensors = [_sensor(c, factors[s], settings["sensor"][s]["noise_density"]) for s, c in found.items()]
    content = {"comment": " ".join(remarks), "CalibrationInformation": {"InertialSensors": sensors}}
    return json.dumps(content, indent=2, allow_nan=False) + "\n"


def _sensor(calibration: SensorCalibration, factor: float, noise_density: float) -> dict[str, Any]:
    mixing, bias = _polynomials(calibration)
    deviation = np.zeros(3) if calibration.covariance is None else np.sqrt(np.diag(calibration.covariance)[:3])
    return {
        "BiasTemperatureModel": (bias * factor).ravel().tolist(),
        "BiasUncertainty": (deviation * factor).tolist(),
        "Id": "CALIBRATION_InertialSensorId_Unknown",
        "MixingMatrixTemperatureModel": mixing.reshape(9, ORDER).ravel().tolist(),
        "ModelTypeMask": 16,
        "Noise": [noise_density * factor] * 3 + [0.0] * 3,
        "Rt": {"Rotation": np.eye(3).ravel().tolist(), "Translation": [0.0, 0.0, 0.0]},
        "SecondOrderScaling": [0.0] * 9,
        "SensorType": f"CALIBRATION_InertialSensorType_{TYPES[calibration.sensor]}",
        "TemperatureBounds": list(TEMPERATURES),
        "TemperatureC": REFERENCE_TEMPERATURE,
    }


def _polynomials(calibration: SensorCalibration) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the coefficients in T of the matrix, (3, 3, 4) array, and of what is added, (3, 4) array."""
    M = calibration.matrix
    D = np.diag(sensor_effects(calibration).get(SCALE, np.zeros(3)))
    powers = [M]
    while len(powers) < ORDER:
        powers.append(-powers[-1] @ D @ M)
    offset = bias_polynomial(calibration)
    added = np.zeros((3, ORDER))
    for i, power in enumerate(powers):
        for j in range(min(3, ORDER - i)):
            added[:, i + j] -= power @ offset[:, j]
    return _of_temperature(np.stack(powers, axis=2)), _of_temperature(added)


def _of_temperature(coefficients: NDArray[np.float64]) -> NDArray[np.float64]:
    """Turn coefficients in T - 25 degC into those in T, along the last axis: ``(T - 25)^k`` is binomial in T."""
    change = [[comb(k, j) * (-REFERENCE_TEMPERATURE) ** (k - j) if j <= k else 0.0 for j in ORDERS] for k in ORDERS]
    return np.asarray(coefficients @ np.array(change), np.float64)
