"""The interface of a physical effect on the readings of a sensor.

    reading = bias + K @ truth + z(motion, K; p),    K = matrix^-1

where ``p`` are the parameters of the effect and ``z`` is 0 at ``p = 0``. An effect provides z and dz/dp for a motion
without noise.

Effects of timing change the motion instead: ``reading(t) = bias + K @ truth' + z(motion')``, where the primed motion
acts on the sensor at the sample's time stamp (``Effect.moved``).
"""

from __future__ import annotations

import abc
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from types import MappingProxyType
from typing import Any, TypedDict

import numpy as np

from pipeline.core.records import SENSOR_UNITS, SENSORS, Motion, Values
from pipeline.physics.signal.rests import RATE_AT_REST_DPS

REFERENCE_TEMPERATURE = 25.0  # degC, that of data sheets
STANDARD_GRAVITY = 9.80665  # m/s^2, ISO 80000-3
OF_THE_BIAS = ("bias_temperature", "bias_temperature_quadratic", "bias_temperature_cubic")  # effects
OF_THE_ROOM = {"time", "temperature", "temperature_rate"}  # fields of a motion that do not depend on the readings
MIN_PROGRAM_STEP_DEG = 5e-3  # above an encoder's resolution (1e-3 deg), below a step of a program (0.1 deg)
MIN_TURNING_DPS = 0.25  # above a gyroscope's noise and residual bias, below a slow turn of a table (1 deg/s)


class Quantity(TypedDict):
    """A value with its unit, in a document."""

    value: float
    unit: str


class Owner(StrEnum):
    """Where an effect originates; only effects of the sensor are compensated in field logs."""

    SENSOR = "sensor"
    RECORDING = "recording"
    MOUNTING = "mounting"
    TABLE = "table"


class Layout(StrEnum):
    """How regressors act on the three axes."""

    PER_AXIS = "per_axis"  # (n, 3, q): each axis has separate q regressors and q coefficients
    EVERY_AXIS = "every_axis"  # (n, q): the same q regressors for each axis, with separate coefficients
    SHARED = "shared"  # (n, 3, p): p coefficients that the axes share


@dataclass(frozen=True)
class EffectParameter:
    """One parameter of an effect: its name, unit and meaning."""

    name: str
    unit: str
    meaning: str


