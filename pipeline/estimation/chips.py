"""Estimate rotation, lever arm and time offset between the chips of one board, from readings at the same times.

    w_b = R (w_a + alpha tau_w) + d_w
    f_b = R (f_a + [omega x (omega x r) + alpha x r] / 9.80665 + f' tau_f) + d_f

a is the reference chip, b another one: calibrated specific force f, g, and angular rate w, deg/s (omega in rad/s). R
rotates vectors of a into the axes of b; r, m, is the position of b in the axes of a; a reading of b at t shows the
motion at t + tau; d are differences of the biases. Rows are means over 0.1 s. The noise of the two chips is
independent, so that the signals of b are instrumental variables for the signals of a: the noise of the regressors
causes no bias (Durbin, Rev. Inst. Int. Stat. 22, 1954, 23).

Accelerometers and gyroscopes each give R; the result is their best linear combination. With more than two chips, each
pair has the same regressors, so that the pairs with the reference chip give the joint estimate (Zellner, JASA 57, 1962,
348).

Errors of both calibrations change the readings. Errors that the table causes are the same rotation, shear and scale of
both chips, so that they cancel as far as the chips' axes agree.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy

from pipeline.errors import NotObservableError
from pipeline.estimation.chip_rows import (
    Chip,
    Means,
    blocks_of,
    clear_of,
    columns_of,
    joined,
    lever,
    rows_of,
    shared,
    turned,
)
from pipeline.estimation.engine import LinearMap, assess_noise, scaled_inverse
from pipeline.estimation.gauss_markov import Blocks, Prior
from pipeline.estimation.uncertainty_budget import own_and_bench
from pipeline.model.kinematics import turn_by_vector
from pipeline.records import AXES, SENSORS, Mask, Values

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence


# Weak priors: what a recording does not show keeps them. Sizes of a device (assumption); the group delays of an
# MPU-6050's low-pass filters differ by up to 19 ms (its register map, register 26).
PRIORS = {"rotation": 1.0, "lever_arm": 0.3, "time_offset": 0.02}
OBSERVED = 0.5  # standard uncertainty over that of the prior, above which a parameter is not observable
BY_HAND = 10.0  # times the standard deviation of the gyroscopes' rotation: a hundredth of the weight
SHIFTS, SMALL_SHIFT_S = 4, 1e-6  # rounds in which the stamps of b are moved by its offset; below any uncertainty
ROUNDS, SMALL = 20, 1e-10  # of Gauss-Newton steps; rad


@dataclass(frozen=True)
class Fit:
    """The estimate by one sensor, linear about the rotation at hand."""

    sensor: str
    names: list[str]  # (p,), kinds of the parameters
    step: Values  # (p,)
    map: LinearMap
    residual: Values  # (n, 3)
    scale: float  # standard deviation of a row
    inverse: Values  # (p, p), of the normal equations with the prior


@dataclass(frozen=True)
class Error:
    """One source of error: its covariance (k, k), and its effect on the fits (q, k) and on the chips' axes (3, k)."""

    source: str
    kind: str
    freedom: float
    covariance: Values
    of_fits: Values
    of_axes: Values


@dataclass(frozen=True)
class Estimate:
    """The best linear combination of the fits: rotation from the one at hand, lever arm, time offsets."""

    names: list[str]  # (q,)
    values: Values  # (q,)
    errors: list[Error]  # of these values
    agreement: dict[str, float] | None  # of the rotations by accelerometers and by gyroscopes

    @property
    def covariance(self) -> Values:
        """Of the values: (q, q) array."""
        return np.asarray(sum(e.of_fits @ e.covariance @ e.of_fits.T for e in self.errors))

    @property
    def lever_arm(self) -> Values:
        """In the axes of a, m: (3,) array."""
        return self.values[[i for i, name in enumerate(self.names) if name.startswith("lever_arm")]]


@dataclass(frozen=True)
class Found:
    """The result for two chips: rotation, estimate, fits, which rows are in motion, and the held-out rows."""

    R: Values
    estimate: Estimate
    fits: list[Fit]
    moving: Mask
    held_out: tuple[Means, Means] | None


