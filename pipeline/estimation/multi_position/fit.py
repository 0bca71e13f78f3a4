"""Fit base and effects to rests and moves by generalised least squares: Gauss-Newton, robust against single moves.

    step = (N + k P)^-1 (X^T C^-1 r - k P p),    covariance = k (N + k P)^-1,   N = X^T C^-1 X

The step is taken under the most likely hypothesis of the noise; the covariance is averaged over the hypotheses by their
restricted likelihood (``pipeline.estimation.engine``),

    -2 log L_R = rss / k + nu log k + log det C + log det(N + k P),    k = max(1, rss / nu),   nu = n - p

where k = 1 if the white noise is known from the scatter within the rests, and the scatter of a hypothesis explains the
residuals (``NoiseHypothesis.known``).

A few rests do not determine some combinations of parameters: two of the nine cross-axis terms of an accelerometer at
rest, or the amplitude of a warm-up far from its end. So the last fit of plausible effects has a prior with the
precision P: the sensor file's limits of their parameters p are two standard deviations. P is zero for bias, matrix,
time constants and parameters without a limit.

A move is an outlier if, with its two whitened residuals r_k and the scale s of the median move,

    t_k = |r_k| / s,   s = median |r_k| / sqrt(2 log 2),   t_k^2 > 2 log(k / p)

which one of k valid moves exceeds with the probability p. If there is an outlier, all moves have the weights
``min(1, (v + 2) / (v + t^2))`` of Student's t with v = 4 degrees of freedom: a move of weight w has 1/w times its
variance. Source: Lange, Little & Taylor, JASA 84 (1989), 881-896.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from pipeline.errors import CannotCalibrateError, NotObservableError
from pipeline.estimation.candidates import parameter_names
from pipeline.estimation.design import placed
from pipeline.estimation.engine import ErrorMixture
from pipeline.estimation.least_squares import ScaledColumns, gauss_newton
from pipeline.estimation.multi_position.model import (
    MIN_NEW_NORM_SHARE,
    Equations,
    Model,
    NoiseHypothesis,
    State,
    project_out,
    stepped,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from pipeline.estimation.multi_position.gyroscope import GyroscopeModel
    from pipeline.records import Mask, Recording, Values

    Limits = Mapping[str, Values]  # effect to the limits of its parameters, infinite where there are none

Fitted = TypeVar("Fitted")
MAX_GAUSS_NEWTON_ITERATIONS = 60  # of Gauss-Newton
SMALL_LAST_STEP = 3e-3  # of a standard uncertainty: the last step taken
STALLED = 0.1  # of a standard uncertainty: a fit whose steps stay larger has not converged
SAME_SCALE = 1e-4  # relative change of the noise's scale below which the weight of the prior is not changed
OPEN_SINGULAR_VALUE = 1e-7  # of the largest singular value, below which a combination of parameters takes no step
UNDETERMINED_COLUMN_SHARE = 1e-8  # share of its columns below which a combination of parameters is not determined
NEGLIGIBLE_LOG_LIKELIHOOD = 12.0  # of log L below the best: a weight of 6e-6
SCATTER_FACTORS = (3.0**0.5, 3.0**0.25, 3.0**0.125)  # factors of a scatter, on the way to its maximum
SHARP = 0.5  # standard deviation of a scatter's logarithm, half a step of the grid
RARE = 1e-3  # weight of a level below which it does not change the average
OUTLIER_FALSE_ALARM, FREEDOM = 1e-3, 4.0  # p and v
ROBUST_ROUNDS, SETTLED_WEIGHT_CHANGE = 6, 0.05  # weights that change by less are final


@dataclass(frozen=True)
class FitByHand:
    """The best fit to rests and moves."""

    state: State
    covariance: Values  # (b + p, b + p); of the base parameters along the model's directions, and of the effects'
    log_likelihood: float
    noise: NoiseHypothesis  # the most likely one
    degrees_of_freedom: Values  # (b + p,)
    # each (n,); residual over the white noise of each equation, and that white noise
    residual: Values
    error: Values
    rank: int  # combinations of parameters that the equations determine
    rounds: int
    converged: bool
    condition: float  # of the whitened columns
    cosine: float  # largest between the whitened residual and a whitened column
    hypotheses: tuple[tuple[NoiseHypothesis, float, float], ...]  # those of the average, the weight of each, and its k
    precision: Values  # (b + p,); P


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
    hypotheses: Sequence[NoiseHypothesis],
    limits: Limits,
    freedom: float | None = None,
) -> FitByHand:
    """Fit bias, matrix and effects from given values.

    ``freedom``: degrees of freedom of the noise's scale, if other readings determine it; by default of the residuals.
    """
    state, rounds, best, scale = start, 0, -1, 0.0
    evaluated: list[tuple[State, Equations]] = []

    def residual_at(state: State) -> tuple[Values, Values]:
        equations = model.equations(state)
        evaluated.append((state, equations))
        values = np.concatenate([equations.columns, equations.residual[:, None]], axis=1)
        white = equations.whitened(hypotheses[best], values)[0]
        precision, parameters = _prior(model, state, limits)
        rows = np.diag(np.sqrt(scale * precision))[precision > 0.0]
        return np.append(white[:, -1], -rows @ parameters), -np.concatenate([white[:, :-1], rows])

    def small(step: Values, factors: ScaledColumns) -> bool:
        uncertainty = np.sqrt(scale * np.diag(factors.covariance()))
        return bool(np.all(np.abs(step) <= np.maximum(SMALL_LAST_STEP * uncertainty, 1e-13)))

    while True:
        equations = next((e for s, e in evaluated if s is state), None) or model.equations(state)
        prior = _prior(model, state, limits)
        likeliest = project_out(equations, hypotheses).of_model()[1]
        solved = solve(equations, hypotheses[likeliest], *prior)
        same = not np.any(prior[0]) or abs(solved.scale - scale) <= SAME_SCALE * scale
        if (likeliest == best and same) or rounds > MAX_GAUSS_NEWTON_ITERATIONS // 2:
            break
        best, scale = likeliest, solved.scale
        evaluated.clear()
        state, _, more = gauss_newton(
            residual_at,
            state,
            partial(stepped, model),
            small,
            MAX_GAUSS_NEWTON_ITERATIONS - rounds,
            OPEN_SINGULAR_VALUE,
        )
        rounds += more
    uncertainty = np.sqrt(np.diag(solved.covariance))
    converged = bool(np.all(np.abs(solved.step) <= np.maximum(STALLED * uncertainty, 1e-13)))
    cosine = solved.cosine  # under the weights of the fit, of which it is the minimum
    levels, likelihood = refined(equations, hypotheses, prior)
    every = [solve(equations, noise, *prior) for noise in levels]
    likeliest = int(np.argmax([s.log_likelihood for s in every]))
    solved = every[likeliest]
    restricted = np.array([s.restricted for s in every])
    weight = np.exp(restricted - restricted.max())
    weight /= weight.sum()
    spare = max(len(equations.residual) - solved.rank, 1) if freedom is None else freedom
    covariance, degrees = ErrorMixture(weight, np.array([s.covariance for s in every]), spare).averaged()
    return FitByHand(
        state=state,
        covariance=covariance,
        log_likelihood=likelihood,
        noise=levels[likeliest],
        degrees_of_freedom=degrees,
        residual=equations.residual,
        error=equations.error,
        rank=solved.rank,
        rounds=rounds,
        converged=converged,
        condition=solved.condition,
        cosine=cosine,
        hypotheses=tuple((noise, float(w), s.scale) for noise, w, s in zip(levels, weight, every, strict=True)),
        precision=prior[0],
    )


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


def refined(
    equations: Equations, hypotheses: Sequence[NoiseHypothesis], prior: tuple[Values, Values]
) -> tuple[list[NoiseHypothesis], float]:
    """Return the hypotheses with significant weight, and the largest log likelihood over the given ones.

    Many moves determine their scatter to about a tenth; a grid with factors of 3 or 4 would make the covariance wrong
    by up to such factors. So each scatter is moved to the maximum of the restricted likelihood by decreasing factors.
    If the standard deviation s of its logarithm is then less than half a step of the grid, its levels are ``exp(0, +-s,
    +-2 s)`` times the maximum; otherwise they are the levels of the grid with weight.
    """
    scores = project_out(equations, hypotheses).scores()
    if len(hypotheses) == 1:
        return list(hypotheses), float(scores.max())
    near = [
        noise
        for noise, score in zip(hypotheses, scores, strict=True)
        if score > scores.max() - NEGLIGIBLE_LOG_LIKELIHOOD
    ]

    def restricted(noise: NoiseHypothesis) -> float:
        return solve(equations, noise, *prior).restricted

    likelihoods = np.array([restricted(noise) for noise in near])
    best, top = near[int(np.argmax(likelihoods))], float(likelihoods.max())
    weight = np.exp(likelihoods - top)
    for factor in SCATTER_FACTORS:
        for j in (j for j, level in enumerate(best.levels) if level > 0.0):
            for other in (best.scaled(j, factor), best.scaled(j, 1.0 / factor)):
                score = restricted(other)
                if score > top:
                    best, top = other, score
    levels = []
    for j, level in enumerate(best.levels):
        given = np.array([noise.levels[j] for noise in near])
        chosen = [float(k) for k in np.unique(given) if weight[given == k].sum() > RARE * weight.sum()]
        if level > 0.0:
            around = [restricted(best.scaled(j, factor)) for factor in (SCATTER_FACTORS[-1], 1.0 / SCATTER_FACTORS[-1])]
            bend = (2.0 * top - sum(around)) / np.log(SCATTER_FACTORS[-1]) ** 2
            if bend > SHARP**-2:
                chosen = (level * np.exp(np.arange(-2.0, 3.0) / np.sqrt(bend))).tolist()
        levels.append(chosen)
    of_each_bias = {n.bias: n for n in near}.values()
    return [n.at(level) for n in of_each_bias for level in product(*levels)], float(scores.max())


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


def plausible(model: Model, fitted: FitByHand, limits: Limits) -> bool:
    """Return whether every effect is within its limits, or exceeds them by less than its uncertainty."""
    uncertainty = np.sqrt(np.diag(fitted.covariance))
    return all(
        bool(np.all(np.abs(term.values) - 2.0 * uncertainty[place] <= limits.get(name, np.inf)))
        for name, (term, place) in placed(fitted.state.terms, model.directions.shape[1]).items()
    )


def require_observable(model: Model, fitted: FitByHand, limits: Limits) -> None:
    """Raise ``NotObservableError``, with the effects or parameters, if rests and moves do not determine them."""
    equations = model.equations(fitted.state)
    limited = _prior(model, fitted.state, limits)[0] > 0.0
    names = parameter_names(model.sensor, [term.effect for term in fitted.state.terms])
    Q, _ = np.linalg.qr(equations.base)
    lost = []
    for term, Z in zip(fitted.state.terms, equations.effects, strict=True):
        size, rest = np.linalg.norm(Z, axis=0), np.linalg.norm(Z - Q @ (Q.T @ Z), axis=0)
        if np.all(rest <= MIN_NEW_NORM_SHARE * np.where(size > 0.0, size, 1.0)):
            lost.append(term.effect)
    scaled = equations.columns / np.maximum(np.linalg.norm(equations.columns, axis=0), 1e-300)
    weak = np.linalg.eigh(scaled.T @ scaled + np.diag(limited.astype(float)))
    undetermined = np.abs(weak.eigenvectors[:, weak.eigenvalues < UNDETERMINED_COLUMN_SHARE])[-len(names) :]
    loose = [name for name, row in zip(names, undetermined, strict=True) if np.any(row > 0.2)]
    if lost or loose:
        advice = "; ".join(f"{e.name} needs {e.excitation}" for e in lost or [t.effect for t in fitted.state.terms])
        raise NotObservableError(
            f"the rests of the {model.sensor} do not determine {', '.join([e.name for e in lost] or loose)}: {advice}; "
            f"or take it out of effects.{model.sensor}"
        )


def with_limits(
    limits: Mapping[str, float], solve_with: Callable[[Mapping[str, float]], tuple[Fitted, Values]]
) -> Fitted:
    """Fit with pseudo-observations of those parameters that the recordings determine worse than the sensor file.

    A parameter keeps its pseudo-observation where its variance is more than half of that of its limit: it is then
    mostly the limit's. ``limits``: name to standard uncertainty. ``solve_with``: fits with some of them, and returns
    the fit and the standard uncertainties of all; raises an error if they leave a combination open.
    """
    u = np.array(list(limits.values()))

    def held(kept: Mask) -> Mapping[str, float]:
        return {name: limit for name, limit, k in zip(limits, u.tolist(), kept, strict=True) if k}

    every, known = solve_with(held(np.ones(len(u), bool)))
    kept = known > u * np.sqrt(0.5)
    while not kept.all():
        try:
            found, known_now = solve_with(held(kept))
        except (NotObservableError, CannotCalibrateError):
            known_now = known
        else:
            if not np.any(~kept & (known_now > u * np.sqrt(0.5))):
                return found
        kept[int(np.argmax(np.where(kept, 0.0, known_now / u)))] = True
    return every


def fit_robustly(
    model: GyroscopeModel, fit_model: Callable[[GyroscopeModel], FitByHand], recordings: Sequence[Recording]
) -> tuple[GyroscopeModel, FitByHand, list[dict[str, Any]]]:
    """Fit rests and moves, with weights of Student's t if a move is an outlier.

    ``fit_model``: function that fits a model. Returns model and fit with the variance by the weights, and the outliers:
    ``recording, time_s, error_deg, over_noise, weight``.
    """
    fitted, moves = fit_model(model), model.moves
    if moves is None:
        return model, fitted, []
    t, error = _over_noise(model, fitted)
    limit = np.sqrt(2.0 * np.log(len(t) / OUTLIER_FALSE_ALARM))
    if not np.any(t > limit):
        return model, fitted, []
    weight = np.ones(len(t))
    for _ in range(ROBUST_ROUNDS):
        before, weight = weight, np.minimum(1.0, (FREEDOM + 2.0) / (FREEDOM + t**2))
        if np.abs(weight - before).max() < SETTLED_WEIGHT_CHANGE:
            break
        variance = np.where(t > 0.0, (error / np.maximum(t, 1e-12)) ** 2, 0.0)
        model = model.with_excess(variance * (1.0 / weight - 1.0))
        fitted = fit_model(model)
        t, error = _over_noise(model, fitted)
    outlying = [
        {
            "recording": recordings[int(model.every.recording[moves.after[k]])].name,
            "time_s": float(moves.time[k, 0]),
            "error_deg": float(error[k]),
            "over_noise": float(t[k]),
            "weight": float(weight[k]),
        }
        for k in np.flatnonzero(t > limit)
    ]
    return model, fitted, outlying


def _over_noise(model: GyroscopeModel, fitted: FitByHand) -> tuple[Values, Values]:
    """Return t of each move, and its residual, deg."""
    C = model.equations(fitted.state).covariance(fitted.noise)
    error = fitted.error[model.of_moves].reshape(-1, 2)
    r = fitted.residual[model.of_moves].reshape(-1, 2) * error
    variance = np.diag(C)[model.of_moves].reshape(-1, 2) * error**2 - model.excess[:, None]
    size = np.sqrt(np.sum(r**2 / variance, axis=1))
    scale = float(np.median(size)) / np.sqrt(2.0 * np.log(2.0))
    return size / max(scale, 1e-12), np.linalg.norm(r, axis=1)
