"""Time stamps of the sensor that are off against the reference.

    reading(t) = model(t + tau),    z = K [u(t + tau) - u(t)]

where tau is s (negative where the reading comes late), u the truth, g or deg/s, and K the inverse of the calibration
matrix.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from pipeline.model.effects.base import Effect, Layout, Owner, Parameter, truth, truth_rate

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from pipeline.records import Motion


def shifted(motion: Motion, offset: float | NDArray[np.float64]) -> Motion:
    """Return the motion at ``time + offset``, from the trajectory where it is known between the samples.

    Without a trajectory the truth is extended along its rate.

    Parameters
    ----------
    motion : Motion
    offset : float or (n,) array, s
    """
    if not np.any(offset):
        return motion
    if motion.at_offset is None:
        by = np.broadcast_to(offset, motion.time.shape)[:, None]
        return replace(
            motion,
            specific_force=motion.specific_force + motion.specific_force_rate * by,
            angular_rate=motion.angular_rate + motion.angular_acceleration * by,
        )
    return _at(motion.at_offset, 0.0, motion, offset=offset)


def _at(
    trajectory: Callable[..., Motion | None],
    before: float | NDArray[np.float64],
    still_of: Motion,
    offset: float | NDArray[np.float64],
) -> Motion:
    """Return the trajectory at the sum of two offsets, which can be shifted on from there."""
    total = before + offset
    there = trajectory(offset=total)
    assert there is not None  # noqa: S101
    return replace(
        there,
        still=still_of.still,
        direction=still_of.direction,
        at_offset=partial(_at, trajectory, total, still_of),
        at_lag=None if there.at_lag is None else partial(_lagged_at, there.at_lag, total, still_of),
    )


def _lagged_at(
    lagged: Callable[..., Motion | None],
    before: float | NDArray[np.float64],
    still_of: Motion,
    lag: float,
    offset: float | NDArray[np.float64] = 0.0,
) -> Motion:
    """Return what a lag shows of a trajectory at the sum of two offsets."""
    there = lagged(lag=lag, offset=before + offset)
    assert there is not None  # noqa: S101
    return replace(there, still=still_of.still, direction=still_of.direction)


class TimeOffset(Effect):
    """A constant time offset: one coefficient."""

    name = "time_offset"
    owner = Owner.TABLE
    layout = Layout.SHARED
    nonlinear = ("tau",)
    meaning = "The time stamps of the sensor and of the table's log are off by a constant."
    excitation = "readings while the table turns at 10 deg/s and more, or while it speeds up and slows down"
    experiment = "turn in both directions with fast ramps (30 deg/s and more): a delay and a lag differ only there"
    source = "Kalibr, time offset of IMU and reference; reading(t) = model(t + tau)"

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return tau."""
        del sensor
        return (Parameter("tau", "s", "the reading at t is that of the motion at t + tau"),)

    def regressors(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return ``K du/dt`` at ``t + tau``."""
        slope: NDArray[np.float64] = truth_rate(sensor, shifted(motion, values[0])) @ K.T
        return slope[:, :, None]

    def reading(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return ``K [u(t + tau) - u(t)]``."""
        change = truth(sensor, shifted(motion, values[0])) - truth(sensor, motion)
        added: NDArray[np.float64] = change @ K.T
        return added

    def slope(self, sensor: str, moved: Motion) -> NDArray[np.float64]:
        """Return ``du/dt``."""
        return truth_rate(sensor, moved)

    def moved(self, motion: Motion, values: NDArray[np.float64]) -> Motion:
        """Return the motion at ``t + tau``."""
        return shifted(motion, values[0])


EFFECT = TimeOffset()
