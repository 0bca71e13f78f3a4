"""Third stage of the staged accelerometer: bias (Sudsanguan 2019, eqs 3.38-3.39).

    a_bi = a_mis - b,   b = a_zero

where a_zero is the mean reading of each axis where it is level, in the output of the stage before.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.estimation.accelerometer.chain import Outcome, per_axis
from pipeline.estimation.accelerometer.staged import fit_stage

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from typing import Any

    from pipeline.estimation.accelerometer.extremes import Extremes
    from pipeline.records import Recording, SensorCalibration


def fit(
    recordings: Sequence[Recording], previous: SensorCalibration | None, settings: Mapping[str, Any]
) -> SensorCalibration:
    """Run the stage; see ``pipeline.estimation.accelerometer.staged.fit_stage``."""
    return fit_stage("bias", recordings, previous, settings)


def outcome(extremes: Extremes, gravity_g: float, *, as_printed: bool) -> Outcome:
    """Return what the stage finds in the extremes."""
    del gravity_g, as_printed
    bias = extremes.a_zero
    return Outcome([{"subtract": bias.tolist()}], per_axis("b", bias, "g"), subtracted=bias)
