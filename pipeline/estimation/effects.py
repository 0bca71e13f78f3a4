"""Fit bias, matrix and effects together: the last stage of a fit, for both sensors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.core.errors import CannotCalibrateError, NotObservableError
from pipeline.core.records import Noise, Recording, SensorCalibration, UnitRecordings
from pipeline.core.settings import Settings
from pipeline.estimation.accelerometer import nonlinear_least_squares
from pipeline.estimation.candidates import AUTO, MOUNTING, configured_effects, limits_of, offered
from pipeline.estimation.generalized_least_squares import fit_joint
from pipeline.estimation.harm import fits_of, harmful_in_turns, left_out, rests_in_turn
from pipeline.estimation.multi_position import accelerometer, gyroscope
from pipeline.estimation.multi_position.fit import plausible, require_observable
from pipeline.estimation.multi_position.model import Model, selection_hypotheses
from pipeline.estimation.multi_position.result import calibration_of
from pipeline.estimation.multi_position.selection import SelectionByHand, fit_configured, refusal
from pipeline.estimation.noise import with_noises
from pipeline.estimation.observability import hidden_in
from pipeline.estimation.observations import observe
from pipeline.estimation.posterior import completed
from pipeline.estimation.rest_means import ROLE, is_multi_position
from pipeline.estimation.selection import select
from pipeline.estimation.stages import Change, FitStage, StageInput, given_calibration, is_given
from pipeline.physics.effects import bench_priors, effect, stated_priors

ALL: tuple[Change, ...] = ("bias", "matrix", "effects")
FIT_STAGES = {"effects": FitStage(changes=ALL, accepts=("readings", *ALL), free=True, reference=True)}


def fit(task: StageInput) -> SensorCalibration:
    """Fit the effects of ``settings.effects`` with bias and matrix; return ``previous`` if there are none to add."""
    sensor, recordings, settings, noise = task.sensor, task.recordings, task.settings, task.noise
    before = task.previous or SensorCalibration(sensor)
    by_hand = is_multi_position(sensor, recordings.filtered)
    of_bench = not by_hand and stated_priors(settings.table)
    if not settings.effects.of(sensor) and not of_bench:
        return before
    if by_hand:
        return fit_effects_by_rests(before, recordings, settings)
    names = configured_effects(sensor, settings, recordings.filtered)
    accelerometer = mountings_by_gravity(recordings, settings) if sensor == "gyroscope" and MOUNTING in names else None
    if settings.effects.of(sensor) == AUTO:
        observations = observe(sensor, recordings.filtered, settings.table)
        if not observations.parts:
            return before
        data_sheet = settings.sensor.of(sensor)
        chosen = select(observations, names, noise, data_sheet, accelerometer=accelerometer)
        chosen = completed(chosen, lambda each: hidden_in(each, names))
        added = offered(chosen.names, chosen.fit.terms, chosen.fit.covariance, data_sheet, sensor)
        harm = harmful_in_turns(chosen, fits_of(chosen)) if added else {}
        names += [name for name in added if name not in harm]
    if not names:
        return before
    return fit_joint(sensor, recordings.filtered, names, noise, settings, before, accelerometer)


def mountings_by_gravity(recordings: UnitRecordings, settings: Settings) -> SensorCalibration | None:
    """Fit the accelerometer with the mountings of its turns; None if the recordings do not determine them.

    Effects that are missing in the list are selected and fitted, too: without them the mountings would be biased.
    Errors of the table's angle are fitted only if they are listed, because a wrongly selected one would bias the
    mountings.
    """
    listed = settings.effects.accelerometer
    within = (MOUNTING, *effect(MOUNTING).contains)
    wanted = [MOUNTING, *(name for name in ([] if listed == AUTO else listed) if name not in within)]
    both = settings.replaced(effects=settings.effects.replaced(accelerometer=wanted))
    names = configured_effects("accelerometer", both, recordings.filtered)
    observations = observe("accelerometer", recordings.filtered, settings.table)
    noise = recordings.noises["accelerometer"]
    try:
        selected = select(observations, names, noise, settings.sensor.accelerometer).names
        names += [name for name in selected if not of_the_angle(name)]
        return fit_joint("accelerometer", recordings.filtered, names, noise, settings)
    except NotObservableError:
        return None


def of_the_angle(name: str) -> bool:
    """Return whether an effect is an error of the table's angle or axes."""
    return effect(name).owner == "table" and name not in bench_priors()


