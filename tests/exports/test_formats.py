"""Every format, read back by its consumer's own formula, gives what the calibration gives."""

import configparser
import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from stage_files import export_all

from pipeline.app.commands.convert import main as convert
from pipeline.core.errors import ConfigurationError
from pipeline.core.records import Coefficient, FittedEffect, SensorCalibration
from pipeline.core.settings import Settings
from pipeline.output import exports
from pipeline.output.exports import formats
from pipeline.output.exports.reading import read_any
from pipeline.output.exports.sensors import lower_times_rotation
from pipeline.physics.effects import effect
from pipeline.simulation.description import shipped_settings

FILES = {
    *("ardupilot.param", "azure_kinect.json", "basalt_imu.json", "betaflight.txt", "calibration.h", "dlio.yaml"),
    *("fusion_calibration.h", "imu_calib.yaml", "imu_calib_toolkit.json", "imu_tk_acc.calib", "imu_tk_gyro.calib"),
    *("imucal.json", "inav.txt", "kalibr.yaml", "kalibr_imu.yaml", "kalibr_imu_chain.yaml", "paparazzi_imu.xml"),
    *("px4.params", "realsense_calibration.json"),
}
EXAMPLE = (Path(__file__).parent / "my_flight_controller.j2").read_text()
ACCELEROMETER = np.array([[0.994, 0.004, -0.002], [0.021, 1.007, 0.003], [-0.005, 0.012, 0.951]])
GYROSCOPE = np.array([[1.017, 0.016, -0.019], [-0.013, 1.001, -0.005], [0.014, 0.005, 0.998]])


def fitted(name: str, sensor: str, size: float, rng: np.random.Generator) -> FittedEffect:
    values = size * rng.uniform(-1, 1, len(effect(name).parameters(sensor)))
    named = zip(effect(name).parameters(sensor), values, strict=True)
    return FittedEffect(name, {p.name: Coefficient(v, p.unit, 0.0) for p, v in named})


def document(effects: dict[str, dict[str, float]], seed: int = 3) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    parts = {
        "accelerometer": (np.array([0.031, -0.022, 0.067]), ACCELEROMETER),
        "gyroscope": (np.array([1.7, -0.9, 0.4]), GYROSCOPE),
    }
    out: dict[str, Any] = {
        "unit": "U1 */",
        "schema_version": 1,
        "status": "ok",
        "sensor": "mpu6050",
        "inputs": [{"rate_hz": 100.0}],
    }
    for sensor, (bias, matrix) in parts.items():
        chosen = tuple(fitted(n, sensor, size, rng) for n, size in effects.get(sensor, {}).items())
        out[sensor] = SensorCalibration(sensor, bias, matrix, effects=chosen).to_json()
    return out


@pytest.fixture
def settings() -> Settings:
    return shipped_settings(sensor="mpu6050")


def samples(n: int = 200) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(8)
    return rng.uniform(-1.5, 1.5, (n, 3)), rng.uniform(-200, 200, (n, 3)), rng.uniform(10, 50, n)


