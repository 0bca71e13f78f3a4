"""Estimate the mounting of a chip relative to the reference chip of its board, from readings at the same times.

    w_b = R (w_a + alpha tau_w) + d_w
    f_b = R (f_a + [omega x (omega x r) + alpha x r] / 9.80665 + f' tau_f) + d_f

a is the reference chip, b another one: calibrated specific force f, g, and angular rate w, deg/s (omega in rad/s). R
rotates vectors of a into the axes of b; r, m, is the position of b in the axes of a; a reading of b at t shows the
motion at t + tau; d are differences of the biases. A row is a mean over 0.1 s of f, w, their derivatives by a quintic
spline, and omega omega^T. Samples without a reading, and samples between which the rate changes too fast, are not used.
The noise of the two chips is independent, so that the signals of b are instrumental variables for the signals of a: the
noise of the regressors causes no bias (Durbin, Rev. Inst. Int. Stat. 22, 1954, 23).

Accelerometers and gyroscopes each give R; the result is their best linear combination. Of more than two chips, all
pairs have the same regressors: those with the reference chip give the joint estimate (Zellner, JASA 57, 1962, 348).

Errors of both calibrations change the readings. Errors that the table causes are the same rotation, shear and scale of
both chips, so that they cancel as far as the chips' axes agree.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
import scipy

from pipeline.core.errors import NotObservableError
from pipeline.core.records import (
    AXES,
    MATRIX,
    MEDIAN_SIZE,
    SENSOR_UNITS,
    SENSORS,
    Mask,
    Recording,
    SensorCalibration,
    Values,
    coverage_factor,
    finite_rows,
    noise_of_steps,
    standard_uncertainty,
)
from pipeline.core.settings import Sensor
from pipeline.estimation.engine import LinearMap, assess_noise, scaled_inverse
from pipeline.estimation.gauss_markov import Blocks, WanderPrior
from pipeline.estimation.noise import noise_of, wander_prior
from pipeline.estimation.observations import BIAS_BLOCKS, SHORTEST_BLOCK_S
from pipeline.estimation.uncertainty_budget import effective_degrees_of_freedom, own_and_bench
from pipeline.physics.compensation import Compensation
from pipeline.physics.effects.base import STANDARD_GRAVITY
from pipeline.physics.kinematics import skew, turn_by_vector
from pipeline.physics.signal.rests import runs

ChannelValues: TypeAlias = "dict[str, Values]"
BothChips: TypeAlias = "tuple[ChannelValues, ChannelValues]"

ROW_S = 0.1  # rows: short against moves by hand, of seconds; longer ones lose angular acceleration
LEAST_S = 10.0  # that two chips have in common: twelve blocks of a second separate five columns from noise
CLEAR_SIGNAL_DEVIATIONS = 5.0  # of noise, below which a signal is set to its mean; noise alone never exceeds them
FOLLOWED = 0.1  # fourth difference over the range of five samples, above which sampling does not follow the motion
LEAST_SAMPLES = 12  # of a recording: a quintic spline and its edges
MAX_CHIP_GAP_INTERVALS = 1.5  # sampling intervals
SPLINE_EDGE_SAMPLES = 2  # samples at each end of a stretch, where a spline's derivative errs
# Weak priors, which parameters keep that a recording does not show. Sizes of a device (assumption); the group delays of
# an MPU-6050's low-pass filters differ by up to 19 ms (its register map, register 26).
PRIORS = {"rotation": 1.0, "lever_arm": 0.3, "time_offset": 0.02}
SHIFTS, SMALL_SHIFT_S = 4, 1e-6  # rounds in which the stamps of b are moved by its offset; below any uncertainty
MAX_GAUSS_NEWTON_STEPS, SMALL_STEP_RAD = 20, 1e-10  # of Gauss-Newton steps; rad
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
class Chip:
    """One chip of a board: its recordings, its calibrations, and its sensor model."""

    unit: str
    recordings: Sequence[Recording]
    calibrations: Mapping[str, SensorCalibration | None]
    sensor_model: Sensor


@dataclass(frozen=True)
class Shared:
    """A recording of both chips: stamps, truths by sensor and valid samples, first of the reference chip."""

    held_out: bool
    interval: float
    time: tuple[Values, Values]
    truth: BothChips
    valid: tuple[Mask, Mask]

    def rows(self, offsets: Mapping[str, float]) -> BothChips | None:
        """Return the rows by each chip, the second one's stamps moved by its offsets, s; None: there are none."""
        (time, other_time), (one, two), valid = self.time, self.truth, self.valid[0]
        if any(offsets.values()) or not np.array_equal(time, other_time):
            known = self.valid[1] & np.append(np.diff(other_time) <= MAX_CHIP_GAP_INTERVALS * self.interval, True)
            moved = {}
            for sensor, values in two.items():
                at = time - offsets[sensor]
                moved[sensor] = scipy.interpolate.CubicSpline(other_time, values)(at)
                valid = valid & (np.interp(at, other_time, known, 0.0, 0.0) > 1.0 - 1e-9)
            two = moved
        else:
            valid = valid & self.valid[1]
        for rate in (truth["gyroscope"] for truth in (one, two) if "gyroscope" in truth):
            valid = valid & _followed(rate)
        a, b = (_means(time, truth, valid, self.interval) for truth in (one, two))
        return (a, b) if len(a["time"]) else None


