"""Compute how each effect of the sensor file, at its limit, would change bias and matrix of a fit without that effect.

    d beta = sum over rows A z(p_j = limit_j),    up to sum_j |d beta_j|

with the linear map A of the fit from its readings (``pipeline.estimation.engine``) or equations to its parameters, and
the column z of parameter j of the effect. Where the recordings leave the effect open
(``pipeline.evaluation.diagnosis.observability``), the largest change is not in the expanded uncertainty: the
calibration states it apart (``pipeline.physics.open_effects``).

An error of the accelerometer by hand changes the direction of gravity, to which the moves of the gyroscope refer:

    df = M_a (z - db_a) + dM_a v_a,    d beta = A D df

with D, the derivative of the moves' equations with respect to the specific force at each rest. These changes are named
``accelerometer.<effect>``.

A change with temperature counts from the mean temperature of the recordings, at which bias and matrix hold.
Effects of timing move the motion, and are left out: they act where the motion changes.
"""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.records import BASE, BIAS, matrix_of
from pipeline.estimation.candidates import limits_of
from pipeline.estimation.design import EffectColumns, columns_of_samples, joined_motions
from pipeline.estimation.engine import scaled_inverse
from pipeline.estimation.multi_position.model import motion_of
from pipeline.physics.effects import catalogue, effect
from pipeline.physics.effects.base import REFERENCE_TEMPERATURE, Owner

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

    from pipeline.core.records import Motion, SensorCalibration, Values
    from pipeline.core.settings import DataSheet
    from pipeline.estimation.engine import LinearMap
    from pipeline.estimation.multi_position.fit import FitByHand
    from pipeline.estimation.multi_position.gyroscope import GyroscopeModel
    from pipeline.estimation.multi_position.model import Model
    from pipeline.estimation.table_errors import Reference
    from pipeline.physics.effects.base import Effect

OWNERS = (Owner.SENSOR, Owner.RECORDING)  # errors of place, table and timing have lines of their own in the budget
OF_ACCELEROMETER = "accelerometer."  # before an effect of the accelerometer that changes the gyroscope's parameters


def limited_effects(
    sensor: str, modelled: Collection[str], data_sheet: DataSheet
) -> Iterator[tuple[Effect, Values, Values]]:
    """Yield each effect of the sensor file that is not in the model, its start, and the limits of its coefficients.

    An effect with time constants has several starts; limits of time constants are 0.
    """
    limits = limits_of(sensor, data_sheet)
    within = {*modelled, *(name for other in modelled for name in effect(other).contains)}
    for name, this in catalogue().items():
        if name in within or sensor not in this.sensors or sensor in this.unseen or this.owner not in OWNERS:
            continue
        if name not in limits or this.moves or this.of_turns or not np.all(np.isfinite(limits[name])):
            continue
        linear = np.array([p.name not in this.nonlinear for p in this.parameters(sensor)])
        yield from ((this, start, np.where(linear, limits[name], 0.0)) for start in this.starts(sensor))


def _keep_larger(found: dict[str, Values], name: str, change: Values) -> None:
    """Keep the larger of two changes by an effect at different time constants."""
    if name not in found or np.abs(change).sum() > np.abs(found[name]).sum():
        found[name] = change


def changes_on_table(
    reference: Reference, fit: LinearMap, modelled: Collection[str], data_sheet: DataSheet
) -> dict[str, Values]:
    """Return the change of bias and matrix by each effect at its limits, (12, p), of a fit on a table."""
    found: dict[str, Values] = {}
    sensor, K, motions = reference.sensor, reference.K, _centred(reference.motions)
    joined = joined_motions(motions)
    for this, start, limits in limited_effects(sensor, modelled, data_sheet):
        if not all(this.available(motion) for motion in motions):
            continue
        if this.of_samples:
            columns = columns_of_samples(EffectColumns(this, start, full=True), sensor, joined, K)
        else:
            columns = np.concatenate([this.columns(sensor, motion, K, start) for motion in motions])
        pairs = zip(fit.derivative, fit.weights, columns.transpose(1, 0, 2), strict=True)
        _keep_larger(found, this.name, (sum(J @ (A @ z) for J, A, z in pairs) * limits)[BASE])
    return found


