"""Second stage of the staged accelerometer: misalignment (Sudsanguan 2019, eqs 3.30-3.37).

While the table turns about an axis, that axis should stay level. What it reads instead gives the angle

    alpha = asin(a_height / a_max)   of x, beta of y, gamma of z

and all axes are multiplied by ``M_P = cos alpha_P cos beta_P cos gamma_P``, negative readings by M_N.

By default a_height is the amplitude of the axis's swing while the table turns about it, which a bias does not touch,
and a_max its largest reading without its bias, (a_max - a_min) / 2, the same on both sides: M_P = M_N. As printed it
is the mean of what the axis reads, bias and all, over a_max for M_P and over |a_min| for M_N, and the side is chosen by
the sign of the reading before its bias is removed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import NotObservableError
from pipeline.estimation.accelerometer.chain import Outcome, per_axis
from pipeline.estimation.accelerometer.staged import fit_stage
from pipeline.estimation.correction import two_sided
from pipeline.records import AXES

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from typing import Any

    from numpy.typing import NDArray

    from pipeline.estimation.accelerometer.extremes import Extremes
    from pipeline.records import Recording, SensorCalibration


def fit(
    recordings: Sequence[Recording], previous: SensorCalibration | None, settings: Mapping[str, Any]
) -> SensorCalibration:
    """Run the stage; see ``pipeline.estimation.accelerometer.staged.fit_stage``."""
    return fit_stage("misalignment", recordings, previous, settings)


def outcome(extremes: Extremes, gravity_g: float, *, as_printed: bool) -> Outcome:
    """Return what the stage finds in the extremes."""
    del gravity_g
    if as_printed:
        angles = {"P": _angles(extremes.height, extremes.a_max), "N": _angles(extremes.height, np.abs(extremes.a_min))}
        switch_at = np.zeros(3)
    else:
        both = _angles(extremes.height, (extremes.a_max - extremes.a_min) / 2.0)
        angles = {"P": both, "N": both}
        switch_at = extremes.a_zero
    positive, negative = (float(np.prod(np.cos(angles[side]))) * np.ones(3) for side in "PN")
    values = per_axis("M_P", positive, "1") | per_axis("M_N", negative, "1")
    for side in "PN":
        for name, angle in zip(("alpha", "beta", "gamma"), np.degrees(angles[side]), strict=True):
            values[f"{name}_{side}"] = (float(angle), "deg")
    mean = (positive + negative) / 2.0
    return Outcome([two_sided(positive, negative, switch_at)], values, mean, mean)


def _angles(height: NDArray[np.float64], largest: NDArray[np.float64]) -> NDArray[np.float64]:
    ratio = height / largest
    for axis, value in zip(AXES, ratio, strict=True):
        if not abs(value) < 1.0:
            raise NotObservableError(
                f"accelerometer {axis} reads {abs(value):.3g} times its largest reading while the table turns about "
                f"{axis}, where it should stay level: check sensor.axis_map, and which turn is about {axis}"
            )
    angles: NDArray[np.float64] = np.arcsin(ratio)
    return angles
