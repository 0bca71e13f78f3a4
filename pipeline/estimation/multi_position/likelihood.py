"""Likelihoods of the model of one sensor in rests and moves (``model``), and of candidates in addition to it.

The steadiness of a unit by hand is unknown: a, c, q and k are free in all comparisons. The likelihood of a model is

    -2 log L = rss / k + n log k + log det C,    rss = min_d (r - X d)^T C^-1 (r - X d),    k = max(1, rss / n)

maximised over the hypotheses of a grid. Twice the gain in log L by v parameters is corrected for a variance that only
the residuals show (Bartlett 1938):

    gain = (1 - h + (v - 2) / (2 n)) 2 (log L' - log L)

where h is the mean leverage of the model with the effect, over the kinds of equations in which the effect shows.
delta BIC is the gain minus ``v log n``; p follows from chi squared with v degrees of freedom.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.core.records import Values
    from pipeline.estimation.multi_position.model import Equations, NoiseHypothesis

# share of a column's norm below which it adds no direction: rounding of the columns is below 1e-8
MIN_NEW_NORM_SHARE = 1e-3
NEGLIGIBLE_LOG_LIKELIHOOD = 12.0  # of log L below the best: a weight of 6e-6
PREDICTED_TO = 4.0  # of log L by a linear model: 9 of 10 fits of 13 simulated units differ by less than 0.5
CEILING_TO = 1.0  # of log L without a residual, which changes by up to 0.02 between fits of these units


def log_likelihood(rss: Values, n: int, log_determinant: Values) -> Values:
    """Return log L of sums of squares of n equations; ``log_determinant``: log det C minus twice the prior."""
    k = np.maximum(1.0, rss / n)
    return np.asarray(-0.5 * (rss / k + n * np.log(k) + log_determinant))


def log_likelihoods(
    equations: Equations, hypotheses: Sequence[NoiseHypothesis], predicted: Values | None = None
) -> Values:
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


def _log_likelihoods(equations: Equations, hypotheses: Sequence[NoiseHypothesis]) -> Values:
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


def project_out(equations: Equations, hypotheses: Sequence[NoiseHypothesis]) -> ProjectedCandidates:
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
    factors = [
        _orthonormalizers(Z.transpose(0, 2, 1) @ Z, sizes[:, block]) for Z, block in zip(raw, blocks, strict=True)
    ]
    log_determinant = np.array([log - 2.0 * h.prior for (_, log), h in zip(whitened, hypotheses, strict=True)])
    return ProjectedCandidates(raw, factors, rest[:, :, -1], basis, log_determinant)
