"""Formats of other programs read back: what they hold arrives to 1e-9, and what they do not hold is stated."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from stage_files import export_all
from test_consumer_formats import BIAS, COUNTS, MATRIX, SCALED, SENSITIVE, SETTINGS, WARM, WARMER

from pipeline import load_calibration
from pipeline.app.commands.convert import main
from pipeline.app.field_logs.stream import LogProfile
from pipeline.core.errors import ConfigurationError, InputError
from pipeline.core.records import SENSORS, SensorCalibration
from pipeline.output import exports
from pipeline.output.exports import formats
from pipeline.output.exports.reading import SAMPLE, explain_calibration, read_any
from pipeline.physics.compensation import read_calibration

G0, RADIAN = 9.80665, np.pi / 180.0
EFFECTS = {"accelerometer": (WARMER, SCALED), "gyroscope": (SENSITIVE, WARM)}
WHOLE = {  # formats that hold the whole matrix of both sensors
    *("azure_kinect.json", "basalt_imu.json", "calibration.h", "fusion_calibration.h", "imu_calib_toolkit.json"),
    *("imu_tk_acc.calib", "imucal.json", "kalibr.yaml", "realsense_calibration.json"),
}
SENSITIVE_TO_G = {"imu_calib_toolkit.json", "imucal.json", "kalibr.yaml", "kalibr_imu_chain.yaml"}
WITHOUT_READINGS = {"board.yaml", "kalibr_imu.yaml", "vins.yaml"}
WARMED = {"azure_kinect.json", "ardupilot.param", "px4.params"}


def document(**effects: Any) -> dict[str, Any]:
    made: dict[str, Any] = {"unit": "U1", "schema_version": 1, "status": "ok", "error": None, "sensor": "mpu6050"}
    made["inputs"] = [{"rate_hz": 100.0}]
    for s in SENSORS:
        covariance = np.eye(12 + sum(len(e.parameters) for e in effects.get(s, ()))) * 1e-8
        calibration = SensorCalibration(s, BIAS[s], MATRIX[s], effects=effects.get(s, ()), covariance=covariance)
        made[s] = calibration.to_json()
    return made


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("exports")
    (found / "calibration.json").write_text(json.dumps(document(**EFFECTS)))
    export_all(document(**EFFECTS), SETTINGS, found)
    return found


@pytest.mark.parametrize("name", sorted(WHOLE))
def test_a_format_that_holds_the_whole_matrix_gives_it_back(folder: Path, name: str) -> None:
    found = read_any(folder / name, counts=COUNTS)
    assert set(found.sensors) == set(SENSORS)
    for s, c in found.sensors.items():
        np.testing.assert_allclose(c.bias, BIAS[s], rtol=0, atol=1e-9)
        np.testing.assert_allclose(c.matrix, MATRIX[s], rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", sorted(SENSITIVE_TO_G | WARMED))
def test_effects_that_a_format_holds_arrive_too(folder: Path, name: str) -> None:
    found = read_any(folder / name).sensors
    wanted = {e.name: e.values for of in EFFECTS.values() for e in of}
    arrived = {e.name: e.values for c in found.values() for e in c.effects}
    expected = {"g_sensitivity"} if name in SENSITIVE_TO_G else {"bias_temperature", "bias_temperature_quadratic"}
    assert set(arrived) == expected | ({"scale_factor_temperature"} if name == "azure_kinect.json" else set())
    for effect, values in arrived.items():
        np.testing.assert_allclose(values, wanted[effect], rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", ["px4.params", "ardupilot.param", "paparazzi_imu.xml"])
def test_a_format_axis_by_axis_gives_back_its_offsets_and_scale_factors(folder: Path, name: str) -> None:
    found = read_any(folder / name, counts=COUNTS).sensors
    K = np.linalg.inv(MATRIX["accelerometer"])
    scale = np.diag(K) / np.sum(K**2, axis=1)
    np.testing.assert_allclose(found["accelerometer"].matrix, np.diag(scale), atol=1e-9)
    np.testing.assert_allclose(found["accelerometer"].bias, BIAS["accelerometer"], atol=1e-9)
    np.testing.assert_allclose(found["gyroscope"].bias * RADIAN, BIAS["gyroscope"] * RADIAN, atol=1e-9)


@pytest.mark.parametrize("name", ["inav.txt", "betaflight.txt", "paparazzi_imu.xml"])
def test_a_format_in_counts_asks_for_the_sensor(folder: Path, name: str) -> None:
    with pytest.raises(InputError, match="in counts"):
        read_any(folder / name)
    if name != "paparazzi_imu.xml":
        bias = read_any(folder / name, counts=COUNTS).sensors["accelerometer"].bias
        np.testing.assert_allclose(bias, BIAS["accelerometer"], rtol=0, atol=0.5 / COUNTS["accelerometer"])


def test_the_content_tells_the_format_whatever_the_file_is_called(folder: Path, tmp_path: Path) -> None:
    format_of = {declared.file.replace("{unit}", "U1"): name for name, (declared, _) in formats().items()}
    for file in sorted(folder.iterdir()):
        if file.name in WITHOUT_READINGS:
            continue
        copy = tmp_path / ("x_acc.calib" if file.suffix == ".calib" else "x")
        shutil.copy(file, copy)
        told = read_any(copy, counts=COUNTS).format_name
        assert told == ("imu_tk.calib" if file.suffix == ".calib" else format_of.get(file.name, file.name))


def test_imu_tk_in_raw_counts_is_told_by_its_scale_factors(tmp_path: Path) -> None:
    """Tedaldi's program takes counts: x = T K (raw - B) in m/s^2 with K near 9.8 / 16384."""
    T = np.array([[1.0, -0.01, 0.02], [0.0, 1.0, 0.003], [0.0, 0.0, 1.0]])
    K, B = np.array([1.01, 0.99, 1.002]) * G0 / 16384.0, np.array([120.0, -340.0, 55.0])
    rows = [*T, *np.diag(K), *B[:, None]]
    (tmp_path / "test_acc.calib").write_text("\n".join(" ".join(f"{x:.17g}" for x in row) for row in rows))
    with pytest.raises(InputError, match="are not in m/s"):
        read_any(tmp_path / "test_acc.calib")
    found = read_any(tmp_path / "test_acc.calib", counts=COUNTS)
    raw = np.array([1000.0, -2000.0, 16000.0])
    c = found.sensors["accelerometer"]
    np.testing.assert_allclose(c.matrix @ (raw / 16384.0 - c.bias), T @ (K * (raw - B)) / G0, atol=1e-14)
    assert "in counts, 16384 per unit" in found.notes[0]


