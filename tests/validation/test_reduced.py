"""What formats of other programs hold, fitted to the recordings, against the best by the truth of a simulation."""

from __future__ import annotations

import copy
import json
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest

import pipeline
from pipeline.app.commands.add import changed_files
from pipeline.app.commands.convert import main as convert
from pipeline.app.one_unit import unit_of_recordings
from pipeline.evaluation.held_out.validation import HELD
from pipeline.output.exports import ExportedUnit, formats
from pipeline.physics.effects import catalogue
from pipeline.physics.effects.base import REFERENCE_TEMPERATURE, Owner
from pipeline.simulation.campaign import simulate_unit
from pipeline.simulation.description import UnitDescription
from tests.study.listed_recordings import Unit

if TYPE_CHECKING:
    from pathlib import Path

    from pipeline.unit import UnitState

EFFECT = {"accelerometer.quadratic_nonlinearity": [0.004, -0.003, 0.005]}


@cache
def unit(*, added: bool) -> tuple[UnitState, dict]:
    recordings, truth = simulate_unit(UnitDescription("U", table="acutronic", effects=EFFECT), 7, 0)
    layers = ["table=acutronic", "sensor=mpu6050", *(["effects.accelerometer=[quadratic_nonlinearity]"] * added)]
    return unit_of_recordings(recordings, layers).run_to("export"), truth


def test_every_format_that_holds_less_has_its_own_fit() -> None:
    known = {(part, frozenset(names)) for part, names in HELD}
    of_sensor = {n for n, e in catalogue().items() if e.owner == Owner.SENSOR}
    for declared, _ in formats().values():
        for sensor in declared.units:
            names = frozenset({*declared.effects, *declared.effects_in_part})
            shown = {n for n in of_sensor if sensor in catalogue()[n].sensors} & names
            part = declared.matrix.get(sensor, "full")
            possible = {frozenset(held) & {*catalogue()} for p, held in known if p == part}
            assert "all" in names or any(shown == {n for n in p if sensor in catalogue()[n].sensors} for p in possible)


def test_a_format_without_an_effect_holds_the_best_offset_and_scale() -> None:
    """With the simulation's own truth t in all directions: least squares of t by offset and scale factors."""
    state, truth = unit(added=True)
    text = state.exports["px4.params"]
    values = {line.split("\t")[2]: float(line.split("\t")[3]) for line in text.splitlines() if line[:1].isdigit()}
    offset = np.array([values[f"CAL_ACC0_{a}OFF"] for a in "XYZ"]) / 9.80665
    scale = np.array([values[f"CAL_ACC0_{a}SCALE"] for a in "XYZ"])
    rng = np.random.default_rng(1)
    t = rng.standard_normal((20_000, 3))
    t /= np.linalg.norm(t, axis=1, keepdims=True)
    K = np.linalg.inv(np.array(truth["accelerometer"]["matrix"]))
    r = t @ K.T + np.array(truth["accelerometer"]["bias"]) + t**2 * EFFECT["accelerometer.quadratic_nonlinearity"]

    def error(offset: np.ndarray, scale: np.ndarray) -> float:
        return float(np.sqrt(np.mean(np.sum(((r - offset) * scale - t) ** 2, axis=1))))

    pairs = [np.linalg.lstsq(np.stack([r[:, i], np.ones(len(r))], axis=1), t[:, i], rcond=None)[0] for i in range(3)]
    best = error(np.array([-p[1] / p[0] for p in pairs]), np.array([p[0] for p in pairs]))
    assert error(offset, scale) < 1.05 * best
    assert np.abs(np.mean((r - offset) * scale - t, axis=0)).max() < 3e-4
    full = state.calibration["accelerometer"]  # its bias without the effect leaves a third of the effect
    assert np.abs(np.mean((r - full["bias"]) * scale - t, axis=0)).max() > 1e-3


def test_header_and_validation_state_the_error_of_the_file_and_of_the_calibration() -> None:
    state, _ = unit(added=True)
    part = state.validation["accelerometer"]
    (held,) = [r for r in part["reduced"] if (r["part"], r["effects"]) == ("diagonal", [])]
    last = part["steps"][-1]["rms_error"]
    assert last < held["rms_error"]
    text = state.exports["px4.params"]
    assert f"held-out rms error of the accelerometer {held['rms_error']:.4g} g" in text
    assert (
        f"With all of the calibration: held-out rms error of the accelerometer, + quadratic_nonlinearity: {last:.4g} g"
        in text
    )
    # adding an effect makes no file worse that cannot hold it
    (before,) = [r for r in unit(added=False)[0].validation["accelerometer"]["reduced"] if r["part"] == "diagonal"]
    assert held["rms_error"] == pytest.approx(before["rms_error"], rel=0.05)


def test_convert_writes_the_values_of_the_run(tmp_path: Path) -> None:
    state, _ = unit(added=True)
    for kind, document in (("calibrations", state.calibration), ("validations", state.validation)):
        (tmp_path / kind).mkdir()
        (tmp_path / kind / "unit.json").write_text(json.dumps(document))
    assert convert([str(tmp_path / "calibrations" / "unit.json"), str(tmp_path / "px4.params")]) == 0
    texts = (tmp_path / "px4.params").read_text(), state.exports["px4.params"]
    written, of_run = ([line for line in text.splitlines() if "\tCAL_ACC0" in line] for text in texts)
    assert written == of_run
    assert len(written) > 5


