"""Whether the matrix of a calibration holds on held-out motion, element by element.

The magnitude of a held-out error hides a small error of the matrix in the noise of single samples. Calibrated readings
v of held-out motion whose reference u is a vector show it: with E the error of the matrix,

    v = e + (1 + E) u,    T = E^T C^-1 E,    C = C_held + S C_fit S^T

E is fitted as a calibration is (``pipeline.estimation.reference_least_squares``), with the covariance C_held of its
nine elements; C_fit is that of the calibration's parameters, and S what they change in E. T / 9 has Fisher's
distribution with 9 degrees of freedom and the effective ones of the less certain fit. Errors of local gravity and of
the time base are in calibration and reference alike.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import CannotCalibrateError, NotObservableError
from pipeline.estimation import reference_least_squares
from pipeline.estimation.uncertainty_budget import covariance_beside_reference
from pipeline.io.quality_flags import STUCK
from pipeline.model.effects import bench_priors, effect_of
from pipeline.records import AXES, Motion
from pipeline.validation.error_breakdown import direction_known, last_step
from pipeline.validation.expected_error import linearized

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.records import Noise, Recording, SensorCalibration
    from pipeline.validation.samples import Samples

SLOPES = slice(3, 12)  # of bias and matrix: the elements of the matrix


def agreement(  # noqa: PLR0917  (as ``validate``)
    calibration: SensorCalibration,
    recordings: Sequence[Recording],
    held_out: Sequence[Samples],
    noise: Noise,
    settings: Mapping[str, Any],
    other: SensorCalibration | None,
) -> dict[str, Any] | None:
    """Return ``p_value``, and of the element that differs most ``reads``, ``of``, ``error`` and its U.

    None where no held-out motion has a vector reference, the method holds elements of the matrix fixed, a filter was
    applied, or an effect moves the motion in time. ``held_out``: the samples of the held-out recordings. ``settings``:
    sections ``table`` and ``sensor``.
    """
    sensor, table = calibration.sensor, settings["table"]
    of_method = any(stage.name == reference_least_squares.NAME for stage in calibration.stages)
    held = [r for r in recordings if r.role == "validation" and r.reading(sensor) is not None]
    vectors = all(r.table_attitude is not None and r.filter["name"] == "none" for r in held)
    moved = any(effect_of(fitted).moves for fitted in calibration.effects)
    if not (of_method and held and vectors and calibration.covariance is not None) or moved:
        return None
    if len(held_out) < len(held) or any(samples.resting for samples in held_out):
        return None
    calibrated, slopes, count = [], np.zeros((9, len(calibration.covariance))), 0
    for recording, samples in zip(held, held_out, strict=True):
        found = last_step(calibration, samples, other)
        if found is None or found[2] is None or not direction_known(calibration, samples):
            return None
        part = linearized(calibration, samples, found[2], other)
        if part is None:
            return None
        rows = np.isfinite(part.truth).all(axis=1)
        columns = np.column_stack([np.ones(np.count_nonzero(rows)), part.truth[rows]])
        per_parameter = np.einsum("jn,nip->ijp", np.linalg.pinv(columns)[1:], part.derivative[rows])
        slopes += part.number * per_parameter.reshape(9, -1)
        count += part.number
        known = samples.known & np.isfinite(np.hstack([found[0], found[2]])).all(axis=1)
        flags = np.zeros(len(known), np.uint16) if recording.flags is None else recording.flags
        flags = np.where(known, flags, flags | STUCK)
        values: dict[str, Any] = {"role": sensor, "flags": flags, sensor: np.nan_to_num(found[0])}
        calibrated.append(replace(recording, **values))
        calibrated[-1].cache.update({key: at for key, at in recording.cache.items() if isinstance(at, Motion)})
    rest = [r for r in recordings if r.role == "static"]
    plain = {"table": {**table, **dict.fromkeys(bench_priors().values())}, "sensor": settings.get("sensor") or {}}
    try:
        fit = reference_least_squares.fit(sensor, [*calibrated, *rest], None, plain | {"noise": {sensor: noise}})
    except (CannotCalibrateError, NotObservableError):
        return None
    slopes /= count
    error = np.linalg.inv(fit.matrix).ravel() - np.eye(3).ravel()
    C = covariance_beside_reference(fit)[SLOPES, SLOPES]
    C += slopes @ covariance_beside_reference(calibration) @ slopes.T
    freedom = min(float(np.min(each.effective_freedom()[SLOPES])) for each in (fit, calibration))
    from scipy.special import fdtrc  # noqa: PLC0415  (held-out motion with a vector reference alone asks for it)

    p_value = float(fdtrc(9, min(freedom, 1e9), float(error @ np.linalg.solve(C, error)) / 9.0))
    u = np.sqrt(np.diag(C))
    worst = int(np.argmax(np.abs(error) / u))
    axes = {"reads": AXES[worst // 3], "of": AXES[worst % 3]}
    return {"p_value": p_value, **axes, "error": float(error[worst]), "expanded_uncertainty": 2.0 * float(u[worst])}
