"""Fit base and effects to rests and moves by generalised least squares: Gauss-Newton.

    step = (N + k P)^-1 (X^T C^-1 r - k P p),    covariance = k (N + k P)^-1,   N = X^T C^-1 X

where k does not scale the limits of the sensor file in r: their rows of ``C^-1/2`` are multiplied by ``sqrt(k)``, as
the prior P is. The step is taken under the most likely hypothesis of the noise; the covariance is averaged over the
hypotheses by their restricted likelihood (``pipeline.estimation.engine``),

    -2 log L_R = rss / k + nu log k + log det C + log det(N + k P),    k = max(1, rss / nu),   nu = n - p

where k = 1 if the white noise is known from the scatter within the rests, and the scatter of a hypothesis explains the
residuals (``NoiseHypothesis.known``).

A few rests do not determine some combinations of parameters: two of the nine cross-axis terms of an accelerometer at
rest, or the amplitude of a warm-up far from its end. So the last fit of plausible effects has a prior with the
precision P: the sensor file's limits of their parameters p are two standard deviations. P is zero for bias, matrix,
time constants and parameters without a limit.

Models (``model``), and candidates in addition to them, are compared by their likelihood. The steadiness of a unit by
hand is unknown: a, c, q and k are free in all comparisons. The likelihood of a model is

    -2 log L = rss / k + n log k + log det C,    rss = min_d (r - X d)^T C^-1 (r - X d),    k = max(1, rss / n)

maximised over the hypotheses of a grid. Twice the gain in log L by v parameters is corrected for a variance that only
the residuals show (Bartlett 1938):

    gain = (1 - h + (v - 2) / (2 n)) 2 (log L' - log L)

where h is the mean leverage of the model with the effect, over the kinds of equations in which the effect shows.
delta BIC is the gain minus ``v log n``; p follows from chi squared with v degrees of freedom.

Free curves of time imitate the wander of the bias: the most likely wander with them is too small, and the gain too
large for chi squared. So p of curves follows from the gain under each hypothesis, and is averaged with weights in
proportion to the restricted likelihood with the curves, as the covariance is (``judged_curves``).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise, product
from typing import TypeAlias

import numpy as np
import scipy

from pipeline.core.errors import NotObservableError
from pipeline.core.records import Values
from pipeline.estimation.candidates import estimates, parameter_names
from pipeline.estimation.engine import ErrorMixture, undetermined_columns
from pipeline.estimation.gates import within
from pipeline.estimation.multi_position.model import Equations, Model, NoiseHypothesis, State, stepped

Limits: TypeAlias = Mapping[str, Values]  # effect to the limits of its parameters, infinite where there are none
Hypotheses: TypeAlias = Sequence[NoiseHypothesis]

MAX_STEP_HALVINGS = 30  # of a step; a smaller one is rounding
MIN_NEW_NORM_SHARE = 1e-3  # of a column beside the others, below which rounding decides: as ``MIN_NEW_COLUMN_SHARE``
REDUNDANT_RESTS = 10  # that are recommended beyond the parameters, so that residuals show the noise
NEGLIGIBLE_LOG_LIKELIHOOD = 12.0  # of log L below the best: a weight of 6e-6
PREDICTED_TO = 4.0  # of log L by a linear model: 9 of 10 fits of 13 simulated units differ by less than 0.5
CEILING_TO = 1.0  # of log L without a residual, which changes by up to 0.02 between fits of these units
MAX_GAUSS_NEWTON_ITERATIONS = 60  # of Gauss-Newton
FAR_ROUNDS = 9  # 99 % of 273 simulated fits need no more
SMALL_LAST_STEP = 3e-3  # of a standard uncertainty: the last step taken
SMALLEST_STEP = 1e-13  # g or deg/s: rounding
COMPARED_STEP = 0.1  # the same where log L alone is compared, which is then within 0.005 a parameter of its maximum
STALLED = 0.1  # of a standard uncertainty: a fit whose steps stay larger has not converged
SAME_SCALE = 1e-4  # relative change of the noise's scale below which the weight of the prior is not changed
# share of the largest eigenvalue of the products of unit columns, below which a combination of them is not determined
UNDETERMINED_COLUMN_SHARE = 1e-8
SCATTER_FACTORS = (3.0**0.5, 3.0**0.25, 3.0**0.125)  # factors of a scatter, on the way to its maximum
SHARP = 0.5  # standard deviation of a scatter's logarithm, half a step of the grid
MIN_TIMES_OF_BIAS = 20.0  # T / tau: with T / (2 tau) independent values a variance is known to sqrt(4 tau / T), 45 %
RARE = 1e-3  # weight of a level below which it does not change the average


def log_likelihood(rss: Values, n: int, log_determinant: Values) -> Values:
    """Return log L of sums of squares of n equations; ``log_determinant``: log det C minus twice the prior."""
    k = np.maximum(1.0, rss / n)
    return np.asarray(-0.5 * (rss / k + n * np.log(k) + log_determinant))


def log_likelihoods(equations: Equations, hypotheses: Hypotheses, predicted: Values | None = None) -> Values:
    """Return log L of the model under each hypothesis: (t,) array.

    ``predicted``: (t,), by a linear model. Then log L is computed only where it may be within
    ``NEGLIGIBLE_LOG_LIKELIHOOD`` of the best if it exceeds its prediction by no more than twice what those computed do,
    or ``PREDICTED_TO``; the other values are the predicted ones.
    """
    if predicted is None:
        return _log_likelihoods(equations, hypotheses)
    scores, still, best, excess = predicted.copy(), np.ones(len(hypotheses), bool), -np.inf, PREDICTED_TO
    while True:
        least = best if np.isfinite(best) else float(scores.max())
        chosen = np.flatnonzero(still & (scores > least - NEGLIGIBLE_LOG_LIKELIHOOD - excess))
        if len(chosen) == 0:
            return scores
        found = _log_likelihoods(equations, [hypotheses[i] for i in chosen.tolist()])
        excess = max(excess, 2.0 * float(np.max(found - scores[chosen])))
        scores[chosen], still[chosen], best = found, False, max(best, float(found.max()))


def _log_likelihoods(equations: Equations, hypotheses: Hypotheses) -> Values:
    together = np.concatenate([equations.columns, equations.residual[:, None]], axis=1)
    whitened = [equations.whitened(noise, together) for noise in hypotheses]
    products = np.array([white.T @ white for white, _ in whitened])
    X, along, power = products[:, :-1, :-1], products[:, :-1, -1:], products[:, -1, -1]
    factors = _orthonormalizers(X, np.sqrt(np.einsum("tii->ti", X)))
    rss = np.maximum(power - np.sum((factors.transpose(0, 2, 1) @ along) ** 2, axis=(1, 2)), 0.0)
    log_determinant = np.array([log - 2.0 * h.prior for (_, log), h in zip(whitened, hypotheses, strict=True)])
    return log_likelihood(rss, len(equations.residual), log_determinant)


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

    def with_candidate(self, j: int) -> Values:
        """Return log L with candidate j under each hypothesis: (t,) array."""
        along = (self.residual[:, None, :] @ self.raw[j]) @ self.orthonormal[j]
        return self.scores(np.sum(along**2, axis=(1, 2)))

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


def _orthonormalizers(products: Values, sizes: Values) -> Values:
    """Return the (t, p, p) factors that make columns orthonormal; ``products``: (t, p, p), ``sizes``: (t, p).

    Directions below ``MIN_NEW_NORM_SHARE`` are zeros.
    """
    size = np.where(sizes > 0.0, sizes, 1.0)
    values, vectors = np.linalg.eigh(products / (size[:, :, None] * size[:, None, :]))
    kept = values > MIN_NEW_NORM_SHARE**2
    return np.asarray(vectors * (kept / np.sqrt(np.where(kept, values, 1.0)))[:, None, :] / size[:, :, None])


def log_determinants(products: Values) -> tuple[Values, int]:
    """Return log det of (t, p, p) products of columns: (t,) array, and the number of directions in it.

    Directions below ``MIN_NEW_NORM_SHARE`` under the first hypothesis are left out.
    """
    size = np.sqrt(np.maximum(np.einsum("tii->ti", products), 1e-300))
    eigenvalues = np.linalg.eigvalsh(products / (size[:, :, None] * size[:, None, :]))
    rank = int(np.sum(eigenvalues[0] > MIN_NEW_NORM_SHARE**2))
    logarithm = np.sum(np.log(np.maximum(eigenvalues[:, products.shape[1] - rank :], 1e-300)), axis=1)
    return np.asarray(logarithm + 2.0 * np.sum(np.log(size), axis=1)), rank


def project_out(equations: Equations, hypotheses: Hypotheses) -> ProjectedCandidates:
    """Whiten the equations under every hypothesis and project the model's columns out of candidates and residual."""
    model = equations.columns
    together = np.concatenate([model, *equations.candidates, equations.residual[:, None]], axis=1)
    edges = np.cumsum([model.shape[1], *(c.shape[1] for c in equations.candidates)])
    whitened = [equations.whitened(noise, together) for noise in hypotheses]
    white = np.array([w for w, _ in whitened])
    sizes = np.linalg.norm(white, axis=1)
    X = white[:, :, : edges[0]]
    basis = X @ _orthonormalizers(X.transpose(0, 2, 1) @ X, sizes[:, : edges[0]])
    rest = white - basis @ (basis.transpose(0, 2, 1) @ white)
    blocks = [slice(start, stop) for start, stop in pairwise(edges.tolist())]
    raw = [rest[:, :, block] for block in blocks]
    pairs = zip(raw, blocks, strict=True)
    factors = [_orthonormalizers(Z.transpose(0, 2, 1) @ Z, sizes[:, block]) for Z, block in pairs]
    log_determinant = np.array([log - 2.0 * h.prior for (_, log), h in zip(whitened, hypotheses, strict=True)])
    return ProjectedCandidates(raw, factors, rest[:, :, -1], basis, log_determinant)


