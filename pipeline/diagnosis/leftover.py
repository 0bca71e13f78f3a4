"""What curves explain of the residual that base and chosen effects leave, under every noise setting.

Of each axis c, with base and chosen effects in the columns B_c and the curves in Z,

    y_c = B_c beta_c + Z gamma_c + noise,    drop(W, c) = b^T (W^T G W)^-1 b,    b = W^T Z^T M C^-1 y_c
    G = Z^T M C^-1 Z,    M = 1 - C^-1 B_c (B_c^T C^-1 B_c)^-1 B_c^T

where

    C    : white noise plus a bias wander, ``pipeline.estimation.gauss_markov``
    W    : (q, r) weights: which combinations of the curves make up a shape
    drop : by how much they lower the whitened sum of squares

so that any number of shapes is judged from products formed once.

Products of columns are differences of larger numbers: what white noise alone would leave, less what a wander takes.
Their rounding errors are at most ``u sqrt(n) |a| |a'|`` (Higham and Mary 2019, doi:10.1137/18M1226312, n rows, |a| the
norm of a column under white noise), so a curve z from which others are taken with coefficients x leaves a sum of
squares that is known to

    e^2 = u sqrt(n) (|z| + sum |x_k| |a_k|)^2

A curve that leaves less than this cannot be told from the others: it explains nothing. The coefficients of effects that
the axes share are left free in each axis: it decouples the axes and takes a little more from the curves than it must,
never less.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.estimation.design import Term, motions_of
from pipeline.estimation.gauss_markov import WHITE, Products
from pipeline.estimation.ranking import projection
from pipeline.model.effects.base import Layout, truth

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from numpy.typing import NDArray

    from pipeline.estimation.observations import Part
    from pipeline.estimation.selection import Selection
    from pipeline.records import Motion

    Values = NDArray[np.float64]

NEW = 1e-3  # share of a curve's norm that base and effects leave, below which it says nothing new
ROUNDING = float(np.finfo(np.float64).eps) / 2.0  # u


@dataclass(frozen=True)
class Gain:
    """What a shape brings.

    Attributes
    ----------
    delta_bic, p_value : float
    axes : tuple of int
        On which it acts.
    parameters : int
    setting : int
        Index of its best noise setting.
    """

    delta_bic: float
    p_value: float
    axes: tuple[int, ...]
    parameters: int
    setting: int


class Leftover:
    """Products of curves with what base and chosen effects leave.

    Parameters
    ----------
    selection : Selection
        Its fit holds base and effects.
    curves : callable
        Motion to (n, q) curves that act on every axis, or to (n, 3, q) where each axis has its own.
    beside : callable, optional
        Motion to further curves, of the same shapes, that belong to what is explained.
    """

    def __init__(
        self,
        selection: Selection,
        curves: Callable[[Motion], Values],
        beside: Callable[[Motion], Values] | None = None,
    ) -> None:
        observations = selection.observations
        self.scale = selection.start.scale
        self.samples = 3.0 * observations.samples
        self.within = float(np.sum(observations.scatter / self.scale**2))
        A, known, own = _columns(selection, curves, beside)
        weight = observations.weight
        self.size = np.sqrt(np.einsum("i,ij,ij->j", weight, A, A))[own[0]]
        self.settings = list(selection.settings)
        stacked, logarithms = Products(observations.blocks, weight, A).products([WHITE, *self.settings])
        priors = np.array([setting.prior for setting in self.settings])
        self.penalty = 1.5 * logarithms[1:] - priors
        self._reduce(stacked, known, own)

    def _reduce(self, products: Values, known: Sequence[NDArray[np.intp]], own: Sequence[NDArray[np.intp]]) -> None:
        """Take what is known out of curves and readings: their products inner, cross and left, by noise and axis."""
        q = len(own[0])
        readings = products.shape[1] - 3 + np.arange(3)
        alike = all(np.array_equal(a, b) for a, b in ((known[0], known[2]), (own[0], own[2])))
        white = np.sqrt(np.maximum(np.einsum("ii->i", products[0]), 0.0))
        unit = (ROUNDING * np.sqrt(self.samples / 3.0)) ** 0.5
        inner, cross, left, error = [], [], [], []
        for c in range(3):
            if c == 0 or not alike:
                index = np.concatenate([known[c], own[c], readings if alike else readings[c : c + 1]])
                among, k = products[:, index[:, None], index], len(known[c])
                taken = projection(among, np.arange(k))[:, :, k:]
                rest = among[:, k:, k:] - among[:, :k, k:].transpose(0, 2, 1) @ taken
                size = white[own[c]] + white[known[c]] @ np.abs(taken[:, :, :q])
            at = q + (c if alike else 0)
            inner.append(rest[:, :q, :q])
            cross.append(rest[:, :q, at])
            left.append(rest[:, at, at])
            error.append(unit * size)
        over = self.scale[None, :] ** -2
        self.white: Values = np.mean([axis[0] for axis in inner], axis=0)
        self.inner: Values = np.stack(inner, axis=1)[1:] * over[:, :, None, None]
        self.cross: Values = np.stack(cross, axis=1)[1:] * over[:, :, None]
        self.left: Values = np.stack(left, axis=1)[1:] * over
        self.error: Values = np.stack(error, axis=1)[1:] / self.scale[:, None]
        self.before = float(self._log_likelihood(self.left.sum(axis=1)).max())

    def _log_likelihood(self, rss: Values) -> Values:
        total = np.maximum(rss + self.within, 1e-300)
        penalty = self.penalty.reshape(-1, *[1] * (rss.ndim - 1))
        found: Values = -0.5 * self.samples * np.log(total / self.samples) - penalty
        return found

    def independent(self, index: Iterable[int]) -> list[int]:
        """Return the curves of ``index`` that say something new beside what is known and those before them."""
        rest, kept = self.white.copy(), []
        for j in index:
            if rest[j, j] > (NEW * self.size[j]) ** 2:
                kept.append(int(j))
                rest -= np.outer(rest[:, j], rest[j]) / rest[j, j]
        return kept

    def drops(self, weights: Values) -> Values:
        """Return what single columns explain under each noise, in each axis: (t, 3, m) array.

        Parameters
        ----------
        weights : (q, m) array
            Each column one shape.
        """
        inner = np.einsum("qm,tcqm->tcm", weights, self.inner @ weights)
        cross = self.cross @ weights
        left = np.einsum("qm,qm->m", weights, self.white @ weights)
        new = left > NEW**2 * np.sum((self.size[:, None] * weights) ** 2, axis=0)
        new = new & (inner > (self.error @ np.abs(weights)) ** 2)
        return np.where(new, cross**2 / np.where(new, inner, 1.0), 0.0)

    def drop(self, index: Sequence[int]) -> Values:
        """Return what several curves explain together, by the number of them from the first on: (t, 3, r) array."""
        each, _ = self._each(index)
        together: Values = np.cumsum(each, axis=2)
        return together

    def _each(self, index: Sequence[int]) -> tuple[Values, NDArray[np.bool_]]:
        """Return what each curve explains beside those before it, and whether it can be told from them: (t, 3, r)."""
        inner, cross = self.inner[:, :, index][:, :, :, index], self.cross[:, :, index].copy()
        error = self.error[:, :, index].copy()
        explained, told = np.zeros_like(cross), np.zeros(cross.shape, bool)
        for j in range(len(index)):
            pivot = inner[:, :, j, j]
            told[:, :, j] = pivot > error[:, :, j] ** 2
            over = np.where(told[:, :, j], 1.0 / np.where(told[:, :, j], pivot, 1.0), 0.0)
            explained[:, :, j] = cross[:, :, j] ** 2 * over
            taken = inner[:, :, j] * over[:, :, None]
            cross -= taken * cross[:, :, j : j + 1]
            inner = inner - taken[:, :, :, None] * inner[:, :, j, None, :]
            error += np.abs(taken) * error[:, :, j : j + 1]
        return explained, told

    def gains(self, drops: Values, parameters: int | NDArray[np.intp]) -> Values:
        """Return delta BIC of shapes on all three axes: (m,) array.

        Parameters
        ----------
        drops : (t, 3, m) array
        parameters : int or (m,) array
            k.
        """
        rss = self.left.sum(axis=1)[:, None] - drops.sum(axis=1)
        best = self._log_likelihood(rss).max(axis=0)
        found: Values = 2.0 * (best - self.before) - parameters * float(np.log(self.samples))
        return found

    def gain(self, drop: Values, columns: int, scanned: int = 0, *, choose: bool = True) -> Gain:
        """Return what one shape brings on the axes that need it.

        Parameters
        ----------
        drop : (t, 3) array
        columns : int
            Coefficients in each axis.
        scanned : int
            Nonlinear parameters, such as the place of a step.
        choose : bool
            Whether to leave out axes that it does not improve; else all three count.
        """
        from scipy.special import chdtrc  # noqa: PLC0415  (0.1 s that only a diagnosis pays)

        order = np.argsort(-drop.max(axis=0))
        best: Gain | None = None
        for count in range(1 if choose else 3, 4):
            axes = order[:count]
            found = self._log_likelihood(self.left.sum(axis=1) - drop[:, axes].sum(axis=1))
            at = int(np.argmax(found))
            gained = max(2.0 * (float(found[at]) - self.before), 0.0)
            k = columns * count + scanned
            delta = gained - k * float(np.log(self.samples))
            if best is None or delta > best.delta_bic:
                best = Gain(delta, float(chdtrc(k, gained)), tuple(sorted(int(a) for a in axes)), k, at)
        assert best is not None  # noqa: S101
        return best

    def coefficients(self, index: Sequence[int], setting: int) -> Values:
        """Return the estimates of some curves under one noise: (3, r) array, unit of the sensor.

        Those of a curve that cannot be told from the others are 0.
        """
        inner, cross = self.inner[setting][:, index][:, :, index], self.cross[setting][:, index]
        both = np.einsum("cr,cs->crs", told := self._each(index)[1][setting], told)
        found: Values = np.linalg.solve(np.where(both, inner, np.eye(len(index))), (cross * told)[..., None])[..., 0]
        return found


def _columns(
    selection: Selection, curves: Callable[[Motion], Values], beside: Callable[[Motion], Values] | None
) -> tuple[Values, list[NDArray[np.intp]], list[NDArray[np.intp]]]:
    """Return the columns [1, u, effects, curves, readings], and of each axis which are known and which are curves."""
    terms = [Term(t.effect, t.values, full=True) for t in selection.fit.terms]
    parts = selection.observations.parts
    A, row, a, e, q, shared = np.zeros((0, 0)), 0, 0, 0, 0, True
    for part in parts:
        groups = _of_part(selection, part, terms, curves, beside)
        if row == 0:
            common, effects, shapes, _ = groups
            a, e, q, shared = common.shape[1], effects.shape[2], shapes.shape[-1], shapes.ndim == 2
            A = np.empty((sum(len(p.weight) for p in parts), a + 3 * e + (q if shared else 3 * q) + 3))
        column = 0
        for group in groups:
            flat = group.reshape(len(group), -1)
            A[row : row + len(group), column : column + flat.shape[1]] = flat
            column += flat.shape[1]
        row += len(part.weight)
    known = [np.concatenate([np.arange(a), a + c * e + np.arange(e)]) for c in range(3)]
    own = [a + 3 * e + (0 if shared else c * q) + np.arange(q) for c in range(3)]
    return A, known, own


def _of_part(
    selection: Selection,
    part: Part,
    terms: Sequence[Term],
    curves: Callable[[Motion], Values],
    beside: Callable[[Motion], Values] | None,
) -> tuple[Values, Values, Values, Values]:
    *motions, everything = motions_of(part, terms)
    sensor = selection.observations.sensor
    common = [np.ones((len(part.weight), 1)), truth(sensor, everything)]
    effects = [np.zeros((len(part.weight), 3, 0))]
    for term, motion in zip(terms, motions, strict=True):
        regressors = term.regressors(sensor, motion, selection.fit.K, everything)
        if term.layout() == Layout.EVERY_AXIS:
            common.append(regressors)
        else:
            effects.append(regressors)
    if beside is not None:
        further = beside(everything)
        (common if further.ndim == 2 else effects).append(further)
    fit = selection.fit  # without bias and truth the readings keep their digits in the products
    rest = part.reading - fit.bias - common[1] @ fit.K.T
    return np.concatenate(common, axis=1), np.concatenate(effects, axis=2), curves(everything), rest
