"""Parameters far beyond the sensor file's limits are marked; those of real sensors and of the thesis are not."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from scipy.signal import lfilter

from pipeline.app.steps.calibration import calibrated_range, judged
from pipeline.core.records import Coefficient, FittedEffect, Recording, SensorCalibration
from pipeline.ingest.quality_flags import CLIPPED
from pipeline.physics.compensation import sample_covariance
from pipeline.physics.statements import implausible, limited, sentences
from pipeline.simulation.description import shipped_settings

if TYPE_CHECKING:
    from pipeline.core.settings import DataSheet

CONFIGS = Path(__file__).parents[2] / "configs/sensor"


def sheet(model: str, sensor: str) -> DataSheet:
    return shipped_settings(sensor=model).sensor.of(sensor)


def marked(model: str, sensor: str, K: np.ndarray, bias: float = 0.0, sigma: float = 1e-4, **effects: float) -> Any:
    fitted = tuple(FittedEffect(n, {f"K2_{a}": Coefficient(v, "1/g", 0.0) for a in "xyz"}) for n, v in effects.items())
    covariance = sigma**2 * np.eye(12 + 3 * len(fitted))
    part = SensorCalibration(sensor, np.full(3, bias), np.linalg.inv(K), effects=fitted, covariance=covariance)
    return implausible(limited(sensor, part.to_json(), sheet(model, sensor)))


@pytest.mark.parametrize("model", ["mpu6050", "stim300", "generic"])
@pytest.mark.parametrize(
    ("sensor", "factor", "cause"),
    [
        (
            "accelerometer",
            2.0,
            "was set to another range; set sensor.accelerometer.range, and counts_per_unit of the columns",
        ),
        ("gyroscope", 0.25, "was set to another range; set sensor.gyroscope.range, and counts_per_unit of the"),
        ("gyroscope", 1.55, "was probably set to another range or unit"),
        ("accelerometer", 0.45, "was probably set to another range or unit"),
        ("accelerometer", 9.80665, "in m/s^2, and read as g"),
        ("gyroscope", np.pi / 180.0, "in rad/s, and read as deg/s"),
        ("gyroscope", 180.0 / np.pi, "in deg/s, and read as rad/s"),
    ],
)
def test_another_range_or_unit_is_marked_with_its_cause(model: str, sensor: str, factor: float, cause: str) -> None:
    K = factor * (np.eye(3) + 0.004 * np.arange(9).reshape(3, 3) / 8.0)
    found = marked(model, sensor, K)
    assert {f"scale_factor_{a}" for a in "xyz"} <= {e["parameter"] for e in found}
    scale = next(e for e in found if e["parameter"] == "scale_factor_x")
    assert cause in scale["likely_cause"]
    assert scale["value"] == pytest.approx(factor - 1.0, abs=0.01 * factor)
    assert scale["ratio"] == pytest.approx(abs(scale["value"]) / scale["limit"])
    said = sentences(sensor, {"implausible": found})
    assert f"sensor.{sensor}.accept_implausible=true" in said[0]


def test_sensors_at_their_limits_and_those_of_the_thesis_are_not_marked() -> None:
    """STIM300 of the thesis: bias 17 times its sheet's limit, scale factor 10 times, mounted 1 deg askew."""
    for model in ("mpu6050", "stim300", "generic"):
        for sensor in ("accelerometer", "gyroscope"):
            s = sheet(model, sensor)
            K = (1.0 + s.scale_factor) * np.eye(3) + s.cross_axis * (1.0 - np.eye(3))
            assert marked(model, sensor, K, s.bias) == []
    assert marked("stim300", "accelerometer", 1.003 * np.eye(3), 0.0455) == []


def test_a_mounting_that_is_askew_is_no_property_of_the_sensor() -> None:
    c, s = np.cos(np.radians(10.0)), np.sin(np.radians(10.0))
    assert marked("stim300", "gyroscope", np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])) == []


