"""Estimate the mounting of a chip relative to the reference chip of its board, from readings at the same times.

    w_b = R (w_a + alpha tau_w) + d_w
    f_b = R (f_a + [omega x (omega x r) + alpha x r] / 9.80665 + f' tau_f) + d_f

a is the reference chip, b another one: calibrated specific force f, g, and angular rate w, deg/s (omega in rad/s). R
rotates vectors of a into the axes of b; r, m, is the position of b in the axes of a; a reading of b at t shows the
motion at t + tau; d are differences of the biases. Rows are means over 0.1 s (``chip_fit``). The noise of the two chips
is independent, so that the signals of b are instrumental variables for the signals of a: the noise of the regressors
causes no bias (Durbin, Rev. Inst. Int. Stat. 22, 1954, 23).

Accelerometers and gyroscopes each give R; the result is their best linear combination. With more than two chips, each
pair has the same regressors, so that the pairs with the reference chip give the joint estimate (Zellner, JASA 57, 1962,
348).

Errors of both calibrations change the readings. Errors that the table causes are the same rotation, shear and scale of
both chips, so that they cancel as far as the chips' axes agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from pipeline.core.errors import NotObservableError
from pipeline.core.records import (
    AXES,
    MATRIX,
    SENSOR_UNITS,
    SENSORS,
    SensorCalibration,
    Values,
    coverage_factor,
    standard_uncertainty,
)
from pipeline.estimation.chip_fit import (
    PRIORS,
    ROW_S,
    Chip,
    RotationFit,
    RotationFits,
    clear_of,
    columns_of,
    fit_chips,
    lever,
    turned,
)
from pipeline.estimation.engine import assess_noise, scaled_inverse
from pipeline.estimation.gauss_markov import WanderPrior
from pipeline.estimation.uncertainty_budget import effective_degrees_of_freedom, own_and_bench
from pipeline.physics.kinematics import turn_by_vector

OBSERVED = 0.5  # standard uncertainty over that of the prior, above which a parameter is not observable
ROTATION_DEVIATION_FACTOR = 10.0  # times the standard deviation of the gyroscopes' rotation: a hundredth of the weight
MIN_COMPARED_ROWS = 20  # at rest and in motion, whose noise is compared
# p-value of the agreement of both rotations, below which it is in doubt (Pearson's chi^2, 3 degrees)
DOUBTFUL_P_VALUE = 0.001
ROUGHER = 2.0  # noise in motion over that at rest, above which the model does not explain the motion
SHEAR = 1e-6  # relative, of the differences
WHY = {
    "rotation": "gravity keeps its direction in the board, and no turn about it is fast enough",
    "lever_arm": "no turn, or none about another axis, is fast enough for this direction",
    "time_offset": "no change of the motion is fast enough",
}
MOUNTING_UNITS = {"rotation": "deg", "lever_arm": "m", "time_offset": "s"}


@dataclass(frozen=True)
class ChipError:
    """One source of error: its covariance (k, k), and its effect on the fits (q, k) and on the chips' axes (3, k)."""

    source: str
    kind: str
    freedom: float
    covariance: Values
    of_fits: Values
    of_axes: Values


@dataclass(frozen=True)
class ChipMounting:
    """The best linear combination of the fits: rotation from that of the fits, lever arm, time offsets."""

    names: list[str]  # (q,)
    values: Values  # (q,)
    errors: list[ChipError]  # of these values
    agreement: dict[str, float] | None  # of the rotations by accelerometers and by gyroscopes

    @property
    def covariance(self) -> Values:
        """Of the values: (q, q) array."""
        return np.asarray(sum(e.of_fits @ e.covariance @ e.of_fits.T for e in self.errors))


def chip_document(reference: Chip, other: Chip) -> dict[str, Any]:
    """Return the mounting of a chip relative to the reference chip of its board, for ``calibrations/<unit>.json``.

    Raises ``NotObservableError`` if the chips share no calibrated sensor, or too little time.
    """
    chips = reference, other
    sensors = [s for s in SENSORS if all(chip.calibrations.get(s) is not None for chip in chips)]
    if not sensors:
        raise NotObservableError("no sensor is calibrated in both chips")
    fitted = fit_chips(*chips, sensors)
    on_table = any(r.table_angle is not None or r.table_attitude is not None for r in reference.recordings)
    estimate = _combined(fitted.fits, _errors(fitted, chips), on_table=on_table)
    R = fitted.R @ turn_by_vector(estimate.values[:3])
    document = _estimated(R, estimate, chips) | _checks(fitted, R, estimate)
    return document | {"duration_s": round(len(fitted.moving) * ROW_S, 3)}