def test_the_example_of_a_template_adds_a_format_whose_file_is_named_by_the_unit(
    tmp_path: Path, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run writes the file; convert takes the format from the name of OUT, writes OUT, and reads it by its keys."""
    shutil.copytree(exports.TEMPLATES, tmp_path / "templates")
    (tmp_path / "templates" / "mine.j2").write_text(EXAMPLE)
    monkeypatch.setattr(exports, "TEMPLATES", tmp_path / "templates")
    formats.cache_clear()
    made = document({"accelerometer": {"hysteresis": 1e-3}}) | {"unit": "U1.b", "error": None}
    try:
        export_all(made, settings, tmp_path)
        (tmp_path / "calibration.json").write_text(json.dumps(made))
        assert convert([str(tmp_path / "calibration.json"), str(tmp_path / "other.mine.ini")]) == 0
        content = configparser.ConfigParser()
        content.read(tmp_path / "other.mine.ini")
        assert [*content["imu"]] == ["offset", "scale"]
        back = read_any(tmp_path / "other.mine.ini")
    finally:
        formats.cache_clear()
    assert (back.format_name, back.unit, [*back.sensors]) == ("mine", "other.mine", ["accelerometer"])
    K = np.linalg.inv(ACCELEROMETER)
    np.testing.assert_allclose(back.sensors["accelerometer"].bias, [0.031, -0.022, 0.067], rtol=1e-8)
    np.testing.assert_allclose(
        back.sensors["accelerometer"].matrix, np.diag(np.diag(K) / np.sum(K**2, axis=1)), rtol=1e-8
    )
    lines = (tmp_path / "U1.b.mine.ini").read_text().splitlines()
    assert lines[:2] == [
        "# Unit U1.b: corrected = (raw - offset) * scale.",
        "# Left out of this format, accelerometer: hysteresis.",
    ]
    assert lines[2].startswith("# Cross-axis terms of the accelerometer are left out")
    offset = [float(x) for x in lines[4].partition("=")[2].split(",")]
    assert offset == pytest.approx([0.031 * 9.80665, -0.022 * 9.80665, 0.067 * 9.80665])


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        (
            "opening_remarks:",
            "opening_remark:",
            "opening_remark: unknown key; nearest: opening_remarks; valid: consumer",
        ),
        ("consumer: my flight controller\n", "", "consumer is missing"),
        ("m/s^2", "mg", "units.accelerometer: one of 'g', 'm/s^2', 'deg/s' or 'rad/s' is expected, not \"mg\""),
    ],
)
def test_a_wrong_declaration_is_refused_by_its_key(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, before: str, after: str, message: str
) -> None:
    (tmp_path / "mine.j2").write_text(EXAMPLE.replace(before, after, 1))
    monkeypatch.setattr(exports, "TEMPLATES", tmp_path)
    formats.cache_clear()
    try:
        with pytest.raises(ConfigurationError, match=re.escape(message)):
            formats()
    finally:
        formats.cache_clear()


def test_every_format_writes_its_file(tmp_path: Path, settings: Settings) -> None:
    written = export_all(document({}), settings, tmp_path / "U1")
    assert {p.name for p in written} >= FILES
    assert all(p.stat().st_size > 300 for p in written)


def test_kalibrs_own_equation_predicts_the_reading(tmp_path: Path, settings: Settings) -> None:
    made = document({"gyroscope": {"g_sensitivity": 0.1}})
    export_all(made, settings, tmp_path)
    imu = yaml.safe_load((tmp_path / "kalibr.yaml").read_text())["imu0"]
    f, w, _ = samples()
    gyroscope = SensorCalibration.from_json("gyroscope", made["gyroscope"])
    G = gyroscope.effects[0].values.reshape(3, 3)
    read_f = np.array([0.031, -0.022, 0.067]) + np.linalg.solve(ACCELEROMETER, f.T).T
    read_w = np.array([1.7, -0.9, 0.4]) + np.linalg.solve(GYROSCOPE, w.T).T + f @ G.T

    body_to_imu = np.array(imu["T_i_b"])[:3, :3]
    f_i, w_i = f @ body_to_imu.T * 9.80665, np.radians(w) @ body_to_imu.T
    a, g = imu["accelerometers"], imu["gyroscopes"]
    C = np.array(g["C_gyro_i"])
    a_meas = f_i @ np.array(a["M"]).T + a["b"]
    w_meas = w_i @ (np.array(g["M"]) @ C).T + f_i @ (np.array(g["A"]) @ C).T + g["b"]
    np.testing.assert_allclose(a_meas / 9.80665, read_f, atol=1e-12)
    np.testing.assert_allclose(np.degrees(w_meas), read_w, atol=1e-10)
    assert np.triu(a["M"], 1).max() == np.triu(g["M"], 1).max() == 0.0
    np.testing.assert_allclose(C @ C.T, np.eye(3), atol=1e-14)
    assert imu["update_rate"] == 100.0
    assert imu["accelerometer_noise_density"] == pytest.approx(4e-4 / np.sqrt(2.0) * 9.80665)  # one-sided in the sheet


def test_a_factor_of_a_matrix_is_lower_triangular_times_a_rotation() -> None:
    L, Q = lower_times_rotation(ACCELEROMETER)
    np.testing.assert_allclose(L @ Q, ACCELEROMETER, atol=1e-15)
    assert np.linalg.det(Q) == pytest.approx(1.0)
    assert (np.diag(L) > 0).all()


def test_what_a_format_cannot_carry_is_said_in_it(tmp_path: Path, settings: Settings) -> None:
    made = document({"accelerometer": {"lever_arm": 0.05, "hysteresis": 1e-3}})
    made |= {"gyroscope": None, "not_calibrated": {"gyroscope": "the recording holds no turn"}}
    export_all(made, settings, tmp_path)
    for name in ("kalibr.yaml", "calibration.h"):
        text = (tmp_path / name).read_text()
        assert "hysteresis" in text
        assert "Of the bench, not of the accelerometer: lever_arm" in text
        assert "the gyroscope is not calibrated: the recording holds no turn" in text
    assert "gyroscopes" not in yaml.safe_load((tmp_path / "kalibr.yaml").read_text())["imu0"]


def test_two_templates_of_one_file_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "one.j2").write_text(EXAMPLE)
    (tmp_path / "two.j2").write_text(EXAMPLE)
    monkeypatch.setattr(exports, "TEMPLATES", tmp_path)
    formats.cache_clear()
    try:
        with pytest.raises(ConfigurationError, match=r"two\.j2: file: .* is also the file of one\.j2"):
            formats()
    finally:
        formats.cache_clear()
