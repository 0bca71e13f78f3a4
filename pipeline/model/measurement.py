"""The measurement equation in the forward direction: what a sensor with given parameters reads in a given motion."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.model.effects import effect
from pipeline.model.effects.base import truth

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.records import Motion, SensorCalibration


def predicted_reading(calibration: SensorCalibration, motion: Motion) -> NDArray[np.float64]:
    """Return ``bias + K @ truth + sum of effects``: (n, 3) array, g or deg/s.

    Parameters
    ----------
    calibration : SensorCalibration
    motion : Motion
    """
    K = np.linalg.solve(calibration.matrix, np.eye(3))
    reading = calibration.bias + truth(calibration.sensor, motion) @ K.T
    for fitted in calibration.effects:
        reading = reading + effect(fitted.name).reading(calibration.sensor, motion, K, fitted.values)
    return reading
