"""Known coefficients of temperature, subtracted before the fit, against units whose truth is simulated.

The reference is the truth, and the same unit without an influence of temperature: its noise is the same.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import pytest
import yaml

import pipeline
from pipeline.app.commands import simulate
from pipeline.core.errors import ConfigurationError
from pipeline.core.files import read_json
from pipeline.core.settings import DataSheet, KnownTemperature
from pipeline.estimation import known_temperature

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from pipeline.app.one_unit import UnitResult

SENSORS = ("accelerometer", "gyroscope")
TRUTH = {
    "accelerometer": {"bias_temperature": [2.0e-3, -1.5e-3, 1.0e-3], "scale_factor_temperature": [3e-4, -2e-4, 2.5e-4]},
    "gyroscope": {"bias_temperature": [0.1, -0.2, 0.15], "scale_factor_temperature": [4e-4, -3e-4, 5e-4]},
}
KNOWN = [
    f"sensor.{sensor}.known_temperature.{setting}={TRUTH[sensor][f'{setting}_temperature']}"
    for sensor in SENSORS
    for setting in ("bias", "scale_factor")
]
TABLE = {
    "course": {"step_deg": 15, "dwell_s": 1.0, "rates_dps": [60, 120], "validation_s": 60, "both_directions": True},
    "temperature": {"ambient": 33.0, "warm_up": 9.0},
}
HAND = {
    "table": "hand",
    "procedure": "multi_position",
    "course": {"positions": 40, "validation_s": 0},
    "temperature": {"ambient": 33.0, "warm_up": 12.0},
}
METHODS = {
    "by_hand": ("[known_temperature, nonlinear_least_squares]", "[known_temperature, rests_and_moves]"),
    "by_stages": (
        "[known_temperature, orthogonality, misalignment, bias, scale_factor]",
        "[known_temperature, bias, orthogonality_and_misalignment, scale_factor]",
    ),
    "after": ("[reference_least_squares]", "[reference_least_squares, known_temperature]"),
    "alone": ("[reference_least_squares]", "[known_temperature]"),
    "judged": ("[reference_least_squares]", "[known_temperature, given]"),
}


def made(directory: Path, unit: dict[str, Any]) -> Path:
    """Return a campaign of two units with the same noise: W, whose readings depend on the temperature, and N."""
    for name, effects in [("W", TRUTH), ("N", {})]:
        hidden = {f"{sensor}.{effect}": v for sensor, of in effects.items() for effect, v in of.items()}
        entry = {"unit": "U1", "sensor": "mpu6050", "effects": hidden, **unit}
        folder = directory / name
        (folder / "configs" / "method").mkdir(parents=True)
        (folder / "simulation.yaml").write_text(yaml.safe_dump({"seed": 7, "units": [entry]}))
        assert simulate.main([str(folder), "--from", str(folder / "simulation.yaml"), "--quiet"]) == 0
        for method, (accelerometer, gyroscope) in METHODS.items():
            stages = f"stages: {{accelerometer: {accelerometer}, gyroscope: {gyroscope}}}"
            text = f"accelerometer: {method}\ngyroscope: {method}\nas_printed: false\n{stages}\n"
            (folder / "configs" / "method" / f"{method}.yaml").write_text(text)
    return directory


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made(tmp_path_factory.mktemp("table"), TABLE)


@pytest.fixture(scope="module")
def calibrated(table: Path) -> Callable[..., UnitResult]:
    """Return the function that calibrates unit W or N of the table, each method once."""
    return cache(lambda unit, *overrides: pipeline.calibrate_unit(table / unit, "U1", overrides=list(overrides)))


@pytest.fixture(scope="module")
def known(calibrated: Callable[..., UnitResult]) -> UnitResult:
    return calibrated("W", "method=known_temperature", *KNOWN)


@pytest.fixture(scope="module")
def with_another(calibrated: Callable[..., UnitResult]) -> UnitResult:
    effects = ["effects.accelerometer=[quadratic_nonlinearity]", "effects.gyroscope=[g_sensitivity]"]
    return calibrated("W", "method=known_temperature", *KNOWN, *effects)


def errors(found: UnitResult, reference: dict[str, dict[str, Any]], sensor: str) -> np.ndarray:
    """Return the differences of bias and matrix from a reference over U."""
    calibration = getattr(found, sensor)
    return np.concatenate(
        [
            (np.ravel(getattr(calibration, name)) - np.ravel(reference[sensor][name]))
            / np.where((U := np.ravel(calibration.expanded_uncertainty[name])) > 0.0, U, np.inf)
            for name in ("bias", "matrix")
        ]
    )


def as_reference(found: UnitResult) -> dict[str, dict[str, Any]]:
    return {s: {"bias": getattr(found, s).bias, "matrix": getattr(found, s).matrix} for s in SENSORS}


def of_effects(found: UnitResult, sensor: str) -> dict[str, list[dict[str, Any]]]:
    return {e["name"]: list(e["parameters"].values()) for e in found.calibration[sensor]["effects"]}


@pytest.mark.parametrize("sensor", SENSORS)
def test_bias_and_matrix_are_those_of_a_unit_that_does_not_depend_on_the_temperature(
    table: Path, known: UnitResult, calibrated: Callable[..., UnitResult], sensor: str
) -> None:
    of_truth = errors(known, read_json(table / "W" / "truth" / "U1.json"), sensor)
    assert np.mean(np.abs(of_truth) < 1.0) > 0.8
    assert np.abs(of_truth).max() < 2.0
    other = calibrated("N", "method=reference_least_squares")
    assert np.abs(errors(known, as_reference(other), sensor)).max() < 0.3  # noise of the thermometer, rounding
    plain = calibrated("W", "method=reference_least_squares")
    assert np.abs(errors(plain, read_json(table / "W" / "truth" / "U1.json"), sensor)).max() > 5.0


@pytest.mark.parametrize("sensor", SENSORS)
def test_the_known_effects_are_published_without_an_uncertainty_which_the_budget_states(
    known: UnitResult, sensor: str
) -> None:
    effects, part = of_effects(known, sensor), known.calibration[sensor]
    assert {name: [p["value"] for p in of] for name, of in effects.items()} == TRUTH[sensor]
    assert all(p["expanded_uncertainty"] is None for of in effects.values() for p in of)
    budget = part["uncertainty_budget"]
    assert budget["parameters"] == part["covariance"]["parameters"]
    assert {len(line["contribution"]) for line in budget["contributions"]} == {18}
    (stated,) = [entry["reason"] for entry in budget["not_included"] if entry["source"] == "known effects"]
    assert stated.startswith("no uncertainty of the known bias_temperature and scale_factor_temperature is stated")
    assert [stage["name"] for stage in part["stages"]] == ["known_temperature", "reference_least_squares"]


@pytest.mark.parametrize("sensor", SENSORS)
def test_nothing_is_missing_and_the_held_out_error_is_noise(known: UnitResult, sensor: str) -> None:
    diagnosis, validation = known.diagnosis[sensor], known.validation[sensor]
    assert (diagnosis["verdict"], diagnosis["selected"]) == ("nothing_missing", [])
    assert not TRUTH[sensor].keys() & {entry["effect"] for entry in diagnosis["not_observable"]}
    assert validation["steps"][-1]["name"] == "+ scale_factor_temperature"
    assert validation["steps"][-1]["rms_error"] < 1.1 * validation["noise_floor"]


def test_it_is_applied_to_a_log(table: Path, known: UnitResult) -> None:
    log = pd.read_csv(table / "W" / "raw" / "U1" / "static.csv")
    assert log.temperature_degc.min() > 35.0
    rate, force = (known.apply(log)[[f"{n}_{a}_{u}" for a in "xyz"]] for n, u in [("gyro", "dps"), ("accel", "g")])
    assert np.abs(rate.mean()).max() < 0.02  # bias_temperature alone is 1.5 deg/s and more
    assert np.linalg.norm(force.mean()) == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("sensor", SENSORS)
def test_effects_that_are_added_are_fitted_beside_the_known_ones(
    table: Path, with_another: UnitResult, sensor: str
) -> None:
    effects = of_effects(with_another, sensor)
    (added,) = effects.keys() - TRUTH[sensor].keys()
    assert all(abs(p["value"]) < 2.0 * p["expanded_uncertainty"] for p in effects[added])  # there is none
    assert {n: [p["value"] for p in effects[n]] for n in TRUTH[sensor]} == TRUTH[sensor]
    assert np.abs(errors(with_another, read_json(table / "W" / "truth" / "U1.json"), sensor)).max() < 2.0
    assert with_another.verdict[sensor] == "nothing_missing"


def test_what_a_wrong_coefficient_leaves_is_fitted_and_added_to_it(table: Path) -> None:
    wrong = ["sensor.gyroscope.known_temperature.bias=[0.05, -0.2, 0.15]", "effects.gyroscope=[bias_temperature]"]
    found = pipeline.calibrate_unit(table / "W", "U1", overrides=["method=known_temperature", *KNOWN, *wrong])
    fitted = of_effects(found, "gyroscope")["bias_temperature"]
    for parameter, true in zip(fitted, TRUTH["gyroscope"]["bias_temperature"], strict=True):
        assert abs(parameter["value"] - true) < 2.0 * parameter["expanded_uncertainty"] < 0.02


@pytest.mark.parametrize("sensor", SENSORS)
def test_the_staged_method_honours_it(calibrated: Callable[..., UnitResult], sensor: str) -> None:
    staged = calibrated("W", "method=by_stages", *KNOWN)
    other = calibrated("N", "method=staged")
    assert np.abs(errors(staged, as_reference(other), sensor)).max() < 0.3
    assert TRUTH[sensor].keys() <= of_effects(staged, sensor).keys()


def test_by_hand_it_leaves_nothing_missing(tmp_path: Path) -> None:
    directory = made(tmp_path, HAND)
    found = pipeline.calibrate_unit(directory / "W", "U1", overrides=["method=by_hand", *KNOWN])
    other = pipeline.calibrate_unit(directory / "N", "U1", overrides=["method=rests_and_moves"])
    for sensor in SENSORS:
        assert np.abs(errors(found, as_reference(other), sensor)).max() < 1.0  # rounding differs, too
        assert found.verdict[sensor] == "nothing_missing"
        assert not TRUTH[sensor].keys() & {e["effect"] for e in found.diagnosis[sensor]["not_observable"]}


def test_a_coefficient_relative_to_another_temperature_is_converted() -> None:
    at_45 = [0.1 / (1.0 + 0.1 * 20.0)] * 3  # 1 + 0.1 (T - 25 degC) is 3 at 45 degC
    stated = KnownTemperature(scale_factor=at_45, reference_degc=45.0)
    (effect,) = known_temperature.known("gyroscope", DataSheet.model_construct(known_temperature=stated))
    assert list(effect.values) == pytest.approx([0.1] * 3)


def test_a_turn_without_temperature_leaves_the_sensor_uncalibrated_with_the_reason(table: Path) -> None:
    raw = table / "W" / "raw" / "U1"
    frames = {file.stem: pd.read_csv(file) for file in raw.glob("*.csv")}
    frames["gyro_y"] = frames["gyro_y"].drop(columns="temperature_degc")
    found = pipeline.calibrate(frames, sensor="mpu6050", table="acutronic", method="known_temperature", overrides=KNOWN)
    assert found.gyroscope is None
    assert "gyro_y logs no temperature" in found.calibration["not_calibrated"]["gyroscope"]
    assert found.accelerometer is not None


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["method=after", *KNOWN], "cannot follow reference_least_squares: it does not honour bias"),
        (["method=judged", *KNOWN], "given cannot follow known_temperature: it does not honour readings"),
        (["method=alone", *KNOWN], "no stage fits bias or matrix"),
        (
            ["method=known_temperature", "filter=high_pass", *KNOWN],
            "filter=high_pass removes the slow changes of a bias",
        ),
        (["method=known_temperature", *KNOWN[2:]], "sensor.accelerometer.known_temperature states neither bias nor"),
    ],
)
def test_what_cannot_be_honoured_is_refused_before_any_job(table: Path, overrides: list[str], words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        pipeline.calibrate_unit(table / "W", "U1", overrides=overrides)
