"""What flows between the stages: frozen dataclasses with units in their names or docstrings, and their files."""

from pipeline.records.calibration import FittedEffect, SensorCalibration, StageResult
from pipeline.records.motion import Motion
from pipeline.records.noise import Noise
from pipeline.records.recording import AXES, SENSORS, Encoding, Note, Recording

__all__ = [
    "AXES",
    "SENSORS",
    "Encoding",
    "FittedEffect",
    "Motion",
    "Noise",
    "Note",
    "Recording",
    "SensorCalibration",
    "StageResult",
]
