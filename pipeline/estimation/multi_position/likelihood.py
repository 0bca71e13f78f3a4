"""Compute likelihoods of models of rests and moves, over a grid of noise hypotheses.

    -2 log L = rss / k + n log k + log det C,    rss = min_d (r - X d)^T C^-1 (r - X d),    k = max(1, rss / n)

with the symbols of ``model``, maximised over the hypotheses for each model. Twice the gain in log L by v parameters is
corrected for a variance that only the residuals show (Bartlett 1938):

    gain = (1 - h + (v - 2) / (2 n)) 2 (log L' - log L)

where h is the mean leverage of the model with the effect, over the kinds of equations in which the effect shows.
delta BIC is the gain minus ``v log n``; p follows from chi squared with v degrees of freedom.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import TYPE_CHECKING

import numpy as np

from pipeline.estimation.gauss_markov import SURE, Prior, Setting, selection_grid

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.estimation.multi_position.model import Equations
    from pipeline.records import Noise, Values

NEW = 1e-3  # share of a column's norm below which it adds no direction: rounding of the columns is below 1e-8
# The grids below were chosen by the study of 500 recordings (tests/study/test_hand_held_study.py); ``fit.refined``
# refines their steps where the data determine the scatter better.
UNLIKELY = -4.0  # prior log weight of a setting, e^-4 of the likeliest
FACTORS = 3.0 ** np.arange(-2.0, 3.0)  # of the bias instability of the prior
RATIOS = (0.1, 0.3, 1.0)  # of bias instability to white noise where none is stated
SCATTER = (0.0, 1.0, 3.0, 9.0, 27.0)  # of rests, of moves and of directions, for a covariance
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
        return not self.known or max(self.scatter) >= SCATTER[-1]

    def at(self, levels: Sequence[float]) -> NoiseHypothesis:
        """Return the hypothesis at other levels."""
        return replace(self, scatter=tuple(levels[:-1]), direction=levels[-1])

    def scaled(self, j: int, factor: float) -> NoiseHypothesis:
        """Return the hypothesis with one of its levels multiplied."""
        return self.at([level * (factor if i == j else 1.0) for i, level in enumerate(self.levels)])


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


def prior_hypotheses(prior: Prior, white: float, kinds: int) -> list[NoiseHypothesis]:
    """Return the hypotheses over which a covariance is averaged.

    ``prior``: of the bias instability. ``white``: white noise of a sample, unit of the sensor. ``kinds``: number of
    kinds of scatter.
    """
    bias = np.append(0.0, prior.wander * FACTORS if prior.wander > 0.0 else white * np.array(RATIOS))
    pairs = zip((bias / white).tolist(), prior.log_belief(bias).tolist(), strict=True)
    none = float(np.log(SURE * (len(SCATTER) - 1)))  # no scatter is stated, so that none at all is the likeliest
    hypotheses = [
        NoiseHypothesis(Setting(ratio, prior.time, belief), level, none=none)
        for ratio, belief in pairs
        if np.isfinite(belief)
        for level in product(SCATTER, repeat=kinds)
    ]
    steady_moves = [h for h in hypotheses if kinds > 1 and h.scatter[1] in {SCATTER[0], SCATTER[2]}]
    return hypotheses + [replace(h, direction=c) for h in steady_moves for c in SCATTER[2:]]


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
    """Return the (t, p, p) factors that make (t, n, p) columns orthonormal; directions below ``NEW`` are zeros."""
    size = np.where(sizes > 0.0, sizes, 1.0)
    products = columns.transpose(0, 2, 1) @ columns / (size[:, :, None] * size[:, None, :])
    values, vectors = np.linalg.eigh(products)
    kept = values > NEW**2
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
