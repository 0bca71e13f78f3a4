"""Creep: the slow, steady tilt of a unit within a rest, as its seat gives way or a hand tires.

A body that turns at the rate omega sees gravity u turn by ``du/dt = -omega x u``, so that the accelerometer shows the
two components of omega across gravity:

    omega_across = (du/dt) x u

du/dt is the slope of the readings of a rest; with white noise s of a sample, n samples and a rest of T seconds its
standard deviation is ``s sqrt(12 / n) / T`` on each axis. s follows from the readings less a parabola in time, so that
creep does not count as noise. A mean over directions that spread by the variance v (rad^2, both axes together) is too
short by the share v/2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.signal.filters import filter_autocovariance, variance_of_mean

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.records import Recording, Values

DEGREE = 2  # of the parabola
SIGNIFICANT = 4.0  # standard deviations: of the two components, noise alone passes it in 3e-4
FEWEST = 8  # samples from which a slope has five degrees of freedom


@dataclass(frozen=True)
class Creep:
    """The tilt within one rest.

    Attributes
    ----------
    rate : (3,) array, deg/s
        omega across gravity, in the axes of the readings; zero where it is not significant.
    measured : (3,) array, deg/s
        The same, also where it may be noise; ``uncertainty`` is the standard one of each of its two components.
    shortening : float
        By which share the mean of the readings is too short; 0 where the rate is zero.
    squares, freedom : (3,) array, int
        Sum of squares of the readings about their parabola, and its degrees of freedom, an axis.
    bend : float, rad
        Largest departure of the direction from a straight line.
    """

    rate: Values
    measured: Values
    uncertainty: float
    shortening: float
    squares: Values
    freedom: int
    bend: float


def believed_rates(creeps: Sequence[Creep]) -> tuple[Values, Values, float]:
    """Return the posterior rates across gravity in the rests of one recording.

    With the variance c^2 of a component between the rests, estimated from rates w of standard uncertainty e,

        rate = w c^2 / (c^2 + e^2),   error^2 = c^2 e^2 / (c^2 + e^2),   c^2 = mean(|w|^2 / 2 - e^2)

    and c = 0 where noise alone explains the rates: ``|w|^2 / (2 e^2)`` has mean and variance 1 then. The rate about
    gravity, which the accelerometer does not show, has the standard deviation c, too.

    Returns
    -------
    rate : (m, 3) array, deg/s
    error : (m,) array, deg/s
        Standard uncertainty of each of its two components.
    about : float, deg/s
        c.
    """
    w, e = np.array([c.measured for c in creeps]).reshape(-1, 3), np.array([c.uncertainty for c in creeps])
    known = e > 0.0
    half = 0.5 * np.sum(w**2, axis=1)
    if not known.any() or np.mean(half[known] / e[known] ** 2) <= 1.0 + SIGNIFICANT / np.sqrt(known.sum()):
        return np.zeros_like(w), np.zeros(len(w)), 0.0
    variance = max(float(np.mean(half[known] - e[known] ** 2)), 0.0)
    share = np.where(known, variance / (variance + e**2), 0.0)
    return w * share[:, None], np.where(known, e * np.sqrt(share), np.sqrt(variance)), float(np.sqrt(variance))


def along_gravity(time: Values, force: Values) -> tuple[Values, bool]:
    """Return the readings of a rest along its mean, (n,) array, g, and whether the unit creeps in it.

    A tilt by theta changes the component along gravity by theta times the bias across it, which is not known yet: where
    the unit creeps, a parabola in time is subtracted.
    """
    mean = force.mean(axis=0)
    along = force @ (mean / np.linalg.norm(mean))
    creeps = bool(creep_of(time, force).rate.any())
    if creeps:
        basis = _parabolas(time)[:, 1:]
        along = along - basis @ (basis.T @ along)
    return along, creeps


def _parabolas(time: Values) -> Values:
    """Return an orthonormal basis of the parabolas in time: (n, 3) array, the constant first."""
    x = 2.0 * (time - time[0]) / (time[-1] - time[0]) - 1.0
    return np.linalg.qr(np.polynomial.legendre.legvander(x, DEGREE))[0]


def creep_in(recording: Recording, start: int, stop: int) -> Creep:
    """Return how a unit tilts in the samples ``start <= n < stop`` of a recording, without marked or missing ones."""
    key = "creep", start, stop
    if key not in recording.cache:
        force = recording.accelerometer
        assert force is not None  # noqa: S101
        good = (recording.valid[start:stop]) & np.isfinite(force[start:stop]).all(axis=1)
        count = np.array([max(int(good.sum()), 1)])
        share = float(variance_of_mean(filter_autocovariance(recording), count)[0])
        recording.cache[key] = creep_of(recording.time[start:stop][good], force[start:stop][good], share)
    found: Creep = recording.cache[key]
    return found


def creep_of(time: Values, force: Values, share: float = 0.0) -> Creep:
    """Return how a unit tilts within a rest of n readings of the accelerometer, g.

    ``share`` is the variance of their mean by white noise over that of one; 0 stands for 1/n.
    """
    n = len(time)
    mean = force.mean(axis=0) if n else np.zeros(3)
    length = float(np.linalg.norm(mean))
    if n < FEWEST or length == 0.0 or time[-1] <= time[0]:
        return Creep(np.zeros(3), np.zeros(3), 0.0, 0.0, np.sum((force - mean) ** 2, axis=0), max(n - 1, 0), 0.0)
    u, span = mean / length, float(time[-1] - time[0])
    basis = _parabolas(time)
    along = basis.T @ force
    squares = np.sum((force - basis @ along) ** 2, axis=0)
    freedom = n - DEGREE - 1
    across = along - np.outer(along @ u, u)  # what turns gravity
    path, line = basis[:, 1:] @ across[1:], basis[:, 1:2] @ across[1:2]
    white = float(np.sqrt(squares.sum() / (3 * freedom)))
    error = white * np.sqrt(12.0 * max(share, 1.0 / n)) / span
    slope = (line[-1] - line[0]) / span
    measured, uncertainty = np.degrees(np.cross(slope, u) / length), float(np.degrees(error / length))
    if np.linalg.norm(slope) <= SIGNIFICANT * error:
        return Creep(np.zeros(3), measured, uncertainty, 0.0, squares, freedom, 0.0)
    bend = float(np.linalg.norm(path - line, axis=1).max()) / length
    variance = float(np.mean(np.sum(path**2, axis=1))) / length**2
    return Creep(measured, measured, uncertainty, 0.5 * variance, squares, freedom, bend)
