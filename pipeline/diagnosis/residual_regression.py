"""What further columns explain of the residual that base, configured and selected effects leave.

    y_c = X_c beta_c + Z gamma_c + noise,    drop(W, c) = b^T (W^T G W)^-1 b,    b = W^T Z^T M C^-1 y_c
    G = Z^T M C^-1 Z,    M = 1 - C^-1 X_c (X_c^T C^-1 X_c)^-1 X_c^T

    X_c  : columns of the model on axis c: 1, what K acts on, and every parameter of every effect
    Z    : (n, q) further columns, such as curves in a covariate;  W : (q, r), combinations of them: a functional form
    C    : white noise plus bias wander, ``pipeline.estimation.gauss_markov``
    drop : by how much they lower the whitened sum of squares

The coefficients of effects that the axes share are left free on each axis: that decouples the axes, and never lets a
form explain more than it does. Rounding errors of products are at most ``u sqrt(n) |a| |a'|`` (Higham and Mary 2019,
doi:10.1137/18M1226312), so a column z from which others are taken with coefficients x leaves a sum of squares that is
known to ``e^2 = u sqrt(n) (|z| + sum |x_k| |a_k|)^2``; a column that leaves less explains nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from pipeline.estimation.design import true_motion
from pipeline.estimation.gauss_markov import WHITE, GaussMarkov, Products
from pipeline.estimation.generalized_least_squares import design_at
from pipeline.estimation.ranking import LEFT, RIDGE, projection, without

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from pipeline.estimation.selection import Selection
    from pipeline.records import Index, Mask, Motion, Values

Curves: TypeAlias = "Callable[[Motion], Values]"

NEW = 1e-3  # share of a column's norm that base and effects leave, below which it is theirs (EXCITED of the ranking)
ROUNDING = float(np.finfo(np.float64).eps) / 2.0  # u


@dataclass(frozen=True)
class Gain:
    """What a functional form explains."""

    delta_bic: float
    p_value: float
    axes: tuple[int, ...]  # on which it acts
    setting: int  # index of its best noise setting


class _Evidence:
    """The likelihood of a fit under every noise setting, by what further columns explain of its residual."""

    def __init__(self, selection: Selection) -> None:
        self.scale = selection.start.scale
        self.observations = selection.observations.weakened
        self.samples = 3.0 * self.observations.samples
        self.within = float(np.sum(self.observations.scatter / self.scale**2))
        self.settings = [WHITE, *selection.settings]
        self.left: Values = np.zeros((len(selection.settings), 3))
        self.penalty: Values = np.zeros(len(selection.settings))

    def _set(self, left: Values, logarithms: Values) -> None:
        """Set what base and effects leave, (t, 3), and log det C of one channel, white noise alone first."""
        self.left = left
        self.penalty = 1.5 * logarithms[1:] - np.array([setting.prior for setting in self.settings[1:]])
        self.before = float(self.log_likelihood(self.left.sum(axis=1)).max())

    def log_likelihood(self, rss: Values, within: Values | None = None) -> Values:
        """Return the log likelihood under each noise setting, (t, ...), of whitened sums of squares.

        ``within``: scatter within rows, of the shape of the last axes of ``rss``; without it that of the readings.
        """
        total = np.maximum(rss + (self.within if within is None else within), 1e-300)
        penalty = self.penalty.reshape(-1, *[1] * (rss.ndim - 1))
        found: Values = -0.5 * self.samples * np.log(total / self.samples) - penalty
        return found

    def gains(self, drops: Values, parameters: int | Index) -> Values:
        """Return delta BIC of forms on all three axes, from their (t, 3, m) drops and numbers of parameters: (m,)."""
        rss = self.left.sum(axis=1)[:, None] - drops.sum(axis=1)
        best = self.log_likelihood(rss).max(axis=0)
        found: Values = 2.0 * (best - self.before) - parameters * float(np.log(self.samples))
        return found

    def best_axes(self, drops: Values, columns: int, scanned: int | Index = 0) -> list[Gain]:
        """Return what each form explains, on the axes that it improves.

        Their (t, 3, m) ``drops`` are those of so many columns on each axis; ``scanned`` counts parameters such as a
        place.
        """
        from scipy.special import chdtrc  # noqa: PLC0415  (0.1 s that only a diagnosis pays)

        order = np.argsort(-drops.max(axis=0), axis=0)
        together = np.cumsum(np.take_along_axis(drops, order[None], axis=1), axis=1)
        likelihoods = self.log_likelihood(self.left.sum(axis=1)[:, None, None] - together)
        gained = np.maximum(2.0 * (likelihoods.max(axis=0) - self.before), 0.0)
        k = columns * np.arange(1, 4)[:, None] + scanned
        delta, p = gained - k * float(np.log(self.samples)), chdtrc(k, gained)
        best, at = delta.argmax(axis=0), likelihoods.argmax(axis=0)
        return [
            Gain(float(delta[a, m]), float(p[a, m]), tuple(sorted(order[: a + 1, m].tolist())), int(at[a, m]))
            for m, a in enumerate(best.tolist())
        ]

    def gain(self, drop: Values, columns: int, scanned: int = 0) -> Gain:
        """Return what one form explains, on the axes that it improves; ``drop`` as for ``best_axes``, (t, 3)."""
        return self.best_axes(drop[:, :, None], columns, scanned)[0]


class ProjectedCurves(_Evidence):
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
        super().__init__(selection)
        observations, (A, places) = self.observations, columns_of_fit(selection, explained, curves)
        self.size = np.sqrt(np.einsum("i,ij,ij->j", observations.weight, A, A))[places[0][-1]]
        stacked, logarithms = Products(observations.blocks, observations.weight, A).products(self.settings)
        self._project(stacked, places)
        self._set(self.left, logarithms)

    def _project(self, products: Values, places: Sequence[Sequence[Index]]) -> None:
        """Project base and effects out of curves and residual: products inner, cross and left, by noise and axis."""
        q = len(places[0][-1])
        white = np.sqrt(np.maximum(np.einsum("ii->i", products[0]), 0.0))
        unit = (ROUNDING * np.sqrt(self.samples / 3.0)) ** 0.5
        inner, cross, left, error = [], [], [], []
        for model, *explained, own in places:
            known = np.concatenate([model[:-1], *explained])
            k, index = len(known), np.concatenate([known, own, model[-1:]])
            among = products[:, index[:, None], index]
            taken = projection(among, np.arange(k))
            rest = without(among, np.arange(k), taken)[:, k:, k:]
            inner.append(rest[:, :q, :q])
            cross.append(rest[:, :q, q])
            left.append(rest[:, q, q])
            error.append(unit * (white[own] + white[known] @ np.abs(taken[:, :, k : k + q])))
        over = self.scale[None, :] ** -2
        self.white: Values = np.mean([axis[0] for axis in inner], axis=0)
        self.inner: Values = np.stack(inner, axis=1)[1:] * over[:, :, None, None]
        self.cross: Values = np.stack(cross, axis=1)[1:] * over[:, :, None]
        self.left: Values = np.stack(left, axis=1)[1:] * over
        self.error: Values = np.stack(error, axis=1)[1:] / self.scale[:, None]

    def independent(self, index: Iterable[int]) -> list[int]:
        """Return the curves of ``index`` that are independent of base, effects and the curves before them."""
        rest, kept = self.white.copy(), []
        for j in index:
            if rest[j, j] > (NEW * self.size[j]) ** 2:
                kept.append(int(j))
                rest -= np.outer(rest[:, j], rest[j]) / rest[j, j]
        return kept

    def drops(self, weights: Values) -> Values:
        """Return what forms, the columns of (q, m) weights, explain under each noise on each axis: (t, 3, m) array."""
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

    def _each(self, index: Sequence[int]) -> tuple[Values, Mask]:
        """Return what each curve adds to those before it, and whether it is independent of them: (t, 3, r)."""
        inner, cross = self.inner[:, :, index][:, :, :, index], self.cross[:, :, index]
        explained, independent = each_explains(inner, cross[..., None], self.error[:, :, index])
        return explained[..., 0], independent

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


class Scan(_Evidence):
    """What each of many forms explains by itself, without the products between forms; arguments as above."""

    def __init__(self, selection: Selection, explained: Curves | None = None) -> None:
        super().__init__(selection)
        observations, (A, places) = self.observations, columns_of_fit(selection, explained)
        self.blocks, self.weight = observations.blocks, observations.weight
        self._label = self.blocks.label(len(self.weight))
        self._noise = GaussMarkov(self.blocks, self.settings)
        self._model = []
        left = []
        for index in places:
            order = np.concatenate([index[0][:-1], *index[1:], index[0][-1:]])
            inside, means = self._whitened(A[:, order])
            products = means @ means.transpose(0, 2, 1) + inside.T @ inside
            k = len(order) - 1
            size = np.sqrt(np.einsum("tpp->tp", products[:, :k, :k]))
            size = np.where(size > 0.0, size, 1.0)
            scaled = products[:, :k, :k] / (size[:, :, None] * size[:, None, :]) + RIDGE * np.eye(k)
            inverse = np.linalg.inv(scaled) / (size[:, :, None] * size[:, None, :])
            target = products[:, :k, k]
            left.append(products[:, k, k] - np.einsum("tp,tpq,tq->t", target, inverse, target))
            self._model.append((inside, means, inverse, products))
        logarithms = self._noise.log_determinant + np.sum(np.log(self.blocks.weight))
        self._set(np.stack(left, axis=1)[1:] / self.scale**2, logarithms)

    def _whitened(self, columns: Values) -> tuple[Values, Values]:
        """Return (n, q) columns about the means of their blocks, and these, whitened: (n, q) and (t, q, m) arrays."""
        means = self.blocks.sums(self.weight[:, None] * columns) / self.blocks.weight[:, None]
        return np.sqrt(self.weight)[:, None] * (columns - means[self._label]), self._noise.whitened(means)

    def drops(self, columns: Values) -> Values:
        """Return what forms explain under each noise on each axis: (t, 3, m) array.

        ``columns``: (n, m, r) of m forms with r coefficients, or (n, 3, m, r) where each axis has its own.
        """
        *_, m, r = columns.shape
        found = np.zeros((len(self.left), 3, m))
        each = [columns] if columns.ndim == 3 else [columns[:, c] for c in range(3)]
        whitened = [self._whitened(z.reshape(len(z), m * r)) for z in each]
        for c in range(3):
            found[:, c] = self._explained(*whitened[c % len(whitened)], c, r) / self.scale[c] ** 2
        return found

    def _explained(self, inside: Values, means: Values, c: int, r: int) -> Values:
        """Return what forms of r whitened columns each explain on an axis: (t, m) array."""
        own_inside, own_means, inverse, products = self._model[c]
        t, q, _ = means.shape
        k = len(inverse[0])
        across = means @ own_means.transpose(0, 2, 1) + inside.T @ own_inside
        taken = across[:, :, :k] @ inverse
        cross = (across[:, :, k] - np.einsum("tqp,tp->tq", taken, products[:, :k, k])).reshape(t, q // r, r)
        inner = np.empty((t, q // r, r, r))
        for i in range(r):
            for j in range(r):
                both = np.sum(means[:, i::r] * means[:, j::r], axis=2)
                both += np.sum(inside[:, i::r] * inside[:, j::r], axis=0)
                inner[:, :, i, j] = both - np.sum(taken[:, i::r] * across[:, j::r, :k], axis=2)
        size = np.sqrt(np.maximum(np.sum(means[0] ** 2, axis=1) + np.sum(inside**2, axis=0), 0.0))
        known = np.sqrt(np.einsum("pp->p", products[0, :k, :k]))
        unit = (ROUNDING * np.sqrt(self.samples / 3.0)) ** 0.5
        error = (unit * (size + np.abs(taken) @ known)).reshape(t, q // r, r)
        own = np.sum(means**2, axis=2) + np.sum(inside**2, axis=0)
        error = np.maximum(error, np.sqrt(LEFT * own).reshape(error.shape))
        error[0] = np.maximum(error[0], NEW * size.reshape(q // r, r))  # the first is white noise
        explained, new = each_explains(inner, cross[..., None], error)
        new &= new[0]
        return np.asarray(np.where(new.all(axis=2), explained[..., 0].sum(axis=2), 0.0)[1:])


def each_explains(inner: Values, cross: Values, error: Values) -> tuple[Values, Mask]:
    """Return what each of r curves adds to those before it, (..., r, s), and whether it is independent of them.

    ``inner``: (..., r, r), products of the curves. ``cross``: (..., r, s), their products with s residuals. ``error``:
    (..., r), the rounding error e; a curve that leaves less explains nothing.
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


def columns_of_fit(selection: Selection, *further: Curves | None) -> tuple[Values, list[list[Index]]]:
    """Return the columns of a selection's fit, its residual and those of curves, and where those of each axis lie."""
    design = design_at(selection.observations.weakened, selection.fit)
    motions = [true_motion(part, selection.fit.terms) for part in selection.observations.parts]
    columns, places = [design.columns.columns], [[design.places(c)[0]] for c in range(3)]
    for curves in filter(None, further):
        values = np.concatenate([curves(motion) for motion in motions])
        first, apart = sum(c.shape[1] for c in columns), values.shape[2] if values.ndim == 3 else 0
        for c in range(3):
            places[c].append(first + c * apart + np.arange(values.shape[-1]))
        columns.append(values.reshape(len(values), -1))
    return np.concatenate(columns, axis=1), places
