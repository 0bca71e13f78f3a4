"""Base and effects fitted to rests and moves, by generalised least squares in Gauss-Newton rounds.

    step = (N + k P)^-1 (X^T C^-1 r - k P p),    covariance = k (N + k P)^-1,   N = X^T C^-1 X

The step is taken at the most likely noise; the covariance is averaged over the noises by their restricted likelihood
(``pipeline.estimation.engine``),

    -2 log L_R = rss / k + nu log k + log det C + log det(N + k P),    k = max(1, rss / nu),   nu = n - p

A few rests leave some combinations of parameters open: two of the nine cross-axis terms of an accelerometer at rest, or
the amplitude of a warm-up that is still far from its end. So the last fit of effects that are plausible has the data
sheet's limits of their parameters p, taken for two standard deviations, beside the equations, with the precision P; it
is zero for bias, matrix and time constants, and where there is no limit. What the rests determine it does not move: its
weight is the square of uncertainty over limit.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import NotObservableError
from pipeline.estimation.engine import Posterior
from pipeline.estimation.generalized_least_squares import parameter_names
from pipeline.estimation.multi_position.likelihood import NEW, beside
from pipeline.estimation.multi_position.model import stepped

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.estimation.multi_position.equations import Equations, HandNoise
    from pipeline.estimation.multi_position.model import Model, State

    Values = NDArray[np.float64]

ROUNDS = 60
SMALL_STEP = 3e-3  # of a standard uncertainty
STALLED = 0.1
HALVINGS = 12
ROUNDING = 1e-9
NONE = 1e-8  # share of its columns below which a combination of parameters is not determined
STEPS = (3.0**0.5, 3.0**0.25, 3.0**0.125)  # factors of a scatter, on the way to its maximum
SHARP = 0.5  # standard deviation of a scatter's logarithm, half a step of the grid's
RARE = 1e-3  # weight of a level below which it is none of the average's
FAR = 12.0  # of log L below the best, where a noise is not believed


@dataclass(frozen=True)
class HandFit:
    """The model that explains rests and moves best.

    Attributes
    ----------
    state : State
    covariance : (b + p, b + p) array
        Of the base parameters along the model's directions, and of the effects'.
    log_likelihood : float
    noise : HandNoise
        The most likely one.
    degrees_of_freedom : (b + p,) array
        Of each of these parameters.
    residual : (n,) array
        Over the white noise of each equation.
    error : (n,) array
        That white noise.
    rank : int
        Directions that the equations determine.
    rounds : int
    converged : bool
    condition : float
    cosine : float
        Largest between the whitened residual and a column, with what is believed of the parameters.
    candidates : tuple of (HandNoise, float, float)
        Every noise that is believed, its weight, and its k.
    precision : (b + p,) array
        P.
    """

    state: State
    covariance: Values
    log_likelihood: float
    noise: HandNoise
    degrees_of_freedom: Values
    residual: Values
    error: Values
    rank: int
    rounds: int
    converged: bool
    condition: float
    cosine: float
    candidates: tuple[tuple[HandNoise, float, float], ...]
    precision: Values


@dataclass(frozen=True)
class Solved:
    """A step at one noise, and its covariance k (N + k P)^-1."""

    step: Values
    covariance: Values
    condition: float
    log_likelihood: float
    restricted: float
    scale: float
    rank: int
    cosine: float


@dataclass(frozen=True)
class Limits:
    """What is believed of the parameters before: precision P (diagonal) and the values p, base first."""

    precision: Values
    values: Values

    def penalty(self) -> float:
        """Return ``p^T P p``."""
        return float(self.precision @ self.values**2)


def fit(model: Model, start: State, noises: Sequence[HandNoise], limits: Mapping[str, Values]) -> HandFit:
    """Fit bias, matrix and effects from given values.

    Parameters
    ----------
    model : Model
    start : State
    noises : sequence of HandNoise
    limits : mapping
        Effect to the limits of its parameters, infinite where there are none.

    Returns
    -------
    HandFit
    """
    state, converged, rounds = start, False, 0
    equations = model.equations(state)
    best = beside(equations, noises).of_model()[1]
    while rounds < ROUNDS:
        rounds += 1
        solved = solve(equations, noises[best], limits_at(model, state, limits))
        state, equations, taken = _lowered(model, state, equations, noises[best], solved, limits)
        uncertainty = np.sqrt(np.diag(solved.covariance))
        if np.all(np.abs(taken) <= np.maximum(SMALL_STEP * uncertainty, 1e-13)):
            now = beside(equations, noises).of_model()[1]
            if now == best or rounds > ROUNDS // 2:
                converged = bool(np.all(np.abs(solved.step) <= np.maximum(STALLED * uncertainty, 1e-13)))
                break
            best = now
    return _assessed(state, equations, noises, limits_at(model, state, limits), (rounds, converged))


def limits_at(model: Model, state: State, limits: Mapping[str, Values]) -> Limits:
    """Return the limits as precision, two standard deviations each, with the parameters' values."""
    base = model.directions.shape[1]
    precision, values = [np.zeros(base)], [np.zeros(base)]
    for term in state.terms:
        nonlinear = [p.name in term.effect.nonlinear for p in term.effect.parameters(model.sensor)]
        limit = limits.get(term.effect.name, np.full(len(term.values), np.inf))
        precision.append(np.where(nonlinear, 0.0, (2.0 / limit) ** 2))
        values.append(term.values)
    return Limits(np.concatenate(precision), np.concatenate(values))


