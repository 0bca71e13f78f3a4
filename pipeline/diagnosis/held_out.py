"""What an effect does to samples that no fit has seen.

Where the held-out recording has a table's motion, the error is the rms length of ``matrix (reading - model)``; it sees
rotations too. Elsewhere it is the rms of the magnitude of the calibrated reading less gravity or the table's rate.

Noise alone would leave

    floor = sqrt(tr(M D M^T)),      D = white^2 gain^2 + wander^2

of the vector's error with the calibration matrix M, the white noise behind a filter of that gain, and the bias wander
(``pipeline.records.Noise``); of the magnitude's, not more.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.estimation.joint import calibration_of
from pipeline.estimation.observations import through_filter
from pipeline.model.compensation import Compensation
from pipeline.model.kinematics import earth_rate, reference_motion
from pipeline.model.measurement import predicted_reading

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.estimation.joint import Fit
    from pipeline.estimation.observations import Observations
    from pipeline.records import Motion, Noise, Recording, SensorCalibration


def held_out_error(
    fit: Fit, observations: Observations, recordings: Sequence[Recording], table: Mapping[str, Any]
) -> float | None:
    """Return the rms error on the recordings of role ``validation``, g or deg/s; None where there is none.

    Parameters
    ----------
    fit : Fit
    observations : Observations
        Those of the fit.
    recordings : sequence of Recording
    table : mapping
        Section of the configuration.
    """
    calibration = calibration_of(observations.sensor, fit, observations, None)
    errors = [
        error
        for recording in recordings
        if recording.role == "validation" and (error := _errors(calibration, recording, table)) is not None
    ]
    if not errors:
        return None
    together = np.concatenate(errors)
    together = together[np.isfinite(together)]
    return float(np.sqrt(np.mean(together))) if len(together) else None


def held_out_floor(fit: Fit, recordings: Sequence[Recording], noise: Noise | None) -> float | None:
    """Return the rms error that noise alone leaves on the recordings of role ``validation``, g or deg/s.

    Parameters
    ----------
    fit : Fit
    recordings : sequence of Recording
    noise : Noise or None
        None gives None.
    """
    held = [r for r in recordings if r.role == "validation"]
    if noise is None or not held:
        return None
    gain = max(float(r.filter.get("noise_gain", 1.0)) for r in held)
    variance = (gain * noise.white) ** 2 + noise.wander**2
    return float(np.sqrt(np.sum(np.linalg.solve(fit.K, np.diag(np.sqrt(variance))) ** 2)))


def _errors(
    calibration: SensorCalibration, recording: Recording, table: Mapping[str, Any]
) -> NDArray[np.float64] | None:
    """Return the squared error of each sample."""
    reading = recording.reading(calibration.sensor)
    if reading is None or recording.samples < 6:
        return None
    motion = _motion(recording, table)
    if motion is not None:
        rest = reading - predicted_reading(calibration, motion)
        squares: NDArray[np.float64] = np.sum((rest @ calibration.matrix.T) ** 2, axis=1)
        return squares
    reference: NDArray[np.float64] | float | None = recording.table_rate
    if calibration.sensor == "accelerometer":
        reference = float(table.get("gravity_g") or 1.0)
    if reference is None:
        return None
    magnitude = np.linalg.norm(_compensated(calibration, recording), axis=1)
    return np.asarray((magnitude - np.abs(reference)) ** 2, np.float64)


def _motion(recording: Recording, table: Mapping[str, Any]) -> Motion | None:
    latitude, azimuth = table.get("latitude_deg"), table.get("azimuth_deg")
    earth = None if latitude is None or azimuth is None else earth_rate(float(latitude), float(azimuth))
    motion = reference_motion(recording, float(table.get("gravity_g") or 1.0), earth)
    return motion if motion is None or recording.filter["name"] == "none" else through_filter(motion, recording)


def _compensated(calibration: SensorCalibration, recording: Recording) -> NDArray[np.float64]:
    """Return the calibrated readings, without the effects of mounting and table."""
    sensor = calibration.sensor
    compensation = Compensation(
        calibration if sensor == "accelerometer" else None, calibration if sensor == "gyroscope" else None
    )
    out = compensation.apply(recording.accelerometer, recording.gyroscope, recording.temperature, recording.time)
    found = out.accelerometer if sensor == "accelerometer" else out.gyroscope
    assert found is not None  # noqa: S101
    return found
