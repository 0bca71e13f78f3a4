"""What further columns explain of the residual that base, configured and selected effects leave.

    y_c = X_c beta_c + Z gamma_c + noise,    drop(W, c) = b^T (W^T G W)^-1 b,    b = W^T Z^T M C^-1 y_c
    G = Z^T M C^-1 Z,    M = 1 - C^-1 X_c (X_c^T C^-1 X_c)^-1 X_c^T

where

    X_c  : (n, 4 + p) columns of the model on axis c: 1, what K acts on, and every parameter of every effect
    Z    : (n, q) further columns, such as curves in a covariate
    C    : white noise plus bias wander, ``pipeline.estimation.gauss_markov``
    W    : (q, r) weights: which combinations of the columns make up a functional form
    drop : by how much they lower the whitened sum of squares

so that any number of forms is judged from products formed once. The coefficients of effects that the axes share are
left free on each axis: that decouples the axes, and never lets a form explain more than it does.

Products of columns are differences of larger numbers. Their rounding errors are at most ``u sqrt(n) |a| |a'|`` (Higham
and Mary 2019, doi:10.1137/18M1226312, n rows, |a| the norm of a column under white noise), so a column z from which
others are taken with coefficients x leaves a sum of squares that is known to

    e^2 = u sqrt(n) (|z| + sum |x_k| |a_k|)^2

A column that leaves less than this cannot be distinguished from the others: it explains nothing.
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
    Curves = Callable[[Motion], Values]

NEW = 1e-3  # share of a column's norm that base and effects leave, below which it is theirs (EXCITED of the ranking)
ROUNDING = float(np.finfo(np.float64).eps) / 2.0  # u


@dataclass(frozen=True)
class FittedModel:
    """The columns and the residual of a selection's fit, at all rows."""

    base: Values  # (n, 4): 1, and what K acts on: the truth and the effects that the axes share
    effects: Values  # (n, 3, p): derivatives by every parameter of every effect, on each axis
    residual: Values  # (n, 3), unit of the sensor
    motions: list[Motion]  # of each part, after all effects of timing

    @classmethod
    def of(cls, selection: Selection) -> FittedModel:
        """Return the model at the values of a selection's fit."""
        terms = [Term(t.effect, t.values, full=True) for t in selection.fit.terms]
        pieces = [_of_part(selection, part, terms) for part in selection.observations.parts]
        base, effects, residual = (np.concatenate([piece[k] for piece in pieces]) for k in range(3))
        return cls(base, effects, residual, [piece[3] for piece in pieces])

    def columns(self, c: int) -> Values:
        """Return the columns of one axis: (n, 4 + p) array."""
        return np.concatenate([self.base, self.effects[:, c]], axis=1)


def _of_part(selection: Selection, part: Part, terms: Sequence[Term]) -> tuple[Values, Values, Values, Motion]:
    """Return base, effects and residual of one recording, and its motion after all effects of timing."""
    sensor, fit = selection.observations.sensor, selection.fit
    *motions, moved = motions_of(part, terms)
    u = truth(sensor, moved)
    residual = part.reading - fit.bias - u @ fit.K.T
    columns = [np.zeros((len(u), 3, 0))]
    for term, motion in zip(terms, motions, strict=True):
        columns.append(term.regressors(sensor, motion, fit.K, moved))
        if term.effect.moves:
            continue
        added = term.effect.reading(sensor, motion, fit.K, term.values)
        residual = residual - added
        if term.effect.layout == Layout.SHARED:
            u = u + np.linalg.solve(fit.K, added.T).T
    return np.column_stack([np.ones(len(u)), u]), np.concatenate(columns, axis=2), residual, moved


@dataclass(frozen=True)
class Gain:
    """What a functional form explains."""

    delta_bic: float
    p_value: float
    axes: tuple[int, ...]  # on which it acts
    setting: int  # index of its best noise setting


