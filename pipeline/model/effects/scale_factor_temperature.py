"""Scale factor that follows the temperature.

    z_c = k_T,c (T - 25 degC) u_c,    c = x, y, z

where k_T is (3,), 1/degC, T the smoothed temperature, degC, and u the truth, g or deg/s.
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
    truth,
)

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pipeline.records import Motion


class ScaleFactorTemperature(Effect):
    """Linear change of scale factor with temperature: one coefficient an axis."""

    name = "scale_factor_temperature"
    owner = Owner.SENSOR
    layout = Layout.PER_AXIS
    needs = ("temperature",)
    meaning = "The scale factor changes in proportion to the temperature."
    excitation = "each axis up and down (or turned both ways) at temperatures some degrees apart"
    experiment = "repeat the sequence of turns at a second steady temperature"
    source = (
        "IEEE Std 1293-2018, scale factor temperature sensitivity; MPU-6000/6050 product specification 6.2, "
        "+-0.02 %/degC"
    )

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return k_T, axis by axis."""
        del sensor
        return axis_parameters("k_T", "1/degC", "relative change of scale factor per degC")

    def regressors(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return (T - 25 degC) u."""
        del K, values
        return (temperature_difference(motion)[:, None] * truth(sensor, motion))[:, :, None]


EFFECT = ScaleFactorTemperature()
