"""Fit the accelerometer by the staged method, equation by equation (Sudsanguan 2019, eqs 3.15-3.43).

The input of each stage is the extremes of the turns in the output of the stage before. It estimates its factors or
offsets, and corrects the readings for the next stage:

    orthogonality -> misalignment -> bias -> scale_factor

The corrections so far have the contract's form, for each axis,

    reading = bias + k u + c |u|,   k = (1/P + 1/N) / 2,   c = (1/P - 1/N) / 2,   matrix_ii = 1 / k

where P and N are the products of all factors of the positive and the negative side, with both sides of the factors of
orthogonality and misalignment averaged, and ``bias`` is the reading that is corrected to zero.

The result is a function of the coefficients of the sinusoids fitted to the turns. Its covariance follows from theirs by
the derivative of all stages up to this one (JCGM 100:2008, 5.2.2), by differences. As printed (``as_printed``, with the
thesis's errata, to reproduce a table) the extremes are single samples, order statistics of the noise: the covariance
then follows from synthetic turns, which are the fitted sinusoids with simulated noise as large as the residuals.

In a turn about body axis i the axes j = i + 1 and k = i + 2 (cyclic: *first* and *second*) each point up and down once.
The method uses, for each turn, the table angles of these four extremes, and for each axis its largest and smallest
readings, its readings where it is level, and its readings while the table turns about it:

    a_max = mean of the largest, a_min = mean of the smallest, a_zero = mean of the level readings  (3.23-3.25)

By default they are extremes of sinusoids fitted to the turns. Opposite extremes are then 180 deg apart, and all samples
that a filter changes equally are used. ``as_printed`` uses the largest and the smallest of all samples and their
angles, also samples in motion between two rests and at rest before or after a turn.

While the table turns about body axis i by the angle A, gravity causes in a channel with its axis across

    y = z + a cos(A - phi) + c |cos(A - phi)|

where

    z    : reading where the axis is level, g
    phi  : angle at which the axis points up, deg
    a, c : half sum and half difference of the two sides, g: the largest reading is ``z + a + c``, the smallest
           ``z - a + c``; c is zero if a sensor has one scale factor for both sides

and in the channel along the turn axis ``y = z + h cos(A - phi)`` with a small h, the misalignment. For a given phi the
other parameters are linear. phi is the phase of the first harmonic of the linear fit, found in a few rounds because
|cos| has even harmonics only. So all samples of a turn determine its extremes, not only the few at its flat peaks.

A filter shifts phi by rate x delay and reduces a, but only while the table turns: it does not change the readings of a
rest at either end, so that one sinusoid does not describe both.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np
import scipy

from pipeline.core.errors import NotObservableError
from pipeline.core.records import (
    AXES,
    BASE,
    BASE_COUNT,
    Contribution,
    Convergence,
    CorrectionStep,
    Recording,
    SensorCalibration,
    StageResult,
    Subtract,
    TwoSided,
    Values,
    base_values,
    corrected,
)
from pipeline.core.settings import Settings
from pipeline.estimation.engine import LinearMap, ResidualNoise, ScaledColumns, linear_convergence
from pipeline.estimation.stages import FitStage, StageInput, details_on_table
from pipeline.estimation.table_errors import Reference
from pipeline.estimation.turns import TurnPart, filtered_alike, noise_of_turns, parts_of, used_motions
from pipeline.estimation.uncertainty_budget import (
    budgeted,
    combined,
    noise_contribution,
    scatter_contribution,
    stage_parameters,
)
from pipeline.physics.effects import fitted_effect

PHASE_ITERATIONS = 12  # of the phase
SAME_PHASE = 1e-12  # rad
MIN_TURN_SINGULAR_VALUE = 1e-3  # smallest singular value of unit columns that still counts as determined
OTHERS = ((1, 2), (2, 0), (0, 1))  # first and second axis of a turn about x, y, z
NamedValues = dict[str, tuple[float, str]]  # value and unit of each parameter
EstimatedSteps = tuple[list[CorrectionStep], NamedValues]  # steps of the correction by a stage, and its parameters
REPLICATES = 60  # synthetic turns: their covariance is known to a tenth
SEED = 20190508  # any number
AS_PRINTED = "the printed variant takes single samples, through which no error of the table can be followed"
DIFFERENCE_STEP_G = 1e-7  # g, of the differences: truncation and rounding are then both about 1e-8 of the derivative
ASYMMETRY = "scale_factor_asymmetry"
GREEK = ("alpha", "beta", "gamma")
FIT_STAGES = {
    "orthogonality": FitStage(sensors=("accelerometer",), accepts=("readings",), changes=("matrix",)),
    "misalignment": FitStage(sensors=("accelerometer",), accepts=("readings",), changes=("matrix",)),
    "bias": FitStage(sensors=("accelerometer",), accepts=("readings",), changes=("bias",)),
    "scale_factor": FitStage(sensors=("accelerometer",), accepts=("readings",), changes=("matrix", "effects")),
}


@dataclass(frozen=True)
class Extremes:
    """The extremes of the turns that the staged method uses."""

    # each (3, 2), deg; table angle where the first and the second axis of the turn about x, y, z read most and least
    angle_high: Values
    angle_low: Values
    # each (3, 2), g; largest and smallest readings of each axis, from the two turns in which it goes up and down
    high: Values
    low: Values
    level: Values  # (3, m), g; readings of each axis where it is level
    # (3,), g; reading of each axis while the table turns about it: by default the amplitude of its swing, as printed
    # its mean
    height: Values
    gravity_g: float
    as_printed: bool  # whether they are single samples, for the equations as printed

    @property
    def a_max(self) -> Values:
        """Largest reading of each axis, g."""
        return np.asarray(self.high.mean(axis=1))

    @property
    def a_min(self) -> Values:
        """Smallest reading of each axis, g."""
        return np.asarray(self.low.mean(axis=1))

    @property
    def a_zero(self) -> Values:
        """Level reading of each axis, g."""
        return np.asarray(self.level.mean(axis=1))

    def corrected(self, step: CorrectionStep) -> Self:
        """Return the extremes of readings after a step of a correction."""

        def apply(values: Values) -> Values:
            return step.apply(values.T).T

        height = self.height
        if self.as_printed:
            height = apply(height[:, None])[:, 0]
        elif isinstance(step, TwoSided):
            height = height * (step.positive + step.negative) / 2.0
        return replace(self, high=apply(self.high), low=apply(self.low), level=apply(self.level), height=height)


@dataclass(frozen=True)
class AxisTurns:
    """The used samples of all recordings of turns about one axis."""

    angle: Values  # (n,), deg
    reading: Values  # (n, 3), g
    parts: list[TurnPart]


def turns_of(parts: Sequence[TurnPart], *, as_printed: bool) -> list[AxisTurns]:
    """Return the turns about x, y and z; raise ``NotObservableError`` if there is none about one of the axes."""
    turns = []
    for axis in range(3):
        used = [part for part in parts if part.motion.axis == axis]
        used = used if as_printed else [replace(part, keep=filtered_alike(part)) for part in used]
        if not any(np.any(part.keep) for part in used):
            raise NotObservableError(
                f"no usable sample of a turn about body axis {AXES[axis]}: the staged method needs a turn about each "
                "of x, y and z; record it, or choose reference_least_squares"
            )
        angle = np.concatenate([np.asarray(part.motion.angle)[part.keep] for part in used])
        turns.append(AxisTurns(angle, np.concatenate([part.reading("accelerometer") for part in used]), used))
    return turns


@dataclass(frozen=True)
class Sinusoid:
    """The sinusoid of one channel in one turn."""

    # (3,) or (4,), g; z, then the cosine's and the sine's coefficient, then c where both sides were fitted
    coefficients: Values
    columns: Values  # (n, p)
    weights: Values  # (p, n); ``coefficients = weights @ readings``
    residuals: Values  # (n,), g
    condition: float  # of the columns, scaled


def fit_sinusoid(angle_deg: Values, reading: Values, *, sides: bool, where: str) -> Sinusoid:
    """Fit a sinusoid of the table angle.

    ``angle_deg``: (n,), deg. ``reading``: (n,), g. ``sides``: whether the two sides may differ. ``where``: channel and
    turn, for the message. Raises ``NotObservableError`` if the angles do not determine it.
    """
    angle = np.radians(angle_deg)
    columns = harmonic = np.column_stack([np.ones_like(angle), np.cos(angle), np.sin(angle)])
    factors = _factors(columns, where)
    coefficients = factors.solve(reading)
    for _ in range(PHASE_ITERATIONS if sides else 0):
        phase = np.arctan2(coefficients[2], coefficients[1])
        columns = np.column_stack([harmonic, np.abs(np.cos(angle - phase))])
        factors = _factors(columns, where)
        coefficients = factors.solve(reading)
        if abs(np.arctan2(coefficients[2], coefficients[1]) - phase) < SAME_PHASE:
            break
    return Sinusoid(coefficients, columns, factors.weights(), reading - columns @ coefficients, factors.condition)


def _factors(columns: Values, where: str) -> ScaledColumns:
    n, p = columns.shape
    if n >= p:
        factors = ScaledColumns.of(columns)
        if factors.singular[-1] > MIN_TURN_SINGULAR_VALUE:
            return factors
    raise NotObservableError(
        f"{where} does not show a sinusoid: {n} samples over too few angles; turn the table once around, stopping at "
        "four angles or more, so that the axis points up and down and is level in between"
    )


def extremes_of_sinusoids(coefficients: Sequence[Sequence[Values]], gravity_g: float) -> Extremes:
    """Return the extremes of fitted sinusoids; ``coefficients``: of each turn, by channel (``Sinusoid``)."""
    angle, high, low = np.empty((3, 3, 2))
    level, height = np.empty((3, 3)), np.empty(3)
    for axis in range(3):
        zero, cosine, sine = coefficients[axis][axis]
        level[axis, 2], height[axis] = zero, np.hypot(cosine, sine)
        for pose, channel in enumerate(OTHERS[axis]):
            zero, cosine, sine, asymmetry = coefficients[axis][channel]
            amplitude = np.hypot(cosine, sine)
            angle[axis, pose] = np.degrees(np.arctan2(sine, cosine))
            high[channel, pose], low[channel, pose] = zero + asymmetry + amplitude, zero + asymmetry - amplitude
            level[channel, pose] = zero
    return Extremes(angle, angle + 180.0, high, low, level, height, gravity_g, as_printed=False)


def extremes_of_samples(turns: Sequence[AxisTurns], gravity_g: float) -> Extremes:
    """Return the extremes as the largest and smallest samples of the turns, the readings of each pose from one sample.

    An axis is level in two poses of each turn in which it goes up and down, and in all four poses of the turn about it.
    """
    angle_high, angle_low, high, low = np.empty((4, 3, 2))
    level, height = np.empty((3, 8)), np.empty(3)
    for axis, turn in enumerate(turns):
        pair = list(OTHERS[axis])
        top, bottom = np.argmax(turn.reading[:, pair], axis=0), np.argmin(turn.reading[:, pair], axis=0)
        angle_high[axis], angle_low[axis] = turn.angle[top], turn.angle[bottom]
        for pose, channel in enumerate(pair):
            other = 1 - pose
            high[channel, pose] = turn.reading[top[pose], channel]
            low[channel, pose] = turn.reading[bottom[pose], channel]
            level[channel, 2 * pose : 2 * pose + 2] = turn.reading[[top[other], bottom[other]], channel]
        level[axis, 4:] = turn.reading[np.concatenate([top, bottom]), axis]
        height[axis] = turn.reading[:, axis].mean()
    return Extremes(angle_high, angle_low, high, low, level, height, gravity_g, as_printed=True)


def by_turn(sinusoids: Sequence[Sequence[Sinusoid]], values: Values) -> list[list[Values]]:
    """Return coefficients ``[turn][channel]`` from a vector in which the channels follow each other."""
    sizes = [len(turn[channel].coefficients) for channel in range(3) for turn in sinusoids]
    pieces = np.split(values, np.cumsum(sizes)[:-1])
    return [pieces[turn :: len(sinusoids)] for turn in range(len(sinusoids))]


def _per_axis(name: str, values: Values, unit: str) -> NamedValues:
    return {f"{name}_{axis}": (float(value), unit) for axis, value in zip(AXES, values, strict=True)}


def _angles(sides: Mapping[str, Values]) -> NamedValues:
    named = [(f"{name}_{side}", a) for side, angles in sides.items() for name, a in zip(GREEK, angles, strict=True)]
    return {name: (float(angle), "deg") for name, angle in named}


def orthogonality(extremes: Extremes) -> EstimatedSteps:
    """Return the factors of orthogonality (3.15-3.29).

    In turns about x, y, z the upper extremes of the two other axes should be 90 deg apart; their excesses are

        alpha_P = (A - B) - 90,   beta_P, gamma_P likewise;   alpha_N, beta_N, gamma_N of the lower extremes

    where A and B are the table angles at which the first and the second axis of (y, z), (z, x), (x, y) read most.
    Readings above the level reading are multiplied by O_P, those below by O_N; with x as the reference axis

        O = diag(1, cos gamma, cos alpha cos beta)

    As printed, (3.26) is ``O = diag(cos beta cos gamma, cos alpha cos gamma, cos alpha cos beta)``, which contradicts x
    being the reference and every printed O_x = 1, and the side is chosen by the sign of the reading with its bias. A
    filter delays both extremes of a pair by the same angle while the table turns evenly, so the excesses do not change.
    """

    def factors(excess_deg: Values) -> Values:
        a, b, c = np.cos(np.radians(excess_deg))
        return np.array([b * c, a * c, a * b] if extremes.as_printed else [1.0, c, a * b])

    angles = {"P": extremes.angle_high, "N": extremes.angle_low}
    # within [-180, 180) deg
    excess = {side: (angle[:, 0] - angle[:, 1] - 90.0 + 180.0) % 360.0 - 180.0 for side, angle in angles.items()}
    positive, negative = factors(excess["P"]), factors(excess["N"])
    switch_at = np.zeros(3) if extremes.as_printed else extremes.a_zero
    values = _per_axis("O_P", positive, "1") | _per_axis("O_N", negative, "1")
    values |= _angles(excess)
    return [TwoSided(positive, negative, switch_at)], values


def misalignment(extremes: Extremes) -> EstimatedSteps:
    """Return the factors of misalignment (3.30-3.37).

    While the table turns about an axis, that axis should stay level. Its reading gives the angle

        alpha = asin(a_height / a_max)   of x, beta of y, gamma of z

    and all axes are multiplied by ``M_P = cos alpha_P cos beta_P cos gamma_P``, negative readings by M_N. By default
    a_height is the amplitude of the axis's swing while the table turns about it, independent of a bias, and a_max is
    (a_max - a_min) / 2, the same on both sides: M_P = M_N. As printed a_height is the mean of the axis's readings, bias
    included, over a_max for M_P and over |a_min| for M_N, and the side is chosen by the sign of the reading.
    """

    def angles(largest: Values) -> Values:
        ratio = extremes.height / largest
        for axis, value in zip(AXES, ratio, strict=True):
            if not abs(value) < 1.0:
                raise NotObservableError(
                    f"accelerometer {axis} reads {abs(value):.3g} times its largest reading while the table turns "
                    f"about {axis}, where it should stay level: check sensor.axis_map, and which turn is about {axis}"
                )
        return np.asarray(np.arcsin(ratio))

    if extremes.as_printed:
        sides = {"P": angles(extremes.a_max), "N": angles(np.abs(extremes.a_min))}
    else:
        sides = dict.fromkeys("PN", angles((extremes.a_max - extremes.a_min) / 2.0))
    positive, negative = (float(np.prod(np.cos(sides[side]))) * np.ones(3) for side in "PN")
    values = _per_axis("M_P", positive, "1") | _per_axis("M_N", negative, "1")
    values |= _angles({side: np.degrees(angle) for side, angle in sides.items()})
    switch_at = np.zeros(3) if extremes.as_printed else extremes.a_zero
    return [TwoSided(positive, negative, switch_at)], values


def bias(extremes: Extremes) -> EstimatedSteps:
    """Return the bias (3.38-3.39): ``a_bi = a_mis - b``, b = a_zero, the mean reading of each axis where level."""
    b = extremes.a_zero
    return [Subtract(b)], _per_axis("b", b, "g")


def scale_factor(extremes: Extremes) -> EstimatedSteps:
    """Return a scale factor for each side (3.40-3.43).

        S_P = G / (a_max - a_zero),   S_N = G / |a_min - a_zero|,   a_sc = a_bi S

    As printed it is ``G / a_max - a_zero``, and a_zero is subtracted once more in (3.42) and (3.43), without effect
    after the bias stage, where a_zero is about zero.
    """
    G, a_max, a_min, a_zero = extremes.gravity_g, extremes.a_max, extremes.a_min, extremes.a_zero
    if extremes.as_printed:
        positive, negative = G / a_max - a_zero, G / np.abs(a_min) - a_zero
        steps: list[CorrectionStep] = [Subtract(a_zero), TwoSided(positive, negative, np.zeros(3))]
    else:
        positive, negative = G / (a_max - a_zero), G / np.abs(a_min - a_zero)
        steps = [TwoSided(positive, negative, a_zero)]
    return steps, _per_axis("S_P", positive, "1") | _per_axis("S_N", negative, "1")


STAGE_EQUATIONS = {f.__name__: f for f in (orthogonality, misalignment, bias, scale_factor)}


@dataclass(frozen=True)
class CorrectedForces:
    """The output of a stage: the correction so far in both forms, and the parameters of the last stage."""

    steps: list[CorrectionStep] = field(default_factory=list)
    bias: Values = field(default_factory=lambda: np.zeros(3))
    positive: Values = field(default_factory=lambda: np.ones(3))
    negative: Values = field(default_factory=lambda: np.ones(3))
    values: NamedValues = field(default_factory=dict)

    @classmethod
    def of(cls, previous: SensorCalibration | None) -> CorrectedForces:
        """Return the output of the stage before."""
        if previous is None or not previous.stages:
            return cls()
        k = 1.0 / np.diag(previous.matrix)
        c = sum((e.values for e in previous.effects if e.name == ASYMMETRY), np.zeros(3))
        return cls([*(previous.stages[-1].correction or ())], previous.bias, 1.0 / (k + c), 1.0 / (k - c))

    @property
    def k(self) -> Values:
        """Reading per g, mean of both sides: (3,) array."""
        return (1.0 / self.positive + 1.0 / self.negative) / 2.0

    @property
    def c(self) -> Values:
        """Half the difference of both sides: (3,) array."""
        return (1.0 / self.positive - 1.0 / self.negative) / 2.0

    def after(self, step: CorrectionStep, *, averaged: bool) -> CorrectedForces:
        """Return the correction after a further step; ``averaged``: the factors of both sides are averaged."""
        steps = [*self.steps, step]
        if isinstance(step, Subtract):
            return replace(self, steps=steps, bias=self.bias + step.offset * self.k)
        assert isinstance(step, TwoSided)  # noqa: S101  (``STAGE_EQUATIONS``)
        positive, negative = step.positive, step.negative
        if averaged:
            positive = negative = (positive + negative) / 2.0
        return replace(self, steps=steps, positive=self.positive * positive, negative=self.negative * negative)

    def vector(self) -> Values:
        """Return bias, matrix, c and the last stage's parameters in one vector."""
        parameters = [value for value, _ in self.values.values()]
        return np.concatenate([base_values(self.bias, np.diag(1.0 / self.k)), self.c, parameters])


