"""Scale factor nonlinearity of third order.

    z_c = K3_c u_c^3,    c = x, y, z

where K3 is (3,), 1/g^2 or 1/(deg/s)^2, and u the truth, g or deg/s.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.model.effects.base import Effect, Layout, Owner, Parameter, axis_parameters, per_unit_of, truth

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pipeline.records import Motion


class CubicNonlinearity(Effect):
    """Third-order nonlinearity: one coefficient an axis."""

    name = "cubic_nonlinearity"
    owner = Owner.SENSOR
    layout = Layout.PER_AXIS
    meaning = "The reading bends with the cube of what is measured."
    excitation = "each axis at many inclinations, or turned at several rates"
    experiment = "look at more than 1 g (centrifuge) or at a wider span of rates in both directions"
    source = "IEEE Std 1293-2018, K3 (third-order nonlinearity coefficient)"

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return K3, axis by axis."""
        return axis_parameters("K3", per_unit_of(sensor, 2), "third-order coefficient")

    def regressors(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return u^3."""
        del K, values
        u = truth(sensor, motion)[:, :, None]
        return u * u * u


EFFECT = CubicNonlinearity()
