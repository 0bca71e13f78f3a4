"""Formats of cameras, filters and flight controllers, read back by each consumer's own formula."""

import json
import re
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from pydantic import TypeAdapter
from stage_files import export_all
from unit_settings import settings_of

from pipeline import load_calibration
from pipeline.core.records import SENSORS, Coefficient, FittedEffect, SensorCalibration
from pipeline.output.exports import Format, formats
from pipeline.output.exports.reading import read_any

G0, RADIAN = 9.80665, np.pi / 180.0
BIAS = {"accelerometer": np.array([0.031, -0.022, 0.067]), "gyroscope": np.array([1.7, -0.9, 0.4])}
MATRIX = {
    "accelerometer": np.array([[0.994, 0.004, -0.002], [0.021, 1.007, 0.003], [-0.005, 0.012, 0.951]]),
    "gyroscope": np.array([[1.017, 0.016, -0.019], [-0.013, 1.001, -0.005], [0.014, 0.005, 0.998]]),
}
COUNTS = {"accelerometer": 16384.0, "gyroscope": 131.0}
SHEET = {"noise_density": 1e-3, "bias_wander": 1e-4, "wander_time_s": 100.0}
SETTINGS = settings_of(sensor={s: SHEET | {"counts_per_unit": COUNTS[s]} for s in BIAS})


def effect(name: str, **values: float) -> FittedEffect:
    return FittedEffect(name, {k: Coefficient(v, "", 0.0) for k, v in values.items()})


SENSITIVE = effect(
    "g_sensitivity",
    **dict(
        zip(
            [f"G_{a}{b}" for a in "xyz" for b in "xyz"],
            [0.1, -0.02, 0.03, 0, 0.08, -0.05, 0.01, 0.02, -0.09],
            strict=True,
        )
    ),
)
WARM = effect("bias_temperature", b_T_x=1e-3, b_T_y=-2e-3, b_T_z=5e-4)
WARMER = effect("bias_temperature_quadratic", **{f"b_T{i}_{a}": v for a, i, v in [
    ("x", 1, 0.01), ("x", 2, 2e-4), ("y", 1, -0.02), ("y", 2, 1e-4), ("z", 1, 0.03), ("z", 2, -3e-4)]})  # fmt: skip
SCALED = effect("scale_factor_temperature", k_T_x=2e-4, k_T_y=-1e-4, k_T_z=1.5e-4)


class Unit:
    """A unit with effects, its exports and its samples."""

    def __init__(self, folder: Path, **effects: tuple[FittedEffect, ...]) -> None:
        self.document: dict[str, Any] = {
            "unit": "U1",
            "schema_version": 1,
            "status": "ok",
            "sensor": "mpu6050",
            "inputs": [{"rate_hz": 100.0}],
        }
        for s in SENSORS:
            self.document[s] = SensorCalibration(s, BIAS[s], MATRIX[s], effects=effects.get(s, ())).to_json()
        self.folder = folder
        export_all(self.document, SETTINGS, folder)
        (folder / "U1.json").write_text(json.dumps(self.document))
        rng = np.random.default_rng(8)
        self.f, self.w = rng.uniform(-1.5, 1.5, (200, 3)), rng.uniform(-200, 200, (200, 3))
        self.temperature = rng.uniform(0, 60, 200)
        self.truth = load_calibration(folder / "U1.json").apply(self.f, self.w, self.temperature)
        self.raw = {"accelerometer": self.f * G0, "gyroscope": self.w * RADIAN}
        self.si = {"accelerometer": self.truth.accelerometer * G0, "gyroscope": self.truth.gyroscope * RADIAN}

    def text(self, name: str) -> str:
        return (self.folder / name).read_text()


def test_openvins_takes_off_the_g_sensitivity_in_its_own_frame(tmp_path: Path) -> None:
    unit = Unit(tmp_path, gyroscope=(SENSITIVE,))
    text = unit.text("kalibr_imu_chain.yaml")
    assert text.startswith("%YAML:1.0\n")
    imu = yaml.safe_load(text.partition("\n")[2])["imu0"]
    m = {k: np.array(imu[k]) for k in ("Tw", "Ta", "Tg", "R_IMUtoGYRO", "R_IMUtoACC", "T_i_b")}
    bias = {s: np.array(json.loads(re.search(rf"b of the {s}: (\[.*\])", text)[1])) for s in SENSORS}
    a = (m["R_IMUtoACC"].T @ np.linalg.inv(m["Ta"]) @ (unit.raw["accelerometer"] - bias["accelerometer"]).T).T
    rest = unit.raw["gyroscope"] - a @ m["Tg"].T - bias["gyroscope"]
    w = (m["R_IMUtoGYRO"].T @ np.linalg.inv(m["Tw"]) @ rest.T).T
    back = m["T_i_b"][:3, :3]
    np.testing.assert_allclose(a @ back, unit.si["accelerometer"], atol=1e-12)
    np.testing.assert_allclose(w @ back, unit.si["gyroscope"], atol=1e-12)
    assert imu["model"] == "kalibr"
    assert np.triu(m["Tw"], 1).max() == np.triu(m["Ta"], 1).max() == 0.0


