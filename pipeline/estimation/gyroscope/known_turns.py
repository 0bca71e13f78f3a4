"""Stages of the gyroscope for turns by known angles that a sheet lists, of one method: the bias, and the matrix.

    Y = integral (y - b) dt,   U = angle e,   A = Y U^T (U U^T)^-1

as in ``cholesky_lu``, with the mean b of the rests in the turn's own recording, otherwise of all rests. The errors of
A, ``dA = (dY - A dU) W^T`` with the weights W of the fit, are

    dY : white noise of the turn's samples, and the bias over the turn less that of its rests: white noise of the rests,
         a Gauss-Markov wander, and the bias of a recording
    dU : the angle of each turn, and two angles between the stated and the mean axis, common to the turns about it
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pipeline.core.errors import CannotCalibrateError
from pipeline.core.records import (
    AXES,
    BASE_COUNT,
    BIAS,
    NORMAL,
    Contribution,
    SensorCalibration,
    StageDetails,
    StageResult,
    Subtract,
)
from pipeline.estimation.gauss_markov import block_covariance
from pipeline.estimation.multi_position.accelerometer import SMALLEST_NOISE, white_of
from pipeline.estimation.multi_position.faces_and_turns import across_axis, turns_of
from pipeline.estimation.multi_position.gyroscope import between_recordings
from pipeline.estimation.multi_position.result import NOT_INCLUDED
from pipeline.estimation.rest_means import rests_of
from pipeline.estimation.uncertainty_budget import clock_line, combined, scatter_contribution, stage_parameters

if TYPE_CHECKING:
    from pipeline.core.records import UnitRecordings, Values
    from pipeline.core.settings import Settings
    from pipeline.estimation.engine import ScaledColumns
    from pipeline.estimation.multi_position.faces_and_turns import TurnsByHand
    from pipeline.estimation.rest_means import Rests

ANGLES = "angles and axes of the turns"  # a source of the uncertainty budget


class KnownTurns(NamedTuple):
    """The rests and turns of a sheet, and what a fit of the turns needs of them."""

    rests: Rests
    turns: TurnsByHand
    Y: Values  # (t, 3), deg
    U: Values  # (t, 3), deg
    bias: Values  # (3,), deg/s; of all rests
    of_bias: Values  # (3,), its variance
    of_angle: Values  # (3, t, t), covariance of each column of Y


def known_turns(recordings: UnitRecordings, settings: Settings) -> KnownTurns:
    """Return the turns of a sheet; raise ``CannotCalibrateError`` without a rest or a turn."""
    filtered, noise = recordings.filtered, recordings.noises["gyroscope"]
    every = rests_of("gyroscope", filtered, settings.procedure)
    rests = None if every is None or every.held_out.all() else every.select(~every.held_out)
    turns = turns_of(filtered, rests, None, settings.procedure) if rests is not None else None
    if rests is None or turns is None or noise is None:
        raise CannotCalibrateError(
            "the Cholesky and LU method needs rests, and turns by known angles about x, y and z (kind turn or table)"
        )
    white = np.maximum(white_of(rests, noise), SMALLEST_NOISE)
    m, t = len(rests.time), len(turns.stated)
    own = rests.recording == turns.recording[:, None]
    chosen = np.concatenate([np.ones((1, m)), np.where(own.any(axis=1, keepdims=True), own, 1.0)]) * rests.count
    mean, *of_turns = chosen / chosen.sum(axis=1, keepdims=True)
    length = turns.weight.sum(axis=1)
    start = np.concatenate([rests.start, turns.time[:, 0]])
    span = np.concatenate([rests.length, turns.time[:, -1] - turns.time[:, 0]])
    recording = np.concatenate([rests.recording, turns.recording])
    same = recording[:, None] == recording
    wander = np.where(same, block_covariance(start, span, noise.correlation_time), 0.0)
    between = between_recordings(rests, turns, noise)
    difference = np.hstack([-np.array(of_turns), np.eye(t)])
    of_bias, of_angle = np.zeros(3), np.zeros((3, t, t))
    for c, of_rests in enumerate(rests.variance(white).T):
        S = noise.wander[c] ** 2 * wander + (between * white[c]) ** 2 * same
        S[np.arange(m), np.arange(m)] += of_rests
        of_bias[c] = mean @ S[:m, :m] @ mean
        of_angle[c] = np.outer(length, length) * (difference @ S @ difference.T)
        of_angle[c] += np.diag(white[c] ** 2 * np.sum(turns.weight**2, axis=1))
    Y = np.einsum("ts,tsi->ti", turns.weight, turns.reading) - length[:, None] * (np.array(of_turns) @ rests.reading)
    return KnownTurns(rests, turns, Y, turns.stated[:, None] * turns.direction, mean @ rests.reading, of_bias, of_angle)


def fit_bias(recordings: UnitRecordings, settings: Settings) -> SensorCalibration:
    """Return the stage ``bias``: the mean of the rests."""
    known = known_turns(recordings, settings)
    covariance = np.zeros((BASE_COUNT, BASE_COUNT))
    covariance[BIAS, BIAS] = np.diag(known.of_bias)
    values = {f"b_{axis}": (float(b), "deg/s") for axis, b in zip(AXES, known.bias, strict=True)}
    parameters, details = stage_parameters(values, np.diag(known.of_bias)), StageDetails(rests=len(known.rests.time))
    stage = StageResult("bias", parameters, correction=(Subtract(known.bias),), details=details)
    found = SensorCalibration("gyroscope", bias=known.bias, stages=(stage,))
    return combined(found, [scatter_contribution(covariance, np.inf)], dict(NOT_INCLUDED))


def covariances(known: KnownTurns, A: Values, columns: ScaledColumns) -> tuple[Values, Values]:
    """Return the covariance of bias and A, row by row, by noise and by angles and axes: (12, 12) arrays."""
    W, turns = columns.weights(), known.turns
    of_noise, of_stated = np.zeros((BASE_COUNT, BASE_COUNT)), np.zeros((BASE_COUNT, BASE_COUNT))
    for c, of_angle in enumerate(known.of_angle):
        of_noise[4 * c, 4 * c] = known.of_bias[c]
        of_noise[4 * c + 1 : 4 * c + 4, 4 * c + 1 : 4 * c + 4] = W @ of_angle @ W.T
    t = len(turns.stated)
    errors: list[Values] = [np.outer(e, d) for e, d in zip(np.diag(turns.error[:t]), turns.direction, strict=True)]
    for k, first in enumerate(np.unique(turns.group)):
        signed = np.where(turns.group == first, turns.stated * np.sign(turns.direction @ turns.direction[first]), 0.0)
        size = np.radians(turns.error[t + 2 * k])
        errors += [np.outer(signed * size, v) for v in across_axis(turns.direction[first])]
    for dU in errors:
        change = np.hstack([np.zeros((3, 1)), A @ dU.T @ W.T]).ravel()
        of_stated += np.outer(change, change)
    return of_noise, of_stated


def with_budget(found: SensorCalibration, of_noise: Values, of_stated: Values, settings: Settings) -> SensorCalibration:
    """Return a calibration with its budget; both covariances are of bias and matrix, (12, 12)."""
    noise = scatter_contribution(of_noise, np.inf, remark="white noise, bias wander, and the bias of each recording")
    angles = Contribution(ANGLES, "B", NORMAL, of_stated, np.full(BASE_COUNT, np.inf))
    clock, missing = clock_line(found, settings.table)
    return combined(found, [noise, angles, *clock], NOT_INCLUDED | missing)
