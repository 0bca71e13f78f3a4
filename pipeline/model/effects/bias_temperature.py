"""Bias that follows the temperature.

    z = b_T (T - 25 degC)

where b_T is (3,), g/degC or (deg/s)/degC, and T the smoothed temperature, degC.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.model.effects.base import (
    Effect,
    Layout,
    Owner,
    Parameter,
    axis_parameters,
    temperature_difference,
    unit_of,
)

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pipeline.records import Motion


class BiasTemperature(Effect):
    """Linear change of bias with temperature: one coefficient an axis."""

    name = "bias_temperature"
    owner = Owner.SENSOR
    layout = Layout.EVERY_AXIS
    needs = ("temperature",)
    meaning = "The bias changes in proportion to the temperature."
    excitation = "a temperature that changes by some degrees while it is recorded"
    experiment = (
        "heat and cool so that the temperature does not simply rise with time (fan, lamp), or repeat the sequence"
        " once it is steady"
    )
    source = (
        "IEEE Std 1293-2018 and 952-2020, bias temperature sensitivity; MPU-6000/6050 product specification 6.1, 6.2"
    )

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return b_T, axis by axis."""
        return axis_parameters("b_T", f"{unit_of(sensor)}/degC", "bias per degC")

    def regressors(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return T - 25 degC."""
        del sensor, K, values
        return temperature_difference(motion)[:, None]


EFFECT = BiasTemperature()
