"""Evaluate and invert the measurement equation of a sensor.

    reading = bias + K @ truth + sum of effects,             K = matrix^-1
    truth = matrix @ (reading - bias - sum of effects(truth))

The inverse is solved by fixed point, starting without the effects. Effects are small, so that each round gains about
two digits. A converged sample is not changed any more: its result does not depend on the other samples. Only effects of
the sensor are subtracted; effects of a mounting, a table or one recording do not occur in another log. The two sensors
are solved together: a gyroscope's g-sensitivity needs the specific force, an accelerometer's inner lever arms need the
angular rate.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np

from pipeline.core.errors import ConvergenceError
from pipeline.physics.effects import effect_of, owner_of
from pipeline.physics.effects.base import Effect, Owner, truth, with_truth

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from pipeline.core.records import FittedEffect, Mask, Motion, SensorCalibration, Values

    Truths = dict[str, Values]

MAX_INVERSION_ITERATIONS = 60  # two digits a round: far more than 1e-13 needs
INVERSION_TOLERANCE = 1e-13  # relative: some hundred roundings of a double
OUT_OF_REACH = 1e12  # g or deg/s: far beyond any reading, the fixed point diverges


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
        """Subtract the effects at a motion from readings: (n, 3) array, g or deg/s."""
        for effect, values in self.effects:
            reading = reading - effect.reading(self.calibration.sensor, motion, self.K, values)
        return reading


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
    calibration: SensorCalibration,
    reading: Values,
    motion: Motion,
    effects: Sequence[FittedEffect] | None = None,
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
    rest = reading - calibration.bias
    x, y, z = rest.T
    truth = np.empty_like(rest)
    for c, (along_x, along_y, along_z) in enumerate(calibration.matrix.tolist()):
        np.add(along_x * x + along_y * y, along_z * z, out=truth[:, c])
    return truth


def inverse_of(calibration: SensorCalibration) -> Values:
    """Return K, the inverse of the calibration matrix: (3, 3) array."""
    return np.asarray(np.linalg.solve(calibration.matrix, np.eye(3)), np.float64)


def _near(new: Values, old: Values) -> Mask:
    """Return which samples have converged, relative to their size; missing ones (NaN) count as such: (n,) array."""
    far = np.abs(new - old) > INVERSION_TOLERANCE * np.maximum(np.abs(new), 1.0)
    return np.logical_not(far[:, 0] | far[:, 1] | far[:, 2])