def judged_curves(equations: Equations, hypotheses: Hypotheses) -> list[tuple[float, float]]:
    """Return delta BIC of each candidate, and p averaged over the hypotheses."""
    projected, n = project_out(equations, hypotheses), len(equations.residual)
    before, (best, at) = projected.scores(), projected.of_model()
    together = np.concatenate([equations.columns, *equations.candidates], axis=1)
    products = np.array([white.T @ white for white in (equations.whitened(h, together)[0] for h in hypotheses)])
    known, edges = equations.columns.shape[1], np.cumsum([0, *(c.shape[1] for c in equations.candidates)])
    found = []
    for j, span in enumerate(pairwise((known + edges).tolist())):
        count, after = projected.count(j, at), projected.with_candidate(j)
        if count == 0:
            found.append((0.0, 1.0))
            continue
        factor = 2.0 * projected.correction(j, at, count, equations.scatter)
        own = np.r_[:known, slice(*span)]
        weight = scipy.special.softmax(after - 0.5 * log_determinants(products[:, own[:, None], own])[0])
        p = scipy.special.chdtrc(count, factor * np.maximum(after - before, 0.0))
        gain = factor * max(float(after.max()) - best, 0.0)
        found.append((gain - count * float(np.log(n)), float(weight @ p)))
    return found


