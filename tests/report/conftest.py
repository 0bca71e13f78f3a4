"""One unit whose truth is known: turns about three axes, held-out motion, and the files of the stages about it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from unit_settings import settings_of

from pipeline.core.records import Estimate, Note, Recording, SensorCalibration, StageResult
from pipeline.core.settings import Settings, Stated
from pipeline.physics.kinematics import reference_motion

SIGMA = {"accelerometer": 0.003, "gyroscope": 0.05}
EFFECT = 0.004  # quadratic nonlinearity of the accelerometer, g/g^2, which the calibration does not know


@dataclass
class Unit:
    calibration: dict[str, Any]
    validation: dict[str, Any]
    diagnosis: dict[str, Any]
    recordings: list[Recording]
    settings: Settings

    @property
    def fit(self) -> SensorCalibration:
        return SensorCalibration.from_json("accelerometer", self.calibration["accelerometer"])

    @property
    def arguments(self) -> tuple[Any, ...]:
        return self.calibration, self.validation, self.diagnosis, self.recordings, self.settings


def sensor_truth(sensor: str) -> SensorCalibration:
    if sensor == "accelerometer":
        return SensorCalibration(
            sensor,
            np.array([0.031, -0.022, 0.067]),
            np.array([[0.994, 0.004, -0.002], [0.001, 1.007, 0.003], [-0.005, 0.002, 0.951]]),
            stages=(StageResult("least_squares", {"bias_x": Estimate(0.031, "g")}, SIGMA[sensor]),),
            covariance=np.eye(12) * 1e-8,
            degrees_of_freedom=900.0,
        )
    return SensorCalibration(
        sensor,
        np.array([1.7, -0.9, 0.4]),
        np.array([[1.017, 0.016, -0.019], [-0.013, 1.001, -0.005], [0.014, 0.005, 0.998]]),
        stages=(StageResult("least_squares", {"bias_x": Estimate(1.7, "deg/s")}, SIGMA[sensor]),),
        covariance=np.eye(12) * 1e-6,
        degrees_of_freedom=400.0,
    )


def readings_of(
    force: np.ndarray, rate: np.ndarray, rng: np.random.Generator, effect: float = 0.0
) -> dict[str, np.ndarray]:
    """Return what the sensors read; ``effect``: of the accelerometer, g/g^2."""
    readings = {}
    for sensor, values in (("accelerometer", force), ("gyroscope", rate)):
        known = sensor_truth(sensor)
        squared = effect * values**2 if sensor == "accelerometer" else 0.0
        noise = SIGMA[sensor] * rng.standard_normal(values.shape)
        readings[sensor] = known.bias + values @ np.linalg.solve(known.matrix, np.eye(3)).T + squared + noise
    return readings


def turn(name: str, role: str, axis: str, samples: int, start: float, *, rng: np.random.Generator) -> Recording:
    time = start + 0.12 * np.arange(samples)
    angle = np.linspace(0.0, 360.0, samples)
    rate = np.full(samples, 360.0 / (0.12 * (samples - 1)))
    bare = Recording(
        name=name,
        role=role,
        axis=axis,
        time_ns=np.rint(time * 1e9).astype(np.int64),
        table_angle=angle,
        table_rate=rate,
        temperature=25.0 + 4.0 * (1.0 - np.exp(-(time - start) / 120.0)),
        source={"file": f"raw/U1/{name}.csv", "sha256": "ab" * 32, "rows": samples},
    )
    motion = reference_motion(bare)
    readings = readings_of(motion.specific_force, motion.angular_rate, rng, EFFECT)
    return replace(bare, **readings, notes=(Note("N-GAP", 2, 40, 90, "2 gaps of 0.24 s"),))


def held_out(samples: int, rng: np.random.Generator) -> Recording:
    time = 4000.0 + 0.12 * np.arange(samples)
    direction = rng.standard_normal((samples, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    rate = 40.0 * np.abs(np.sin(time / 30.0))
    readings = readings_of(direction, rate[:, None] * direction[::-1], rng)
    return Recording(
        "validation", "validation", None, np.rint(time * 1e9).astype(np.int64), **readings, table_rate=rate
    )


def steps(values: dict[str, float]) -> list[dict[str, Any]]:
    raw = values["raw"]
    return [
        {
            "name": name,
            "mean_abs_error": 0.8 * rms,
            "sum_abs_error": 800.0 * rms,
            "max_error": 3.0 * rms,
            "min_error": -2.9 * rms,
            "rms_error": rms,
            "change_percent": 100.0 * (raw - rms) / raw,
            "vector_rms_error": 1.7 * rms,
        }
        for name, rms in values.items()
    ]


def ranked(
    effect: str, parameters: dict[str, Any], figures: tuple[float, ...], alike: str = "", *, plausible: bool = True
) -> dict[str, Any]:
    names = ("delta_bic", "p_value", "explained_share", "held_out_error_before", "held_out_error_after")
    look_alikes = [{"effect": alike, "share": 0.94}] if alike else []
    entry = {"effect": effect, "parameters": parameters, "look_alikes": look_alikes, "plausible": plausible}
    return entry | dict(zip(names, figures, strict=True))


def diagnosis_of(sensor: str) -> dict[str, Any]:
    if sensor == "gyroscope":
        return {
            "verdict": "nothing_missing",
            "residual_over_noise": 1.002,
            "selected": [],
            "ranking": [],
            "not_observable": [{"effect": "lever_arm", "reason": "a gyroscope does not feel it"}],
            "unexplained": [],
            "next_experiment": "",
            "override": "",
        }
    k2 = {f"k2_{a}": {"value": EFFECT, "unit": "g/g^2", "expanded_uncertainty": 0.00005} for a in "xyz"}
    c = {f"c_{a}": {"value": 0.0052, "unit": "", "expanded_uncertainty": 1e-4} for a in "xyz"}
    b = {"b_x": {"value": 0.0001, "unit": "g/degC", "expanded_uncertainty": 1e-4}}
    return {
        "verdict": "missing_effect",
        "residual_over_noise": 1.41,
        "selected": ["quadratic_nonlinearity"],
        "ranking": [
            ranked("quadratic_nonlinearity", k2, (2184.2, 0.0, 0.98, 0.0042, 0.0031), "scale_factor_asymmetry"),
            ranked("scale_factor_asymmetry", c, (1710.0, 1e-30, 0.91, 0.0042, 0.0033), "quadratic_nonlinearity"),
            ranked("bias_temperature", b, (3.1, 0.02, 0.01, 0.0042, 0.0042), plausible=False),
        ],
        "not_observable": [{"effect": "lever_arm", "reason": "the table turned too slowly"}],
        "unexplained": [{"covariate": "temperature", "p_value": 0.001}],
        "next_experiment": "record beyond 1 g on a centrifuge, which tells it from scale factor asymmetry",
        "override": "effects.accelerometer=[quadratic_nonlinearity]",
    }


SHEET = {
    "full_scale": 2.0,
    "counts_per_unit": 16384.0,
    "noise_density": 4.0e-4,
    "bias_wander": 1.0e-4,
    "wander_time_s": 100.0,
    "bias": 0.05,
    "scale_factor": 0.03,
    "cross_axis": 0.02,
    "effects": {"quadratic_nonlinearity": 0.005},
}


def build_unit(samples: int = 1500, held_out_samples: int = 2000) -> Unit:
    rng = np.random.default_rng(20190423)
    recordings = [turn(f"accel_{a}", "accelerometer", a, samples, 300.0 * i, rng=rng) for i, a in enumerate("xyz")]
    recordings += [
        turn(f"gyro_{a}", "gyroscope", a, samples // 4, 2000.0 + 90.0 * i, rng=rng) for i, a in enumerate("xyz")
    ]
    recordings.append(held_out(held_out_samples, rng))
    calibration = {
        "schema_version": 1,
        "unit": "U1",
        "status": "ok",
        "error": None,
        "sensor": "mpu6050",
        "table": "acutronic",
        "procedure": "three_axis_turns",
        "method": "reference_least_squares",
        "config_sha256": "cd" * 32,
        "inputs": [
            {**r.source, "notes": [n.__dict__ for n in r.notes]} if r.source else {"file": "raw/U1/validation.csv"}
            for r in recordings
        ],
        "software": {"imu-calibration": "0.1.0", "numpy": np.__version__},
        "accelerometer": sensor_truth("accelerometer").to_json(),
        "gyroscope": sensor_truth("gyroscope").to_json(),
    }
    values = {"raw": 0.0689, "stage:least_squares": 0.0042, "calibrated": 0.0042, "+ quadratic_nonlinearity": 0.0031}
    return Unit(
        calibration=calibration,
        validation={
            "accelerometer": {
                "unit": "g",
                "samples": 2000,
                "noise_floor": 0.003,
                "vector_noise_floor": 0.0052,
                "steps": steps(values),
                "limits": [
                    {"name": "held_out_rms_error", "limit": 0.005, "value": 0.0031, "pass": True},
                    {"name": "bias", "limit": 0.05, "value": 0.067, "pass": False},
                ],
                "pass": False,
            },
            "gyroscope": {
                "unit": "deg/s",
                "samples": 2000,
                "noise_floor": 0.05,
                "vector_noise_floor": None,
                "steps": [s | {"vector_rms_error": None} for s in steps({"raw": 1.724, "calibrated": 0.0512})],
            },
        },
        diagnosis={s: diagnosis_of(s) for s in ("accelerometer", "gyroscope")},
        recordings=recordings,
        settings=settings_of(
            sensor={"name": "mpu6050", "accelerometer": SHEET, "gyroscope": {**SHEET, "bias": 20.0}},
            table={"name": "acutronic"},
        ).replaced(stated=Stated()),
    )


@pytest.fixture
def unit() -> Unit:
    return build_unit()
