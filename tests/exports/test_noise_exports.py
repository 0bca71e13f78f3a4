"""Noise parameters: what each consumer makes of them is the noise of the recording that they come from."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import yaml
from scipy.signal import lfilter
from stage_files import export_all
from unit_settings import settings_of

from pipeline.core.records import SENSORS, Recording, SensorCalibration
from pipeline.estimation.noise_identification import identify_noise
from pipeline.estimation.noise_terms import allan_variance
from pipeline.output.exports import ExportedUnit, export
from pipeline.output.exports.reading import document_of, read_any, with_noise
from pipeline.output.exports.sensors import INSTABILITY_FLOOR, SensorFigures, noise

if TYPE_CHECKING:
    from pathlib import Path

RATE, SAMPLES, G0 = 50.0, 60_000, 9.80665
SIGMA = {"accelerometer": 3e-3, "gyroscope": 0.05}  # of a sample, g and deg/s
WALK = {"accelerometer": 2e-5, "gyroscope": 8e-4}  # per sqrt(s)
FACTOR = {"accelerometer": G0, "gyroscope": np.pi / 180.0}
SHEET = {"noise_density": 1e-3, "bias_wander": 1e-4, "wander_time_s": 100.0, "counts_per_unit": 16384.0}
SETTINGS = settings_of(sensor=dict.fromkeys(SENSORS, SHEET))
SHEETS = dict.fromkeys(SENSORS, SensorFigures.of(SETTINGS.sensor.gyroscope))


def noise_of(sheets: dict[str, SensorFigures], document: dict[str, Any]) -> dict[str, float | None]:
    return noise(ExportedUnit(document, sheets).noise_figures)


def document(readings: dict[str, Any] | None = None) -> dict[str, Any]:
    found: dict[str, Any] = {"unit": "U1", "schema_version": 1, "status": "ok", "sensor": "mpu6050"}
    found["inputs"] = [{"rate_hz": RATE}]
    found |= {s: SensorCalibration(s).to_json() for s in SENSORS}
    if readings:
        time_ns = (np.arange(SAMPLES) / RATE * 1e9).astype(np.int64)
        static = Recording("static", "static", None, time_ns, **readings)
        found["noise"] = identify_noise([static])
    return found


@pytest.fixture(scope="module")
def measured() -> dict[str, Any]:
    rng = np.random.default_rng(1)
    readings = {}
    for s in SENSORS:
        steps = WALK[s] / np.sqrt(RATE) * rng.standard_normal((SAMPLES, 3))
        readings[s] = SIGMA[s] * rng.standard_normal((SAMPLES, 3)) + np.cumsum(steps, axis=0)
    return document(readings)


def short(sensor: str) -> str:
    return "acc" if sensor == "accelerometer" else "gyr"


@pytest.mark.parametrize("sensor", SENSORS)
def test_each_consumer_gets_the_noise_of_the_recording(measured: dict[str, Any], tmp_path: Path, sensor: str) -> None:
    export_all(measured, SETTINGS, tmp_path)
    sigma, walk = SIGMA[sensor] * FACTOR[sensor], WALK[sensor] * FACTOR[sensor]
    texts = {
        name: (tmp_path / f"{name}.yaml").read_text() for name in ("kalibr_imu", "kalibr", "kalibr_imu_chain", "vins")
    }
    read = {name: yaml.safe_load(text.replace("%YAML:1.0", "")) for name, text in texts.items()}
    for imu in (read["kalibr_imu"], read["kalibr"]["imu0"], read["kalibr_imu_chain"]["imu0"]):
        # Kalibr, ConfigReader.py: discrete = density / sqrt(1 / rate); OpenVINS, Propagator.cpp: bias walk^2 dt a step
        assert imu[f"{sensor}_noise_density"] / np.sqrt(1.0 / RATE) == pytest.approx(sigma, rel=0.01)
        assert imu[f"{sensor}_random_walk"] == pytest.approx(walk, rel=0.15)
    basalt, key = json.loads((tmp_path / "basalt_imu.json").read_text()), short(sensor).replace("acc", "accel")
    key = "gyro" if key == "gyr" else key
    np.testing.assert_allclose(np.array(basalt[f"{key}_noise_std"]) * np.sqrt(RATE), sigma, rtol=0.01)
    np.testing.assert_allclose(basalt[f"{key}_bias_std"], walk, rtol=0.15)
    lines = [line for line in texts["kalibr_imu"].splitlines() if line.startswith(f"# {sensor}, ")]
    assert "measured at rest (static), root mean square of the axes" in lines[0]
    low, high = (float(v) for v in lines[0].partition("95 %: ")[2].partition(";")[0].split(" to "))
    assert low < sigma / np.sqrt(RATE) < high
    low, high = (float(v) for v in lines[1].partition("95 %: ")[2].partition(";")[0].split(" to "))
    assert low < walk < high


def test_the_variances_of_vins_are_those_of_the_integrals_of_the_recording(measured: dict[str, Any]) -> None:
    text = export("vins.yaml", ExportedUnit(measured, SHEETS))["vins.yaml"]
    vins, dt, steps = yaml.safe_load(text.replace("%YAML:1.0", "")), 1.0 / RATE, 2000
    velocity = bias = 0.0
    for _ in range(steps):  # integration_base.h: V noise V^T of the velocity and of the bias
        velocity += 2.0 * (0.5 * dt) ** 2 * vins["acc_n"] ** 2
        bias += dt**2 * vins["acc_w"] ** 2
    sigma, walk = SIGMA["accelerometer"] * G0, WALK["accelerometer"] * G0
    weights = np.convolve(np.ones(steps), [0.5 * dt, 0.5 * dt])  # of each sample, by the trapezoidal rule
    assert velocity == pytest.approx(sigma**2 * np.sum(weights**2), rel=0.02)
    assert bias == pytest.approx(walk**2 * steps * dt, rel=0.3)
    assert vins["g_norm"] == pytest.approx(G0)


def test_without_a_rest_the_configuration_is_exported_and_what_is_unknown_is_null() -> None:
    found = noise_of(SHEETS, document())
    assert found["gyroscope_noise_density"] == pytest.approx(1e-3 / np.sqrt(2.0) * np.pi / 180.0)
    assert found["gyroscope_random_walk"] == pytest.approx(1e-4 * np.sqrt(0.02) * np.pi / 180.0)
    unknown = dict.fromkeys(SENSORS, SensorFigures(wander_time_s=100.0))
    text = export("kalibr_imu.yaml", ExportedUnit(document(), unknown))["kalibr_imu.yaml"]
    assert yaml.safe_load(text)["accelerometer_noise_density"] is None
    assert "# accelerometer, white: not known; null has to be replaced." in text


def test_a_walk_that_was_not_seen_is_at_most_its_upper_limit() -> None:
    rng = np.random.default_rng(2)
    quiet = document({s: SIGMA[s] * rng.standard_normal((SAMPLES, 3)) for s in SENSORS})
    limits = [quiet["noise"]["gyroscope"]["axes"][a]["terms"]["random_walk"]["upper_limit"] for a in "xyz"]
    loud = {s: replace(sheet, bias_wander=10.0) for s, sheet in SHEETS.items()}
    found = noise_of(loud, quiet)["gyroscope_random_walk"]
    assert found == pytest.approx(np.sqrt(np.mean(np.square(limits))) * np.pi / 180.0)
    text = export("kalibr_imu.yaml", ExportedUnit(quiet, loud))["kalibr_imu.yaml"]
    assert "gyroscope, walk:" in text
    assert "not found at rest (1.2e+03 s), below" in text


def test_a_process_is_white_or_a_walk_by_its_correlation_time_and_flicker_meets_white_noise() -> None:
    def terms(**given: Any) -> dict[str, Any]:
        absent = {"value": None, "interval": None, "upper_limit": 1e-9}
        white = {"value": 2.0, "interval": [1.9, 2.1]}
        empty = {"white": white, "random_walk": absent, "bias_instability": absent, "gauss_markov": []}
        return {"terms": empty | given}

    def exported(**given: Any) -> tuple[float, float]:
        made = document() | {
            "noise": {"accelerometer": {"source": "static", "length_s": 1e3, "axes": {"x": terms(**given)}}}
        }
        found = noise_of(SHEETS, made)
        return tuple(found[f"accelerometer_{k}"] / G0 for k in ("noise_density", "random_walk"))  # type: ignore[return-value,operator]

    for time in (0.01, 30.0):
        process = {
            "value": 0.5,
            "interval": [0.4, 0.6],
            "correlation_time_s": {"value": time, "interval": [time, time]},
        }
        tau = np.array([100.0 * time if time < 1.0 else 1e3 / 9.0])  # the longest time of a rest of 1000 s
        n, k = exported(gauss_markov=[process])
        exact = allan_variance("gauss_markov", 0.5, tau, time)[0]
        found = (n**2 - 4.0) / tau[0] if time < 1.0 else k**2 * tau[0] / 3.0
        assert found == pytest.approx(exact, rel=0.02)
    flicker = {"value": 0.05, "interval": [0.04, 0.06]}
    n, k = exported(bias_instability=flicker)
    meets = n**2 / (INSTABILITY_FLOOR * 0.05**2)
    assert k**2 * meets / 3.0 == pytest.approx(allan_variance("bias_instability", 0.05, np.array([meets]))[0])
    assert n == pytest.approx(2.0)


def test_a_simulated_short_process_is_exported_as_its_plateau() -> None:
    rng, keep = np.random.default_rng(3), np.exp(-1.0 / (RATE * 0.05))
    drive = np.sqrt(1.0 - keep**2) * rng.standard_normal((SAMPLES, 3))
    values = 0.01 * rng.standard_normal((SAMPLES, 3)) + 0.2 * lfilter([1.0], [1.0, -keep], drive, axis=0)
    made = document(dict.fromkeys(SENSORS, values))
    assert made["noise"]["gyroscope"]["axes"]["x"]["terms"]["gauss_markov"]
    found = noise_of(SHEETS, made)["gyroscope_noise_density"]
    seconds = values.reshape(-1, 50, 3).mean(axis=1)  # means over 1 s scatter by the density
    assert found == pytest.approx(np.radians(seconds.std()), rel=0.05)


def test_noise_that_no_composition_fits_is_exported_as_doubtful() -> None:
    drive = np.random.default_rng(4).standard_normal((SAMPLES, 3))
    shaken = lfilter([1.0], [1.0, -1.6, 0.95], drive, axis=0)  # a resonance, as of vibration
    text = export("kalibr_imu.yaml", ExportedUnit(document(dict.fromkeys(SENSORS, shaken)), SHEETS))["kalibr_imu.yaml"]
    assert "# gyroscope, in doubt: no composition fits the spectrum" in text


def test_a_conversion_keeps_the_densities(measured: dict[str, Any], tmp_path: Path) -> None:
    export_all(measured, SETTINGS, tmp_path)
    found = read_any(tmp_path / "kalibr.yaml")
    again = noise_of(with_noise({}, found), document_of(found))
    assert again == pytest.approx(noise_of(SHEETS, measured), rel=1e-9)


def test_the_walk_of_a_short_process_holds_at_the_longest_time_measured() -> None:
    """Of a process of 0.3 s a walk with its increments would reach 80 times its size in 1000 s."""
    rng, length, time, size = np.random.default_rng(4), SAMPLES / RATE, 0.3, 0.2
    keep = np.exp(-1.0 / (RATE * time))
    drive = np.sqrt(1.0 - keep**2) * rng.standard_normal((SAMPLES, 3))
    values = 0.1 * rng.standard_normal((SAMPLES, 3)) + size * lfilter([1.0], [1.0, -keep], drive, axis=0)
    made = document(dict.fromkeys(SENSORS, values))
    found = noise_of(SHEETS, made)
    factor = np.pi / 180.0
    walk, white = (found[f"gyroscope_{k}"] / factor for k in ("random_walk", "noise_density"))  # type: ignore[operator]
    averages = values[: SAMPLES // 9 * 9].reshape(9, -1, 3).mean(axis=1)  # of the longest averaging time, 133 s
    seen = 0.5 * np.mean(np.diff(averages, axis=0) ** 2)
    longest = length / 9.0
    implied = white**2 / longest + walk**2 * longest / 3.0
    assert 0.4 * seen < implied < 2.5 * seen  # 8 differences of each of 3 axes: 35 %
    assert walk * np.sqrt(1000.0) < 3.0 * size
