"""Compute how much further columns explain of the residual, given base, configured and selected effects.

    y_c = X_c beta_c + Z gamma_c + noise,    drop(Z, c) = b^T G^-1 b
    b = Z^T M C^-1 y_c,    G = Z^T M C^-1 Z,    M = 1 - C^-1 X_c (X_c^T C^-1 X_c)^-1 X_c^T

    X_c  : columns of the model on axis c: 1, what K acts on, and every parameter of every effect
    Z    : (n, r) further columns, such as curves in a covariate or the columns of a functional form
    C    : white noise plus bias wander, ``pipeline.estimation.gauss_markov``
    drop : reduction of the whitened sum of squares by them

The coefficients of effects that the axes share are free on each axis: then the axes are separate problems, and no form
explains more than it does. Rounding errors of products are at most ``u sqrt(n) |a| |a'|`` (Higham and Mary 2019,
doi:10.1137/18M1226312). So the remaining sum of squares of a column z, after columns a_k are subtracted with
coefficients x_k, is uncertain by ``e^2 = u sqrt(n) (|z| + sum |x_k| |a_k|)^2``. Below e^2 a column explains nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike

from pipeline.core.records import Index, Mask, Values
from pipeline.estimation.design import joined_motions, true_motion
from pipeline.estimation.gauss_markov import WHITE_SETTING, Setting
from pipeline.estimation.observations import Observations
from pipeline.estimation.ranking import MIN_LEFT_SQUARE_SHARE, MIN_NEW_COLUMN_SHARE, UNIT_COLUMN_RIDGE
from pipeline.estimation.selection import Selection
from pipeline.evaluation.diagnosis.functional_forms import Curves

SETS_OF_AXES = [tuple(c for c in range(3) if code >> c & 1) for code in range(8)]
UNIT_ROUNDOFF = float(np.finfo(np.float64).eps) / 2.0  # u


class FormGain(NamedTuple):
    """The improvement of the fit by a functional form."""

    delta_bic: float
    p_value: float
    axes: tuple[int, ...]  # that it improves
    setting: int  # index of its best noise setting


class Whitened(NamedTuple):
    """Whitened columns: deviations from the means of their blocks, (n, q), and these means by noise, (t, q, m)."""

    inside: Values
    means: Values

    def times(self, other: Whitened) -> Values:
        """Return the products with other columns: (t, q, p) array."""
        return np.asarray(self.means @ other.means.transpose(0, 2, 1) + self.inside.T @ other.inside)

    def grams(self, r: int) -> Values:
        """Return the products of the columns of each of m forms of r columns: (t, m, r, r) array."""
        found = np.empty((len(self.means), len(self.means[0]) // r, r, r))
        for i, j in product(range(r), repeat=2):
            found[..., i, j] = np.einsum("tqm,tqm->tq", self.means[:, i::r], self.means[:, j::r])
            found[..., i, j] += np.einsum("nq,nq->q", self.inside[:, i::r], self.inside[:, j::r])
        return found


class Scan:
    """The residual of a selection's fit under every noise setting, and its reduction by further columns.

    ``explained``: curves that are projected out too.
    """

    def __init__(self, selection: Selection, explained: Curves | None = None) -> None:
        self.scale = selection.start.scale
        self.observations = observations = selection.observations.less_stop_errors
        motions = [true_motion(part, selection.fit.terms) for part in selection.observations.parts]
        self.motions = [motion for motion, _ in joined_motions(motions)]
        self.blocks, self.weight = observations.blocks, observations.weight
        self._label = self.blocks.label(len(self.weight))
        self.settings = WHITE_SETTING, *selection.settings
        self.noise = self.blocks.model(self.settings)
        self._unit = float(UNIT_ROUNDOFF * np.sqrt(observations.samples)) ** 0.5
        # its columns depend on no weight
        self.design = design = selection.fit.design(observations)
        A, self._places = design.columns.columns, [design.places(c)[0] for c in range(3)]
        if explained is not None:
            values, first = self.values(explained), A.shape[1]
            n, versions, q = values.shape
            A = np.concatenate([A, values.reshape(n, -1)], axis=1)
            more = [first + c % versions * q + np.arange(q) for c in range(3)]
            self._places = [np.append(*each) for each in zip(more, self._places, strict=True)]
        self.columns, self.every = A, self.whitened(A)  # model, explained curves and readings of all axes
        self._fit(self.every.times(self.every))

    def white(self, c: int, rows: Mask) -> WhiteAxis:
        """Return what the model leaves of an axis at some rows, weighted."""
        *known, target = self._places[c]
        columns = np.sqrt(self.weight[rows])[:, None] * self.columns[rows]
        found = WhiteAxis(columns[:, target], columns[:, :0])
        found.add(columns[:, known])
        return found

    def _fit(self, among: Values) -> None:
        """Compute what the model leaves of the readings from the products of all columns, (t, p, p)."""
        self._among = among
        self.samples = 3.0 * self.observations.samples
        self.within = float(np.sum(self.observations.scatter / self.scale**2))
        self._fitted: list[tuple[Index, int, Values]] = []  # of each axis: model, residual, inverse of its products
        left = []
        for c, (*known, target) in enumerate(self._places):
            products = among[:, np.array(known)[:, None], known]
            size = np.sqrt(np.einsum("tpp->tp", products))
            size = np.where(size > 0.0, size, 1.0)
            over = size[:, :, None] * size[:, None, :]
            inverse = np.linalg.inv(products / over + UNIT_COLUMN_RIDGE * np.eye(len(known))) / over
            self._fitted.append((np.array(known), target, inverse))
            cross = among[:, known, target]
            taken = np.einsum("tp,tpq,tq->t", cross, inverse, cross)
            left.append((among[:, target, target] - taken)[1:] / self.scale[c] ** 2)
        logarithms = self.noise.log_determinant[1:] + np.sum(np.log(self.blocks.weight))
        self._penalty: Values = 1.5 * logarithms - np.array([setting.prior for setting in self.settings[1:]])
        self.left: Values = np.stack(left, axis=1)
        self.before = float(self.log_likelihood(self.left.sum(axis=1)).max())

    def under(self, settings: Iterable[Setting]) -> Scan:
        """Return the scan under other noise settings."""
        found = copy(self)
        found.settings = WHITE_SETTING, *settings
        found.noise = self.blocks.model(found.settings)
        found.every = Whitened(self.every.inside, found.noise.whitened(self.means(self.columns)))
        found._fit(found.every.times(found.every))  # noqa: SLF001
        return found

    def resampled(
        self, columns: Values, edges: Index, resamples: Iterable[Observations]
    ) -> Iterator[tuple[Scan, Values]]:
        """Yield the scan of observations with other weights, and the products of columns: (t, q, q).

        ``columns``: (n, q), first those of the scan. Between two of the ``edges``, rows, all weights differ by one
        factor: rows of one block are then averaged.
        """
        first = np.union1d(edges, self.blocks.first)
        weight = np.add.reduceat(self.weight, first)
        means = np.add.reduceat(self.weight[:, None] * columns, first) / weight[:, None]
        inside = columns - np.repeat(means, np.diff(np.append(first, len(columns))), axis=0)
        inside *= np.sqrt(self.weight)[:, None]
        grams = np.stack([part.T @ part for part in np.split(inside, edges[1:])])
        at = np.searchsorted(first, self.blocks.first)
        for observations in resamples:
            found, factor = copy(self), observations.weight / self.weight
            found.observations, found.blocks = observations, observations.blocks
            found.noise = found.blocks.model(self.settings)
            of_rows = (weight * factor[first])[:, None]
            of_blocks = np.add.reduceat(of_rows * means, at) / found.blocks.weight[:, None]
            between = np.sqrt(of_rows) * (means - np.repeat(of_blocks, np.diff(np.append(at, len(first))), axis=0))
            whole = np.tensordot(factor[edges], grams, axes=1)
            products = Whitened(between, found.noise.whitened(of_blocks))
            among, p = products.times(products) + whole, self.columns.shape[1]
            found._fit(among[:, :p, :p])  # noqa: SLF001
            yield found, among

    def values(self, curves: Curves) -> Values:
        """Return the values of curves in all rows: (n, 3, q) array, or (n, 1, q) if they are equal on all axes.

        They depend at a sample on the motion there alone.
        """
        return np.concatenate([curves(motion) for motion in self.motions])

    def whitened(self, columns: Values) -> Whitened:
        """Return (n, q) columns whitened."""
        means = self.means(columns)
        inside = columns - means[self._label]
        inside *= np.sqrt(self.weight)[:, None]
        return Whitened(inside, self.noise.whitened(means))

    def means(self, columns: Values) -> Values:
        """Return the means of (n, q) columns in blocks: (m, q) array."""
        return np.asarray(self.blocks.sums(self.weight[:, None] * columns) / self.blocks.weight[:, None])

    def without_model(self, c: int, one: Whitened, other: Whitened) -> tuple[Values, Values]:
        """Return products of columns on an axis without their part in the model, white noise first.

        Those of one with other columns are a (t, q, p) array, the squares of the other ones a (t, p) array.
        """
        index, _, inverse = self._fitted[c]
        known = Whitened(self.every.inside[:, index], self.every.means[:, index])
        across = known.times(other)
        taken = inverse @ across
        own = np.einsum("tqm,tqm->tq", other.means, other.means) + np.einsum("nq,nq->q", other.inside, other.inside)
        squares = own - np.einsum("tkp,tkp->tp", across, taken)
        return (one.times(other) - one.times(known) @ taken) / self.scale[c] ** 2, squares / self.scale[c] ** 2

    def log_likelihood(self, rss: Values, within: Values | None = None) -> Values:
        """Return the log likelihood under each noise setting, (t, ...), of whitened sums of squares.

        ``within``: scatter within rows, of the shape of the last axes of ``rss``; by default that of the readings.
        """
        total = np.maximum(rss + (self.within if within is None else within), 1e-300)
        penalty = self._penalty.reshape(-1, *[1] * (rss.ndim - 1))
        found: Values = -0.5 * self.samples * np.log(total / self.samples) - penalty
        return found

    def gains(self, drops: Values, parameters: int | Index) -> Values:
        """Return delta BIC of forms on all three axes from their drops, (t, 3, m), and numbers of parameters: (m,)."""
        rss = self.left.sum(axis=1)[:, None] - drops.sum(axis=1)
        best = self.log_likelihood(rss).max(axis=0)
        found: Values = 2.0 * (best - self.before) - parameters * float(np.log(self.samples))
        return found

    def best_axes(self, drops: Values, columns: int | Index, scanned: int | Index = 0) -> list[FormGain]:
        """Return the gain of each form on the axes that it improves.

        ``drops``: (t, 3, m). ``columns``: number of columns on each axis. ``scanned``: number of scanned constants.
        """
        order = np.argsort(-drops.max(axis=0), axis=0)
        together = np.cumsum(np.take_along_axis(drops, order[None], axis=1), axis=1)
        likelihoods = self.log_likelihood(self.left.sum(axis=1)[:, None, None] - together)
        gained = np.maximum(2.0 * (likelihoods.max(axis=0) - self.before), 0.0)
        k = columns * np.arange(1, 4)[:, None] + scanned
        delta, p = gained - k * float(np.log(self.samples)), scipy.special.chdtrc(k, gained)
        best = delta.argmax(axis=0)[None]
        delta, p, at = (np.take_along_axis(v, best, 0)[0].tolist() for v in (delta, p, likelihoods.argmax(axis=0)))
        axes = [SETS_OF_AXES[each] for each in np.take_along_axis(np.cumsum(2**order, axis=0), best, 0)[0].tolist()]
        return [*map(FormGain, delta, p, axes, at)]

    def drops(self, columns: Values) -> Values:
        """Return the drops of m forms of r columns under each noise on each axis: (t, 3, m).

        ``columns``: (n, 3, m, r), or (n, 1, m, r) if they are equal on all axes.
        """
        versions = [self.whitened(each.reshape(len(each), -1)) for each in np.moveaxis(columns, 1, 0)]
        grams = [version.grams(columns.shape[3]) for version in versions]
        return self.drops_of(grams, [version.times(self.every) for version in versions])

    def drops_of(self, grams: Sequence[Values], across: Sequence[Values]) -> Values:
        """Return ``drops`` from products of columns; see ``left_of``."""
        inner, cross, error = self.left_of(grams, across)
        explained, new = each_explains(inner, cross[..., None], error)
        new &= new[0]
        return np.asarray(np.where(new.all(axis=3), explained[..., 0].sum(axis=3), 0.0)[1:])

    def left_of(self, grams: Sequence[Values], across: Sequence[Values]) -> tuple[Values, Values, Values]:
        """Return products of m forms of r columns without their part in the model, white noise first.

        ``grams``: (t, m, r, r), products of the columns of each form, for each axis, or once for all. ``across``: (t,
        m r, k), those with model and readings. Returns (t, 3, m, r, r) products of a form's columns, (t, 3, m, r) with
        the residual, and (t, 3, m, r) the error e of each column. e exceeds the remaining norm of a column that is less
        than ``MIN_NEW_COLUMN_SHARE`` under white noise, or rounding alone under another noise.
        """

        def split(values: Values) -> Values:
            return values.reshape(*values.shape[:-2], *grams[0].shape[1:3], values.shape[-1])

        sizes, found = np.sqrt(np.einsum("pp->p", self._among[0])), []
        for c, (known, target, inverse) in enumerate(self._fitted):
            gram, with_all = grams[c % len(grams)], across[c % len(grams)]
            taken, own = with_all[:, :, known] @ inverse, np.einsum("tmrr->tmr", gram)
            inner = gram - split(taken) @ split(with_all[:, :, known]).swapaxes(-1, -2)
            cross = with_all[:, :, target] - (taken @ self._among[:, known, target, None])[:, :, 0]
            hidden = self._unit * (np.sqrt(own[0]) + (np.abs(taken) @ sizes[known]).reshape(own.shape))
            error = np.maximum(hidden, np.sqrt(MIN_LEFT_SQUARE_SHARE * own))
            error[0] = np.maximum(error[0], MIN_NEW_COLUMN_SHARE * np.sqrt(own[0]))
            scale = self.scale[c]
            found.append((inner / scale**2, cross.reshape(own.shape) / scale**2, error / scale))
        inner, cross, error = (np.stack(each, axis=1) for each in zip(*found, strict=True))
        return inner, cross, error


@dataclass
class WhiteAxis:
    """What orthonormal columns of a model, (n, k), leave of the readings of an axis, (n,), under white noise."""

    residual: Values
    model: Values

    def _without_model(self, columns: Values) -> Values:
        """Return orthonormal columns that span (..., n, r) columns without their part in the model."""
        return np.asarray(np.linalg.qr(columns - self.model @ (self.model.T @ columns))[0])

    def add(self, columns: Values) -> float:
        """Add columns to the model, and return what they explain."""
        new = self._without_model(columns)
        parts = new.T @ self.residual
        self.model, self.residual = np.hstack([self.model, new]), self.residual - new @ parts
        return float(parts @ parts)

    def explained(self, F: Values, G: Values) -> Values:
        """Return what each product of one of q and one of p columns explains: (q, p) array."""
        own, taken = (F**2).T @ G**2, F.T @ (G[:, :, None] * self.model[:, None]).reshape(len(F), -1)
        rest = own - np.sum(taken.reshape(*own.shape, -1) ** 2, axis=2)
        new = rest > MIN_NEW_COLUMN_SHARE**2 * own
        return np.where(new, (F.T @ (G * self.residual[:, None])) ** 2 / np.where(new, rest, 1.0), 0.0)

    def explained_together(self, sets: Values) -> Values:
        """Return what each of m sets of r columns explains, (m, n, r): (m,) array."""
        return np.asarray(np.sum((self.residual @ self._without_model(sets)) ** 2, axis=1))


class ProjectedCurves:
    """Products of q curves and the residual of a scan, after model and explained curves are projected out of them.

    ``values``: as of ``Scan.values``. The products are without white noise alone.
    """

    def __init__(self, scan: Scan, values: Values) -> None:
        self.columns = [scan.whitened(values[:, k]) for k in range(values.shape[1])]
        grams = [each.times(each)[:, None] for each in self.columns]
        found = scan.left_of(grams, [each.times(scan.every) for each in self.columns])
        inner, cross, error = (each[:, :, 0] for each in found)
        self.inner, self.cross, self.error = inner[1:], cross[1:], error[1:]
        first = self.columns[0]
        self.size = np.sqrt(np.sum(first.means[0] ** 2, axis=1) + np.sum(first.inside**2, axis=0))
        self.white: Values = np.mean(inner[0] * scan.scale[:, None, None] ** 2, axis=0)

    def independent(self, index: Iterable[int]) -> list[int]:
        """Return the curves of ``index`` that are independent of base, effects and the curves before them."""
        tried, new = np.array([*index]), []
        rest, least = self.white[tried[:, None], tried], (MIN_NEW_COLUMN_SHARE * self.size[tried]) ** 2
        for k, j in enumerate(tried.tolist()):
            if rest[k, k] > least[k]:
                new.append(j)
                rest -= rest[:, k, None] * rest[k] / rest[k, k]
        return new

    def drop(self, index: ArrayLike) -> Values:
        """Return the drops of the first curve, the first two curves and so on: (t, 3, ..., r) array.

        ``index``: (..., r), of several sets of curves.
        """
        return np.asarray(np.cumsum(self._each(np.asarray(index))[0], axis=-1))

    def _each(self, index: Index) -> tuple[Values, Mask]:
        """Return the drop by each curve after those before it, and whether it is independent of them: (t, 3, .., r)."""
        inner, cross = self.inner[:, :, index[..., :, None], index[..., None, :]], self.cross[:, :, index]
        explained, independent = each_explains(inner, cross[..., None], self.error[:, :, index])
        return explained[..., 0], independent

    def coefficients(self, index: Sequence[int], setting: int) -> Values:
        """Return the coefficients of some curves under one noise: (3, r) array, unit of the sensor.

        The coefficient of a curve that depends on those before it is 0.
        """
        inner, cross = self.inner[setting][:, index][:, :, index], self.cross[setting][:, index]
        independent = self._each(np.asarray(index))[1][setting]
        both = np.einsum("cr,cs->crs", independent, independent)
        known = np.where(both, inner, np.eye(len(index)))
        found: Values = np.linalg.solve(known, (cross * independent)[..., None])[..., 0]
        return found


def each_explains(inner: Values, cross: Values, error: Values) -> tuple[Values, Mask]:
    """Return the drop by each of r curves after those before it, (..., r, s), and whether it is independent of them.

    ``inner``: (..., r, r), products of the curves. ``cross``: (..., r, s), their products with s residuals. ``error``:
    (..., r), the rounding error e of each curve.
    """
    explained, independent = np.zeros_like(cross), np.zeros(error.shape, bool)
    for j in range(inner.shape[-1]):  # what is left holds the curves from j on
        pivot = inner[..., 0, 0]
        independent[..., j] = new = pivot > error[..., 0] ** 2
        over = np.where(new, 1.0 / np.where(new, pivot, 1.0), 0.0)
        explained[..., j, :] = cross[..., 0, :] ** 2 * over[..., None]
        taken = inner[..., 1:, 0] * over[..., None]
        cross = cross[..., 1:, :] - taken[..., None] * cross[..., 0, None, :]
        inner = inner[..., 1:, 1:] - taken[..., None] * inner[..., 0, None, 1:]
        error = error[..., 1:] + np.abs(taken) * error[..., 0, None]
    return explained, independent