def shared(reference: Chip, other: Chip, sensors: Sequence[str]) -> list[Shared]:
    """Return the recordings of the same name that overlap in time and have all sensors."""
    found = []
    for recording in reference.recordings:
        twin = next((r for r in other.recordings if r.name == recording.name), None)
        if twin is None or min(recording.samples, twin.samples) < LEAST_SAMPLES:
            continue
        complete = all(r.reading(s) is not None for s in sensors for r in (recording, twin))
        if complete and recording.time_ns[0] < twin.time_ns[-1] and twin.time_ns[0] < recording.time_ns[-1]:
            one, valid = _truth(reference, recording, sensors)
            two, known = _truth(other, twin, sensors)
            times, held = (recording.time, twin.time), recording.role == "validation"
            found.append(Shared(held, recording.interval, times, (one, two), (valid, known)))
    return found


def _truth(chip: Chip, recording: Recording, sensors: Sequence[str]) -> tuple[ChannelValues, Mask]:
    """Return the calibrated readings of a chip, and which samples are valid."""
    readings = {s: np.asarray(recording.reading(s)) for s in sensors}
    valid = recording.valid & np.all([finite_rows(v) for v in readings.values()], axis=0)
    given: dict[str, Any] = {s: np.where(valid[:, None], v, 0.0) for s, v in readings.items()}
    compensation = Compensation(chip.calibrations["accelerometer"], chip.calibrations["gyroscope"], chip.unit)
    truth = compensation.apply(**given, temperature=recording.temperature, time=recording.time)
    return {s: np.asarray(getattr(truth, s)) for s in sensors}, np.asarray(valid)


def _followed(rate: Values) -> Mask:
    """Return at which samples the sampling is fast enough for the motion, by the fourth difference: (n,) array."""
    fourth = np.abs(np.diff(rate, 4, axis=0))
    noise = noise_of_steps(np.abs(np.diff(rate, axis=0))) * np.sqrt(70.0)  # 1 + 16 + 36 + 16 + 1
    windows = np.lib.stride_tricks.sliding_window_view(rate, 2 * SPLINE_EDGE_SAMPLES + 1, axis=0)
    lost = np.any((fourth > CLEAR_SIGNAL_DEVIATIONS * noise) & (fourth > FOLLOWED * np.ptp(windows, axis=2)), axis=1)
    spread = np.convolve(np.pad(lost, SPLINE_EDGE_SAMPLES), np.ones(4 * SPLINE_EDGE_SAMPLES + 1), "same")
    return np.asarray(spread < 0.5)


def _means(time: Values, signals: Mapping[str, Values], valid: Mask, interval: float) -> ChannelValues:
    """Return the rows of one chip: time, f, w, their derivatives, and the mean of omega omega^T (n, 3, 3)."""
    k = max(round(ROW_S / interval), 1)
    gaps = np.flatnonzero(np.diff(time) > MAX_CHIP_GAP_INTERVALS * interval) + 1
    rows: dict[str, list[Values]] = {}
    for first, last in runs(valid):
        inner = gaps[(gaps > first) & (gaps < last)]
        for start, stop in zip([first, *inner], [*inner, last], strict=True):
            n = (stop - start - 2 * SPLINE_EDGE_SAMPLES) // k
            if n < 1 or stop - start < 6 + 2 * SPLINE_EDGE_SAMPLES:
                continue
            row = {"time": time[start:stop]}
            for sensor, values in signals.items():
                row[sensor] = values[start:stop]
                row[sensor + "'"] = scipy.interpolate.make_interp_spline(row["time"], row[sensor], k=5)(row["time"], 1)
            if "gyroscope" in row:
                omega = np.radians(row["gyroscope"])
                row["turn"] = omega[:, :, None] * omega[:, None, :]
            for name, values in row.items():
                cut = values[SPLINE_EDGE_SAMPLES : SPLINE_EDGE_SAMPLES + n * k]
                rows.setdefault(name, []).append(cut.reshape(n, k, *cut.shape[1:]).mean(axis=1))
    return {name: np.concatenate(parts) for name, parts in rows.items()} or {"time": np.zeros(0)}


