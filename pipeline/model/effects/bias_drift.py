"""Bias that drifts steadily through the recordings.

    z = d t

where d is (3,), g/s or (deg/s)/s, and t the time since power-on, s.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.model.effects.base import Effect, Layout, Owner, Parameter, axis_parameters, unit_of

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pipeline.records import Motion


class BiasDrift(Effect):
    """Linear drift of the bias with time: one coefficient an axis."""

    name = "bias_drift"
    owner = Owner.RECORDING
    layout = Layout.EVERY_AXIS
    needs_clock = True
    meaning = "The bias drifts steadily with time."
    excitation = "recordings on one clock, an hour and more from first to last"
    experiment = "return to the first pose at the end and hold the temperature steady: what remains is drift"
    source = "IEEE Std 952-2020, rate ramp"

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return d, axis by axis."""
        return axis_parameters("d", f"{unit_of(sensor)}/s", "drift of the bias")

    def regressors(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return t."""
        del sensor, K, values
        return motion.time[:, None]


EFFECT = BiasDrift()
