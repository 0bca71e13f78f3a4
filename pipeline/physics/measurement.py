"""Evaluate and invert the measurement equation of a sensor.

    reading = bias + K @ truth + sum of effects,             K = matrix^-1
    truth = matrix @ (reading - bias - sum of effects(truth))

The inverse is solved by fixed point, starting without the effects. Effects are small, so that each round gains about
two digits. A converged sample is not changed any more: its result does not depend on the other samples. Only effects of
the sensor are subtracted; effects of a mounting, a table or one recording do not occur in another log. The two sensors
are solved together: a gyroscope's g-sensitivity needs the specific force, an accelerometer's inner lever arms need the
angular rate.

Compute the motion and the smoothed temperature of a log from its own signals; no sample depends on later ones.

    domega/dt[n] = (omega[n] - omega[n-1]) / (t[n] - t[n-1]),    df/dt likewise; 0 at the first sample

A ``LogEnd`` carries the state from one block to the next, so that blocks of any size give the result of the whole log.

The temperature is smoothed by a line with exponentially decaying weights (exponential regression),

    T(t) = a,  (a, b) = argmin sum_i exp((t_i - t) / h) (T_i - a - b (t_i - t))^2,    t_i <= t

where h is the memory, s. A ramp passes without lag, and the noise of the thermometer is averaged. The rate of the
temperature is the slope b of another such line, through the smoothed temperature. Time is divided into
stretches of 4 h. The line follows from five sums, taken about the start ``o`` of the stretch of the sample:

    S_k = sum_i exp((t_i - o) / h) (t_i - o)^k,   k = 0, 1, 2;    R_k likewise with T_i - 25 degC,   k = 0, 1

The samples add their terms one by one; where a stretch begins, the sums are moved to its start.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Self

import numpy as np

from pipeline.core.errors import ConfigurationError, ConvergenceError, InputError
from pipeline.core.records import FittedEffect, Mask, Motion, SensorCalibration, Values, finite_rows
from pipeline.physics.effects import effect_of, owner_of
from pipeline.physics.effects.base import REFERENCE_TEMPERATURE, Effect, Owner, truth, turning_direction, with_truth

Known = tuple[float, Values]  # the last sample that is not missing: time in s, value
Truths = dict[str, Values]


MAX_INVERSION_ITERATIONS = 60  # two digits a round: far more than 1e-13 needs
INVERSION_TOLERANCE = 1e-13  # relative: some hundred roundings of a double
OUT_OF_REACH = 1e12  # g or deg/s: far beyond any reading, the fixed point diverges
SAMPLES_AT_ONCE = 20_000  # 480 kB an array of three axes
STRETCH = 4.0  # memories: exp(4) costs two digits of the sums; shorter stretches cost time
MAX_MEMORIES_BACK = 50.0  # memories that time may go back: exp(50) of the sums is still far from overflow
DEGENERATE = 1e-15  # determinant over its scale, below which doubles do not resolve a slope
FIELDS_OF_SIGNALS = {
    "time": {"time"},
    "temperature": {"temperature"},
    "temperature_rate": {"temperature", "time"},
    "specific_force": {"accelerometer"},
    "specific_force_rate": {"accelerometer", "time"},
    "angular_rate": {"gyroscope"},
    "angular_acceleration": {"gyroscope", "time"},
    "direction": {"gyroscope"},
}


@dataclass(frozen=True)
class SensorEffects:
    """The effects, with their values, to subtract from the readings of a sensor; K is the inverse of its matrix."""

    calibration: SensorCalibration
    effects: tuple[tuple[Effect, Values], ...]
    K: Values

    @classmethod
    def of(cls, calibration: SensorCalibration, effects: Iterable[FittedEffect]) -> Self:
        """Return the part that subtracts the given effects of a calibration."""
        return cls(calibration, tuple((effect_of(e), e.values) for e in effects), inverse_of(calibration))

    def take_off(self, reading: Values, motion: Motion) -> Values:
        """Subtract the effects at a motion from readings: (n, 3) array, g or deg/s; those of a long log in parts."""
        n, rest = len(reading), reading.copy()
        if n > SAMPLES_AT_ONCE:
            motion = motion.changed(direction=partial(turning_direction, motion))
        for at in (slice(first, first + SAMPLES_AT_ONCE) for first in range(0, n, SAMPLES_AT_ONCE)):
            here = motion if n <= SAMPLES_AT_ONCE else motion.part(at)
            for effect, values in self.effects:
                rest[at] -= effect.reading(self.calibration.sensor, here, self.K, values)
        return rest


def predicted_reading(calibration: SensorCalibration, motion: Motion) -> Values:
    """Return ``bias + K @ truth + sum of effects``: (n, 3) array, g or deg/s; motion by the reference's clock."""
    K = inverse_of(calibration)
    for fitted in calibration.effects:
        motion = effect_of(fitted).moved(motion, fitted.values)
    reading = calibration.bias + truth(calibration.sensor, motion) @ K.T
    for fitted in calibration.effects:
        if not effect_of(fitted).moves:
            reading = reading + effect_of(fitted).reading(calibration.sensor, motion, K, fitted.values)
    return reading


