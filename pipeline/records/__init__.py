"""The data that stages pass to each other: recordings, motions, noise and calibrations (frozen dataclasses)."""

import numpy as np
from numpy.typing import NDArray

from pipeline.records.calibration import (
    NORMAL,
    RECTANGULAR,
    SENSOR_UNITS,
    Contribution,
    FittedEffect,
    SensorCalibration,
    StageResult,
    coverage_factor,
    finite,
)
from pipeline.records.recording import (
    AXES,
    SENSORS,
    Encoding,
    Index,
    Integers,
    Mask,
    Motion,
    Noise,
    Note,
    Recording,
    Values,
    conjugate_product,
    continuous,
    level_in_body,
    median,
    motion_at_rest,
    noise_of_steps,
    rate_of_attitude,
)

Values = NDArray[np.float64]  # an array of floats; shape and unit stand where it is used

__all__ = [
    "AXES",
    "NORMAL",
    "RECTANGULAR",
    "SENSORS",
    "SENSOR_UNITS",
    "Contribution",
    "Encoding",
    "FittedEffect",
    "Index",
    "Integers",
    "Mask",
    "Motion",
    "Noise",
    "Note",
    "Recording",
    "SensorCalibration",
    "StageResult",
    "Values",
    "conjugate_product",
    "continuous",
    "coverage_factor",
    "finite",
    "level_in_body",
    "median",
    "motion_at_rest",
    "noise_of_steps",
    "rate_of_attitude",
]
