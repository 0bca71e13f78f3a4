"""Compute the errors that a method's approximations cause, from a free fit of the same recordings.

A method states ``truth = M (reading - b_m - z_m)``. The free fit predicts the reading by bias b, matrix K and effects
z. In a motion u that the recording's filter turns into u_f, with E = M K - 1, the calibrated reading is wrong by

    M (b - b_m) [bias]  +  E u_f [diagonal: scale_factor; symmetric part off it: non_orthogonality, half of the angle by
    which two axes depart from 90 deg; antisymmetric: rotation]  +  M (z - z_m) [two_sided]  +  u_f - u [filter_delay]

Each error e_k has the share ``mean(e_k^2) / sum_j mean(e_j^2)``, also of the error of the magnitude, ``|u_f + e_k| -
|u_f|``, for the filter ``|u_f| - |u(t - delay)|``. An error is named if it exceeds
``SIGNIFICANT_METHOD_ERROR`` standard uncertainties of both fits and a fiftieth of either error. Both fits count as
independent, which never makes the uncertainty too small.
If an effect is missing, bias and sides are not compared, since the effect shifts both in the method's fit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from pipeline.core.records import (
    BASE,
    BASE_COUNT,
    BIAS,
    MethodError,
    Motion,
    Recording,
    SensorCalibration,
    Values,
    matrix_of,
)
from pipeline.core.settings import Settings, Table
from pipeline.estimation.generalized_least_squares import JointFit, fit_terms
from pipeline.estimation.observations import filtered_motion
from pipeline.estimation.selection import Selection
from pipeline.estimation.stages import declarations
from pipeline.evaluation.diagnosis.words import template
from pipeline.physics.effects import effect_of
from pipeline.physics.effects.base import truth, unit_of
from pipeline.physics.kinematics import table_motion

MIN_MEAN_SQUARE_SHARE = 0.02  # of the mean square: a smaller part adds less than 1 % to the rms error
# standard uncertainties: 9 elements of 10^4 units exceed them by chance less than once in 10
SIGNIFICANT_METHOD_ERROR = 5.0


def method_errors(
    calibration: SensorCalibration, selection: Selection, recordings: Sequence[Recording], settings: Settings
) -> list[MethodError]:
    """Return the errors by the method's approximations, the largest share first; none if it is the free fit.

    ``selection``: the free fit. ``recordings``: all of the unit, filtered. Entries: ``name, meaning, size, unit, share,
    rms`` on the recordings of the fit (rms in the unit of the sensor), ``held_out_share`` and
    ``held_out_magnitude_share`` (or None).
    """
    stages = [*declarations(calibration).values()]
    if not stages or stages[-1].reference:
        return []
    free, names = selection.base, [effect.name for effect in calibration.effects]
    fitted = {term.effect.name for term in free.terms}
    more = [t for t in selection.fit.terms if t.effect.name in names and t.effect.name not in fitted]
    if more:
        free = fit_terms(selection.observations, [*free.terms, *more], free, selection.settings)
    of_free = free.covariance, np.kron(calibration.matrix, np.eye(3))
    difference = _Difference(calibration, free.bias, free.K, of_free, settings)
    of_roles = ([r for r in recordings if r.role == role] for role in (calibration.sensor, "validation"))
    of_turns, of_held_out = (_errors(difference, free, each, settings.table) for each in of_roles)
    shares = {
        "held_out_share": _shares({name: of_vector for name, (of_vector, _) in of_held_out.items()}),
        "held_out_magnitude_share": _shares({name: of_size for name, (_, of_size) in of_held_out.items()}),
    }
    rms = {name: of_vector for name, (of_vector, _) in of_turns.items()}
    return _named(difference, rms, recordings, selection.names, shares, printed=settings.method.as_printed)


def given_differences(
    calibration: SensorCalibration,
    free_fit: Callable[[], SensorCalibration],
    recordings: Sequence[Recording],
    settings: Settings,
) -> list[MethodError]:
    """Return the differences of a given calibration from a free fit of rests and moves by hand, as ``method_errors``.

    They are bias and the symmetric part of E, since by hand the sensor's axes have no relation to a body. Shares are
    those of a truth of any direction, 1 g or the rms rate of the recordings. None for a method that fits.
    """
    if [stage.name for stage in calibration.stages] != ["given"]:
        return []
    free = free_fit()
    K = np.asarray(np.linalg.inv(free.matrix), np.float64)
    of_free = free.covariance, np.kron(calibration.matrix @ K, K.T)
    difference = _Difference(calibration, free.bias, K, of_free, settings)
    del difference.matrices["rotation"]
    rates = [np.sum(w**2, axis=1) for r in recordings if (w := r.reading("gyroscope")) is not None]
    size = 1.0 if calibration.sensor == "accelerometer" else float(np.sqrt(np.nanmean(np.concatenate(rates))))
    rms = {"bias": float(np.linalg.norm(difference.bias))}
    rms |= {name: size * float(np.linalg.norm(part)) / np.sqrt(3.0) for name, part in difference.matrices.items()}
    return _named(difference, rms, recordings)


class _Difference:
    """The difference of a method's calibration from a free fit, of bias b and matrix K.

    ``of_free``: covariance of the free fit's bias and matrix, and (9, 9) derivative of E to this matrix.
    """

    def __init__(
        self, method: SensorCalibration, b: Values, K: Values, of_free: tuple[Values | None, Any], settings: Settings
    ) -> None:
        M, variance = method.matrix, np.zeros(BASE_COUNT)
        for covariance, derivative in (of_free, (_covariance(method, settings), np.kron(np.eye(3), K.T))):
            if covariance is not None:
                J = block_diag(M, derivative)
                variance += np.diag(J @ covariance[BASE, BASE] @ J.T)
        E = M @ K - np.eye(3)
        diagonal = np.diag(np.diag(E))
        parts = {"scale_factor": diagonal, "non_orthogonality": 0.5 * (E + E.T) - diagonal, "rotation": 0.5 * (E - E.T)}
        self.method, self.bias = method, M @ (b - method.bias)
        self.matrices: dict[str, Values] = parts
        self.uncertainty = np.sqrt(np.clip(variance, 0.0, None))  # (12,), of bias and E

    def errors(self, motion: Motion, free: JointFit) -> dict[str, Values]:
        """Return the error of the calibrated reading by cause, without that of the filter: (n, 3) arrays."""
        u, added = truth(self.method.sensor, motion), np.zeros((len(motion.time), 3))
        fitted = {term.effect.name: term.values for term in free.terms}
        for effect in self.method.effects:
            this = effect_of(effect)
            if not this.moves and this.available(motion):
                added -= this.reading(self.method.sensor, motion, free.K, effect.values)
                if effect.name in fitted:
                    added += this.reading(self.method.sensor, motion, free.K, fitted[effect.name])
        of_matrix = {name: u @ matrix.T for name, matrix in self.matrices.items()}
        return {"bias": np.broadcast_to(self.bias, u.shape), **of_matrix, "two_sided": added @ self.method.matrix.T}

    def certain(self, selected: Sequence[str]) -> dict[str, bool]:
        """Return which parts exceed the noise of the two fits."""
        u = matrix_of(self.uncertainty)
        least = SIGNIFICANT_METHOD_ERROR * np.where(np.eye(3) > 0.0, u, np.hypot(u, u.T) / 2.0)
        complete = {effect.name for effect in self.method.effects}.issuperset(selected)
        of_bias = complete and bool(np.any(np.abs(self.bias) > SIGNIFICANT_METHOD_ERROR * self.uncertainty[BIAS]))
        of_matrix = {name: bool(np.any(np.abs(matrix) > least)) for name, matrix in self.matrices.items()}
        return {"two_sided": complete, "bias": of_bias, **of_matrix}


def _covariance(calibration: SensorCalibration, settings: Settings) -> Values:
    """Return the covariance of bias and matrix: (12, 12).

    If a given calibration states none, its bias varies by at least the wander of the sensor file.
    """
    covariance = calibration.parameters.covariance[BASE, BASE]
    if covariance.any() or [stage.name for stage in calibration.stages] != ["given"]:
        return covariance
    covariance = np.zeros_like(covariance)
    covariance[BIAS, BIAS] = settings.sensor.of(calibration.sensor).bias_wander ** 2 * np.eye(3)
    return covariance


def _errors(
    difference: _Difference, free: JointFit, recordings: Sequence[Recording], table: Table
) -> dict[str, tuple[float, float]]:
    """Return the rms error by cause in the recordings with a known motion: of the vector, and of the magnitude."""
    sensor = difference.method.sensor
    found: dict[str, list[tuple[Values, Values]]] = {}
    for recording in recordings:
        before = table_motion(recording, table)
        if recording.samples < 6 or recording.reading(sensor) is None or before is None:
            continue
        filtered = recording.filter["name"] != "none"
        motion = filtered_motion(replace(before, at_offset=None, at_lag=None), recording) if filtered else before
        u = truth(sensor, motion)
        size = np.linalg.norm(u, axis=1)
        for name, error in difference.errors(motion, free).items():
            found.setdefault(name, []).append((error, np.linalg.norm(u + error, axis=1) - size))
        if filtered:
            unfiltered = truth(sensor, before)
            late = recording.time - float(recording.filter.get("delay_s", 0.0))
            delayed = np.interp(late, recording.time, np.linalg.norm(unfiltered, axis=1))
            found.setdefault("filter_delay", []).append((u - unfiltered, size - delayed))
    return {name: (_rms([v for v, _ in errors]), _rms([m for _, m in errors])) for name, errors in found.items()}


def _shares(rms: Mapping[str, float]) -> dict[str, float]:
    total = sum(size**2 for size in rms.values())
    return {name: size**2 / total for name, size in rms.items()} if total > 0.0 else {}


def _rms(parts: Sequence[Values]) -> float:
    errors = np.concatenate(parts)
    return float(np.sqrt(np.sum(errors**2) / len(errors)))


def _named(
    difference: _Difference,
    rms: Mapping[str, float],
    recordings: Sequence[Recording],
    selected: Sequence[str] = (),
    held_out: Mapping[str, Mapping[str, float]] | None = None,
    *,
    printed: bool = False,
) -> list[MethodError]:
    """Return the entries of significant errors, the largest share first; ``held_out``: shares by key and name."""
    held_out = held_out or {"held_out_share": {}, "held_out_magnitude_share": {}}
    certain, sensor = difference.certain(selected), difference.method.sensor
    stages = [stage.name for stage in difference.method.stages]
    filters = [r.filter for r in recordings if r.filter["name"] != "none"] or [{"name": "none"}]
    delay = max(float(each.get("delay_s", 0.0)) for each in filters)
    meaning = template("method_errors.txt").module.meaning  # type: ignore[attr-defined]
    found = [
        MethodError(
            name,
            " ".join(meaning(name, sensor, stages, printed, filters[0]["name"], delay).split()),
            *_size(name, difference, rms[name], recordings),
            share,
            rms[name],
            *(shares.get(name) for shares in held_out.values()),
        )
        for name, share in _shares(rms).items()
        if max(share, held_out["held_out_magnitude_share"].get(name, 0.0)) > MIN_MEAN_SQUARE_SHARE
        and certain.get(name, True)
    ]
    return sorted(found, key=lambda error: -error.share)


def _size(name: str, difference: _Difference, rms: float, recordings: Sequence[Recording]) -> tuple[float, str]:
    sensor = difference.method.sensor
    if name == "bias":
        return float(np.abs(difference.bias).max()), unit_of(sensor)
    if name == "scale_factor":
        return float(np.abs(difference.matrices[name]).max()), "1"
    if name in difference.matrices:
        return float(np.degrees(np.abs(difference.matrices[name]).max())), "deg"
    if name == "filter_delay":
        turns = [(r, rate) for r in recordings if r.role == sensor and (rate := r.logged_rate) is not None]
        angles = [float(np.abs(rate).max() * r.filter.get("delay_s", 0.0)) for r, rate in turns]
        return max(angles, default=0.0), "deg"
    return rms, unit_of(sensor)