def compensate(
    calibration: SensorCalibration, reading: Values, motion: Motion, effects: Sequence[FittedEffect] | None = None
) -> Values:
    """Return the truth of (n, 3) readings of one sensor; the other fields of the motion are known.

    ``effects``: those to subtract, by default all effects of the sensor. Errors as of ``solve``.
    """
    sensor = calibration.sensor

    def motion_at(truths: Truths, _number: int) -> Motion:
        return with_truth(motion, sensor, truths[sensor])

    part = SensorEffects.of(calibration, sensor_effects(calibration) if effects is None else effects)
    return solve({sensor: part}, {sensor: reading}, motion_at)[sensor]


def sensor_effects(calibration: SensorCalibration) -> list[FittedEffect]:
    """Return the fitted effects that belong to the sensor itself."""
    return [fitted for fitted in calibration.effects if owner_of(fitted) == Owner.SENSOR]


def solve(parts: Mapping[str, SensorEffects], readings: Truths, motion_at: Callable[[Truths, int], Motion]) -> Truths:
    """Solve the measurement equation of one or both sensors.

    ``parts``: by sensor; the readings of a sensor without a part are its truth. ``readings`` and result: by sensor,
    (n, 3), g or deg/s. ``motion_at(truths, round)``: returns the motion for given truths; rounds count from 0. Raises
    ``ConvergenceError`` if a reading is so far out of range that the equation has no solution.
    """
    busy = {s: part for s, part in parts.items() if part.effects}
    truths = {s: linear_truth(parts[s].calibration, r) if s in parts else r for s, r in readings.items()}
    if not busy:
        return truths
    settled = np.zeros(len(next(iter(truths.values()))), bool)
    for number in range(MAX_INVERSION_ITERATIONS):
        moved = without_effects(busy, readings, motion_at(truths, number))
        if any(np.any(np.abs(moved[s]) > OUT_OF_REACH) for s in busy):
            break
        if settled.any():
            moved = {s: np.where(settled[:, None], truths[s], new) for s, new in moved.items()}
        settled |= np.logical_and.reduce([_near(moved[s], truths[s]) for s in busy])
        truths |= moved
        if settled.all():
            return truths
    sensor = max(truths, key=lambda s: float(np.max(np.nan_to_num(np.abs(truths[s]), posinf=1e300))))
    size = np.nan_to_num(np.abs(readings[sensor]).max(axis=1))
    row = int(np.argmax(size))
    raise ConvergenceError(
        f"the fitted effects of the {sensor} cannot be subtracted from a reading of {size[row]:g} (sample {row + 1} of "
        "the block): it is far outside the range that was calibrated; remove such readings from the log"
    )


def without_effects(parts: Mapping[str, SensorEffects], readings: Truths, motion: Motion) -> Truths:
    """Return ``matrix @ (reading - bias - effects(motion))`` for each sensor in ``parts``."""
    return {s: linear_truth(part.calibration, part.take_off(readings[s], motion)) for s, part in parts.items()}


