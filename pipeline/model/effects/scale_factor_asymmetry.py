"""Scale factors that differ between positive and negative readings.

    z_c = c_c |u_c|,    c = x, y, z

where c is (3,), dimensionless, and u the truth, g or deg/s. With the thesis's scale factors P and N of positive and
negative readings c = (1/P - 1/N) / 2, and the matrix holds k = (1/P + 1/N) / 2.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.model.effects.base import Effect, Layout, Owner, Parameter, axis_parameters, truth

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipeline.records import Motion


class ScaleFactorAsymmetry(Effect):
    """Scale factor asymmetry: one coefficient an axis."""

    name = "scale_factor_asymmetry"
    owner = Owner.SENSOR
    layout = Layout.PER_AXIS
    meaning = "Positive and negative readings have different scale factors."
    excitation = "each axis up and down, or turned in both directions"
    experiment = (
        "look at more than 1 g (centrifuge) or at several rates in both directions: |u| and u^2 are nearly alike "
        "on a 1 g circle"
    )
    source = "IEEE Std 528-2019, scale factor asymmetry; Sudsanguan 2019, eqs 3.40 to 3.43 and fig. 3.13"

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return c, axis by axis."""
        del sensor
        return axis_parameters("c", "1", "half the difference of the positive and negative scale factors")

    def regressors(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return |u|."""
        del K, values
        return np.abs(truth(sensor, motion))[:, :, None]


EFFECT = ScaleFactorAsymmetry()
