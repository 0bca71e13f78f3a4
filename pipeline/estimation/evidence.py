"""Compute the evidence of sets of effects: a linear problem with conjugate priors, under hypotheses about the noise.

    log E(S, s, theta) = log pi(theta) - 1/2 log|C| - 1/2 log|X^T C^-1 X| - 1/2 log|I + D G D| - nu/2 log RSS

where

S     : a set of effects, Z their columns, each times the limit of its parameter by the sensor file
s     : a scale for each effect of S; its parameters over their limits are N(0, sigma^2 s^2), and D = diag(s)
theta : a hypothesis about the noise, covariance sigma^2 C, with log pi(sigma) = -log sigma; X: columns of the base
G     : Z^T M Z with ``M = C^-1 - C^-1 X (X^T C^-1 X)^-1 X^T C^-1``
RSS   : ``y^T M y - y^T M Z (D^-2 + G)^-1 Z^T M y``; nu: readings less columns of the base
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple, TypeAlias

import numpy as np

from pipeline.core.records import Index, Values
from pipeline.estimation.engine import cholesky
from pipeline.estimation.ranking import by_size

Pick: TypeAlias = tuple[int, int]  # version and scale of an effect
# log weight, (m,), mean and standard deviation, (m, k), of the normal components of a mixture
Mixture: TypeAlias = "tuple[Values, Values, Values]"
EffectSet: TypeAlias = frozenset[str]

# Chosen on 738 simulated sensors; stated probabilities and the share that is true: docs/evidence.md.
LIMIT_SCALES = np.array([0.02, 0.06, 0.2, 0.6, 2.0, 20.0])  # of the sensor file's limits
SCALE_PRIOR = np.log([0.2375, 0.2375, 0.2375, 0.2375, 0.03, 0.02])
NEGLIGIBLE_MIXTURE_WEIGHT = 1e-4  # weight below which a hypothesis or a component of a mixture is not used
READINGS, ZEROS = -2, -1  # columns of the padded products
WIDE = 8  # columns of an effect above which LAPACK's factorisation costs less than a vectorised elimination
FAR_TOO_MUCH = 2.0  # times the sum of squares that columns explain: rounding; at most 1 is possible
PRODUCT_ROUNDING = 1e-9  # of the largest eigenvalue: 1e7 times the rounding of a double, for products of products
PRODUCT_RIDGE = 1e-12  # of a column's square: 1e4 times the rounding of a double


class Version(NamedTuple):
    """The columns of an effect at one value of its nonlinear parameters."""

    columns: Index  # (k,), places among the products
    log_weight: float  # of its prior


@dataclass(frozen=True)
class CandidateProblem:
    """Candidates in addition to a base, which is projected out, under t hypotheses about the noise."""

    # (t, p + 2, p + 2); of columns per limit of their parameters, of the readings, and of a column of zeros, which
    # stands for the missing columns of smaller sets
    products: Values
    prior: Values  # (t,); log pi(theta) - 1/2 log|C| - 1/2 log|X^T C^-1 X|
    within: float  # sum of squares that no column changes
    free: float  # nu
    versions: Mapping[str, Sequence[Version]]
    limits: Mapping[str, Values]  # (k,), of the parameters of each effect; the unit of its columns
    excluded: Mapping[str, EffectSet] = field(default_factory=dict)  # effects that are never in a set with this one
    least: float = 0.0  # lower bound of sigma^2

    def rss(self, squares: Values) -> Values:
        """Return -nu/2 log RSS of sums of squares; if sigma has a lower bound, log L at its likeliest value."""
        total = np.maximum(squares + self.within, 1e-300)
        if not self.least:
            return np.asarray(-0.5 * self.free * np.log(total))
        variance = self.variance(total)
        return np.asarray(-0.5 * (self.free * np.log(variance) + total / variance))

    def variance(self, total: Values) -> Values:
        """Return the estimate of sigma^2 from total sums of squares."""
        return np.maximum(total / self.free, self.least)

    def under(self, kept: Values | slice) -> CandidateProblem:
        """Return the problem under some of the hypotheses."""
        return replace(self, products=self.products[kept], prior=self.prior[kept])


def excited(products: Values, size: Values, limit: Values, least: float) -> Iterator[Values | None]:
    """Yield the linear map from columns to columns per limit of the parameters, in the excited directions.

    ``products``: (m, k, k) of m effects, with the base projected out. ``size``: (m, k), norm of the columns before the
    projection. ``limit``: (m, k). ``least``: smallest share of that norm after the projection. None: all directions are
    excited, and the map is the limits.
    """
    decomposed = np.linalg.eigh(products / (size[:, :, None] * size[:, None]))
    for values, vectors, own, most in zip(*decomposed, size, limit, strict=True):
        kept = vectors[:, values > least**2]
        yield None if values[0] > least**2 else np.asarray((kept @ kept.T) * most / own[:, None] * own)


def linear_problem(  # noqa: PLR0917  (they are the problem)
    columns: Sequence[tuple[str, float, slice]],
    products: Values,
    size: Values,
    prior: Values,
    known: tuple[Mapping[str, Values], Mapping[str, Values]],
    excluded: Mapping[str, EffectSet],
    *,
    samples: float,
    free: float,
    new: float,
    within: float = 0.0,
    least: float = 0.0,
) -> CandidateProblem:
    """Return the problem of candidates at a fit.

    ``columns``: effect, log weight and place of the columns of each version, the fitted one first. ``products``: (t, p
    + 1, p + 1), of columns and the fit's residual, with the base projected out; white noise first. ``size``: (p + 1,),
    norm of the columns before this projection. ``known``: values of the fitted effects, whose signal is added to the
    residual; and limits by the sensor file. An effect without a limit has as unit the parameter whose signal is as
    large as the noise of all ``samples``. ``new``: share of a column's norm below which the base explains it. Others:
    of ``CandidateProblem``.
    """
    (fitted, stated), values = known, np.zeros(products.shape[1])
    versions: dict[str, list[Version]] = {}
    limits: dict[str, Values] = {}
    for name, weight, at in columns:
        if name in fitted and name not in versions:
            values[at] = fitted[name][: at.stop - at.start]
        versions.setdefault(name, []).append(Version(np.arange(at.start, at.stop), weight))
    if fitted:
        products[:, :, -1] += products @ values
        products[:, -1] += values @ products
    unit = np.ones(len(size))
    changes: dict[int, Values] = {}
    for name, _, at in columns:
        if name not in limits:
            noise = np.sqrt(samples / np.maximum(np.diag(products[0])[at], 1e-300))
            limit = stated.get(name, noise)[: len(noise)]
            limits[name] = np.where(np.isfinite(limit), limit, noise)
        unit[at] = limits[name]
    for members in by_size(at.stop - at.start for _, _, at in columns):
        places = [columns[j][2] for j in members]
        inner, sizes = np.stack([products[0, at, at] for at in places]), np.stack([size[at] for at in places])
        found = excited(inner, sizes, np.stack([limits[columns[j][0]] for j in members]), new)
        changes |= {j: change for j, change in zip(members, found, strict=True) if change is not None}
    for j in changes:
        unit[columns[j][2]] = 1.0
    scaled = np.zeros(np.add(products.shape, (0, 1, 1)))
    np.multiply(products, unit[:, None] * unit, out=scaled[:, :ZEROS, :ZEROS])
    for at, change in ((columns[j][2], changes[j]) for j in sorted(changes)):
        scaled[:, :, at] = scaled[:, :, at] @ change
        scaled[:, at] = change.T @ scaled[:, at]
    return CandidateProblem(scaled, prior, within, free, versions, limits, excluded, least)


class Given:
    """A problem given s sets of effects, each at chosen versions and scales."""

    def __init__(self, problem: CandidateProblem, sets: Sequence[Mapping[str, Pick]]) -> None:
        self.problem, products = problem, problem.products
        columns = [[problem.versions[name][v].columns for name, (v, _) in picks.items()] for picks in sets]
        shape = len(sets), max(sum(map(len, each)) for each in columns)
        self._at, scale = np.full(shape, ZEROS), np.ones(shape)
        for row, (picks, each) in enumerate(zip(sets, columns, strict=True)):
            if each:
                used = slice(sum(map(len, each)))
                self._at[row, used] = np.concatenate(each)
                scale[row, used] = np.repeat([LIMIT_SCALES[s] for _, s in picks.values()], [len(c) for c in each])
        inner = products[:, self._at[:, :, None], self._at[:, None, :]] + scale[:, :, None] ** -2.0 * np.eye(shape[1])
        L = cholesky(inner)
        self._inverse = np.linalg.inv(L)
        self._readings = (self._inverse @ products[:, self._at, READINGS, None])[..., 0]
        self.squares = products[:, None, READINGS, READINGS] - np.sum(self._readings**2, axis=2)
        logarithm = 2.0 * np.sum(np.log(np.einsum("tskk->tsk", L)), axis=2) + 2.0 * np.sum(np.log(scale), axis=1)
        chosen = [sum(SCALE_PRIOR[s] + problem.versions[n][v].log_weight for n, (v, s) in p.items()) for p in sets]
        self.level = problem.prior[:, None] - 0.5 * logarithm + np.array(chosen)

    def alone(self) -> Values:
        """Return log E of the sets under each hypothesis: (t, s) array."""
        return np.asarray(self.level + self.problem.rss(self.squares))

    def further(self, names: Sequence[str]) -> Further:
        """Return further effects in addition to each set, those with equal numbers of columns next to each other."""
        versions, products = self.problem.versions, self.problem.products
        groups = [[names[j] for j in index] for index in by_size(len(versions[name][0].columns) for name in names)]
        ordered, inner, cross, gains, log_dets = [name for group in groups for name in group], [], [], [], []
        for group in groups:
            at = np.array([version.columns for name in group for version in versions[name]])
            half = self._inverse @ products[:, self._at[:, :, None], at.ravel()]  # squares: what the sets explain
            half = half.reshape(*half.shape[:3], *at.shape).transpose(0, 1, 3, 4, 2)
            inner.append(products[:, None, at[:, :, None], at[:, None, :]] - half @ half.swapaxes(3, 4))
            cross.append(products[:, None, at, READINGS] - (half @ self._readings[:, :, None, :, None])[..., 0])
            flat = inner[-1].reshape(-1, *inner[-1].shape[2:]), cross[-1].reshape(-1, *cross[-1].shape[2:])
            gain, log_det = _explained(*flat, self.squares.ravel())
            gains.append(gain.reshape(-1, *inner[-1].shape[:3]))
            log_dets.append(log_det.reshape(gains[-1].shape))
        squares = self.squares[:, :, None] - np.concatenate(gains, axis=3)
        weight = SCALE_PRIOR[:, None, None, None] + [v.log_weight for name in ordered for v in versions[name]]
        score = self.problem.rss(squares) - 0.5 * np.concatenate(log_dets, axis=3) + self.level[:, :, None] + weight
        owner = np.repeat(np.arange(len(ordered)), [len(versions[name]) for name in ordered])
        return Further(ordered, owner, inner, cross, score, squares + self.problem.within)


class Conditional(NamedTuple):
    """Log E of a set with a further effect, without prior odds: over all its versions and scales, and at the best."""

    total: float
    best: float
    pick: Pick


@dataclass(frozen=True)
class Further:
    """Further effects given s sets; their m versions follow each other."""

    names: list[str]
    owner: Index  # (m,), number of the effect of each version
    inner: Sequence[Values]  # of successive versions with k columns: (t, s, m', k, k), their products
    cross: Sequence[Values]  # (t, s, m', k), those with the readings
    score: Values  # (scales, t, s, m), log E
    squares: Values  # (scales, t, s, m), RSS

    def under(self, kept: Values) -> Further:
        """Return the same under some of the hypotheses."""
        inner, cross = ([values[kept] for values in each] for each in (self.inner, self.cross))
        return replace(self, inner=inner, cross=cross, score=self.score[:, kept], squares=self.squares[:, kept])

    @property
    def starts(self) -> Index:
        """The first version of each effect."""
        return np.searchsorted(self.owner, np.arange(len(self.names)))

    @cached_property
    def conditionals(self) -> list[dict[str, Conditional]]:
        """Log E of each set with each effect."""
        scales, count = len(self.score), self.score.shape[3]
        evidence = log_sum(self.score, 1).transpose(1, 2, 0).reshape(self.score.shape[2], -1)
        first = scales * self.starts
        best = np.maximum.reduceat(evidence, first, axis=1)
        above = evidence - best[:, np.repeat(self.owner, scales)]
        total = best + np.log(np.add.reduceat(np.exp(above), first, axis=1))
        places = np.where(above == 0.0, np.arange(scales * count), scales * count)
        rows = (each.tolist() for each in (total, best, np.minimum.reduceat(places, first, axis=1) - first))
        found = [map(Conditional, t, b, (divmod(p, scales) for p in each)) for t, b, each in zip(*rows, strict=True)]
        return [dict(zip(self.names, each, strict=True)) for each in found]

    def mixtures(self, number: int, names: Collection[str], problem: CandidateProblem) -> dict[str, Mixture]:
        """Return the distribution of the parameters of some of the effects over their limits, given one of the sets."""
        mixtures, first = {}, 0
        score, squares = self.score[:, :, number], self.squares[:, :, number]
        top = np.maximum.reduceat(np.max(score, axis=(0, 1)), self.starts)
        kept = score > top[self.owner] + np.log(NEGLIGIBLE_MIXTURE_WEIGHT)
        for inner, cross in zip(self.inner, self.cross, strict=True):
            s, t, m = np.nonzero(kept[:, :, first : first + inner.shape[2]])
            components, owner = (s, t, first + m), self.owner[first + m]
            inverse = np.linalg.inv(inner[t, number, m] + LIMIT_SCALES[s, None, None] ** -2.0 * np.eye(inner.shape[-1]))
            mean, weight = (inverse @ cross[t, number, m, :, None])[..., 0], score[components]
            variance = np.einsum("nkk->nk", inverse) * problem.variance(squares[components])[:, None]
            deviation, first = np.sqrt(np.maximum(variance, 0.0)), first + inner.shape[2]
            for j in [j for j in np.unique(owner).tolist() if self.names[j] in names]:
                of_effect = owner == j
                mixtures[self.names[j]] = weight[of_effect], mean[of_effect], deviation[of_effect]
        return mixtures


def log_sum(values: Values, axis: int) -> Values:
    """Return the logarithm of the sum of exponentials."""
    top = values.max(axis=axis, keepdims=True)
    return np.asarray(np.log(np.sum(np.exp(values - top), axis=axis)) + np.squeeze(top, axis))


def _explained(inner: Values, cross: Values, squares: Values) -> tuple[Values, Values]:
    """Return ``c^T A^-1 c`` and ``log|A D^2|``, with ``A = G + D^-2``: (scales, t, m) arrays.

    ``inner``: (t, m, k, k), G. ``cross``: (t, m, k), c. ``squares``: (t,), of the readings. Effects of many columns are
    computed by the Cholesky factor of A with c as a further row, others by a vectorised elimination; the pivots of A
    are at least ``D^-2``. Where rounding of products far above the noise leaves no positive definite matrix, the
    eigenvalues of G are used.
    """
    k, least = inner.shape[-1], LIMIT_SCALES[:, None, None] ** -2.0
    log_det = np.broadcast_to(-k * np.log(least), (len(LIMIT_SCALES), *inner.shape[:2])).copy()
    try:
        return (_by_cholesky if k > WIDE else _by_elimination)(inner, cross, squares, log_det)
    except np.linalg.LinAlgError:
        return _by_eigenvalues(inner, cross, squares)


def _by_cholesky(inner: Values, cross: Values, squares: Values, log_det: Values) -> tuple[Values, Values]:
    """Return ``_explained`` by Cholesky factors; ``log_det``: ``log|D^2|``."""
    k, least = inner.shape[-1], LIMIT_SCALES[:, None, None] ** -2.0
    joined = np.zeros((*log_det.shape, k + 1, k + 1))
    joined[..., :k, :k], joined[..., k, :k], diagonal = inner, cross, np.arange(k)
    joined[..., diagonal, diagonal] += least[..., None] + PRODUCT_RIDGE * np.einsum("tmkk->tmk", inner)
    joined[..., k, k] = 1.0 + 2.0 * squares[:, None]
    factor = np.linalg.cholesky(joined)
    log_det += 2.0 * np.sum(np.log(np.einsum("...kk->...k", factor)[..., :k]), axis=-1)
    return np.sum(factor[..., k, :k] ** 2, axis=-1), log_det


def _by_elimination(inner: Values, cross: Values, squares: Values, log_det: Values) -> tuple[Values, Values]:
    """Return ``_explained`` by a vectorised elimination; ``log_det``: ``log|D^2|``."""
    k, least = inner.shape[-1], LIMIT_SCALES[:, None, None] ** -2.0
    matrix = np.concatenate([inner, cross[..., None]], axis=3).transpose(2, 3, 0, 1)[:, :, None]
    matrix = matrix + np.eye(k, k + 1)[:, :, None, None, None] * least
    gain = np.zeros(log_det.shape)
    with np.errstate(over="ignore", invalid="ignore"):
        for j in range(k):
            pivot, row = np.maximum(matrix[j, j], least), matrix[j, j + 1 :]
            ratio = row / pivot
            gain += row[-1] * ratio[-1]
            log_det += np.log(pivot)
            matrix[j + 1 :, j + 1 :] -= row[:-1, None] * ratio
    if not np.all(gain <= FAR_TOO_MUCH * (1.0 + squares[:, None])):
        raise np.linalg.LinAlgError
    return gain, log_det


def _by_eigenvalues(inner: Values, cross: Values, squares: Values) -> tuple[Values, Values]:
    """Return ``_explained`` by the eigenvalues of G; those that are rounding of the largest one count as zero."""
    values, vectors = np.linalg.eigh(inner)
    shown = np.where(values > PRODUCT_ROUNDING * np.abs(values).max(axis=-1, keepdims=True), values, 0.0)
    along = np.where(shown > 0.0, (cross[..., None, :] @ vectors)[..., 0, :], 0.0)
    least = LIMIT_SCALES[:, None, None, None] ** -2.0
    gain = np.sum(along**2 / (shown + least), axis=-1)
    return np.minimum(gain, squares[:, None]), np.sum(np.log1p(shown / least), axis=-1)
