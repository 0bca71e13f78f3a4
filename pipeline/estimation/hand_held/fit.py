"""Base and effects fitted to rests and moves, by generalised least squares in Gauss-Newton rounds.

    step = (X^T C^-1 X)^-1 X^T C^-1 r,    covariance = sum over noises of weight k (X^T C^-1 X)^-1

The step is taken at the most likely noise; the covariance is averaged over the noises by their restricted likelihood,

    -2 log L_R = rss / k + nu log k + log det C + log det(X^T C^-1 X),    k = max(1, rss / nu),   nu = n - p

A combination of effects' parameters that the equations do not determine (as of the nine cross-axis terms of an
accelerometer at rest, two) stays at its shortest, and its uncertainty is that of the data sheet's limits taken for
two standard deviations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import NotObservableError
from pipeline.estimation.hand_held.likelihood import NEW, beside
from pipeline.estimation.hand_held.model import stepped
from pipeline.estimation.joint import parameter_names

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from pipeline.estimation.hand_held.equations import Equations, HandNoise
    from pipeline.estimation.hand_held.model import Model, State

    Values = NDArray[np.float64]

ROUNDS = 30
SMALL_STEP = 1e-3  # of a standard uncertainty
LEAST_WEIGHT = 1e-6


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
    scale : float
        k.
    degrees_of_freedom : float
    residual : (n,) array
        Over the white noise of each equation.
    error : (n,) array
        That white noise.
    rank : int
        Directions that the equations determine.
    rounds : int
    converged : bool
    condition : float
    """

    state: State
    covariance: Values
    log_likelihood: float
    noise: HandNoise
    scale: float
    degrees_of_freedom: float
    residual: Values
    error: Values
    rank: int
    rounds: int
    converged: bool
    condition: float


@dataclass(frozen=True)
class Solved:
    """A step with its precision, at one noise: ``step``, ``half half^T = (X^T C^-1 X)^-1``, null directions."""

    step: Values
    half: Values
    null: Values
    condition: float
    log_likelihood: float
    restricted: float
    scale: float
    rank: int


def fit(model: Model, start: State, noises: Sequence[HandNoise]) -> HandFit:
    """Fit bias, matrix and effects from given values.

    Parameters
    ----------
    model : Model
    start : State
    noises : sequence of HandNoise

    Returns
    -------
    HandFit
    """
    state, converged, rounds = start, False, 0
    equations = model.equations(state)
    best = beside(equations, noises).of_model()[1]
    while rounds < ROUNDS and not converged:
        rounds += 1
        solved = solve(equations, noises[best])
        state, taken = stepped(model, state, solved.step)
        equations = model.equations(state)
        small = SMALL_STEP * np.sqrt(solved.scale * np.sum(solved.half**2, axis=1))
        if np.all(np.abs(taken) <= np.maximum(small, 1e-13)):
            now = beside(equations, noises).of_model()[1]
            converged, best = now == best or rounds > ROUNDS // 2, now
    return _assessed(state, equations, noises, rounds, converged=converged)


def _assessed(
    state: State, equations: Equations, noises: Sequence[HandNoise], rounds: int, *, converged: bool
) -> HandFit:
    every = [solve(equations, noise) for noise in noises]
    best = int(np.argmax([s.log_likelihood for s in every]))
    restricted = np.array([s.restricted for s in every])
    weight = np.exp(restricted - restricted.max())
    weight /= weight.sum()
    kept = [(w, s, noise) for w, s, noise in zip(weight, every, noises, strict=True) if w > LEAST_WEIGHT]
    covariances = np.array([s.scale * s.half @ s.half.T for _, s, _ in kept])
    share = np.array([w for w, _, _ in kept])
    covariance = np.tensordot(share, covariances, 1) / share.sum()
    spare = max(len(equations.residual) - every[best].rank, 1)
    return HandFit(
        state,
        covariance,
        every[best].log_likelihood,
        noises[best],
        every[best].scale,
        _freedom(covariances, covariance, share / share.sum(), spare),
        equations.residual,
        equations.error,
        every[best].rank,
        rounds,
        converged,
        every[best].condition,
    )


