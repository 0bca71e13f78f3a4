"""A fit by hand as a calibration, and the last stage of a fit: base and effects together, configured or selected."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import NotObservableError
from pipeline.estimation.least_squares import certified
from pipeline.estimation.multi_position import accelerometer, observed
from pipeline.estimation.multi_position.budget import budgeted_by_hand
from pipeline.estimation.multi_position.equations import noises_for
from pipeline.estimation.multi_position.fit import plausible, require_observable
from pipeline.estimation.multi_position.model import refusal
from pipeline.estimation.multi_position.selection import fit_configured, limits_of, select
from pipeline.model.effects import effect
from pipeline.records import FittedEffect, SensorCalibration, StageResult

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.estimation.multi_position.fit import HandFit
    from pipeline.estimation.multi_position.model import Model
    from pipeline.records import Noise, Recording

AUTO = "auto"


def model_of(
    recordings: Sequence[Recording],
    calibration: SensorCalibration,
    noise: Noise | None,
    settings: Mapping[str, Any],
    other: SensorCalibration | None = None,
) -> Model | None:
    """Return the model of a sensor by hand, or None where its recordings hold no rest.

    Parameters
    ----------
    recordings : sequence of Recording
    calibration : SensorCalibration
        Of the sensor's method.
    noise : Noise or None
    settings : mapping
        Sections ``table`` and ``procedure``.
    other : SensorCalibration, optional
        Of the accelerometer, where the sensor is the gyroscope; without it, it is calibrated here.
    """
    if calibration.sensor == "accelerometer":
        return accelerometer.model_of(recordings, calibration, noise, settings)
    return observed.model_of(recordings, calibration, noise, settings, other)


def fit_effects_by_hand(
    before: SensorCalibration, recordings: Sequence[Recording], noise: Noise | None, settings: Mapping[str, Any]
) -> SensorCalibration:
    """Fit the effects of ``settings["effects"]`` together with bias and matrix to rests and moves.

    Parameters
    ----------
    before : SensorCalibration
        Of the sensor's method.
    recordings : sequence of Recording
    noise : Noise or None
    settings : mapping
        Sections ``effects``, ``sensor``, ``table`` and ``procedure``.

    Returns
    -------
    SensorCalibration
        ``before`` unchanged where there is nothing to add.

    Raises
    ------
    NotObservableError
        If rests and moves do not determine an effect.
    ConfigurationError
        If an effect is unknown or not one of this sensor.
    """
    sensor = before.sensor
    wanted, sheet = settings["effects"][sensor], settings["sensor"][sensor]
    model = model_of(recordings, before, noise, settings)
    if model is None:
        return before
    names = select(model, before, [], noise, sheet).names if wanted == AUTO else list(wanted)
    if not names:
        return before
    for name in names:
        reason = refusal(effect(name), sensor, model.rests) if sensor in effect(name).sensors else ""
        if reason:
            raise NotObservableError(f"{name} cannot be fitted by hand: {reason}; take it out of effects.{sensor}")
    noises = noises_for(noise, model.kinds)
    limits = limits_of(sensor, sheet)
    found = fit_configured(model, before, names, noises)
    if plausible(model, found, limits):
        found = fit_configured(model, before, names, noises, limits)
    if len(found.residual) <= found.rank:
        raise NotObservableError(
            f"{len(model.rests.time)} rests of the {sensor} are too few for {', '.join(names)} beside bias and matrix: "
            f"record at least {found.rank + 10} rests in as many orientations"
        )
    require_observable(model, found, limits)
    return calibration_of(model, found, before, settings)


def calibration_of(
    model: Model, found: HandFit, before: SensorCalibration, settings: Mapping[str, Any]
) -> SensorCalibration:
    """Return a fit as a calibration with the stage ``effects``."""
    covariance = found.covariance
    count = covariance.shape[0] - model.directions.shape[1]
    place = np.zeros((12 + count, covariance.shape[0]))
    place[:12, : model.directions.shape[1]] = model.directions
    place[12:, model.directions.shape[1] :] = np.eye(count)
    covariance = place @ covariance @ place.T
    freedom = np.min(np.where(place != 0.0, found.degrees_of_freedom, np.inf), axis=1)
    uncertainty = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
    effects, parameters, at = [], {}, 12
    for term in found.state.terms:
        described: dict[str, dict[str, Any]] = {}
        for parameter, value in zip(term.effect.parameters(model.sensor), term.values, strict=True):
            shared = {"value": float(value), "unit": parameter.unit}
            described[parameter.name] = shared
            own = {**shared, "standard_uncertainty": float(uncertainty[at])}
            parameters[f"{term.effect.name}.{parameter.name}"] = own
            at += 1
        effects.append(FittedEffect(term.effect.name, described, term.effect.definition))
    details = {
        "samples": round(model.samples()),
        "rests": len(model.rests.time),
        "equations": len(found.residual),
        "rounds": found.rounds,
        "condition": found.condition if np.isfinite(found.condition) else None,
        "wander_ratio": float(found.noise.ratio),
        "wander_time_s": float(found.noise.time),
        "scatter_over_noise": list(found.noise.scatter),
    }
    rests = slice(0, model.rests_equations)
    rms = float(np.sqrt(np.mean((found.residual[rests] * found.error[rests]) ** 2)))
    calibration = replace(
        before,
        bias=found.state.bias,
        matrix=found.state.matrix,
        stages=(*before.stages, StageResult("effects", parameters, rms, None, details)),
        effects=tuple(effects),
        converged=found.converged,
        convergence=certified(found.cosine, found.condition, found.rank, len(found.covariance)),
    )
    return budgeted_by_hand(calibration, covariance, freedom, model, found, settings)
