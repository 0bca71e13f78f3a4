"""The motion of the body as a reference knows it, at the sample times of one recording."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray


@dataclass(frozen=True)
class Motion:
    """What the body did, from a table's log (no noise) or from a log's own calibrated signals.

    Attributes
    ----------
    time : (n,) array, s since power-on
    specific_force : (n, 3) array, g, body frame
    angular_rate : (n, 3) array, deg/s, body frame
    angular_acceleration : (n, 3) array, deg/s^2, body frame
    specific_force_rate : (n, 3) array, g/s, body frame
        Time derivative of ``specific_force`` as the body sees it (for gravity alone ``-omega x f``, omega in rad/s).
    temperature : (n,) array, degC, or None
        Smoothed over 30 s: sensor noise in a regressor would bias what is fitted to it.
    angle, rate : (n,) array, deg and deg/s, or None
        About the turn axis, where there is one.
    axis : int or None
        Index of the turn axis in the body frame.
    still : (n,) array of bool
        Samples at which the body rests and has settled.
    at_offset : callable or None
        ``at_offset(offset=tau)`` is the motion at ``time + tau`` (tau a float or (n,) array, s), from the same
        interpolated trajectory; None where the trajectory is not known between the samples.
    at_lag : callable or None
        ``at_lag(lag=tau, offset=0.0)`` is what a first-order lag of time constant tau, s, leaves of that motion.
    level : (n, 3, 3) array, or None
        Rows: the level frame's axes x, y, z in the body frame; None where no reference gives the heading.
    direction : (n, 3) array, or None
        Unit vector in the body frame of the turn that goes on or, at rest, of the last one; zeros before the first.
        None: not worked out yet (``pipeline.model.effects.base.turning_direction`` does it from the rates).
    followed : (n,) array of bool, or None
        Samples beside which the log is fine enough to know the trajectory between the samples.
    recording : str
        Name of the recording, for messages; empty where there is none.
    setup : str
        Its table, mounting or session; empty where there is one alone.
    """

    time: NDArray[np.float64]
    specific_force: NDArray[np.float64]
    angular_rate: NDArray[np.float64]
    angular_acceleration: NDArray[np.float64]
    specific_force_rate: NDArray[np.float64]
    temperature: NDArray[np.float64] | None
    angle: NDArray[np.float64] | None
    rate: NDArray[np.float64] | None
    axis: int | None
    still: NDArray[np.bool_]
    at_offset: Callable[..., Motion | None] | None = None
    at_lag: Callable[..., Motion | None] | None = None
    level: NDArray[np.float64] | None = None
    direction: NDArray[np.float64] | None = None
    followed: NDArray[np.bool_] | None = None
    recording: str = ""
    setup: str = ""

    def select(self, index: NDArray[Any]) -> Motion:
        """Return the motion at some samples (a mask or integers); the trajectory between samples is left behind."""

        def cut(values: NDArray[Any] | None) -> NDArray[Any] | None:
            return None if values is None else values[index]

        return replace(
            self,
            time=self.time[index],
            specific_force=self.specific_force[index],
            angular_rate=self.angular_rate[index],
            angular_acceleration=self.angular_acceleration[index],
            specific_force_rate=self.specific_force_rate[index],
            temperature=cut(self.temperature),
            angle=cut(self.angle),
            rate=cut(self.rate),
            still=self.still[index],
            at_offset=None,
            at_lag=None,
            level=cut(self.level),
            direction=cut(self.direction),
            followed=cut(self.followed),
        )


def motion_at_rest(time: NDArray[np.float64]) -> Motion:
    """Return the motion of a unit that rests, nobody knows how: forces and rates are zeros."""
    nothing = np.zeros((len(time), 3))
    still = np.ones(len(time), bool)
    return Motion(time, nothing, nothing, nothing, nothing, None, None, None, None, still)