@dataclass(frozen=True)
class FitByHand:
    """The best fit to rests and moves; its covariance is computed where it is used."""

    state: State
    equations: Equations  # at the state
    scores: Values  # log L under each of the given hypotheses; where it is far below the best, by a linear model
    rounds: int
    converged: bool
    cosine: float  # largest between the whitened residual and a whitened column
    precision: Values  # (b + p,); P
    near: tuple[NoiseHypothesis, ...]  # those of the grid whose likelihood is not negligible
    alone: bool  # whether one hypothesis was given, which is not refined
    freedom: float | None  # see ``fit``
    values: Values  # (b + p,); p

    @property
    def log_likelihood(self) -> float:
        """Log L under the most likely of the given hypotheses."""
        return float(self.scores.max())

    @property
    def residual(self) -> Values:
        """Residual over the white noise of each equation: (n,) array."""
        return self.equations.residual

    @property
    def error(self) -> Values:
        """White noise of each equation: (n,) array."""
        return self.equations.error

    @property
    def deviation(self) -> Values:
        """Standard deviation of each residual by all noise, without k, in the unit of ``error``: (n,) array."""
        variance = [weight * np.diag(self.equations.covariance(noise)) for noise, weight, _ in self.hypotheses]
        return np.asarray(self.error * np.sqrt(np.sum(variance, axis=0)))

    @property
    def noise(self) -> NoiseHypothesis:
        """The most likely hypothesis."""
        return self._every[0][self._likeliest]

    @property
    def rank(self) -> int:
        """Number of combinations of parameters that the equations determine."""
        return self._every[1][self._likeliest].rank

    @property
    def more_rests(self) -> str:
        """What to record where the rests do not determine the parameters."""
        return f"record at least {self.rank + REDUNDANT_RESTS} rests in as many orientations"

    @property
    def condition(self) -> float:
        """Condition number of the whitened columns."""
        return self._every[1][self._likeliest].condition

    @property
    def cosine_at_minimum(self) -> float:
        """The cosine where each of p parameters is ``SMALL_LAST_STEP`` uncertainties off: times ``sqrt(p / n)``."""
        return SMALL_LAST_STEP * float(np.sqrt(len(self.precision) / len(self.residual)))

    @property
    def covariance(self) -> Values:
        """Of the base parameters along the model's directions, and of the effects': (b + p, b + p) array."""
        return self._averaged[0]

    @property
    def degrees_of_freedom(self) -> Values:
        """Of each parameter: (b + p,) array.

        The means of f recordings show the bias between them with 3 (f - 1); both are combined (GUM, G.4.1).
        """
        freedom, files = self._averaged[1], self.equations.files
        if self.equations.between is None or files < 2:
            return freedom
        solved, p = self._every[1][self._likeliest], len(self.precision)
        together = np.concatenate([self.equations.columns, self.equations.between], axis=1)
        white, _ = self.equations.whitened(self.noise, together)
        change = solved.covariance @ white[:, :p].T @ white[:, p:] / solved.scale
        share = np.minimum(np.sum(change**2, axis=1) / np.maximum(np.diag(self.covariance), 1e-300), 1.0)
        return np.asarray(1.0 / (share**2 / (3.0 * (files - 1)) + (1.0 - share) ** 2 / freedom))

    @property
    def hypotheses(self) -> list[tuple[NoiseHypothesis, float, float]]:
        """The hypotheses of the average, the weight of each, and its k."""
        weights = zip(*self._every, self._weight.tolist(), strict=True)
        return [(noise, weight, solved.scale) for noise, solved, weight in weights]

    @cached_property
    def _every(self) -> tuple[list[NoiseHypothesis], list[Solution]]:
        prior = self.precision, self.values
        levels = list(self.near) if self.alone else refined(self.equations, self.near, prior)
        return levels, [solve(self.equations, noise, *prior) for noise in levels]

    @cached_property
    def _likeliest(self) -> int:
        return int(np.argmax([solved.log_likelihood for solved in self._every[1]]))

    @cached_property
    def _weight(self) -> Values:
        return np.asarray(scipy.special.softmax([solved.restricted for solved in self._every[1]]))

    @cached_property
    def _averaged(self) -> tuple[Values, Values]:
        spare = max(len(self.residual) - self.rank, 1) if self.freedom is None else self.freedom
        covariances = np.array([solved.covariance for solved in self._every[1]])
        return ErrorMixture(self._weight, covariances, spare).averaged()


