"""Simulate a sensor: its true motion in a recording, its readings, and the random draw of its parameters.

    f = g up + [omega x (omega x r) + alpha x r] / 9.80665 + shaking,   omega_sensed = omega + level^T Omega_earth

at the true time of the sensor's clock, ``t' = t + tau + epsilon t``, where

up      : (3,) the true vertical in the body frame; it may be tilted against the level frame of the table
r       : (3,) position of the accelerometer from the turn axes, m, body frame
tau     : time offset, s: the reading at t shows the motion at t + tau
epsilon : relative error of the sensor's clock

A lag is a first-order low pass of the true motion, ``y(t) = integral_0^inf exp(-s) u(t - lag s) ds``. It is integrated
by Gauss' rule on short panels, because a rule for smooth functions would be inaccurate at the corners of ramps.

Effects of place, mounting, table and timing use exact geometry instead of the linear columns that the estimation uses.
Each of ``ALTERATIONS`` takes a scene and the parameters (in units of ``configs/effect``), and returns the scene
with that effect.

The sensor reads

    reading = clip(round(c (bias + K truth + effects + noise)) / c),   noise[n] = white w[n] + wander m[n]
    m[n+1] = r m[n] + sqrt(1 - r^2) w'[n],   r = exp(-(t[n+1] - t[n]) / T)
    K^-1 = matrix = R_m^T S_n diag(S),   S_n = [[1, 0, 0], [n_yx, 1, 0], [n_zx, n_zy, 1]]

where

c      : counts per g or deg/s
white  : noise density * sqrt(1 / (2 dt)): the band up to Nyquist, unit of the sensor
wander : standard deviation of the bias wander m, a Gauss-Markov process with correlation time T, which continues
         between the recordings of a session
S, n   : (3,) scale factors of the correction (body = matrix @ (reading - bias)), and non-orthogonality, rad
R_m    : mounting, which takes body vectors to the sensor's axes: turns about x, then y, then z

Parameters that a description does not state are drawn: limits of the sensor file are three standard deviations; the
mounting angles are within 1 deg (Sudsanguan 2019, chapter 3). A description may also hide an effect by a formula:

    effects:
      gyroscope.gear_mesh: {terms: {A: {formula: "cos(5 * radians(angle))", unit: deg/s}}, values: [0.03, 0.03, 0.03]}

The keys are the keys of an effect's file (``pipeline.physics.effects.formula_effect``), of which only ``terms`` is
required, and ``values``: the parameters' values, or one size; not needed where there are ``limits``. The effect is not
in the catalogue of a diagnosis.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy

from pipeline.core.errors import ConfigurationError
from pipeline.core.records import SENSORS, Motion, Values
from pipeline.core.settings import DataSheet, Sensor
from pipeline.physics.effects import effect, effect_from
from pipeline.physics.effects.base import STANDARD_GRAVITY, Effect, parameter_limits, truth
from pipeline.physics.signal.filters import rate_of_change
from pipeline.physics.signal.rests import still_samples
from pipeline.simulation.trajectory import CommandedTurns, Gimbals, RestsAndMoves, mounted, rotation_about, rotation_by

Alteration = Callable[["Scene", Values], "Scene"]
Hidden = dict[str, tuple[Effect, Values]]  # by name: an effect and the values of its parameters

# Edges of the panels in time constants: exp(-20) is 2e-9. The rule: nodes s and weights of the integral of
# ``exp(-s) u(s)``, two a panel; the weights sum to 1.
PANELS = np.concatenate([np.linspace(0.0, 2.0, 21), np.linspace(2.25, 6.0, 16), np.linspace(7.0, 20.0, 14)])

MIDDLE, HALF = (PANELS[1:] + PANELS[:-1]) / 2.0, np.diff(PANELS) / 2.0
NODES = np.concatenate([MIDDLE - HALF / np.sqrt(3.0), MIDDLE + HALF / np.sqrt(3.0)])
LAG_RULE = NODES, np.tile(HALF, 2) * np.exp(-NODES) / np.sum(np.tile(HALF, 2) * np.exp(-NODES))
SENSOR_KEYS = {"bias", "matrix", "scale_factor", "non_orthogonality_deg", "mounting_deg"}
NOISE_KEYS = {"noise_density", "bias_wander", "wander_time_s"}  # they replace figures of the sensor file
POSITIVE = {"time_constant", "tau"}  # parameters without a sign


@dataclass(frozen=True)
class Scene:
    """The motion of one sensor in one recording."""

    trajectory: CommandedTurns | RestsAndMoves | Gimbals
    start: float = 0.0  # s since power-on at which the trajectory begins
    axis: int | None = None  # of the turn
    gravity: float = 1.0  # g
    up: Values = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))  # the true vertical in the level frame
    earth: Values = field(default_factory=lambda: np.zeros(3))  # deg/s, Earth's rotation in the level frame
    lever_arm: Values = field(default_factory=lambda: np.zeros(3))  # r, m
    offset: float = 0.0  # tau, s
    clock: float = 0.0  # epsilon
    lag: float = 0.0  # time constant, s
    mounting: Values = field(default_factory=lambda: np.eye(3))  # columns: axes of the unit in the trajectory's body

    def motion(self, time: Values, temperature: Values | None = None) -> Motion:
        """Return the motion that the sensor reads at times of the log, (n,) array, s since power-on."""
        shown = time + self.offset + self.clock * time
        motion = self._without_lag(shown, temperature)
        if self.lag > 0.0:
            nodes, weights = LAG_RULE
            past = [self._without_lag(shown - self.lag * node, None) for node in nodes]
            names = ("specific_force", "angular_rate", "angular_acceleration", "specific_force_rate")
            weighted = [*zip(weights, past, strict=True)]
            motion = replace(motion, **{name: sum(w * getattr(p, name) for w, p in weighted) for name in names})
        return replace(motion, time=time, at_offset=lambda offset=0.0: self.motion(time + offset, temperature))

    def _without_lag(self, time: Values, temperature: Values | None) -> Motion:
        warming = None if temperature is None else rate_of_change(time, temperature)
        pose = mounted(self.trajectory.pose(time - self.start), self.mounting)
        gravity = self.gravity * (self.up @ pose.level)
        force = gravity
        if np.any(self.lever_arm):
            turning, r = np.radians(pose.omega), self.lever_arm
            acceleration = np.cross(turning, np.cross(turning, r)) + np.cross(np.radians(pose.alpha), r)
            force = force + acceleration / STANDARD_GRAVITY
        if pose.force is not None:
            force = force + pose.force
        omega = pose.omega + self.earth @ pose.level if np.any(self.earth) else pose.omega
        return Motion(
            time=time,
            specific_force=force,
            angular_rate=omega,
            angular_acceleration=pose.alpha,
            specific_force_rate=-np.cross(np.radians(pose.omega), gravity),
            temperature=temperature,
            temperature_rate=warming,
            angle=pose.angle,
            rate=pose.rate,
            axis=self.axis,
            still=still_samples(time, np.linalg.norm(pose.omega, axis=1)),
            level=pose.level,
            direction=pose.direction,
        )


def _added(field_name: str, factor: float = 1.0) -> Alteration:
    """Return an effect that adds its parameters, in units of ``factor``, to a field of the scene."""

    def altered(scene: Scene, values: Values) -> Scene:
        added = factor * (values if len(values) > 1 else values[0])
        return replace(scene, **{field_name: getattr(scene, field_name) + added})

    return altered


def _of_turn(field_name: str, shape: tuple[int, ...] = (3, 2)) -> Alteration:
    """Return an effect that adds its parameters, one row for each axis, to a field of the errors of a turn."""

    def altered(scene: Scene, values: Values) -> Scene:
        turn = scene.trajectory
        if scene.axis is None or not isinstance(turn, CommandedTurns):
            return scene
        values = np.radians(values) if field_name == "direction" else values
        added = getattr(turn.errors, field_name) + values.reshape(shape)[scene.axis]
        return replace(scene, trajectory=replace(turn, errors=replace(turn.errors, **{field_name: added})))

    return altered


ALTERATIONS: dict[str, Alteration] = {
    "lever_arm": _added("lever_arm"),
    "time_offset": _added("offset"),
    "clock_rate": _added("clock", 1e-6),
    "low_pass_lag": _added("lag"),
    "earth_rotation": lambda scene, values: replace(scene, earth=scene.earth + np.pad(values, (0, 3 - len(values)))),
    # about level x and y, deg
    "table_tilt": lambda scene, values: replace(scene, up=scene.up @ rotation_by(np.append(values, 0.0))),
    "table_axis_nonorthogonality": _of_turn("direction"),
    "table_encoder_error": _of_turn("encoder"),
    "table_rate_ripple": _of_turn("ripple"),
    "table_backlash": _of_turn("backlash", (3,)),
}


def alter(scene: Scene, effects: Mapping[str, Values]) -> Scene:
    """Apply to a scene the effects that change the motion (``ALTERATIONS``)."""
    for name in [name for name in effects if name in ALTERATIONS]:
        scene = ALTERATIONS[name](scene, effects[name])
    return scene


@dataclass(frozen=True)
class SimulatedSensor:
    """One accelerometer or gyroscope with known errors."""

    sensor: str
    data_sheet: DataSheet  # full scale, counts, noise
    bias: Values  # (3,), g or deg/s
    matrix: Values  # (3, 3), of a perfect calibration: body = matrix @ (reading - bias - effects)
    effects: Hidden = field(default_factory=dict)  # effects on the reading

    def exact(self, motion: Motion) -> Values:
        """Return the reading without noise and quantisation: (n, 3) array."""
        K = np.asarray(np.linalg.solve(self.matrix, np.eye(3)), np.float64)
        reading: Values = self.bias + truth(self.sensor, motion) @ K.T
        for kind, values in self.effects.values():
            reading = reading + kind.reading(self.sensor, motion, K, values)
        return reading

    def quantised(self, reading: Values) -> Values:
        """Round the reading to whole counts and clip it at full scale: (n, 3) array, g or deg/s."""
        counts = np.round(reading * self.data_sheet.counts_per_unit)
        top = self.data_sheet.full_scale * self.data_sheet.counts_per_unit
        return np.asarray(np.clip(counts, -top, top - 1.0) / self.data_sheet.counts_per_unit)


def decimals_of(data_sheet: DataSheet) -> int:
    """Return the number of decimals that prints a reading to a tenth of a count."""
    return int(np.ceil(np.log10(data_sheet.counts_per_unit))) + 1


def bias_wander(sessions: list[Values], correlation_time: float, rng: np.random.Generator) -> list[Values]:
    """Draw a stationary Gauss-Markov process of unit variance for three axes: (n, 3) array for each recording.

    ``sessions``: (n,) sample times of successive recordings, s, each evenly sampled.
    """
    out, last, before = [], rng.standard_normal(3), sessions[0][0]
    for time in sessions:
        step = (time[-1] - time[0]) / (len(time) - 1) if len(time) > 1 else 0.0
        r = np.exp(-step / correlation_time)
        across = np.exp(-(time[0] - before) / correlation_time)
        drive = np.sqrt(1.0 - r * r) * rng.standard_normal((len(time), 3))
        drive[0] = across * last + np.sqrt(1.0 - across * across) * rng.standard_normal(3)
        process = scipy.signal.lfilter([1.0], [1.0, -r], drive, axis=0)
        out.append(process)
        last, before = process[-1], time[-1]
    return out


def drawn_sensors(
    sensor_model: Sensor,
    given: Mapping[str, Mapping[str, Any]],
    effects: Mapping[str, Hidden],
    rng: np.random.Generator,
) -> dict[str, SimulatedSensor]:
    """Return both sensors of a unit by configuration and description; ``ConfigurationError``: an unknown key."""
    mounting = rng.uniform(-1.0, 1.0, 3)
    out = {}
    for sensor in SENSORS:
        unknown = sorted(set(given[sensor]) - SENSOR_KEYS - NOISE_KEYS)
        if unknown:
            known = ", ".join(sorted(SENSOR_KEYS | NOISE_KEYS))
            raise ConfigurationError(f"{sensor}: {', '.join(unknown)} is not known; known: {known}")
        noise = {key: given[sensor][key] for key in NOISE_KEYS & set(given[sensor])}
        sheet = sensor_model.of(sensor).replaced(**noise)
        of_sensor = {name: hidden for name, hidden in effects[sensor].items() if name not in ALTERATIONS}
        bias = np.array(given[sensor].get("bias", _limited(sheet.bias, rng)), float)
        out[sensor] = SimulatedSensor(sensor, sheet, bias, _matrix(sheet, given[sensor], mounting, rng), of_sensor)
    return out


def _matrix(data_sheet: DataSheet, given: Mapping[str, Any], mounting: Values, rng: np.random.Generator) -> Values:
    scale = 1.0 + _limited(data_sheet.scale_factor, rng)
    skew = np.degrees(_limited(data_sheet.cross_axis, rng))
    if "matrix" in given:
        return np.array(given["matrix"], float)
    if SENSOR_KEYS & set(given) - {"bias"}:
        scale, skew, mounting = np.ones(3), np.zeros(3), np.zeros(3)
    scale = np.array(given.get("scale_factor", scale), float)
    lower = np.eye(3)
    lower[[1, 2, 2], [0, 0, 1]] = np.radians(np.array(given.get("non_orthogonality_deg", skew), float))
    angles = np.array(given.get("mounting_deg", mounting), float)
    x, y, z = (rotation_about(axis, np.array([a]))[0] for axis, a in zip(np.eye(3), angles, strict=True))
    return np.asarray((z @ y @ x).T @ lower @ np.diag(scale))


def _limited(limit: float, rng: np.random.Generator) -> Values:
    """Draw three normal numbers with the limit at three standard deviations, clipped at the limit."""
    return np.clip(rng.standard_normal(3) * limit / 3.0, -limit, limit)


def drawn_effects(stated: Mapping[str, Any], sensor_model: Sensor, rng: np.random.Generator) -> dict[str, Hidden]:
    """Return the effects that a description's ``effects`` hide in each sensor.

    Raises ``ConfigurationError`` if an effect does not exist or apply, or its formula or number of values is wrong.
    """
    out: dict[str, Hidden] = {sensor: {} for sensor in SENSORS}
    for key, value in stated.items():
        sensor, _, name = str(key).rpartition(".")
        if isinstance(value, dict):
            usual = {"owner": "table", "sensors": [sensor] if sensor else list(SENSORS), "meaning": "Hidden."}
            definition = {"name": name, **usual, **{k: v for k, v in value.items() if k != "values"}}
            kind, size = effect_from(definition, f"effects: {key}"), value.get("values")
        else:
            kind, size = effect(name), value
        if sensor not in (*kind.sensors, ""):
            raise ConfigurationError(f"effect {key}: {name} applies to the {' and '.join(kind.sensors)}")
        if kind.of_turns:
            raise ConfigurationError(
                f"effect {key}: {name} has parameters for each recording; give imperfections mounting_deg or zero_deg"
            )
        for each in kind.sensors if sensor == "" else (sensor,):
            if name in ALTERATIONS and each != kind.sensors[0] and sensor == "":
                out[each][name] = out[kind.sensors[0]][name]  # one table, one clock: the same for both sensors
            else:
                out[each][name] = kind, _values(kind, each, size, sensor_model.of(each).effects, rng)
    return out


def _values(
    kind: Effect,
    sensor: str,
    value: Any,  # noqa: ANN401  (None, a number or a list, as YAML gives it)
    limits: Mapping[str, float],
    rng: np.random.Generator,
) -> Values:
    name, parameters = kind.name, kind.parameters(sensor)
    positive = np.array([p.name in POSITIVE for p in parameters])
    sign = np.where(positive, 1.0, rng.choice([-1.0, 1.0], len(parameters)))
    typical = kind.typical_share * parameter_limits(kind, sensor, limits)
    drawn = sign * rng.uniform(0.7, 1.3, len(parameters)) * typical
    given = np.ravel([] if value is None else value)
    if given.dtype.kind not in "iuf":
        raise ConfigurationError(f"{sensor}.{name}: a size, or the list of the parameters' values, is expected")
    if len(given) == len(parameters):
        return given.astype(float)
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
