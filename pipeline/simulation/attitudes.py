"""The attitudes of procedures without a table, as matrices whose rows are the level axes in the body frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.model.rotation import attitude_matrix
from pipeline.simulation.trajectory import rotation_about

if TYPE_CHECKING:
    from numpy.typing import NDArray


def axis_and_angle(rotation: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Return the unit axis and the angle in deg, 0 to 180, of a rotation matrix.

    The quaternion is the eigenvector of Bar-Itzhack's matrix for its largest eigenvalue; it is good at 180 deg too.
    """
    d, off = rotation, np.array([rotation[2, 1], rotation[0, 2], rotation[1, 0]])
    skew = off - np.array([d[1, 2], d[2, 0], d[0, 1]])
    matrix = np.empty((4, 4))
    matrix[0, 0] = np.trace(d)
    matrix[0, 1:] = matrix[1:, 0] = skew
    matrix[1:, 1:] = d + d.T - np.trace(d) * np.eye(3)
    q = np.linalg.eigh(matrix)[1][:, -1]
    q = q if q[0] >= 0.0 else -q
    size = float(np.linalg.norm(q[1:]))
    if size == 0.0:  # none: any axis will do
        return np.array([1.0, 0.0, 0.0]), 0.0
    return q[1:] / size, float(np.degrees(2.0 * np.arctan2(size, q[0])))


def orientations_24() -> NDArray[np.float64]:
    """Return eight attitudes 45 deg apart about each axis: (24, 3, 3) array; for z, body x points up at the first."""
    angles = np.linspace(0.0, 315.0, 8)
    x, y, z = np.eye(3)
    upright = rotation_about(y, np.array([-90.0]))[0]  # body x up
    turns = [rotation_about(x, angles), rotation_about(y, angles), upright @ rotation_about(z, angles)]
    return np.concatenate(turns)


def six_positions() -> NDArray[np.float64]:
    """Return six attitudes with each axis up and down: (6, 3, 3) array."""
    x, y, _ = np.eye(3)
    return np.concatenate([rotation_about(x, np.linspace(0.0, 270.0, 4)), rotation_about(y, np.array([-90.0, 90.0]))])


def random_attitudes(count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return attitudes that are uniform over all rotations: (count, 3, 3) array."""
    q = rng.standard_normal((count, 4))
    return attitude_matrix(q / np.linalg.norm(q, axis=1, keepdims=True))
