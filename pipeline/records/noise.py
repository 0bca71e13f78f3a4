"""The noise of one sensor: white noise and bias wander."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True)
class Noise:
    """White noise of a sample and a first-order Gauss-Markov bias wander, per axis.

    ``noise[n] = white * w[n] + wander * m[n]``, with ``w`` independent standard normal and ``m`` stationary with unit
    variance and autocorrelation ``exp(-|t| / correlation_time)``.

    Attributes
    ----------
    white : (3,) array, unit of the sensor
        Standard deviation of one raw sample, before any filter.
    wander : (3,) array, unit of the sensor
        Stationary standard deviation of the bias wander; 0 where none was seen.
    correlation_time : float, s
    source : str
        ``static`` (a long rest), ``rests`` (rest parts of the recordings), ``residual`` (what a fit left) or
        ``data_sheet``.
    length : float, s
        Of the static rest that told it; 0 where none did. It bounds how well the wander is known: its standard
        deviation has a relative uncertainty of about ``sqrt(correlation_time / length)``.
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