class Effect(abc.ABC):
    """A physical effect on the readings of a sensor."""

    name: str
    owner: Owner
    layout: Layout
    sensors: tuple[str, ...] = SENSORS  # to which it applies
    needs: tuple[str, ...] = ()  # fields that the motion must hold: temperature, angle, rate, level
    needs_clock: bool = False  # the time between the recordings must be known
    needs_motion: bool = False  # it adds nothing while the body rests
    needs_both_directions: bool = False  # turns in one direction show it as a part of bias and matrix
    needs_swing: bool = False  # without a temperature that rises and falls it looks like a drift
    of_samples: bool = False  # its regressors at a sample depend on the motion at that sample alone
    of_turns: bool = False  # it has separate parameters for each recording of a turn
    nonlinear: tuple[str, ...] = ()  # parameters in which the reading is not linear
    prior: str = ""  # setting of the table that adds it to the model: standard deviation of its parameters
    contains: tuple[str, ...] = ()  # effects of which this is a generalisation; the two are never fitted together
    scales_with: str = ""  # effect whose coefficient, times a time, is its own
    shown_by: str = ""  # kind of a sheet's recording, without which it is no candidate
    unseen: Mapping[str, str] = MappingProxyType({})  # sensor to the reason why the effect never changes its readings
    meaning: str  # one sentence for the reader of a report
    excitation: str  # advice: the motion or temperature that makes this effect observable
    experiment: str  # advice: the experiment that distinguishes it from effects with similar signals
    experiment_by_hand: str = ""  # the same without a table, where that is another experiment
    source: str  # of the equation
    typical_share: float = 0.5  # default size of a simulated effect, as a share of its limits
    proposed: bool = False  # where it is not observable, the first advice is to record what shows it
    definition: dict[str, Any] | None = None  # content of a user's file; stored in every calibration with the effect

    @abc.abstractmethod
    def parameters(self, sensor: str) -> tuple[EffectParameter, ...]:
        """Return the parameters for ``sensor``; units in g or deg/s and their products."""

    @abc.abstractmethod
    def regressors(self, sensor: str, motion: Motion, K: Values, values: Values) -> Values:
        """Return the derivatives of the reading in the shape of ``layout``; K is the inverse of the matrix."""

    def columns(self, sensor: str, motion: Motion, K: Values, values: Values) -> Values:
        """Return the derivative of the reading with respect to each parameter, at ``values``: (n, 3, p) array."""
        regressors = self.regressors(sensor, motion, K, values)
        if self.layout == Layout.SHARED:
            return regressors
        return per_axis(regressors) if self.layout == Layout.PER_AXIS else every_axis(regressors)

    def reading(self, sensor: str, motion: Motion, K: Values, values: Values) -> Values:
        """Return what the effect adds to the reading: (n, 3) array, g or deg/s.

        Linear effects return ``columns @ values``; the others override this with the exact value. The terms are added
        in a fixed order, sample by sample, so that no rounding depends on the number of samples.
        """
        regressors = self.regressors(sensor, motion, K, values)
        if self.layout == Layout.EVERY_AXIS:
            regressors = regressors[:, None, :]
        coefficients = values if self.layout == Layout.SHARED else values.reshape(3, -1)
        added = regressors[:, :, 0] * coefficients[..., 0]
        for j in range(1, regressors.shape[2]):
            added += regressors[:, :, j] * coefficients[..., j]
        return added

    def of_recordings(self, setups: Mapping[str, str]) -> Effect:
        """Return the effect with its parameters for these recordings (name to setup); most have one set for all."""
        return self

    def moved(self, motion: Motion, values: Values) -> Motion:
        """Return the motion that acts on the sensor at the time stamps; only effects of timing change it."""
        return motion

    def slope(self, sensor: str, moved: Motion, values: Values) -> Values | None:
        """Return du/dp of an effect of timing with one parameter p, from the motion that it moved; None for others."""
        return None

    @property
    def moves(self) -> bool:
        """Whether the effect moves the motion in time."""
        return type(self).moved is not Effect.moved

    @property
    def has_slope(self) -> bool:
        """Whether the effect states ``slope``."""
        return type(self).slope is not Effect.slope

    @property
    def uses_time_or_temperature(self) -> bool:
        """Whether its formula contains the time or the temperature; False for effects that move the motion in time."""
        return (self.needs_clock or "temperature" in self.needs) and not self.moves

    def of_the_room(self, sensor: str) -> bool:
        """Whether the effect depends on time and temperature only: it adds to the bias."""
        known: dict[str, bool] = vars(self).setdefault("_of_the_room", {})  # by sensor
        if self.uses_time_or_temperature and sensor not in known:
            known[sensor] = self.fields(sensor, self.starts(sensor)[0]) <= OF_THE_ROOM
        return self.uses_time_or_temperature and known[sensor]

    def starts(self, sensor: str) -> list[Values]:
        """Return the values from which a fit starts; several where the reading is not linear in the parameters."""
        return [np.zeros(len(self.parameters(sensor)))]

    def stepped(self, values: Values, step: Values) -> Values:
        """Return ``values + step``, limited to the change allowed in one round of a nonlinear fit."""
        return values + step

    def fields(self, sensor: str, values: Values) -> set[str]:
        """Return the fields of ``Motion`` that the reading depends on, by recording which are read."""
        seen: set[str] = set()
        self.reading(sensor, _watched(seen), np.eye(3), values)
        return seen | set(self.needs)

    def in_c(self, values: Values) -> list[str] | None:
        """Return a C expression for each axis, in the names of ``calibration.h``; None if there is none."""
        return None

    def limits(self, sensor: str) -> dict[str, float]:
        """Return the largest plausible sizes by the effect's file, with the keys of the sensor file."""
        return {}

    def available(self, motion: Motion) -> bool:
        """Return whether the motion has all fields that the effect needs."""
        return all(motion.has(need) for need in self.needs)


def _watched(seen: set[str]) -> Motion:
    """Return a motion of two samples that adds each field that is read to ``seen``."""
    names = {f.name for f in fields(Motion)}

    class Watched(Motion):
        def __getattribute__(self, name: str) -> Any:  # noqa: ANN401
            if name in names:
                seen.add(name)
            return super().__getattribute__(name)

    time, vector = np.arange(2.0), np.ones((2, 3))
    at_rest = (vector, vector, vector, vector, np.full(2, 25.0), time, time, 0, np.ones(2, bool))
    return Watched(time, *at_rest, direction=vector, level=np.tile(np.eye(3), (2, 1, 1)), temperature_rate=time)


def truth(sensor: str, motion: Motion) -> Values:
    """Return what an ideal sensor would read: (n, 3) array, specific force in g or angular rate in deg/s."""
    return motion.specific_force if sensor == "accelerometer" else motion.angular_rate


