"""The noise of one sensor: white noise and a wandering bias.

    noise[n] = white * w[n] + wander * m[n]

with ``w`` independent standard normal and ``m`` a stationary first-order Gauss-Markov process of unit variance and
autocorrelation ``exp(-|t| / correlation_time)``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

MEDIAN_STEP = 0.9539  # median of |w[n+1] - w[n]| of white noise with standard deviation 1: 0.67449 sqrt(2)


@dataclass(frozen=True)
class Noise:
    """White noise of a sample (before any filter) and Gauss-Markov bias wander: (3,) standard deviations.

    ``source``: ``static`` (a long rest), ``rests`` (in the recordings), ``residual`` (of a fit) or ``data_sheet``.
    ``length``, s, is that of the static rest, else 0; the relative uncertainty of the wander is about
    ``sqrt(correlation_time / length)``.
    """

    white: NDArray[np.float64]
    wander: NDArray[np.float64]
    correlation_time: float
    source: str
    length: float = 0.0

    def to_json(self) -> dict[str, Any]:
        """Return the noise as JSON values."""
        return {**vars(self), "white": self.white.tolist(), "wander": self.wander.tolist()}

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Self:
        """Read back what ``to_json`` wrote."""
        return cls(**{**data, "white": np.array(data["white"]), "wander": np.array(data["wander"])})


def noise_of_steps(step: NDArray[np.float64], axis: int = 0, *, keepdims: bool = False) -> NDArray[np.float64]:
    """Return the standard deviation of white noise, ``median |x[n+1] - x[n]| / 0.9539``, along an axis.

    ``step`` are the absolute differences of successive samples. Slow signals and outliers hardly change the result.
    """
    return np.asarray(np.median(step, axis, keepdims=keepdims) / MEDIAN_STEP)