def linear_truth(calibration: SensorCalibration, reading: Values) -> Values:
    """Return ``matrix @ (reading - bias)``: (n, 3) array.

    The three products of a row are added in a fixed order, so that no rounding depends on the number of samples.
    """
    truth, n = np.empty((len(reading), 3)), SAMPLES_AT_ONCE
    for at in (slice(first, first + n) for first in range(0, len(reading), n)):
        part = reading[at].T
        x, y, z = np.subtract(part, calibration.bias[:, None], out=np.empty(part.shape))  # contiguous: faster
        for c, (along_x, along_y, along_z) in enumerate(calibration.matrix.tolist()):
            np.add(along_x * x + along_y * y, along_z * z, out=truth[at, c])
    return truth


def inverse_of(calibration: SensorCalibration) -> Values:
    """Return K, the inverse of the calibration matrix: (3, 3) array."""
    return np.asarray(np.linalg.solve(calibration.matrix, np.eye(3)), np.float64)


def _near(new: Values, old: Values) -> Mask:
    """Return which samples have converged, relative to their size; missing ones (NaN) count as such: (n,) array."""
    far = np.abs(new - old) > INVERSION_TOLERANCE * np.maximum(np.abs(new), 1.0)
    return np.logical_not(far[:, 0] | far[:, 1] | far[:, 2])


@dataclass(frozen=True)
class LogEnd:
    """The state at the end of a block of a log: its last samples that are not missing, and its last turn."""

    force: Known | None = None
    rate: Known | None = None
    direction: Values = field(default_factory=lambda: np.zeros(3))

    def after(self, motion: Motion, used: set[str]) -> LogEnd:
        """Return the state at the end of the next block; only the ``used`` fields are stored."""
        force = _last_known(motion.time, motion.specific_force) if "specific_force_rate" in used else None
        rate = _last_known(motion.time, motion.angular_rate) if "angular_acceleration" in used else None
        direction = self.direction if motion.direction is None else motion.direction[-1]
        return LogEnd(force or self.force, rate or self.rate, direction)


def _last_known(time: Values, values: Values) -> Known | None:
    known = np.flatnonzero(finite_rows(values))
    return (float(time[known[-1]]), values[known[-1]]) if len(known) else None


def log_motion(
    time: Values,
    *,
    specific_force: Values,
    angular_rate: Values,
    temperature: Values | None,
    temperature_rate: Values | None,
    used: set[str],
    end: LogEnd,
) -> Motion:
    """Return the motion of a block; ``temperature`` is smoothed already, ``end`` is the end of the block before.

    Derivatives and direction are computed only where they are ``used``.
    """
    zeros = np.zeros_like(specific_force)
    rate = _difference(time, specific_force, end.force) if "specific_force_rate" in used else zeros
    turn = _difference(time, angular_rate, end.rate) if "angular_acceleration" in used else zeros
    motion = Motion(
        time=time,
        specific_force=specific_force,
        angular_rate=angular_rate,
        angular_acceleration=turn,
        specific_force_rate=rate,
        temperature=temperature,
        angle=None,
        rate=None,
        axis=None,
        still=np.zeros(len(time), bool),
        temperature_rate=temperature_rate,
    )
    if "direction" not in used:
        return motion
    direction = turning_direction(motion)
    turned = np.any(direction != 0.0, axis=1, keepdims=True)
    direction = np.where(turned, direction, end.direction)
    return replace(motion, direction=direction)


def fields_used(sensor: str, effects: Iterable[FittedEffect]) -> set[str]:
    """Return the fields of a motion that effects depend on; raise ``ConfigurationError`` for one that no log has."""
    seen: set[str] = set()
    for fitted in effects:
        looked_at = effect_of(fitted).fields(sensor, fitted.values)
        seen |= looked_at
        strange = sorted(looked_at - set(FIELDS_OF_SIGNALS))
        if strange:
            raise ConfigurationError(f"effect {fitted.name} needs {', '.join(strange)}, which no field log holds")
    return seen


