"""The evidence of sets of effects: a linear problem with conjugate priors, under several hypotheses about the noise.

    log E(S, s, theta) = log pi(theta) - 1/2 log|C| - 1/2 log|X^T C^-1 X| - 1/2 log|I + D G D| - nu/2 log RSS

where

S     : a set of effects, Z their columns, each times the limit of its parameter by the data sheet
s     : a scale for each effect of S; its parameters over their limits are N(0, sigma^2 s^2), and D = diag(s)
theta : a hypothesis about the noise, covariance sigma^2 C, with log pi(sigma) = -log sigma; X: columns of the base
G     : Z^T M Z with ``M = C^-1 - C^-1 X (X^T C^-1 X)^-1 X^T C^-1``
RSS   : ``y^T M y - y^T M Z (D^-2 + G)^-1 Z^T M y``; nu: readings less columns of the base
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.records import Index, Values

Pick: TypeAlias = tuple[int, int]  # version and scale of an effect
Set: TypeAlias = frozenset[str]

# The prior was chosen on 738 simulated sensors: docs/blind_study.md.
SCALES = np.array([0.02, 0.06, 0.2, 0.6, 2.0, 20.0])  # of the data sheet's limits
SCALE_PRIOR = np.log([0.2375, 0.2375, 0.2375, 0.2375, 0.03, 0.02])
NEGLIGIBLE = 1e-4  # weight of a hypothesis or of a part of a mixture that is left out
WIDE = 8  # columns of an effect from which on LAPACK's factorisation costs less than an elimination of all side by side
RIDGE = 1e-12  # of a column's square: 1e4 times the rounding of a double


@dataclass(frozen=True)
class Version:
    """The columns of an effect at one value of what is not linear in it."""

    columns: Index  # (k,), places among the products
    log_weight: float  # of its prior


@dataclass(frozen=True)
class Problem:
    """Candidates beside a base, which is projected out, under t hypotheses about the noise."""

    products: Values  # (t, p + 1, p + 1); of columns over the limits of their parameters, and last the readings
    prior: Values  # (t,); log pi(theta) - 1/2 log|C| - 1/2 log|X^T C^-1 X|
    within: float  # sum of squares that no column changes
    free: float  # nu
    versions: Mapping[str, Sequence[Version]]
    limits: Mapping[str, Values]  # (k,), of the parameters of each effect; the unit of its columns
    excluded: Mapping[str, Set] = field(default_factory=dict)  # effects that are never in a set with this one

    def rss(self, squares: Values) -> Values:
        """Return -nu/2 log RSS of sums of squares."""
        return np.asarray(-0.5 * self.free * np.log(np.maximum(squares + self.within, 1e-300)))

    def under(self, kept: Values) -> Problem:
        """Return the problem under some of the hypotheses."""
        return replace(self, products=self.products[kept], prior=self.prior[kept])


class Given:
    """A problem beside a set of effects at chosen versions and scales."""

    def __init__(self, problem: Problem, picks: Mapping[str, Pick]) -> None:
        self.problem, self.level = problem, problem.prior
        self.squares, self._half = problem.products[:, -1, -1], None  # of the readings; what the set takes
        if picks:
            held = [problem.versions[name][v].columns for name, (v, _) in picks.items()]
            at = np.concatenate(held)
            scale = np.repeat([SCALES[s] for _, s in picks.values()], [len(c) for c in held])
            L = np.linalg.cholesky(problem.products[:, at[:, None], at] + np.diag(scale**-2.0))
            self._half = np.linalg.inv(L) @ problem.products[:, at]
            self.squares = self.squares - np.sum(self._half[:, :, -1] ** 2, axis=1)
            logarithm = 2.0 * np.sum(np.log(np.einsum("tkk->tk", L)), axis=1) + 2.0 * float(np.sum(np.log(scale)))
            chosen = sum(float(SCALE_PRIOR[s] + problem.versions[n][v].log_weight) for n, (v, s) in picks.items())
            self.level = problem.prior - 0.5 * logarithm + chosen

    def alone(self) -> Values:
        """Return log E of the set under each hypothesis: (t,) array."""
        return self.level + self.problem.rss(self.squares)

    def conditionals(self, names: Sequence[str]) -> dict[str, Values]:
        """Return log E with each of some further effects, without prior odds: its (versions, scales) array."""
        found: dict[str, Values] = {}
        for block in self.blocks(names):
            each = np.logaddexp.reduce(block.score, axis=1).T
            found |= zip(block.names, np.split(each, block.starts[1:]), strict=True)
        return found

    def mixtures(self, names: Sequence[str]) -> dict[str, tuple[Values, Values, Values]]:
        """Return log weight, (m,), mean and standard deviation, (m, k), of effects' parameters over their limits."""
        found = {}
        for block in self.blocks(names):
            ends = [*block.starts[1:], block.score.shape[2]]
            top = np.maximum.reduceat(np.max(block.score, axis=(0, 1)), block.starts)
            owner = np.repeat(np.arange(len(ends)), np.diff([*block.starts, ends[-1]]))
            kept = block.score > top[owner] + np.log(NEGLIGIBLE)
            s, t, m = np.nonzero(kept)
            k = block.inner.shape[-1]
            inverse = np.linalg.inv(block.inner[t, m] + SCALES[s, None, None] ** -2.0 * np.eye(k))
            mean, weight = (inverse @ block.cross[t, m, :, None])[..., 0], block.score[kept]
            spread = np.einsum("nkk->nk", inverse) * (block.squares[kept] / self.problem.free)[:, None]
            deviation = np.sqrt(np.maximum(spread, 0.0))
            for place, name in enumerate(block.names):
                own = owner[m] == place
                found[name] = weight[own], mean[own], deviation[own]
        return found

    def blocks(self, names: Sequence[str]) -> list[Block]:
        """Return some further effects, those with as many columns together."""
        sizes: dict[int, list[str]] = {}
        for name in names:
            sizes.setdefault(len(self.problem.versions[name][0].columns), []).append(name)
        out, products = [], self.problem.products
        for alike in sizes.values():
            each = [self.problem.versions[name] for name in alike]
            at = np.array([version.columns for versions in each for version in versions])
            inner, cross = products[:, at[:, :, None], at[:, None, :]], products[:, at, -1]
            if self._half is not None:
                half = self._half[:, :, at].transpose(0, 2, 3, 1)
                inner = inner - half @ half.transpose(0, 1, 3, 2)
                cross = cross - (half @ self._half[:, None, :, -1:])[..., 0]
            gain, log_det = _explained(inner, cross, self.squares)
            squares = self.squares[:, None] - gain
            weight = SCALE_PRIOR[:, None, None] + [version.log_weight for versions in each for version in versions]
            score = self.problem.rss(squares) - 0.5 * log_det + self.level[:, None] + weight
            starts = np.cumsum([0, *(len(versions) for versions in each[:-1])])
            out.append(Block(alike, starts, inner, cross, score, squares + self.problem.within))
        return out