def test_an_effect_of_gravity_that_a_file_cannot_hold_stays_in_its_bias_as_far_as_the_rests_have_a_mean() -> None:
    effects = {"gyroscope.g_sensitivity": [0.3, -0.1, 0.2, 0.1, 0.4, -0.2, 0.1, 0.2, 0.5]}
    recordings, _ = simulate_unit(UnitDescription("U", table="hand", procedure="ferraris", effects=effects), 7, 0)
    layers = ["table=hand", "procedure=ferraris", "method=rests_and_moves", "effects.gyroscope=[g_sensitivity]"]
    part = unit_of_recordings(recordings, layers).run_to("validate").validation["gyroscope"]
    (held,) = [r for r in part["reduced"] if r["part"] == "full"]
    (same_bias,) = [step for step in part["steps"] if step["name"] == "calibrated"]
    assert held["rms_error"] < 0.85 * same_bias["rms_error"]  # a fit without the effect: 0.397 to 0.463 deg/s


def test_a_file_without_the_slope_of_a_gyroscopes_scale_holds_the_matrix_at_the_recordings_temperature() -> None:
    slope = np.array([0.002, -0.001, 0.0015])  # 1/degC
    effects, warm = {"gyroscope.scale_factor_temperature": slope.tolist()}, {"ambient": 40.0}
    description = UnitDescription("U", table="acutronic", effects=effects, temperature=warm)
    recordings, truth = simulate_unit(description, 7, 0)
    layers = ["table=acutronic", "sensor=mpu6050", "effects.gyroscope=[scale_factor_temperature]"]
    part = unit_of_recordings(recordings, layers).run_to("validate").validation["gyroscope"]
    (held,) = [r for r in part["reduced"] if (r["part"], r["effects"]) == ("full", [])]
    at = np.mean(np.concatenate([r.temperature for r in recordings if r.role == "gyroscope"])) - REFERENCE_TEMPERATURE
    assert at > 10.0
    K = np.linalg.inv(truth["gyroscope"]["matrix"]) + at * np.diag(slope)
    np.testing.assert_allclose(held["matrix"], np.linalg.inv(K), atol=1e-3)


def test_add_names_the_files_whose_error_changes() -> None:
    was, now = (
        ExportedUnit(s.calibration, {}, validation=copy.deepcopy(s.validation))
        for s in (unit(added=False)[0], unit(added=True)[0])
    )
    error = was.held_out_errors(less=False)["accelerometer", "px4.params"]
    assert now.held_out_errors(less=True)["accelerometer", "px4.params"] == pytest.approx(error, rel=0.05)
    (line,) = [line for line in changed_files("U", was, now) if "px4.params" in line]
    assert line.startswith("U, accelerometer: these files cannot hold the effect, and their error stays: ")
    assert not changed_files("U", now, now)
    for held in now.validation["accelerometer"]["reduced"]:
        if held["part"] == "diagonal":
            held["rms_error"] = 1.2 * error
    changed = ExportedUnit(now.document, {}, validation=now.validation)
    (line,) = [line for line in changed_files("U", was, changed) if "px4.params" in line]
    change = f"{error:.3g} -> {1.2 * error:.3g} g: "
    assert line.startswith(f"U, accelerometer, held-out error of files that hold less {change}")


@pytest.fixture
def soaked(tmp_path: Path) -> tuple[Path, list[str]]:
    """Two soaks of a unit in one attitude, one held out, with cubic biases; and the settings that fit these."""
    simulated = Unit(tmp_path, np.random.default_rng(3))
    cold = np.linspace(-15.0, 60.0, 1500)
    for name, warmth, row in (("heat", cold, "soak"), ("cool", cold[::-1], "soak,,,,yes")):
        t = (warmth - 25.0)[:, None]
        force = np.array([0.1, -0.2, 0.97]) + t * 3e-4 + t**2 * np.array([2e-6, -1e-6, 2e-5])
        rate = t * np.array([1e-3, -2e-3, 5e-4]) + t**3 * 1e-6
        simulated.write(name, row, force, rate, warmth=warmth, hz=2.0, between=0.0)
    simulated.sheet()
    effects = [f"effects.{sensor}=[bias_temperature_cubic]" for sensor in ("accelerometer", "gyroscope")]
    return tmp_path, effects


def test_one_attitude_determines_no_matrix_of_a_format(soaked: tuple[Path, list[str]]) -> None:
    """The change over temperature alone would determine one, of factors from 0.004 to 5."""
    folder, effects = soaked
    result = pipeline.calibrate(folder, sensor="mpu6050", procedure="listed", overrides=effects)
    assert result.accelerometer is not None
    held = [r for r in result.validation["accelerometer"]["reduced"] if r["part"] == "full"]
    assert held
    for each in held:
        np.testing.assert_allclose(each["matrix"], result.accelerometer.matrix)
        assert np.abs(each["bias"]).max() < 0.2


def test_a_given_calibration_keeps_the_order_of_parameters(soaked: tuple[Path, list[str]]) -> None:
    folder, effects = soaked
    fitted = pipeline.calibrate(folder, sensor="mpu6050", procedure="listed", overrides=effects)
    fitted.save(folder / "out")
    file = next((folder / "out" / "calibrations").iterdir())
    given = pipeline.calibrate(
        folder, sensor="mpu6050", procedure="listed", method="given", overrides=[f"method.file={file}"]
    )
    for sensor in ("accelerometer", "gyroscope"):
        parameters = [r.calibration[sensor]["effects"][0]["parameters"] for r in (fitted, given)]
        assert list(parameters[0]) == list(parameters[1])
        for name, value in parameters[0].items():
            assert parameters[1][name]["value"] == pytest.approx(value["value"])
            assert parameters[1][name]["expanded_uncertainty"] == pytest.approx(value["expanded_uncertainty"], rel=0.2)
        last = [r.validation[sensor]["steps"][-1]["rms_error"] for r in (fitted, given)]
        assert last[1] == pytest.approx(last[0])
