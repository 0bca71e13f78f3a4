"""Robotics and autopilot formats, read back by each consumer's own formula."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from stage_files import export_all
from unit_settings import settings_of

from pipeline import load_calibration
from pipeline.core.records import Coefficient, FittedEffect, SensorCalibration
from pipeline.output.exports.sensors import ExportedSensor

G0 = 9.80665
BIAS = {"accelerometer": np.array([0.031, -0.022, 0.067]), "gyroscope": np.array([1.7, -0.9, 0.4])}
MATRIX = {
    "accelerometer": np.array([[0.994, 0.004, -0.002], [0.021, 1.007, 0.003], [-0.005, 0.012, 0.951]]),
    "gyroscope": np.array([[1.017, 0.016, -0.019], [-0.013, 1.001, -0.005], [0.014, 0.005, 0.998]]),
}
SENSITIVITY = np.array([[0.1, -0.02, 0.03], [0.0, 0.08, -0.05], [0.01, 0.02, -0.09]])
SHEET = {"noise_density": 1e-3, "bias_wander": 1e-4, "wander_time_s": 100.0}
SETTINGS = settings_of(sensor={s: SHEET | {"counts_per_unit": 16384.0} for s in BIAS})


def document(*, sensitive: bool = False) -> dict[str, Any]:
    names = [f"G_{a}{b}" for a in "xyz" for b in "xyz"]
    named = zip(names, SENSITIVITY.ravel(), strict=True)
    g_sensitivity = FittedEffect("g_sensitivity", {n: Coefficient(float(v), "deg/s/g") for n, v in named})
    out: dict[str, Any] = {"unit": "U1\nreboot", "schema_version": 1, "status": "ok", "sensor": "mpu6050", "inputs": []}
    for sensor, bias in BIAS.items():
        effects = (g_sensitivity,) if sensitive and sensor == "gyroscope" else ()
        out[sensor] = SensorCalibration(sensor, bias, MATRIX[sensor], effects=effects).to_json()
    return out


@pytest.fixture
def readings() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(8)
    return rng.uniform(-1.5, 1.5, (200, 3)), rng.uniform(-200, 200, (200, 3))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    export_all(document(), SETTINGS, tmp_path)
    return tmp_path


def calibrated(sensor: str, reading: np.ndarray) -> np.ndarray:
    return (reading - BIAS[sensor]) @ MATRIX[sensor].T


@pytest.mark.parametrize(
    ("name", "sensor", "factor"), [("acc", "accelerometer", G0), ("gyro", "gyroscope", np.pi / 180.0)]
)
def test_imu_tk_reads_fifteen_numbers_that_calibrate(
    folder: Path, readings: tuple[np.ndarray, np.ndarray], name: str, sensor: str, factor: float
) -> None:
    words = (folder / f"imu_tk_{name}.calib").read_text().split()
    numbers = np.array(words[:21], float)
    assert words[21] == "#"
    T, K, B = numbers[:9].reshape(3, 3), numbers[9:18].reshape(3, 3), numbers[18:]
    raw = readings[0 if sensor == "accelerometer" else 1]
    np.testing.assert_allclose((raw * factor - B) @ (T @ K).T / factor, calibrated(sensor, raw), atol=1e-11)
    assert np.diag(T).tolist() == [1.0, 1.0, 1.0]
    assert np.count_nonzero(K) == 3


def test_imucal_inverts_its_two_factors_and_takes_off_the_g_sensitivity(
    tmp_path: Path, readings: tuple[np.ndarray, np.ndarray]
) -> None:
    made = document(sensitive=True)
    export_all(made, SETTINGS, tmp_path)
    c = json.loads((tmp_path / "imucal.json").read_text())
    m = {k: np.array(v) for k, v in c.items() if k[:2] in ("K_", "R_", "b_")}
    acc = (np.linalg.inv(m["R_a"]) @ np.linalg.inv(m["K_a"]) @ (readings[0] - m["b_a"]).T).T
    offsets = (m["K_ga"] @ acc.T).T + m["b_g"]
    gyr = (np.linalg.inv(m["R_g"]) @ np.linalg.inv(m["K_g"]) @ (readings[1] - offsets).T).T
    (tmp_path / "U1.json").write_text(json.dumps(made))
    expected = load_calibration(tmp_path / "U1.json").apply(*readings)
    np.testing.assert_allclose(acc / G0, expected.accelerometer, atol=1e-12)
    np.testing.assert_allclose(gyr, expected.gyroscope, atol=1e-10)
    assert (c["acc_unit"], c["gyr_unit"], c["from_acc_unit"], c["from_gyr_unit"]) == ("m/s^2", "deg/s", "g", "deg/s")
    assert (c["cal_type"], c["_format_version"]) == ("Turntable", "2.0.0")


@pytest.mark.parametrize("name", ["imu_calib.yaml", "dlio.yaml"])
def test_the_bias_comes_after_the_matrix_where_the_consumer_takes_it_off_there(
    folder: Path, readings: tuple[np.ndarray, np.ndarray], name: str
) -> None:
    content = yaml.safe_load((folder / name).read_text())
    part = content if name == "imu_calib.yaml" else content["dlio"]["imu"]["intrinsics"]["accel"]
    matrix = np.array(part["SM" if name == "imu_calib.yaml" else "sm"]).reshape(3, 3)
    out = (readings[0] * G0) @ matrix.T - part["bias"]
    np.testing.assert_allclose(out / G0, calibrated("accelerometer", readings[0]), atol=1e-12)


def parameters(folder: Path, name: str) -> dict[str, float]:
    lines = [line.split() for line in (folder / name).read_text().splitlines() if not line.startswith("#")]
    if name == "px4.params":
        assert all(line[0] == line[1] == "1" and line[4] == "9" for line in lines)
        lines = [line[2:4] for line in lines]
    return {key: float(value) for key, value in lines}


@pytest.mark.parametrize(
    ("name", "offset", "scale", "rate"),
    [
        ("px4.params", "CAL_ACC0_{}OFF", "CAL_ACC0_{}SCALE", "CAL_GYRO0_{}OFF"),
        ("ardupilot.param", "INS_ACCOFFS_{}", "INS_ACCSCAL_{}", "INS_GYROFFS_{}"),
    ],
)
def test_an_autopilots_axis_by_axis_correction_leaves_what_its_header_says(
    folder: Path, name: str, offset: str, scale: str, rate: str
) -> None:
    found = parameters(folder, name)
    rng = np.random.default_rng(5)
    truth = rng.standard_normal((20_000, 3))
    truth /= np.linalg.norm(truth, axis=1)[:, None]
    left = {}
    raw = (truth @ np.linalg.inv(MATRIX["accelerometer"]).T + BIAS["accelerometer"]) * G0
    out = (raw - [found[offset.format(a)] for a in "XYZ"]) * [found[scale.format(a)] for a in "XYZ"]
    left["accelerometer"] = np.sqrt(np.mean(np.sum((out / G0 - truth) ** 2, axis=1)))
    raw = np.radians(100.0 * truth @ np.linalg.inv(MATRIX["gyroscope"]).T + BIAS["gyroscope"])
    out = np.degrees(raw - [found[rate.format(a)] for a in "XYZ"])
    left["gyroscope"] = np.sqrt(np.mean(np.sum((out / 100.0 - truth) ** 2, axis=1)))
    header = (folder / name).read_text()
    assert f"that leaves about {left['accelerometer']:.2g} g at 1 g" in header
    assert f"that leaves about {100 * left['gyroscope']:.2g} % of the rate" in header


def test_the_diagonal_that_stands_for_a_matrix_is_the_best_one() -> None:
    c = SensorCalibration("accelerometer", BIAS["accelerometer"], MATRIX["accelerometer"])
    found = ExportedSensor(c, "g", None)
    scale, error = found.scale, found.scale_error
    K = np.linalg.inv(MATRIX["accelerometer"])
    for change in (0.0, 1e-3, -1e-3):
        left = np.linalg.norm(np.eye(3) - np.diag(scale * (1.0 + change)) @ K) / np.sqrt(3.0)
        assert left == pytest.approx(error) if change == 0.0 else left > error


def test_a_sensor_that_was_not_calibrated_is_in_no_format(tmp_path: Path) -> None:
    made = document() | {"gyroscope": None, "not_calibrated": {"gyroscope": "no turns"}}
    names = {p.name for p in export_all(made, SETTINGS, tmp_path)}
    assert {"imu_tk_gyro.calib", "imucal.json"} & names == set()
    assert {"imu_tk_acc.calib", "imu_calib.yaml", "dlio.yaml", "px4.params", "ardupilot.param"} <= names
    for name in ("dlio.yaml", "px4.params", "ardupilot.param"):
        text = (tmp_path / name).read_text()
        assert "the gyroscope is not calibrated: no turns" in text
        assert "GYROFF" not in text
        assert "gyro:" not in text


def test_a_units_name_cannot_leave_its_comment(folder: Path) -> None:
    for file in folder.iterdir():
        assert not any(line.startswith("reboot") for line in file.read_text().splitlines()), file.name
