"""The derivative of an analytic function, exact to rounding.

    df/dx_j = Im f(x + i h e_j) / h

where h = 1e-30: there is no difference, so nothing cancels (Squire & Trapp, SIAM Review 40, 1998).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Function = Callable[[NDArray[np.float64]], NDArray[np.float64]]

COMPLEX_STEP = 1e-30


def complex_step_jacobian(function: Function) -> Function:
    """Return the derivative of an analytic function, exact to rounding.

    Parameters
    ----------
    function : callable
        (p,) to (n,), analytic: no abs, no comparison of its argument.

    Returns
    -------
    callable
        (p,) to (n, p).
    """

    def jacobian(x: NDArray[np.float64]) -> NDArray[np.float64]:
        columns = []
        for j in range(len(x)):
            moved = x.astype(complex)
            moved[j] += 1j * COMPLEX_STEP
            columns.append(np.imag(function(moved)) / COMPLEX_STEP)
        return np.stack(columns, axis=1)

    return jacobian