def place_of(reference: Chip, other: Chip) -> Found:
    """Return the mounting of a chip relative to the reference chip of its board.

    Raises ``NotObservableError`` if the chips share no calibrated sensor, or too little time.
    """
    sensors = [s for s in SENSORS if all(c.calibrations.get(s) is not None for c in (reference, other))]
    if not sensors:
        raise NotObservableError("no sensor is calibrated in both chips")
    recordings, offset = shared(reference, other, sensors), dict.fromkeys(sensors, 0.0)
    for _ in range(SHIFTS):
        used, held_out = rows_of(recordings, offset)
        a, b = joined(used)
        R, clear, fits = _solved(sensors, a, b)
        steps = {fit.sensor: float(fit.step[fit.names.index("time_offset")]) for fit in fits}
        if max(map(abs, steps.values())) < SMALL_SHIFT_S:
            break
        offset = {s: offset[s] + step for s, step in steps.items()}
    on_table = any(r.table_angle is not None or r.table_attitude is not None for r in reference.recordings)
    turning = [clear[k] for k in ("gyroscope", "gyroscope'", "accelerometer'") if k in clear]
    moving = np.any(np.concatenate(turning, axis=1) > 0.0, axis=1)
    blocks = blocks_of([pair[0]["time"] for pair in used])
    estimate = _combined(fits, _errors(fits, R, (a, b), clear, moving, blocks, (reference, other)), on_table=on_table)
    for sensor, shift in offset.items():
        estimate.values[estimate.names.index(f"time_offset_{sensor}")] += shift
    R = R @ turn_by_vector(estimate.values[:3])
    return Found(R, estimate, fits, moving, joined(held_out) if held_out else None)


def _solved(sensors: Sequence[str], a: Means, b: Means) -> tuple[Values, Means, list[Fit]]:
    """Return the rotation at which the fits are linear, which signals are clear of noise, and the fits."""
    R = _first_rotation(a, b, sensors)
    clear = clear_of(a, b, R)
    for _ in range(ROUNDS):
        fits = [_fit(s, R, a, b, clear) for s in sensors]
        weights = [scaled_inverse(fit.inverse[:3, :3]) for fit in fits]
        moments = [W @ fit.step[:3] for W, fit in zip(weights, fits, strict=True)]
        turn = np.linalg.solve(np.sum(weights, axis=0), np.sum(moments, axis=0))
        R = R @ turn_by_vector(turn)
        if np.linalg.norm(turn) < SMALL:
            break
    return R, clear, [_fit(s, R, a, b, clear) for s in sensors]


def vector_of(R: Values) -> Values:
    """Return the vector of a rotation, rad: (3,) array."""
    return np.asarray(scipy.spatial.transform.Rotation.from_matrix(R).as_rotvec())


def _first_rotation(a: Means, b: Means, sensors: Sequence[str]) -> Values:
    """Return the rotation that brings vectors of a nearest to those of b (Wahba's problem, by Markley's SVD)."""
    B = np.sum([m / np.linalg.norm(m) for m in (b[s].T @ a[s] for s in sensors)], axis=0)
    U, _, Vt = np.linalg.svd(B)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)


def _fit(sensor: str, R: Values, a: Means, b: Means, clear: Mapping[str, Values]) -> Fit:
    """Return the estimate by one sensor: instrumental variables with the weak priors."""
    columns = columns_of(sensor, turned(a, np.eye(3), clear))
    X = np.concatenate([c for _, c in columns], axis=2)
    Z = np.concatenate([c for _, c in columns_of(sensor, turned(b, R, clear))], axis=2)
    names = [kind for kind, c in columns for _ in range(c.shape[2])]
    y = b[sensor] @ R - a[sensor]
    prior = np.diag([PRIORS[kind] ** -2 if kind in PRIORS else 0.0 for kind in names])
    products, moment = np.einsum("nci,ncj->ij", Z, X), np.einsum("nci,nc->i", Z, y)
    scale, step = float(np.std(y)), np.zeros(len(names))
    for _ in range(3):  # the prior's weight beside the noise settles at once
        step = np.linalg.solve(products + scale**2 * prior, moment)
        scale = float(np.sqrt(np.mean((y - X @ step) ** 2)))
    inverse = np.linalg.inv(products / scale**2 + prior)
    J = inverse / scale**2
    u, v, w = Z.transpose(1, 2, 0)
    return Fit(sensor, names, step, LinearMap((u, v, w), (J, J, J)), y - X @ step, scale, inverse)


