"""Compose the mounting of a chip on its board for ``calibrations/<unit>.json``: values, uncertainties, checks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.estimation.chip_rows import ROW_S, Chip, clear_of, columns_of, turned
from pipeline.estimation.chips import (
    OBSERVED,
    PRIORS,
    Estimate,
    Found,
    axes_between,
    axes_of,
    matrix_of,
    place_of,
    vector_of,
)
from pipeline.estimation.uncertainty_budget import effective_degrees_of_freedom
from pipeline.model.kinematics import turn_by_vector
from pipeline.records import AXES, SENSOR_UNITS, Values, coverage_factor

if TYPE_CHECKING:
    from collections.abc import Sequence


FEWEST_ROWS = 20  # at rest and in motion, whose noise is compared
DOUBTFUL = 0.001  # p-value of the agreement of both rotations, below which it is in doubt (Pearson's chi^2, 3 degrees)
ROUGHER = 2.0  # noise in motion over that at rest, above which the model does not explain the motion
WHY = {
    "rotation": "gravity keeps its direction in the board, and no turn about it is fast enough",
    "lever_arm": "no turn, or none about another axis, is fast enough for this direction",
    "time_offset": "no change of the motion is fast enough",
}
UNITS = {"rotation": "deg", "lever_arm": "m", "time_offset": "s"}


def chip_document(reference: Chip, other: Chip) -> dict[str, Any]:
    """Return the mounting of a chip relative to the reference chip of its board.

    Raises ``NotObservableError`` if the chips share no calibrated sensor, or too little time.
    """
    found = place_of(reference, other)
    document = _estimated(found.R, found.estimate, (reference, other))
    return document | _checks(found) | {"duration_s": round(len(found.moving) * ROW_S, 3)}


def _checks(found: Found) -> dict[str, Any]:
    """Return the residuals of the fits, and doubts about them."""
    doubts, residual, left, agree = [], {}, {}, found.estimate.agreement
    if agree and agree["p_value"] < DOUBTFUL:
        doubts.append(
            f"accelerometers and gyroscopes state rotations that differ by {agree['angle_deg']:.2g} deg (p = "
            f"{agree['p_value']:.1g}): one of the calibrations is wrong in its axes; see the chips' diagnoses"
        )
    for fit in found.fits:
        unit = SENSOR_UNITS[fit.sensor]
        parts = [fit.residual[found.moving], fit.residual[~found.moving]]
        moving, still = (float(np.sqrt(np.mean(p**2))) if len(p) else None for p in parts)
        residual[fit.sensor] = {"unit": unit, "rms": fit.scale, "in_motion": moving, "at_rest": still}
        if moving and still and min(map(len, parts)) >= FEWEST_ROWS and moving > ROUGHER * still:
            doubts.append(
                f"in motion the {fit.sensor}s differ by {moving:.2g} {unit}, at rest by {still:.2g} {unit}: the board "
                "bends, the chips' filters differ, or an effect is missing in a calibration"
            )
        if found.held_out is not None:
            left[fit.sensor] = {"unit": unit} | _left(fit.sensor, found)
    return {"residual": residual, "held_out": left or None, "agreement": agree, "doubts": doubts}


def _left(sensor: str, found: Found) -> dict[str, Any]:
    """Return the rms difference of both chips in held-out rows, with and without the lever arm."""
    a, b = found.held_out or ({}, {})
    columns = dict(columns_of(sensor, turned(a, np.eye(3), clear_of(a, b, found.R))))
    y = b[sensor] @ found.R - a[sensor]
    rms = {"without_lever_arm": float(np.sqrt(np.mean((y - y.mean(axis=0)) ** 2)))}
    if "lever_arm" in columns:
        y = y - columns["lever_arm"] @ found.estimate.lever_arm
    return {"rows": len(y)} | rms | {"difference": float(np.sqrt(np.mean((y - y.mean(axis=0)) ** 2)))}


def _estimated(R: Values, estimate: Estimate, chips: Sequence[Chip]) -> dict[str, Any]:
    """Return rotation, parameters with uncertainties, what is not observable, and the budget."""
    names, own = list(estimate.names), np.eye(len(estimate.names))
    values, of_values, of_axes = estimate.values, np.eye(len(names)), np.zeros((len(names), 3))
    values[:3], of_values[:3, :3] = vector_of(R), _of_vector(R)
    axes = None
    if all(chip.calibrations.get("accelerometer") is not None for chip in chips):
        axes = axes_between(chips, R)
        names += [f"axes_rotation_{a}" for a in AXES]
        values = np.append(values, vector_of(axes))
        turn = axes_of(matrix_of(chips[0]))
        of_values = np.concatenate([of_values, _of_vector(axes) @ turn @ own[:3]])
        of_axes = np.concatenate([of_axes, _of_vector(axes)])
    factor = np.array([np.degrees(1.0) if "rotation" in name else 1.0 for name in names])
    covariance, lines, u = np.zeros((len(names), len(names))), [], []
    for e in estimate.errors:
        G = factor[:, None] * (of_values @ e.of_fits + of_axes @ e.of_axes)
        covariance += (C := G @ e.covariance @ G.T)
        u.append(np.sqrt(np.clip(np.diag(C), 0.0, None)))
        lines.append({"source": e.source, "type": e.kind, "contribution": u[-1].tolist()})
    freedom = effective_degrees_of_freedom(np.array(u), np.array([e.freedom for e in estimate.errors]))
    standard = np.sqrt(np.diag(covariance))
    expanded = coverage_factor(freedom) * standard
    parameters = {}
    for i, name in enumerate(names):
        kind = next(k for k in PRIORS if k in name)
        parameters[name] = {
            "value": float(factor[i] * values[i]),
            "unit": UNITS[kind],
            "standard_uncertainty": float(standard[i]),
            "expanded_uncertainty": float(expanded[i]),
            "observable": bool(standard[i] <= OBSERVED * PRIORS[kind] * factor[i]),
        }
    return {
        "rotation": R.tolist(),
        "axes_rotation": None if axes is None else axes.tolist(),
        "parameters": parameters,
        "covariance": {"parameters": names, "values": covariance.tolist()},
        "not_observable": _not_observable(estimate),
        "uncertainty_budget": lines,
    }


def _of_vector(R: Values) -> Values:
    """Return the derivative of the rotation vector of ``R exp([phi x])`` with respect to phi: (3, 3) array."""
    step, columns = 1e-6, []
    for phi in step * np.eye(3):
        v, w = vector_of(R @ turn_by_vector(-phi)), vector_of(R @ turn_by_vector(phi))
        if v @ w < 0.0:  # both sides of half a turn
            w = w * (1.0 - 2.0 * np.pi / np.linalg.norm(w))
        columns.append((w - v) / (2.0 * step))
    return np.stack(columns, axis=1)


def _not_observable(estimate: Estimate) -> list[dict[str, Any]]:
    """Return the directions of rotation and lever arm, and the time offsets, that the recordings do not show."""
    found = []
    for kind, prior in PRIORS.items():
        place = [i for i, name in enumerate(estimate.names) if name.startswith(kind)]
        for group in [[i] for i in place] if kind == "time_offset" else [place] * bool(place):
            variances, directions = np.linalg.eigh(estimate.covariance[np.ix_(group, group)])
            for variance, direction in zip(variances, directions.T, strict=True):
                if variance > (OBSERVED * prior) ** 2:
                    size = coverage_factor(np.inf) * np.sqrt(variance)
                    along = np.sign(direction[np.argmax(np.abs(direction))]) * direction.round(4)
                    found.append({
                        "parameter": kind if len(group) > 1 else estimate.names[group[0]],
                        "direction": along.tolist() if len(group) > 1 else None,
                        "expanded_uncertainty": float(np.degrees(size) if kind == "rotation" else size),
                        "unit": UNITS[kind],
                        "reason": WHY[kind],
                    })  # fmt: skip
    if not any(name.startswith("lever_arm") for name in estimate.names):
        found.append({
            "parameter": "lever_arm", "direction": None, "expanded_uncertainty": None, "unit": "m",
            "reason": "it needs both sensors of both chips, calibrated",
        })  # fmt: skip
    return found
