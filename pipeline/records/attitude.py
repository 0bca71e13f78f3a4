"""Attitudes as quaternions (w, x, y, z), body to level with z up, and the angular rate that they imply over time.

    omega = 2 vec(conj(q) dq/dt)

with the derivative of a quintic spline through the quaternion's components: at 0.12 s and 200 deg/s its truncation
error is below 1e-3 deg/s; a central difference would be wrong by 1 %.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


def continuous(attitude: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return unit quaternions without jumps in sign (q and -q are one attitude): (n, 4) array."""
    q = attitude / np.linalg.norm(attitude, axis=1, keepdims=True)
    flips = np.where(np.sum(q[1:] * q[:-1], axis=1) < 0, -1.0, 1.0)
    found: NDArray[np.float64] = q * np.concatenate([[1.0], np.cumprod(flips)])[:, None]
    return found


def conjugate_product(p: NDArray[np.float64], q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the vector part of ``conj(p) q`` for quaternions of shape (n, 4): (n, 3)."""
    return p[:, :1] * q[:, 1:] - q[:, :1] * p[:, 1:] - np.cross(p[:, 1:], q[:, 1:])


def level_in_body(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the vertical in the body frame, ``R(q)^T e_z``: (n, 3) array."""
    w, x, y, z = q.T
    up: NDArray[np.float64] = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1)
    return up


def rate_of_attitude(time: NDArray[np.float64], attitude: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the size of the angular rate: (n,) array, deg/s.

    Parameters
    ----------
    time : (n,) array, s
        n at least 6, increasing.
    attitude : (n, 4) array
        Quaternions (w, x, y, z), body to level.
    """
    from scipy.interpolate import make_interp_spline  # noqa: PLC0415  (0.3 s, needed by attitude logs alone)

    rate = make_interp_spline(time, continuous(attitude), k=5)(time, 1)
    size: NDArray[np.float64] = 2.0 * np.degrees(np.linalg.norm(rate, axis=1))
    return size