class ProjectedCurves:
    """Products of curves and residual after base and effects are projected out of them.

    Parameters
    ----------
    selection : Selection
        Its fit holds base and effects.
    curves : callable
        Motion to (n, q) curves that act on every axis, or to (n, 3, q) where each axis has its own.
    explained : callable, optional
        Motion to further curves, of the same shapes, that are projected out too.
    """

    def __init__(self, selection: Selection, curves: Curves, explained: Curves | None = None) -> None:
        observations, model = selection.observations, FittedModel.of(selection)
        self.scale = selection.start.scale
        self.samples = 3.0 * observations.samples
        self.within = float(np.sum(observations.scatter / self.scale**2))
        groups = [model.base, model.effects, *(_at_rows(f, model) for f in (explained, curves) if f is not None)]
        A = np.concatenate([*(g.reshape(len(g), -1) for g in groups), model.residual], axis=1)
        starts = np.cumsum([0, *(g[0].size for g in groups)])
        of_axis = [
            [
                start + (c * g.shape[2] if g.ndim == 3 else 0) + np.arange(g.shape[-1])
                for g, start in zip(groups, starts, strict=False)
            ]
            for c in range(3)
        ]
        known, own = [np.concatenate(places[:-1]) for places in of_axis], [places[-1] for places in of_axis]
        self.size = np.sqrt(np.einsum("i,ij,ij->j", observations.weight, A, A))[own[0]]
        settings = list(selection.settings)
        stacked, logarithms = Products(observations.blocks, observations.weight, A).products([WHITE, *settings])
        self.penalty = 1.5 * logarithms[1:] - np.array([setting.prior for setting in settings])
        self._project(stacked, known, own)

    def _project(self, products: Values, known: Sequence[NDArray[np.intp]], own: Sequence[NDArray[np.intp]]) -> None:
        """Project base and effects out of curves and residual: products inner, cross and left, by noise and axis."""
        q = len(own[0])
        white = np.sqrt(np.maximum(np.einsum("ii->i", products[0]), 0.0))
        unit = (ROUNDING * np.sqrt(self.samples / 3.0)) ** 0.5
        inner, cross, left, error = [], [], [], []
        for c in range(3):
            k = len(known[c])
            index = np.concatenate([known[c], own[c], [products.shape[1] - 3 + c]])
            among = products[:, index[:, None], index]
            taken = projection(among, np.arange(k))[:, :, k:]
            rest = among[:, k:, k:] - among[:, :k, k:].transpose(0, 2, 1) @ taken
            inner.append(rest[:, :q, :q])
            cross.append(rest[:, :q, q])
            left.append(rest[:, q, q])
            error.append(unit * (white[own[c]] + white[known[c]] @ np.abs(taken[:, :, :q])))
        over = self.scale[None, :] ** -2
        self.white: Values = np.mean([axis[0] for axis in inner], axis=0)
        self.inner: Values = np.stack(inner, axis=1)[1:] * over[:, :, None, None]
        self.cross: Values = np.stack(cross, axis=1)[1:] * over[:, :, None]
        self.left: Values = np.stack(left, axis=1)[1:] * over
        self.error: Values = np.stack(error, axis=1)[1:] / self.scale[:, None]
        self.before = float(self._log_likelihood(self.left.sum(axis=1)).max())

    def _log_likelihood(self, rss: Values) -> Values:
        """Return the log likelihood under each noise setting, (t, ...), of whitened sums of squares."""
        total = np.maximum(rss + self.within, 1e-300)
        penalty = self.penalty.reshape(-1, *[1] * (rss.ndim - 1))
        found: Values = -0.5 * self.samples * np.log(total / self.samples) - penalty
        return found

    def independent(self, index: Iterable[int]) -> list[int]:
        """Return the curves of ``index`` that are independent of base, effects and the curves before them."""
        rest, kept = self.white.copy(), []
        for j in index:
            if rest[j, j] > (NEW * self.size[j]) ** 2:
                kept.append(int(j))
                rest -= np.outer(rest[:, j], rest[j]) / rest[j, j]
        return kept

    def drops(self, weights: Values) -> Values:
        """Return what single columns explain under each noise, on each axis: (t, 3, m) array.

        Parameters
        ----------
        weights : (q, m) array
            Each column one form.
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
        """Return what each curve explains beside those before it, and whether it is independent of them: (t, 3, r)."""
        inner, cross = self.inner[:, :, index][:, :, :, index], self.cross[:, :, index].copy()
        error = self.error[:, :, index].copy()
        explained, independent = np.zeros_like(cross), np.zeros(cross.shape, bool)
        for j in range(len(index)):
            pivot = inner[:, :, j, j]
            independent[:, :, j] = pivot > error[:, :, j] ** 2
            over = np.where(independent[:, :, j], 1.0 / np.where(independent[:, :, j], pivot, 1.0), 0.0)
            explained[:, :, j] = cross[:, :, j] ** 2 * over
            taken = inner[:, :, j] * over[:, :, None]
            cross -= taken * cross[:, :, j : j + 1]
            inner = inner - taken[:, :, :, None] * inner[:, :, j, None, :]
            error += np.abs(taken) * error[:, :, j : j + 1]
        return explained, independent

    def gains(self, drops: Values, parameters: int | NDArray[np.intp]) -> Values:
        """Return delta BIC of forms on all three axes: (m,) array.

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

    def gain(self, drop: Values, columns: int, scanned: int = 0) -> Gain:
        """Return what one form explains, on the axes that it improves.

        Parameters
        ----------
        drop : (t, 3) array
        columns : int
            Coefficients on each axis.
        scanned : int
            Nonlinear parameters, such as the place of a step.
        """
        from scipy.special import chdtrc  # noqa: PLC0415  (0.1 s that only a diagnosis pays)

        order = np.argsort(-drop.max(axis=0))
        found = []
        for axes in (order[:1], order[:2], order):
            likelihoods = self._log_likelihood(self.left.sum(axis=1) - drop[:, axes].sum(axis=1))
            at = int(np.argmax(likelihoods))
            gained = max(2.0 * (float(likelihoods[at]) - self.before), 0.0)
            k = columns * len(axes) + scanned
            delta = gained - k * float(np.log(self.samples))
            found.append(Gain(delta, float(chdtrc(k, gained)), tuple(sorted(int(a) for a in axes)), at))
        return max(found, key=lambda gain: gain.delta_bic)

    def coefficients(self, index: Sequence[int], setting: int) -> Values:
        """Return the estimates of some curves under one noise: (3, r) array, unit of the sensor.

        Those of a curve that is not independent of the others are 0.
        """
        inner, cross = self.inner[setting][:, index][:, :, index], self.cross[setting][:, index]
        independent = self._each(index)[1][setting]
        both = np.einsum("cr,cs->crs", independent, independent)
        known = np.where(both, inner, np.eye(len(index)))
        found: Values = np.linalg.solve(known, (cross * independent)[..., None])[..., 0]
        return found


def _at_rows(curves: Curves, model: FittedModel) -> Values:
    """Return curves at all rows."""
    return np.concatenate([curves(motion) for motion in model.motions])
