"""The model of one sensor in rests and moves: its linearised equations and hypotheses about the noise.

    r = X d + e,    cov e = k C,    C = I + S + sum_j a_j^2 diag(g_j) + c^2 D + q^2 H R H^T

where

r   : (n,) residuals, each over its standard deviation by white noise
X   : (n, p) derivatives of the model with respect to its parameters; d: a step of the parameters
S   : (n, n) covariance by errors of the accelerometer, which equations of the gyroscope share
g_j : (n,) variance of the scatter of the rests, or of the moves, beyond white noise (tremor), in units of the median
      white error; a_j is its size. In slow movement ``exp(-|t_i - t_j| / T)`` is its correlation
D   : (n, n) covariance by errors of the direction of gravity at each rest, as large as the median white error of a
      move; two moves share each error; c is their size (a support that yields, a hand that drifts)
H   : (n, 3 t) derivatives with respect to the bias of each axis in each of t stretches of time, over its white noise
R   : (t, t) covariance of a Gauss-Markov bias of unit variance, averaged over each stretch
q   : standard deviation of that bias over white noise
k   : at least 1: scatter beyond the hypotheses of a grid (``fit``), of all equations but those of limits

A parameter that the recordings do not determine has a separate equation, a pseudo-observation of the value of an ideal
sensor with the standard uncertainty u by the sensor file's limit. ``between`` is the standard
deviation of the bias from one recording to the next, over white noise: it adds ``between^2 H J H^T`` to S, where J is 1
for two stretches of one recording and else 0. Limits and stated axes are of the case, and the frame of the fit is off
it by three angles of one standard uncertainty: their change F of the equations adds ``F F^T`` to S.

The models of both sensors have: ``kinds`` of scatter (1: rests; 2: rests and moves), ``rests_equations`` (their number;
they come first), ``white`` noise of a raw sample, and ``directions``, (12, b): change of bias and matrix by each base
parameter.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias, TypeVar

import numpy as np
import scipy

from pipeline.core.errors import CannotCalibrateError, NotObservableError
from pipeline.core.records import BIAS, Index, Mask, Motion, Noise, Values, base_values, matrix_of, motion_at_rest
from pipeline.estimation import design
from pipeline.estimation.design import EffectColumns, Terms
from pipeline.estimation.engine import cholesky
from pipeline.estimation.gauss_markov import NO_INSTABILITY_ODDS, Setting, WanderPrior, block_covariance, selection_grid
from pipeline.estimation.rest_means import Rests

if TYPE_CHECKING:
    from pipeline.estimation.multi_position.accelerometer import AccelerometerModel
    from pipeline.estimation.multi_position.faces_and_turns import TurnsByHand
    from pipeline.estimation.multi_position.gyroscope import GyroscopeModel
    from pipeline.estimation.multi_position.moves import Moves

Model: TypeAlias = "AccelerometerModel | GyroscopeModel"

Fitted = TypeVar("Fitted")
# The grids below were chosen by the study of 500 recordings (tests/study/test_hand_held_study.py); ``fit.refined``
# refines their steps where the data determine the scatter better.
UNLIKELY = -4.0  # prior log weight of a setting, e^-4 of the likeliest
INSTABILITY_FACTORS = 3.0 ** np.arange(-2.0, 3.0)  # of the bias instability of the prior
INSTABILITY_RATIOS = (0.1, 0.3, 1.0)  # of bias instability to white noise where none is stated
START_SCATTERS = (0.0, 1.0, 3.0, 9.0, 27.0)  # of rests, of moves and of directions, for a covariance
SELECTION_SCATTER = ((0.0, 2.0, 6.0, 20.0), (0.0, 4.0, 16.0))  # of rests, and of moves, where models are compared
# Parameters that are 1 in an ideal sensor; all others are 0.
ONE = {f"{prefix}{axis}" for axis in "xyz" for prefix in ("scale_factor_", f"matrix_{axis}")}


@dataclass(frozen=True)
class NoiseHypothesis:
    """One hypothesis about the noise."""

    SLOW_BIAS: ClassVar[int] = -2  # the bias at low frequencies, beside the numbers of ``levels``
    BIAS_TIME: ClassVar[int] = -1  # its correlation time
    bias: Setting  # q, bias over white noise, and its time
    scatter: tuple[float, ...]  # the a_j: of rests, and of moves
    direction: float = 0.0  # c
    none: float = 0.0  # prior log weight of each kind without scatter
    known: bool = False  # whether the white noise is known; any excess of the residuals is then scatter

    @property
    def prior(self) -> float:
        """Prior log weight."""
        return self.bias.prior + self.none * self.scatter.count(0.0)

    @property
    def levels(self) -> tuple[float, ...]:
        """Scatter of each kind, and c."""
        return *self.scatter, self.direction

    @property
    def free_scale(self) -> bool:
        """Whether C is scaled to the residuals."""
        return not self.known or max(self.scatter) >= START_SCATTERS[-1]

    def at(self, levels: Sequence[float]) -> NoiseHypothesis:
        """Return the hypothesis at other levels."""
        return replace(self, scatter=tuple(levels[:-1]), direction=levels[-1])

    def scaled(self, j: int, factor: float) -> NoiseHypothesis:
        """Return the hypothesis with one of its levels multiplied, or the bias at low frequencies, or its time."""
        if j >= 0:
            return self.at([level * (factor if i == j else 1.0) for i, level in enumerate(self.levels)])
        if j == self.SLOW_BIAS:
            return replace(self, bias=self.bias._replace(ratio=self.bias.ratio * factor))
        return replace(self, bias=self.bias._replace(ratio=self.bias.ratio / factor**0.5, time=self.bias.time * factor))


@dataclass(frozen=True)
class State:
    """Parameters: bias (3,), matrix (3, 3), and the effects at their values."""

    bias: Values
    matrix: Values
    terms: tuple[EffectColumns, ...] = ()

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
    scatter: Values  # (s, n); the g_j, zeros of a kind without equations
    bias: Values  # (3, n, t); H, axis by axis
    # each (t,), s; the stretches of time
    start: Values
    length: Values
    joined: Mask  # (t, t); whether the time between two stretches is known
    error: Values  # (n,), g, deg/s or deg; standard deviation of each equation by white noise
    # each (n, n); S and D
    common: Values | None = None
    direction: Values | None = None
    frame: Values | None = None  # (n, 3); F
    between: Values | None = None  # (n, 3 f); change by the bias of each recording, one standard deviation
    files: int = 1  # number of recordings with rests, whose means show that bias
    alike: Values | None = None  # (n, n); covariance of the scatter between rests of slow movement, for a_0 = 1
    stated: int = 0  # number of the last equations, which are pseudo-observations of limits
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
        n = len(self.residual)
        C = np.zeros((n, n)) if self.common is None else self.common.copy()
        C.flat[:: n + 1] += self.variance(noise)
        if self.direction is not None and noise.direction:
            C += noise.direction**2 * self.direction
        if self.alike is not None:
            C += noise.scatter[0] ** 2 * self.alike
        if noise.bias.ratio:
            if noise.bias.time not in self._kernels:
                R = np.where(self.joined, block_covariance(self.start, self.length, noise.bias.time), 0.0)
                self._kernels[noise.bias.time] = np.sum(self.bias @ R @ self.bias.transpose(0, 2, 1), axis=0)
            C += noise.bias.ratio**2 * self._kernels[noise.bias.time]
        return C

    def whitened(self, noise: NoiseHypothesis, values: Values, k: float = 1.0) -> tuple[Values, float]:
        """Return ``L^-1`` times (n, p) values, where ``L L^T = C``, those of limits times sqrt(k), and log det C."""
        L, log_determinant = self.factor(noise)
        if L.ndim == 1:
            solved = values / L[:, None]
        else:
            solved, failed = scipy.linalg.lapack.dtrtrs(L, values, lower=1)
            assert failed == 0  # noqa: S101
        solved[len(solved) - self.stated :] *= np.sqrt(k)
        return solved, log_determinant

    def factor(self, noise: NoiseHypothesis) -> tuple[Values, float]:
        """Return the lower triangular L, or its diagonal where C is diagonal, and log det C."""
        if self.common is None and self.alike is None and not noise.direction and not noise.bias.ratio:
            variance = self.variance(noise)
            return np.sqrt(variance), float(np.sum(np.log(variance)))
        L, failed = scipy.linalg.lapack.dpotrf(self.covariance(noise).T, lower=1, clean=0, overwrite_a=1)
        if failed:
            L = cholesky(self.covariance(noise))
        return L, 2.0 * float(np.sum(np.log(np.diag(L))))

    def scaled(self, noise: NoiseHypothesis, k: float) -> Values:
        """Return the covariance of the residuals, ``k C`` but for the errors of limits: (n, n) array."""
        L = cholesky(self.covariance(noise))
        L[:, : len(L) - self.stated] *= np.sqrt(k)
        return np.asarray(L @ L.T)

    def ceilings(self, hypotheses: Sequence[NoiseHypothesis]) -> Values:
        """Return the largest log L that a model can have under each hypothesis, with no residual: (t,) array."""
        return np.array([noise.prior - 0.5 * self.factor(noise)[1] for noise in hypotheses])


@dataclass(frozen=True)
class EquationBlock:
    """Equations of one kind, over the white noise of each: rests, moves, faces or turns; symbols of ``Equations``."""

    residual: Values  # (n,)
    base: Values  # (n, 12), of bias and matrix
    columns: Callable[[EffectColumns], Values]  # (n, p), of an effect
    error: Values  # (n,)
    bias: Values | None = None  # (3, n, t); None: zeros
    stretches: tuple[Values, Values, Index] | None = None  # start, length, recording; None: those of the rests
    scattered: bool = False  # whether a separate kind of scatter adds to them
    # each (n, n); None: zeros
    common: Values | None = None
    direction: Values | None = None
    frame: Values | None = None  # (n, 3); F; None: zeros
    shared: Values | None = None  # (n, 12); change of moves by errors of the accelerometer's calibration
    force: Values | None = None  # (n, m, 3); change of moves by the specific force at each rest, per g
    alike: Values | None = None  # (n, n), of ``Equations``
    stated: bool = False  # whether they are pseudo-observations of limits; the last block


def stacked(blocks: Sequence[EquationBlock], model: Model, state: State, candidates: Terms) -> Equations:
    """Stack blocks of equations; the block of the rests is the first.

    Blocks beyond the kinds of scatter, as the parts of soaks, share the last kind.
    """
    sizes = [len(block.residual) for block in blocks]
    edges = np.cumsum([0, *sizes])
    stretches = (b.stretches for b in blocks if b.stretches is not None)
    start, length, recording = (np.concatenate(times) for times in zip(*stretches, strict=True))
    scatter = np.zeros((model.kinds, edges[-1]))
    bias, column = np.zeros((3, edges[-1], len(start))), 0
    for kind, (block, rows) in enumerate(zip(blocks, map(slice, edges[:-1], edges[1:]), strict=True)):
        if block.scattered:
            scatter[min(kind, model.kinds - 1), rows] = np.square(np.median(block.error) / block.error)
        if block.bias is not None:
            first = 0 if block.stretches is None else column
            bias[:, rows, first : first + block.bias.shape[2]] = block.bias
        column += 0 if block.stretches is None else len(block.stretches[0])

    def diagonal(parts: Sequence[Values | None]) -> Values | None:
        if all(part is None for part in parts):
            return None
        filled = (np.zeros((n, n)) if part is None else part for part, n in zip(parts, sizes, strict=True))
        return np.asarray(scipy.linalg.block_diag(*filled))

    same, common = recording[:, None] == recording, diagonal([block.common for block in blocks])
    between = None
    if model.between:
        own = np.unique(recording)[:, None] == recording
        between = model.between * np.concatenate([H @ own.T for H in bias], axis=1)
        common = between @ between.T if common is None else common + between @ between.T
    frame = None
    if any(block.frame is not None for block in blocks):
        frame = np.concatenate([np.zeros((len(b.residual), 3)) if b.frame is None else b.frame for b in blocks])
        common = frame @ frame.T if common is None else common + frame @ frame.T
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
        common=common,
        direction=diagonal([block.direction for block in blocks]),
        frame=frame,
        between=between,
        files=len(np.unique(model.rests.recording)),
        alike=diagonal([block.alike for block in blocks]),
        stated=sizes[-1] if blocks[-1].stated else 0,
    )


def stepped(model: Model, state: State, step: Values) -> tuple[State, Values]:
    """Return the parameters after a step, and the step taken, which effects may limit."""
    count = model.directions.shape[1]
    change = model.directions @ step[:count]
    terms, taken = design.stepped(state.terms, step[count:])
    moved = State(state.bias + change[BIAS], state.matrix + matrix_of(change), tuple(terms))
    return moved, np.concatenate([step[:count], taken])


def motion_at_rests(rests: Rests, force: Values) -> Motion:
    """Return the motion at rests with the specific force (m, 3), g."""
    return motion_of(rests, force, np.zeros_like(force), still=True)


def motion_of(part: Rests | Moves | TurnsByHand, force: Values, rate: Values, *, still: bool) -> Motion:
    """Return the motion, without derivatives, at rests or samples of moves or turns by calibrated signals (n, 3)."""
    time, temperature, warming = (values.ravel() for values in (part.time, part.temperature, part.temperature_rate))
    known: dict[str, Any] = {"specific_force": force, "angular_rate": rate, "direction": np.zeros_like(force)}
    if not np.isnan(temperature).any():
        known |= {"temperature": temperature, "temperature_rate": warming}
    return replace(motion_at_rest(time), still=np.full(len(time), still), **known)


def effect_readings(sensor: str, terms: Terms, motion: Motion, K: Values) -> Values:
    """Return what effects add to the readings: (n, 3) array."""
    readings = (term.effect.reading(sensor, motion, K, term.values) for term in terms)
    return np.asarray(sum(readings, np.zeros_like(motion.specific_force)))


def selection_hypotheses(noise: Noise | None, kinds: int) -> list[NoiseHypothesis]:
    """Return the hypotheses for the comparison of models: every bias instability with every scatter.

    ``noise``: from a static recording, it determines the bias instability. ``kinds``: number of kinds of scatter.
    """
    settings = selection_grid(noise)
    if kinds > 1:  # two kinds of scatter do not determine a bias far from that of a static recording
        settings = [s for s in settings if s.prior > UNLIKELY]
    hypotheses = [NoiseHypothesis(s, level) for s in settings for level in product(*SELECTION_SCATTER[:kinds])]
    steady_moves = [h for h in hypotheses if kinds > 1 and h.scatter[1] == 0.0]
    return hypotheses + [replace(h, direction=c) for h in steady_moves for c in SELECTION_SCATTER[1][1:]]


def prior_hypotheses(prior: WanderPrior, white: float, kinds: int) -> list[NoiseHypothesis]:
    """Return the hypotheses over which a covariance is averaged; ``prior``: of the bias instability.

    ``white``: white noise of a sample, unit of the sensor. ``kinds``: number of kinds of scatter.
    """
    steps = prior.wander * INSTABILITY_FACTORS if prior.wander > 0.0 else white * np.array(INSTABILITY_RATIOS)
    bias = np.append(0.0, steps)
    pairs = zip((bias / white).tolist(), prior.log_belief(bias).tolist(), strict=True)
    # no scatter is stated, so that none at all is the likeliest
    none = float(np.log(NO_INSTABILITY_ODDS * (len(START_SCATTERS) - 1)))
    settings = [Setting(ratio, prior.time, belief) for ratio, belief in pairs if np.isfinite(belief)]
    levels = list(product(START_SCATTERS, repeat=kinds))
    hypotheses = [NoiseHypothesis(setting, level, none=none) for setting in settings for level in levels]
    steady_moves = [h for h in hypotheses if kinds > 1 and h.scatter[1] in {START_SCATTERS[0], START_SCATTERS[2]}]
    return hypotheses + [replace(h, direction=c) for h in steady_moves for c in START_SCATTERS[2:]]


def limit_block(known: Mapping[str, float], columns: Values, state: State, unit: float = 1.0) -> EquationBlock:
    """Return the pseudo-observations of parameters that the sensor file's limits alone determine.

    ``known``: name to standard uncertainty; ``columns``: (k, 12), derivative of each by bias and matrix; ``unit``:
    factor of the errors that are reported.
    """
    u = np.array(list(known.values()))
    ideal = np.array([float(name in ONE) for name in known])
    residual, base, size = (ideal - columns @ base_values(state.bias, state.matrix)) / u, columns / u[:, None], len(u)
    return EquationBlock(residual, base, lambda term: np.zeros((size, len(term.values))), unit * u, stated=True)


def with_limits(limits: Mapping[str, float], solve: Callable[[Mapping[str, float]], tuple[Fitted, Values]]) -> Fitted:
    """Fit with pseudo-observations of those parameters that the recordings determine worse than the sensor file.

    A parameter keeps its pseudo-observation where its variance is more than half of that of its limit, or without one
    more than all of it: it is then mostly the limit's. ``limits``: name to standard uncertainty. ``solve``: fits
    with some of them, and returns the fit and the standard uncertainties of all; raises an error if they leave a
    combination open.
    """
    u = np.array(list(limits.values()))

    def held(kept: Mask) -> Mapping[str, float]:
        return {name: limit for name, limit, k in zip(limits, u.tolist(), kept, strict=True) if k}

    every, known = solve(held(np.ones(len(u), bool)))
    kept = known > u * np.sqrt(0.5)
    while not kept.all():
        try:
            found, known_now = solve(held(kept))
        except (NotObservableError, CannotCalibrateError):
            known_now = known
        else:
            if not np.any(~kept & (known_now > u)):
                return found
        kept[int(np.argmax(np.where(kept, 0.0, known_now / u)))] = True
    return every
