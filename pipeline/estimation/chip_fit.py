"""Fit rotation, lever arm and time offset between two chips of a board, for each sensor, from simultaneous readings.

A row is a mean over 0.1 s of calibrated specific force f, g, and rate w, deg/s, of their derivatives by a quintic
spline, and of omega omega^T. Samples without a reading, and samples between which the rate changes too fast, are not
used. The fit is by instrumental variables; ``chips`` has the equations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import scipy

from pipeline.core.errors import NotObservableError
from pipeline.core.records import MEDIAN_SIZE, SENSORS, Mask, Recording, SensorCalibration, Values, noise_of_steps
from pipeline.core.settings import Sensor
from pipeline.estimation.engine import LinearMap, scaled_inverse
from pipeline.estimation.gauss_markov import Blocks, WanderPrior
from pipeline.estimation.noise import noise_of, wander_prior
from pipeline.estimation.observations import BIAS_BLOCKS, SHORTEST_BLOCK_S
from pipeline.physics.compensation import Compensation
from pipeline.physics.effects.base import STANDARD_GRAVITY
from pipeline.physics.kinematics import skew, turn_by_vector

ChannelValues: TypeAlias = "dict[str, Values]"

ROW_S = 0.1  # rows: short against moves by hand, of seconds; longer ones lose angular acceleration
LEAST_S = 10.0  # that two chips have in common: twelve blocks of a second separate five columns from noise
# standard deviations of noise, below which a signal is set to its mean; noise alone never exceeds them
CLEAR_SIGNAL_DEVIATIONS = 5.0
FOLLOWED = 0.1  # fourth difference over the range of five samples, above which sampling does not follow the motion
LEAST_SAMPLES = 12  # of a recording: a quintic spline and its edges
MAX_CHIP_GAP_INTERVALS = 1.5  # sampling intervals
SPLINE_EDGE_SAMPLES = 2  # samples at each end of a stretch, where a spline's derivative errs
# Weak priors, which parameters keep that a recording does not show. Sizes of a device (assumption); the group delays of
# an MPU-6050's low-pass filters differ by up to 19 ms (its register map, register 26).
PRIORS = {"rotation": 1.0, "lever_arm": 0.3, "time_offset": 0.02}
SHIFTS, SMALL_SHIFT_S = 4, 1e-6  # rounds in which the stamps of b are moved by its offset; below any uncertainty
MAX_GAUSS_NEWTON_STEPS, SMALL_STEP_RAD = 20, 1e-10  # of Gauss-Newton steps; rad


@dataclass(frozen=True)
class Chip:
    """One chip of a board: its recordings, its calibrations, and its sensor model."""

    unit: str
    recordings: Sequence[Recording]
    calibrations: Mapping[str, SensorCalibration | None]
    sensor_model: Sensor

    def prior(self, sensor: str) -> WanderPrior:
        """Return the prior of the wander of its bias."""
        data_sheet = self.sensor_model.of(sensor)
        return wander_prior(noise_of(sensor, self.recordings, data_sheet), data_sheet)


@dataclass(frozen=True)
class Shared:
    """A recording of both chips: stamps, truths by sensor and valid samples, first of the reference chip."""

    held_out: bool
    interval: float
    time: tuple[Values, Values]
    truth: tuple[ChannelValues, ChannelValues]
    valid: tuple[Mask, Mask]

    def rows(self, offsets: Mapping[str, float]) -> tuple[ChannelValues, ChannelValues] | None:
        """Return the rows by each chip, the second one's stamps moved by its offsets, s; None: there are none."""
        (time, other_time), (one, two), valid = self.time, self.truth, self.valid[0]
        if any(offsets.values()) or not np.array_equal(time, other_time):
            known = (
                self.valid[1] & np.append(np.diff(other_time) <= MAX_CHIP_GAP_INTERVALS * self.interval, True)
            ).astype(float)
            moved = {}
            for sensor, values in two.items():
                at = time - offsets[sensor]
                moved[sensor] = scipy.interpolate.CubicSpline(other_time, values)(at)
                valid = valid & (np.interp(at, other_time, known, 0.0, 0.0) > 1.0 - 1e-9)
            two = moved
        else:
            valid = valid & self.valid[1]
        for truth in (one, two):
            if "gyroscope" in truth:
                valid = valid & _followed(truth["gyroscope"])
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
            held, times = recording.role == "validation", (recording.time, twin.time)
            found.append(Shared(held, recording.interval, times, (one, two), (valid, known)))
    return found