@dataclass(frozen=True)
class Solution:
    """A step under one hypothesis, and its covariance."""

    step: Values
    covariance: Values
    condition: float
    log_likelihood: float
    restricted: float  # restricted log likelihood
    scale: float  # k
    rank: int
    cosine: float


def fit(
    model: Model,
    start: State,
    hypotheses: Hypotheses,
    limits: Limits,
    freedom: float | None = None,
    *,
    known: tuple[Equations, Values | None] | None = None,
    small: float = SMALL_LAST_STEP,
) -> FitByHand:
    """Fit bias, matrix and effects from given values.

    ``freedom``: degrees of freedom of the noise's scale, if other readings determine it; by default of the residuals.
    ``known``: the equations at the start and, if computed, log L under each hypothesis after one step. ``small``: the
    last step over the standard uncertainty.
    """
    state, rounds, best, scale = start, 0, -1, 0.0
    equations, scores = known or (model.equations(state), None)
    scores = log_likelihoods(equations, hypotheses) if scores is None else scores
    while True:
        prior = _prior(model, state, limits)
        likeliest = int(np.argmax(scores))
        solved = solve(equations, hypotheses[likeliest], *prior)
        same = not (np.any(prior[0]) or equations.stated) or abs(solved.scale - scale) <= SAME_SCALE * scale
        if (likeliest == best and same) or rounds > MAX_GAUSS_NEWTON_ITERATIONS // 2:
            break
        best, scale = likeliest, solved.scale
        state, equations, more = _descended(model, state, equations, hypotheses[best], limits, small)
        rounds, scores = rounds + more, log_likelihoods(equations, hypotheses, scores)
    uncertainty = np.sqrt(np.diag(solved.covariance))
    near = [h for h, score in zip(hypotheses, scores, strict=True) if score > scores.max() - NEGLIGIBLE_LOG_LIKELIHOOD]
    return FitByHand(
        state=state,
        equations=equations,
        scores=scores,
        rounds=rounds,
        converged=bool(np.all(np.abs(solved.step) <= np.maximum(STALLED * uncertainty, SMALLEST_STEP))),
        cosine=solved.cosine,  # under the weights of the fit, of which it is the minimum
        precision=prior[0],
        near=tuple(near),
        alone=len(hypotheses) == 1,
        freedom=freedom,
        values=prior[1],
    )