def _lowered(  # noqa: PLR0917  (they are the problem)
    model: Model,
    state: State,
    equations: Equations,
    noise: HandNoise,
    solved: Solved,
    limits: Mapping[str, Values],
) -> tuple[State, Equations, Values]:
    """Take a step, halved while it makes the residual longer; after the last one there is none left to take."""

    def length(at: State, there: Equations) -> float:
        white = there.whitened(noise, there.residual[:, None])[0]
        return float(np.sum(white**2)) / solved.scale + limits_at(model, at, limits).penalty()

    before = length(state, equations)
    for halving in range(HALVINGS):
        moved, taken = stepped(model, state, solved.step * 0.5**halving)
        there = model.equations(moved)
        if length(moved, there) <= before * (1.0 + ROUNDING):
            return moved, there, taken
    return state, equations, np.zeros(len(solved.step))


def _assessed(
    state: State, equations: Equations, noises: Sequence[HandNoise], limits: Limits, how: tuple[int, bool]
) -> HandFit:
    noises, likelihood = refined(equations, noises, limits)
    every = [solve(equations, noise, limits) for noise in noises]
    best = int(np.argmax([s.log_likelihood for s in every]))
    restricted = np.array([s.restricted for s in every])
    weight = np.exp(restricted - restricted.max())
    weight /= weight.sum()
    spare = max(len(equations.residual) - every[best].rank, 1)
    covariance, freedom = Posterior(weight, np.array([s.covariance for s in every]), spare).averaged()
    return HandFit(
        state,
        covariance,
        likelihood,
        noises[best],
        freedom,
        equations.residual,
        equations.error,
        every[best].rank,
        *how,
        every[best].condition,
        every[best].cosine,
        tuple((noise, float(w), s.scale) for noise, w, s in zip(noises, weight, every, strict=True)),
        limits.precision,
    )


def refined(equations: Equations, noises: Sequence[HandNoise], limits: Limits) -> tuple[list[HandNoise], float]:
    """Return the noises that are believed, with levels of scatter as close as their uncertainty asks for.

    A scatter of many moves is known to a tenth or so, where a grid of factors of 3 or 4 would give a covariance that is
    wrong by up to as much. So each scatter is led to the maximum of the restricted likelihood, by ever smaller factors;
    where its logarithm has a standard deviation s there that is less than half a step of the grid, its levels are
    ``exp(0, +-s, +-2 s)`` times the maximum, and otherwise those of the grid that are believed.

    Returns
    -------
    list of HandNoise
    float
        The largest log likelihood over the given noises.
    """
    found = beside(equations, noises)
    scores = found.log_likelihood(np.sum(found.residual**2, axis=1))
    noises = [noise for noise, score in zip(noises, scores, strict=True) if score > scores.max() - FAR]

    def restricted(noise: HandNoise) -> float:
        return solve(equations, noise, limits).restricted

    weight = np.array([restricted(noise) for noise in noises])
    best, top = noises[int(np.argmax(weight))], float(weight.max())
    weight = np.exp(weight - top)
    for factor in STEPS:
        for j in (j for j, level in enumerate(best.levels) if level > 0.0):
            for other in (best.scaled(j, factor), best.scaled(j, 1.0 / factor)):
                score = restricted(other)
                if score > top:
                    best, top = other, score
    levels = []
    for j, level in enumerate(best.levels):
        given = np.array([noise.levels[j] for noise in noises])
        kinds = np.unique(given)
        believed = [float(k) for k in kinds if weight[given == k].sum() > RARE * weight.sum()]
        if level > 0.0:
            around = [restricted(best.scaled(j, factor)) for factor in (STEPS[-1], 1.0 / STEPS[-1])]
            bend = (2.0 * top - sum(around)) / np.log(STEPS[-1]) ** 2
            if bend > SHARP**-2:
                believed = (level * np.exp(np.arange(-2.0, 3.0) / np.sqrt(bend))).tolist()
        levels.append(believed)
    wanders = {(n.ratio, n.time): n for n in noises}.values()
    return [n.at(level) for n in wanders for level in product(*levels)], float(scores.max())


