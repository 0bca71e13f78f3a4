"""Stage given: no fit, but bias, matrix and effects of an existing calibration (``method=given``).

The recordings take no part in it; they judge it, by validation and diagnosis. Its uncertainty is what its file states.
Where that states none, none is known: the covariance is zero, the budget says so, and what noise cannot explain on
held-out motion is a departure of the given calibration.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import CannotCalibrateError
from pipeline.estimation.uncertainty_budget import base_parameters, combined
from pipeline.records import NORMAL, Contribution, SensorCalibration, StageResult

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.records import Recording

SOURCE = "given calibration"


def fit(
    sensor: str, _recordings: Sequence[Recording], _previous: SensorCalibration | None, settings: Mapping[str, Any]
) -> SensorCalibration:
    """Return the given calibration of a sensor, as its configuration holds it (``method.given``).

    Effects of mounting, place, table and timing belong to the bench of the file's own recordings: they are left out,
    and the stage names them. Raises ``CannotCalibrateError`` where the file holds nothing of the sensor.
    """
    given = settings["method"]["given"]
    part, source = given[sensor], given["source"]
    if part is None:
        raise CannotCalibrateError(f"the given calibration {source} holds nothing of the {sensor}")
    found = SensorCalibration.from_json(sensor, part)
    bench = part["of_the_bench"]
    kept = [i for i, name in enumerate(found.parameter_names()) if name.partition(".")[0] not in bench]
    assert found.covariance is not None  # noqa: S101  (JSON holds zeros where none is known)
    covariance = found.covariance[np.ix_(kept, kept)]
    calibration = SensorCalibration(
        sensor,
        found.bias,
        found.matrix,
        effects=tuple(e for e in found.effects if e.name not in bench),
        stages=(
            StageResult(
                "given",
                base_parameters(sensor, found.bias, found.matrix, covariance[:12, :12]),
                details={"source": source, "sha256": given["sha256"], "notes": given["notes"], "left_out": bench},
            ),
        ),
    )
    if not part["uncertain"]:
        return combined(
            calibration, [], {SOURCE: f"{source} states no uncertainty: none is known, and zeros stand for it"}
        )
    freedom = np.full(len(kept), np.inf) if found.freedom is None else found.freedom[kept]
    line = Contribution(SOURCE, "B", NORMAL, covariance, freedom, remark=f"as {source} states it")
    return combined(calibration, [line], {})
