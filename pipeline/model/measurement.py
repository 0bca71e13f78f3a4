"""The measurement equation in the forward direction: what a sensor with given parameters reads in a given motion."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.model.effects import effect_of
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
    K = np.asarray(np.linalg.solve(calibration.matrix, np.eye(3)), np.float64)
    motion = felt_motion(calibration, motion)
    reading = calibration.bias + truth(calibration.sensor, motion) @ K.T
    for fitted in calibration.effects:
        if not effect_of(fitted).moves:
            reading = reading + effect_of(fitted).reading(calibration.sensor, motion, K, fitted.values)
    return reading


def felt_motion(calibration: SensorCalibration, motion: Motion) -> Motion:
    """Return the motion that the sensor felt at its time stamps, after the fitted effects of timing.

    Parameters
    ----------
    calibration : SensorCalibration
    motion : Motion
        By the clock of the reference.
    """
    for fitted in calibration.effects:
        motion = effect_of(fitted).moved(motion, fitted.values)
    return motion
