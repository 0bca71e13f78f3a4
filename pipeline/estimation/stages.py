"""Run the stages of a fit.

A stage is a module ``pipeline/estimation/<sensor>/<stage>.py`` with ``fit(recordings, previous, settings)``, or, if it
is the same for both sensors, ``pipeline/estimation/<stage>.py`` with ``fit(sensor, recordings, previous, settings)``.
The stages of the staged method are functions of one module for each sensor, whose ``fit`` takes their name first. Each
module declares its stages in ``FIT_STAGES``, by name (``FitStage``). A new stage needs only such a module and its name
in a method's list.

    recordings : all of a unit, with the noise of each sensor; a stage uses those of its roles
    previous   : the result of the stage before, whose stages the new result continues; None for the first
    settings   : sections of the configuration

A stage raises ``CannotCalibrateError`` if there is no recording for it, ``NotObservableError`` if the recordings do not
determine its parameters. ``check_stages`` refuses a method whose stages cannot follow each other before any job.

The stage ``given`` (``method=given``) is no fit: it takes bias, matrix and effects from an existing calibration file,
for validation and diagnosis with the recordings. The uncertainty is that of the file. If the file states none, the
covariance is zero, which the budget states; any held-out error beyond noise is then an error of the calibration.

``pipeline.core.records.calibration`` describes the correction of readings by the stages so far.

Subtract effects with known parameters from readings, and keep them in the calibration that is fitted to the others.

    reading - z(motion, K; p) = bias + K @ truth + noise

with the effects z and known parameters p that a stage of the method states (``FitStage.known``). ``truth`` is that of
the readings themselves by bias and matrix so far (``pipeline.physics.measurement``), so that no table is needed. An
effect of the same name that is fitted to the corrected readings is what the known parameters leave: the calibration has
the sum.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, partial
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np

from pipeline.core.errors import CannotCalibrateError, ConfigurationError
from pipeline.core.records import (
    BASE,
    BASE_NAMES,
    NORMAL,
    SENSORS,
    Contribution,
    CorrectionStep,
    Estimate,
    FittedEffect,
    MonteCarlo,
    NotIncluded,
    Recording,
    SensorCalibration,
    StageDetails,
    StageResult,
    UnitRecordings,
    Values,
    motion_at_rest,
    once_of_log,
)
from pipeline.estimation.uncertainty_budget import with_uncertainty
from pipeline.physics.effects.base import with_truth
from pipeline.physics.measurement import SensorEffects, compensate
from pipeline.physics.signal.filters import temperature_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from pipeline.core.records import UnitRecordings
    from pipeline.core.settings import DataSheet, Method, Settings
    from pipeline.estimation.engine import ResidualNoise


SOURCE = "known effects"  # of the uncertainty budget
GIVEN, GIVEN_SOURCE = "given", "given calibration"
NOT_WANTED = "not_wanted"  # stage of a sensor whose method is null
MOST_PASSES = 4  # each reduces the error of the known effects by their share of the reading, at most a hundredth
SETTLED = 1e-6  # change of bias, g or deg/s, and matrix in a pass: the known effects change by a hundredth of it
Change: TypeAlias = Literal["readings", "bias", "matrix", "effects"]


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
                raise CannotCalibrateError(
                    f"{recording.name} logs no temperature, which the known {_names(known)} of the {sensor} need: "
                    "record it, or choose a method without known effects"
                )
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


@dataclass(frozen=True, kw_only=True)
class FitStage:
    """The declaration of a stage; the stages of one module continue each other.

    A stage that changes the readings states effects with known parameters, from the sensor's section of the settings;
    ``fit_stage`` subtracts them from what all later stages read, and adds them to what these return.
    """

    sensors: tuple[str, ...] = SENSORS
    needs: tuple[Change, ...] = ()  # what an earlier stage must have changed
    changes: tuple[Change, ...] = ()  # what it estimates or corrects
    accepts: tuple[Change, ...] = ()  # changes by stages of other modules that it uses, keeps or estimates anew
    free: bool = False  # estimates each element of bias and matrix freely; else the verdict may blame the method
    reference: bool = False  # the fit with which the diagnosis compares the other methods on a table
    known: Callable[[str, DataSheet], list[FittedEffect]] | None = None  # of a stage that changes the readings


FIT_STAGES = {GIVEN: FitStage(changes=("bias", "matrix", "effects")), NOT_WANTED: FitStage()}


@cache
def stage_module(sensor: str, stage: str) -> str:
    """Return the module of a stage."""
    if stage in FIT_STAGES:
        return __name__
    own, of_both = f"pipeline.estimation.{sensor}.{stage}", f"pipeline.estimation.{stage}"
    return next((name for name in (own, of_both) if find_spec(name)), f"pipeline.estimation.{sensor}.staged")


def declared(sensor: str, stage: str) -> FitStage:
    """Return the declaration of a stage; raise ``ConfigurationError`` if there is no such stage of the sensor."""
    found = _declaration(sensor, stage)
    if found is None:
        raise ConfigurationError(
            f"no stage of the {sensor} is called {stage!r}: a stage is a module pipeline/estimation/{stage}.py, or for "
            f"one sensor pipeline/estimation/{sensor}/{stage}.py, with its declaration in FIT_STAGES"
        )
    return found


def _declaration(sensor: str, stage: str) -> FitStage | None:
    found: FitStage | None = getattr(import_module(stage_module(sensor, stage)), "FIT_STAGES", {}).get(stage)
    return found if found is not None and sensor in found.sensors else None


def declarations(calibration: SensorCalibration) -> dict[str, FitStage]:
    """Return the declarations of the stages of a calibration's method, by name, in order.

    A further result of a stage, such as ``faces``, has no declaration.
    """
    found = {stage.name: _declaration(calibration.sensor, stage.name) for stage in calibration.stages}
    return {name: stage for name, stage in found.items() if stage is not None}


def last_fit(calibration: SensorCalibration) -> FitStage:
    """Return the declaration of the last stage of a calibration's method, before the stage ``effects``."""
    fits = [stage for name, stage in declarations(calibration).items() if name != "effects"]
    return fits[-1] if fits else FitStage()


