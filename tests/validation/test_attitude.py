"""The attitude of a calibrated unit, against motions whose attitude is known in closed form."""

from math import cos, radians, sin
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.core.records import Recording, SensorCalibration
from pipeline.evaluation.held_out.attitude import angle_between, attitude, drift, integrate

STILL = np.array([1.0, 0.0, 0.0, 0.0])


def coning(time: np.ndarray[Any, Any], half_angle: float = 20.0, turns: float = 0.5) -> tuple[Any, Any]:
    """Return attitude and angular rate (deg/s) of an axis that goes round a cone.

    Source of the closed form: P. Savage, Strapdown Analytics (2000), section 10.1.1.1 (pure coning).
    """
    a, w = radians(half_angle), 2.0 * np.pi * turns
    q = np.stack(
        [np.full_like(time, cos(a / 2)), sin(a / 2) * np.cos(w * time), sin(a / 2) * np.sin(w * time), 0 * time], 1
    )
    rate = w * np.stack(
        [-sin(a) * np.sin(w * time), sin(a) * np.cos(w * time), np.full_like(time, -2 * sin(a / 2) ** 2)], 1
    )
    return q, np.degrees(rate)


def recording(time: np.ndarray[Any, Any], q: Any, rate: Any, force: Any = None) -> Recording:
    return Recording(
        "validation",
        "validation",
        None,
        np.rint(time * 1e9).astype(np.int64),
        accelerometer=force,
        gyroscope=rate,
        table_attitude=q,
    )


def ideal(sensor: str) -> SensorCalibration:
    return SensorCalibration(sensor, np.zeros(3), np.eye(3))


def test_a_coning_motion_is_integrated_far_beyond_second_order() -> None:
    errors = []
    for interval in (0.04, 0.02):
        time = np.arange(0.0, 60.0 + interval / 2, interval)
        q, rate = coning(time)
        errors.append(float(angle_between(integrate(time, rate, q[0]), q.T)[-1]))
    assert errors[1] < 2e-3  # of 1800 deg of turning in a minute; the trapezoid rule leaves 0.4
    assert errors[0] / errors[1] > 8.0


def test_a_bias_at_rest_drifts_by_itself_times_a_minute() -> None:
    time = np.arange(0.0, 150.0, 0.05)
    q = np.tile(STILL, (len(time), 1))
    estimate = integrate(time, np.tile([0.0, 0.0, 0.02], (len(time), 1)), STILL)
    assert drift(time, estimate, q.T, 60.0) == pytest.approx(1.2, rel=1e-9)


def test_calibration_takes_away_the_drift_and_the_tilt_that_the_sensors_errors_make() -> None:
    time = np.arange(0.0, 120.0, 0.02)
    q, rate = coning(time, half_angle=8.0, turns=0.1)
    force = Rotation.from_quat(q[:, [1, 2, 3, 0]]).inv().apply([0.0, 0.0, 1.0])
    bias = {"accelerometer": np.array([0.03, 0.0, 0.01]), "gyroscope": np.array([0.0, 0.0, 0.5])}
    matrix = np.diag([1.0, 0.99, 1.01])
    fits = {s: SensorCalibration(s, b, matrix) for s, b in bias.items()}
    read = {s: bias[s] + values / np.diag(matrix) for s, values in (("accelerometer", force), ("gyroscope", rate))}
    found = attitude(*fits.values(), [recording(time, q, read["gyroscope"], read["accelerometer"])])
    assert found["reason"] is None
    assert found["drift_deg"]["before"] == pytest.approx(30.0, rel=0.05)  # 0.5 deg/s for a minute, and the scale
    assert found["drift_deg"]["after"] < 0.001
    assert found["tilt_rms_deg"]["before"] == pytest.approx(np.degrees(0.03), rel=0.3)
    assert found["tilt_rms_deg"]["after"] < 0.02
    assert len(found["curve"]["time_s"]) == len(found["curve"]["tilt_after"]) == 120


def test_readings_that_a_filter_made_late_are_held_against_the_attitude_of_then() -> None:
    time = np.arange(0.0, 120.0, 0.02)
    q, rate = coning(time, turns=0.11)
    _, late = coning(time - 0.3, turns=0.11)
    plain, unsaid = recording(time, q, rate), recording(time, q, late)
    said = Recording(**{**vars(unsaid), "filter": {"name": "rc_low_pass", "delay_s": 0.3, "noise_gain": 1.0}})
    drifts = [attitude(None, ideal("gyroscope"), [r])["drift_deg"]["after"] for r in (plain, said, unsaid)]
    assert max(drifts[:2]) < 0.001
    assert drifts[2] > 0.1


@pytest.mark.parametrize(
    ("fit", "q", "length", "reason"),
    [
        (None, STILL, 60.0, "the gyroscope is not calibrated"),
        (ideal("gyroscope"), None, 60.0, "no held-out recording logs the table's attitude"),
        (ideal("gyroscope"), STILL, 5.0, "recording validation is shorter than 10 s"),
    ],
)
def test_without_an_attitude_to_compare_with_there_is_a_reason(fit: Any, q: Any, length: float, reason: str) -> None:
    time = np.arange(0.0, length, 0.1)
    made = recording(time, None if q is None else np.tile(q, (len(time), 1)), np.zeros((len(time), 3)))
    assert attitude(None, fit, [made]) == {"reason": reason}
