"""Convert a fit to rests and moves to a calibration with its uncertainty budget.

The Monte Carlo run of the budget is to second order of the model. The errors of the equations are drawn under every
hypothesis of the noise by its weight, and solved with the weights of that hypothesis, because the fit averages over the
hypotheses. The prior of the parameters is added as equations ``sqrt(P) p = 0 +- 1``.

If the procedure states faces, bias and full matrix of the accelerometer are fitted after the nine parameters of
gravity's length, with the equations of ``accelerometer`` and ``faces_and_turns``. The matrix then refers to the case.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import scipy

from pipeline.core.records import (
    LIMIT,
    NORMAL,
    Contribution,
    Convergence,
    NoiseParts,
    Recording,
    SensorCalibration,
    StageDetails,
    StageResult,
    UnitRecordings,
    Values,
    base_values,
)
from pipeline.core.settings import Procedure, Settings
from pipeline.estimation.engine import draw_normal, quadratic_results, scaled_inverse, with_trials
from pipeline.estimation.multi_position import accelerometer, gyroscope
from pipeline.estimation.multi_position.faces_and_turns import DEPARTS, FACES, faces_of
from pipeline.estimation.multi_position.fit import FitByHand, fit
from pipeline.estimation.multi_position.model import Model, State, prior_hypotheses, stepped
from pipeline.estimation.noise import wander_prior
from pipeline.estimation.rest_means import rests_of
from pipeline.estimation.stages import unknown_uncertainty
from pipeline.estimation.uncertainty_budget import (
    TEMPERATURE,
    base_parameters,
    changes_by_hand,
    changes_through_gravity,
    clock_line,
    combined,
    effect_parameters,
    gain_of,
    gravity_line,
    scatter_contribution,
)

STEP_UNCERTAINTIES = 0.1  # of a standard uncertainty: the columns are differentiated where they are used
REMARK = {
    "accelerometer": "white noise, bias wander and further scatter of the rests, estimated from the residuals",
    "gyroscope": "white noise, bias wander, scatter of rests and moves, and the accelerometer's own calibration",
}
NOT_INCLUDED = {
    "table angle, rate and orthogonality, levelling": "there is no table",
    "quantisation": "contained in the noise of the readings, as the rests scatter",
    "temperature": TEMPERATURE,
}
NAME = "faces"


def calibration_of(
    model: Model,
    fitted: FitByHand,
    before: SensorCalibration,
    settings: Settings,
    other: SensorCalibration | None = None,
) -> SensorCalibration:
    """Convert a fit to a calibration with the stage ``effects``; ``other``: as of ``after_stage``."""
    details = StageDetails(
        samples=round(model.samples()),
        rests=len(model.rests.time),
        equations=len(fitted.residual),
        rounds=fitted.rounds,
        condition=fitted.condition,
        wander_ratio=float(fitted.noise.bias.ratio),
        wander_time_s=float(fitted.noise.bias.time),
        scatter_over_noise=fitted.noise.scatter,
    )
    return after_stage(before, StageResult("effects", details=details), model, fitted, settings, other=other)


def with_stage(before: SensorCalibration, stage: StageResult, model: Model, fitted: FitByHand) -> SensorCalibration:
    """Return a calibration after an additional stage, without its uncertainty; it adds the residual to the stage."""
    at_rest = slice(0, model.rests_equations)
    rms = float(np.sqrt(np.mean((fitted.residual[at_rest] * fitted.error[at_rest]) ** 2)))
    rank = fitted.rank - len(model.known_by_limit)
    convergence = Convergence(fitted.cosine, fitted.condition, rank, len(fitted.covariance), fitted.cosine_at_minimum)
    found = replace(before, bias=fitted.state.bias, matrix=fitted.state.matrix, converged=fitted.converged)
    return replace(found, stages=(*before.stages, replace(stage, residual_rms=rms)), convergence=convergence)


def after_stage(
    before: SensorCalibration,
    stage: StageResult,
    model: Model,
    fitted: FitByHand,
    settings: Settings,
    *,
    white: Values | None = None,
    not_included: Mapping[str, str] = NOT_INCLUDED,
    other: SensorCalibration | None = None,
) -> SensorCalibration:
    """Convert a fit to a calibration after an additional stage, with its uncertainty budget by the residuals.

    ``stage``: without parameters, they are bias, matrix and those of the effects. ``white``: (12,), variance by white
    noise, where the budget states it separately. ``other``: for the gyroscope, the calibration of the accelerometer.
    """
    sensor, table, place = model.sensor, settings.table, _places(model, fitted)
    covariance = place @ fitted.covariance @ place.T
    freedom = np.min(np.where(place != 0.0, fitted.degrees_of_freedom, np.inf), axis=1)
    effects, of_effects = effect_parameters(sensor, fitted.state.terms, covariance)
    parameters = stage.parameters or of_effects
    parameters = parameters or base_parameters(sensor, fitted.state.bias, fitted.state.matrix, covariance)
    calibration = with_stage(before, replace(stage, parameters=parameters), model, fitted)
    at_limits = _at_limits(model, fitted, place, other, settings)
    calibration = replace(calibration, effects=effects, at_limits=at_limits)
    limit, of_limit = limits_contribution(model, fitted)
    variance, parts = np.clip(np.diag(covariance - of_limit), 0.0, None), NoiseParts()
    if white is not None:
        white = np.minimum(white, variance)
        parts = NoiseParts(np.sqrt(white), wander_and_scatter=np.sqrt(variance - white))
    scatter = scatter_contribution(covariance - of_limit, np.inf, parts, REMARK[sensor])
    lines, missing = [replace(scatter, degrees_of_freedom=freedom)], dict(not_included)
    stated, unstated = (gravity_line if sensor == "accelerometer" else clock_line)(calibration, table)
    lines, missing = lines + stated, missing | unstated
    if sensor == "gyroscope":
        missing |= unknown_uncertainty("accelerometer", settings.method)
        missing["Earth's rotation"] = "not in the model: by hand the heading is unknown; up to 0.0042 deg/s of bias"
    complete, trials = combined(calibration, [*lines, *limit], missing), settings.uncertainty.monte_carlo
    return _with_monte_carlo(complete, model, fitted, trials, lines[1:]) if trials else complete


def _at_limits(
    model: Model, fitted: FitByHand, place: Values, other: SensorCalibration | None, settings: Settings
) -> dict[str, Values]:
    """Return the change of bias and matrix by each effect at its limits; ``other``: of the accelerometer."""
    gain, modelled = gain_of(fitted, place), [term.effect.name for term in fitted.state.terms]
    found = changes_by_hand(model, fitted, gain, modelled, settings.sensor.of(model.sensor))
    if isinstance(model, gyroscope.GyroscopeModel) and other is not None:
        found |= changes_through_gravity(model, fitted, gain, other, settings.sensor.accelerometer)
    return found


def _places(model: Model, fitted: FitByHand) -> Values:
    """Return the map from base and effect parameters to bias, matrix and effect parameters: (12 + p, b + p) array."""
    base = model.directions
    return np.asarray(scipy.linalg.block_diag(base, np.eye(len(fitted.covariance) - base.shape[1])))


def limits_contribution(model: Model, fitted: FitByHand) -> tuple[list[Contribution], Values]:
    """Return the line of the misalignments known by the sensor file's limit, if any, and its first-order covariance.

    A limit is so wide that the square of a misalignment is significant, for example in six positions, where the
    readings depend on it only to second order. With the curvature H_i of equation i and the covariance C of a fit,
    ``d^T H_i d / 2`` of a normal error d has the mean ``tr(H_i C) / 2`` and the covariances ``tr(H_i C H_j C) / 2``
    (JCGM 100, 5.1.2, note).
    """
    place = _places(model, fitted)
    if not model.known_by_limit:
        return [], np.zeros((len(place), len(place)))
    equations = fitted.equations
    X = equations.columns
    scale = max(fitted.hypotheses, key=lambda hypothesis: hypothesis[1])[2]
    inverse = np.linalg.inv(equations.scaled(fitted.noise, scale))
    gain = scaled_inverse(X.T @ inverse @ X) @ X.T @ inverse
    of_limits = gain[:, -len(model.known_by_limit) :]  # their pseudo-observations are the last equations
    if equations.frame is not None:
        of_limits = np.hstack([of_limits, gain @ equations.frame])
    HC = curvature(model, fitted) @ fitted.covariance
    mean = 0.5 * np.trace(HC, axis1=1, axis2=2)
    bent = 0.5 * np.einsum("iab,jba->ij", HC, HC) + np.outer(mean, mean)
    first = place @ of_limits @ of_limits.T @ place.T
    total = first + place @ gain @ bent @ gain.T @ place.T
    freedom, remark = np.full(len(total), np.inf), ", ".join(model.known_by_limit)
    return [Contribution(LIMIT, "B", NORMAL, total, freedom, remark=remark)], first


def _with_monte_carlo(
    calibration: SensorCalibration, model: Model, fitted: FitByHand, trials: int, direct: Sequence[Contribution]
) -> SensorCalibration:
    """Return a calibration whose budget also has a Monte Carlo run; ``direct``: its sources of type B."""
    equations = fitted.equations
    n, p = equations.columns.shape
    prior = np.diag(np.sqrt(fitted.precision))[fitted.precision > 0.0]
    X, H = np.concatenate([equations.columns, prior]), np.zeros((n + len(prior), p, p))
    H[:n] = curvature(model, fitted)
    of_equations = [equations.scaled(noise, scale) for noise, _, scale in fitted.hypotheses]
    covariances = [scipy.linalg.block_diag(C, np.eye(len(prior))) for C in of_equations]
    solvers = [quadratic_results(X, H, np.asarray(np.linalg.pinv(c, hermitian=True), float)) for c in covariances]
    weight, place = np.array([w for _, w, _ in fitted.hypotheses]), _places(model, fitted)
    effects = [value for term in fitted.state.terms for value in term.values]
    estimate = np.concatenate([base_values(fitted.state.bias, fitted.state.matrix), effects])

    def draw(rng: np.random.Generator, count: int) -> Values:
        chosen, steps = rng.choice(len(weight), count, p=weight), np.empty((count, p))
        for k in np.unique(chosen):
            rows = chosen == k
            steps[rows] = solvers[k](draw_normal(rng, covariances[k], int(np.count_nonzero(rows))))
        return np.asarray(estimate + steps @ place.T)

    return with_trials(calibration, draw, trials, direct)


def curvature(model: Model, fitted: FitByHand) -> Values:
    """Return the derivative of the columns with respect to the parameters: (n, p, p) array, symmetric."""
    slopes = []
    for j, step in enumerate(np.diag(STEP_UNCERTAINTIES * np.sqrt(np.diag(fitted.covariance)))):
        (up, more), (down, less) = (stepped(model, fitted.state, sign * step) for sign in (1.0, -1.0))
        change = model.equations(up).columns - model.equations(down).columns
        slopes.append(change / (more[j] - less[j]) if step[j] > 0.0 else np.zeros_like(change))
    H = np.stack(slopes, axis=2)
    return np.asarray(0.5 * (H + H.transpose(0, 2, 1)))


def require_faces(recordings: Sequence[Recording], procedure: Procedure) -> None:
    """Raise ``NotObservableError`` if there is a face without a rest, by the raw readings."""
    rests = rests_of("accelerometer", recordings, procedure)
    if rests is not None:
        used = rests.select(~rests.held_out)
        faces_of(used, used.reading, procedure.faces)


def fit_faces(before: SensorCalibration, recordings: UnitRecordings, settings: Settings) -> SensorCalibration:
    """Fit bias and full matrix to the rests and their faces; ``before``: the calibration by the rests alone.

    Raises ``NotObservableError`` if there is no rest on a face.
    """
    noise, stated = recordings.noises["accelerometer"], settings.procedure.faces
    model = accelerometer.model_of(recordings.filtered, before, noise, settings)
    assert model is not None  # noqa: S101
    assert model.faces is not None  # noqa: S101
    assert stated is not None  # noqa: S101
    prior = wander_prior(noise, settings.sensor.accelerometer)
    noises = prior_hypotheses(prior, float(np.mean(model.white)), model.kinds)
    fitted = fit(model, State(before.bias, before.matrix), noises, {})
    force, _ = model.specific_force(fitted.state, model.rests)
    across = np.degrees(np.einsum("rmc,mc->r", model.faces.weights(), force) / model.gravity).reshape(-1, 2)
    off = dict(zip(FACES, np.linalg.norm(across, axis=1).tolist(), strict=True))
    accuracy = stated.accuracy_deg
    details = StageDetails(
        departures=[
            f"face {name} is {angle:.1f} deg off the direction by the other faces, {angle / accuracy:.1f} times "
            "procedure.faces.accuracy_deg"
            for name, angle in off.items()
            if angle > DEPARTS * accuracy
        ],
        rests_on_faces={name: int(np.count_nonzero(model.faces.face == i)) for i, name in enumerate(FACES)},
        face_off_deg=off,
        scatter_of_rests=fitted.noise.scatter[0],
        condition=fitted.condition,
        degrees_of_freedom=float(fitted.degrees_of_freedom.min()),
    )
    return after_stage(before, StageResult(NAME, details=details), model, fitted, settings)