def _freedom(covariances: Values, mean: Values, weight: Values, spare: float) -> float:
    """Return the degrees of freedom of an average of covariances: ``var / mean^2 = 2 / (nu - 4)`` of a variance."""
    own = np.diagonal(covariances, axis1=1, axis2=2) / np.maximum(np.diag(mean), 1e-300)
    spread = float(np.max(weight @ (own - 1.0) ** 2))
    return float(1.0 / (1.0 / spare + (0.0 if spread < 1e-12 else 1.0 / (4.0 + 2.0 / spread))))


def solve(equations: Equations, noise: HandNoise) -> Solved:
    """Solve for the step under one noise."""
    X = equations.columns
    n, p = X.shape
    white, logarithm = equations.whitened(noise, np.concatenate([X, equations.residual[:, None]], axis=1))
    X, r = white[:, :p], white[:, p]
    size = np.linalg.norm(X, axis=0)
    size = np.where(size > 0.0, size, 1.0)
    U, s, Vt = np.linalg.svd(X / size, full_matrices=True)
    kept = s > NEW * s[0] * 0.1
    rank = int(kept.sum())
    half = (Vt[: len(s)][kept] / s[kept, None]).T / size[:, None]
    along = U[:, : len(s)][:, kept].T @ r
    rss = float(r @ r - along @ along)
    spare = max(n - rank, 1)
    k, k_free = max(1.0, rss / n), max(1.0, rss / spare)
    inner = 2.0 * float(np.sum(np.log(s[kept]))) + 2.0 * float(np.sum(np.log(size)))
    return Solved(
        half @ along,
        half,
        np.concatenate([Vt[: len(s)][~kept], Vt[len(s) :]]).T,
        float(s[0] / s[-1]) if s[-1] > 0 else float("inf"),
        -0.5 * (rss / k + n * float(np.log(k)) + logarithm) + noise.prior,
        -0.5 * (rss / k_free + spare * float(np.log(k_free)) + logarithm + inner) + noise.prior,
        k_free,
        rank,
    )


def with_limits(
    model: Model, found: HandFit, noises: Sequence[HandNoise], limits: Mapping[str, Values]
) -> tuple[Values, list[str]]:
    """Return the covariance with what the equations leave open, and the names of the parameters concerned.

    Parameters
    ----------
    model : Model
    found : HandFit
    noises : sequence of HandNoise
    limits : mapping
        Effect to the limits of its parameters.

    Raises
    ------
    NotObservableError
        If an effect is not determined at all, or the data sheet has no limit for it.
    """
    equations = model.equations(found.state)
    names = parameter_names(model.sensor, [term.effect for term in found.state.terms])
    columns = equations.columns
    solved = solve(equations, noises[0])
    if solved.null.shape[1] == 0:
        return found.covariance, []
    size = np.linalg.norm(equations.whitened(noises[0], columns)[0], axis=0)
    open_ = solved.null / np.where(size > 0.0, size, 1.0)[:, None]
    precision = np.zeros(len(found.covariance))
    at = columns.shape[1] - len(names)
    for term in found.state.terms:
        own = slice(at, at + len(term.values))
        known = np.asarray(limits.get(term.effect.name, np.full(len(term.values), np.inf)))
        precision[own] = (2.0 / known) ** 2
        at = own.stop
    gram = open_.T @ (precision[:, None] * open_)
    reach = np.sqrt(np.sum(open_[-len(names) :] ** 2 * precision[-len(names) :, None], axis=1))
    concerned = [name for name, share in zip(names, reach, strict=True) if share > NEW * reach.max()]
    lost = [t.effect for t, Z in zip(found.state.terms, equations.effects, strict=True) if _lost(equations.base, Z)]
    if lost or np.linalg.eigvalsh(gram)[0] <= 1e-12 * max(float(np.trace(gram)), 1e-300):
        effects = lost or [t.effect for t in found.state.terms]
        advice = "; ".join(f"{e.name} needs {e.excitation}" for e in effects)
        raise NotObservableError(
            f"the rests of the {model.sensor} do not determine {', '.join(e.name for e in effects)}: {advice}; or take "
            f"it out of effects.{model.sensor}"
        )
    return found.covariance + open_ @ np.linalg.solve(gram, open_.T), concerned


def _lost(base: Values, Z: Values) -> bool:
    """Return whether base columns explain all of an effect's."""
    size = np.linalg.norm(Z, axis=0)
    Q, _ = np.linalg.qr(base)
    left = np.linalg.norm(Z - Q @ (Q.T @ Z), axis=0)
    return bool(np.all(left <= NEW * np.where(size > 0.0, size, 1.0)))