@dataclass(frozen=True)
class Block:
    """Effects with as many columns beside a set, their m versions one after the other."""

    names: list[str]
    starts: Index  # of each effect's versions
    inner: Values  # (t, m, k, k), products of columns
    cross: Values  # (t, m, k), with the readings
    score: Values  # (scales, t, m), log E
    squares: Values  # (scales, t, m), sum of squares that is left


def _explained(inner: Values, cross: Values, squares: Values) -> tuple[Values, Values]:
    """Return ``c^T A^-1 c`` and ``log|A D^2|``, with ``A = G + D^-2``: (scales, t, m) arrays.

    ``inner``: (t, m, k, k), G. ``cross``: (t, m, k), c. ``squares``: (t,), of the readings. Wide effects by Cholesky's
    factor of A with c as a further row, others by elimination of all side by side; the pivots of A are not below
    ``D^-2``.
    """
    k, least = inner.shape[-1], SCALES[:, None, None] ** -2.0
    log_det = np.broadcast_to(-k * np.log(least), (len(SCALES), *inner.shape[:2])).copy()
    if k > WIDE:
        joined = np.zeros((*log_det.shape, k + 1, k + 1))
        joined[..., :k, :k], joined[..., k, :k], diagonal = inner, cross, np.arange(k)
        joined[..., diagonal, diagonal] += least[..., None] + RIDGE * np.einsum("tmkk->tmk", inner)
        joined[..., k, k] = 1.0 + 2.0 * squares[:, None]
        factor = np.linalg.cholesky(joined)
        log_det += 2.0 * np.sum(np.log(np.einsum("...kk->...k", factor)[..., :k]), axis=-1)
        return np.sum(factor[..., k, :k] ** 2, axis=-1), log_det
    left = np.concatenate([inner, cross[..., None]], axis=3).transpose(2, 3, 0, 1)[:, :, None]
    left = left + np.eye(k, k + 1)[:, :, None, None, None] * least
    gain = np.zeros(log_det.shape)
    for j in range(k):
        pivot, row = np.maximum(left[j, j], least), left[j, j + 1 :]
        over = row / pivot
        gain += row[-1] * over[-1]
        log_det += np.log(pivot)
        left[j + 1 :, j + 1 :] -= row[:-1, None] * over
    return gain, log_det