def vector_of(R: Values) -> Values:
    """Return the vector of a rotation, rad: (3,) array."""
    return np.asarray(scipy.spatial.transform.Rotation.from_matrix(R).as_rotvec())


def _rms(values: Values) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _errors(fitted: RotationFits, chips: tuple[Chip, Chip]) -> list[ChipError]:
    """Return the sources of error of the fits' parameters, one after the other, without the biases."""
    fits, R, moving = fitted.fits, fitted.R, fitted.moving
    kept = [np.flatnonzero(np.array(fit.names) != "bias") for fit in fits]
    sizes = [len(k) for k in kept]
    places = np.split(np.eye(sum(sizes)), np.cumsum(sizes)[:-1], axis=1)
    errors, none = [], np.zeros((3, 3))
    for fit, k, place in zip(fits, kept, places, strict=True):
        priors = [chip.prior(fit.sensor) for chip in chips]
        prior = WanderPrior(float(np.linalg.norm([p.wander for p in priors])), max(p.time for p in priors))
        design = np.column_stack([np.ones(len(fit.residual)), fitted.rows[0][fit.sensor]])
        covariance, freedom = assess_noise(fit.residual, design, fitted.blocks, prior).posterior(fit.map).averaged()
        # Motion alone determines all but the accelerometers' rotation; its noise may be larger than that at rest.
        by_motion = (np.array(fit.names)[k] != "rotation") | (fit.sensor == "gyroscope")
        in_motion = _rms(fit.residual[moving]) if moving.any() else 0.0
        rougher = np.where(by_motion, max(in_motion / fit.scale, 1.0), 1.0)
        noise = covariance[np.ix_(k, k)] * np.outer(rougher, rougher)
        of_axes, source = np.zeros((3, len(k))), f"noise of the {fit.sensor}s"
        errors.append(ChipError(source, "A", float(freedom[k].min()), noise, place, of_axes))
        weak = np.array([PRIORS[fit.names[i]] ** -2 for i in k])
        pulled = fit.inverse[np.ix_(k, k)]
        errors.append(ChipError("weak priors", "B", np.inf, pulled @ np.diag(weak) @ pulled.T, place, of_axes))
    for of in (fit.sensor for fit in fits):
        # Each error of a matrix is a pair of shears E of the chips in the axes of a: their truths are ``u + E u``.
        sources = []
        for number, chip in enumerate(chips):
            calibration = chip.calibrations[of]
            assert calibration is not None  # noqa: S101  (of the sensors)
            of_unit, of_bench = own_and_bench(calibration)
            freedom_of_unit = float(np.min(calibration.parameters.degrees_of_freedom[MATRIX]))
            shears = [d.reshape(3, 3) @ np.linalg.inv(calibration.matrix) for d in np.eye(9)]
            pairs = [(none, R.T @ E @ R) if number else (E, none) for E in shears]
            sources.append((f"calibration of the {of} of {chip.unit}", "A", freedom_of_unit, of_unit, pairs))
            if number == 0:
                both = [(E, E) for E in shears]
                sources.append((f"stated accuracies of the bench, {of}s", "B", np.inf, of_bench, both))
        for source, kind, degrees, covariance, pairs in sources:
            of_fits = [
                np.concatenate([fit.map.of(_change(fitted, fit, of, *E))[k] for fit, k in zip(fits, kept, strict=True)])
                for E in pairs
            ]
            of_axes = np.zeros((3, 9))
            if of == "accelerometer":
                of_axes = np.stack([_axes_change(chips, R, *E) for E in pairs], axis=1)
            errors.append(
                ChipError(source, kind, degrees, covariance[MATRIX, MATRIX], np.stack(of_fits, axis=1), of_axes)
            )
    return errors