def clear_of(a: ChannelValues, b: ChannelValues, R: Values) -> ChannelValues:
    """Return where components exceed their noise, as 0 and 1; rows of noise alone are not used.

    For the specific force the deviation from its mean is used, because a bias cannot be distinguished from the mean.
    """
    clear = {}
    for name in set(a) & {*SENSORS, *(f"{s}'" for s in SENSORS)}:
        difference = b[name] @ R - a[name]
        noise = MEDIAN_SIZE * np.median(np.abs(difference - np.median(difference, axis=0)), axis=0)
        centre = a[name].mean(axis=0) * (name == "accelerometer")
        clear[name] = (np.abs(a[name] - centre) > CLEAR_SIGNAL_DEVIATIONS * noise).astype(float)
    if "gyroscope" in clear:
        clear["turn"] = clear["gyroscope"][:, :, None] * clear["gyroscope"][:, None, :]
    return clear


def lever(turn: Values, alpha: Values) -> Values:
    """Return the matrices by which a lever arm, m, becomes a specific force, g: (n, 3, 3) array.

    ``turn``: (n, 3, 3), omega omega^T, rad^2/s^2. ``alpha``: (n, 3), deg/s^2.
    """
    square = turn - np.trace(turn, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    return np.asarray((square + skew(np.radians(alpha))) / STANDARD_GRAVITY)


def columns_of(sensor: str, x: ChannelValues) -> list[tuple[str, Values]]:
    """Return the columns of a sensor's fit from the signals of one chip: kind and (n, 3, p) array."""
    columns = [("rotation", -skew(x[sensor]))]
    if sensor == "accelerometer" and "turn" in x:
        columns.append(("lever_arm", lever(x["turn"], x["gyroscope'"])))
    bias = np.tile(np.eye(3), (len(x["time"]), 1, 1))
    return [*columns, ("time_offset", x[sensor + "'"][:, :, None]), ("bias", bias)]


def turned(x: ChannelValues, R: Values, clear: Mapping[str, Values]) -> ChannelValues:
    """Return the signals of a chip in axes that R turns into the chip's axes, where they are clear of noise."""
    signals = {k: R.T @ v @ R if k == "turn" else v @ R if v.ndim == 2 else v for k, v in x.items()}
    level = {k: signals[k].mean(axis=0) if k == "accelerometer" else 0.0 for k in clear}
    return {k: level[k] + (v - level[k]) * clear[k] if k in clear else v for k, v in signals.items()}


@dataclass(frozen=True)
class RotationFit:
    """The estimate by one sensor, linear about the rotation R of ``RotationFits``."""

    sensor: str
    names: list[str]  # (p,), kinds of the parameters
    step: Values  # (p,)
    map: LinearMap
    residual: Values  # (n, 3)
    scale: float  # standard deviation of a row
    inverse: Values  # (p, p), of the normal equations with the prior


@dataclass(frozen=True)
class RotationFits:
    """The fits, which are linear at the rotation R, and the rows of both chips."""

    R: Values
    fits: list[RotationFit]
    rows: BothChips
    clear: ChannelValues  # which signals are clear of noise
    blocks: Blocks  # stretches of time in which the difference of the biases is taken as constant
    held_out: BothChips | None

    @property
    def moving(self) -> Mask:
        """Which rows are in motion."""
        names = [k for k in ("gyroscope", "gyroscope'", "accelerometer'") if k in self.clear]
        return np.asarray(np.any(np.concatenate([self.clear[k] for k in names], axis=1) > 0.0, axis=1))


def fit_chips(reference: Chip, other: Chip, sensors: Sequence[str]) -> RotationFits:
    """Fit each sensor of two chips; raise ``NotObservableError`` if the chips share too little time."""
    recordings, total = shared(reference, other, sensors), dict.fromkeys(sensors, 0.0)
    for _ in range(SHIFTS):
        offset = total
        pairs = [(r.held_out, rows) for r in recordings if (rows := r.rows(offset)) is not None]
        used = [rows for held, rows in pairs if not held]
        common = sum(len(a["time"]) for a, _ in used) * ROW_S
        if common < LEAST_S:
            raise NotObservableError(
                f"the chips have {common:.0f} s in common; expected recordings of the same names and times with the "
                f"same sensors, {LEAST_S:g} s or more without gaps"
            )
        both = _joined(used)
        R, clear, fits = _fitted(sensors, both)
        steps = {fit.sensor: fit.step[fit.names.index("time_offset")] for fit in fits}
        total = {s: offset[s] + float(step) for s, step in steps.items()}
        if max(map(abs, steps.values())) < SMALL_SHIFT_S:
            break
    for fit in fits:
        fit.step[fit.names.index("time_offset")] = total[fit.sensor]
    held_out = [rows for held, rows in pairs if held]
    times = [a["time"] for a, _ in used]
    span = sum(float(np.ptp(t)) for t in times)
    length = max(min(SHORTEST_BLOCK_S, span / 12.0), span / BIAS_BLOCKS)
    blocks = Blocks.of_rows([(t, np.ones(len(t))) for t in times], range(len(times)), length)
    return RotationFits(R, fits, both, clear, blocks, _joined(held_out) if held_out else None)


def _joined(pairs: Sequence[BothChips]) -> BothChips:
    a, b = ({k: np.concatenate([pair[chip][k] for pair in pairs]) for k in pairs[0][chip]} for chip in (0, 1))
    return a, b


def _fitted(sensors: Sequence[str], rows: BothChips) -> tuple[Values, ChannelValues, list[RotationFit]]:
    """Return the rotation at which the fits are linear, which signals are clear of noise, and the fits.

    The start is the rotation that maps the vectors of a best onto the vectors of b (Wahba's problem, Markley's SVD).
    """
    a, b = rows
    U, _, Vt = np.linalg.svd(np.sum([m / np.linalg.norm(m) for m in (b[s].T @ a[s] for s in sensors)], axis=0))
    R = np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)
    clear = clear_of(a, b, R)
    for _ in range(MAX_GAUSS_NEWTON_STEPS):
        fits = [_fit(s, R, a, b, clear) for s in sensors]
        weights = [scaled_inverse(fit.inverse[:3, :3]) for fit in fits]
        moments = [W @ fit.step[:3] for W, fit in zip(weights, fits, strict=True)]
        turn = np.linalg.solve(np.sum(weights, axis=0), np.sum(moments, axis=0))
        R = R @ turn_by_vector(turn)
        if np.linalg.norm(turn) < SMALL_STEP_RAD:
            break
    return R, clear, [_fit(s, R, a, b, clear) for s in sensors]


