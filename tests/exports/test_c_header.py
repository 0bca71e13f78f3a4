"""The C header, compiled, gives what the samples give in Python."""

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline import load_calibration
from pipeline.core.records import SENSORS, Coefficient, FittedEffect, SensorCalibration
from pipeline.output.exports import ExportedUnit, export
from pipeline.physics.compensation import SMOOTHING_S
from pipeline.physics.effects import catalogue, effect, effect_from
from pipeline.physics.effects.base import Owner

BIAS = {"accelerometer": np.array([0.031, -0.022, 0.067]), "gyroscope": np.array([1.7, -0.9, 0.4])}
MATRIX = {
    "accelerometer": np.array([[0.994, 0.004, -0.002], [0.021, 1.007, 0.003], [-0.005, 0.012, 0.951]]),
    "gyroscope": np.array([[1.017, 0.016, -0.019], [-0.013, 1.001, -0.005], [0.014, 0.005, 0.998]]),
}
ALGEBRA = {
    "accelerometer": {
        "bias_temperature": 1e-3,
        "scale_factor_temperature": 2e-4,
        "scale_factor_asymmetry": 3e-3,
        "quadratic_nonlinearity": 5e-3,
        "cubic_nonlinearity": 4e-3,
        "cross_axis_nonlinearity": 3e-3,
        "rate_dependence": 5e-5,
        "vibration_rectification": 1e-5,
        "inner_lever_arms": 5e-3,
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
LIBRARY = {
    "accelerometer": {"hysteresis": 2e-3, "warm_up": 1e-2},
    "gyroscope": {"warm_up": 0.5, "temperature_lag": 0.05},
}
IN_TURN = {"accelerometer": {"cubic_nonlinearity": 4e-3}, "gyroscope": {"g_sensitivity": 0.1}}
LEVERS = {"accelerometer": {"inner_lever_arms": 5e-3}, "gyroscope": {"scale_factor_asymmetry": 2e-3}}
ONE_ROUND = {"accelerometer": {"inner_lever_arms": 5e-3}, "gyroscope": {"bias_temperature": 0.1}}
OWN = {
    "name": "own",
    "owner": "sensor",
    "meaning": "my own",
    "sensors": ["accelerometer", "gyroscope"],
    "axes": ["x", "z"],
    "terms": {
        "p": {
            "formula": "tanh(u / 50) * exp(-time / 100) + sqrt(speed + 1) - maximum(fx, minimum(wy, pi))",
            "unit": "1",
        },
        "q": {"formula": "band(alphax, -500, 500) * (temperature - 25) + step(fz) * abs(u) ** 0.5", "unit": "1"},
        "r": {
            "formula": "step(fx - fx) + 2 * band(fy - fy, 0, 1) + 4 * band(1 + 0 * fz, 0, 1)",
            "unit": "1",
        },  # at ends
        "v": {"formula": ["sin(radians(wz))", "-cos(fy) / (1 + fx ** 2)", "sign(wx) * log(2 + abs(fy))"], "unit": "1"},
    },
}
MAIN = """
#include <stdio.h>
#include "calibration.h"
int main(void) {
    imu_state state = {0};
    double in[8];
    while (scanf("%lf %lf %lf %lf %lf %lf %lf %lf", in, in+1, in+2, in+3, in+4, in+5, in+6, in+7) == 8) {
        imu_real f[3], w[3], rf[3], rw[3];
        int i;
        for (i = 0; i < 3; ++i) { rf[i] = (imu_real)in[i]; rw[i] = (imu_real)in[3 + i]; }
        if (ALONE)
            imu_compensate(rf, rw, (imu_real)in[6], f, w);
        else
            imu_update(&state, rf, rw, (imu_real)in[6], in[7], f, w);
        printf("%.17g %.17g %.17g %.17g %.17g %.17g\\n", (double)f[0], (double)f[1], (double)f[2],
               (double)w[0], (double)w[1], (double)w[2]);
    }
    return 0;
}
"""

needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")


def fitted(name: str, sensor: str, size: float, rng: np.random.Generator) -> FittedEffect:
    made = effect_from(OWN, "test") if name == "own" else effect(name)
    parameters = made.parameters(sensor)
    values = [100.0 if p.unit == "s" else size * rng.uniform(-1, 1) for p in parameters]
    named = {p.name: Coefficient(v, p.unit, 0.0) for p, v in zip(parameters, values, strict=True)}
    return FittedEffect(name, named, made.definition)


def document(effects: dict[str, dict[str, float]]) -> dict[str, Any]:
    rng = np.random.default_rng(3)
    out: dict[str, Any] = {"unit": "U1 */", "schema_version": 1, "status": "ok", "sensor": "mpu6050", "inputs": []}
    for sensor in SENSORS:
        chosen = tuple(fitted(n, sensor, size, rng) for n, size in effects.get(sensor, {}).items())
        out[sensor] = SensorCalibration(sensor, BIAS[sensor], MATRIX[sensor], effects=chosen).to_json()
    return out


def samples(n: int = 300) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Specific force, angular rate, temperature, time; at rest in between, and over the end of a stretch of time."""
    rng = np.random.default_rng(8)
    rate = rng.uniform(-200, 200, (n, 3))
    rate[100:130] = [1.7, -0.9, 0.4]
    time = 4.0 * SMOOTHING_S - 1.5 + 0.01 * np.arange(n) + 1e-3 * rng.uniform(size=n)
    return rng.uniform(-1.5, 1.5, (n, 3)), rate, 30.0 + 0.5 * time + 0.1 * rng.standard_normal(n), time


def compiled(folder: Path, made: dict[str, Any], real: str, *, alone: bool = False) -> np.ndarray:
    (folder / "calibration.h").write_text(export("calibration.h", ExportedUnit(made, {}))["calibration.h"])
    (folder / "main.c").write_text(MAIN)
    flags = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2", "-ffp-contract=off"]
    flags += [f"-DIMU_REAL={real}", f"-DALONE={int(alone)}"]
    subprocess.run(["cc", *flags, "main.c", "-o", "main", "-lm"], cwd=folder, check=True)
    f, w, temperature, time = samples()
    text = "\n".join(" ".join(map(repr, row)) for row in np.column_stack([f, w, temperature, time]).tolist())
    done = subprocess.run([folder / "main"], input=text, capture_output=True, text=True, check=True)
    return np.array([line.split() for line in done.stdout.splitlines()], float)


def in_python(folder: Path, made: dict[str, Any], *, alone: bool = False) -> np.ndarray:
    (folder / "U1.json").write_text(json.dumps(made))
    f, w, temperature, time = samples()
    found = load_calibration(folder / "U1.json").apply(f, w, temperature, None if alone else time)
    return np.column_stack([found.accelerometer, found.gyroscope])


@needs_compiler
@pytest.mark.parametrize(
    "effects", [{}, ONE_ROUND, IN_TURN, LEVERS, ALGEBRA], ids=["linear", "one round", "in turn", "levers", "algebra"]
)
def test_samples_in_c_are_those_of_python_to_the_last_bit(tmp_path: Path, effects: dict[str, dict[str, float]]) -> None:
    made = document(effects)
    found, expected = compiled(tmp_path, made, "double"), in_python(tmp_path, made)
    if "temperature" in str(effects):  # the line through the past calls exp of the C library
        np.testing.assert_allclose(found, expected, atol=1e-12, rtol=0)
    else:
        np.testing.assert_array_equal(found, expected)


@needs_compiler
def test_one_sample_by_itself_is_that_of_python_to_the_last_bit(tmp_path: Path) -> None:
    effects = {s: {n: v for n, v in of.items() if n != "inner_lever_arms"} for s, of in ALGEBRA.items()}
    made = document(effects)
    found = compiled(tmp_path, made, "double", alone=True)
    np.testing.assert_array_equal(found, in_python(tmp_path, made, alone=True))


@needs_compiler
def test_what_looks_at_the_time_or_the_past_is_left_out_of_a_sample_by_itself(tmp_path: Path) -> None:
    found = compiled(tmp_path, document(LIBRARY), "double", alone=True)
    np.testing.assert_array_equal(found, in_python(tmp_path, document({}), alone=True))
    assert (
        "without hysteresis, temperature_lag, warm_up, which time or the sample before tells"
        in (tmp_path / "calibration.h").read_text()
    )


@needs_compiler
@pytest.mark.parametrize(("real", "tolerance"), [("double", 1e-12), ("float", 1e-6)])
@pytest.mark.parametrize(
    "effects",
    [ALGEBRA, LIBRARY, {s: {**ALGEBRA[s], **LIBRARY[s]} for s in SENSORS}, {s: {"own": 1e-3} for s in SENSORS}],
    ids=["algebra", "library", "all", "own"],
)
def test_the_c_header_compensates_as_python_does(
    tmp_path: Path, effects: dict[str, dict[str, float]], real: str, tolerance: float
) -> None:
    made = document(effects)
    found, expected = compiled(tmp_path, made, real), in_python(tmp_path, made)
    np.testing.assert_allclose(found[:, :3], expected[:, :3], atol=1.5 * tolerance, rtol=0)
    np.testing.assert_allclose(found[:, 3:], expected[:, 3:], atol=200.0 * tolerance, rtol=0)


def test_every_effect_of_a_sensor_is_in_the_header() -> None:
    for sensor in SENSORS:
        for name, known in catalogue().items():
            if known.owner == Owner.SENSOR and sensor in known.sensors:
                text = export("calibration.h", ExportedUnit(document({sensor: {name: 1e-3}}), {}))["calibration.h"]
                assert "Left out" not in text
                assert f"/* {name} */" in text


def test_an_effect_in_python_is_named_as_left_out() -> None:
    made = document({})
    own = {"python": "mine.py", "sha256": "0" * 64, "owner": "sensor"}
    made["gyroscope"]["effects"] = [{"name": "mine", "parameters": {}, "definition": own}]
    assert (
        "Left out, gyroscope: mine (it is in Python" in export("calibration.h", ExportedUnit(made, {}))["calibration.h"]
    )