def solve(equations: Equations, noise: HandNoise, limits: Limits) -> Solved:
    """Solve for the step under one noise."""
    X = equations.columns
    n, p = X.shape
    white, logarithm = equations.whitened(noise, np.concatenate([X, equations.residual[:, None]], axis=1))
    X, r = white[:, :p], white[:, p]
    size = np.linalg.norm(X, axis=0)
    size = np.where(size > 0.0, size, 1.0)
    values, vectors = np.linalg.eigh((X / size).T @ (X / size))
    kept = values > NONE * values[-1]
    along = (vectors[:, kept] / np.sqrt(values[kept])).T @ ((X / size).T @ r)
    rank, rss = int(kept.sum()), max(float(r @ r - along @ along), 0.0)
    spare = max(n - rank, 1)
    k, k_free = max(1.0, rss / n), max(1.0, rss / spare)
    believed = k_free * limits.precision
    N = ((X / size).T @ (X / size)) + np.diag(believed / size**2)
    values, vectors = np.linalg.eigh(N)
    kept = values > 1e-14 * values[-1]
    half = vectors[:, kept] / np.sqrt(values[kept]) / size[:, None]
    inner = float(np.sum(np.log(values[kept]))) + 2.0 * float(np.sum(np.log(size)))
    return Solved(
        half @ (half.T @ (X.T @ r - believed * limits.values)),
        k_free * half @ half.T,
        float(np.sqrt(values[-1] / max(values[0], 1e-300))),
        -0.5 * (rss / k + n * float(np.log(k)) + logarithm) + noise.prior,
        -0.5 * (rss / k_free + spare * float(np.log(k_free)) + logarithm + inner) + noise.prior,
        k_free,
        rank,
        float(np.max(np.abs(X.T @ r - believed * limits.values) / size)) / max(float(np.linalg.norm(r)), 1e-300),
    )


def plausible(model: Model, found: HandFit, limits: Mapping[str, Values]) -> bool:
    """Return whether every effect is within its limits, as far as its uncertainty tells."""
    uncertainty = np.sqrt(np.diag(found.covariance))
    at, within = model.directions.shape[1], True
    for term in found.state.terms:
        own = slice(at, at + len(term.values))
        limit = limits.get(term.effect.name, np.full(len(term.values), np.inf))
        within &= bool(np.all(np.abs(term.values) - 2.0 * uncertainty[own] <= limit))
        at = own.stop
    return within


def require_observable(model: Model, found: HandFit, limits: Mapping[str, Values]) -> None:
    """Refuse a fit with an effect of which rests and moves say nothing.

    Raises
    ------
    NotObservableError
        Naming the effects, or the parameters that nothing determines.
    """
    equations = model.equations(found.state)
    limited = limits_at(model, found.state, limits).precision > 0.0
    names = parameter_names(model.sensor, [term.effect for term in found.state.terms])
    pairs = zip(found.state.terms, equations.effects, strict=True)
    lost = [term.effect for term, Z in pairs if _explained(equations.base, Z)]
    scaled = equations.columns / np.maximum(np.linalg.norm(equations.columns, axis=0), 1e-300)
    gram = scaled.T @ scaled + np.diag(limited.astype(float))
    weak = np.linalg.eigh(gram)
    open_ = np.abs(weak.eigenvectors[:, weak.eigenvalues < NONE])
    loose = [name for name, row in zip(names, open_[-len(names) :], strict=True) if np.any(row > 0.2)]
    if lost or loose:
        advice = "; ".join(f"{e.name} needs {e.excitation}" for e in lost or [t.effect for t in found.state.terms])
        raise NotObservableError(
            f"the rests of the {model.sensor} do not determine {', '.join([e.name for e in lost] or loose)}: {advice}; "
            f"or take it out of effects.{model.sensor}"
        )


def _explained(base: Values, Z: Values) -> bool:
    """Return whether base columns explain all of an effect's."""
    size = np.linalg.norm(Z, axis=0)
    Q, _ = np.linalg.qr(base)
    left = np.linalg.norm(Z - Q @ (Q.T @ Z), axis=0)
    return bool(np.all(left <= NEW * np.where(size > 0.0, size, 1.0)))