def _truth(chip: Chip, recording: Recording, sensors: Sequence[str]) -> tuple[ChannelValues, Mask]:
    """Return the calibrated readings of a chip, and which samples are valid."""
    readings = {s: np.asarray(recording.reading(s)) for s in sensors}
    valid = recording.valid & np.all([np.isfinite(v).all(axis=1) for v in readings.values()], axis=0)
    given: dict[str, Any] = {s: np.where(valid[:, None], v, 0.0) for s, v in readings.items()}
    compensation = Compensation(chip.calibrations["accelerometer"], chip.calibrations["gyroscope"], chip.unit)
    truth = compensation.apply(**given, temperature=recording.temperature, time=recording.time)
    return {s: np.asarray(getattr(truth, s)) for s in sensors}, np.asarray(valid)


def _followed(rate: Values) -> Mask:
    """Return at which samples the sampling is fast enough for the motion, by the fourth difference: (n,) array."""
    if len(rate) < 2 * SPLINE_EDGE_SAMPLES + 1:
        return np.zeros(len(rate), bool)
    fourth = np.abs(np.diff(rate, 4, axis=0))
    noise = noise_of_steps(np.abs(np.diff(rate, axis=0))) * np.sqrt(70.0)  # 1 + 16 + 36 + 16 + 1
    windows = np.lib.stride_tricks.sliding_window_view(rate, 2 * SPLINE_EDGE_SAMPLES + 1, axis=0)
    lost = np.any((fourth > CLEAR_SIGNAL_DEVIATIONS * noise) & (fourth > FOLLOWED * np.ptp(windows, axis=2)), axis=1)
    spread = np.convolve(lost, np.ones(4 * SPLINE_EDGE_SAMPLES + 1))[
        SPLINE_EDGE_SAMPLES : SPLINE_EDGE_SAMPLES + len(rate)
    ]
    return np.asarray(spread < 0.5)


def _means(time: Values, signals: Mapping[str, Values], valid: Mask, interval: float) -> ChannelValues:
    """Return the rows of one chip: time, f, w, their derivatives, and the mean of omega omega^T (n, 3, 3)."""
    k = max(round(ROW_S / interval), 1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], valid, [False]]).astype(int)))
    gaps = np.flatnonzero(np.diff(time) > MAX_CHIP_GAP_INTERVALS * interval) + 1
    rows: dict[str, list[Values]] = {}
    for first, last in edges.reshape(-1, 2):
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
    """The rotation at which the fits are linear, the fits, and the rows of both chips."""

    R: Values
    fits: list[RotationFit]
    rows: tuple[ChannelValues, ChannelValues]
    clear: ChannelValues  # which signals are clear of noise
    blocks: Blocks  # stretches of time in which the difference of the biases is taken as constant
    held_out: tuple[ChannelValues, ChannelValues] | None

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
        a, b = _joined(used)
        R, clear, fits = _fitted(sensors, a, b)
        steps = {fit.sensor: fit.step[fit.names.index("time_offset")] for fit in fits}
        total = {s: offset[s] + float(step) for s, step in steps.items()}
        if max(map(abs, steps.values())) < SMALL_SHIFT_S:
            break
    for fit in fits:
        fit.step[fit.names.index("time_offset")] = total[fit.sensor]
    held_out = [rows for held, rows in pairs if held]
    times = [rows[0]["time"] for rows in used]
    span = sum(float(np.ptp(t)) for t in times)
    length = max(min(SHORTEST_BLOCK_S, span / 12.0), span / BIAS_BLOCKS)
    blocks = Blocks.of_rows([(t, np.ones(len(t))) for t in times], range(len(times)), length)
    return RotationFits(R, fits, (a, b), clear, blocks, _joined(held_out) if held_out else None)


def _joined(pairs: Sequence[tuple[ChannelValues, ChannelValues]]) -> tuple[ChannelValues, ChannelValues]:
    """Return the rows of all recordings by each chip."""
    a, b = ({k: np.concatenate([pair[chip][k] for pair in pairs]) for k in pairs[0][chip]} for chip in (0, 1))
    return a, b


def _fitted(
    sensors: Sequence[str], a: ChannelValues, b: ChannelValues
) -> tuple[Values, ChannelValues, list[RotationFit]]:
    """Return the rotation at which the fits are linear, which signals are clear of noise, and the fits.

    The start is the rotation that maps the vectors of a best onto the vectors of b (Wahba's problem, Markley's SVD).
    """
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
