"""Every effect on disk keeps the promises of an effect."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import yaml
from bench_session import CONTINUOUS, SIZE, K, Session, record, values_of

from pipeline.model.effects import built_in, catalogue
from pipeline.model.effects.base import Owner
from pipeline.model.kinematics import reference_motion
from pipeline.records import SENSORS, Motion

CONFIGS = Path(__file__).parents[2] / "configs" / "effect"
BOTH = [
    "bias_temperature",
    "bias_temperature_quadratic",
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
]
ACCELEROMETER = ["cross_axis_nonlinearity", "hysteresis", "inner_lever_arms", "rate_dependence", "lever_arm"]
GYROSCOPE = ["g_sensitivity", "g_squared_sensitivity", "earth_rotation"]
OWNERS = {
    Owner.RECORDING: {"bias_drift"},
    Owner.MOUNTING: {"lever_arm", "earth_rotation"},
    Owner.TABLE: {n for n in BOTH if n.startswith("table_")} | {"time_offset", "low_pass_lag", "clock_rate"},
}
CASES = [(name, sensor) for name, effect in catalogue().items() for sensor in effect.sensors]


@pytest.fixture(scope="module")
def motions() -> list[Motion]:
    return [reference_motion(r) for r in record(Session(3, CONTINUOUS)) if r.axis is not None]


def realistic(name: str, sensor: str) -> np.ndarray:
    if name in SIZE[sensor]:
        return values_of(sensor, name, np.random.default_rng(1))
    return np.full(len(catalogue()[name].parameters(sensor)), 0.01)


def test_catalogue_holds_every_effect_of_the_interface_for_its_sensors() -> None:
    sensors = {name: effect.sensors for name, effect in catalogue().items()}
    expected = {
        **dict.fromkeys(BOTH, SENSORS),
        **dict.fromkeys(ACCELEROMETER, ("accelerometer",)),
        **dict.fromkeys(GYROSCOPE, ("gyroscope",)),
    }
    assert {name: sensors[name] for name in expected} == expected


def test_owners_are_those_of_the_interface() -> None:
    for name, effect in catalogue().items():
        owner = next((o for o, names in OWNERS.items() if name in names), Owner.SENSOR)
        assert effect.owner == owner, name


def test_every_effect_has_a_configuration_file_and_every_file_an_effect() -> None:
    described = {file.stem: yaml.safe_load(file.read_text(encoding="utf-8")) for file in CONFIGS.glob("*.yaml")}
    assert {name for name, content in described.items() if "terms" not in content} == set(built_in())


@pytest.mark.parametrize("name", catalogue())
def test_configuration_file_agrees_with_the_code(name: str) -> None:
    effect, described = catalogue()[name], yaml.safe_load((CONFIGS / f"{name}.yaml").read_text(encoding="utf-8"))
    assert described["name"] == effect.name == name
    assert described["owner"] == effect.owner
    assert tuple(described["sensors"]) == effect.sensors
    for key in ("meaning", "excitation", "experiment", "source"):
        assert " ".join(described[key].split()) == getattr(effect, key), key
    for sensor in effect.sensors:
        assert described["parameters"][sensor] == {p.name: p.unit for p in effect.parameters(sensor)}


@pytest.mark.parametrize(("name", "sensor"), CASES)
def test_parameters_have_distinct_names_units_and_meanings(name: str, sensor: str) -> None:
    parameters = catalogue()[name].parameters(sensor)
    assert len({p.name for p in parameters}) == len(parameters) > 0
    assert all(p.unit and p.meaning for p in parameters)


@pytest.mark.parametrize("name", catalogue())
def test_docstring_of_the_module_states_an_equation(name: str) -> None:
    text = import_module(f"pipeline.model.effects.{name}").__doc__ or ""
    assert "=" in text
    assert "where" in text or "for turns about" in text


@pytest.mark.parametrize(("name", "sensor"), CASES)
def test_zero_parameters_change_nothing(name: str, sensor: str, motions: list[Motion]) -> None:
    effect = catalogue()[name]
    zero = np.zeros(len(effect.parameters(sensor)))
    for motion in motions:
        assert np.array_equal(effect.reading(sensor, motion, K[sensor], zero), np.zeros((len(motion.time), 3)))
        assert effect.moved(motion, zero) is motion


@pytest.mark.parametrize(("name", "sensor"), CASES)
def test_columns_are_the_central_differences_of_the_reading(name: str, sensor: str, motions: list[Motion]) -> None:
    effect, values = catalogue()[name], realistic(name, sensor)
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
    assert scale > 0 or sensor in effect.unseen
