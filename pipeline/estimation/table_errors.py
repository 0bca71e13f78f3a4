"""Propagate the stated accuracies of a table to the parameters of a fit, through its linear map.

The true motion is the logged motion plus an error, ``u + du``, which changes the readings by ``K du``. Each accuracy is
the standard uncertainty of independent errors:

    angle          each stop of the table, and in a turn between two stops e_k + (e_k+1 - e_k) (A - A_k) / (A_k+1 - A_k)
    rate           each turn axis, relative; in continuous turns of an accelerometer its integral, an error of the angle
    orthogonality  lean of each turn axis toward both others (``table_axis_nonorthogonality``)
    wobble         once a turn, each axis about both others: cosine and sine of the table angle
    levelling      tilt of the table about level x and y (``table_tilt``)
    gravity        local gravity
    azimuth        of level x, if Earth's rotation is in the model
    time base      of the sensor's clock, relative, if the log has no rate: the rate is the change of the angle
                   over the time by that clock

An attitude log has no stops: its angle errors are three constant turns of each recording, about the body axes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import TypeAlias

import numpy as np
from scipy.linalg import lapack

from pipeline.core.records import NORMAL, SENSORS, Contribution, Index, Integers, Motion, Values, noise_of_steps
from pipeline.core.settings import Table
from pipeline.estimation.engine import LinearMap, ResidualNoise, assess_noise
from pipeline.estimation.gauss_markov import Blocks, Products, Setting, WanderPrior
from pipeline.physics.effects import effect
from pipeline.physics.effects.base import truth
from pipeline.physics.kinematics import ABOUT, earth_of
from pipeline.physics.signal.rests import RATE_AT_REST_DPS

# contributions to a budget, and the reason for each source that is not included
BudgetLines: TypeAlias = "tuple[list[Contribution], dict[str, str]]"

INPUT_EFFECT_ROUNDING = 1e-10  # of the largest effect of an input: a hundred thousand times the rounding of a double
SAME_STOP_DEG = 0.02  # by which angles of one stop may differ
LEAST_CHANGE = 1e-9  # of the bias's variance, between blocks at one time: there its precision would be infinite
COUNTED_STOPS = 4  # stops of a recording above which its steps are counted, so that the rate adds no error
TILT_ACCURACIES = ("angle_accuracy_deg", "orthogonality_deg", "wobble_deg", "levelling_deg")

TIME_BASE = "time base"
TIMED_BY_SENSOR = (
    "the log holds no rate, so that the rate is the change of the angle over the time by the sensor's clock: an error "
    "of 100 ppm of that clock is one of 100 ppm of the matrix"
)
CLOCK_OF_TABLE = (
    "the log holds no rate; the rate is the change of the angle over the time by the table's own clock, whose error is "
    "part of table.rate_accuracy"
)


@dataclass(frozen=True)
class Reference:
    """The motion at the rows of a fit, recording by recording, by a table with stated accuracies."""

    sensor: str
    motions: Sequence[Motion]  # their samples, one after the other, are the columns of ``LinearMap.weights``
    K: Values  # (3, 3)
    table: Table

    def summed(self, fit: LinearMap | BlockSums, change: Callable[[Motion], Values | None], inputs: int) -> Values:
        """Return the change of the parameters by inputs that change the truth: (p, inputs) array.

        ``change``: motion to the derivative of the truth, (n, 3, inputs), or None if it does not change.
        """
        total = np.zeros((fit.parameters, inputs))
        edges = np.cumsum([0, *(len(motion.time) for motion in self.motions)]).tolist()
        for motion, edge in zip(self.motions, pairwise(edges), strict=True):
            du = change(motion)
            if du is not None:
                rows = fit.rows(slice(*edge))
                size = np.ones(du[:, :, 0].size) @ np.abs(du).reshape(-1, inputs)
                for j in np.flatnonzero(size):  # errors of other axes have no effect
                    total[:, j] += rows.of(du[:, :, j] @ self.K.T)
        return total

    def of_one(self, fit: LinearMap | BlockSums, motion: Motion, du: Values) -> Values:
        """Return the change of the parameters by inputs of one recording; ``du``: (n, 3, inputs), as in ``summed``."""
        return self.summed(fit, lambda other: du if other is motion else None, du.shape[2])


@dataclass(frozen=True)
class BlockSums:
    """The linear map from changes of the readings to the sums over blocks of consecutive rows, channel by channel."""

    label: Index  # (n,); block of each row
    blocks: int  # m
    weight: Values  # (n,); samples of each row

    @property
    def parameters(self) -> int:
        """Number of sums of all channels."""
        return 3 * self.blocks

    def rows(self, rows: slice) -> BlockSums:
        """Return the map from some consecutive readings."""
        return BlockSums(self.label[rows], self.blocks, self.weight[rows])

    def of(self, change: Values) -> Values:
        """Return the change of the sums by a change of the readings, (n, 3): (3 m,) array."""
        return self.of_groups(change, np.zeros(len(change), np.intp), 1)[:, 0]

    def of_groups(self, change: Values, group: Index, count: int) -> Values:
        """Return the change of the sums by the change of each of ``count`` groups of readings: (3 m, count) array."""
        place = self.label * count + group
        sums = [np.bincount(place, self.weight * dy, self.blocks * count) for dy in change.T]
        return np.asarray(np.concatenate(sums), np.float64).reshape(-1, count)


def type_b(  # noqa: PLR0917  (the columns of a budget's line)
    source: str, distribution: str, u: float, unit: str, effect: Values, remark: str = ""
) -> Contribution:
    """Return the contribution of m independent inputs of standard uncertainty u; ``effect``: (p, m) array."""
    effect = _without_rounding(effect)
    covariance = u**2 * effect @ effect.T
    freedom = np.full(len(effect), np.inf)
    return Contribution(source, "B", distribution, covariance, freedom, u, unit, effect.shape[1], remark=remark)


def _without_rounding(effect: Values) -> Values:
    """Return the effect of inputs on parameters with zeros in place of values that are rounding."""
    return np.where(np.abs(effect) > INPUT_EFFECT_ROUNDING * np.abs(effect).max(initial=0.0), effect, 0.0)


def table_errors(reference: Reference, fit: LinearMap | BlockSums, estimated: Sequence[str] = ()) -> BudgetLines:
    """Return the contribution of each stated accuracy to the parameters of a fit, and reasons for those not included.

    ``estimated``: effects of the fit; an error that one of them estimates is not an input any more.
    """
    stated, missing = _stated_errors(reference, fit, estimated)
    return [type_b(source, NORMAL, u, unit, effect) for source, u, unit, effect in stated], missing


def _stated_errors(
    reference: Reference, fit: LinearMap | BlockSums, estimated: Sequence[str] = ()
) -> tuple[list[tuple[str, float, str, Values]], dict[str, str]]:
    """Return source, accuracy, unit and effect, (p, inputs), of each stated accuracy, and reasons for the others."""
    stated, missing = [], {}
    setups = {motion.setup for motion in reference.motions}
    for source, key, unit, sensors, replaced_by, inputs, change in ACCURACIES:
        if reference.sensor not in sensors:
            continue
        u: float | None = getattr(reference.table, key)
        fitted = [n for n in replaced_by if n in estimated or all(f"{n}@{setup}" in estimated for setup in setups)]
        reason = f"estimated by {fitted[0]}" if fitted else _without(source, key, reference)
        if reason:
            missing[source] = reason
        elif u:
            if change is None:
                by_input = _angle(reference, fit)
            elif change is _rate and reference.table.motion == "commanded":
                by_input = _rate_of_each(reference, fit)
            else:
                by_input = reference.summed(fit, partial(change, reference), inputs)
            stated.append((source, float(u), unit, by_input))
    return stated, missing


def disturbance(
    reference: Reference, residuals: Values, blocks: Blocks, weight: Values | None = None, white: Values | None = None
) -> Values | None:
    """Return the change of sums over blocks by the errors of the table, or None if it is small against the noise.

    ``residuals``: (n, 3). ``weight``: (k,), samples of each row; None: rows are samples. ``white``: (3,), noise of a
    sample; None: from the residuals, then those of samples. Returns F, (3 m, r), channel by channel, for r independent
    errors of standard uncertainty 1: the sums have the covariance ``F F^T``.
    """
    if white is None:
        white = noise_of_steps(np.abs(np.diff(residuals, axis=0)))
    if not 0.0 < white.min() < _largest(reference) * np.sqrt(blocks.weight.max()):
        return None
    weight = np.ones(len(residuals)) if weight is None else weight
    sums = BlockSums(blocks.label(len(weight)), len(blocks.weight), weight)
    stated, _ = _stated_errors(reference, sums)
    return np.column_stack([u * _without_rounding(effect) for _, u, _, effect in stated]) if stated else None


def noise_on_table(  # noqa: PLR0917  (as of ``assess_noise``)
    reference: Reference,
    residuals: Values,
    design: Values,
    blocks: Blocks,
    prior: WanderPrior,
    row_weight: Values | None = None,
) -> ResidualNoise:
    """Weight the hypotheses of a prior by the residuals of a fit on a table; arguments: see ``assess_noise``."""
    known = disturbance(reference, residuals, blocks, row_weight)
    return assess_noise(residuals, design, blocks, prior, known, row_weight)


def _largest(reference: Reference) -> float:
    """Return the approximate largest error of the truth by the stated accuracies, g or deg/s."""
    table, size = reference.table, 0.0
    tilt = np.radians(max(float(getattr(table, key) or 0.0) for key in TILT_ACCURACIES))
    for motion in reference.motions:
        u = truth(reference.sensor, motion)
        size = max(size, tilt * float(np.abs(u).max()))
        if reference.sensor == "gyroscope" and motion.angle is not None and motion.rate is not None:
            slope = float(np.abs(motion.rate * between_stops(motion.angle, motion.rate)[2]).max())
            size = max(size, slope * table.angle_accuracy_deg)
            size = max(size, float(np.abs(motion.rate).max()) * table.rate_accuracy)
    return size


def _without(source: str, key: str, reference: Reference) -> str:
    """Return why a source is not included; empty if it is, or if its accuracy is stated as 0."""
    table, clocks = reference.table, {motion.timed_by for motion in reference.motions}
    placed = table.latitude_deg is not None and table.azimuth_deg is not None
    if source == "Earth's rotation" and not placed:
        return "not in the model: table.latitude_deg and table.azimuth_deg are not set; up to 0.0042 deg/s"
    if source == TIME_BASE:
        if reference.sensor == "accelerometer":
            return "no time enters the direction of gravity at an angle of the table"
        if "sensor" not in clocks:
            return CLOCK_OF_TABLE if "table" in clocks else "the table states the rate itself: no clock changes it"
        return "" if getattr(table, key) is not None else f"table.{key} is not stated; {TIMED_BY_SENSOR}"
    return f"table.{key} is not stated" if getattr(table, key) is None else ""


def _angle(reference: Reference, fit: LinearMap | BlockSums) -> Values:
    """Return the change of the parameters by an error of each stop's angle: (p, stops) array."""
    before, after, stop, count = errors_of_stops(reference.sensor, reference.motions, reference.K)
    at_stops = np.zeros((fit.parameters, count + 1))
    if before.any() or after.any():  # else no motion is a turn about one axis
        at_stops = fit.of_groups(before, stop, count + 1) + fit.of_groups(after, stop + 1, count + 1)
    attitudes = [m for m in reference.motions if m.axis is None and m.has("level")]
    return np.concatenate([at_stops, *(_turned(reference, fit, motion) for motion in attitudes)], axis=1)


