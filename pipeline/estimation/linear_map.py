"""The linear map of a solved fit: what small changes of the readings do to its parameters.

    d parameters = sum over channels c of J_c A_c dy_c

where

    dy_c : (n,) change of the readings of channel c, g or deg/s
    A_c  : (q, n) weights of the readings in what is fitted of the channel, as the fit has solved for it
    J_c  : (p, q) derivative of the parameters with respect to that

The same map carries noise, quantisation and errors of the table (a wrong truth by du is a change of the readings by
``K du``) to the parameters, so that an uncertainty budget needs no further fit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Values = NDArray[np.float64]


@dataclass(frozen=True)
class LinearMap:
    """A and J of each channel; A may be one array for all.

    Attributes
    ----------
    weights : tuple of three (q, n) arrays
    derivative : tuple of three (p, q) arrays
    """

    weights: tuple[Values, Values, Values]
    derivative: tuple[Values, Values, Values]

    @property
    def parameters(self) -> int:
        """Number of parameters."""
        return int(self.derivative[0].shape[0])

    def then(self, change: Values) -> LinearMap:
        """Return the map to what (r, p) ``change`` makes of the parameters."""
        x, y, z = (change @ J for J in self.derivative)
        return LinearMap(self.weights, (x, y, z))

    def first(self) -> LinearMap:
        """Return the map to what is fitted of the channels, one after the other, without what follows."""
        sizes = [len(A) for A in self.weights]
        place = np.eye(sum(sizes))
        x, y, z = np.split(place, np.cumsum(sizes)[:-1], axis=1)
        return LinearMap(self.weights, (x, y, z))

    def results(self, kept: slice) -> LinearMap:
        """Return the map to some of the parameters."""
        x, y, z = (J[kept] for J in self.derivative)
        return LinearMap(self.weights, (x, y, z))

    def rows(self, rows: slice) -> LinearMap:
        """Return the map of some consecutive readings."""
        x, y, z = (A[:, rows] for A in self.weights)
        return LinearMap((x, y, z), self.derivative)

    def of(self, change: Values) -> Values:
        """Return the change of the parameters by a change of the readings, (n, 3): (p,) array."""
        total = np.zeros(self.parameters)
        for c in range(3):
            total += self.derivative[c] @ (self.weights[c] @ change[:, c])
        return total

    def of_groups(self, change: Values, group: NDArray[np.intp], count: int) -> Values:
        """Return the change of the parameters by the change of each group of readings alone: (p, count) array.

        Parameters
        ----------
        change : (n, 3) array
        group : (n,) array of int
            0 .. count - 1.
        count : int
        """
        total = np.zeros((self.parameters, count))
        for c in range(3):
            sums = [np.bincount(group, weight * change[:, c], count) for weight in self.weights[c]]
            total += self.derivative[c] @ np.array(sums).reshape(len(self.weights[c]), count)
        return total
