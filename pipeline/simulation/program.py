"""The angle of one axis over time: rests, and turns with trapezoidal rate.

Between the knots ``t_k`` the angular acceleration is constant, so at any time, not only at samples,

    A(t) = A_k + W_k s + a_k s^2 / 2,   dA/dt = W_k + a_k s,   d2A/dt2 = a_k,   s = t - t_k

where

A_k : angle at knot k, deg
W_k : rate at knot k, deg/s
a_k : acceleration after knot k, deg/s^2

A turn by the angle D at the rate r with acceleration a ramps for r/a, holds r and ramps down; where |D| < r^2/a it
never reaches r and the ramps meet in the middle.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True)
class Program:
    """One axis over time.

    Attributes
    ----------
    knots : (m,) array, s
        Starts of the segments; before the first and after the last the axis rests.
    angle, rate, acceleration : (m,) array, deg, deg/s, deg/s^2
        At each knot; the acceleration holds until the next.
    move : (m,) array of int
        Number of the move that a segment belongs to; a rest has that of the move before it, -1 before the first.
    stops : (moves + 1,) array, deg
        Angle before each move, and after the last.
    duration : float, s
    """

    knots: NDArray[np.float64]
    angle: NDArray[np.float64]
    rate: NDArray[np.float64]
    acceleration: NDArray[np.float64]
    move: NDArray[np.int64]
    stops: NDArray[np.float64]
    duration: float

    def segment(self, time: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the segment that each time falls into: (n,) array."""
        found = np.searchsorted(self.knots, time, side="right") - 1
        return np.clip(found, 0, None).astype(np.int64)

    def at(
        self, time: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
        """Return angle (deg), rate (deg/s), acceleration (deg/s^2) and number of the move at any times: (n,) arrays."""
        k = self.segment(time)
        s = np.clip(time - self.knots[k], 0.0, None)
        acceleration = self.acceleration[k]
        rate = self.rate[k] + acceleration * s
        return self.angle[k] + (self.rate[k] + 0.5 * acceleration * s) * s, rate, acceleration, self.move[k]


class ProgramBuilder:
    """Puts rests and turns one after the other.

    Parameters
    ----------
    acceleration : float, deg/s^2
        Of every ramp.
    angle : float, deg
        At the start.
    """

    def __init__(self, acceleration: float, angle: float = 0.0) -> None:
        self._acceleration = acceleration
        self._time, self._angle = 0.0, angle
        self._stops = [angle]
        self._rows: list[tuple[float, float, float, float, int]] = [(0.0, angle, 0.0, 0.0, -1)]

    def rest(self, seconds: float) -> ProgramBuilder:
        """Stay for a time in s."""
        self._time += seconds
        return self

    def turn(self, angle: float, rate: float) -> ProgramBuilder:
        """Turn by an angle (deg, signed), at most at ``rate`` (deg/s)."""
        if angle == 0.0:
            return self
        sign, a = float(np.sign(angle)), self._acceleration
        top = min(rate, float(np.sqrt(abs(angle) * a)))
        ramp, hold = top / a, abs(angle) / top - top / a
        number = len(self._stops) - 1
        half = sign * 0.5 * top * ramp
        t, start = self._time, self._angle
        self._rows += [
            (t, start, 0.0, sign * a, number),
            (t + ramp, start + half, sign * top, 0.0, number),
            (t + ramp + hold, start + angle - half, sign * top, -sign * a, number),
            (t + 2 * ramp + hold, start + angle, 0.0, 0.0, number),
        ]
        self._time, self._angle = t + 2 * ramp + hold, start + angle
        self._stops.append(self._angle)
        return self

    def turn_with_plateau(self, angle: float, rate: float) -> ProgramBuilder:
        """Turn so that ``angle`` (deg, signed) is passed at full ``rate`` (deg/s), with the ramps before and after."""
        return self.turn(angle + float(np.sign(angle)) * rate**2 / self._acceleration, rate)

    def build(self) -> Program:
        """Return the program."""
        rows = np.array([row[:4] for row in self._rows])
        move = np.array([row[4] for row in self._rows], np.int64)
        return Program(rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3], move, np.array(self._stops), self._time)
