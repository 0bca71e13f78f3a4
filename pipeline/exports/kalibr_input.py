"""The noise of the IMU as Kalibr asks for it, ``imu.yaml``.

Densities and random walks are those of the sensor's configuration; the walk that stands for a bias that wanders with
the standard deviation s and the correlation time T has ``s sqrt(2 / T)``. Source: Kalibr, ``ImuConfig`` in
``ConfigReader.py``.
"""

from __future__ import annotations

from typing import Any

from pipeline.exports.kalibr import noise, sampling_rate
from pipeline.exports.sensors import comment, yaml_text

FILE_NAME = "kalibr_imu.yaml"


def export(calibration: dict[str, Any], settings: dict[str, Any], validation: dict[str, Any] | None) -> str:
    """Return the YAML text."""
    del validation
    remarks = [
        f"Unit {calibration['unit']}: input of Kalibr and of filters. m/s^2 and rad/s, per sqrt(Hz) and sqrt(s).",
        "It holds no calibration. Kalibr expects calibrated readings, or finds bias and matrix itself.",
        "Set rostopic to your driver's (that of python -m pipeline apply: <topic>_calibrated).",
    ]
    entry = {**noise(settings), "rostopic": "/imu0", "update_rate": sampling_rate(calibration)}
    return comment(remarks) + yaml_text(entry)