def follow(extremes: Extremes, names: Sequence[str], start: CorrectedForces | None = None) -> CorrectedForces:
    """Run stages one after the other, each on the output of the one before; ``start``: output before the first."""
    found = start or CorrectedForces()
    for step in found.steps:
        extremes = extremes.corrected(step)
    for name in names:
        steps, values = STAGE_EQUATIONS[name](extremes)
        for step in steps:
            extremes = extremes.corrected(step)
            found = found.after(step, averaged=name != "scale_factor")
        found = replace(found, values=values)
    return found


@dataclass(frozen=True)
class Estimator:
    """The estimates of the stages, without their uncertainty, from the turns of recordings."""

    turns: list[AxisTurns]
    gravity_g: float
    as_printed: bool

    @classmethod
    def of(cls, recordings: Sequence[Recording], settings: Settings) -> Estimator:
        """Return the turns of recordings; ``settings``: sections ``table`` and ``method``."""
        as_printed = settings.method.as_printed
        parts = parts_of(recordings, "accelerometer", settings.table, "the staged method")
        turns = turns_of(parts, as_printed=as_printed)
        return cls(turns, settings.table.gravity_g, as_printed)

    @cached_property
    def sinusoids(self) -> list[list[Sinusoid]]:
        """The sinusoid of each channel in each turn."""
        found = []
        for axis, turn in enumerate(self.turns):
            named = [(c, f"accelerometer {AXES[c]} in the turn about {AXES[axis]}") for c in range(3)]
            found += [[fit_sinusoid(turn.angle, turn.reading[:, c], sides=c != axis, where=name) for c, name in named]]
        return found

    def after(self, names: Sequence[str], start: CorrectedForces | None = None) -> CorrectedForces:
        """Return the output of stages; ``start``: output of the stage before the first."""
        if self.as_printed:
            return follow(extremes_of_samples(self.turns, self.gravity_g), names, start)
        coefficients = [[sinusoid.coefficients for sinusoid in turn] for turn in self.sinusoids]
        return follow(extremes_of_sinusoids(coefficients, self.gravity_g), names, start)


