"""Parameters of simulated sensors and effects: as described, otherwise drawn at random within the data sheet.

    matrix = R_m^T T diag(S),   T = [[1, 0, 0], [n_yx, 1, 0], [n_zx, n_zy, 1]]

where

S   : (3,) scale factors of the correction (body = matrix @ (reading - bias))
n   : non-orthogonality, rad
R_m : mounting, which takes body vectors to the sensor's axes: turns about x, then y, then z

Data-sheet limits are taken for three standard deviations; the mounting lies within 1 deg (Sudsanguan 2019, chapter 3).

A description may also hide an effect by a formula that is not in the catalogue:

    effects:
      gyroscope.gear_mesh: {terms: {A: {formula: "cos(5 * radians(angle))", unit: deg/s}}, values: [0.03, 0.03, 0.03]}

The keys are those of an effect's file (``pipeline.model.effects.declaration``), of which only ``terms`` is needed, and
``values``: of the parameters, one size, or nothing where there are ``limits``. It does not enter the catalogue: a
diagnosis meets it as something unknown.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import ConfigurationError
from pipeline.model.effects import effect
from pipeline.model.effects.base import parameter_limits
from pipeline.model.effects.files import effect_from
from pipeline.records import SENSORS
from pipeline.simulation.scene import ALTERATIONS
from pipeline.simulation.sensor import SimulatedSensor
from pipeline.simulation.trajectory import rotation_about

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from pipeline.model.effects.base import Effect

KEYS = {"bias", "matrix", "scale_factor", "non_orthogonality_deg", "mounting_deg"}
NOISE_KEYS = {"noise_density", "bias_wander", "wander_time_s"}  # in place of those of the data sheet
POSITIVE = {"time_constant", "tau"}
# A typical size as a share of the largest plausible one, where that is not a half.
TYPICAL_SHARE = {
    "inner_lever_arms": 0.05,
    "clock_rate": 0.02,
    "table_tilt": 0.2,
    "table_axis_nonorthogonality": 0.1,
    "table_encoder_error": 0.1,
    "table_rate_ripple": 0.1,
    "table_backlash": 0.1,
}


def drawn_sensors(
    sheets: Mapping[str, Mapping[str, Any]],
    given: Mapping[str, Mapping[str, Any]],
    effects: Mapping[str, dict[str, NDArray[np.float64]]],
    rng: np.random.Generator,
    kinds: dict[str, Effect],
) -> dict[str, SimulatedSensor]:
    """Return accelerometer and gyroscope of a unit.

    Each argument but ``rng`` and ``kinds`` (effects that are not in the catalogue, by name) is by sensor: its section
    of the configuration, what is described of it, and the values of its effects.
    """
    mounting = rng.uniform(-1.0, 1.0, 3)
    out = {}
    for sensor in SENSORS:
        unknown = sorted(set(given[sensor]) - KEYS - NOISE_KEYS)
        if unknown:
            known = ", ".join(sorted(KEYS | NOISE_KEYS))
            raise ConfigurationError(f"{sensor}: {', '.join(unknown)} is not known; known: {known}")
        sheet = {**sheets[sensor], **{key: given[sensor][key] for key in NOISE_KEYS & set(given[sensor])}}
        own = {name: values for name, values in effects[sensor].items() if name not in ALTERATIONS}
        drawn = _limited(sheet["bias"], 3, rng)
        bias = np.array(given[sensor].get("bias", drawn), float)
        matrix = _matrix(sheet, given[sensor], mounting, rng)
        out[sensor] = SimulatedSensor(sensor, sheet, bias, matrix, own, kinds)
    return out


def drawn_effects(
    specification: Mapping[str, Any],
    sheets: Mapping[str, Mapping[str, Any]],
    rng: np.random.Generator,
    kinds: dict[str, Effect],
) -> dict[str, dict[str, NDArray[np.float64]]]:
    """Return the values of the parameters of each effect, per sensor.

    ``specification``: ``effects`` of a description, as ``inline_effects`` returns it with ``kinds``.

    Raises
    ------
    ConfigurationError
        If there is no such effect, it does not apply, or the number of values is wrong.
    """
    out: dict[str, dict[str, NDArray[np.float64]]] = {sensor: {} for sensor in SENSORS}
    for key, value in specification.items():
        sensor, _, name = str(key).rpartition(".")
        kind = kinds.get(name) or effect(name)
        if sensor not in (*kind.sensors, ""):
            raise ConfigurationError(f"effect {key}: {name} applies to the {' and '.join(kind.sensors)}")
        for each in kind.sensors if sensor == "" else (sensor,):
            if name in ALTERATIONS and each != kind.sensors[0] and sensor == "":
                out[each][name] = out[kind.sensors[0]][name]  # one table, one clock: the same for both sensors
            else:
                out[each][name] = _values(kind, each, value, sheets[each]["effects"], rng)
    return out


def _matrix(
    sheet: Mapping[str, Any], given: Mapping[str, Any], mounting: NDArray[np.float64], rng: np.random.Generator
) -> NDArray[np.float64]:
    scale = 1.0 + _limited(sheet["scale_factor"], 3, rng)
    skew = np.degrees(_limited(sheet["cross_axis"], 3, rng))
    if "matrix" in given:
        return np.array(given["matrix"], float)
    if KEYS & set(given) - {"bias"}:
        scale, skew, mounting = np.ones(3), np.zeros(3), np.zeros(3)
    scale = np.array(given.get("scale_factor", scale), float)
    lower = np.eye(3)
    lower[[1, 2, 2], [0, 0, 1]] = np.radians(np.array(given.get("non_orthogonality_deg", skew), float))
    angles = np.array(given.get("mounting_deg", mounting), float)
    x, y, z = (rotation_about(axis, np.array([a]))[0] for axis, a in zip(np.eye(3), angles, strict=True))
    matrix: NDArray[np.float64] = (z @ y @ x).T @ lower @ np.diag(scale)
    return matrix


def _limited(limit: float, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return normal numbers with the limit at three standard deviations, cut there."""
    return np.clip(rng.standard_normal(count) * limit / 3.0, -limit, limit)


