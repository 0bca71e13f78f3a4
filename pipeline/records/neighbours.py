"""White noise by the differences of neighbours, which slow signals and outliers do not move."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.records.median import median

if TYPE_CHECKING:
    from numpy.typing import NDArray

MEDIAN_STEP = 0.9539  # median of |w[n+1] - w[n]| of white noise of standard deviation 1


def noise_of_steps(step: NDArray[np.float64], axis: int = 0, *, keepdims: bool = False) -> NDArray[np.float64]:
    """Return the standard deviation of white noise, ``median |x[n+1] - x[n]| / 0.9539``, along an axis.

    Parameters
    ----------
    step : array
        Sizes of the differences of neighbours, ``|x[n+1] - x[n]|``.
    axis : int
    keepdims : bool
        As of ``numpy.median``.
    """
    return np.asarray(median(step, axis, keepdims=keepdims) / MEDIAN_STEP)
