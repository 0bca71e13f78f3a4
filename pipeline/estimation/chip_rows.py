"""Compute rows of the readings of two chips of a board at the same times, from which ``chips`` estimates the mounting.

A row is a mean over 0.1 s of calibrated specific force f, g, and rate w, deg/s, of their derivatives by a quintic
spline, and of omega omega^T. Samples without a reading, and samples between which the rate changes too fast, are not
used.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import scipy

from pipeline.errors import NotObservableError
from pipeline.estimation.gauss_markov import Blocks, Prior
from pipeline.estimation.noise import prior_of
from pipeline.model.compensation import Compensation
from pipeline.model.effects.base import STANDARD_GRAVITY
from pipeline.model.kinematics import skew
from pipeline.records import MEDIAN_SIZE, SENSORS, Mask, Recording, SensorCalibration, Values, noise_of_steps

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

Means: TypeAlias = "dict[str, Values]"

ROW_S = 0.1  # rows: short against moves by hand, of seconds; longer ones lose angular acceleration
BLOCK_S, MOST_BLOCKS = 4.0, 300  # of the bias's wander, as in ``observations``
LEAST_S = 10.0  # that two chips have in common: twelve blocks of a second tell five columns from noise
CLEAR = 5.0  # standard deviations of noise: a signal below is taken for none, which no row of noise then exceeds
FOLLOWED = 0.1  # fourth difference over the range of five samples, above which sampling does not follow the motion
LEAST_SAMPLES = 12  # of a recording: a quintic spline and its edges
GAP = 1.5  # sampling intervals
EDGE = 2  # samples at each end of a stretch, where a spline's derivative errs


@dataclass(frozen=True)
class Chip:
    """One chip of a board: its recordings, its calibrations, and the section ``sensor`` of its settings."""

    unit: str
    recordings: Sequence[Recording]
    calibrations: Mapping[str, SensorCalibration | None]
    sensor_config: Mapping[str, Any]

    def prior(self, sensor: str) -> Prior:
        """Return what is known of the wander of its bias."""
        return prior_of(sensor, self.recordings, {"sensor": self.sensor_config})


@dataclass(frozen=True)
class Shared:
    """A recording of both chips: stamps, truths by sensor and valid samples, first of the reference chip."""

    held_out: bool
    interval: float
    time: tuple[Values, Values]
    truth: tuple[Means, Means]
    valid: tuple[Mask, Mask]

    def rows(self, offsets: Mapping[str, float]) -> tuple[Means, Means] | None:
        """Return the rows by each chip, the second one's stamps moved by its offsets, s; None: there are none."""
        (time, theirs), (one, two), valid = self.time, self.truth, self.valid[0]
        if any(offsets.values()) or not np.array_equal(time, theirs):
            known = (self.valid[1] & np.append(np.diff(theirs) <= GAP * self.interval, True)).astype(float)
            moved = {}
            for sensor, values in two.items():
                at = time - offsets[sensor]
                moved[sensor] = scipy.interpolate.CubicSpline(theirs, values)(at)
                valid = valid & (np.interp(at, theirs, known, 0.0, 0.0) > 1.0 - 1e-9)
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
        every = [[s for s in sensors if r.reading(s) is not None] == list(sensors) for r in (recording, twin)]
        overlap = recording.time_ns[0] < twin.time_ns[-1] and twin.time_ns[0] < recording.time_ns[-1]
        if all(every) and overlap:
            one, valid = _truth(reference, recording, sensors)
            two, known = _truth(other, twin, sensors)
            held, times = recording.role == "validation", (recording.time, twin.time)
            found.append(Shared(held, recording.interval, times, (one, two), (valid, known)))
    return found


def _truth(chip: Chip, recording: Recording, sensors: Sequence[str]) -> tuple[Means, Mask]:
    """Return the calibrated readings of a chip, and which samples are valid."""
    readings = {s: np.asarray(recording.reading(s)) for s in sensors}
    valid = recording.valid & np.all([np.isfinite(v).all(axis=1) for v in readings.values()], axis=0)
    given: dict[str, Any] = {s: np.where(valid[:, None], v, 0.0) for s, v in readings.items()}
    made = Compensation(chip.calibrations["accelerometer"], chip.calibrations["gyroscope"], chip.unit)
    truth = made.apply(**given, temperature=recording.temperature, time=recording.time)
    return {s: np.asarray(getattr(truth, s)) for s in sensors}, np.asarray(valid)


def rows_of(
    recordings: Sequence[Shared], offsets: Mapping[str, float]
) -> tuple[list[tuple[Means, Means]], list[tuple[Means, Means]]]:
    """Return the rows of the recordings of the fit, and of those that are held out.

    Raises ``NotObservableError`` if the chips have too little in common.
    """
    every = [(r.held_out, pair) for r in recordings if (pair := r.rows(offsets)) is not None]
    used, held_out = ([pair for held, pair in every if held == wanted] for wanted in (False, True))
    common = sum(len(a["time"]) for a, _ in used) * ROW_S
    if common < LEAST_S:
        raise NotObservableError(
            f"the chips have {common:.0f} s in common; expected recordings of the same names and times with the same "
            f"sensors, {LEAST_S:g} s or more without gaps"
        )
    return used, held_out


