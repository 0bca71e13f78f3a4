"""Bias that settles after power-on.

    z = A exp(-t / tau)

where A is (3,), g or deg/s, t the time since power-on, s, and tau the time constant, s; nothing is added at tau = 0.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.model.effects.base import Effect, Layout, Owner, Parameter, axis_parameters, every_axis, unit_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.records import Motion

STARTS_S = (60.0, 180.0, 500.0, 1500.0)
SHORTEST_S, LONGEST_S = 1.0, 1e5


class WarmUp(Effect):
    """Exponential settling of the bias: one amplitude an axis and one time constant."""

    name = "warm_up"
    owner = Owner.SENSOR
    layout = Layout.EVERY_AXIS
    needs_clock = True
    nonlinear = ("time_constant",)
    meaning = "The bias settles after power-on."
    excitation = "recordings on one clock that begin within minutes of power-on"
    experiment = "repeat the sequence once the unit is warm, and return to the first pose at the end"
    source = "IEEE Std 952-2020, turn-on transient; exponential settling of first order"

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return A, axis by axis, and tau."""
        amplitudes = axis_parameters("A", unit_of(sensor), "bias at power-on above its final value")
        return (*amplitudes, Parameter("time_constant", "s", "time in which it falls to 37 %"))

    def starts(self, sensor: str) -> list[NDArray[np.float64]]:
        """Return a small grid of time constants."""
        del sensor
        return [np.array([0.0, 0.0, 0.0, tau]) for tau in STARTS_S]

    def stepped(self, values: NDArray[np.float64], step: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return ``values + step`` with the time constant at most halved or doubled."""
        new = values + step
        new[3] = np.clip(new[3], max(values[3] / 2.0, SHORTEST_S), min(values[3] * 2.0, LONGEST_S))
        return new

    def regressors(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return ``exp(-t / tau)``."""
        del sensor, K
        tau = values[3]
        decay: NDArray[np.float64] = np.exp(-motion.time / tau) if tau > 0 else np.zeros_like(motion.time)
        return decay[:, None]

    def columns(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the columns of A and ``A t / tau^2 exp(-t / tau)``, that of tau."""
        decay = self.regressors(sensor, motion, K, values)
        tau = values[3]
        slope = decay[:, 0] * motion.time / tau**2 if tau > 0 else np.zeros_like(motion.time)
        return np.concatenate([every_axis(decay), (slope[:, None] * values[:3])[:, :, None]], axis=2)

    def reading(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return ``A exp(-t / tau)``."""
        return self.regressors(sensor, motion, K, values) * values[:3]


EFFECT = WarmUp()
