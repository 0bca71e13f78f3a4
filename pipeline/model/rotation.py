"""Rotations of vectors by table angles and attitudes; quaternions are (w, x, y, z)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


# ABOUT[a] @ u = e_a x u
ABOUT = np.stack([np.cross(axis, np.eye(3)).T for axis in np.eye(3)])


def turn_about_axis(vector: NDArray[np.float64], axis: int, angle_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    """Turn vectors about a coordinate axis by each of several angles (right-handed).

    Parameters
    ----------
    vector : (..., 3) array
    axis : int
        0, 1, 2 for x, y, z.
    angle_deg : (n,) array, deg

    Returns
    -------
    (n, ..., 3) array
    """
    j, k = (axis + 1) % 3, (axis + 2) % 3
    angle = np.radians(angle_deg).reshape(-1, *[1] * (vector.ndim - 1))
    c, s = np.cos(angle), np.sin(angle)
    out = np.empty((len(angle), *vector.shape))
    out[..., axis] = vector[..., axis]
    out[..., j] = c * vector[..., j] - s * vector[..., k]
    out[..., k] = s * vector[..., j] + c * vector[..., k]
    return out


def attitude_matrix(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation matrices of unit quaternions: (n, 4) to (n, 3, 3), body vectors to level vectors."""
    w, x, y, z = q.T
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        1,
    )
