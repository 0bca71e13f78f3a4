"""First stage of the staged gyroscope: bias (Sudsanguan 2019, eqs 3.47-3.48).

    g_bi = g_r - b,   b = mean of the readings at rest

where the rests are those of the recordings made for the gyroscope, by the table's log, as in the thesis; the static
recording, which may lie far away in time and temperature, stands in only where these hold no rest.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.estimation.gyroscope.staged import Outcome, fit_stage
from pipeline.records import AXES

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from typing import Any

    from pipeline.estimation.gyroscope.response import Response
    from pipeline.records import Recording, SensorCalibration


def fit(
    recordings: Sequence[Recording], previous: SensorCalibration | None, settings: Mapping[str, Any]
) -> SensorCalibration:
    """Run the stage; see ``pipeline.estimation.gyroscope.staged.fit_stage``."""
    return fit_stage("bias", recordings, previous, settings)


def outcome(response: Response, *, as_printed: bool) -> Outcome:
    """Return what the stage finds in the response."""
    del as_printed
    values = {f"b_{axis}": (float(b), "deg/s") for axis, b in zip(AXES, response.rest, strict=True)}
    return Outcome({"subtract": response.rest.tolist()}, values)