def _errors(  # noqa: PLR0917  (what acts on the fits)
    fits: Sequence[Fit],
    R: Values,
    signals: tuple[Means, Means],
    clear: Mapping[str, Values],
    moving: Mask,
    blocks: Blocks,
    chips: tuple[Chip, Chip],
) -> list[Error]:
    """Return the sources of error of the fits' parameters, one after the other, without the biases."""
    kept = [np.flatnonzero(np.array(fit.names) != "bias") for fit in fits]
    sizes = [len(k) for k in kept]
    place = np.split(np.eye(sum(sizes)), np.cumsum(sizes)[:-1], axis=1)
    found = []
    for fit, k, put in zip(fits, kept, place, strict=True):
        priors = [chip.prior(fit.sensor) for chip in chips]
        prior = Prior(float(np.linalg.norm([p.wander for p in priors])), max(p.time for p in priors))
        design = np.column_stack([np.ones(len(fit.residual)), signals[0][fit.sensor]])
        covariance, freedom = assess_noise(fit.residual, design, blocks, prior).posterior(fit.map).averaged()
        none = np.zeros((3, len(k)))
        source = f"noise of the {fit.sensor}s"
        # what motion alone determines: its noise may be larger than that at rest
        by_motion = (np.array(fit.names)[k] != "rotation") | (fit.sensor == "gyroscope")
        rougher = np.where(by_motion, max(_rms(fit.residual[moving]) / fit.scale, 1.0), 1.0)
        noise = covariance[np.ix_(k, k)] * np.outer(rougher, rougher)
        found.append(Error(source, "A", float(freedom[k].min()), noise, put, none))
        weak = np.array([PRIORS[fit.names[i]] ** -2 for i in k])
        pulled = fit.inverse[np.ix_(k, k)]
        found.append(Error("weak priors", "B", np.inf, pulled @ np.diag(weak) @ pulled.T, put, none))

    def response(of: str, E: Values, who: Sequence[int]) -> Values:
        """Return what ``u + E u`` instead of the truths u of a sensor, in the axes of the reference, does."""
        return np.concatenate(
            [fit.map.of(_change(fit, of, E, R, signals, clear, who))[k] for fit, k in zip(fits, kept, strict=True)]
        )

    for fit in fits:
        of = fit.sensor
        own: list[tuple[str, str, float, Values, list[int]]] = []
        for number, chip in enumerate(chips):
            calibration = chip.calibrations[of]
            assert calibration is not None  # noqa: S101  (of the sensors)
            alone, bench = own_and_bench(calibration)
            nu = float(np.min(calibration.effective_freedom()[3:12]))
            own.append((f"calibration of the {of} of {chip.unit}", "A", nu, alone[3:12, 3:12], [number]))
            if number == 0:
                own.append((f"stated accuracies of the bench, {of}s", "B", np.inf, bench[3:12, 3:12], [0, 1]))
        for source, kind, nu, own_covariance, who in own:
            inverse = np.linalg.inv(matrix_of(chips[who[0]], of))
            shears = [d.reshape(3, 3) @ inverse for d in np.eye(9)]
            if who == [1]:
                shears = [R.T @ E @ R for E in shears]
            of_fits = np.stack([response(of, E, who) for E in shears], axis=1)
            of_axes = np.zeros((3, 9))
            if of == "accelerometer":
                of_axes = np.stack([_axes_change(chips, R, E, who) for E in shears], axis=1)
            found.append(Error(source, kind, nu, own_covariance, of_fits, of_axes))
    return found


def _rms(values: Values) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0


