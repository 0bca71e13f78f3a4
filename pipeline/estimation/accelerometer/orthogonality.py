"""First stage of the staged accelerometer: orthogonality (Sudsanguan 2019, eqs 3.15-3.29).

In turns about x, y, z the upper extremes of the two other axes should be 90 deg apart; their excesses are

    alpha_P = (A - B) - 90,   beta_P, gamma_P likewise;   alpha_N, beta_N, gamma_N of the lower extremes

where A and B are the table angles at which the first and the second axis of the pairs (y, z), (z, x), (x, y) read most.
Readings above the level reading are multiplied by O_P, those below by O_N; with x as the reference axis

    O = diag(1, cos gamma, cos alpha cos beta)

Two printed details are offered only as ``as_printed``, to reproduce a table: (3.26),
``O = diag(cos beta cos gamma, cos alpha cos gamma, cos alpha cos beta)``, which contradicts x being the reference and
every printed O_x = 1; and the choice of the side by the sign of the reading before its bias is removed.

A filter that delays the readings delays both extremes of a pair by the same angle as long as the table turns evenly,
so the excesses do not feel it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.estimation.accelerometer.chain import Outcome, per_axis
from pipeline.estimation.accelerometer.staged import fit_stage
from pipeline.estimation.correction import two_sided

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
    return fit_stage("orthogonality", recordings, previous, settings)


def outcome(extremes: Extremes, gravity_g: float, *, as_printed: bool) -> Outcome:
    """Return what the stage finds in the extremes."""
    del gravity_g
    positive = _factors(extremes.excess_high, as_printed=as_printed)
    negative = _factors(extremes.excess_low, as_printed=as_printed)
    switch_at = np.zeros(3) if as_printed else extremes.a_zero
    values = per_axis("O_P", positive, "1") | per_axis("O_N", negative, "1")
    for side, excess in (("P", extremes.excess_high), ("N", extremes.excess_low)):
        for name, angle in zip(("alpha", "beta", "gamma"), excess, strict=True):
            values[f"{name}_{side}"] = (float(angle), "deg")
    mean = (positive + negative) / 2.0
    return Outcome([two_sided(positive, negative, switch_at)], values, mean, mean)


def _factors(excess_deg: NDArray[np.float64], *, as_printed: bool) -> NDArray[np.float64]:
    a, b, c = np.cos(np.radians(excess_deg))
    if as_printed:
        return np.array([b * c, a * c, a * b])
    return np.array([1.0, c, a * b])