def errors_of_stops(sensor: str, motions: Sequence[Motion], K: Values) -> tuple[Values, Values, Index, int]:
    """Return the change of each reading by errors of the angle at the stop before and the stop after it, per deg.

    Returns two (n, 3) arrays; the index of the stop before, (n,), which the stop after follows; and the number of
    stops.
    """
    before, after, index, count = [], [], [], 0
    for motion in motions:
        if motion.axis is None or motion.angle is None or motion.rate is None:
            stop, stops = np.zeros(len(motion.time), int), 1
            before.append(np.zeros((len(stop), 3)))
            after.append(np.zeros((len(stop), 3)))
        else:
            stop, share, slope, stops = between_stops(motion.angle, motion.rate)
            if sensor == "accelerometer":
                turned = motion.specific_force @ (-np.radians(1.0) * K @ ABOUT[motion.axis]).T
                before.append(turned * (1.0 - share)[:, None])
                after.append(turned * share[:, None])
            else:
                faster = (motion.rate * slope)[:, None] * K[:, motion.axis]
                before.append(-faster)
                after.append(faster)
        index.append(stop + count)
        count += stops
    return np.concatenate(before), np.concatenate(after), np.concatenate(index), count


class StopErrors:
    """Errors of the angle at the stops and the bias of the blocks, eliminated from a fit together.

    Over the white noise of axis c, its readings are

        y_c = A_c p + S x_c + T_c e + w_c,    x_c ~ N(0, q B),    e ~ N(0, 1),    w_c ~ N(0, W^-1)

    where S has a 1 in each row at its block, T_c is the change by the error of each stop, W the samples of the rows,
    and q B as in ``pipeline.estimation.gauss_markov``. With M, the precision of (x, e) at given parameters p,

        A^T C^-1 A = A^T W A - Z^T M^-1 Z,    Z = [S, T]^T W A,    log det C = log det M + 3 log det(q B)

    In the order of time M is a band matrix: a reading depends on one block and two stops, and the bias at an instant
    on the one before it. ``before``, ``after``: (n, 3), the changes of ``errors_of_stops`` for errors of unit variance.
    """

    def __init__(self, rows: Products, before: Values, after: Values, stop: Index, count: int) -> None:
        blocks, weight = rows.blocks, rows.weight
        assert not blocks.length.any()  # noqa: S101  (only the bias at instants is a Markov process)
        self._rows, self._change, self._stop = rows, (before, after), stop
        self._label, order, ends = blocks.label(len(weight)), blocks.order, np.concatenate([stop, stop + 1])
        rank = np.argsort(order)
        of_row, change, doubled = np.tile(rank[self._label], 2), np.concatenate(self._change), np.tile(weight, 2)
        middle = np.bincount(ends, of_row, count) / np.maximum(np.bincount(ends, minlength=count), 1)
        place = np.argsort(np.argsort(np.append(np.repeat(np.arange(len(order)), 3), middle), kind="stable"))
        self._bias, self._errors = place[: 3 * len(order)].reshape(-1, 3), place[3 * len(order) :]  # in M; in time
        pairs, pair = np.unique(of_row * count + ends, return_inverse=True)  # of a block and a stop
        block, error = self._bias[pairs // count], self._errors[pairs % count]
        of_turn = np.bincount(stop, weight * np.sum(before * after, axis=1), count)
        turns = np.flatnonzero(of_turn)
        turn = self._errors[turns], self._errors[turns + 1]
        links = [(block, error[:, None]), turn, (self._bias[:-1], self._bias[1:])]
        width = max(int(np.abs(a - b).max(initial=0)) for a, b in links)
        self._alone = np.zeros((width + 1, len(place)))  # lower band of M without bias
        self._alone[0, self._errors] = 1.0 + np.bincount(ends, doubled * np.sum(change**2, axis=1), count)
        _add(self._alone, turn[0], turn[1], of_turn[turns].astype(float))
        self._both = self._alone.copy()  # of M without the prior of the bias
        self._both[0, self._bias] = blocks.weight[order, None]
        self._alone[0, self._bias] = 1.0
        for c in range(3):
            _add(self._both, block[:, c], error, np.bincount(pair, doubled * change[:, c]).astype(float))
        same = np.diff(blocks.clock[order]) == 0
        self._order, self._apart = order, np.where(same, np.diff(blocks.start[order]), np.inf)

    def products(self, settings: Sequence[Setting], white: Values, sums: Values) -> tuple[Values, Values]:
        """Return ``A^T C^-1 A``, (g, p, p), and ``log det C``, (g,); ``white``: ``A^T W A``; ``sums``: of ``sums``."""
        found, logarithms = np.empty((len(settings), *white.shape)), np.empty(len(settings))
        for i, setting in enumerate(settings):
            factor, logarithms[i], of_setting = self._factor(setting, sums)
            half, info = lapack.dtbtrs(factor, of_setting, uplo="L")
            assert info == 0  # noqa: S101
            found[i] = white - half.T @ half
        return found, logarithms

    def sums(self, scale: Values, of_axis: Sequence[tuple[Index, Index]], count: int) -> Values:
        """Return Z: (3 m + s, p) array; ``of_axis``: the columns of each axis, and their places among ``count``."""
        of_stops, found = np.zeros((len(self._errors), count)), np.zeros((self._both.shape[1], count), order="F")
        first = np.flatnonzero(np.diff(self._stop, prepend=-1))
        of_blocks = (self._rows.blocks.weight[:, None] * self._rows.means)[self._order]
        for c, (local, at) in enumerate(of_axis):
            columns = (self._rows.weight / scale[c])[:, None] * self._rows.columns.take(local, 1)
            found[self._bias[:, c, None], at] = of_blocks.take(local, 1) / scale[c]
            for change, stops in zip(self._change, (self._stop[first], self._stop[first] + 1), strict=True):
                of_stops[stops[:, None], at] += np.add.reduceat(change[:, c, None] * columns, first, axis=0)
        found[self._errors] = of_stops
        return found

    def explained(self, setting: Setting, sums: Values) -> list[Values]:
        """Return ``W (S x_c + T_c e)``, (n, p), of each axis, with the expected bias and errors by the readings A."""
        factor, _, of_setting = self._factor(setting, sums)
        solved, info = lapack.dpbtrs(factor, of_setting, lower=1)
        assert info == 0  # noqa: S101
        errors, bias = solved[self._errors], np.empty((len(self._order), 3, solved.shape[1]))
        bias[self._order] = solved[self._bias] * (setting.ratio > 0.0)
        before, after = self._change
        moved = (before[:, c, None] * errors[self._stop] + after[:, c, None] * errors[self._stop + 1] for c in range(3))
        return [self._rows.weight[:, None] * (bias[self._label, c] + by_stops) for c, by_stops in enumerate(moved)]

    def _factor(self, setting: Setting, sums: Values) -> tuple[Values, float, Values]:
        """Return the Cholesky factor of M as a band, ``log det C``, and Z as far as M couples it to parameters."""
        if setting.ratio > 0.0:
            step = self._apart / setting.time
            inner = np.append(np.inf, step)
            # of each bias, given the one before it
            variance = setting.ratio**2 * np.maximum(-np.expm1(-2.0 * inner), LEAST_CHANGE)
            carried, band, logarithm = np.exp(-step), self._both.copy(), 3.0 * float(np.sum(np.log(variance)))
            band[0, self._bias] += (1.0 / variance + np.append(carried**2 / variance[1:], 0.0))[:, None]
            _add(band, self._bias[:-1], self._bias[1:], -(carried / variance[1:])[:, None])
        else:
            band, logarithm, sums = self._alone.copy(), 0.0, sums.copy()
            sums[self._bias] = 0.0
        factor, info = lapack.dpbtrf(band, lower=1, overwrite_ab=1)
        assert info == 0  # noqa: S101  (M is a precision)
        return factor, logarithm + 2.0 * float(np.sum(np.log(factor[0]))), sums


def _add(band: Values, one: Integers, two: Integers, values: Values) -> None:
    """Add elements of a symmetric matrix, each once, to its lower band."""
    band[np.abs(one - two), np.minimum(one, two)] += values


def between_stops(angle: Values, rate: Values) -> tuple[Index, Values, Values, int]:
    """Return the stop at or before each sample, the share of the turn to the next, its derivative, 1/deg, and a count.

    The count is that of the stops. If a recording does not begin or end with a rest, its first or last sample is used
    as a stop.
    """
    still = np.abs(rate) <= RATE_AT_REST_DPS
    was_still = np.concatenate([[False], still[:-1]])
    jump = np.abs(np.diff(angle, prepend=angle[0])) > SAME_STOP_DEG
    new = still & (~was_still | jump)
    new[0] = True
    stop = np.cumsum(new) - 1
    stops = np.append(angle[new], angle[-1])
    arc = stops[stop + 1] - stops[stop]
    moving = ~still & (np.abs(arc) > SAME_STOP_DEG)
    slope = np.where(moving, 1.0 / np.where(moving, arc, 1.0), 0.0)
    return stop, (angle - stops[stop]) * slope, slope, len(stops)


def _turned(reference: Reference, fit: LinearMap | BlockSums, motion: Motion) -> Values:
    """Return the change of the parameters by a rotation of one recording about each axis, per deg: (p, 3) array."""
    u = truth(reference.sensor, motion)
    du = np.stack([-np.radians(u @ about.T) for about in ABOUT], axis=2)
    return reference.of_one(fit, motion, du)


def _rate(reference: Reference, motion: Motion) -> Values | None:
    """Return the change of the truth by a relative error of the rate about each axis."""
    if motion.axis is None or motion.rate is None or motion.angle is None:
        return None
    du = np.zeros((len(motion.time), 3, 3))
    if reference.sensor == "gyroscope":
        du[:, motion.axis, motion.axis] = motion.rate
    elif between_stops(motion.angle, motion.rate)[3] <= COUNTED_STOPS:
        travelled = np.concatenate([[0.0], np.cumsum(np.diff(motion.angle))])[:, None]
        du[:, :, motion.axis] = -np.radians(travelled * (motion.specific_force @ ABOUT[motion.axis].T))
    return du


def _rate_of_each(reference: Reference, fit: LinearMap | BlockSums) -> Values:
    """Return the change of the parameters by a relative error of the rate in each recording: (p, recordings) array.

    A motor without an encoder loses steps in fast turns, so that recordings about one axis have different errors.
    """
    changes = [(motion, _rate(reference, motion)) for motion in reference.motions]  # other axes have zeros
    columns = [reference.of_one(fit, m, du.sum(axis=2, keepdims=True)) for m, du in changes if du is not None]
    return np.concatenate(columns, axis=1) if columns else np.zeros((fit.parameters, 0))


def _orthogonality(reference: Reference, motion: Motion) -> Values | None:
    """Return the change of the truth by a lean of each axis, per deg."""
    lean = effect("table_axis_nonorthogonality")
    return None if motion.axis is None else lean.regressors(reference.sensor, motion, np.eye(3), np.zeros(6))


def _wobble(reference: Reference, motion: Motion) -> Values | None:
    """Return the change of the truth by cosine and sine of a wobble about both other axes, per deg."""
    if motion.axis is None or motion.angle is None or motion.rate is None:
        return None
    a, angle = motion.axis, np.radians(motion.angle)
    u, du = truth(reference.sensor, motion), np.zeros((len(angle), 3, 12))
    for j, (wave, slope) in enumerate(((np.cos(angle), -np.sin(angle)), (np.sin(angle), np.cos(angle)))):
        for k in (1, 2):
            about = np.radians(1.0) * np.eye(3)[(a + k) % 3]
            du[:, :, 4 * a + 2 * j + k - 1] = np.cross(u, about) * wave[:, None]
            if reference.sensor == "gyroscope":
                du[:, :, 4 * a + 2 * j + k - 1] += about * (slope * motion.rate)[:, None]
    return du


def _levelling(reference: Reference, motion: Motion) -> Values | None:
    """Return the change of the truth by a tilt about level x and y, per deg."""
    tilt = effect("table_tilt")
    return None if motion.level is None else tilt.regressors(reference.sensor, motion, np.eye(3), np.zeros(2))


def _gravity(reference: Reference, motion: Motion) -> Values:
    """Return the change of the truth by gravity, per g."""
    return motion.specific_force[:, :, None] / reference.table.gravity_g


def _azimuth(reference: Reference, motion: Motion) -> Values | None:
    """Return the change of Earth's rotation by a turn of the table about the vertical, per deg."""
    earth = earth_of(reference.table)
    if motion.level is None or earth is None:
        return None
    change = np.radians(np.array([-earth[1], earth[0], 0.0]))
    return np.asarray(np.einsum("i,nij->nj", change, motion.level)[:, :, None])


def _clock(reference: Reference, motion: Motion) -> Values | None:
    """Return the change of rates by an error of the sensor's clock, per ppm, if they are computed by that clock."""
    del reference
    return 1e-6 * motion.angular_rate[:, :, None] if motion.timed_by == "sensor" else None


# Source, setting of the table, unit, sensors whose readings it changes, effects that estimate it, number of inputs, and
# the change of the truth by them, (n, 3, inputs); for the angle at the stops see ``_angle``.
ACCURACIES: tuple[
    tuple[str, str, str, Sequence[str], Sequence[str], int, Callable[[Reference, Motion], Values | None] | None], ...
] = (
    ("table angle", "angle_accuracy_deg", "deg", SENSORS, (), 0, None),
    ("table rate", "rate_accuracy", "1", SENSORS, (), 3, _rate),
    (
        "orthogonality of the table's axes", "orthogonality_deg", "deg", SENSORS,
        ("table_axis_nonorthogonality", "mounting"), 6, _orthogonality,
    ),
    ("wobble of the table's axes", "wobble_deg", "deg", SENSORS, (), 12, _wobble),
    ("levelling", "levelling_deg", "deg", ("accelerometer",), ("table_tilt",), 2, _levelling),
    ("local gravity", "gravity_accuracy_g", "g", ("accelerometer",), (), 1, _gravity),
    ("Earth's rotation", "azimuth_accuracy_deg", "deg", ("gyroscope",), ("earth_rotation",), 1, _azimuth),
    (TIME_BASE, "clock_accuracy_ppm", "ppm", SENSORS, (), 1, _clock),
)  # fmt: skip
