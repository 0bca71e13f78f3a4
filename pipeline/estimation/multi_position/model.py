"""The model of one sensor in rests and moves: its linearised equations, hypotheses about the noise, and likelihoods.

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

The steadiness of a unit by hand is unknown: a, c, q and k are free in all comparisons. The likelihood of a model is

    -2 log L = rss / k + n log k + log det C,    rss = min_d (r - X d)^T C^-1 (r - X d),    k = max(1, rss / n)

maximised over the hypotheses of a grid. Twice the gain in log L by v parameters is corrected for a variance that only
the residuals show (Bartlett 1938):

    gain = (1 - h + (v - 2) / (2 n)) 2 (log L' - log L)

where h is the mean leverage of the model with the effect, over the kinds of equations in which the effect shows.
delta BIC is the gain minus ``v log n``; p follows from chi squared with v degrees of freedom.

A parameter that the recordings do not determine has a separate equation, a pseudo-observation of the value of an ideal
sensor with the standard uncertainty u by the sensor file's limit (``limits``). ``between`` is the standard
deviation of the bias from one recording to the next, over white noise: it adds ``between^2 H J H^T`` to S, where J is 1
for two stretches of one recording and else 0.

The models of both sensors have: ``kinds`` of scatter (1: rests; 2: rests and moves), ``rests_equations`` (their number;
they come first), ``white`` noise of a raw sample, and ``directions``, (12, b): change of bias and matrix by each base
parameter.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise, product
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import scipy

from pipeline.estimation import design
from pipeline.estimation.gauss_markov import NO_INSTABILITY_ODDS, Setting, WanderPrior, block_covariance, selection_grid
from pipeline.estimation.least_squares import cholesky
from pipeline.records import BIAS, Index, Mask, Motion, Noise, Values, matrix_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from pipeline.estimation.design import EffectColumns
    from pipeline.estimation.multi_position.accelerometer import AccelerometerModel
    from pipeline.estimation.multi_position.gyroscope import GyroscopeModel

Model: TypeAlias = "AccelerometerModel | GyroscopeModel"

# share of a column's norm below which it adds no direction: rounding of the columns is below 1e-8
MIN_NEW_NORM_SHARE = 1e-3
# The grids below were chosen by the study of 500 recordings (tests/study/test_hand_held_study.py); ``fit.refined``
# refines their steps where the data determine the scatter better.
UNLIKELY = -4.0  # prior log weight of a setting, e^-4 of the likeliest
INSTABILITY_FACTORS = 3.0 ** np.arange(-2.0, 3.0)  # of the bias instability of the prior
INSTABILITY_RATIOS = (0.1, 0.3, 1.0)  # of bias instability to white noise where none is stated
START_SCATTERS = (0.0, 1.0, 3.0, 9.0, 27.0)  # of rests, of moves and of directions, for a covariance
SELECTION_SCATTER = ((0.0, 2.0, 6.0, 20.0), (0.0, 4.0, 16.0))  # of rests, and of moves, where models are compared


@dataclass(frozen=True)
class NoiseHypothesis:
    """One hypothesis about the noise."""

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
        """Return the hypothesis with one of its levels multiplied."""
        return self.at([level * (factor if i == j else 1.0) for i, level in enumerate(self.levels)])


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
        C = self.covariance(noise)
        L, failed = scipy.linalg.lapack.dpotrf(C, lower=1)
        if failed:
            L = cholesky(C)
        solved, failed = scipy.linalg.lapack.dtrtrs(L, values, lower=1)
        assert failed == 0  # noqa: S101
        return solved, 2.0 * float(np.sum(np.log(np.diag(L))))


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
    shared: Values | None = None  # (n, 12); change of moves by errors of the accelerometer's calibration
    force: Values | None = None  # (n, m, 3); change of moves by the specific force at each rest, per g


def stacked(
    blocks: Sequence[EquationBlock], model: Model, state: State, candidates: Sequence[EffectColumns]
) -> Equations:
    """Stack blocks of equations; the block of the rests is the first.

    Blocks beyond the kinds of scatter, as the parts of soaks, share the last kind.
    """
    sizes = [len(block.residual) for block in blocks]
    edges = np.cumsum([0, *sizes])
    start, length, recording = (
        np.concatenate(times) for times in zip(*(b.stretches for b in blocks if b.stretches is not None), strict=True)
    )
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
    if model.between:
        added = model.between**2 * np.sum(bias @ same.astype(float) @ bias.transpose(0, 2, 1), axis=0)
        common = added if common is None else common + added
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
    )


def stepped(model: Model, state: State, step: Values) -> tuple[State, Values]:
    """Return the parameters after a step, and the step taken, which effects may limit."""
    count = model.directions.shape[1]
    change = model.directions @ step[:count]
    terms, taken = design.stepped(state.terms, step[count:])
    moved = State(state.bias + change[BIAS], state.matrix + matrix_of(change), tuple(terms))
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


def effect_readings(sensor: str, terms: Sequence[EffectColumns], motion: Motion, K: Values) -> Values:
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
    """Return the hypotheses over which a covariance is averaged.

    ``prior``: of the bias instability. ``white``: white noise of a sample, unit of the sensor. ``kinds``: number of
    kinds of scatter.
    """
    bias = np.append(
        0.0, prior.wander * INSTABILITY_FACTORS if prior.wander > 0.0 else white * np.array(INSTABILITY_RATIOS)
    )
    pairs = zip((bias / white).tolist(), prior.log_belief(bias).tolist(), strict=True)
    none = float(
        np.log(NO_INSTABILITY_ODDS * (len(START_SCATTERS) - 1))
    )  # no scatter is stated, so that none at all is the likeliest
    hypotheses = [
        NoiseHypothesis(Setting(ratio, prior.time, belief), level, none=none)
        for ratio, belief in pairs
        if np.isfinite(belief)
        for level in product(START_SCATTERS, repeat=kinds)
    ]
    steady_moves = [h for h in hypotheses if kinds > 1 and h.scatter[1] in {START_SCATTERS[0], START_SCATTERS[2]}]
    return hypotheses + [replace(h, direction=c) for h in steady_moves for c in START_SCATTERS[2:]]


def log_likelihood(rss: Values, n: int, log_determinant: Values) -> Values:
    """Return log L of sums of squares of n equations; ``log_determinant``: log det C minus twice the prior."""
    k = np.maximum(1.0, rss / n)
    return np.asarray(-0.5 * (rss / k + n * np.log(k) + log_determinant))


@dataclass(frozen=True)
class ProjectedCandidates:
    """Whitened candidates and residual with the model's columns projected out, under each of t hypotheses."""

    raw: list[Values]  # each (t, n, p); projected columns of each candidate
    # each (t, p, p); ``raw @ orthonormal`` are orthonormal directions, padded with zeros to p columns
    orthonormal: list[Values]
    residual: Values  # (t, n)
    basis: Values  # (t, n, b); orthonormal, of the model's columns
    log_determinant: Values  # (t,); log det C, minus twice the prior

    def of_model(self) -> tuple[float, int]:
        """Return log L of the model, and the index of its best hypothesis."""
        scores = self.scores()
        return float(scores.max()), int(np.argmax(scores))

    def scores(self, explained: Values | float = 0.0) -> Values:
        """Return log L under each hypothesis, where ``explained`` is subtracted from the sum of squares: (t,) array."""
        rss = np.sum(self.residual**2, axis=1) - explained
        return log_likelihood(rss, self.residual.shape[1], self.log_determinant)

    def with_candidate(self, j: int) -> tuple[float, int]:
        """Return log L with candidate j, and the index of its best hypothesis."""
        along = (self.residual[:, None, :] @ self.raw[j]) @ self.orthonormal[j]
        scores = self.scores(np.sum(along**2, axis=(1, 2)))
        return float(scores.max()), int(np.argmax(scores))

    def count(self, j: int, at: int) -> int:
        """Return the number of directions of candidate j under a hypothesis."""
        return int(np.any(self.orthonormal[j][at], axis=0).sum())

    def shown(self, j: int, at: int) -> Values:
        """Return the orthonormal directions of candidate j under a hypothesis: (n, p) array."""
        return np.asarray(self.raw[j][at] @ self.orthonormal[j][at])

    def correction(self, j: int, at: int, added: int, kinds: Values) -> float:
        """Return the factor on the gain by candidate j; 0 if fewer than two equations remain to judge it.

        ``j``, ``at``: candidate and hypothesis. ``added``: parameters, also those whose column is zero at their start.
        ``kinds``: (s, n), positive where an equation is of a kind.
        """
        power = np.sum(self.shown(j, at) ** 2, axis=1)
        leverage = np.sum(self.basis[at] ** 2, axis=1) + power
        factor = 0.0
        for kind in kinds > 0:
            factor += float(power[kind].sum() / power.sum() * (1.0 - leverage[kind].mean())) if kind.any() else 0.0
        n = len(leverage)
        spare = factor * n - (added - float(power.sum()))
        return max((spare + 0.5 * (added - 2)) / n, 0.0) if spare >= 2.0 - 1e-9 else 0.0