def test_one_axis_a_bias_a_cross_axis_term_and_an_effect_are_named() -> None:
    found = marked("mpu6050", "accelerometer", np.diag([1.0, 0.2, 1.0]))
    assert [e["parameter"] for e in found] == ["scale_factor_y"]
    assert "damaged axis" in found[0]["likely_cause"]
    found = marked("mpu6050", "accelerometer", np.eye(3), 0.5)
    assert {e["parameter"] for e in found} == {"bias_x", "bias_y", "bias_z"}
    assert {e["unit"] for e in found} == {"g"}
    found = marked("mpu6050", "accelerometer", np.eye(3) + 0.1 * np.eye(3)[[1, 0, 2]] * [1, 1, 0])
    assert [e["parameter"] for e in found] == ["cross_axis_xy"]
    assert found[0]["value"] == pytest.approx(0.1)
    found = marked("mpu6050", "accelerometer", np.eye(3), quadratic_nonlinearity=0.05)
    assert found[0]["parameter"] == "quadratic_nonlinearity.K2_x"
    assert found[0]["ratio"] == pytest.approx(5.0)
    assert marked("mpu6050", "accelerometer", np.eye(3), quadratic_nonlinearity=0.035) == []


def test_what_is_not_known_well_enough_is_not_marked() -> None:
    assert marked("mpu6050", "accelerometer", np.eye(3), 0.5, sigma=0.1) == []
    fitted = FittedEffect("quadratic_nonlinearity", {f"K2_{a}": Coefficient(0.5, "1/g") for a in "xyz"})
    part = SensorCalibration("accelerometer", effects=(fitted,)).to_json()
    assert implausible(limited("accelerometer", part, sheet("mpu6050", "accelerometer"))) == []


def test_the_user_can_accept_them() -> None:
    part = SensorCalibration("gyroscope", matrix=0.5 * np.eye(3)).to_json()
    plain, meant = (
        judged("gyroscope", part, sheet("mpu6050", "gyroscope").replaced(accept_implausible=bool(a))) for a in (0, 1)
    )
    assert [e["ratio"] for e in plain["implausible"]] == pytest.approx([1.0 / 0.03] * 3)
    assert meant["implausible"] == []
    assert meant["implausible_accepted"] == plain["implausible"]


def test_the_calibrated_range_is_that_of_the_sound_samples_of_the_fits() -> None:
    def recording(role: str, force: float, rate: float, warmth: float) -> Recording:
        ramp = np.linspace(0.1, 1.0, 10)
        flags = np.where(np.arange(10) == 9, CLIPPED, 0).astype(np.uint16)  # the largest is clipped
        vectors = (size * np.outer(ramp, [0.6, 0.0, -0.8]) for size in (force, rate))
        return Recording(role, role, None, np.arange(10) * 10**8, *vectors, temperature=warmth * ramp, flags=flags)

    fitted = [recording("accelerometer", 1.0, 700.0, 30.0), recording("gyroscope", 3.0, 200.0, 40.0)]
    others = [recording("validation", 4.0, 900.0, 60.0), recording("static", 5.0, 800.0, 1.0)]
    found = calibrated_range([*fitted, *others])
    assert found == {"specific_force_g": 0.9, "angular_rate_dps": 180.0, "temperature_degc": [3.0, 40.0]}


def test_the_covariance_of_a_sample_is_that_of_simulated_samples_without_slow_wander() -> None:
    """Truth: an angle with rounding errors, white noise and two processes, written out sample by sample."""
    rng = np.random.default_rng(8)
    n, dt, white, rounding, fast, slow = 200_000, 0.01, 0.002, 1e-4, 0.015, 0.5
    rounded = rounding * rng.normal(size=(n + 1, 3))
    readings = white / np.sqrt(dt) * rng.normal(size=(n, 3)) + np.diff(rounded, axis=0) / dt
    for size, time in ((fast, 0.03), (slow, 40_000.0)):
        kept = np.exp(-dt / time)
        steps = size * np.sqrt(1.0 - kept**2) * rng.normal(size=(n, 3))
        readings += lfilter([1.0], [1.0, -kept], steps, axis=0)
    M = np.array([[1.02, 0.01, 0.0], [0.2, 0.97, -0.03], [0.0, 0.3, 1.01]])
    calibrated = readings @ M.T
    apart = calibrated[100:] - calibrated[:-100]  # 1 s: the slow process hardly changes, the rest is independent
    expected = apart.T @ apart / (2.0 * len(apart))
    processes = [(fast, 0.03), (slow, 40_000.0)]
    wander = [{"value": size, "correlation_time_s": {"value": time}} for size, time in processes]
    terms = {"white": {"value": white}, "quantisation": {"value": rounding}, "gauss_markov": wander}
    noise = {"sampling_interval_s": dt, "axes": {axis: {"terms": terms} for axis in "xyz"}}
    covariance = sample_covariance({"noise": {"gyroscope": noise}, "gyroscope": {"matrix": M.tolist()}}, "gyroscope")
    assert covariance is not None
    size = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(covariance / np.outer(size, size), expected / np.outer(size, size), atol=0.04)
