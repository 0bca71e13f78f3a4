"""Subtract effects with known parameters from readings, and keep them in the calibration that is fitted to the others.

    reading - z(motion, K; p) = bias + K @ truth + noise

with the effects z and known parameters p that a stage of the method states (``FitStage.known``). ``truth`` is that of
the readings themselves by bias and matrix so far (``pipeline.physics.measurement``), so that no table is needed. An
effect of the same name that is fitted to the corrected readings is what the known parameters leave: the calibration has
the sum.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from pipeline.core.errors import CannotCalibrateError
from pipeline.core.records import (
    BASE_NAMES,
    FittedEffect,
    MonteCarlo,
    NotIncluded,
    Recording,
    SensorCalibration,
    StageResult,
    UnitRecordings,
    Values,
    motion_at_rest,
    once_of_log,
)
from pipeline.core.settings import Method
from pipeline.estimation.uncertainty_budget import with_uncertainty
from pipeline.physics.effects.base import with_truth
from pipeline.physics.measurement import SensorEffects, compensate
from pipeline.physics.signal.filters import temperature_of

SOURCE = "known effects"  # of the uncertainty budget


def known_effects(sensor: str, method: Method) -> tuple[FittedEffect, ...]:
    """Return the effects that the method of a sensor knows before the fit (``method.known``)."""
    entries = [] if method.known is None else method.known.get(sensor, [])
    return tuple(FittedEffect.from_json(entry) for entry in entries)


def subtracted(
    recordings: Sequence[Recording],
    calibration: SensorCalibration,
    known: Sequence[FittedEffect],
    needed: Sequence[str] = (),
) -> list[Recording]:
    """Return the recordings with the known effects subtracted from the readings of the calibration's sensor.

    ``calibration``: its bias and matrix are used. A recording without a temperature loses the readings of this sensor;
    raises ``CannotCalibrateError`` if its role is one of ``needed``.
    """
    sensor, part, found = calibration.sensor, SensorEffects.of(calibration, known), []
    for recording in recordings:
        reading = recording.reading(sensor)
        if reading is None:
            found.append(recording)
            continue
        if recording.temperature is None:
            if recording.role in needed:
                problem = f"{recording.name} logs no temperature, which the known {_names(known)} of the {sensor} need"
                raise CannotCalibrateError(f"{problem}: record it, or choose a method without known effects")
            found.append(recording.with_readings(**{sensor: None}))
            continue
        motion = replace(motion_at_rest(recording.time), temperature=temperature_of(recording))
        truth = compensate(calibration, reading, motion, known)
        corrected = part.take_off(reading, with_truth(motion, sensor, truth))
        found.append(recording.with_readings(**{sensor: _readings(recording, corrected.tobytes())}))
    return found


@once_of_log
def _readings(recording: Recording, values: bytes) -> Values:
    """Return corrected readings; equal ones are one object, so that what follows from them is computed once."""
    return np.frombuffer(values).reshape(recording.samples, 3)


def with_known(
    calibration: SensorCalibration, known: Sequence[FittedEffect], stages: Sequence[StageResult]
) -> SensorCalibration:
    """Return a calibration by corrected readings with the known effects, and the results of the stages that state them.

    The known parameters have no uncertainty, which the budget states.
    """
    values = {effect.name: effect.values for effect in known}
    fitted = [_moved(e, values[e.name]) if e.name in values else e for e in calibration.effects]
    more = [effect for effect in known if effect.name not in {e.name for e in fitted}]
    found = replace(calibration, effects=(*fitted, *more), stages=(*stages, *calibration.stages))
    if calibration.covariance is None or calibration.budget is None:
        return found
    size, added = len(calibration.covariance), [p for effect in more for p in effect.parameters.values()]
    covariance = np.pad(calibration.covariance, (0, len(added)))
    freedom = np.pad(calibration.parameters.degrees_of_freedom, (0, len(added)), constant_values=np.inf)
    budget = calibration.budget.at([*range(size), *[None] * len(added)])
    if isinstance(budget.monte_carlo, MonteCarlo):
        budget = replace(budget, monte_carlo=replace(budget.monte_carlo, estimate=found.parameters.values))
    reason = f"no uncertainty of the known {_names(known)} is stated: zeros stand for it"
    budget = replace(budget, not_included=(*budget.not_included, NotIncluded(SOURCE, reason)))
    return with_uncertainty(found, covariance, freedom, budget)


def _names(known: Sequence[FittedEffect]) -> str:
    return " and ".join(effect.name for effect in known)


def without_known(calibration: SensorCalibration, known: Sequence[FittedEffect]) -> SensorCalibration:
    """Return the calibration of readings from which the known effects are subtracted: undoes ``with_known``."""
    values, parameters = {effect.name: effect.values for effect in known}, calibration.parameters
    effects, names = [], list(BASE_NAMES)
    for effect in calibration.effects:
        own = parameters.select(parameters.of_effect(effect.name))
        left = _moved(effect, -values[effect.name]) if effect.name in values else effect
        if effect.name not in values or np.any(left.values) or np.any(own.standard_uncertainty):
            effects.append(left)
            names += own.names
    rows = parameters.places(names)
    freedom = None if calibration.freedom is None else calibration.freedom[rows]
    budget = calibration.budget and calibration.budget.at(rows.tolist())
    covariance = parameters.select(rows).covariance
    return replace(calibration, effects=tuple(effects), covariance=covariance, freedom=freedom, budget=budget)


def _moved(effect: FittedEffect, by: Values) -> FittedEffect:
    """Return an effect that is linear in its parameters with other values."""
    return effect.at((effect.values + by).tolist())


def without_known_effects(
    recordings: UnitRecordings, calibrations: Mapping[str, SensorCalibration | None], method: Method
) -> tuple[UnitRecordings, dict[str, SensorCalibration | None]]:
    """Return the recordings of a unit less the known effects of both sensors, and calibrations of these readings."""
    filtered, found = recordings.filtered, dict(calibrations)
    for sensor, calibration in calibrations.items():
        known = known_effects(sensor, method)
        if calibration is not None and known:
            filtered = subtracted(filtered, calibration, known)
            found[sensor] = without_known(calibration, known)
    return replace(recordings, filtered=filtered), found
