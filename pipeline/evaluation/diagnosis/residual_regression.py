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

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np
import scipy

from pipeline.estimation.design import true_motion
from pipeline.estimation.gauss_markov import WHITE_SETTING, GaussMarkov
from pipeline.estimation.ranking import MIN_LEFT_SQUARE_SHARE, MIN_NEW_COLUMN_SHARE, UNIT_COLUMN_RIDGE

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from pipeline.core.records import Index, Mask, Motion, Values
    from pipeline.estimation.selection import Selection

Curves: TypeAlias = "Callable[[Motion], Values]"  # to (n, 1, q), or (n, 3, q) if they differ between the axes

UNIT_ROUNDOFF = float(np.finfo(np.float64).eps) / 2.0  # u


@dataclass(frozen=True)
class FormGain:
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


class Scan:
    """The residual of a selection's fit under every noise setting, and its reduction by further columns.

    ``explained``: curves that are projected out too.
    """

    def __init__(self, selection: Selection, explained: Curves | None = None) -> None:
        self.scale = selection.start.scale
        observations = selection.observations.less_stop_errors
        self.samples = 3.0 * observations.samples
        self.within = float(np.sum(observations.scatter / self.scale**2))
        self._motions = [true_motion(part, selection.fit.terms) for part in selection.observations.parts]
        self._blocks, self._weight = observations.blocks, observations.weight
        self._label = self._blocks.label(len(self._weight))
        self._noise = GaussMarkov(self._blocks, [WHITE_SETTING, *selection.settings])
        self._unit = float(UNIT_ROUNDOFF * np.sqrt(observations.samples)) ** 0.5
        design = selection.fit.design(observations)
        A, places = design.columns.columns, [design.places(c)[0] for c in range(3)]
        if explained is not None:
            values, first = self.values(explained), A.shape[1]
            n, versions, q = values.shape
            A = np.concatenate([A, values.reshape(n, -1)], axis=1)
            places = [np.append(first + c % versions * q + np.arange(q), place) for c, place in enumerate(places)]
        self._every = self.whitened(A)  # model, explained curves and readings of all axes
        self._among = self._every.times(self._every)
        self._fitted: list[tuple[Index, int, Values]] = []  # of each axis: model, residual, inverse of its products
        left = []
        for c, (*known, target) in enumerate(places):
            products = self._among[:, np.array(known)[:, None], known]
            size = np.sqrt(np.einsum("tpp->tp", products))
            size = np.where(size > 0.0, size, 1.0)
            over = size[:, :, None] * size[:, None, :]
            inverse = np.linalg.inv(products / over + UNIT_COLUMN_RIDGE * np.eye(len(known))) / over
            self._fitted.append((np.array(known), target, inverse))
            cross = self._among[:, known, target]
            taken = np.einsum("tp,tpq,tq->t", cross, inverse, cross)
            left.append((self._among[:, target, target] - taken)[1:] / self.scale[c] ** 2)
        logarithms = self._noise.log_determinant[1:] + np.sum(np.log(self._blocks.weight))
        self._penalty: Values = 1.5 * logarithms - np.array([setting.prior for setting in selection.settings])
        self.left: Values = np.stack(left, axis=1)
        self.before = float(self.log_likelihood(self.left.sum(axis=1)).max())

    def values(self, curves: Curves) -> Values:
        """Return the values of curves in all rows: (n, 3, q) array, or (n, 1, q) if they are equal on all axes."""
        return np.concatenate([curves(motion) for motion in self._motions])

    def whitened(self, columns: Values) -> Whitened:
        """Return (n, q) columns whitened."""
        means = self._blocks.sums(self._weight[:, None] * columns) / self._blocks.weight[:, None]
        inside = np.sqrt(self._weight)[:, None] * (columns - means[self._label])
        return Whitened(inside, self._noise.whitened(means))

    def without_model(self, c: int, one: Whitened, other: Whitened) -> Values:
        """Return the products of columns on an axis without their part in the model, white noise first: (t, q, p)."""
        known, _, inverse = self._fitted[c]
        taken = one.times(self._every)[:, :, known] @ inverse @ self._every.times(other)[:, known]
        return np.asarray((one.times(other) - taken) / self.scale[c] ** 2)

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
        best, at = delta.argmax(axis=0), likelihoods.argmax(axis=0)
        return [
            FormGain(float(delta[a, m]), float(p[a, m]), tuple(sorted(order[: a + 1, m].tolist())), int(at[a, m]))
            for m, a in enumerate(best.tolist())
        ]

    def drops(self, columns: Values) -> Values:
        """Return the drops of forms under each noise on each axis: (t, 3, m) array.

        ``columns``: (n, 3, m, r) of m forms with r coefficients, or (n, 1, m, r) if they are equal on all axes.
        """
        n, axes, _, r = columns.shape
        inner, cross, error = self.products([self.whitened(columns[:, k].reshape(n, -1)) for k in range(axes)], r)
        explained, new = each_explains(inner, cross[..., None], error)
        new &= new[0]
        return np.asarray(np.where(new.all(axis=3), explained[..., 0].sum(axis=3), 0.0)[1:])

    def products(self, versions: Sequence[Whitened], r: int) -> tuple[Values, Values, Values]:
        """Return the products of m forms of r columns without their part in the model, white noise first.

        (t, 3, m, r, r) products of a form's columns, (t, 3, m, r) with the residual, and (t, 3, m, r) the error e of
        each column. e exceeds the remaining norm of a column that is less than ``MIN_NEW_COLUMN_SHARE``
        under white noise, or rounding alone under another noise. ``versions``: the columns of each axis, or one for
        all.
        """

        def split(values: Values) -> Values:
            return values.reshape(*values.shape[:-2], -1, r, values.shape[-1])

        grams, acrosses = [], [version.times(self._every) for version in versions]
        for version in versions:
            means, inside = split(version.means), split(version.inside.T)
            grams.append(means @ means.swapaxes(-1, -2) + inside @ inside.swapaxes(-1, -2))
        sizes, found = np.sqrt(np.einsum("pp->p", self._among[0])), []
        for c, (known, target, inverse) in enumerate(self._fitted):
            gram, across = grams[c % len(versions)], acrosses[c % len(versions)]
            taken, own = across[:, :, known] @ inverse, np.einsum("tmrr->tmr", gram)
            inner = gram - split(taken) @ split(across[:, :, known]).swapaxes(-1, -2)
            cross = across[:, :, target] - (taken @ self._among[:, known, target, None])[:, :, 0]
            hidden = self._unit * (np.sqrt(own[0]) + (np.abs(taken) @ sizes[known]).reshape(own.shape))
            error = np.maximum(hidden, np.sqrt(MIN_LEFT_SQUARE_SHARE * own))
            error[0] = np.maximum(error[0], MIN_NEW_COLUMN_SHARE * np.sqrt(own[0]))
            scale = self.scale[c]
            found.append((inner / scale**2, cross.reshape(own.shape) / scale**2, error / scale))
        inner, cross, error = (np.stack(each, axis=1) for each in zip(*found, strict=True))
        return inner, cross, error