def _change(  # noqa: PLR0917  (as above)
    fit: Fit,
    of: str,
    E: Values,
    R: Values,
    signals: tuple[Means, Means],
    clear: Mapping[str, Values],
    who: Sequence[int],
) -> Values:
    """Return the change of a fit's readings, (n, 3), by errors of the truth of a sensor of one chip, or of both."""
    a, b = signals
    change = np.zeros_like(fit.residual)
    if of == fit.sensor:
        change += (b[of] @ R @ E.T) * (1 in who) - (a[of] @ E.T) * (0 in who)
    if of == "gyroscope" and fit.sensor == "accelerometer" and 0 in who:
        x, r = turned(a, np.eye(3), clear), fit.step[np.array(fit.names) == "lever_arm"]
        wrong = lever(E @ x["turn"] + x["turn"] @ E.T, x["gyroscope'"] @ E.T)
        change -= wrong @ r
    return change


def axes_of(matrix: Values) -> Values:
    """Return the rotation from calibrated axes to those of the chip: x along the accelerometer's x, y in its x-y plane.

    ``matrix^-1 = L C``, L lower triangular. ``matrix``: (3, 3), of the accelerometer.
    """
    q, r = np.linalg.qr(np.linalg.inv(matrix).T)
    return np.asarray((q * np.sign(np.diag(r))).T)


def matrix_of(chip: Chip, sensor: str = "accelerometer") -> Values:
    """Return the matrix of a sensor that is calibrated."""
    calibration = chip.calibrations[sensor]
    assert calibration is not None  # noqa: S101  (of the sensors)
    return calibration.matrix


def axes_between(chips: Sequence[Chip], R: Values, E: Values | None = None, who: Sequence[int] = ()) -> Values:
    """Return the rotation from the axes of a to those of b, where the truths of some are ``u + E u``."""
    C = []
    for k, chip in enumerate(chips):
        wrong = np.zeros((3, 3)) if E is None or k not in who else R @ E @ R.T if k else E
        C.append(axes_of((np.eye(3) + wrong) @ matrix_of(chip)))
    return np.asarray(C[1] @ R @ C[0].T)


def _axes_change(chips: Sequence[Chip], R: Values, E: Values, who: Sequence[int]) -> Values:
    """Return the turn between the chips' axes, in those of a, by truths ``u + E u``: (3,) array."""
    step = 1e-6
    turned = axes_between(chips, R, -step * E, who).T @ axes_between(chips, R, step * E, who)
    return (
        np.array([turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]]) / 4.0 / step
    )


def _combined(fits: Sequence[Fit], errors: Sequence[Error], *, on_table: bool) -> Estimate:
    """Return the best linear estimate by both sensors: one common rotation, and all other parameters.

    By hand the axes of a gyroscope are determined by those of its accelerometer, so that the errors of both rotations
    are correlated. So the gyroscopes' rotation is used only in directions that the accelerometers hardly show.
    """
    names, values, columns = [f"rotation_{a}" for a in AXES], [], []
    for fit in fits:
        kinds = [k for k in fit.names if k != "bias"]
        values.append(fit.step[: len(kinds)])
        own = [f"lever_arm_{AXES[i - 3]}" if k == "lever_arm" else f"{k}_{fit.sensor}" for i, k in enumerate(kinds)]
        names += own[3:]
        columns += [0, 1, 2, *range(len(names) - len(own) + 3, len(names))]
    H = np.eye(len(names))[columns]
    x = np.concatenate(values)
    total = sum(e.of_fits @ e.covariance @ e.of_fits.T for e in errors)
    weighed = np.asarray(total).copy()
    if not on_table and len(fits) > 1:
        second = len(values[0])
        weighed[second : second + 3] *= BY_HAND
        weighed[:, second : second + 3] *= BY_HAND
    W = scaled_inverse(weighed)
    T = np.linalg.solve(H.T @ W @ H, H.T @ W)
    agreement = None
    if len(fits) > 1:
        second = len(values[0])
        D = np.eye(len(x))[:3] - np.eye(len(x))[second : second + 3]
        apart = D @ x
        chi2 = float(apart @ np.linalg.solve(D @ total @ D.T, apart))
        agreement = {
            "angle_deg": float(np.degrees(np.linalg.norm(apart))),
            "p_value": float(scipy.special.chdtrc(3, chi2)),
        }
    return Estimate(names, T @ x, [replace(e, of_fits=T @ e.of_fits) for e in errors], agreement)