def fit(task: StageInput) -> SensorCalibration:
    """Run one stage of the staged method (``pipeline.estimation.stages``); role ``accelerometer``, on a table."""
    name, recordings, previous, settings = task.stage, task.recordings, task.previous, task.settings
    prior, before = task.prior, [stage.name for stage in task.stages]
    estimator = Estimator.of(recordings.filtered, settings)
    turns, gravity_g, sinusoids = estimator.turns, estimator.gravity_g, estimator.sinusoids
    theta = np.concatenate([s.coefficients for channel in range(3) for s in (turn[channel] for turn in sinusoids)])

    def chain(values: Values) -> Values:
        return follow(extremes_of_sinusoids(by_turn(sinusoids, values), gravity_g), [*before, name]).vector()

    found = estimator.after([name], CorrectedForces.of(previous))
    # A separate sinusoid for each turn and channel would absorb the changes of the bias from turn to turn.
    parts = [part for turn in turns for part in turn.parts]
    noise = noise_of_turns(parts, prior, settings.table, two_sided=True)
    if estimator.as_printed:
        scatter = _resampled(turns, sinusoids, noise, gravity_g, [*before, name])
    else:
        map_ = _linear_map(sinusoids, theta, chain)
        scatter = noise_contribution(noise, map_, prior)
    after = corrected(found.steps, np.concatenate([turn.reading for turn in turns]))
    after_c = BASE_COUNT + len(found.c)
    parameters = stage_parameters(found.values, scatter.covariance[after_c:, after_c:])
    rms = float(np.sqrt(np.mean((np.linalg.norm(after, axis=1) - gravity_g) ** 2)))
    details = details_on_table(noise, scatter.degrees_of_freedom, parts, len(after))
    result = StageResult(name, parameters, rms, tuple(found.steps), details)
    of_turns = [s for turn in sinusoids for s in turn]
    fits = [linear_convergence(s.columns, s.residuals, s.condition, s.columns.shape[1]) for s in of_turns]
    cosine, condition = max(each.cosine for each in fits), max(each.condition for each in fits)
    last = name == "scale_factor"
    effects = (fitted_effect(ASYMMETRY, "accelerometer", found.c),) if last else ()
    calibration = SensorCalibration(
        sensor="accelerometer",
        bias=found.bias,
        matrix=np.diag(1.0 / found.k),
        stages=(*task.stages, result),
        effects=effects,
        convergence=Convergence(cosine, condition, len(theta), len(theta)),
    )
    kept = slice(0, after_c) if last else BASE
    if estimator.as_printed:
        return combined(calibration, [scatter.of(kept)], {"everything but noise": AS_PRINTED})
    reference = Reference("accelerometer", used_motions(parts), np.diag(found.k), settings.table)

    def results(errors: Values) -> Values:
        return np.array([chain(theta + e)[kept] for e in errors])

    return budgeted(calibration, reference, map_.results(kept), noise, [scatter.of(kept)], settings, results)