def test_kalibrs_input_holds_its_six_fields(tmp_path: Path) -> None:
    Unit(tmp_path)
    given = yaml.safe_load((tmp_path / "kalibr_imu.yaml").read_text())
    kinds = [f"{s}_{k}" for s in SENSORS for k in ("noise_density", "random_walk")]
    assert set(given) == {*kinds, "rostopic", "update_rate"}
    # the sensor file's density is one-sided: a sample at 100 Hz has the noise of the band up to 50 Hz
    assert given["accelerometer_noise_density"] * np.sqrt(100.0) == pytest.approx(1e-3 * np.sqrt(50.0) * G0)
    assert given["gyroscope_random_walk"] == pytest.approx(1e-4 * np.sqrt(2 / 100) * RADIAN)
    assert given["update_rate"] == 100.0


def test_imu_calib_toolkit_solves_for_the_rate(tmp_path: Path) -> None:
    unit = Unit(tmp_path, gyroscope=(SENSITIVE,))
    core = {k: np.array(v) for k, v in json.loads(unit.text("imu_calib_toolkit.json"))["core_outputs"].items()}
    acc = (unit.raw["accelerometer"] - core["ba"]) @ core["Ca"].T
    gyr = np.linalg.solve(core["Cg"], (unit.raw["gyroscope"] - core["bg"] - acc @ core["Gg"].T).T).T
    np.testing.assert_allclose(acc, unit.si["accelerometer"], atol=1e-12)
    np.testing.assert_allclose(gyr, unit.si["gyroscope"], atol=1e-12)
    assert core["gravity_magnitude"] == pytest.approx(G0)


def test_fusion_multiplies_by_sensitivity_and_misalignment(tmp_path: Path) -> None:
    unit = Unit(tmp_path)
    text = unit.text("fusion_calibration.h")
    for sensor, raw, truth in (
        ("accelerometer", unit.f, unit.truth.accelerometer),
        ("gyroscope", unit.w, unit.truth.gyroscope),
    ):
        found = {
            what: np.array(re.findall(r"-?[\d.e-]+(?=f[,}])", re.search(rf"{sensor}{what} = (.*);", text)[1]), float)
            for what in ("Misalignment", "Sensitivity", "Offset")
        }
        out = ((raw - found["Offset"]) * found["Sensitivity"]) @ found["Misalignment"].reshape(3, 3).T
        np.testing.assert_allclose(out, truth, atol=1e-10)


def test_realsense_takes_vectors_as_rows_and_the_bias_after_the_matrix(tmp_path: Path) -> None:
    unit = Unit(tmp_path)
    imu = json.loads(unit.text("realsense_calibration.json"))["imus"][0]
    for sensor in SENSORS:
        X = np.array([*imu[sensor]["scale_and_alignment"], *imu[sensor]["bias"]]).reshape(4, 3)
        out = np.column_stack([unit.raw[sensor], np.full(200, -1.0)]) @ X
        np.testing.assert_allclose(out, unit.si[sensor], atol=1e-12)


