"""Bias that settles after power-on.

    z = A exp(-t / tau)

where A is (3,), g or deg/s, t the time since power-on, s, and tau the time constant, s; nothing is added at tau = 0.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.model.effects.base import Layout, every_axis
from pipeline.model.effects.formula_effect import DeclaredEffect
from pipeline.model.formula import c_number

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.records import Motion

STARTS_S = (60.0, 180.0, 500.0, 1500.0)  # of a part of some grams to a box of some kilograms, in steps of three
SHORTEST_S, LONGEST_S = 1.0, 1e5  # beyond these it is a step at the start, or a drift


class WarmUp(DeclaredEffect):
    """Exponential settling of the bias: one amplitude an axis and one time constant."""

    layout = Layout.EVERY_AXIS
    needs_clock = True
    nonlinear = ("time_constant",)

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

    def in_c(self, values: NDArray[np.float64]) -> list[str]:
        """Return ``A exp(-t / tau)`` of each axis as C expressions."""
        decay = f"(imu_real)exp(-m->time / {c_number(values[3])})" if values[3] > 0 else "0"
        return [f"{c_number(a)} * {decay}" for a in values[:3]]
