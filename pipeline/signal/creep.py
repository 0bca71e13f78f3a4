"""How a unit tilts within a rest by hand: steadily, as its seat gives way or a hand tires.

A body that turns at the rate omega sees gravity u turn by ``du/dt = -omega x u``, so that the accelerometer shows the
two components of omega across gravity, and nothing of the third:

    omega_across = (du/dt) x u

du/dt is the slope of the readings of a rest; with white noise s of a sample, n samples and a rest of T seconds its
standard deviation is ``s sqrt(12 / n) / T`` on each axis. The readings less a parabola in time tell s: a creep that
passes for noise would hide what the noise hides.

A mean over directions that spread by the variance v (rad^2, both axes together) is short by v/2 of its length.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.signal.filter_noise import filter_autocovariance
from pipeline.signal.wander import variance_of_mean

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.records import Recording

    Values = NDArray[np.float64]

DEGREE = 2
SIGNIFICANT = 4.0  # standard deviations: of the two components, noise alone passes it in 3e-4
FEWEST = 8  # samples from which a rest tells a slope beside its noise


@dataclass(frozen=True)
class Creep:
    """The tilt within one rest.

    Attributes
    ----------
    rate : (3,) array, deg/s
        omega across gravity, in the axes of the readings; zero where it does not stand out of the noise.
    uncertainty : float, deg/s
        Standard uncertainty of each of its two components; 0 where the rate is zero.
    shortening : float
        By which share the mean of the readings is too short; 0 likewise.
    squares : (3,) array
        Sum of squares of the readings about their parabola.
    freedom : int
        Its degrees of freedom, an axis.
    bend : float, rad
        How far the direction strays from a straight line, at most.
    """

    rate: Values
    uncertainty: float
    shortening: float
    squares: Values
    freedom: int
    bend: float


def vertical_creep(rates: Values) -> float:
    """Return the standard deviation of the rate about gravity, which the accelerometer does not show, deg/s.

    Nothing tells the three axes apart: it is that of the other two.

    Parameters
    ----------
    rates : (m, 3) array, deg/s
        Across gravity, of the rests of a recording.
    """
    return float(np.sqrt(np.sum(rates**2) / (2.0 * max(len(rates), 1))))


def along_gravity(time: Values, force: Values) -> tuple[Values, bool]:
    """Return the readings of a rest along its mean, (n,) array, g, and whether the unit creeps in it.

    A tilt by theta changes the component along gravity by theta times the bias across it, which no calibration has told
    yet; so of a rest in which the unit creeps it is less its parabola in time.
    """
    mean = force.mean(axis=0)
    along = force @ (mean / np.linalg.norm(mean))
    creeps = bool(creep_of(time, force).rate.any())
    if creeps:
        x = 2.0 * (time - time[0]) / (time[-1] - time[0]) - 1.0
        basis, _ = np.linalg.qr(np.polynomial.legendre.legvander(x, DEGREE))
        along = along - basis[:, 1:] @ (basis[:, 1:].T @ along)
    return along, creeps


def creep_in(recording: Recording, start: int, stop: int) -> Creep:
    """Return how a unit tilts in the samples ``start <= n < stop`` of a recording, without marked or missing ones."""
    key = "creep", start, stop
    if key not in recording.kept:
        force = recording.accelerometer
        assert force is not None  # noqa: S101
        good = (recording.sound[start:stop]) & np.isfinite(force[start:stop]).all(axis=1)
        count = np.array([max(int(good.sum()), 1)])
        share = float(variance_of_mean(filter_autocovariance(recording), count)[0])
        recording.kept[key] = creep_of(recording.time[start:stop][good], force[start:stop][good], share)
    found: Creep = recording.kept[key]
    return found


def creep_of(time: Values, force: Values, share: float = 0.0) -> Creep:
    """Return how a unit tilts within a rest.

    Parameters
    ----------
    time : (n,) array, s
    force : (n, 3) array, g
        Readings of the accelerometer.
    share : float
        Variance of their mean by white noise over that of one; 0 stands for 1/n.
    """
    n = len(time)
    mean = force.mean(axis=0) if n else np.zeros(3)
    length = float(np.linalg.norm(mean))
    if n < FEWEST or length == 0.0 or time[-1] <= time[0]:
        return Creep(np.zeros(3), 0.0, 0.0, np.sum((force - mean) ** 2, axis=0), max(n - 1, 0), 0.0)
    u, span = mean / length, float(time[-1] - time[0])
    x = 2.0 * (time - time[0]) / span - 1.0
    basis, _ = np.linalg.qr(np.polynomial.legendre.legvander(x, DEGREE))
    along = basis.T @ force
    squares = np.sum((force - basis @ along) ** 2, axis=0)
    freedom = n - DEGREE - 1
    path = basis[:, 1:] @ along[1:]
    path -= np.outer(path @ u, u)  # what is left turns gravity
    line = basis[:, 1:2] @ along[1:2]
    line -= np.outer(line @ u, u)
    white = float(np.sqrt(squares.sum() / (3 * freedom)))
    error = white * np.sqrt(12.0 * max(share, 1.0 / n)) / span
    slope = (line[-1] - line[0]) / span
    if np.linalg.norm(slope) <= SIGNIFICANT * error:
        return Creep(np.zeros(3), 0.0, 0.0, squares, freedom, 0.0)
    bend = float(np.linalg.norm(path - line, axis=1).max()) / length
    variance = float(np.mean(np.sum(path**2, axis=1))) / length**2
    rate = np.degrees(np.cross(slope, u) / length)
    return Creep(rate, float(np.degrees(error / length)), 0.5 * variance, squares, freedom, bend)