def with_truth(motion: Motion, sensor: str, values: Values) -> Motion:
    """Return a motion with other (n, 3) values of ``truth``."""
    if sensor == "accelerometer":
        return replace(motion, specific_force=values)
    return replace(motion, angular_rate=values)


def truth_rate(sensor: str, motion: Motion) -> Values:
    """Return the time derivative of ``truth``: (n, 3) array, g/s or deg/s^2."""
    return motion.specific_force_rate if sensor == "accelerometer" else motion.angular_acceleration


def length(vectors: Values) -> Values:
    """Return the length of each vector, with the squares added in the order x, y, z: (n,) array."""
    x, y, z = vectors[:, 0], vectors[:, 1], vectors[:, 2]
    return np.asarray(np.sqrt(x * x + y * y + z * z), np.float64)


def turning_direction(motion: Motion) -> Values:
    """Return the unit vector of the present turn or, at rest, of the last turn: (n, 3) array, body frame.

    A table turns where its rate exceeds that of a rest or its angle changes (a step may lie between two samples). Any
    other body turns where its rate exceeds 0.25 deg/s.
    """
    if motion.direction is not None:
        return motion.direction
    if motion.axis is not None and motion.rate is not None and motion.angle is not None:
        step = np.diff(motion.angle, prepend=motion.angle[0])
        stepped = np.where(np.abs(step) > MIN_PROGRAM_STEP_DEG, np.sign(step), 0)
        sign = np.where(np.abs(motion.rate) > RATE_AT_REST_DPS, np.sign(motion.rate), stepped)
        now = np.zeros_like(motion.angular_rate)
        now[:, motion.axis] = sign
        turning = sign != 0
    else:
        magnitude = length(motion.angular_rate)
        turning = magnitude > MIN_TURNING_DPS
        now = motion.angular_rate / np.where(turning, magnitude, 1.0)[:, None]
    last = np.maximum.accumulate(np.where(turning, np.arange(len(turning)), -1))
    return np.asarray(np.where(last[:, None] >= 0, now[last], 0.0))


def per_axis(regressors: Values) -> Values:
    """Spread (n, 3, q) regressors, q coefficients an axis, to (n, 3, 3 q) columns: all of x, then y, then z."""
    n, _, q = regressors.shape
    out = np.zeros((n, 3, 3, q))
    out[:, [0, 1, 2], [0, 1, 2], :] = regressors
    return out.reshape(n, 3, 3 * q)


def every_axis(regressors: Values) -> Values:
    """Spread (n, q) regressors, q coefficients an axis, to (n, 3, 3 q) columns; order as of ``per_axis``."""
    return per_axis(np.broadcast_to(regressors[:, None, :], (len(regressors), 3, regressors.shape[1])))


def axis_parameters(symbol: str, unit: str, meaning: str) -> tuple[EffectParameter, ...]:
    """Return one parameter an axis, ``<symbol>_x .. <symbol>_z``."""
    return tuple(EffectParameter(f"{symbol}_{a}", unit, f"{meaning}, {a} axis") for a in "xyz")


def unit_of(sensor: str) -> str:
    """Return the unit of a sensor's readings."""
    return SENSOR_UNITS[sensor]


def largest_by_unit(limits: Mapping[str, Quantity]) -> dict[str, float]:
    """Return the largest limit for each unit, from the limit of each parameter."""
    found: dict[str, float] = {}
    for limit in limits.values():
        found[limit["unit"]] = max(limit["value"], found.get(limit["unit"], 0.0))
    return found


def parameter_limits(effect: Effect, sensor: str, limits: Mapping[str, float]) -> Values:
    """Return the limit of each parameter's absolute value: (p,) array, infinite where there is none.

    ``limits`` are the ``effects`` of the sensor's configuration; where they do not name the effect, the limits of its
    file apply. A limit of ``<effect>_<parameter>`` or ``<effect>_<parameter without its axis>`` takes precedence over
    the limit of ``<effect>``. An effect in one session (``<effect>@<setup>``) has the limits of the effect.
    """
    found, base_name = [], effect.name.partition("@")[0]
    if base_name not in limits:
        limits = {**effect.limits(sensor), **limits}
    for parameter in effect.parameters(sensor):
        symbol = parameter.name.rpartition("_")[0]
        names = (f"{base_name}_{parameter.name}", f"{base_name}_{symbol}", base_name)
        found.append(next((float(limits[name]) for name in names if name in limits), np.inf))
    return np.array(found)
