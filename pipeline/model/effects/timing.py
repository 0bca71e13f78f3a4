"""Effects of timing: the reading is that of the motion at another time, or of a filtered motion.

    time_offset:   reading(t) = model(t + tau)
    clock_rate:    reading(t) = model(t + 1e-6 e t)
    low_pass_lag:  reading(t) = model(u'),  u'(t) = integral_0^inf exp(-s / tau) / tau u(t - s) ds

and z = K (u' - u), with tau in s (an offset is negative where the reading comes late, a time constant is 0 or more), e
in ppm, u the truth, g or deg/s, u' the truth there, and K the inverse of the calibration matrix. The lag of a turn's
rate is exact; that of other signals is a Gauss-Laguerre sum, exact where they are polynomials of degree 7 in time.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from pipeline.model.effects.base import Layout, truth, truth_rate
from pipeline.model.effects.formula_effect import DeclaredEffect
from pipeline.model.kinematics import NODES, WEIGHTS

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from pipeline.records import Motion

PPM = 1e-6
STEP_S = 1e-5  # of the central difference: its rounding is 1e-11 of u per second


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


class _Timing(DeclaredEffect):
    """An effect that moves the motion in time: its value is K times the change of the truth."""

    layout = Layout.SHARED
    needs_motion = True

    def regressors(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return K times the derivative of the truth with respect to the only parameter."""
        slope = self.slope(sensor, self.moved(motion, values))
        assert slope is not None  # noqa: S101
        return np.asarray(slope @ K.T)[:, :, None]

    def reading(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return ``K (u' - u)``."""
        change = truth(sensor, self.moved(motion, values)) - truth(sensor, motion)
        return np.asarray(change @ K.T)


class TimeOffset(_Timing):
    """A constant time offset: one coefficient."""

    nonlinear = ("tau",)

    def slope(self, sensor: str, moved: Motion) -> NDArray[np.float64]:
        """Return ``du/dt``."""
        return truth_rate(sensor, moved)

    def moved(self, motion: Motion, values: NDArray[np.float64]) -> Motion:
        """Return the motion at ``t + tau``."""
        return shifted(motion, values[0])


class ClockRate(_Timing):
    """A clock that runs at a wrong rate: one coefficient."""

    needs_clock = True
    nonlinear = ("e",)

    def slope(self, sensor: str, moved: Motion) -> NDArray[np.float64]:
        """Return ``1e-6 t du/dt``."""
        return PPM * moved.time[:, None] * truth_rate(sensor, moved)

    def moved(self, motion: Motion, values: NDArray[np.float64]) -> Motion:
        """Return the motion at ``t + 1e-6 e t``."""
        return shifted(motion, PPM * values[0] * motion.time)


class LowPassLag(_Timing):
    """A first-order lag: one coefficient."""

    nonlinear = ("tau",)

    def starts(self, sensor: str) -> list[NDArray[np.float64]]:
        """Return a short lag: at none, it looks exactly like a time offset."""
        del sensor
        return [np.array([0.005])]

    def stepped(self, values: NDArray[np.float64], step: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return ``values + step``, not below zero."""
        return np.maximum(values + step, 0.0)

    def regressors(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return ``K du'/dtau``: minus the rate of u where there is no lag yet, else a central difference."""
        if values[0] <= STEP_S:
            slope = -truth_rate(sensor, motion)
        else:
            later, sooner = (truth(sensor, self.moved(motion, values + d)) for d in (STEP_S, -STEP_S))
            slope = (later - sooner) / (2.0 * STEP_S)
        return np.asarray(slope @ K.T)[:, :, None]

    def moved(self, motion: Motion, values: NDArray[np.float64]) -> Motion:
        """Return the motion behind a first-order lag."""
        if values[0] <= 0.0:
            return motion
        if motion.at_lag is not None:
            shown = motion.at_lag(lag=float(values[0]))
            assert shown is not None  # noqa: S101
            return replace(
                shown,
                still=motion.still,
                direction=motion.direction,
                at_offset=partial(self._moved_at, motion, values),
            )
        nodes = [shifted(motion, -values[0] * node) for node in NODES]

        def mean(name: str) -> NDArray[np.float64]:
            total = np.zeros_like(motion.specific_force)
            for weight, node in zip(WEIGHTS, nodes, strict=True):
                total += weight * getattr(node, name)
            return total

        return replace(
            motion,
            specific_force=mean("specific_force"),
            angular_rate=mean("angular_rate"),
            angular_acceleration=mean("angular_acceleration"),
            specific_force_rate=mean("specific_force_rate"),
            at_offset=partial(self._moved_at, motion, values),
        )

    def _moved_at(
        self, motion: Motion, values: NDArray[np.float64], offset: float | NDArray[np.float64] = 0.0
    ) -> Motion:
        """Return the motion behind the lag at ``time + offset``."""
        return self.moved(shifted(motion, offset), values)
