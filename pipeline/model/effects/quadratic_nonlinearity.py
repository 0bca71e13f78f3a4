"""Scale factor nonlinearity of second order.

    z_c = K2_c u_c^2,    c = x, y, z

where K2 is (3,), 1/g or 1/(deg/s), and u the truth, g or deg/s. A best-fit-straight-line nonlinearity h at full scale
FS is K2 = 2 h / FS^2.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.model.effects.base import Effect, Layout, Owner, Parameter, axis_parameters, per_unit_of, truth

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pipeline.records import Motion


class QuadraticNonlinearity(Effect):
    """Second-order nonlinearity: one coefficient an axis."""

    name = "quadratic_nonlinearity"
    owner = Owner.SENSOR
    layout = Layout.PER_AXIS
    meaning = "The reading bends with the square of what is measured."
    excitation = "each axis at several inclinations, or turned at several rates in both directions"
    experiment = (
        "look at more than 1 g (centrifuge) or at several rates in both directions: |u| and u^2 are nearly alike "
        "on a 1 g circle"
    )
    source = "IEEE Std 1293-2018, K2 (second-order nonlinearity coefficient)"

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return K2, axis by axis."""
        return axis_parameters("K2", per_unit_of(sensor), "second-order coefficient")

    def regressors(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return u^2."""
        del K, values
        return truth(sensor, motion)[:, :, None] ** 2


EFFECT = QuadraticNonlinearity()