def _descended(  # noqa: PLR0917  (what an iteration is)
    model: Model, state: State, equations: Equations, noise: NoiseHypothesis, limits: Limits, small: float
) -> tuple[State, Equations, int]:
    """Return the state after Gauss-Newton steps under one hypothesis, its equations, and the number of steps.

    A step is halved until the next step is shorter (natural monotonicity test; Deuflhard, Newton Methods for Nonlinear
    Problems, 2004, 3.3) or, in the first ``FAR_ROUNDS``, the sum of squares falls, with the weights before it. Near the
    minimum that sum is flat, and as the weights change, steps by it can go to and fro.
    """
    prior = _prior(model, state, limits)
    solved = solve(equations, noise, *prior)
    for rounds in range(1, MAX_GAUSS_NEWTON_ITERATIONS + 1):
        uncertainty = _uncertainty(solved, small)
        for halving in range(MAX_STEP_HALVINGS):
            moved, taken = stepped(model, state, solved.step * 0.5**halving)
            further, last = model.equations(moved), bool(np.all(np.abs(taken) <= small * uncertainty))
            after = _prior(model, moved, limits)
            then = solve(further, noise, *after)
            both = np.stack([equations.residual, further.residual * further.error / equations.error], axis=1)
            squares = np.sum(equations.whitened(noise, both, solved.scale)[0] ** 2, axis=0)
            squares += solved.scale * np.array([weight @ values**2 for weight, values in (prior, after)])
            shorter = np.max(np.abs(then.step) / _uncertainty(then, small)) < np.max(np.abs(solved.step) / uncertainty)
            if last or shorter or (rounds <= FAR_ROUNDS and squares[1] < squares[0]):
                break
        state, equations, prior, solved = moved, further, after, then
        if last or np.all(np.abs(solved.step) <= small * _uncertainty(solved, small)):
            break
    return state, equations, rounds


def _uncertainty(solved: Solution, small: float) -> Values:
    """Return the standard uncertainties, of which a share ``small`` is at least rounding."""
    return np.maximum(np.sqrt(np.diag(solved.covariance)), SMALLEST_STEP / small)


