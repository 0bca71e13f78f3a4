"""Fit bias and matrix of the gyroscope to hand-held rests and moves (Tedaldi, Pretto & Menegatti, ICRA 2014).

At rest the reading is the bias. The integrated rate of a move must rotate gravity before it onto gravity after it. The
accelerometer is calibrated first, and defines the frame. ``pipeline.estimation.multi_position.gyroscope`` has the
equations. Rests and moves are weighted by their scatter, and outlying moves have less weight.

A move is an outlier if, with its two whitened residuals r_k and the scale s of the median move,

    t_k = |r_k| / s,   s = median |r_k| / sqrt(2 log 2),   t_k^2 > 2 log(k / p)

which one of k valid moves exceeds with the probability p. If there is an outlier, all moves have the weights
``min(1, (v + 2) / (v + t^2))`` of Student's t with v = 4 degrees of freedom: a move of weight w has 1/w times its
variance. Source: Lange, Little & Taylor, JASA 84 (1989), 881-896.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import partial
from typing import TypeAlias

import numpy as np

from pipeline.core.errors import CannotCalibrateError
from pipeline.core.records import (
    BASE_COUNT,
    MATRIX,
    MATRIX_NAMES,
    Multiply,
    OutlyingMove,
    Recording,
    SensorCalibration,
    StageDetails,
    StageResult,
    Subtract,
    TurnAxes,
    Values,
)
from pipeline.core.settings import Procedure
from pipeline.estimation.effects import accelerometer_of, frame_error
from pipeline.estimation.engine import ScaledColumns
from pipeline.estimation.multi_position.fit import MIN_NEW_NORM_SHARE, FitByHand
from pipeline.estimation.multi_position.fit import fit as fit_by_hand
from pipeline.estimation.multi_position.gyroscope import MIN_MOVES, GyroscopeModel, model_of
from pipeline.estimation.multi_position.model import State, prior_hypotheses, with_limits
from pipeline.estimation.multi_position.moves import clipped_moves
from pipeline.estimation.multi_position.result import after_stage
from pipeline.estimation.rest_means import ROLE, advice_on_held_out, is_multi_position, rests_of
from pipeline.estimation.stages import FitStage, StageInput, limits_of_base

Robust: TypeAlias = tuple[GyroscopeModel, FitByHand, list[OutlyingMove]]


OUTLIER_FALSE_ALARM, FREEDOM = 1e-3, 4.0  # p and v
ROBUST_ROUNDS, SETTLED_WEIGHT_CHANGE = 6, 0.05  # weights that change by less are final
NAME = "rests_and_moves"
FIT_STAGES = {NAME: FitStage(sensors=("gyroscope",), accepts=("readings",), changes=("bias", "matrix"), free=True)}
MOVED_TIMES = 2  # an error of 0.7 deg squared is 0.01 deg, as large as the noise of a move; a second time 1e-4 deg
# standard uncertainty beyond which an element of the matrix is called undetermined
MAX_KNOWN_ELEMENT_UNCERTAINTY = 0.05
CLEARLY_BELOW = 0.9  # of the limit: axes of turns that are known so well, and noise, are less uncertain than it
RECORDING_ADVICE = "record some 24 rests, each in another orientation, with moves about changing axes between them"


def fit_robustly(model: GyroscopeModel, fit_model: Callable[..., FitByHand], recordings: Sequence[Recording]) -> Robust:
    """Fit rests and moves, with weights of Student's t if a move is an outlier.

    ``fit_model``: function that fits a model, from ``start`` and what is ``known`` of it if given (``fit``). Returns
    model and fit with the variance by the weights, and the outliers: ``recording, time_s, error_deg, over_noise,
    weight``.
    """
    fitted, moves = fit_model(model), model.moves
    if moves is None:
        return model, fitted, []
    t, error = _over_noise(model, fitted)
    limit = np.sqrt(2.0 * np.log(len(t) / OUTLIER_FALSE_ALARM))
    if not np.any(t > limit):
        return model, fitted, []
    weight = np.ones(len(t))
    for _ in range(ROBUST_ROUNDS):
        before, weight = weight, np.minimum(1.0, (FREEDOM + 2.0) / (FREEDOM + t**2))
        if np.abs(weight - before).max() < SETTLED_WEIGHT_CHANGE:
            break
        variance = np.where(t > 0.0, (error / np.maximum(t, 1e-12)) ** 2, 0.0)
        model = copy(model)
        model.excess = variance * (1.0 / weight - 1.0)
        fitted = fit_model(model, start=fitted.state, known=(model.equations(fitted.state), fitted.scores))
        t, error = _over_noise(model, fitted)
    outlying = [
        OutlyingMove(
            recording=recordings[int(model.every.recording[moves.after[k]])].name,
            time_s=float(moves.time[k, 0]),
            error_deg=float(error[k]),
            over_noise=float(t[k]),
            weight=float(weight[k]),
        )
        for k in np.flatnonzero(t > limit)
    ]
    return model, fitted, outlying


def _over_noise(model: GyroscopeModel, fitted: FitByHand) -> tuple[Values, Values]:
    """Return t of each move, and its residual, deg."""
    C = fitted.equations.covariance(fitted.noise)
    error = fitted.error[model.of_moves].reshape(-1, 2)
    r = fitted.residual[model.of_moves].reshape(-1, 2) * error
    variance = np.diag(C)[model.of_moves].reshape(-1, 2) * error**2 - model.excess[:, None]
    size = np.sqrt(np.sum(r**2 / variance, axis=1))
    scale = float(np.median(size)) / np.sqrt(2.0 * np.log(2.0))
    return size / max(scale, 1e-12), np.linalg.norm(r, axis=1)


def fit(task: StageInput) -> SensorCalibration:
    """Fit bias and matrix of the gyroscope (``pipeline.estimation.stages``).

    Role ``rests``, with the readings of the accelerometer, which is calibrated first. Raises ``CannotCalibrateError``
    also where moves and turns do not determine the matrix: the unit then keeps the calibration of its accelerometer.
    """
    recordings, settings, noise, data_sheet = task.recordings, task.settings, task.noise, task.data_sheet
    filtered, procedure = recordings.filtered, settings.procedure
    _require_recordings(filtered, procedure)
    accelerometer = accelerometer_of(recordings, settings)
    sheet = procedure.sheet is not None
    frame_deg = frame_error(accelerometer, settings)
    limits = dict(zip(MATRIX_NAMES, limits_of_base(data_sheet)[MATRIX].tolist(), strict=True)) if sheet else {}
    model = model_of(filtered, None, noise, procedure, accelerometer, known_by_limit=limits, frame_deg=frame_deg)
    advice = RECORDING_ADVICE + advice_on_held_out(filtered, procedure)
    if model is None or not (model.moves or model.turns or sheet):
        rests = rests_of("gyroscope", filtered, procedure)
        raise CannotCalibrateError(
            f"the gyroscope's matrix needs at least {MIN_MOVES} moves between rests, without gaps or clipped "
            f"readings{clipped_moves(filtered, rests) if rests else ''}: {advice}"
        )
    noises = prior_hypotheses(task.prior, float(np.mean(model.white)), model.kinds)
    start = State(np.average(model.rests.reading, axis=0, weights=model.rests.count), np.eye(3))
    fit_model = partial(fit_by_hand, start=start, hypotheses=noises, limits={})
    of_frame = np.radians(frame_deg) ** 2 * (1.0 - np.eye(3)).ravel()

    def fit_with(held: Mapping[str, float], whole: GyroscopeModel = model) -> tuple[Robust, Values]:
        part = copy(whole)
        part.known_by_limit = held
        equations = part.equations(start)
        base = equations.base
        if ScaledColumns.of(base, MIN_NEW_NORM_SHARE).rank < base.shape[1]:
            problem = "the moves are too much alike to determine the gyroscope's matrix, as if all were about one axis"
            raise CannotCalibrateError(f"{problem}: {advice}")
        found = fit_robustly(part, partial(fit_model, known=(equations, None)), filtered)
        # limits and axes are of the case: no gyroscope shows the frame of the accelerometer in it
        return found, np.sqrt(np.maximum(np.diag(found[1].covariance)[MATRIX] - of_frame, 0.0))

    model, fitted, outlying = with_limits(limits, fit_with) if sheet else fit_with({})[0]
    moved, faces = np.zeros(BASE_COUNT), procedure.faces
    for _ in range(MOVED_TIMES if faces and model.moves else 0):
        moved = model.accelerometer_errors(fitted)
        model = model_of(filtered, None, noise, procedure, accelerometer, moved=moved)
        assert model is not None  # noqa: S101
        model, fitted, outlying = fit_robustly(model, partial(fit_model, start=fitted.state), filtered)
    moves, u = model.moves.count if model.moves else 0, np.sqrt(np.diag(fitted.covariance))[MATRIX]
    if not sheet:
        _require_known(u, moves, advice)
    apart = fitted.residual[model.of_moves] * fitted.error[model.of_moves]
    details = StageDetails(
        rests=len(model.rests.time),
        moves=moves,
        direction_error_rms_deg=float(np.sqrt(np.mean(apart**2))) if moves else None,
        scatter_of_rests=fitted.noise.scatter[0],
        scatter_of_moves=fitted.noise.scatter[1] if moves else None,
        scatter_of_directions=fitted.noise.direction,
        moves_weighted_down=len(outlying),
        moves_outlying=outlying,
        condition=fitted.condition,
        degrees_of_freedom=float(fitted.degrees_of_freedom.min()),
        known_by_limit=model.known_by_limit if sheet else None,
        accelerometer_moved=moved.tolist() if faces else None,
    )
    if model.turns is not None:
        off, axes = fitted.residual * fitted.error, None
        by_hand = settings.table.motion == "none" or any(r.kind == "turn" for r in filtered)
        if sheet and procedure.turns and by_hand:
            needed = CLEARLY_BELOW * float(np.degrees(data_sheet.cross_axis / np.sqrt(3.0)))
            axes = TurnAxes(procedure.turns.axis_accuracy_deg, needed)
        departures = model.turns.departures(off[model.of_turns], fitted.deviation[model.of_turns])
        angles = model.turns.described(fitted.state)
        details = replace(details, turns=angles, turn_axes=axes, departures=departures)
    stage = StageResult(NAME, correction=(Subtract(fitted.state.bias), Multiply(fitted.state.matrix)), details=details)
    before = SensorCalibration("gyroscope", stages=task.stages)
    return after_stage(before, stage, model, fitted, settings, other=accelerometer)


def _require_recordings(recordings: Sequence[Recording], procedure: Procedure) -> None:
    """Raise ``CannotCalibrateError`` without recordings by hand of both sensors; a sheet may lack the accelerometer."""
    if not is_multi_position("gyroscope", recordings):
        raise CannotCalibrateError(
            f"rests and moves need a recording by hand with the gyroscope's readings: {RECORDING_ADVICE}"
        )
    if procedure.sheet is None and not any(r.role == ROLE and r.accelerometer is not None for r in recordings):
        raise CannotCalibrateError(
            "rests and moves need the readings of both sensors: gravity before and after each move shows by how much "
            "the unit turned. A gyroscope alone needs a rate table, or turns by known angles (procedure listed)"
        )


def _require_known(u: Values, moves: int, advice: str) -> None:
    """Raise ``CannotCalibrateError`` if the moves leave an element of the matrix open; ``u``: (9,)."""
    if np.any(u > MAX_KNOWN_ELEMENT_UNCERTAINTY):
        weak = [name for name, one in zip(MATRIX_NAMES, u, strict=True) if one > MAX_KNOWN_ELEMENT_UNCERTAINTY]
        raise CannotCalibrateError(
            f"the {moves} moves are nearly degenerate: they leave {', '.join(weak)} open to {float(u.max()):.2g} "
            f"(standard uncertainty), as if all were about one axis: {advice}"
        )