def _fit(sensor: str, R: Values, a: ChannelValues, b: ChannelValues, clear: Mapping[str, Values]) -> RotationFit:
    """Return the estimate by one sensor: instrumental variables with the weak priors."""
    columns = columns_of(sensor, turned(a, np.eye(3), clear))
    X = np.concatenate([c for _, c in columns], axis=2)
    Z = np.concatenate([c for _, c in columns_of(sensor, turned(b, R, clear))], axis=2)
    names = [kind for kind, c in columns for _ in range(c.shape[2])]
    y = b[sensor] @ R - a[sensor]
    prior = np.diag([PRIORS[kind] ** -2 if kind in PRIORS else 0.0 for kind in names])
    products, moment = np.einsum("nci,ncj->ij", Z, X), np.einsum("nci,nc->i", Z, y)
    scale, step = float(np.std(y)), np.zeros(len(names))
    for _ in range(3):  # of the weight of the prior against the noise
        step = np.linalg.solve(products + scale**2 * prior, moment)
        scale = float(np.sqrt(np.mean((y - X @ step) ** 2)))
    inverse = np.linalg.inv(products / scale**2 + prior)
    J = inverse / scale**2
    u, v, w = Z.transpose(1, 2, 0)
    return RotationFit(sensor, names, step, LinearMap((u, v, w), (J, J, J)), y - X @ step, scale, inverse)


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