def _change(fitted: RotationFits, fit: RotationFit, of: str, E_a: Values, E_b: Values) -> Values:
    """Return the change of a fit's readings, (n, 3), where the truths of a sensor are sheared."""
    a, b = fitted.rows
    change = np.zeros_like(fit.residual)
    if of == fit.sensor:
        change += b[of] @ fitted.R @ E_b.T - a[of] @ E_a.T
    if of == "gyroscope" and fit.sensor == "accelerometer":
        x, r = turned(a, np.eye(3), fitted.clear), fit.step[np.array(fit.names) == "lever_arm"]
        change -= lever(E_a @ x["turn"] + x["turn"] @ E_a.T, x["gyroscope'"] @ E_a.T) @ r
    return change


def axes_of(matrix: Values) -> Values:
    """Return the rotation from calibrated axes to those of the chip: x along the accelerometer's x, y in its x-y plane.

    ``matrix^-1 = L C``, L lower triangular. ``matrix``: (3, 3), of the accelerometer.
    """
    q, r = np.linalg.qr(np.linalg.inv(matrix).T)
    return np.asarray((q * np.sign(np.diag(r))).T)


def axes_between(chips: Sequence[Chip], R: Values, E_a: Values, E_b: Values) -> Values:
    """Return the rotation from the axes of a to those of b, where the accelerometers' truths are sheared."""
    a, b = (
        axes_of((np.eye(3) + E) @ calibration.matrix)
        for E, calibration in zip((E_a, R @ E_b @ R.T), _accelerometers(chips), strict=True)
    )
    return np.asarray(b @ R @ a.T)


def _accelerometers(chips: Sequence[Chip]) -> list[SensorCalibration]:
    """Return the calibrations of the accelerometers; empty if one of them has none."""
    found = [chip.calibrations.get("accelerometer") for chip in chips]
    return [c for c in found if c is not None] if None not in found else []


def _axes_change(chips: Sequence[Chip], R: Values, E_a: Values, E_b: Values) -> Values:
    """Return the derivative of the rotation between the chips' axes, in those of a, by a pair of shears: (3,) array."""
    less, more = (axes_between(chips, R, step * E_a, step * E_b) for step in (-SHEAR, SHEAR))
    return vector_of(less.T @ more) / (2.0 * SHEAR)


def _combined(fits: Sequence[RotationFit], errors: Sequence[ChipError], *, on_table: bool) -> ChipMounting:
    """Return the best linear estimate by both sensors: one common rotation, and all other parameters.

    By hand the axes of a gyroscope are determined by those of its accelerometer, so that the errors of both rotations
    are correlated. So the gyroscopes' rotation is used only in directions that the accelerometers hardly show.
    """
    names, values, columns = [f"rotation_{a}" for a in AXES], [], []
    for fit in fits:
        kinds = [k for k in fit.names[3:] if k != "bias"]
        values.append(fit.step[: 3 + len(kinds)])
        columns += [0, 1, 2, *range(len(names), len(names) + len(kinds))]
        names += [f"lever_arm_{AXES[i]}" if k == "lever_arm" else f"{k}_{fit.sensor}" for i, k in enumerate(kinds)]
    H, x = np.eye(len(names))[columns], np.concatenate(values)
    total = np.asarray(sum(e.of_fits @ e.covariance @ e.of_fits.T for e in errors))
    agreement, size, second = None, np.ones(len(x)), slice(len(values[0]), len(values[0]) + 3)
    if len(fits) > 1:
        D = np.eye(len(x))[:3] - np.eye(len(x))[second]
        apart = D @ x
        chi2 = float(apart @ np.linalg.solve(D @ total @ D.T, apart))
        angle = float(np.degrees(np.linalg.norm(apart)))
        agreement = {"angle_deg": angle, "p_value": float(scipy.special.chdtrc(3, chi2))}
        size[second] = 1.0 if on_table else ROTATION_DEVIATION_FACTOR
    W = scaled_inverse(total * np.outer(size, size))
    T = np.linalg.solve(H.T @ W @ H, H.T @ W)
    return ChipMounting(names, T @ x, [replace(e, of_fits=T @ e.of_fits) for e in errors], agreement)