def _followed(rate: Values) -> Mask:
    """Return at which samples the sampling is fast enough for the motion, by the fourth difference: (n,) array."""
    if len(rate) < 2 * EDGE + 1:
        return np.zeros(len(rate), bool)
    fourth = np.abs(np.diff(rate, 4, axis=0))
    noise = noise_of_steps(np.abs(np.diff(rate, axis=0))) * np.sqrt(70.0)  # 1 + 16 + 36 + 16 + 1
    windows = np.lib.stride_tricks.sliding_window_view(rate, 2 * EDGE + 1, axis=0)
    lost = np.any((fourth > CLEAR * noise) & (fourth > FOLLOWED * np.ptp(windows, axis=2)), axis=1)
    spread = np.convolve(lost, np.ones(4 * EDGE + 1))[EDGE : EDGE + len(rate)]
    return np.asarray(spread < 0.5)


def _means(time: Values, signals: Mapping[str, Values], valid: Mask, interval: float) -> Means:
    """Return the rows of one chip: time, f, w, their derivatives, and the mean of omega omega^T (n, 3, 3)."""
    k = max(round(ROW_S / interval), 1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], valid, [False]]).astype(int)))
    gaps = np.flatnonzero(np.diff(time) > GAP * interval) + 1
    found: dict[str, list[Values]] = {}
    for first, last in edges.reshape(-1, 2):
        inner = gaps[(gaps > first) & (gaps < last)]
        for start, stop in zip([first, *inner], [*inner, last], strict=True):
            n = (stop - start - 2 * EDGE) // k
            if n < 1 or stop - start < 6 + 2 * EDGE:
                continue
            row = {"time": time[start:stop]}
            for sensor, values in signals.items():
                row[sensor] = values[start:stop]
                row[sensor + "'"] = scipy.interpolate.make_interp_spline(row["time"], row[sensor], k=5)(row["time"], 1)
            if "gyroscope" in row:
                omega = np.radians(row["gyroscope"])
                row["turn"] = omega[:, :, None] * omega[:, None, :]
            for name, values in row.items():
                cut = values[EDGE : EDGE + n * k]
                found.setdefault(name, []).append(cut.reshape(n, k, *cut.shape[1:]).mean(axis=1))
    return {name: np.concatenate(parts) for name, parts in found.items()} or {"time": np.zeros(0)}


def joined(pairs: Sequence[tuple[Means, Means]]) -> tuple[Means, Means]:
    """Return the rows of all recordings by each chip."""
    a, b = ({k: np.concatenate([pair[chip][k] for pair in pairs]) for k in pairs[0][chip]} for chip in (0, 1))
    return a, b


def clear_of(a: Means, b: Means, R: Values) -> dict[str, Values]:
    """Return where components exceed their noise, as 0 and 1; rows of noise alone are not used.

    For the specific force the deviation from its mean is used, because a bias cannot be distinguished from the mean.
    """
    found = {}
    for name in set(a) & {*SENSORS, *(f"{s}'" for s in SENSORS)}:
        difference = b[name] @ R - a[name]
        noise = MEDIAN_SIZE * np.median(np.abs(difference - np.median(difference, axis=0)), axis=0)
        centre = a[name].mean(axis=0) * (name == "accelerometer")
        found[name] = (np.abs(a[name] - centre) > CLEAR * noise).astype(float)
    if "gyroscope" in found:
        found["turn"] = found["gyroscope"][:, :, None] * found["gyroscope"][:, None, :]
    return found


def lever(turn: Values, alpha: Values) -> Values:
    """Return the matrices by which a lever arm, m, becomes a specific force, g: (n, 3, 3) array.

    ``turn``: (n, 3, 3), omega omega^T, rad^2/s^2. ``alpha``: (n, 3), deg/s^2.
    """
    square = turn - np.trace(turn, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    return np.asarray((square + skew(np.radians(alpha))) / STANDARD_GRAVITY)


def columns_of(sensor: str, x: Means) -> list[tuple[str, Values]]:
    """Return the columns of a sensor's fit from the signals of one chip: kind and (n, 3, p) array."""
    n = len(x["time"])
    columns = [("rotation", -skew(x[sensor]))]
    if sensor == "accelerometer" and "turn" in x:
        columns.append(("lever_arm", lever(x["turn"], x["gyroscope'"])))
    return [*columns, ("time_offset", x[sensor + "'"][:, :, None]), ("bias", np.tile(np.eye(3), (n, 1, 1)))]


def turned(x: Means, R: Values, clear: Mapping[str, Values]) -> Means:
    """Return the signals of a chip in axes that R turns into its own, where they are clear of noise."""
    found = {k: R.T @ v @ R if k == "turn" else v @ R if v.ndim == 2 else v for k, v in x.items()}
    level = {k: found[k].mean(axis=0) if k == "accelerometer" else 0.0 for k in clear}
    return {k: level[k] + (v - level[k]) * clear[k] if k in clear else v for k, v in found.items()}


def blocks_of(times: Sequence[Values]) -> Blocks:
    """Return stretches of time in which the difference of the biases is taken as constant, of each recording."""
    span = sum(float(np.ptp(t)) for t in times)
    length = max(min(BLOCK_S, span / 12.0), span / MOST_BLOCKS)
    return Blocks.of_rows([(t, np.ones(len(t))) for t in times], range(len(times)), length)
