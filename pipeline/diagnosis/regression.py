"""The columns of a fitted model, and what they leave: of the readings, and of one column among them.

    y_c = X_c beta + r_c,    x~ = x - X_other delta,   delta = (X_other^T C^-1 X_other)^-1 X_other^T C^-1 x

where

    X_c : (n, 4 + p) columns of an axis: 1, what K acts on, and every parameter of every effect at its value
    r   : residual of the fit of base, configured and selected effects
    C   : white noise plus bias wander, ``pipeline.estimation.gauss_markov``
    w   : the wander that residuals tell, ``E[wander | r] = wander covariance C^-1 r``; ``r - w`` is white
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.estimation.design import BASE, Term, motions_of
from pipeline.estimation.gauss_markov import Products
from pipeline.model.effects.base import Layout, truth

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from pipeline.estimation.gauss_markov import Setting
    from pipeline.estimation.observations import Observations, Part
    from pipeline.estimation.selection import Selection

    Values = NDArray[np.float64]

OWN = 4  # columns of the base on each axis
RANK = 1e-11


@dataclass(frozen=True)
class Regression:
    """The columns and the residual of a selection's fit.

    Attributes
    ----------
    columns : list of (n, 4 + p) array
        Of each axis.
    residual : (n, 3) array, unit of the sensor
    observations : Observations
    """

    columns: list[Values]
    residual: Values
    observations: Observations

    @classmethod
    def of(cls, selection: Selection) -> Regression:
        """Return the regression at the values of a selection's fit."""
        observations = selection.observations
        terms = [Term(t.effect, t.values, full=True) for t in selection.fit.terms]
        pieces = [_of_part(selection, part, terms) for part in observations.parts]
        base, effects, residual = (np.concatenate([piece[k] for piece in pieces]) for k in range(3))
        columns = [np.concatenate([base, effects[:, c]], axis=1) for c in range(3)]
        return cls(columns, residual, observations)

    def products(self, columns: Values, setting: Setting) -> Values:
        """Return ``A^T C^-1 A`` of columns, with the white noise as unit."""
        products: Values = self._columns(columns).products([setting])[0][0]
        return products

    def _columns(self, columns: Values) -> Products:
        return Products(self.observations.blocks, self.observations.weight, columns)

    def all_products(self, scale: Values, setting: Setting) -> Values:
        """Return the products of all parameters' columns: 12 of the base, then those of the effects."""
        count = BASE + self.columns[0].shape[1] - OWN
        total = np.zeros((count, count))
        for c in range(3):
            index = _places(c, count)
            total[np.ix_(index, index)] += self.products(self.columns[c], setting) / scale[c] ** 2
        return total

    def wander(self, setting: Setting) -> Values:
        """Return the bias wander that the residual tells under a noise: (n, 3) array."""
        return self._columns(self.residual).bias(setting)

    def white_noise(self, white: Values) -> Values:
        """Return the standard deviation of a sample on each axis, of a residual without its wander: (3,) array."""
        squares = np.einsum("i,ij->j", self.observations.weight, white**2) + self.observations.scatter
        return np.asarray(np.sqrt(squares / self.observations.samples), np.float64)

    def left_of_column(self, c: int, j: int, products: Values) -> Values:
        """Return what all other columns leave of that of effect parameter ``j`` on an axis: (n,) array.

        Parameters
        ----------
        c : int
            Axis.
        j : int
            Counted over the parameters of all effects.
        products : (12 + p, 12 + p) array
            Of ``all_products``.
        """
        count, own = len(products), BASE + j
        others = np.arange(count) != own
        delta = np.zeros(count)
        delta[others] = _solved(products[np.ix_(others, others)], products[others, own])
        left: Values = self.columns[c][:, OWN + j] - self.columns[c] @ delta[_places(c, count)]
        return left

    def left_of(self, c: int, values: Values, setting: Setting) -> Values:
        """Return what base and effects, free on this axis, leave of values of (n,): (n,) array."""
        products = self.products(np.column_stack([self.columns[c], values]), setting)
        left: Values = values - self.columns[c] @ _solved(products[:-1, :-1], products[:-1, -1])
        return left


def _solved(gram: Values, cross: Values) -> Values:
    """Return the smallest solution of the normal equations, columns scaled to unit norm."""
    size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    found: Values = np.linalg.lstsq(gram / np.outer(size, size), cross / size, rcond=RANK)[0] / size
    return found


def _places(c: int, count: int) -> NDArray[np.intp]:
    """Return to which parameters the columns of an axis belong."""
    return np.concatenate([[c], 3 + 3 * c + np.arange(3), np.arange(BASE, count)])


def _of_part(selection: Selection, part: Part, terms: Sequence[Term]) -> tuple[Values, Values, Values]:
    """Return the columns of the base, those of the effects by axis, and the residual."""
    sensor, fit = selection.observations.sensor, selection.fit
    *motions, everything = motions_of(part, terms)
    u = truth(sensor, everything)
    residual = part.reading - fit.bias - u @ fit.K.T
    columns = [np.zeros((len(u), 3, 0))]
    for term, motion in zip(terms, motions, strict=True):
        columns.append(term.regressors(sensor, motion, fit.K, everything))
        if term.effect.moves:
            continue
        added = term.effect.reading(sensor, motion, fit.K, term.values)
        residual = residual - added
        if term.effect.layout == Layout.SHARED:
            u = u + np.linalg.solve(fit.K, added.T).T
    return np.column_stack([np.ones(len(u)), u]), np.concatenate(columns, axis=2), residual
