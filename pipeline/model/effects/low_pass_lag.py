"""A low-pass filter inside the sensor.

    reading(t) = model(u'),    u'(t) = integral_0^inf exp(-s / tau) / tau u(t - s) ds,    z = K [u'(t) - u(t)]

where tau is the time constant of the filter, s (0 and more), u the truth, g or deg/s, and K the inverse of the
calibration matrix. A turn's rate is taken through the lag exactly; other signals by a Gauss-Laguerre sum, which is
exact where they are polynomials of degree 7 in time.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from pipeline.model.effects.base import Effect, Layout, Owner, Parameter, truth, truth_rate
from pipeline.model.effects.time_offset import shifted

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.records import Motion

NODES, WEIGHTS = np.polynomial.laguerre.laggauss(4)
STEP_S = 1e-5


class LowPassLag(Effect):
    """A first-order lag: one coefficient."""

    name = "low_pass_lag"
    owner = Owner.TABLE
    layout = Layout.SHARED
    nonlinear = ("tau",)
    meaning = "A low-pass filter inside the sensor makes it lag behind the motion."
    excitation = "readings while the table turns at 10 deg/s and more, or while it speeds up and slows down"
    experiment = "turn in both directions with fast ramps (30 deg/s and more): a delay and a lag differ only there"
    source = "MPU-6000/6050 register map, DLPF_CFG, delay of 1 to 19 ms; first-order lag"

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return tau."""
        del sensor
        return (Parameter("tau", "s", "time constant of the filter"),)

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
        return (slope @ K.T)[:, :, None]

    def reading(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return ``K [u'(t) - u(t)]``."""
        change = truth(sensor, self.moved(motion, values)) - truth(sensor, motion)
        added: NDArray[np.float64] = change @ K.T
        return added

    def moved(self, motion: Motion, values: NDArray[np.float64]) -> Motion:
        """Return the motion that a sensor with this lag feels."""
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
        """Return what the sensor feels at ``time + offset``."""
        return self.moved(shifted(motion, offset), values)


EFFECT = LowPassLag()