def check_stages(sensor: str, stages: Sequence[str]) -> None:
    """Raise ``ConfigurationError`` if a stage of a method lacks what it needs, or loses what an earlier one changed.

    ``stages``: of the sensor, in order.
    """
    for i, stage in enumerate(stages):
        found, module = declared(sensor, stage), stage_module(sensor, stage)
        if "readings" in found.changes and found.known is None:
            raise ConfigurationError(f"the stage {stage} changes the readings: declare in its FitStage what it knows")
        made = {change for before in stages[:i] for change in declared(sensor, before).changes}
        if lacking := [need for need in found.needs if need not in made]:
            raise ConfigurationError(
                f"the stage {stage} needs {_listed(lacking)} by an earlier stage: put a stage that estimates "
                f"{'it' if len(lacking) == 1 else 'them'} before {stage}"
            )
        for before in stages[:i]:
            lost = [change for change in declared(sensor, before).changes if change not in found.accepts]
            if lost and stage_module(sensor, before) != module:
                raise ConfigurationError(
                    f"the stage {stage} cannot follow {before}: it does not honour {_listed(lost)} of {before}; change "
                    "their order, or leave one of them out"
                )


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:-1]) + " and " * (len(names) > 1) + names[-1]


def fit_stage(
    sensor: str, stage: str, recordings: UnitRecordings, previous: SensorCalibration | None, settings: Settings
) -> SensorCalibration:
    """Run a stage on the result of the stage before.

    Raises ``CannotCalibrateError`` if the sensor's method is null, ``ConfigurationError`` as of ``check_stages``.
    """
    if stage == NOT_WANTED:
        raise CannotCalibrateError(f"method.{sensor} is null: the configuration leaves this sensor uncalibrated")
    if stage == GIVEN:
        return given_calibration(sensor, settings.method)
    check_stages(sensor, [*declarations(previous), stage] if previous else [stage])
    module = import_module(stage_module(sensor, stage))
    of_both = len(declared(sensor, stage).sensors) > 1 and f".{sensor}." not in module.__name__
    fit = partial(module.fit, *((stage,) if len(module.FIT_STAGES) > 1 else (sensor,) if of_both else ()))
    for other in SENSORS:
        if other != sensor and (of_other := known_effects(other, settings.method)):
            filtered = subtracted(recordings.filtered, SensorCalibration(other), of_other, ("rests",))
            recordings = replace(recordings, filtered=filtered)
    known = () if declared(sensor, stage).known else known_effects(sensor, settings.method)
    if known and previous is not None:
        return _fit_to_corrected(fit, recordings, previous, known, settings)
    calibration: SensorCalibration = fit(recordings, previous, settings)
    return calibration


