"""The data that stages pass to each other: recordings, motions, noise and calibrations (frozen dataclasses)."""

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
from pipeline.records.motion import (
    Motion,
    conjugate_product,
    continuous,
    level_in_body,
    motion_at_rest,
    rate_of_attitude,
)
from pipeline.records.recording import AXES, SENSORS, Encoding, Noise, Note, Recording, median, noise_of_steps

__all__ = [
    "AXES",
    "NORMAL",
    "RECTANGULAR",
    "SENSORS",
    "SENSOR_UNITS",
    "Contribution",
    "Encoding",
    "FittedEffect",
    "Motion",
    "Noise",
    "Note",
    "Recording",
    "SensorCalibration",
    "StageResult",
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