def _prior(model: Model, state: State, limits: Limits) -> tuple[Values, Values]:
    """Return P (its diagonal) and p."""
    base = np.zeros(model.directions.shape[1])
    precision, values = [base], [base]
    for term in state.terms:
        nonlinear = [p.name in term.effect.nonlinear for p in term.effect.parameters(model.sensor)]
        limit = limits.get(term.effect.name, np.full(len(term.values), np.inf))
        precision.append(np.where(nonlinear, 0.0, (2.0 / limit) ** 2))
        values.append(term.values)
    return np.concatenate(precision), np.concatenate(values)


def refined(equations: Equations, near: Hypotheses, prior: tuple[Values, Values]) -> list[NoiseHypothesis]:
    """Return the hypotheses with significant weight; ``near``: those of a grid whose likelihood is not negligible.

    Many moves determine their scatter to about a tenth; a grid with factors of 3 or 4 would make the covariance wrong
    by up to such factors. So each scatter is moved to the maximum of the restricted likelihood by decreasing factors.
    If the standard deviation s of its logarithm is then less than half a step of the grid, its levels are ``exp(0, +-s,
    +-2 s)`` times the maximum; otherwise they are the levels of the grid with weight. The bias at low frequencies is
    treated alike, with its correlation time at values by a factor of sqrt(3) apart, where the rests last 20 correlation
    times and more, as in a soak, and determine its variance to a half.
    """

    def restricted(noise: NoiseHypothesis) -> float:
        return solve(equations, noise, *prior).restricted

    likelihoods = np.array([restricted(noise) for noise in near])
    weight = np.exp(likelihoods - likelihoods.max())
    best = near[int(np.argmax(likelihoods))]
    scattered = [j for j, level in enumerate(best.levels) if level > 0.0]
    best, top = _at_maximum(best, scattered, restricted)
    biases = [noise.bias for noise in {n.bias: n for n in near}.values()]
    if best.bias.ratio > 0.0 and equations.length.sum() > MIN_TIMES_OF_BIAS * best.bias.time:
        best, top = _at_maximum(best, [best.SLOW_BIAS, best.BIAS_TIME, *scattered], restricted)
        biases = []
        for factor in (1.0 / SCATTER_FACTORS[0], 1.0, SCATTER_FACTORS[0]):
            other, peak = _at_maximum(best.scaled(best.BIAS_TIME, factor), [best.SLOW_BIAS], restricted)
            factors = _sharp(other, other.SLOW_BIAS, peak, restricted).tolist() or [1.0]
            biases += [other.scaled(other.SLOW_BIAS, f).bias for f in factors]
    levels = []
    for j, level in enumerate(best.levels):
        given = np.array([noise.levels[j] for noise in near])
        chosen = [float(k) for k in np.unique(given) if weight[given == k].sum() > RARE * weight.sum()]
        factors = (level * _sharp(best, j, top, restricted)).tolist() if level > 0.0 else []
        levels.append(factors or chosen)
    return [replace(best, bias=bias).at(level) for bias in biases for level in product(*levels)]


def _at_maximum(
    noise: NoiseHypothesis, which: Sequence[int], restricted: Callable[[NoiseHypothesis], float]
) -> tuple[NoiseHypothesis, float]:
    """Return a hypothesis with some of its levels at their maximum, in decreasing steps, and log L there."""
    top = restricted(noise)
    for step, j in product(SCATTER_FACTORS, which):
        for other in (noise.scaled(j, step), noise.scaled(j, 1.0 / step)):
            if (score := restricted(other)) > top:
                noise, top = other, score
    return noise, top


def _sharp(noise: NoiseHypothesis, j: int, top: float, restricted: Callable[[NoiseHypothesis], float]) -> Values:
    """Return factors on a level at its maximum, by the curvature of log L there; none where it is flat."""
    step = SCATTER_FACTORS[-1]
    around = restricted(noise.scaled(j, step)) + restricted(noise.scaled(j, 1.0 / step))
    bend = (2.0 * top - around) / np.log(step) ** 2
    return np.exp(np.arange(-2.0, 3.0) / np.sqrt(bend)) if bend > SHARP**-2 else np.zeros(0)


