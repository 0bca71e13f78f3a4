"""Means of a residual in equal bins of a covariate, with the variance that white noise and bias wander give them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.estimation.gauss_markov import Blocks

    Values = NDArray[np.float64]

BINS = 40
DIGITS = 5


@dataclass(frozen=True)
class Bins:
    """Those of equal bins that hold something.

    Attributes
    ----------
    cell : (n,) array of int
        Bin of each row; one beyond the last where the covariate is not known.
    row_weight : (n,) array
    weight : (b,) array
        Of the rows in a bin together.
    centre : (b,) array
        Weighted mean of the covariate.
    """

    cell: NDArray[np.intp]
    row_weight: Values
    weight: Values
    centre: Values

    @classmethod
    def of(cls, values: Values, weight: Values) -> Bins:
        """Return the bins of a covariate.

        Parameters
        ----------
        values : (n,) array
            Not finite where it is not known.
        weight : (n,) array
        """
        known = np.isfinite(values)
        low, high = (float(values[known].min()), float(values[known].max())) if known.any() else (0.0, 0.0)
        place = np.full(len(values), BINS)
        place[known] = np.minimum((values[known] - low) * (BINS / max(high - low, 1e-300)), BINS - 1)
        total: Values = np.bincount(place, weight, BINS + 1).astype(float)
        filled = np.flatnonzero(total[:BINS] > 0)
        number = np.full(BINS + 1, len(filled))
        number[filled] = np.arange(len(filled))
        sums: Values = np.bincount(place, weight * np.where(known, values, 0.0), BINS + 1).astype(float)
        return cls(number[place], weight, total[filled], sums[filled] / total[filled])

    def mean(self, values: Values) -> Values:
        """Return the weighted means of (n,) values: (b,) array."""
        sums = np.bincount(self.cell, self.row_weight * values, len(self.weight) + 1)
        means: Values = sums[: len(self.weight)] / self.weight
        return means

    def bias_of_means(self, blocks: Blocks, time: float) -> Values:
        """Return the variance that a Gauss-Markov bias of unit variance gives the means: (b,) array.

        ``a^T B a``, with a the shares of a bin in the blocks and B the covariance of the bias.

        Parameters
        ----------
        blocks : Blocks
        time : float, s
            Its correlation time.
        """
        bins, count = len(self.weight), len(blocks.first)
        index = self.cell * count + blocks.label(len(self.cell))
        sums = np.bincount(index, self.row_weight, (bins + 1) * count)
        share: Values = sums.reshape(bins + 1, count)[:bins] / self.weight[:, None]
        variance: Values = np.einsum("bi,bi->b", share @ blocks.covariance(time), share)
        return variance

    def document(self, values: Values, variance: Values) -> dict[str, list[float]]:
        """Return covariate, means of (n,) values and their standard errors as lists."""
        return {
            "x": rounded(self.centre),
            "mean": rounded(self.mean(values)),
            "standard_error": rounded(np.sqrt(variance)),
        }


def rounded(values: Values) -> list[float]:
    """Return values to five digits, which is more than a picture shows."""
    return [float(f"{v:.{DIGITS}g}") for v in values.tolist()]