def test_a_kalibr_result_of_its_own_program_predicts_the_reading(tmp_path: Path) -> None:
    """Keys as Kalibr writes them; its equation: a = M f + b, w = M (C w) + A (C f) + b."""
    imu = {
        "model": "scale-misalignment",
        "accelerometer_noise_density": 1e-3,
        "accelerometer_random_walk": 1e-4,
        "gyroscope_noise_density": 1e-4,
        "gyroscope_random_walk": 1e-5,
        "T_i_b": np.eye(4).tolist(),
        "accelerometers": {"M": [[1.01, 0.0, 0.0], [0.002, 0.99, 0.0], [-0.003, 0.004, 1.02]]},
        "gyroscopes": {
            "M": [[0.98, 0.0, 0.0], [0.001, 1.03, 0.0], [0.002, -0.004, 1.01]],
            "A": [[1e-4, 2e-4, 0.0], [0.0, -3e-4, 1e-4], [5e-5, 0.0, 2e-4]],
            "C_gyro_i": [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]],
        },
    }
    file = tmp_path / "imu-results.yaml"
    file.write_text(yaml.safe_dump({"imu0": imu}))
    found = read_any(file)
    f, w = np.array([0.5, -2.0, 9.5]), np.array([0.3, -0.4, 0.5])  # m/s^2, rad/s
    M, C = np.array(imu["gyroscopes"]["M"]), np.array(imu["gyroscopes"]["C_gyro_i"])
    read_f = np.array(imu["accelerometers"]["M"]) @ f
    read_w = M @ C @ w + np.array(imu["gyroscopes"]["A"]) @ C @ f
    (tmp_path / "c.json").write_text("")
    assert main([str(file), str(tmp_path / "c.json"), "--to", "calibration.json"]) == 0
    unit = load_calibration(tmp_path / "c.json")
    out = unit.apply(read_f / G0, read_w / RADIAN)
    np.testing.assert_allclose(out.accelerometer, f / G0, atol=1e-12)
    np.testing.assert_allclose(out.gyroscope, w / RADIAN, atol=1e-10)
    assert "accelerometer: the file states no bias; it counts as 0" in found.notes
    assert found.noise["gyroscope_random_walk"] == 1e-5


