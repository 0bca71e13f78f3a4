"""Fourth stage of the staged accelerometer: a scale factor for each side (Sudsanguan 2019, eqs 3.40-3.43).

    S_P = G / (a_max - a_zero),   S_N = G / |a_min - a_zero|,   a_sc = a_bi S

where a_max, a_min, a_zero are those of the stage's input and G is local gravity. Printed is ``G / a_max - a_zero``, and
a_zero is subtracted once more in (3.42) and (3.43); ``as_printed`` does both, which is harmless after the bias stage,
where a_zero is about zero.
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

    from pipeline.estimation.accelerometer.extremes import Extremes
    from pipeline.records import Recording, SensorCalibration


def fit(
    recordings: Sequence[Recording], previous: SensorCalibration | None, settings: Mapping[str, Any]
) -> SensorCalibration:
    """Run the stage; see ``pipeline.estimation.accelerometer.staged.fit_stage``."""
    return fit_stage("scale_factor", recordings, previous, settings)


def outcome(extremes: Extremes, gravity_g: float, *, as_printed: bool) -> Outcome:
    """Return what the stage finds in the extremes."""
    a_max, a_min, a_zero = extremes.a_max, extremes.a_min, extremes.a_zero
    if as_printed:
        positive, negative = gravity_g / a_max - a_zero, gravity_g / np.abs(a_min) - a_zero
        subtracted, switch_at = a_zero, np.zeros(3)
        steps = [{"subtract": a_zero.tolist()}]
    else:
        positive, negative = gravity_g / (a_max - a_zero), gravity_g / np.abs(a_min - a_zero)
        subtracted, switch_at = np.zeros(3), a_zero
        steps = []
    steps.append(two_sided(positive, negative, switch_at))
    values = per_axis("S_P", positive, "1") | per_axis("S_N", negative, "1")
    return Outcome(steps, values, positive, negative, subtracted)
