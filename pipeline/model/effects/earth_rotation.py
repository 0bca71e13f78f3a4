"""Earth's rotation, where the place and heading of the table are not configured.

    z = K R^T E

where E is (3,), deg/s, Earth's rotation along the level axes x, y, z (z up), R the rotation from body to level, and K
the inverse of the calibration matrix. The part along z looks exactly like an isotropic sensitivity to specific force.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.model.effects.base import Effect, Layout, Owner, Parameter

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pipeline.records import Motion


class EarthRotation(Effect):
    """Earth's rotation in the level frame: three coefficients."""

    name = "earth_rotation"
    owner = Owner.MOUNTING
    layout = Layout.SHARED
    sensors = ("gyroscope",)
    needs = ("level",)
    meaning = "The gyroscope reads Earth's rotation, which the base model leaves out."
    excitation = "rests or slow turns in which each axis points along level and vertical directions"
    experiment = (
        "configure table.latitude_deg and table.azimuth_deg; else repeat with the table's home turned about the "
        "vertical"
    )
    source = "IEEE Std 952-2020, Earth rate; 360 deg in 86164.0905 s"

    def parameters(self, sensor: str) -> tuple[Parameter, ...]:
        """Return E along the level axes."""
        del sensor
        return tuple(Parameter(f"E_{a}", "deg/s", f"Earth's rotation along level {a}") for a in "xyz")

    def regressors(
        self, sensor: str, motion: Motion, K: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return K times the level axes in the body frame."""
        del sensor, values
        assert motion.level is not None  # noqa: S101
        return K @ motion.level.transpose(0, 2, 1)


EFFECT = EarthRotation()