def _difference(time: Values, values: Values, before: Known | None) -> Values:
    """Return the backward difference quotient: (n, 3) array; 0 at a first sample."""
    first = before is None
    t_before, v_before = (time[0], values[0]) if before is None else before
    t = np.concatenate([[t_before], time])
    v = np.concatenate([v_before[None], values])
    known = np.where(finite_rows(v), np.arange(len(v)), 0)
    last = np.maximum.accumulate(known)[:-1]  # a missing sample is stepped over
    step = t[1:] - t[last]
    back = np.flatnonzero(step[1 if first else 0 :] <= 0) + (1 if first else 0)
    if len(back):
        raise InputError(
            f"time does not increase at {time[back[0]]:.6f} s; an effect of this calibration needs rates of change: "
            "sort the log and drop repeated samples"
        )
    if first:
        step[0] = 1.0
    quotient: Values = (v[1:] - v[last]) / step[:, None]
    quotient[np.isnan(v[last]).any(axis=1)] = 0.0  # nothing is known before
    return quotient


class ExponentialRegression:
    """Exponential regression of a temperature log; ``memory`` in s."""

    def __init__(self, memory: float) -> None:
        self.memory = memory
        self._stretch = float("nan")
        self._sums = np.zeros(5)

    def apply(self, time: Values, temperature: Values, *, slope: bool = False) -> Values:
        """Return the line at each sample: (n,) array, degC; also where the temperature is missing (NaN).

        ``slope``: return the slope of the line, degC/s; 0 as long as one temperature is known.
        Raises ``InputError`` if time goes back by more than ``MAX_MEMORIES_BACK`` memories.
        """
        stretch = np.floor(time / (STRETCH * self.memory))
        cuts = np.flatnonzero(stretch[1:] != stretch[:-1]) + 1
        out = np.empty(len(time))
        for start, end in itertools.pairwise([0, *cuts.tolist(), len(time)]):
            self._move(float(stretch[start]), float(time[start]))
            out[start:end] = self._along(time[start:end], temperature[start:end], slope=slope)
        return out

    def _move(self, stretch: float, time: float) -> None:
        """Move the sums to the start of another stretch."""
        step = (stretch - self._stretch) * (STRETCH * self.memory)
        self._stretch = stretch
        if not abs(step) > 0.0 or not self._sums[0]:  # NaN: no stretch yet
            return
        if step < -MAX_MEMORIES_BACK * self.memory:
            raise InputError(f"time goes back by about {-step:.6g} s to {time:.6f} s; sort the log, or cut it there")
        s0, s1, s2, r0, r1 = self._sums
        moved = (s0, s1 - step * s0, s2 - 2.0 * step * s1 + step * step * s0, r0, r1 - step * r0)
        self._sums = np.exp(-step / self.memory) * np.array(moved)

    def _along(self, time: Values, temperature: Values, *, slope: bool) -> Values:
        """Return the line, or its slope, within a stretch; from one known sample, its temperature."""
        since = time - self._stretch * (STRETCH * self.memory)
        missing = np.isnan(temperature)
        excess = np.where(missing, 0.0, temperature - REFERENCE_TEMPERATURE)
        weight = np.where(missing, 0.0, np.exp(since / self.memory))
        weighted_time = weight * since
        terms = np.array([weight, weighted_time, weighted_time * since, weight * excess, weighted_time * excess])
        sums = np.add.accumulate(np.column_stack([self._sums, terms]), axis=1)[:, 1:]
        self._sums = sums[:, -1]
        s0, s1, s2, r0, r1 = sums
        first, second = s1 - since * s0, s2 - 2.0 * since * s1 + since * since * s0
        determinant = s0 * second - first * first
        sloping = determinant > DEGENERATE * s0 * s0 * self.memory * self.memory
        if slope:
            rate = np.where(s0 > 0, 0.0, np.nan)
            np.divide(s0 * (r1 - since * r0) - first * r0, determinant, out=rate, where=sloping)
            return rate
        value = np.divide(r0, s0, out=np.full(len(since), np.nan), where=s0 > 0)
        np.divide(second * r0 - first * (r1 - since * r0), determinant, out=value, where=sloping)
        return np.asarray(value + REFERENCE_TEMPERATURE, np.float64)