class ProjectedCurves:
    """Products of q curves and the residual of a scan, after model and explained curves are projected out of them.

    The products are without white noise alone.
    """

    def __init__(self, scan: Scan, curves: Curves) -> None:
        values = scan.values(curves)
        self.columns = [scan.whitened(values[:, k]) for k in range(values.shape[1])]
        inner, cross, error = (each[:, :, 0] for each in scan.products(self.columns, values.shape[2]))
        self.inner, self.cross, self.error = inner[1:], cross[1:], error[1:]
        first = self.columns[0]
        self.size = np.sqrt(np.sum(first.means[0] ** 2, axis=1) + np.sum(first.inside**2, axis=0))
        self.white: Values = np.mean(inner[0] * scan.scale[:, None, None] ** 2, axis=0)

    def independent(self, index: Iterable[int]) -> list[int]:
        """Return the curves of ``index`` that are independent of base, effects and the curves before them."""
        rest, new = self.white.copy(), []
        for j in index:
            if rest[j, j] > (MIN_NEW_COLUMN_SHARE * self.size[j]) ** 2:
                new.append(int(j))
                rest -= np.outer(rest[:, j], rest[j]) / rest[j, j]
        return new

    def drop(self, index: Sequence[int]) -> Values:
        """Return the drops of the first curve, the first two curves and so on: (t, 3, r) array."""
        return np.asarray(np.cumsum(self._each(index)[0], axis=2))

    def _each(self, index: Sequence[int]) -> tuple[Values, Mask]:
        """Return the drop by each curve after those before it, and whether it is independent of them: (t, 3, r)."""
        inner, cross = self.inner[:, :, index][:, :, :, index], self.cross[:, :, index]
        explained, independent = each_explains(inner, cross[..., None], self.error[:, :, index])
        return explained[..., 0], independent

    def coefficients(self, index: Sequence[int], setting: int) -> Values:
        """Return the coefficients of some curves under one noise: (3, r) array, unit of the sensor.

        The coefficient of a curve that depends on those before it is 0.
        """
        inner, cross = self.inner[setting][:, index][:, :, index], self.cross[setting][:, index]
        independent = self._each(index)[1][setting]
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
    for j in range(inner.shape[-1]):
        pivot = inner[..., j, j]
        independent[..., j] = new = pivot > error[..., j] ** 2
        over = np.where(new, 1.0 / np.where(new, pivot, 1.0), 0.0)
        explained[..., j, :] = cross[..., j, :] ** 2 * over[..., None]
        taken = inner[..., j] * over[..., None]
        cross = cross - taken[..., None] * cross[..., j, None, :]
        inner = inner - taken[..., None] * inner[..., j, None, :]
        error = error + np.abs(taken) * error[..., j, None]
    return explained, independent
