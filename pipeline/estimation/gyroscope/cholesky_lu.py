"""Fit the gyroscope's matrix by the Cholesky and LU factors of integrated turns (paper eqs 2 and 5-12).

    y - b = A u,   A = S T M

where

    y, b : reading and bias, deg/s; the bias comes from the stage before
    u    : angular rate by the table, deg/s
    S    : diagonal scale factors
    T    : unit lower triangular, the non-orthogonality of the sensor's axes
    M    : orthonormal, the mounting of the sensor

Readings and reference are integrated over each turn, from rest to rest; the angles are the columns of Y and U (deg),
and

    A = Y U^T (U U^T)^-1,   S T = chol(A A^T),   M = (S T)^-1 A

With several turns about an axis, at several rates and in both directions, A is a least-squares estimate. The
calibration matrix is ``A^-1``. As printed it is A: in Sudsanguan 2019, tables 5.25 and 5.26, the forward matrix is
applied as if it were the correction.

Y is linear in the readings. So ``pipeline.estimation.engine`` gives the covariance of A under white noise and bias
wander, and the derivatives with respect to A give the covariance of S, T, M and ``A^-1``. The integrals

    Y = integral (y - b) dt,   U = integral u dt

are by the trapezoidal rule on the timestamps, so that noise and a delay between reading and reference have little
effect. A turn is the time in which the table's rate is above a threshold, in one direction, plus the time in which the
output of a filter still changes.

Turns of a sheet have ``U = angle e`` by their known angles, and b is the mean of the rests in the turn's own recording,
otherwise of all rests; the stage ``bias`` of the method is then ``fit_bias``. The errors of A, ``dA = (dY - A dU) W^T``
with the weights W of the fit, are

    dY : white noise of the turn's samples, and the bias over the turn less that of its rests: white noise of the rests,
         a Gauss-Markov wander, and the bias of a recording
    dU : the angle of each turn, and two angles between the stated and the mean axis, common to the turns about it
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from pipeline.core.errors import CannotCalibrateError, NotObservableError
from pipeline.core.records import (
    AFTER_BASE,
    AXES,
    BASE,
    BASE_COUNT,
    BIAS,
    NORMAL,
    Contribution,
    Index,
    Mask,
    Multiply,
    Recording,
    SensorCalibration,
    StageDetails,
    StageResult,
    Subtract,
    UnitRecordings,
    Values,
)
from pipeline.core.settings import Settings, Table
from pipeline.estimation.engine import LinearMap, ScaledColumns, derivative, linear_convergence, with_matrix
from pipeline.estimation.gauss_markov import block_covariance
from pipeline.estimation.multi_position.accelerometer import SMALLEST_NOISE, white_of
from pipeline.estimation.multi_position.faces_and_turns import TurnsByHand, across_axis, turns_of
from pipeline.estimation.multi_position.gyroscope import between_recordings
from pipeline.estimation.multi_position.moves import trapezoids
from pipeline.estimation.multi_position.result import NOT_INCLUDED
from pipeline.estimation.reference_least_squares import of_channels
from pipeline.estimation.rest_means import Rests, rests_of
from pipeline.estimation.stages import FitStage, StageInput
from pipeline.estimation.table_errors import Reference, noise_on_table
from pipeline.estimation.turns import TurnPart, blocks_of_samples, parts_of, used_motions
from pipeline.estimation.uncertainty_budget import (
    budgeted,
    clock_line,
    combined,
    noise_contribution,
    scatter_contribution,
    stage_parameters,
)
from pipeline.physics.signal.rests import runs

NAME = "cholesky_lu"
STAGE = FitStage(sensors=("gyroscope",), needs=("bias",), changes=("matrix",), accepts=("readings", "bias"), free=True)
FIT_STAGES = {NAME: STAGE}
DIFFERENCE_STEP = 1e-6  # of the central differences: truncation and rounding are below 1e-9 of the derivative
MOTION_SHARE = 0.01  # of the largest rate, above which the table turns
MIN_RATE_DPS = 0.02  # five times Earth's rotation, which a log may contain
DELAYS_TO_SETTLE = 5.0  # after which an RC filter holds less than 1 % of a change of rate
SMALLEST_ANGLE_DEG = 1.0  # a smaller turn hardly determines the matrix
ANGLES = "angles and axes of the turns"  # a source of the uncertainty budget


class Factors(NamedTuple):
    """S, T and M of a forward matrix ``A = S T M``: (3,), (3, 3) and (3, 3) arrays."""

    S: Values
    T: Values
    M: Values


class Forward(NamedTuple):
    """The least squares ``Y = U A^T`` of integrated readings and rates."""

    turns: TurnIntegrals
    Y: Values  # (t, 3), deg; readings less bias, integrated over each turn
    U: Values  # (t, 3), deg; rates
    A: Values  # (3, 3)


def forward_of(recordings: Sequence[Recording], bias: Values, table: Table) -> Forward:
    """Return the forward matrix of recordings without its uncertainty."""
    turns = integrals_of(parts_of(recordings, "gyroscope", table, "the Cholesky and LU method"))
    Y, U = turns.integral(turns.reading - bias), turns.integral(turns.rate)
    require_turns(U)
    return Forward(turns, Y, U, ScaledColumns.of(U).solve(Y).T)


def fit(task: StageInput) -> SensorCalibration:
    """Fit the matrix to the integrated turns of role ``gyroscope``, on a table, after the stage ``bias``."""
    recordings, previous, settings, prior = task.recordings, task.previous, task.settings, task.prior
    assert previous is not None  # noqa: S101  (it needs the bias: FIT_STAGES)
    if settings.procedure.sheet is not None:
        return _fit_of_sheet(recordings, previous, settings)
    turns, Y, U, A = forward_of(recordings.filtered, previous.bias, settings.table)
    as_printed = settings.method.as_printed
    residuals = turns.reading - previous.bias - turns.rate @ A.T
    design = np.column_stack([np.ones(len(turns.rate)), turns.rate])
    fit, of_bias = _linear_map(turns, A, previous, as_printed=as_printed)
    reference = Reference("gyroscope", used_motions(turns.parts), A, settings.table)
    noise = noise_on_table(reference, residuals, design, blocks_of_samples(turns.parts), prior)
    scatter = noise_contribution(noise, fit, prior)
    matrix = calibration_matrix(A, as_printed=as_printed)
    # The rms error of the integrated angles: rows are turn axes, columns are sensor axes.
    squares, about = (Y @ matrix.T - U) ** 2, np.argmax(np.abs(U), axis=1)
    of_axes = [squares[about == i] for i in range(3)]
    angle_errors = [np.sqrt(each.mean(axis=0)).tolist() if len(each) else 3 * [None] for each in of_axes]
    after = (turns.reading - previous.bias) @ matrix.T
    error = np.linalg.norm(after, axis=1) - np.linalg.norm(turns.rate, axis=1)
    details = StageDetails(
        turns_left_out=turns.left_out,
        samples_used=len(turns.reading),
        angle_error_rms_deg=angle_errors,
        degrees_of_freedom=float(scatter.degrees_of_freedom.min()),
    )
    rms = float(np.sqrt(np.mean(error**2)))
    found = _calibration(previous, Y, U, A, matrix, scatter.covariance + of_bias, rms, details)
    lines = [scatter.of(BASE)]
    if np.any(of_bias):
        before = np.inf if previous.freedom is None else float(previous.freedom[BIAS].min())
        lines.append(replace(scatter_contribution(of_bias[BASE, BASE], before), source="bias of the stage before"))
    theta = np.column_stack([previous.bias, A])

    def results(errors: Values) -> Values:
        plain = of_channels(theta.ravel() + errors)
        return plain if as_printed else with_matrix(plain)

    return budgeted(found, reference, fit.results(BASE), noise, lines, settings, results)


def _fit_of_sheet(recordings: UnitRecordings, previous: SensorCalibration, settings: Settings) -> SensorCalibration:
    """Fit the matrix to turns by known angles (``known_turns``)."""
    known, as_printed = known_turns(recordings, settings), settings.method.as_printed
    require_turns(known.U)
    columns, turns, t = ScaledColumns.of(known.U), known.turns, len(known.U)
    A, W = columns.solve(known.Y).T, columns.weights()
    of_noise, of_stated = np.zeros((2, BASE_COUNT, BASE_COUNT))  # of bias and A, row by row
    for c, of_angle in enumerate(known.of_angle):
        of_noise[4 * c, 4 * c] = known.of_bias[c]
        of_noise[4 * c + 1 : 4 * c + 4, 4 * c + 1 : 4 * c + 4] = W @ of_angle @ W.T
    errors: list[Values] = [np.outer(e, d) for e, d in zip(np.diag(turns.error[:t]), turns.direction, strict=True)]
    for k, first in enumerate(np.unique(turns.group)):
        signed = np.where(turns.group == first, turns.stated * np.sign(turns.direction @ turns.direction[first]), 0.0)
        size = np.radians(turns.error[t + 2 * k])
        errors += [np.outer(signed * size, v) for v in across_axis(turns.direction[first])]
    for dU in errors:
        change = np.hstack([np.zeros((3, 1)), A @ dU.T @ W.T]).ravel()
        of_stated += np.outer(change, change)
    theta = np.column_stack([previous.bias, A]).ravel()
    J = derivative(partial(_results, as_printed=as_printed), theta, np.full(theta.size, DIFFERENCE_STEP))
    matrix, left = calibration_matrix(A, as_printed=as_printed), known.Y - known.U @ A.T
    rms, details = float(np.sqrt(np.mean(np.sum(left**2, axis=1)))), StageDetails(rests=len(known.rests.time))
    found = _calibration(previous, known.Y, known.U, A, matrix, J @ (of_noise + of_stated) @ J.T, rms, details)
    of_noise, of_stated = (J[BASE] @ each @ J[BASE].T for each in (of_noise, of_stated))
    noise = scatter_contribution(of_noise, np.inf, remark="white noise, bias wander, and the bias of each recording")
    angles = Contribution(ANGLES, "B", NORMAL, of_stated, np.full(BASE_COUNT, np.inf))
    clock, missing = clock_line(found, settings.table)
    return combined(found, [noise, angles, *clock], NOT_INCLUDED | missing)


def _calibration(  # noqa: PLR0917  (of one stage)
    previous: SensorCalibration,
    Y: Values,
    U: Values,
    A: Values,
    matrix: Values,
    covariance: Values,
    rms: float,
    details: StageDetails,
) -> SensorCalibration:
    """Return the calibration after the stage; ``covariance``: of bias, matrix, S, T and M, (27, 27)."""
    factors, columns = factorise(A), ScaledColumns.of(U)
    M, condition = factors.M, float(np.linalg.cond(U / np.linalg.norm(U, axis=0)))
    error, determinant = float(np.max(np.abs(M @ M.T - np.eye(3)))), float(np.linalg.det(M))
    details = replace(details, turns=len(U), orthonormality_error=error, determinant_of_M=determinant)
    details = replace(details, condition=condition)
    parameters = stage_parameters(_values(factors), covariance[AFTER_BASE, AFTER_BASE])
    stage = StageResult(NAME, parameters, rms, (Subtract(previous.bias), Multiply(matrix)), details)
    convergence = linear_convergence(U, Y - U @ A.T, columns.condition, columns.rank)
    stages = (*previous.stages, stage)
    return SensorCalibration("gyroscope", previous.bias, matrix, stages, convergence=convergence)


def factorise(A: Values) -> Factors:
    """Return S (positive), T (unit lower triangular) and M (orthonormal) with ``A = S T M``."""
    L = np.linalg.cholesky(A @ A.T)
    S = np.diag(L).copy()
    return Factors(S, L / S[:, None], np.linalg.solve(L, A))


def calibration_matrix(A: Values, *, as_printed: bool) -> Values:
    """Return the matrix of the calibration: the inverse of A, or A itself as printed."""
    return A if as_printed else np.asarray(np.linalg.solve(A, np.eye(3)))


def _results(theta: Values, *, as_printed: bool) -> Values:
    """Return bias, matrix, S, T and M (12 + 15) of the rows of bias and A, (12,)."""
    channels = theta.reshape(3, 4)
    found = [value for value, _ in _values(factorise(channels[:, 1:])).values()]
    return np.concatenate([channels[:, 0], calibration_matrix(channels[:, 1:], as_printed=as_printed).ravel(), found])


def _linear_map(
    turns: TurnIntegrals, A: Values, previous: SensorCalibration, *, as_printed: bool
) -> tuple[LinearMap, Values]:
    """Return the map from readings to bias, matrix, S, T and M (12 + 15), and their covariance by the bias before.

    Without a rest in the turns' recordings the bias is from another recording, and its covariance adds to the other;
    else that covariance is zero.
    """
    inverse = ScaledColumns.of(turns.integral(turns.rate)).weights()
    inside = turns.turn >= 0
    weights = np.zeros((4, len(turns.reading)))
    weights[1:, inside] = inverse[:, turns.turn[inside]] * turns.weight[inside]
    from_rests = bool(turns.rest.any())
    lever = np.array([1.0, *(-weights[1:].sum(axis=1))])
    if from_rests:
        weights += lever[:, None] * np.where(turns.rest, 1.0 / turns.rest.sum(), 0.0)
    theta, of_bias = np.column_stack([previous.bias, A]).ravel(), np.zeros((27, 27))

    results = partial(_results, as_printed=as_printed)
    x, y, z = np.split(derivative(results, theta, np.full(theta.size, DIFFERENCE_STEP)), 3, axis=1)
    if not from_rests and previous.covariance is not None:
        for channel, J in enumerate((x, y, z)):
            of_bias += previous.covariance[channel, channel] * np.outer(J @ lever, J @ lever)
    return LinearMap((weights, weights, weights), (x, y, z)), of_bias


def _values(factors: Factors) -> dict[str, tuple[float, str]]:
    """Return S, the elements of T below its diagonal, and M, with their units."""
    below = list(zip(*np.tril_indices(3, -1), strict=True))
    values = {f"S_{axis}": (float(s), "1") for axis, s in zip(AXES, factors.S, strict=True)}
    values |= {f"T_{AXES[i]}{AXES[j]}": (float(factors.T[i, j]), "1") for i, j in below}
    return values | {f"M_{AXES[i]}{AXES[j]}": (float(factors.M[i, j]), "1") for i in range(3) for j in range(3)}


@dataclass(frozen=True)
class TurnIntegrals:
    """Samples at rest and in turns of all recordings, stacked, with their weights in the integrals."""

    reading: Values  # (n, 3), deg/s
    rate: Values  # (n, 3), deg/s; by the table, Earth's rotation included where it is known
    rest: Mask  # (n,)
    weight: Values  # (n,), s; of each sample in the integral over its turn; 0 at rest
    turn: Index  # (n,); turn of each sample, -1 at rest
    parts: list[TurnPart]
    left_out: int  # turns with clipped or stuck readings

    def integral(self, values: Values) -> Values:
        """Return the integral of (n, 3) values over each turn: (t, 3) array, deg."""
        inside = self.turn >= 0
        size = int(self.turn.max(initial=-1)) + 1
        weighted = self.weight[inside, None] * values[inside]
        return np.stack([np.bincount(self.turn[inside], column, size) for column in weighted.T], axis=1)


def integrals_of(parts: Sequence[TurnPart]) -> TurnIntegrals:
    """Stack the samples at rest and in turns of recordings."""
    columns, chosen, found, left_out = [], [], 0, 0
    for part in parts:
        weight, turn = np.zeros(part.recording.samples), np.full(part.recording.samples, -1, np.intp)
        for start, stop in _moves(part):
            if not part.keep[start:stop].all():
                left_out += 1
                continue
            weight[start:stop] += trapezoids(part.motion.time[start:stop])
            turn[start:stop] = found
            found += 1
        rest = part.motion.still & part.keep & (turn < 0)
        keep = rest | (turn >= 0)
        each = np.asarray(part.recording.gyroscope), part.motion.angular_rate, rest, weight, turn
        columns.append([values[keep] for values in each])
        chosen.append(replace(part, keep=keep))
    reading, rate, rest, weight, turn = (np.concatenate(column) for column in zip(*columns, strict=True))
    return TurnIntegrals(reading, rate, rest, weight, turn, chosen, left_out)


def _moves(part: TurnPart) -> list[tuple[int, int]]:
    """Return the stretches in which the table turns in one direction, until the filtered reading has settled."""
    motion = part.motion
    rate = motion.rate if motion.rate is not None else np.linalg.norm(motion.angular_rate, axis=1)
    threshold = max(MIN_RATE_DPS, MOTION_SHARE * float(np.max(np.abs(rate))))
    lag = int(np.ceil(DELAYS_TO_SETTLE * float(part.recording.filter.get("delay_s", 0.0)) / part.recording.interval))
    moving = sorted(runs(rate > threshold) + runs(rate < -threshold))
    out, end = [], 0
    for k, (first, last) in enumerate(moving):
        after = moving[k + 1][0] if k + 1 < len(moving) else len(rate)
        start, stop = max(first - 1, end), min(last + 1 + lag, after, len(rate))
        angle = abs(float(np.trapezoid(rate[start:stop], motion.time[start:stop]))) if stop - start > 1 else 0.0
        if angle >= SMALLEST_ANGLE_DEG:
            out.append((start, stop))
            end = stop
    return out


def require_turns(U: Values) -> None:
    """Raise ``NotObservableError`` if turns by U, (t, 3) deg about each axis, do not span all three axes."""
    total = np.sqrt(np.sum(U**2, axis=0))
    largest = float(total.max(initial=0.0))
    missing = [axis for axis, angle in zip(AXES, total, strict=True) if angle <= 1e-3 * largest or largest == 0.0]
    if missing or np.linalg.matrix_rank(U, tol=1e-3 * largest) < 3:
        about = f"about {' and '.join(missing)}" if missing else "about three independent axes"
        problem = f"the gyroscope was not turned {about}: record a turn about each of x, y and z, from rest to rest"
        raise NotObservableError(f"{problem}, at 20 deg/s or more")


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