def test_a_calibration_of_basalt_itself_is_read_below_its_root(tmp_path: Path) -> None:
    """basalt-headers: accel = raw + S raw - b with S lower triangular (s11, s21, s31, s22, s32, s33)."""
    accel, gyro = [0.1, -0.2, 0.3, 0.01, 0.002, -0.003, -0.02, 0.004, 0.03], [0.01, 0.02, -0.03, *np.arange(9) * 1e-3]
    content = {"calib_accel_bias": accel, "calib_gyro_bias": gyro, "accel_noise_std": [0.016] * 3, "T_imu_cam": []}
    (tmp_path / "calibration.json").write_text(json.dumps({"value0": content}))
    with pytest.raises(InputError, match="no calibration of a unit"):  # the name is that of our own format
        read_any(tmp_path / "calibration.json", "calibration.json")
    found = read_any(tmp_path / "calibration.json", "basalt_imu.json").sensors
    f, w = np.array([0.5, -2.0, 9.5]), np.array([0.3, -0.4, 0.5])
    S = np.array([[0.01, 0.0, 0.0], [0.002, -0.02, 0.0], [-0.003, 0.004, 0.03]])
    a, g = found["accelerometer"], found["gyroscope"]
    np.testing.assert_allclose(a.matrix @ (f / G0 - a.bias) * G0, f + S @ f - accel[:3], atol=1e-14)
    G = np.reshape(gyro[3:], (3, 3)).T  # column by column
    np.testing.assert_allclose(g.matrix @ (w / RADIAN - g.bias) * RADIAN, w + G @ w - gyro[:3], atol=1e-14)


