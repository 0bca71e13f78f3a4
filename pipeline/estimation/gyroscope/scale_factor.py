"""Third stage of the staged gyroscope: scale factor (Sudsanguan 2019, eqs 3.52-3.53).

    S_i = I_i / (g_max - g_min),   g_sc = g_mis S

where, in the output of the stage before, g_max is what axis i reads while the table turns about it at the rate I_i, and
g_min what it reads at rest. The matrix of the stage before carries the scale already, so S is 1.000, as in every
printed table. Printed is ``I / g_max - g_min``; ``as_printed`` does it, which differs only where g_min is not zero.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

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
    return fit_stage("scale_factor", recordings, previous, settings)


def outcome(response: Response, *, as_printed: bool) -> Outcome:
    """Return what the stage finds in the response."""
    response.require_turns()
    g_min = response.rest
    g_max = g_min + response.rate * np.diag(response.slope)
    scale = response.rate / g_max - g_min if as_printed else response.rate / (g_max - g_min)
    values = {f"S_{axis}": (float(s), "1") for axis, s in zip(AXES, scale, strict=True)}
    return Outcome({"matrix": np.diag(scale).tolist()}, values)