def accelerometer_of(recordings: UnitRecordings, settings: Settings) -> SensorCalibration | None:
    """Return the given calibration of the accelerometer (``method.given``), else calibrate it.

    Raises ``CannotCalibrateError`` if that fails. None for a sheet of recordings without its readings.
    """
    known = any(r.role == ROLE and r.accelerometer is not None for r in recordings.filtered)
    if settings.procedure.sheet and not known and not is_given("accelerometer", settings.method):
        return None
    try:
        if is_given("accelerometer", settings.method):
            return given_calibration("accelerometer", settings.method)
        return nonlinear_least_squares.fit(StageInput("accelerometer", recordings, None, settings))
    except (NotObservableError, CannotCalibrateError) as lack:
        raise CannotCalibrateError(
            f"the gyroscope by hand needs the direction of gravity by a calibrated accelerometer: {lack.message}"
        ) from lack


def frame_error(accelerometer: SensorCalibration | None, settings: Settings) -> float:
    """Return the standard uncertainty of each angle between the accelerometer's frame and the case, deg.

    Of a sheet: its own axes are the frame, and off the case within the limit of the cross-axis sensitivity.
    """
    if accelerometer is None or settings.procedure.sheet is None or is_given("accelerometer", settings.method):
        return 0.0
    return float(np.degrees(settings.sensor.accelerometer.cross_axis / np.sqrt(3.0)))


def model_of(
    recordings: Sequence[Recording],
    calibration: SensorCalibration,
    noise: Noise | None,
    settings: Settings,
    other: SensorCalibration | None = None,
) -> Model | None:
    """Return the model of the sensor of a calibration, or None if its recordings have no rest.

    ``calibration``: of the sensor's method. ``other``: of the accelerometer, where the sensor is the gyroscope; by
    default ``accelerometer_of``.
    """
    if calibration.sensor == "accelerometer":
        return accelerometer.model_of(recordings, calibration, noise, settings)
    if other is None:
        other = accelerometer_of(with_noises(recordings, settings.sensor, ("accelerometer",)), settings)
    frame_deg = frame_error(other, settings)
    return gyroscope.model_of(recordings, calibration, noise, settings.procedure, other, frame_deg=frame_deg)


def fit_effects_by_rests(start: SensorCalibration, recordings: UnitRecordings, settings: Settings) -> SensorCalibration:
    """Fit the effects of ``settings.effects`` together with bias and matrix to rests and moves.

    ``start``: of the sensor's method; returned unchanged where there is no effect to add. Raises
    ``NotObservableError`` if rests and moves do not determine an effect; ``ConfigurationError`` if an effect is unknown
    or not of this sensor.
    """
    sensor = start.sensor
    wanted, data_sheet = settings.effects.of(sensor), settings.sensor.of(sensor)
    noise, other = recordings.noises[sensor], None
    if sensor == "gyroscope":
        other = accelerometer_of(recordings, settings)
    model = model_of(recordings.filtered, start, noise, settings, other)
    if model is None:
        return start
    names = [] if wanted == AUTO else list(wanted)
    if wanted == AUTO:
        chosen = SelectionByHand(model, start, [], noise, data_sheet)
        added = offered(chosen.names, chosen.fit.state.terms, chosen.fit.covariance, data_sheet, sensor)
        parts = [(model.without(rests), rests) for rests in rests_in_turn(model)] if added else []
        harm = left_out(chosen, parts).harmful(chosen.names) if parts else {}
        names = [name for name in added if name not in harm]
    if not names:
        return start
    for name in names:
        reason = refusal(effect(name), sensor, model.rests) if sensor in effect(name).sensors else ""
        if reason:
            raise NotObservableError(f"{name} cannot be fitted by hand: {reason}; take it out of effects.{sensor}")
    hypotheses = selection_hypotheses(noise, model.kinds)
    limits = limits_of(sensor, data_sheet)
    fitted = fit_configured(model, start, names, hypotheses)
    if plausible(fitted, limits):
        fitted = fit_configured(model, start, names, hypotheses, limits)
    if len(fitted.residual) <= fitted.rank:
        raise NotObservableError(
            f"{len(model.rests.time)} rests of the {sensor} are too few for {', '.join(names)} in addition to bias and "
            f"matrix: {fitted.more_rests}"
        )
    require_observable(model, fitted, limits)
    return calibration_of(model, fitted, start, settings, other)
