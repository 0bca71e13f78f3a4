"""Compute the extremes of the readings in turns, for the staged method (Sudsanguan 2019, eqs 3.15-3.25).

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

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from pipeline.core.errors import NotObservableError
from pipeline.core.records import AXES, Convergence, CorrectionStep, Mask, TwoSided, Values
from pipeline.estimation.engine import ScaledColumns, linear_convergence
from pipeline.estimation.turns import TurnPart, filtered_alike

PHASE_ITERATIONS = 12  # of the phase
SAME_PHASE = 1e-12  # rad
MIN_TURN_SINGULAR_VALUE = 1e-3  # smallest singular value of unit columns that still counts as determined
OTHERS = ((1, 2), (2, 0), (0, 1))  # first and second axis of a turn about x, y, z


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

    @property
    def excess_high(self) -> Values:
        """alpha_P, beta_P, gamma_P: angle between the upper extremes of a turn, minus 90 deg."""
        return wrap(self.angle_high[:, 0] - self.angle_high[:, 1] - 90.0)

    @property
    def excess_low(self) -> Values:
        """alpha_N, beta_N, gamma_N: the same of the lower extremes."""
        return wrap(self.angle_low[:, 0] - self.angle_low[:, 1] - 90.0)

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
        used = [
            replace(part, keep=samples_of(part, as_printed=as_printed)) for part in parts if part.motion.axis == axis
        ]
        if not any(np.any(part.keep) for part in used):
            raise NotObservableError(
                f"no usable sample of a turn about body axis {AXES[axis]}: the staged method needs a turn about each "
                "of x, y and z; record it, or choose reference_least_squares"
            )
        angle = np.concatenate([np.asarray(part.motion.angle)[part.keep] for part in used])
        turns.append(AxisTurns(angle, np.concatenate([part.reading("accelerometer") for part in used]), used))
    return turns


def samples_of(part: TurnPart, *, as_printed: bool) -> Mask:
    """Return which samples of a part are used."""
    return part.keep if as_printed else filtered_alike(part)


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


def wrap(angle_deg: Values) -> Values:
    """Return angles in [-180, 180) deg."""
    return (angle_deg + 180.0) % 360.0 - 180.0


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


def sinusoids_of(turns: Sequence[AxisTurns]) -> list[list[Sinusoid]]:
    """Fit a sinusoid to each channel in each turn: ``[turn][channel]``."""
    return [
        [
            fit_sinusoid(
                turn.angle,
                turn.reading[:, channel],
                sides=channel != axis,
                where=f"accelerometer {AXES[channel]} in the turn about {AXES[axis]}",
            )
            for channel in range(3)
        ]
        for axis, turn in enumerate(turns)
    ]


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


def convergence_of_sinusoids(sinusoids: Sequence[Sequence[Sinusoid]]) -> Convergence:
    """Return the evidence of the sinusoids' fits: the largest cosine and condition of all."""
    fits = [s for turn in sinusoids for s in turn]
    parts = [linear_convergence(s.columns, s.residuals, s.condition, s.columns.shape[1]) for s in fits]
    count = sum(part.parameters for part in parts)
    return Convergence(max(part.cosine for part in parts), max(part.condition for part in parts), count, count)