def _linear_map(sinusoids: Sequence[Sequence[Sinusoid]], theta: Values, chain: Callable[[Values], Values]) -> LinearMap:
    """Return the map from readings to ``CorrectedForces.vector``, by the derivative of all stages so far."""
    here = chain(theta)
    steps = DIFFERENCE_STEP_G * np.eye(len(theta))
    columns = np.stack([(chain(theta + step) - here) / DIFFERENCE_STEP_G for step in steps], axis=1)
    x, y, z = (np.asarray(scipy.linalg.block_diag(*(turn[c].weights for turn in sinusoids))) for c in range(3))
    J_x, J_y, J_z = np.split(columns, np.cumsum([len(x), len(y)]), axis=1)
    return LinearMap((x, y, z), (J_x, J_y, J_z))


def _resampled(
    turns: Sequence[AxisTurns],
    sinusoids: Sequence[Sequence[Sinusoid]],
    noise: ResidualNoise,
    gravity_g: float,
    names: Sequence[str],
) -> Contribution:
    """Return the contribution of the noise to the parameters of stages, from their scatter over synthetic turns."""
    pairs = list(zip(turns, sinusoids, strict=True))
    means = [turn.reading - np.column_stack([s.residuals for s in fits]) for turn, fits in pairs]
    cuts = np.cumsum([len(turn.angle) for turn in turns])[:-1]
    vectors = []
    for noisy in noise.draws(np.random.default_rng(SEED), REPLICATES):
        drawn = zip(turns, means, np.split(noisy, cuts), strict=True)
        synthetic = [replace(turn, reading=mean + new) for turn, mean, new in drawn]
        vectors.append(follow(extremes_of_samples(synthetic, gravity_g), names).vector())
    return scatter_contribution(np.cov(np.array(vectors).T), REPLICATES - 1.0)