def _centred(motions: Sequence[Motion]) -> list[Motion]:
    """Return the motions with the mean temperature to which effects refer."""
    known = [motion.temperature for motion in motions if motion.temperature is not None]
    shift = REFERENCE_TEMPERATURE - float(np.mean(np.concatenate(known))) if known else 0.0
    return [m if m.temperature is None else replace(m, temperature=m.temperature + shift) for m in motions]


def changes_by_hand(
    model: Model, fitted: FitByHand, gain: Values, modelled: Collection[str], data_sheet: DataSheet
) -> dict[str, Values]:
    """Return the change of bias and matrix by each effect at its limits, (12, p), of a fit to rests and moves.

    ``gain``: of ``gain_of``.
    """
    model = _at_mean_temperature(model)
    warm = bool(np.all(np.isfinite(model.rests.temperature)))
    listed = [
        (this, start, limits)
        for this, start, limits in limited_effects(model.sensor, modelled, data_sheet)
        if ("temperature" not in this.needs or warm) and set(this.needs) <= {"temperature"}
    ]
    equations = model.equations(fitted.state, [EffectColumns(this, start) for this, start, _ in listed])
    found: dict[str, Values] = {}
    for (this, _, limits), columns in zip(listed, equations.candidates, strict=True):
        _keep_larger(found, this.name, gain @ columns * limits)
    return found


def gain_of(model: Model, fitted: FitByHand, place: Values) -> Values:
    """Return the change of bias and matrix by a change of the residuals of rests and moves: (12, n) array.

    ``place``: (12 + e, b + e), from the parameters of the fit to bias, matrix and effects.
    """
    equations = model.equations(fitted.state)
    n, scale = len(equations.residual), max(fitted.hypotheses, key=lambda hypothesis: hypothesis[1])[2]
    white, _ = equations.whitened(fitted.noise, np.column_stack([equations.columns, np.eye(n)]))
    X, root = white[:, :-n], white[:, -n:]
    inverse = scaled_inverse(X.T @ X + scale * np.diag(fitted.precision))
    return np.asarray((place @ inverse @ X.T @ root)[BASE], np.float64)


def _at_mean_temperature(model: Model) -> Model:
    """Return the model with the mean temperature of its rests at the one to which effects refer."""
    mean = np.mean(model.rests.temperature)
    if not np.isfinite(mean):
        return model
    shift, out = REFERENCE_TEMPERATURE - float(mean), copy(model)
    out.rests = replace(model.rests, temperature=model.rests.temperature + shift)
    for name in ("moves", "turns"):
        part = getattr(model, name, None)
        if part is not None:
            setattr(out, name, replace(part, temperature=part.temperature + shift))
    return out


def changes_through_gravity(
    model: GyroscopeModel, fitted: FitByHand, gain: Values, accelerometer: SensorCalibration, data_sheet: DataSheet
) -> dict[str, Values]:
    """Return the change of the gyroscope's bias and matrix by each effect of the accelerometer at its limits, (12, p).

    ``accelerometer``: with the changes of its own bias and matrix. ``gain``: of ``gain_of``. ``data_sheet``: of
    the accelerometer.
    """
    if model.moves is None or not accelerometer.at_limits:
        return {}
    rests, force, M = model.every, model.at_rests.force, accelerometer.matrix
    motion = motion_of(rests.time, force, np.zeros_like(force), rests.temperature, still=True)
    motion = _centred([motion])[0]
    by_force = np.einsum("pn,nmc->pmc", gain[:, model.of_moves], model.by_force(fitted.state))
    K = np.asarray(np.linalg.solve(M, np.eye(3)), np.float64)
    found: dict[str, Values] = {}
    for this, start, limits in limited_effects("accelerometer", (), data_sheet):
        own = accelerometer.at_limits.get(this.name)
        if own is None:
            continue
        z = this.columns("accelerometer", motion, K, start) * limits
        df = np.einsum("ij,mjp->mip", M, z - own[BIAS])
        df += np.stack([(force @ K.T) @ matrix_of(change).T for change in own.T], axis=2)
        _keep_larger(found, OF_ACCELEROMETER + this.name, np.einsum("pmc,mcq->pq", by_force, df))
    return found