def test_a_chain_of_conversions_keeps_every_parameter(folder: Path, tmp_path: Path) -> None:
    chain = ["kalibr.yaml", "imucal.json", "imu_calib_toolkit.json", "calibration.json", "kalibr.yaml"]
    before = folder / "kalibr.yaml"
    for step, name in enumerate(chain[1:]):
        after = tmp_path / str(step) / name
        after.parent.mkdir()
        assert main([str(before), str(after), "--sensor", "mpu6050"]) == 0
        before = after
    first, last = (read_any(file).sensors for file in (folder / "kalibr.yaml", before))
    for s in SENSORS:
        np.testing.assert_allclose(last[s].bias, first[s].bias, rtol=0, atol=1e-9)
        np.testing.assert_allclose(last[s].matrix, first[s].matrix, rtol=0, atol=1e-9)
    np.testing.assert_allclose(last["gyroscope"].effects[0].values, SENSITIVE.values, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    "maps", [["-y", "+x", "+z"], {"accelerometer": ["+x", "-y", "-z"], "gyroscope": ["+x", "+y", "+z"]}]
)
@pytest.mark.parametrize("name", sorted({"px4.params", "imu_calib.yaml", *WHOLE} - {"imu_tk_acc.calib"}))
def test_the_axis_map_survives_a_conversion_and_back(
    tmp_path: Path, name: str, maps: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    """A log of the unit, in the axes of the sensor, is turned alike by the calibration and by its copy of a copy."""
    made = document() | {"log": {"ingest": {"csv": {}}, "axis_map": maps}}
    (tmp_path / "first.json").write_text(json.dumps(made))
    assert main([str(tmp_path / "first.json"), str(tmp_path / name), "--sensor", "mpu6050"]) == 0
    assert main([str(tmp_path / name), str(tmp_path / "calibration.json"), "--sensor", "mpu6050"]) == 0
    assert "axes of the sensor along" not in capsys.readouterr().out
    last = json.loads((tmp_path / "calibration.json").read_text())
    readings = np.array([[1.0, 2.0, 3.0]])
    profile = LogProfile.of_calibration(last, "calibration.json")
    for s in SENSORS:
        before = LogProfile.of_calibration(made, "first.json").to_body(s, readings)
        np.testing.assert_array_equal(profile.to_body(s, readings), before)
    assert profile.ingest == LogProfile().ingest  # no format states the columns of a log


def test_an_axis_map_that_a_format_cannot_hold_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(exports.TEMPLATES, tmp_path / "templates")
    silent = (exports.TEMPLATES / "px4.params.j2").read_text().replace("{{ remarks | comment }}\n", "")
    (tmp_path / "templates" / "px4.params.j2").write_text(silent)
    monkeypatch.setattr(exports, "TEMPLATES", tmp_path / "templates")
    formats.cache_clear()
    (tmp_path / "first.json").write_text(json.dumps(document() | {"log": {"axis_map": ["-y", "+x", "+z"]}}))
    try:
        main([str(tmp_path / "first.json"), str(tmp_path / "px4.params")])
    finally:
        formats.cache_clear()
    assert "body (accelerometer -y +x +z, gyroscope -y +x +z): turn the readings" in capsys.readouterr().out


def test_an_uncertainty_that_no_file_states_is_null(folder: Path, tmp_path: Path) -> None:
    """Kalibr states none, Azure Kinect that of the bias; what reads the result again knows as much."""
    main([str(folder / "kalibr.yaml"), str(tmp_path / "calibration.json")])
    unknown = json.loads((tmp_path / "calibration.json").read_text())["gyroscope"]
    for key in ("standard_uncertainty", "expanded_uncertainty"):
        assert unknown[key] == {"bias": [None] * 3, "matrix": [[None] * 3] * 3}
    assert {x for row in unknown["covariance"]["values"] for x in row} == {None}
    assert read_any(tmp_path / "calibration.json").sensors["gyroscope"].covariance is None
    assert load_calibration(tmp_path / "calibration.json").apply(np.eye(3), np.eye(3)).gyroscope.shape == (3, 3)
    main([str(folder / "azure_kinect.json"), str(tmp_path / "calibration.json")])
    in_part = json.loads((tmp_path / "calibration.json").read_text())["accelerometer"]
    assert in_part["standard_uncertainty"]["bias"] == pytest.approx([1e-4] * 3)
    assert in_part["expanded_uncertainty"]["matrix"] == [[None] * 3] * 3
    assert in_part["covariance"]["values"][3][3] is None
    again = read_any(tmp_path / "calibration.json")
    np.testing.assert_allclose(np.diag(again.sensors["accelerometer"].covariance)[:4], [1e-8, 1e-8, 1e-8, 0.0])
    assert "g, matrix not stated\n" in explain_calibration(again)


def test_noise_that_both_formats_hold_is_kept_with_its_origin(folder: Path, tmp_path: Path) -> None:
    assert main([str(folder / "kalibr.yaml"), str(tmp_path / "basalt_imu.json")]) == 0
    first, last = read_any(folder / "kalibr.yaml").noise, read_any(tmp_path / "basalt_imu.json").noise
    assert len(first) == 4
    assert last == pytest.approx(first, rel=1e-12)
    assert "as kalibr.yaml states it" in (tmp_path / "basalt_imu.json").read_text()


def test_convert_states_what_is_lost(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = str(folder / "calibration.json")
    main([source, str(tmp_path / "px4.params")])
    told = capsys.readouterr().out
    for line in (
        "accelerometer: elements of the matrix change by up to 0.021",
        "accelerometer: the effect scale_factor_temperature",
        "gyroscope: the effect g_sensitivity",
        "gyroscope: The matrix of the gyroscope is left out: that leaves about 2.1 % of the rate.",
        "expanded uncertainties, covariances and uncertainty budgets",
    ):
        assert f"  {line}\n" in told
    assert "bias_temperature" not in told
    main([source, str(tmp_path / "kalibr_imu_chain.yaml")])
    assert "gyroscope: the bias\n" in capsys.readouterr().out
    main([source, str(tmp_path / "imu_calib.yaml")])
    assert "gyroscope: all of it" in capsys.readouterr().out
    main([str(folder / "realsense_calibration.json"), str(tmp_path / "rig.calib"), "--to", "imu_tk"])
    told = capsys.readouterr().out
    assert "lost: nothing" in told
    assert (tmp_path / "rig_acc.calib").is_file()
    assert (tmp_path / "rig_gyro.calib").is_file()


def test_what_a_conversion_cannot_do_is_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(
        ConfigurationError, match=r"kalibr\.yaml needs the noise density; IN does not state it: give --sensor NAME"
    ):
        main([str(folder / "imucal.json"), str(tmp_path / "kalibr.yaml")])
    with pytest.raises(ConfigurationError, match="--sensor mpu9999: no such sensor"):
        main([str(folder / "imucal.json"), str(tmp_path / "kalibr.yaml"), "--sensor", "mpu9999"])
    with pytest.raises(ConfigurationError, match=r"several formats: calibration.json, calibration.h"):
        main([str(folder / "imucal.json"), str(tmp_path / "x"), "--to", "calibration"])
    with pytest.raises(ConfigurationError, match="OUT is the file IN"):
        main([str(folder / "imucal.json"), str(folder / "imucal.json")])
    for name in ("kalibr_imu.yaml", "vins.yaml"):
        with pytest.raises(InputError, match="noise only"):
            read_any(folder / name)
    imu = yaml.safe_load((folder / "kalibr.yaml").read_text())
    del imu["imu0"]["gyroscopes"]["C_gyro_i"]
    (tmp_path / "k.yaml").write_text(yaml.safe_dump(imu))
    with pytest.raises(InputError, match=r"imu0.gyroscopes.C_gyro_i is missing"):
        read_any(tmp_path / "k.yaml")
    (tmp_path / "x.txt").write_text("hello")
    with pytest.raises(InputError, match="the file has the keys of no format"):
        read_any(tmp_path / "x.txt")


def test_every_format_with_a_calibration_can_be_read() -> None:
    for name, (declared, _) in formats().items():
        assert set(declared.read_back) >= ({"kind"} if declared.units else set()), name
    assert {name for name, (declared, _) in formats().items() if not declared.units} <= WITHOUT_READINGS


def test_the_worked_sample_of_an_explanation_is_what_apply_gives(folder: Path) -> None:
    text = explain_calibration(read_any(folder / "calibration.json"))
    expected = load_calibration(folder / "calibration.json").apply(**SAMPLE, smoothing=0.0)
    shown = [line.partition("[")[2].partition("]")[0] for line in text.splitlines() if "matrix times that" in line]
    for s, numbers in zip(SENSORS, shown, strict=True):
        np.testing.assert_allclose([float(x) for x in numbers.split(",")], getattr(expected, s), rtol=1e-8)
    assert "calibrated = matrix (reading - bias - g_sensitivity - bias_temperature), deg/s" in text
    assert "x: 0.1 * f[0] + -0.02 * f[1] + 0.03 * f[2]" in text


def test_a_diff_of_inav_omits_defaults(tmp_path: Path) -> None:
    file = tmp_path / "diff.txt"
    file.write_text(
        "# diff\nset acczero_x = 12\nset acczero_z = -40\nset accgain_y = 4100\nset gyro_hardware_lpf = 256HZ\n"
    )
    found = read_any(file, None, {"accelerometer": 2048.0, "gyroscope": 16.4})
    assert found.format_name == "inav.txt"
    np.testing.assert_allclose(found.sensors["accelerometer"].bias, np.array([12, 0, -40]) / 2048.0)
    np.testing.assert_allclose(np.diag(found.sensors["accelerometer"].matrix), [1.0, 4100 / 4096, 1.0])
    assert "acczero_y = 0" in found.notes[0]


def test_commands_of_px4s_console_are_parameters(tmp_path: Path) -> None:
    file = tmp_path / "px4.txt"
    lines = [f"param set CAL_ACC0_{a}OFF 0.{i}" for i, a in enumerate("XYZ", 1)]
    lines += [f"param set CAL_ACC0_{a}SCALE 1.0{i}" for i, a in enumerate("XYZ", 1)]
    file.write_text("\n".join(lines))
    found = read_any(file)
    assert found.format_name == "px4.params"
    np.testing.assert_allclose(found.sensors["accelerometer"].bias * 9.80665, [0.1, 0.2, 0.3])


def test_readings_without_a_unit_are_the_counts_of_the_stated_sensor(tmp_path: Path) -> None:
    content = {
        "K_a": np.diag([208.0, 209.0, 210.0]).tolist(), "R_a": np.eye(3).tolist(), "b_a": [10.0, 0.0, -20.0],
        "K_g": np.diag([16.4, 16.5, 16.3]).tolist(), "R_g": np.eye(3).tolist(), "b_g": [3.0, 0.0, 1.0],
        "K_ga": np.zeros((3, 3)).tolist(), "acc_unit": "m/s^2", "gyr_unit": "deg/s", "from_acc_unit": "a.u.",
    }  # fmt: skip
    file = tmp_path / "imucal.json"
    file.write_text(json.dumps(content))
    found = read_any(file, None, {"accelerometer": 2048.0, "gyroscope": 16.4})
    np.testing.assert_allclose(found.sensors["accelerometer"].bias, np.array([10.0, 0.0, -20.0]) / 2048.0)
    with pytest.raises(InputError, match="state it"):
        read_any(file)


def test_what_holds_no_calibration_says_so(tmp_path: Path) -> None:
    (tmp_path / "imu.yaml").write_text(
        "accelerometer_noise_density: 0.01\naccelerometer_random_walk: 0.001\nrostopic: /imu0\n"
    )
    with pytest.raises(InputError, match="noise of a sensor for a filter, and no calibration"):
        read_any(tmp_path / "imu.yaml")
    (tmp_path / "kalibr.yaml").write_text("imu0:\n  model: scale-misalignment\n")
    with pytest.raises(InputError, match=r"convert .*kalibr\.yaml calibration\.json"):
        read_calibration(tmp_path / "kalibr.yaml")
