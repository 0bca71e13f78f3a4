"""What the scatter of hand-held rests does to an estimate: white noise, tremor of each rest, and a bias wander.

The error of the length of gravity at rest i is ``e_i = a_i . (noise of its mean)``, with ``a_i = n_i^T L``, so that

    C_ij = (v_i + s^2) delta_ij + w^2 (a_i . a_j) B_ij(tau)

where

    v_i : variance of the mean by white noise, g^2
    s   : standard deviation of what each rest has of its own (tremor, creep), g
    w   : standard deviation of the bias wander, g; B its correlation between the rests, for the time tau

Rests that follow each other share the wander: taken for independent, they would claim too small an uncertainty of the
bias. Nobody knows s, w and tau, so each point of a grid is weighted by its restricted likelihood (Patterson & Thompson,
Biometrika 58, 1971) times what is believed of the wander, as in ``pipeline.estimation.engine``. For one s and
tau one eigendecomposition gives every w.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.estimation.engine import Posterior
from pipeline.estimation.gauss_markov import SURE, block_covariance
from pipeline.estimation.uncertainty_budget import scatter_contribution

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.estimation.gauss_markov import Prior
    from pipeline.records import Contribution

    Values = NDArray[np.float64]

TREMORS = np.geomspace(0.1, 3.0, 10)  # of the scatter beyond white noise that the residuals show
WANDERS = np.append(0.0, np.geomspace(0.125, 27.0, 14))  # of the one that is believed
TIMES = (0.5, 1.0, 2.0)  # of the correlation time that is believed


@dataclass(frozen=True)
class RestErrors:
    """The errors of a fit to m rests."""

    error: Values  # (m,), g
    derivative: Values  # (m, p); of the length of gravity with respect to the parameters
    along: Values  # (m, 3); a_i
    variance: Values  # (m,), g^2; v_i
    between: float  # g; what they scatter beyond white noise, taken for independent
    # each (m,), s
    start: Values
    length: Values
    joined: NDArray[np.bool_]  # (m, m); whether the time between two rests is known


def rest_scatter(rests: RestErrors, gain: Values, prior: Prior) -> Contribution:
    """Return what the rests' scatter contributes to ``gain @ errors``.

    ``gain``: (p, m). ``prior``: of the bias wander.
    """
    spare = len(rests.error) - rests.derivative.shape[1]
    weight, covariances = rest_candidates(rests, gain, prior)
    covariance, freedom = Posterior(weight, covariances, float("inf")).averaged()
    parts = {
        "white noise": np.sqrt(np.minimum(np.diag(gain * rests.variance @ gain.T), np.diag(covariance))),
    }
    parts["bias wander and scatter of the rests"] = np.sqrt(np.diag(covariance) - parts["white noise"] ** 2)
    whole = scatter_contribution(covariance, float(spare), parts)
    return whole.with_freedom(freedom)


def rest_candidates(rests: RestErrors, gain: Values, prior: Prior) -> tuple[Values, Values]:
    """Return the weight of each candidate of the noise, (k,), and the covariance of ``gain @ errors``, (k, p, p)."""
    Q = np.linalg.qr(rests.derivative, mode="complete")[0][:, rests.derivative.shape[1] :]
    z = Q.T @ rests.error
    tremors = np.append(0.0, max(rests.between, 0.3 * float(np.sqrt(np.median(rests.variance)))) * TREMORS)
    wanders = prior.wander * WANDERS if prior.wander > 0.0 else np.zeros(1)
    belief = prior.log_belief(wanders) if prior.wander > 0.0 else np.zeros(1)
    scores, covariances = [], []
    for time in TIMES if prior.wander > 0.0 else (1.0,):
        B = np.where(rests.joined, block_covariance(rests.start, rests.length, time * prior.time), 0.0)
        B = B * (rests.along @ rests.along.T)
        slow = gain @ B @ gain.T
        for s in tremors:  # as nobody states a tremor, none at all is believed before any
            none = 0.0 if s > 0.0 else float(np.log(SURE * len(TREMORS)))
            own = rests.variance + s**2
            scores.append(_restricted_likelihood(z, Q.T @ (own[:, None] * Q), Q.T @ B @ Q, wanders**2) + belief + none)
            covariances.append(gain * own @ gain.T + (wanders**2)[:, None, None] * slow)
    weight = np.exp(np.concatenate(scores) - np.max(scores))
    return weight / weight.sum(), np.concatenate(covariances)


def _restricted_likelihood(z: Values, D: Values, E: Values, variances: Values) -> Values:
    """Return the log likelihood of ``z ~ N(0, D + v E)`` for each v: (k,) array."""
    root = np.linalg.cholesky(D)
    half = np.linalg.solve(root, E)
    e, U = np.linalg.eigh(np.linalg.solve(root, half.T))
    y = U.T @ np.linalg.solve(root, z)
    spectrum = 1.0 + np.outer(variances, np.clip(e, 0.0, None))
    logarithm = 2.0 * float(np.sum(np.log(np.diag(root))))
    score: Values = -0.5 * (np.sum(np.log(spectrum) + y**2 / spectrum, axis=1) + logarithm)
    return score
