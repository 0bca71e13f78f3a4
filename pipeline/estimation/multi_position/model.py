"""The model of one sensor in rests and moves, and its linearised equations at given parameters.

    r = X d + e,    cov e = k C,    C = I + S + sum_j a_j^2 diag(g_j) + c^2 D + q^2 H R H^T

where

r   : (n,) residuals, each over its standard deviation by white noise
X   : (n, p) derivatives of the model with respect to its parameters; d: a step of the parameters
S   : (n, n) covariance by errors of the accelerometer, which equations of the gyroscope share
g_j : (n,) variance of the scatter of the rests, or of the moves, beyond white noise (tremor), in units of the median
      white error; a_j is its size
D   : (n, n) covariance by errors of the direction of gravity at each rest, as large as the median white error of a
      move; two moves share each error; c is their size (a support that yields, a hand that drifts)
H   : (n, 3 t) derivatives with respect to the bias of each axis in each of t stretches of time, over its white noise
R   : (t, t) covariance of a Gauss-Markov bias of unit variance, averaged over each stretch
q   : standard deviation of that bias over white noise
k   : at least 1: scatter beyond the hypotheses of a grid

The steadiness of a unit by hand is unknown: a, c, q and k are free in all comparisons (``likelihood``).

The models of both sensors have: ``kinds`` of scatter (1: rests; 2: rests and moves), ``rests_equations`` (their number;
they come first), ``white`` noise of a raw sample, and ``directions``, (12, b): change of bias and matrix by each base
parameter.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import scipy

from pipeline.estimation import design
from pipeline.estimation.gauss_markov import block_covariance
from pipeline.model.effects.base import Effect, Owner
from pipeline.records import Index, Mask, Motion, Values

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from pipeline.estimation.design import Term
    from pipeline.estimation.multi_position.accelerometer import AccelerometerModel
    from pipeline.estimation.multi_position.gyroscope import GyroscopeModel
    from pipeline.estimation.multi_position.likelihood import NoiseHypothesis
    from pipeline.estimation.rest_means import Rests

Model: TypeAlias = "AccelerometerModel | GyroscopeModel"


@dataclass(frozen=True)
class State:
    """Parameters: bias (3,), matrix (3, 3), and the effects at their values."""

    bias: Values
    matrix: Values
    terms: tuple[Term, ...] = ()

    @property
    def K(self) -> Values:  # noqa: N802  (as in every equation)
        """Inverse of the matrix: (3, 3) array."""
        return np.asarray(np.linalg.solve(self.matrix, np.eye(3)), np.float64)


@dataclass(frozen=True)
class Equations:
    """The linearised equations at given parameters; see the module."""

    residual: Values  # (n,)
    base: Values  # (n, b); columns of bias and matrix
    # lists of (n, p); columns of the effects of the model, and of effects that are not in it
    effects: list[Values]
    candidates: list[Values]
    scatter: Values  # (s, n); the g_j
    bias: Values  # (3, n, t); H, axis by axis
    # each (t,), s; the stretches of time
    start: Values
    length: Values
    joined: Mask  # (t, t); whether the time between two stretches is known
    error: Values  # (n,), g, deg/s or deg; standard deviation of each equation by white noise
    # each (n, n); S and D
    common: Values | None = None
    direction: Values | None = None
    _kernels: dict[float, Values] = field(default_factory=dict, compare=False, repr=False)

    @property
    def columns(self) -> Values:
        """Columns of the model: (n, b + p) array."""
        return np.concatenate([self.base, *self.effects], axis=1)

    def variance(self, noise: NoiseHypothesis) -> Values:
        """Return the diagonal of C by white noise and scatter: (n,) array."""
        return np.asarray(1.0 + np.square(noise.scatter) @ self.scatter)

    def covariance(self, noise: NoiseHypothesis) -> Values:
        """Return C: (n, n) array."""
        C = np.diag(self.variance(noise))
        if self.common is not None:
            C += self.common
        if self.direction is not None and noise.direction:
            C += noise.direction**2 * self.direction
        if noise.bias.ratio:
            if noise.bias.time not in self._kernels:
                R = np.where(self.joined, block_covariance(self.start, self.length, noise.bias.time), 0.0)
                self._kernels[noise.bias.time] = np.sum(self.bias @ R @ self.bias.transpose(0, 2, 1), axis=0)
            C += noise.bias.ratio**2 * self._kernels[noise.bias.time]
        return C

    def whitened(self, noise: NoiseHypothesis, values: Values) -> tuple[Values, float]:
        """Return ``L^-1`` times (n, p) values, where ``L L^T = C``, and log det C."""
        if self.common is None and not noise.direction and not noise.bias.ratio:
            variance = self.variance(noise)
            return values / np.sqrt(variance)[:, None], float(np.sum(np.log(variance)))
        L, failed = scipy.linalg.lapack.dpotrf(self.covariance(noise), lower=1)
        assert failed == 0  # noqa: S101
        solved, failed = scipy.linalg.lapack.dtrtrs(L, values, lower=1)
        assert failed == 0  # noqa: S101
        return solved, 2.0 * float(np.sum(np.log(np.diag(L))))


@dataclass(frozen=True)
class Block:
    """Equations of one kind, over the white noise of each: rests, moves, faces or turns; symbols of ``Equations``."""

    residual: Values  # (n,)
    base: Values  # (n, 12), of bias and matrix
    columns: Callable[[Term], Values]  # (n, p), of an effect
    error: Values  # (n,)
    bias: Values | None = None  # (3, n, t); None: zeros
    stretches: tuple[Values, Values, Index] | None = None  # start, length, recording; None: those of the rests
    scattered: bool = False  # whether a separate kind of scatter adds to them
    # each (n, n); None: zeros
    common: Values | None = None
    direction: Values | None = None
    shared: Values | None = None  # (n, 12); change of moves by errors of the accelerometer's calibration


def stacked(blocks: Sequence[Block], model: Model, state: State, candidates: Sequence[Term]) -> Equations:
    """Stack blocks of equations; the block of the rests is the first."""
    sizes = [len(block.residual) for block in blocks]
    edges = np.cumsum([0, *sizes])
    start, length, recording = (
        np.concatenate(times) for times in zip(*(b.stretches for b in blocks if b.stretches is not None), strict=True)
    )
    scatter = np.zeros((sum(block.scattered for block in blocks), edges[-1]))
    bias, column = np.zeros((3, edges[-1], len(start))), 0
    for kind, (block, rows) in enumerate(zip(blocks, map(slice, edges[:-1], edges[1:]), strict=True)):
        if block.scattered:
            scatter[kind, rows] = np.square(np.median(block.error) / block.error)
        if block.bias is not None:
            first = 0 if block.stretches is None else column
            bias[:, rows, first : first + block.bias.shape[2]] = block.bias
        column += 0 if block.stretches is None else len(block.stretches[0])

    def diagonal(parts: Sequence[Values | None]) -> Values | None:
        if all(part is None for part in parts):
            return None
        filled = (np.zeros((n, n)) if part is None else part for part, n in zip(parts, sizes, strict=True))
        return np.asarray(scipy.linalg.block_diag(*filled))

    same = recording[:, None] == recording
    return Equations(
        residual=np.concatenate([block.residual for block in blocks]),
        base=np.concatenate([block.base for block in blocks]) @ model.directions,
        effects=[np.concatenate([block.columns(term) for block in blocks]) for term in state.terms],
        candidates=[np.concatenate([block.columns(term) for block in blocks]) for term in candidates],
        scatter=scatter,
        bias=bias,
        start=start,
        length=length,
        joined=np.ones_like(same) if model.rests.clock_shared else same,
        error=np.concatenate([block.error for block in blocks]),
        common=diagonal([block.common for block in blocks]),
        direction=diagonal([block.direction for block in blocks]),
    )


def stepped(model: Model, state: State, step: Values) -> tuple[State, Values]:
    """Return the parameters after a step, and the step taken, which effects may limit."""
    count = model.directions.shape[1]
    change = model.directions @ step[:count]
    terms, taken = design.stepped(state.terms, step[count:])
    moved = State(state.bias + change[:3], state.matrix + change[3:].reshape(3, 3), tuple(terms))
    return moved, np.concatenate([step[:count], taken])


def motion_of(time: Values, force: Values, rate: Values, temperature: Values, *, still: bool) -> Motion:
    """Return the motion with the unit's calibrated signals; derivatives are zero."""
    nothing = np.zeros_like(force)
    return Motion(
        time=time,
        specific_force=force,
        angular_rate=rate,
        angular_acceleration=nothing,
        specific_force_rate=nothing,
        temperature=None if np.isnan(temperature).any() else temperature,
        angle=None,
        rate=None,
        axis=None,
        still=np.full(len(time), still),
        direction=nothing,
    )


def effect_readings(sensor: str, terms: Sequence[Term], motion: Motion, K: Values) -> Values:
    """Return what effects add to the readings: (n, 3) array."""
    readings = (term.effect.reading(sensor, motion, K, term.values) for term in terms)
    return np.asarray(sum(readings, np.zeros_like(motion.specific_force)))


def refusal(this: Effect, sensor: str, rests: Rests) -> str:
    """Return why an effect cannot be in a model without a table; empty if it can."""
    unknown = [need for need in this.needs if need != "temperature"]
    checks = [
        (sensor not in this.sensors, f"{this.name} is no effect of the {sensor}"),
        (sensor in this.unseen, this.unseen.get(sensor, "")),
        (this.owner == Owner.TABLE or this.moves, "there is no table"),
        (this.owner == Owner.MOUNTING, "by hand nobody knows the unit's heading, nor about which point it turns"),
        ("temperature" in this.needs and np.isnan(rests.temperature).any(), "the recordings hold no temperature"),
        (bool(unknown), f"without a table nobody knows the {' and '.join(unknown)}"),
        (this.needs_clock and not rests.clock_shared, "the time between the recordings is not known"),
    ]
    return next((reason for applies, reason in checks if applies), "")
