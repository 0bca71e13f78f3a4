"""Bias that follows the temperature along a parabola.

    z = b_T1 (T - 25 degC) + b_T2 (T - 25 degC)^2

where b_T1 is (3,), g/degC or (deg/s)/degC, b_T2 (3,) per degC^2, and T the smoothed temperature, degC.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.model.effects.base import Effect, Layout, Owner, Parameter, temperature_difference, unit_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.records import Motion


class BiasTemperatureQuadratic(Effect):
    """Quadratic change of bias with temperature: two coefficients an axis."""

    name = "bias_temperature_quadratic"
    owner = Owner.SENSOR
    layout = Layout.EVERY_AXIS
    needs = ("temperature",)
    contains = ("bias_temperature",)
    meaning = "The bias changes with the temperature along a parabola."
    excitation = "a temperature that changes by ten degrees and more while it is recorded"
    experiment = "heat and cool over a wider span, and so that the temperature does not simply rise with time"
    source = "IEEE Std 1293-2018, bias temperature model of second order"

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return b_T1 and b_T2, axis by axis."""
        unit = unit_of(sensor)
        return tuple(
            Parameter(f"b_T{power}_{a}", f"{unit}/degC{'^2' if power == 2 else ''}", f"bias per degC^{power}, {a} axis")
            for a in "xyz"
            for power in (1, 2)
        )

    def regressors(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return T - 25 degC and its square."""
        del sensor, K, values
        difference = temperature_difference(motion)
        return np.column_stack([difference, difference**2])


EFFECT = BiasTemperatureQuadratic()
