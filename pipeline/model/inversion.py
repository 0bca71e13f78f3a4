"""The measurement equation in the inverse direction: what a sensor felt, from what it read.

    truth = matrix @ (reading - bias - sum of effects(truth))

is solved by fixed point, starting without the effects; each round gains about two digits, as effects are small. Only
effects that belong to the sensor are taken off; those of a mounting, a table or one recording do not exist in another
log. The two sensors are solved together: a gyroscope's g-sensitivity asks for the specific force, an accelerometer's
inner lever arms for the angular rate.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import ConvergenceError
from pipeline.model.effects.base import Owner
from pipeline.model.user_effects import effect_of, owner_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.records import FittedEffect, Motion, SensorCalibration

    Truths = dict[str, NDArray[np.float64]]

ROUNDS = 60
TOLERANCE = 1e-13
OUT_OF_REACH = 1e12  # g or deg/s; the fixed point runs away


def compensate(
    calibration: SensorCalibration,
    reading: NDArray[np.float64],
    motion: Motion,
    effects: Sequence[FittedEffect] | None = None,
) -> NDArray[np.float64]:
    """Return the truth that a sensor's readings tell, beside a motion that is known otherwise.

    Parameters
    ----------
    calibration : SensorCalibration
    reading : (n, 3) array, g or deg/s
    motion : Motion
        Its truth of this very sensor is not looked at: that is solved for.
    effects : sequence of FittedEffect, optional
        Those to take off; by default all of the calibration that belong to the sensor.

    Returns
    -------
    (n, 3) array, same unit

    Raises
    ------
    ConvergenceError
        If a reading is so far out of range that the equation has no solution.
    """
    chosen = sensor_effects(calibration) if effects is None else effects

    def felt(truths: Truths) -> Motion:
        own = truths[calibration.sensor]
        if calibration.sensor == "accelerometer":
            return replace(motion, specific_force=own)
        return replace(motion, angular_rate=own)

    solved = solve({calibration.sensor: (calibration, chosen)}, {calibration.sensor: reading}, felt)
    return solved[calibration.sensor]


def sensor_effects(calibration: SensorCalibration) -> list[FittedEffect]:
    """Return the fitted effects that belong to the sensor itself."""
    return [fitted for fitted in calibration.effects if owner_of(fitted) == Owner.SENSOR]


def solve(
    parts: Mapping[str, tuple[SensorCalibration | None, Sequence[FittedEffect]]],
    readings: Truths,
    felt: Callable[[Truths], Motion],
) -> Truths:
    """Solve the measurement equation of one or both sensors.

    Parameters
    ----------
    parts : mapping
        Sensor to its calibration (None: its readings are taken for the truth) and the effects to take off.
    readings : dict
        Sensor to (n, 3) array, g or deg/s.
    felt : callable
        The motion that given truths make.

    Returns
    -------
    dict
        Sensor to (n, 3) array of its truth.

    Raises
    ------
    ConvergenceError
        If a reading is so far out of range that the equation has no solution.
    """
    truths = dict(readings)
    busy: dict[str, tuple[SensorCalibration, Sequence[FittedEffect], NDArray[np.float64]]] = {}
    for s, (calibration, effects) in parts.items():
        if calibration is not None:
            truths[s] = linear_truth(calibration, readings[s])
            if effects:
                busy[s] = (calibration, effects, inverse_of(calibration))
    for _ in range(ROUNDS if busy else 0):
        motion, moved = felt(truths), dict(truths)
        for s, (calibration, effects, K) in busy.items():
            rest = readings[s]
            for fitted in effects:
                rest = rest - effect_of(fitted).reading(s, motion, K, fitted.values)
            moved[s] = linear_truth(calibration, rest)
        change = max(_largest(moved[s] - truths[s], moved[s]) for s in busy)
        truths = moved
        if change <= TOLERANCE:
            return truths
        if change == float("inf"):
            break
    if busy:
        _complain(truths, readings)
    return truths


def linear_truth(calibration: SensorCalibration, reading: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``matrix @ (reading - bias)``: (n, 3) array."""
    truth: NDArray[np.float64] = (reading - calibration.bias) @ calibration.matrix.T
    return truth


def inverse_of(calibration: SensorCalibration) -> NDArray[np.float64]:
    """Return K, the inverse of the calibration matrix: (3, 3) array."""
    return np.asarray(np.linalg.solve(calibration.matrix, np.eye(3)), np.float64)


def _largest(change: NDArray[np.float64], value: NDArray[np.float64]) -> float:
    relative = np.abs(change) / np.maximum(np.abs(value), 1.0)
    known = np.logical_not(np.isnan(value))  # a missing sample stays missing
    runaway = np.max(np.abs(value), initial=0.0, where=known) > OUT_OF_REACH
    return float("inf") if runaway else float(np.max(relative, initial=0.0, where=known))


def _complain(truths: Truths, readings: Truths) -> None:
    """Name the reading for which the equation has no solution: the farthest out of range."""
    sensor = max(truths, key=lambda s: float(np.max(np.nan_to_num(np.abs(truths[s]), posinf=1e300))))
    size = np.nan_to_num(np.abs(readings[sensor]).max(axis=1))
    row = int(np.argmax(size))
    raise ConvergenceError(
        f"the fitted effects of the {sensor} cannot be taken off a reading of {size[row]:g} (sample {row + 1} of the "
        "block): it is far outside the range that was calibrated; remove such readings from the log"
    )
