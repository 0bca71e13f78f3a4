"""A clock of the sensor that runs fast or slow against the reference.

    reading(t) = model(t + 1e-6 e t),    z = K [u(t + 1e-6 e t) - u(t)]

where e is the error of the clock, ppm, t the time since power-on, s, u the truth, g or deg/s, and K
the inverse of the calibration matrix.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.model.effects.base import Effect, Layout, Owner, Parameter, truth, truth_rate
from pipeline.model.effects.time_offset import shifted

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pipeline.records import Motion

PPM = 1e-6


class ClockRate(Effect):
    """A clock that runs at a wrong rate: one coefficient."""

    name = "clock_rate"
    owner = Owner.TABLE
    layout = Layout.SHARED
    needs_clock = True
    nonlinear = ("e",)
    meaning = "The clock of the sensor runs fast or slow against that of the table's log."
    excitation = "turns at 10 deg/s and more, minutes apart"
    experiment = "repeat the first turn at the end: a time offset is then the same, a clock's error has grown"
    source = "MPU-6000/6050 product specification 6.6, internal clock source, +-1 %"

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return e."""
        del sensor
        return (Parameter("e", "ppm", "error of the clock"),)

    def regressors(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return ``K 1e-6 t du/dt`` there."""
        there = shifted(motion, PPM * values[0] * motion.time)
        slope: NDArray[np.float64] = (PPM * motion.time[:, None] * truth_rate(sensor, there)) @ K.T
        return slope[:, :, None]

    def reading(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the change of the truth, times K."""
        change = truth(sensor, shifted(motion, PPM * values[0] * motion.time)) - truth(sensor, motion)
        added: NDArray[np.float64] = change @ K.T
        return added

    def slope(self, sensor: str, moved: Motion) -> NDArray[np.float64]:
        """Return ``1e-6 t du/dt``."""
        return PPM * moved.time[:, None] * truth_rate(sensor, moved)

    def moved(self, motion: Motion, values: NDArray[np.float64]) -> Motion:
        """Return the motion at ``t + 1e-6 e t``."""
        return shifted(motion, PPM * values[0] * motion.time)


EFFECT = ClockRate()
