"""Likelihoods of models on the linear form of rests and moves, and what an effect brings by them.

    -2 log L = rss / k + n log k + log det C,    rss = min_d (r - X d)^T C^-1 (r - X d),    k = max(1, rss / n)

maximised over the noises of a grid, by each model for itself. Twice the gain in log L by v parameters is corrected as
for a variance that only the residuals tell (Bartlett 1938; for one variance component, with the leverage's mean for
1 - nu/n, it is ``nu + (v - 2) / 2`` over n times it), as nobody knows beforehand how firmly the unit rests:

    gain = (1 - h + (v - 2) / (2 n)) 2 (log L' - log L)

where

h  : mean leverage of the model with the effect, of the kinds of equations in which the effect shows
nu : n less all parameters

delta BIC is the gain less ``v log n``, and p that of chi squared with v degrees of freedom.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from pipeline.estimation.multi_position.equations import Equations, HandNoise

    Values = NDArray[np.float64]

NEW = 1e-3  # share of a column's norm that those before it leave


@dataclass(frozen=True)
class Beside:
    """Whitened candidates and residual after the model's own columns are taken out, under each of t noises.

    Attributes
    ----------
    raw : list of (t, n, p) array
        What is left of each candidate's columns.
    half : list of (t, p, p) array
        ``raw @ half`` are orthonormal directions, zeros where a candidate shows fewer than it has columns.
    residual : (t, n) array
    basis : (t, n, b) array
        Orthonormal, of the model's columns.
    logarithm : (t,) array
        log det C, less twice the prior of the noise.
    """

    raw: list[Values]
    half: list[Values]
    residual: Values
    basis: Values
    logarithm: Values

    def log_likelihood(self, rss: Values) -> Values:
        """Return log L of a sum of squares under each noise: (t,) array."""
        n = self.residual.shape[1]
        k = np.maximum(1.0, rss / n)
        found: Values = -0.5 * (rss / k + n * np.log(k) + self.logarithm)
        return found

    def of_model(self) -> tuple[float, int]:
        """Return log L of the model, and the index of its best noise."""
        scores = self.log_likelihood(np.sum(self.residual**2, axis=1))
        return float(scores.max()), int(np.argmax(scores))

    def of_candidate(self, j: int) -> tuple[float, int]:
        """Return log L with candidate j, and the index of its best noise."""
        along = (self.residual[:, None, :] @ self.raw[j]) @ self.half[j]
        gained = np.sum(along**2, axis=(1, 2))
        scores = self.log_likelihood(np.sum(self.residual**2, axis=1) - gained)
        return float(scores.max()), int(np.argmax(scores))

    def count(self, j: int, at: int) -> int:
        """Return how many directions candidate j shows under a noise."""
        return int(np.any(self.half[j][at], axis=0).sum())

    def shown(self, j: int, at: int) -> Values:
        """Return the orthonormal directions of candidate j under a noise: (n, p) array."""
        return np.asarray(self.raw[j][at] @ self.half[j][at])

    def correction(self, j: int, at: int, added: int, kinds: Values) -> float:
        """Return the factor on the gain by candidate j; 0 where it leaves fewer than two equations to judge it by.

        Parameters
        ----------
        j, at : int
            Candidate and noise.
        added : int
            Parameters, also those whose column is zero at their start.
        kinds : (s, n) array
            Positive where an equation is of a kind.
        """
        power = np.sum(self.shown(j, at) ** 2, axis=1)
        leverage = np.sum(self.basis[at] ** 2, axis=1) + power
        factor = 0.0
        for kind in kinds > 0:
            factor += float(power[kind].sum() / power.sum() * (1.0 - leverage[kind].mean())) if kind.any() else 0.0
        n = len(leverage)
        spare = factor * n - (added - float(power.sum()))
        return max((spare + 0.5 * (added - 2)) / n, 0.0) if spare >= 2.0 - 1e-9 else 0.0


def halves(columns: Values, sizes: Values) -> Values:
    """Return what makes stacked columns orthonormal: (t, p, p) array; directions below ``NEW`` of the sizes are zeros.

    Parameters
    ----------
    columns : (t, n, p) array
    sizes : (t, p) array
        Norms before something was taken out of the columns.
    """
    size = np.where(sizes > 0.0, sizes, 1.0)
    products = columns.transpose(0, 2, 1) @ columns / (size[:, :, None] * size[:, None, :])
    values, vectors = np.linalg.eigh(products)
    kept = values > NEW**2
    half: Values = vectors * (kept / np.sqrt(np.where(kept, values, 1.0)))[:, None, :] / size[:, :, None]
    return half


def beside(equations: Equations, noises: Sequence[HandNoise]) -> Beside:
    """Return what is left beside the model's columns under every noise."""
    model = equations.columns
    together = np.concatenate([model, *equations.candidates, equations.residual[:, None]], axis=1)
    edges = np.cumsum([model.shape[1], *(c.shape[1] for c in equations.candidates)])
    whitened = [equations.whitened(noise, together) for noise in noises]
    white = np.array([w for w, _ in whitened])
    sizes = np.linalg.norm(white, axis=1)
    basis = white[:, :, : edges[0]] @ halves(white[:, :, : edges[0]], sizes[:, : edges[0]])
    rest = white - basis @ (basis.transpose(0, 2, 1) @ white)
    blocks = [slice(start, stop) for start, stop in pairwise(edges.tolist())]
    half = [halves(rest[:, :, block], sizes[:, block]) for block in blocks]
    logarithm = np.array([log - 2.0 * noise.prior for (_, log), noise in zip(whitened, noises, strict=True)])
    return Beside([rest[:, :, block] for block in blocks], half, rest[:, :, -1], basis, logarithm)
