"""Derivatives by a complex step, for least-squares problems that tests state without a Jacobian."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    Function = Callable[[np.ndarray[Any, Any]], np.ndarray[Any, Any]]

STEP = 1e-30  # there is no difference, so that nothing cancels (Squire & Trapp, SIAM Review 40, 1998)


def jacobian_of(function: Function) -> Function:
    """Return the derivative of an analytic function (no abs, no comparison), ``Im f(x + i h e_j) / h``."""

    def jacobian(x: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        return np.stack([np.imag(function(x + 1j * STEP * e)) / STEP for e in np.eye(len(x))], axis=1)

    return jacobian
