"""Rotations of vectors by table angles and attitudes; quaternions are (w, x, y, z)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


def turn_about_axis(vector: NDArray[np.float64], axis: int, angle_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    """Turn (..., 3) vectors about coordinate axis 0, 1 or 2 by each of n angles (right-handed): (n, ..., 3) array."""
    j, k = (axis + 1) % 3, (axis + 2) % 3
    angle = np.radians(angle_deg).reshape(-1, *[1] * (vector.ndim - 1))
    c, s = np.cos(angle), np.sin(angle)
    out = np.empty((len(angle), *vector.shape))
    out[..., axis] = vector[..., axis]
    out[..., j] = c * vector[..., j] - s * vector[..., k]
    out[..., k] = s * vector[..., j] + c * vector[..., k]
    return out


def turn_by_vector(phi: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotations by vectors, ``exp [phi]x`` (Rodrigues): (..., 3) array, rad, to (..., 3, 3)."""
    angle = np.linalg.norm(phi, axis=-1)
    small = angle < 1e-6
    safe = np.where(small, 1.0, angle)
    s = np.where(small, 1.0, np.sin(safe) / safe)
    c = np.where(small, 0.5, (1.0 - np.cos(safe)) / safe**2)
    cross = skew(phi)
    out: NDArray[np.float64] = np.eye(3) + s[..., None, None] * cross + c[..., None, None] * (cross @ cross)
    return out


def skew(v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``[v]x``, with ``[v]x u = v x u``: (..., 3) array to (..., 3, 3)."""
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
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


ABOUT = skew(np.eye(3))  # ABOUT[a] @ u = e_a x u