def _values(
    kind: Effect,
    sensor: str,
    value: Any,  # noqa: ANN401  (None, a number or a list, as YAML gives it)
    limits: Mapping[str, float],
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    name, parameters = kind.name, kind.parameters(sensor)
    positive = np.array([p.name in POSITIVE for p in parameters])
    sign = np.where(positive, 1.0, rng.choice([-1.0, 1.0], len(parameters)))
    typical = TYPICAL_SHARE.get(name, 0.5) * parameter_limits(kind, sensor, limits)
    drawn = sign * rng.uniform(0.7, 1.3, len(parameters)) * typical
    given = np.array([]) if value is None else np.atleast_1d(np.asarray(value, float))
    if len(given) == len(parameters):
        return given
    if len(given) == 1:
        return np.where(positive, typical, sign * given[0])
    if value is not None:
        names = ", ".join(p.name for p in parameters)
        raise ConfigurationError(
            f"{sensor}.{name} takes one size or {len(parameters)} values ({names}), not {len(given)}"
        )
    if not np.all(np.isfinite(drawn)):
        raise ConfigurationError(
            f"{sensor}.{name}: the sensor's configuration has no limit of this effect, so no typical size; give one"
        )
    return np.asarray(drawn)


def inline_effects(specification: Mapping[str, Any]) -> tuple[dict[str, Effect], dict[str, Any]]:
    """Return the effects that a unit's ``effects`` define by formulas, and the same with their values alone.

    Raises
    ------
    ConfigurationError
        If a definition is not as it should be.
    """
    found: dict[str, Effect] = {}
    values: dict[str, Any] = {}
    for key, given in specification.items():
        values[key] = given
        if isinstance(given, dict):
            sensor, _, name = str(key).rpartition(".")
            usual = {"owner": "table", "sensors": [sensor] if sensor else list(SENSORS), "meaning": "Hidden."}
            definition = {"name": name, **usual, **{k: v for k, v in given.items() if k != "values"}}
            found[name] = effect_from(definition, f"effects: {key}")
            values[key] = given.get("values")
    return found, values
