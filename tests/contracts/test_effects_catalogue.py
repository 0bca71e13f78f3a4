"""Every effect on disk keeps the promises of an effect."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from bench_session import CONTINUOUS, SIZE, K, Session, random_motion, record, values_of

from pipeline.core.records import SENSORS, Answer, Motion
from pipeline.evaluation.diagnosis.words import to_distinguish
from pipeline.physics import effects
from pipeline.physics.effects import built_in, built_in_files, catalogue
from pipeline.physics.effects.base import Effect, Owner, parameter_limits
from pipeline.physics.kinematics import reference_motion

CONFIGS = Path(__file__).parents[2] / "configs" / "effect"
BOTH = [
    "bias_temperature",
    "bias_temperature_quadratic",
    "bias_temperature_cubic",
    "temperature_lag",
    "scale_factor_temperature",
    "warm_up",
    "scale_factor_asymmetry",
    "quadratic_nonlinearity",
    "cubic_nonlinearity",
    "vibration_rectification",
    "bias_drift",
    "time_offset",
    "low_pass_lag",
    "clock_rate",
    "table_tilt",
    "table_axis_nonorthogonality",
    "table_encoder_error",
    "table_rate_ripple",
    "table_backlash",
    "mounting",
    "encoder_zero",
]
OF_TABLE = {"time_offset", "low_pass_lag", "clock_rate", "mounting", "encoder_zero"}
TURNS = dict.fromkeys(("accel_x", "accel_y", "accel_z", "gyro_x", "gyro_y", "gyro_z"), "")
ACCELEROMETER = ["cross_axis_nonlinearity", "hysteresis", "inner_lever_arms", "rate_dependence", "lever_arm"]
GYROSCOPE = ["g_sensitivity", "g_squared_sensitivity", "earth_rotation"]
OWNERS = {
    Owner.RECORDING: {"bias_drift"},
    Owner.MOUNTING: {"lever_arm", "earth_rotation"},
    Owner.TABLE: {n for n in BOTH if n.startswith("table_")} | OF_TABLE,
}
RATE_PRODUCT = """\
# z = P w_y w_z
name: rate_product
built_in: true
owner: sensor
sensors: [gyroscope]
meaning: A gyroscope reads a product of rates.
excitation: turns about an inclined axis
experiment: turn at twice the rate
source: none
terms: {P: {formula: wy * wz, unit: 1/(deg/s)}}
limits: {P: 1.0e-5}
"""
CASES = [(name, sensor) for name, effect in catalogue().items() for sensor in effect.sensors]


@pytest.fixture(scope="module")
def motions() -> list[Motion]:
    return [reference_motion(r) for r in record(Session(3, CONTINUOUS)) if r.axis is not None]


def realistic(name: str, sensor: str) -> np.ndarray:
    if name in SIZE[sensor]:
        return values_of(sensor, name, np.random.default_rng(1))
    return np.full(len(bound(name).parameters(sensor)), 0.01)


def bound(name: str) -> Effect:
    return catalogue()[name].of_recordings(TURNS)


def test_catalogue_holds_every_effect_of_the_interface_for_its_sensors() -> None:
    sensors = {name: effect.sensors for name, effect in catalogue().items()}
    expected = {
        **dict.fromkeys(BOTH, SENSORS),
        **dict.fromkeys(ACCELEROMETER, ("accelerometer",)),
        **dict.fromkeys(GYROSCOPE, ("gyroscope",)),
    }
    assert {name: sensors[name] for name in expected} == expected


def test_owners_are_those_of_the_interface() -> None:
    for name in (*BOTH, *ACCELEROMETER, *GYROSCOPE):
        owner = next((o for o, names in OWNERS.items() if name in names), Owner.SENSOR)
        assert catalogue()[name].owner == owner, name


def test_every_file_that_ships_is_an_effect_with_all_texts() -> None:
    assert set(built_in()) == {file.stem for file in CONFIGS.glob("*.yaml")}
    for effect in built_in().values():
        assert all([effect.meaning, effect.excitation, effect.experiment, effect.source]), effect.name
        assert (CONFIGS / f"{effect.name}.yaml").read_text(encoding="utf-8").startswith("# ")  # its equation
        assert effect.definition is None


def test_effects_of_time_or_temperature_are_recognised_by_their_formulas() -> None:
    single = [e for e in built_in().values() if not e.of_turns]
    for e in single:
        terms = yaml.safe_load((CONFIGS / f"{e.name}.yaml").read_text(encoding="utf-8")).get("terms")
        if terms:
            assert e.uses_time_or_temperature == bool(re.search(r"\b(time|temperature)\b", str(terms))), e.name
    assert built_in()["warm_up"].uses_time_or_temperature
    assert not built_in()["time_offset"].uses_time_or_temperature
    of_bias = {"bias_drift", "bias_temperature", "bias_temperature_quadratic", "warm_up"}
    for sensor in SENSORS:
        of_the_room = {e.name for e in single if sensor in e.sensors and e.of_the_room(sensor)}
        assert of_bias <= of_the_room
        assert not of_the_room & {"scale_factor_temperature", "quadratic_nonlinearity", "g_sensitivity", "time_offset"}


def test_an_experiment_without_a_table_is_proposed_where_there_is_none() -> None:
    sets = [Answer(["g_sensitivity"], 0.62), Answer([], 0.31)]
    at_table, by_hand = (to_distinguish(sets, "gyroscope", on_table=on_table) for on_table in (True, False))
    assert "rate table" in at_table
    assert by_hand == f"g sensitivity (0.62) from nothing (0.31): {built_in()['g_sensitivity'].experiment_by_hand}"
    assert built_in()["g_sensitivity"].experiment_by_hand


def test_the_rows_of_the_table_of_theory_are_those_of_the_files() -> None:
    text = (CONFIGS.parents[1] / "docs" / "theory.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| (\w+) \| .* \| (\w+) \|$", text, re.MULTILINE)
    both = {SENSORS: "both"}
    expected = [(e.name, both.get(e.sensors, e.sensors[0]), str(e.owner)) for e in built_in().values()]
    assert len(rows) > 20
    assert set(rows) <= set(expected), "docs/theory.md, Effects: effect, sensors, term, owner"


def test_one_file_adds_an_effect(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, motions: list[Motion]) -> None:
    shutil.copytree(CONFIGS, tmp_path / "effect")
    (tmp_path / "effect" / "rate_product.yaml").write_text(RATE_PRODUCT, encoding="utf-8")
    monkeypatch.setattr(effects, "EFFECTS_FOLDER", tmp_path / "effect")
    built_in_files.cache_clear()
    try:
        made = catalogue()["rate_product"]
        u = motions[0].angular_rate
        columns = made.columns("gyroscope", motions[0], K["gyroscope"], np.zeros(3))
        np.testing.assert_allclose(columns[:, 0, 0], u[:, 1] * u[:, 2], atol=1e-9)
        assert made.needs_motion
        assert parameter_limits(made, "gyroscope", {}).tolist() == [1e-5] * 3
        assert made.in_c(np.array([1.0, 2.0, 3.0]))[1] == "(imu_real)2.0 * (w[1] * w[2])"
    finally:
        built_in_files.cache_clear()


@pytest.mark.parametrize(("name", "sensor"), CASES)
def test_parameters_have_distinct_names_units_and_meanings(name: str, sensor: str) -> None:
    parameters = bound(name).parameters(sensor)
    assert len({p.name for p in parameters}) == len(parameters) > 0
    assert all(p.unit and p.meaning for p in parameters)


@pytest.mark.parametrize(("name", "sensor"), CASES)
def test_zero_parameters_change_nothing(name: str, sensor: str, motions: list[Motion]) -> None:
    effect = bound(name)
    zero = np.zeros(len(effect.parameters(sensor)))
    for motion in motions:
        assert np.array_equal(effect.reading(sensor, motion, K[sensor], zero), np.zeros((len(motion.time), 3)))
        assert effect.moved(motion, zero) is motion


@pytest.mark.parametrize(("name", "sensor"), CASES)
def test_columns_are_the_central_differences_of_the_reading(name: str, sensor: str, motions: list[Motion]) -> None:
    effect, values = bound(name), realistic(name, sensor)
    step = 1e-4 * np.where(values == 0, 1.0, np.abs(values))
    scale = 0.0
    for motion in motions:
        # at a bend of the rate the derivative jumps, and a difference across it is neither side's
        smooth = motion.reference_valid & np.roll(motion.reference_valid, 1) & np.roll(motion.reference_valid, -1)
        smooth &= np.abs(np.gradient(motion.angular_acceleration[:, motion.axis])) < 1e-6
        columns = effect.columns(sensor, motion, K[sensor], values)[smooth]
        scale = max(scale, np.abs(columns).max())
        for j, h in enumerate(step):
            e = h * np.eye(len(values))[j]
            later, sooner = (effect.reading(sensor, motion, K[sensor], values + s * e)[smooth] for s in (1, -1))
            difference = (later - sooner) / (2 * h)
            np.testing.assert_allclose(columns[:, :, j], difference, rtol=1e-5, atol=1e-6 * np.abs(columns).max())
    anywhere = effect.columns(sensor, random_motion(1), K[sensor], values)
    assert scale > 0 or np.any(anywhere) or sensor in effect.unseen