def _orthonormalizers(columns: Values, sizes: Values) -> Values:
    """Return the (t, p, p) factors that make (t, n, p) columns orthonormal.

    Directions below ``MIN_NEW_NORM_SHARE`` are zeros.
    """
    size = np.where(sizes > 0.0, sizes, 1.0)
    products = columns.transpose(0, 2, 1) @ columns / (size[:, :, None] * size[:, None, :])
    values, vectors = np.linalg.eigh(products)
    kept = values > MIN_NEW_NORM_SHARE**2
    return vectors * (kept / np.sqrt(np.where(kept, values, 1.0)))[:, None, :] / size[:, :, None]


def project_out(equations: Equations, hypotheses: Sequence[NoiseHypothesis]) -> ProjectedCandidates:
    """Whiten the equations under every hypothesis and project the model's columns out of candidates and residual."""
    model = equations.columns
    together = np.concatenate([model, *equations.candidates, equations.residual[:, None]], axis=1)
    edges = np.cumsum([model.shape[1], *(c.shape[1] for c in equations.candidates)])
    whitened = [equations.whitened(noise, together) for noise in hypotheses]
    white = np.array([w for w, _ in whitened])
    sizes = np.linalg.norm(white, axis=1)
    basis = white[:, :, : edges[0]] @ _orthonormalizers(white[:, :, : edges[0]], sizes[:, : edges[0]])
    rest = white - basis @ (basis.transpose(0, 2, 1) @ white)
    blocks = [slice(start, stop) for start, stop in pairwise(edges.tolist())]
    factors = [_orthonormalizers(rest[:, :, block], sizes[:, block]) for block in blocks]
    log_determinant = np.array([log - 2.0 * h.prior for (_, log), h in zip(whitened, hypotheses, strict=True)])
    return ProjectedCandidates([rest[:, :, b] for b in blocks], factors, rest[:, :, -1], basis, log_determinant)
