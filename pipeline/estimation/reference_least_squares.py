"""Fit bias and full 3x3 matrix of a sensor by least squares against the table's motion.

In the measurement direction, with regressors without noise,

    y = b + K u + noise,   matrix = K^-1

where

    y : (3,) reading, g or deg/s
    u : (3,) specific force or angular rate by the table's log, same unit
    b : (3,) bias
    K : (3, 3)

each channel is a linear problem with the same columns (1, u_x, u_y, u_z), fitted to the means of samples between which
the motion changes little (``pipeline.estimation.turns.rows_of_parts``). A filtered reading is compared with
``b + K F u``, F the same filter. This is exact for any linear filter; a shift of u by the filter's delay would ignore
its attenuation and be wrong in every ramp.

With stop-and-go turns the accelerometer is fitted to the settled rests, otherwise to all samples. The gyroscope is
fitted to all samples; if the table's rate is only the derivative of its logged angle, the ramps are not used.

The covariance includes bias wander (``pipeline.estimation.engine``) and the table's stated accuracies
(``pipeline.estimation.table_errors``); the covariance of the matrix follows from ``dM = -M dK M``.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.core.errors import NotObservableError
from pipeline.core.records import AXES, BASE_COUNT, MATRIX, SensorCalibration, StageResult, Values
from pipeline.estimation.candidates import bench_effects
from pipeline.estimation.design import MIN_DESIGN_SINGULAR_VALUE, PART_OF_IT
from pipeline.estimation.engine import LinearMap, ScaledColumns, linear_convergence, with_matrix
from pipeline.estimation.generalized_least_squares import fit_joint
from pipeline.estimation.stages import FitStage, StageInput, details_on_table
from pipeline.estimation.table_errors import Reference, noise_on_table
from pipeline.estimation.turns import TurnPart, parts_of, rows_of_parts, settled
from pipeline.estimation.uncertainty_budget import (
    base_parameters,
    budgeted,
    combined,
    lines_on_table,
    noise_contribution,
)
from pipeline.physics.effects import stated_priors
from pipeline.physics.effects.base import length, truth
from pipeline.physics.signal.filters import filtered

NAME = "reference_least_squares"
FIT_STAGES = {NAME: FitStage(accepts=("readings",), changes=("bias", "matrix", "effects"), free=True, reference=True)}
PARAMETER_COLUMNS = ("bias", *(f"matrix column {axis}" for axis in AXES))
SHARP_CHANGE = 1e-3  # of the largest rate between two samples, where the rate is not logged
ADVICE = {
    "accelerometer": "turns about at least two axes bring gravity along all three",
    "gyroscope": "record a turn about each of x, y and z, and rests or turns in both directions",
}


def fit(task: StageInput, *, details: bool = True) -> SensorCalibration:
    """Fit bias and matrix of a sensor against the table's motion (``pipeline.estimation.stages``); role: the sensor.

    ``details``: also the result of the stage, the parts of the noise, effects at their limits and the Monte Carlo run.
    """
    sensor, recordings, settings, prior = task.sensor, task.recordings, task.settings, task.prior
    parts = [_select(sensor, part) for part in parts_of(recordings.filtered, sensor, settings.table, NAME)]
    readings = np.concatenate([part.reading(sensor) for part in parts])
    ideal = (filtered(truth(sensor, part.motion), part.recording) for part in parts)
    truths = np.concatenate([u.compress(part.keep, axis=0) for u, part in zip(ideal, parts, strict=True)])
    if not truths.any():
        raise NotObservableError(f"{sensor}: the table never moved in these recordings; {ADVICE[sensor]}")
    rows, blocks = rows_of_parts(parts)
    count = np.concatenate([each.count for each in rows])
    first, root = (np.cumsum(count) - count).astype(np.intp), np.sqrt(count)[:, None]
    y, u = (np.add.reduceat(of_samples, first, axis=0) / count[:, None] for of_samples in (readings, truths))
    X = np.column_stack([np.ones(len(u)), u])
    weighted = root * X
    factors = ScaledColumns.of(weighted)
    condition, rank = _require_observable(sensor, factors, X), X.shape[1]
    beta = factors.solve(root * y)
    residuals = readings - beta[0] - truths @ beta[1:]
    bias, K = beta[0], beta[1:].T
    matrix = np.asarray(np.linalg.solve(K, np.eye(3)), float)
    J = np.zeros((3, BASE_COUNT, 4))
    for channel in range(3):
        J[channel, channel, 0] = 1.0
        J[channel, MATRIX, 1:] = -np.einsum("i,bj->ijb", matrix[:, channel], matrix).reshape(9, 3)
    weights = factors.weights() * root.T
    fit = LinearMap((weights, weights, weights), (J[0], J[1], J[2]))
    motions = [each.motion(part.motion) for each, part in zip(rows, parts, strict=True) if len(each.count)]
    reference = Reference(sensor, motions, K, settings.table)
    noise = noise_on_table(reference, residuals, X, blocks, prior, count)
    bench = bench_effects(sensor, settings.table, recordings.filtered)
    if not (details or bench):
        rounded, stated, missing = lines_on_table(reference, fit, noise, settings)
        lines = [noise_contribution(noise, fit, None), *rounded, *stated]
        return combined(SensorCalibration(sensor, bias, matrix), lines, missing)
    contributions = [noise_contribution(noise, fit, prior)]
    figures = details_on_table(noise, contributions[0].degrees_of_freedom, parts, len(readings), condition)
    result = StageResult(
        name=NAME,
        parameters=base_parameters(sensor, bias, matrix, contributions[0].covariance),
        residual_rms=float(np.sqrt(np.mean(residuals**2))),
        details=replace(figures, residual_rms=np.sqrt(np.mean(residuals**2, axis=0)).tolist()),
    )
    convergence = linear_convergence(weighted, root * (y - X @ beta), condition, rank)
    found = SensorCalibration(sensor, bias, matrix, stages=(*task.stages, result), convergence=convergence)
    if bench and not stated_priors(settings.table):  # else the stage ``effects`` fits them
        return fit_joint(sensor, recordings.filtered, bench, recordings.noises[sensor], settings, found)
    return budgeted(
        found, reference, fit, noise, contributions, settings, lambda e: with_matrix(of_channels(beta.T.ravel() + e))
    )


def of_channels(values: Values) -> Values:
    """Reorder (t, 12) values from (bias, row of K) for each channel to bias and K."""
    channels = values.reshape(len(values), 3, 4)
    return np.concatenate([channels[:, :, 0], channels[:, :, 1:].reshape(-1, 9)], axis=1)


def _select(sensor: str, part: TurnPart) -> TurnPart:
    if sensor == "accelerometer":
        return replace(part, keep=settled(part))
    if part.recording.table_rate is not None:
        return part
    rate = np.linalg.norm(part.motion.angular_acceleration, axis=1) * part.recording.interval
    sharp = rate > SHARP_CHANGE * np.max(np.abs(part.motion.angular_rate))
    sharp = np.convolve(sharp, np.ones(5), mode="same") > 0  # a spline rings about a corner
    return replace(part, keep=part.keep & ~sharp)


def _require_observable(sensor: str, factors: ScaledColumns, X: Values) -> float:
    """Return the condition of the columns, in units of the largest motion; raise if one is not determined.

    ``factors``: of X times the root of the samples of each row.
    """
    size = float(np.max(length(X[:, 1:])))
    units = factors.scale[0] * np.array([1.0, size, size, size])
    rotated = factors.singular[:, None] * factors.Vt * (factors.scale / units)  # of the same singular values
    columns = ScaledColumns.of(rotated, MIN_DESIGN_SINGULAR_VALUE, np.ones(len(units)))
    if lost := columns.undetermined(PARAMETER_COLUMNS, PART_OF_IT):
        raise NotObservableError(
            f"{sensor}: the recordings do not determine {', '.join(lost)}"
            f"{' independently of each other' if len(lost) > 1 else ''}: {ADVICE[sensor]}"
        )
    return columns.condition