def test_basalt_scales_by_a_lower_triangle_in_a_frame_of_its_own(tmp_path: Path) -> None:
    unit = Unit(tmp_path)
    found = json.loads(unit.text("basalt_imu.json"))
    b, s = np.array(found["calib_accel_bias"][:3]), found["calib_accel_bias"][3:]
    S = np.array([[s[0], 0, 0], [s[1], s[3], 0], [s[2], s[4], s[5]]])
    accelerometer = unit.raw["accelerometer"] @ (np.eye(3) + S).T - b
    G = np.array(found["calib_gyro_bias"][3:]).reshape(3, 3).T
    gyroscope = unit.raw["gyroscope"] @ (np.eye(3) + G).T - found["calib_gyro_bias"][:3]
    body_to_imu = np.array(found["R_i_b"])
    np.testing.assert_allclose(body_to_imu @ body_to_imu.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(accelerometer @ body_to_imu, unit.si["accelerometer"], atol=1e-12)
    np.testing.assert_allclose(gyroscope @ body_to_imu, unit.si["gyroscope"], atol=1e-12)
    assert np.abs(S).max() < 0.1


@pytest.mark.parametrize(("effects", "tolerance"), [((WARM,), 1e-10), ((WARM, WARMER), 1e-10), ((SCALED, WARM), 2e-5)])
def test_azure_kinect_adds_polynomials_of_the_temperature(
    tmp_path: Path, effects: tuple[FittedEffect, ...], tolerance: float
) -> None:
    unit = Unit(tmp_path, accelerometer=effects, gyroscope=effects)
    content = json.loads(unit.text("azure_kinect.json"))
    powers = unit.temperature[:, None] ** np.arange(4)
    for found, sensor in zip(content["CalibrationInformation"]["InertialSensors"], SENSORS, strict=True):
        mixing = (powers @ np.array(found["MixingMatrixTemperatureModel"]).reshape(9, 4).T).reshape(-1, 3, 3)
        bias = powers @ np.array(found["BiasTemperatureModel"]).reshape(3, 4).T
        out = (mixing @ unit.raw[sensor][:, :, None])[:, :, 0] + bias
        np.testing.assert_allclose(out, unit.si[sensor], atol=tolerance)
    assert ("To third order" in content["comment"]) == (SCALED in effects)


def parameters(unit: Unit, name: str) -> dict[str, float]:
    lines = [line.split() for line in unit.text(name).splitlines() if not line.startswith("#")]
    return {
        line[-3] if name == "px4.params" else line[0]: float(line[-2 if name == "px4.params" else -1]) for line in lines
    }


@pytest.mark.parametrize("effects", [(WARM,), (WARMER,), (WARM, WARMER)])
def test_an_autopilots_thermal_correction_is_that_of_the_bias(
    tmp_path: Path, effects: tuple[FittedEffect, ...]
) -> None:
    warm, cold = Unit(tmp_path / "warm", accelerometer=effects, gyroscope=effects), Unit(tmp_path / "cold")
    T = warm.temperature[:, None]
    poly = {
        s: sum(e.values.reshape(3, -1)[:, k] * (T - 25) ** (k + 1) for e in effects for k in range(len(e.values) // 3))
        for s in SENSORS
    }
    unit = {"accelerometer": G0, "gyroscope": RADIAN}
    px4, ardupilot = parameters(warm, "px4.params"), parameters(warm, "ardupilot.param")
    for sensor, name in (("accelerometer", "TC_A0"), ("gyroscope", "TC_G0")):
        dT = np.clip(T, px4[f"{name}_TMIN"], px4[f"{name}_TMAX"]) - px4[f"{name}_TREF"]
        offset = sum(np.array([px4[f"{name}_X{k}_{a}"] for a in range(3)]) * dT**k for k in range(4))
        np.testing.assert_allclose(offset, poly[sensor] * unit[sensor], atol=1e-8)
    for sensor, name in (("accelerometer", "ACC"), ("gyroscope", "GYR")):
        c = [np.array([ardupilot[f"INS_TCAL1_{name}{k}_{a}"] for a in "XYZ"]) for k in (1, 2, 3)]

        def p(t: Any, c: list[np.ndarray] = c) -> Any:
            return (c[0] + (c[1] + c[2] * t) * t) * t * 1e-6

        offset = p(T - 35.0) - p(ardupilot[f"INS_{name}1_CALTEMP"] - 35.0)
        np.testing.assert_allclose(offset, poly[sensor] * unit[sensor], atol=1e-8)
    assert px4["TC_A_ENABLE"] == px4["TC_G_ENABLE"] == ardupilot["INS_TCAL1_ENABLE"] == 1
    assert not any(key.startswith("TC_") for key in parameters(cold, "px4.params"))
    assert "Left out of this format" not in warm.text("px4.params") + warm.text("ardupilot.param")


@pytest.mark.parametrize("limits", [[25.3, 36.8], [20.0, 24.0], None])
def test_an_autopilot_corrects_by_temperature_where_the_calibration_was_recorded(
    tmp_path: Path, limits: list[float] | None
) -> None:
    """PX4 limits T to TMIN ... TMAX; ArduPilot limits T and CALTEMP (AP_InertialSensor_tempcal.cpp)."""
    unit = Unit(tmp_path / "first", accelerometer=(WARMER,), gyroscope=(WARMER,))
    unit.document["calibrated_range"] = {"temperature_degc": limits} if limits else {}
    export_all(unit.document, SETTINGS, tmp_path / "first")
    px4, ardupilot = parameters(unit, "px4.params"), parameters(unit, "ardupilot.param")
    low, high = limits or (-40.0, 85.0)
    for of_file, name in ((px4, "TC_A0"), (px4, "TC_G0"), (ardupilot, "INS_TCAL1")):
        assert [of_file[f"{name}_TMIN"], of_file[f"{name}_TMAX"]] == [low, high]
    T = np.linspace(low, high, 7)[:, None]
    c = [np.array([ardupilot[f"INS_TCAL1_ACC{k}_{a}"] for a in "XYZ"]) for k in (1, 2, 3)]

    def p(T: Any) -> Any:
        t = np.clip(T, low, high) - 35.0
        return (c[0] + (c[1] + c[2] * t) * t) * t * 1e-6

    offset = np.array([ardupilot[f"INS_ACCOFFS_{a}"] for a in "XYZ"])
    corrected = offset + p(T) - p(ardupilot["INS_ACC1_CALTEMP"])
    coefficients = WARMER.values.reshape(3, 2)
    bias = BIAS["accelerometer"] + coefficients[:, 0] * (T - 25.0) + coefficients[:, 1] * (T - 25.0) ** 2
    np.testing.assert_allclose(corrected, bias * G0, atol=1e-8)
    back = read_any(tmp_path / "first" / "ardupilot.param").sensors["accelerometer"]
    np.testing.assert_allclose(back.bias, BIAS["accelerometer"], atol=1e-9)


def test_flight_controllers_in_counts_leave_what_their_remarks_say(tmp_path: Path) -> None:
    unit = Unit(tmp_path)
    rng = np.random.default_rng(5)
    truth = rng.standard_normal((20_000, 3))
    truth /= np.linalg.norm(truth, axis=1)[:, None]
    counts = (truth @ np.linalg.inv(MATRIX["accelerometer"]).T + BIAS["accelerometer"]) * COUNTS["accelerometer"]

    def left(out: np.ndarray) -> float:
        return float(np.sqrt(np.mean(np.sum((out - truth) ** 2, axis=1))))

    inav = dict(re.findall(r"set (\w+) = (-?\d+)", unit.text("inav.txt")))
    zero, gain = (np.array([float(inav[f"acc{what}_{a}"]) for a in "xyz"]) for what in ("zero", "gain"))
    error = left((counts - zero) * gain / 4096 / COUNTS["accelerometer"])
    assert f"that leaves about {error:.2g} g at 1 g" in unit.text("inav.txt")
    assert inav["ins_gravity_cmss"] == "981"

    zero = np.array(re.search(r"acc_calibration = (.*),1", unit.text("betaflight.txt"))[1].split(","), float)
    error = left((counts - zero) / COUNTS["accelerometer"])
    assert f"that leaves about {error:.2g} g at 1 g" in unit.text("betaflight.txt")

    airframe = dict(re.findall(r'name="(\w+)" value="([^"]+)"', unit.text("paparazzi_imu.xml")))
    neutral, sens = (np.array([float(airframe[f"ACCEL_{a}_{what}"]) for a in "XYZ"]) for what in ("NEUTRAL", "SENS"))
    error = left((counts - neutral) * sens / 2**10 / G0)
    assert f"that leaves about {error:.2g} g at 1 g" in unit.text("paparazzi_imu.xml")


def test_axes_of_the_sensor_that_are_not_the_bodys_are_stated_in_each_format(tmp_path: Path) -> None:
    unit = Unit(tmp_path / "plain")
    unit.document["log"] = {"ingest": {}, "axis_map": ["-y", "+x", "+z"]}
    for path in export_all(unit.document, SETTINGS, tmp_path / "turned"):
        if path.name not in {"kalibr_imu.yaml", "vins.yaml"}:  # noise alone
            assert "x along body -y, y along body +x" in " ".join(path.read_text().split()), path.name


def test_axes_of_one_sensor_that_are_not_the_bodys_are_stated_with_its_name(tmp_path: Path) -> None:
    unit = Unit(tmp_path / "plain")
    maps = {"accelerometer": ["+x", "+y", "-z"], "gyroscope": ["+x", "+y", "+z"]}
    unit.document["log"] = {"ingest": {}, "axis_map": maps}
    for path in export_all(unit.document, SETTINGS, tmp_path / "turned"):
        if path.name not in {"kalibr_imu.yaml", "vins.yaml"}:  # noise alone
            text = " ".join(path.read_text().split())
            assert "the accelerometer's x along body +x, y along body +y, z along body -z" in text, path.name
            assert "gyroscope's x along" not in text, path.name


def test_every_format_says_what_it_leaves_out(tmp_path: Path) -> None:
    quadratic = effect("quadratic_nonlinearity", K2_x=1e-3, K2_y=1e-3, K2_z=1e-3)
    Unit(tmp_path, accelerometer=(quadratic,))
    for declared, _ in formats().values():
        if "accelerometer" in declared.units and "all" not in declared.effects:
            ending = declared.sensor_endings.get("accelerometer", "")
            file = Path(declared.file.replace("{unit}", "U1"))
            path = tmp_path / f"{file.stem}{ending}{file.suffix}"
            assert "Left out of this format, accelerometer: quadratic_nonlinearity" in path.read_text(), path.name
    assert len(formats()) < len(list(tmp_path.iterdir()))


def test_the_declarations_of_the_formats_have_their_types() -> None:
    adapter = TypeAdapter(Format)
    for name, (declared, _) in formats().items():
        assert adapter.validate_python(asdict(declared)) == declared, name
