"""Second stage of the staged gyroscope: orthogonality and misalignment together (Sudsanguan 2019, eqs 3.49-3.51).

    S M = diag(I),   M = S^-1 diag(I),   g_mis = g_bi M

where row i of S is the reading of (x, y, z), without bias, while the table turns about axis i at the rate I_i, and
readings g are row vectors; as the contract's ``matrix`` acts on columns, it is M transposed. With turns at several
rates and in both directions, S is I times the slopes of the readings against the signed rate, so ``M = R^-1``.

Printed is ``M = diag(I) S^-1`` (3.50), which (3.49) and (3.51) contradict; ``as_printed`` does it. It differs only
where the rates about the axes do.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.estimation.gyroscope.staged import Outcome, fit_stage

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from typing import Any

    from pipeline.estimation.gyroscope.response import Response
    from pipeline.records import Recording, SensorCalibration


def fit(
    recordings: Sequence[Recording], previous: SensorCalibration | None, settings: Mapping[str, Any]
) -> SensorCalibration:
    """Run the stage; see ``pipeline.estimation.gyroscope.staged.fit_stage``."""
    return fit_stage("orthogonality_and_misalignment", recordings, previous, settings)


def outcome(response: Response, *, as_printed: bool) -> Outcome:
    """Return what the stage finds in the response."""
    response.require_turns()
    rate = np.diag(response.rate)
    S = rate @ response.slope
    M = np.linalg.solve(S.T, rate).T if as_printed else np.linalg.solve(S, rate)
    values = {f"M_{i + 1}{j + 1}": (float(M[i, j]), "1") for i in range(3) for j in range(3)}
    return Outcome({"matrix": M.T.tolist()}, values)