def _checks(fitted: RotationFits, R: Values, estimate: ChipMounting) -> dict[str, Any]:
    """Return the residuals of the fits, and doubts about them."""
    doubts, residual, held_out, agree, moving = [], {}, {}, estimate.agreement, fitted.moving
    if agree and agree["p_value"] < DOUBTFUL_P_VALUE:
        doubts.append(
            f"accelerometers and gyroscopes state rotations that differ by {agree['angle_deg']:.2g} deg (p = "
            f"{agree['p_value']:.1g}): one of the calibrations is wrong in its axes; see the chips' diagnoses"
        )
    for fit in fitted.fits:
        unit = SENSOR_UNITS[fit.sensor]
        parts = [fit.residual[moving], fit.residual[~moving]]
        in_motion, at_rest = (_rms(part) if len(part) else None for part in parts)
        residual[fit.sensor] = {"unit": unit, "rms": fit.scale, "in_motion": in_motion, "at_rest": at_rest}
        if in_motion and at_rest and min(map(len, parts)) >= MIN_COMPARED_ROWS and in_motion > ROUGHER * at_rest:
            doubts.append(
                f"in motion the {fit.sensor}s differ by {in_motion:.2g} {unit}, at rest by {at_rest:.2g} {unit}: the "
                "board bends, the chips' filters differ, or an effect is missing in a calibration"
            )
        if fitted.held_out is not None:
            a, b = fitted.held_out
            columns = dict(columns_of(fit.sensor, turned(a, np.eye(3), clear_of(a, b, R))))
            y = b[fit.sensor] @ R - a[fit.sensor]
            held_out[fit.sensor] = {"unit": unit, "rows": len(y), "without_lever_arm": _rms(y - y.mean(axis=0))}
            if "lever_arm" in columns:
                arm = [i for i, name in enumerate(estimate.names) if name.startswith("lever_arm")]
                y = y - columns["lever_arm"] @ estimate.values[arm]
            held_out[fit.sensor]["difference"] = _rms(y - y.mean(axis=0))
    return {"residual": residual, "held_out": held_out or None, "agreement": agree, "doubts": doubts}


def _estimated(R: Values, estimate: ChipMounting, chips: Sequence[Chip]) -> dict[str, Any]:
    """Return rotation, parameters with uncertainties, what is not observable, and the budget."""
    names, axes = list(estimate.names), None
    of_values, of_axes = np.eye(len(names)), np.zeros((len(names), 3))
    values = np.concatenate([vector_of(R), estimate.values[3:]])
    of_values[:3, :3] = _of_vector(R)
    if calibrations := _accelerometers(chips):
        axes = axes_between(chips, R, np.zeros((3, 3)), np.zeros((3, 3)))
        names += [f"axes_rotation_{a}" for a in AXES]
        values = np.append(values, vector_of(axes))
        by_rotation = np.eye(3, len(estimate.names))
        of_values = np.concatenate([of_values, _of_vector(axes) @ axes_of(calibrations[0].matrix) @ by_rotation])
        of_axes = np.concatenate([of_axes, _of_vector(axes)])
    factor = np.array([np.degrees(1.0) if "rotation" in name else 1.0 for name in names])
    covariance, lines, u = np.zeros((len(names), len(names))), [], []
    for e in estimate.errors:
        G = factor[:, None] * (of_values @ e.of_fits + of_axes @ e.of_axes)
        covariance += (C := G @ e.covariance @ G.T)
        u.append(standard_uncertainty(C))
        lines.append({"source": e.source, "type": e.kind, "contribution": u[-1].tolist()})
    freedom = effective_degrees_of_freedom(np.array(u), np.array([e.freedom for e in estimate.errors]))
    standard = np.sqrt(np.diag(covariance))
    expanded = coverage_factor(freedom) * standard
    parameters = {}
    for i, name in enumerate(names):
        kind = next(k for k in PRIORS if k in name)
        parameters[name] = {
            "value": float(factor[i] * values[i]),
            "unit": MOUNTING_UNITS[kind],
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
        if v @ w < 0.0:  # on both sides of half a turn
            w = w * (1.0 - 2.0 * np.pi / np.linalg.norm(w))
        columns.append((w - v) / (2.0 * step))
    return np.stack(columns, axis=1)


def _not_observable(estimate: ChipMounting) -> list[dict[str, Any]]:
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
                        "unit": MOUNTING_UNITS[kind],
                        "reason": WHY[kind],
                    })  # fmt: skip
    if not any(name.startswith("lever_arm") for name in estimate.names):
        found.append({
            "parameter": "lever_arm", "direction": None, "expanded_uncertainty": None, "unit": "m",
            "reason": "it needs both sensors of both chips, calibrated",
        })  # fmt: skip
    return found
