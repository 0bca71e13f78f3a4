"""Every format, read back by its consumer's own formula, gives what the calibration gives."""

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from pipeline import load_calibration
from pipeline.exports import export_all, exporters
from pipeline.exports.kalibr import lower_times_rotation
from pipeline.model.effects import effect
from pipeline.records import FittedEffect, SensorCalibration

ACCELEROMETER = np.array([[0.994, 0.004, -0.002], [0.021, 1.007, 0.003], [-0.005, 0.012, 0.951]])
GYROSCOPE = np.array([[1.017, 0.016, -0.019], [-0.013, 1.001, -0.005], [0.014, 0.005, 0.998]])
SIZES = {
    "accelerometer": {
        "bias_temperature": 1e-3,
        "scale_factor_temperature": 2e-4,
        "scale_factor_asymmetry": 3e-3,
        "quadratic_nonlinearity": 5e-3,
        "cubic_nonlinearity": 4e-3,
        "cross_axis_nonlinearity": 3e-3,
        "rate_dependence": 5e-5,
    },
    "gyroscope": {
        "bias_temperature_quadratic": 1e-3,
        "scale_factor_asymmetry": 2e-3,
        "quadratic_nonlinearity": 1e-5,
        "cubic_nonlinearity": 1e-7,
        "g_sensitivity": 0.1,
        "g_squared_sensitivity": 0.02,
    },
}


def fitted(name: str, sensor: str, size: float, rng: np.random.Generator) -> FittedEffect:
    values = size * rng.uniform(-1, 1, len(effect(name).parameters(sensor)))
    named = zip(effect(name).parameters(sensor), values, strict=True)
    return FittedEffect(name, {p.name: {"value": v, "unit": p.unit, "expanded_uncertainty": 0.0} for p, v in named})


def document(effects: dict[str, dict[str, float]], seed: int = 3) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    parts = {
        "accelerometer": (np.array([0.031, -0.022, 0.067]), ACCELEROMETER),
        "gyroscope": (np.array([1.7, -0.9, 0.4]), GYROSCOPE),
    }
    out: dict[str, Any] = {"unit": "U1 */", "status": "ok", "sensor": "mpu6050", "inputs": [{"rate_hz": 100.0}]}
    for sensor, (bias, matrix) in parts.items():
        chosen = tuple(fitted(n, sensor, size, rng) for n, size in effects.get(sensor, {}).items())
        out[sensor] = SensorCalibration(sensor, bias, matrix, effects=chosen).to_json()
    return out


@pytest.fixture
def settings() -> dict[str, Any]:
    root = Path(__file__).parents[2] / "configs" / "sensor" / "mpu6050.yaml"
    return {"sensor": {"name": "mpu6050", **yaml.safe_load(root.read_text())}, "table": {"gravity_g": 1.0}}


def samples(n: int = 200) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(8)
    return rng.uniform(-1.5, 1.5, (n, 3)), rng.uniform(-200, 200, (n, 3)), rng.uniform(10, 50, n)


def test_every_format_writes_its_file(tmp_path: Path, settings: dict[str, Any]) -> None:
    written = export_all(document({}), settings, tmp_path / "U1")
    assert {p.name for p in written} == {m.FILE_NAME for m in exporters()} >= {"kalibr.yaml", "calibration.h"}
    assert all(p.stat().st_size > 300 for p in written)


def test_kalibrs_own_equation_predicts_the_reading(tmp_path: Path, settings: dict[str, Any]) -> None:
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
    assert imu["accelerometer_noise_density"] == pytest.approx(4e-4 * 9.80665)


def test_a_factor_of_a_matrix_is_lower_triangular_times_a_rotation() -> None:
    L, Q = lower_times_rotation(ACCELEROMETER)
    np.testing.assert_allclose(L @ Q, ACCELEROMETER, atol=1e-15)
    assert np.linalg.det(Q) == pytest.approx(1.0)
    assert (np.diag(L) > 0).all()


PROGRAM = """
#include <stdio.h>
#include "calibration.h"
int main(void) {
    double in[7];
    while (scanf("%lf %lf %lf %lf %lf %lf %lf", in, in+1, in+2, in+3, in+4, in+5, in+6) == 7) {
        imu_real f[3], w[3], rf[3], rw[3];
        int i;
        for (i = 0; i < 3; ++i) { rf[i] = (imu_real)in[i]; rw[i] = (imu_real)in[3 + i]; }
        imu_compensate(rf, rw, (imu_real)in[6], f, w);
        printf("%.17g %.17g %.17g %.17g %.17g %.17g\\n", (double)f[0], (double)f[1], (double)f[2],
               (double)w[0], (double)w[1], (double)w[2]);
    }
    return 0;
}
"""


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
@pytest.mark.parametrize(("real", "tolerance"), [("double", 1e-12), ("float", 2e-6)])
@pytest.mark.parametrize("effects", [{}, SIZES], ids=["linear", "all effects of one sample"])
def test_the_c_header_compensates_as_python_does(
    tmp_path: Path, settings: dict[str, Any], effects: dict[str, dict[str, float]], real: str, tolerance: float
) -> None:
    made = document(effects)
    export_all(made, settings, tmp_path)
    (tmp_path / "main.c").write_text(PROGRAM)
    flags = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-ffp-contract=off", f"-DIMU_REAL={real}"]
    subprocess.run(["cc", *flags, "main.c", "-o", "main"], cwd=tmp_path, check=True)
    f, w, temperature = samples()
    text = "\n".join(" ".join(map(repr, row)) for row in np.column_stack([f, w, temperature]).tolist())
    done = subprocess.run([tmp_path / "main"], input=text, capture_output=True, text=True, check=True)
    out = np.array([line.split() for line in done.stdout.splitlines()], float)

    (tmp_path / "U1.json").write_text(json.dumps(made))
    expected = load_calibration(tmp_path / "U1.json").apply(f, w, temperature)
    scale = {"accelerometer": 1.5, "gyroscope": 200.0}
    np.testing.assert_allclose(out[:, :3], expected.accelerometer, atol=tolerance * scale["accelerometer"], rtol=0)
    np.testing.assert_allclose(out[:, 3:], expected.gyroscope, atol=tolerance * scale["gyroscope"], rtol=0)


def test_what_a_format_cannot_carry_is_said_in_it(tmp_path: Path, settings: dict[str, Any]) -> None:
    made = document({"accelerometer": {"lever_arm": 0.05, "hysteresis": 1e-3}})
    made |= {"gyroscope": None, "not_calibrated": {"gyroscope": "the recording holds no turn"}}
    export_all(made, settings, tmp_path)
    for name in ("kalibr.yaml", "calibration.h"):
        text = (tmp_path / name).read_text()
        assert "hysteresis" in text
        assert "Of the bench, not of the accelerometer: lever_arm" in text
        assert "the gyroscope is not calibrated: the recording holds no turn" in text
    assert "gyroscopes" not in yaml.safe_load((tmp_path / "kalibr.yaml").read_text())["imu0"]