def _fit_to_corrected(
    fit: Callable[..., SensorCalibration],
    recordings: UnitRecordings,
    previous: SensorCalibration,
    known: Sequence[FittedEffect],
    settings: Settings,
) -> SensorCalibration:
    """Return the fit to the readings less the known effects, which depend on bias and matrix, with these effects."""
    sensor, stages = previous.sensor, declarations(previous)
    held = [s for s in previous.stages if s.name in stages and stages[s.name].known]
    before = without_known(previous, known)
    before = replace(before, stages=tuple(s for s in previous.stages if s not in held))
    at, passes = before, 0
    while True:
        filtered = subtracted(recordings.filtered, at, known, (sensor, "rests"))
        found = fit(replace(recordings, filtered=filtered), before if before.stages else None, settings)
        if found is before:  # nothing to fit
            return previous
        passes += 1
        change = max(np.abs(found.bias - at.bias).max(), np.abs(found.matrix - at.matrix).max())
        if change <= SETTLED or passes == MOST_PASSES:
            return with_known(found, known, held)
        at = found


def is_given(sensor: str, method: Method) -> bool:
    """Return whether the calibration of a sensor is given, and not fitted."""
    return method.given is not None and sensor in method.given


def given_calibration(sensor: str, method: Method) -> SensorCalibration:
    """Return the given calibration of a sensor from the configuration (``method.given``).

    Effects of mounting, place, table and timing belong to the bench of that calibration: they are not used, and the
    stage lists them. Raises ``CannotCalibrateError`` if the file has no calibration of the sensor.
    """
    from pipeline.estimation.uncertainty_budget import base_parameters, combined  # noqa: PLC0415  (0.1 s of Snakemake)

    given = _given(method)
    part, source = given[sensor], given["source"]
    if part is None:
        raise CannotCalibrateError(f"the given calibration {source} holds nothing of the {sensor}")
    found = SensorCalibration.from_json(sensor, part)
    bench = part["of_the_bench"]
    every = found.parameters
    kept = every.select(every.places([name for name in every.names if name.partition(".")[0] not in bench]))
    parameters = base_parameters(sensor, found.bias, found.matrix, kept.covariance[BASE, BASE])
    details = StageDetails(source=source, sha256=given["sha256"], notes=given["notes"], left_out=bench)
    stage = StageResult(GIVEN, parameters, details=details)
    effects = tuple(e for e in found.effects if e.name not in bench)
    calibration = SensorCalibration(sensor, found.bias, found.matrix, effects=effects, stages=(stage,))
    if not part["uncertain"]:
        return combined(calibration, [], unknown_uncertainty(sensor, method))
    freedom = np.full(len(kept), np.inf) if found.freedom is None else kept.degrees_of_freedom
    line = Contribution(GIVEN_SOURCE, "B", NORMAL, kept.covariance, freedom, remark=f"as {source} states it")
    return combined(calibration, [line], {})


def unknown_uncertainty(sensor: str, method: Method) -> dict[str, str]:
    """Return the entry of a budget for a given calibration whose file states no uncertainty; empty if it does."""
    given = _given(method)
    if given[sensor] is None or given[sensor]["uncertain"]:
        return {}
    return {GIVEN_SOURCE: f"{given['source']} states no uncertainty: none is known, and zeros stand for it"}


def _given(method: Method) -> dict[str, Any]:
    """Return the document of a given calibration."""
    assert method.given is not None  # noqa: S101  (``is_given``)
    return method.given


def staged_result(  # noqa: PLR0917  (the results of a stage)
    name: str,
    steps: Sequence[CorrectionStep],
    parameters: Mapping[str, Estimate],
    error: Values,
    samples: tuple[int, int],
    noise: ResidualNoise,
    degrees_of_freedom: Values,
) -> StageResult:
    """Return the result of a stage; ``error``: of the magnitude of each sample; ``samples``: those used, and all."""
    details = StageDetails(
        samples_used=samples[0],
        samples_left_out=samples[1] - samples[0],
        white_noise=noise.white.tolist(),
        bias_wander=noise.wander.tolist(),
        degrees_of_freedom=float(degrees_of_freedom.min()),
    )
    return StageResult(name, parameters, float(np.sqrt(np.mean(error**2))), tuple(steps), details)