def _covariance(errors: Sequence[ChipError]) -> Values:
    """Return the covariance of the fits' parameters, or of their combination, by all sources: (q, q) array."""
    return np.asarray(sum(e.of_fits @ e.covariance @ e.of_fits.T for e in errors))


def _errors(fitted: RotationFits, chips: tuple[Chip, Chip]) -> list[ChipError]:
    """Return the sources of error of the fits' parameters, one after the other, without the biases."""
    fits, R, moving = fitted.fits, fitted.R, fitted.moving
    kept = [np.flatnonzero(np.array(fit.names) != "bias") for fit in fits]
    sizes = [len(k) for k in kept]
    places = np.split(np.eye(sum(sizes)), np.cumsum(sizes)[:-1], axis=1)
    errors, none = [], np.zeros((3, 3))
    for fit, k, place in zip(fits, kept, places, strict=True):
        sheets = [(chip, chip.sensor_model.of(fit.sensor)) for chip in chips]
        priors = [wander_prior(noise_of(fit.sensor, chip.recordings, sheet), sheet) for chip, sheet in sheets]
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
            every = list(zip(fits, kept, strict=True))
            of_fits = [np.concatenate([fit.map.of(_change(fitted, fit, of, *E))[k] for fit, k in every]) for E in pairs]
            of_axes = np.zeros((3, 9))
            for column, (E_a, E_b) in enumerate(pairs if of == "accelerometer" else []):
                less, more = (axes_between(chips, R, step * E_a, step * E_b) for step in (-SHEAR, SHEAR))
                of_axes[:, column] = vector_of(less.T @ more) / (2.0 * SHEAR)  # in the axes of a
            C = covariance[MATRIX, MATRIX]
            errors.append(ChipError(source, kind, degrees, C, np.stack(of_fits, axis=1), of_axes))
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
    pairs = zip((E_a, R @ E_b @ R.T), _accelerometers(chips), strict=True)
    a, b = (axes_of((np.eye(3) + E) @ calibration.matrix) for E, calibration in pairs)
    return np.asarray(b @ R @ a.T)


def _accelerometers(chips: Sequence[Chip]) -> list[SensorCalibration]:
    """Return the calibrations of the accelerometers; empty if one of them has none."""
    found = [chip.calibrations.get("accelerometer") for chip in chips]
    return [c for c in found if c is not None] if None not in found else []


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
    H, x, total = np.eye(len(names))[columns], np.concatenate(values), _covariance(errors)
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
    changes = [factor[:, None] * (of_values @ e.of_fits + of_axes @ e.of_axes) for e in estimate.errors]
    parts = np.array([G @ e.covariance @ G.T for G, e in zip(changes, estimate.errors, strict=True)])
    u, covariance = standard_uncertainty(parts), parts.sum(axis=0)
    freedom = effective_degrees_of_freedom(u, np.array([e.freedom for e in estimate.errors]))
    standard, of_sources = np.sqrt(np.diag(covariance)), zip(estimate.errors, u.tolist(), strict=True)
    expanded = coverage_factor(freedom) * standard
    parameters = {}
    for i, name in enumerate(names):
        kind = next(k for k in PRIORS if k in name)
        observable = bool(standard[i] <= OBSERVED * PRIORS[kind] * factor[i])
        about = {"value": float(factor[i] * values[i]), "unit": MOUNTING_UNITS[kind]}
        of_u = {"standard_uncertainty": float(standard[i]), "expanded_uncertainty": float(expanded[i])}
        parameters[name] = {**about, **of_u, "observable": observable}
    budget = [{"source": e.source, "type": e.kind, "contribution": each} for e, each in of_sources]
    found = {"rotation": R.tolist(), "axes_rotation": None if axes is None else axes.tolist(), "parameters": parameters}
    found |= {"covariance": {"parameters": names, "values": covariance.tolist()}}
    return found | {"not_observable": _not_observable(estimate), "uncertainty_budget": budget}


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
    found, total = [], _covariance(estimate.errors)
    for kind, prior in PRIORS.items():
        place = [i for i, name in enumerate(estimate.names) if name.startswith(kind)]
        for group in [[i] for i in place] if kind == "time_offset" else [place] * bool(place):
            variances, directions = np.linalg.eigh(total[np.ix_(group, group)])
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