def solve(equations: Equations, noise: NoiseHypothesis, precision: Values, values: Values) -> Solution:
    """Solve for the step under one hypothesis, with the prior precision P at the parameters p."""
    X = equations.columns
    n, p = X.shape
    white, logarithm = equations.whitened(noise, np.concatenate([X, equations.residual[:, None]], axis=1))
    X, r = white[:, :p], white[:, p]
    size = np.linalg.norm(X, axis=0)
    size = np.where(size > 0.0, size, 1.0)
    gram, along = (X / size).T @ (X / size), (X / size).T @ r
    w, V = np.linalg.eigh(gram)
    kept = w > UNDETERMINED_COLUMN_SHARE * w[-1]
    shown = (V[:, kept] / np.sqrt(w[kept])).T @ along
    rank, rss = int(kept.sum()), max(float(r @ r - shown @ shown), 0.0)
    spare = max(n - rank, 1)
    k, k_free = (max(1.0, rss / n), max(1.0, rss / spare)) if noise.free_scale else (1.0, 1.0)
    white[n - equations.stated :] *= np.sqrt(k_free)
    gram = (X / size).T @ (X / size) if equations.stated else gram
    w, V = np.linalg.eigh(gram + np.diag(k_free * precision / size**2))
    kept = w > 1e-14 * w[-1]
    half = V[:, kept] / np.sqrt(w[kept]) / size[:, None]
    inner = float(np.sum(np.log(w[kept]))) + 2.0 * float(np.sum(np.log(size)))
    gradient = X.T @ r - k_free * precision * values
    return Solution(
        step=half @ (half.T @ gradient),
        covariance=k_free * half @ half.T,
        condition=float(np.sqrt(w[-1] / max(w[0], 1e-300))),
        log_likelihood=-0.5 * (rss / k + n * float(np.log(k)) + logarithm) + noise.prior,
        restricted=-0.5 * (rss / k_free + spare * float(np.log(k_free)) + logarithm + inner) + noise.prior,
        scale=k_free,
        rank=rank,
        cosine=float(np.max(np.abs(gradient) / size)) / max(float(np.linalg.norm(r)), 1e-300),
    )


def plausible(fitted: FitByHand, limits: Limits) -> bool:
    """Return whether every effect is within its limits, or exceeds them by less than twice its standard uncertainty."""
    found = estimates(fitted.state.terms, fitted.covariance).items()
    return all(within(*of_effect, limits.get(name, np.inf)) for name, of_effect in found)


def adds_nothing(Q: Values, columns: Values) -> bool:
    """Return whether columns of an effect are combinations of those of bias and matrix, with orthonormal base Q."""
    size, rest = np.linalg.norm(columns, axis=0), np.linalg.norm(columns - Q @ (Q.T @ columns), axis=0)
    return bool(np.all(rest <= MIN_NEW_NORM_SHARE * np.where(size > 0.0, size, 1.0)))


def require_observable(model: Model, fitted: FitByHand, limits: Limits) -> None:
    """Raise ``NotObservableError``, with the effects or parameters, if rests and moves do not determine them."""
    equations = fitted.equations
    limited = _prior(model, fitted.state, limits)[0] > 0.0
    names = parameter_names(model.sensor, [term.effect for term in fitted.state.terms])
    Q, _ = np.linalg.qr(equations.base)
    shown = zip(fitted.state.terms, equations.effects, strict=True)
    lost = [term.effect for term, Z in shown if adds_nothing(Q, Z)]
    scaled = equations.columns / np.maximum(np.linalg.norm(equations.columns, axis=0), 1e-300)
    weak = undetermined_columns(scaled.T @ scaled + np.diag(limited.astype(float)), UNDETERMINED_COLUMN_SHARE)
    loose = [name for name, each in zip(names, weak[-len(names) :], strict=True) if each]
    if lost or loose:
        advice = "; ".join(f"{e.name} needs {e.excitation}" for e in lost or [t.effect for t in fitted.state.terms])
        problem = f"the rests of the {model.sensor} do not determine {', '.join([e.name for e in lost] or loose)}"
        raise NotObservableError(f"{problem}: {advice}; or take it out of effects.{model.sensor}")
