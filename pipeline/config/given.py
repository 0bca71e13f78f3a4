"""The calibration that ``method=given`` takes from a file, as a part of the configuration.

The content of the file is a setting: where it changes, exactly the stages that read it run again.
"""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, Any

from pipeline.config.options import Problem
from pipeline.config.schema import OF_BENCH
from pipeline.errors import PipelineError
from pipeline.history import SENSORS

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

GIVEN = "given"  # the method


def with_given(config: Mapping[str, Any], campaign: Path, unit: str) -> dict[str, Any]:
    """Return the sections ``method`` and ``effects`` of a unit, with the calibration that its file holds.

    ``method.given``: ``source`` (for texts), ``sha256``, ``notes``, and each sensor's bias, matrix, effects and
    uncertainties as in ``calibrations/<unit>.json``. The effects of the file that belong to the sensor are those of
    the model. Raises ``Problem``.
    """
    from pipeline.exports.reading import counts_of, read_any  # noqa: PLC0415  (only for this method)
    from pipeline.model.effects import owner_of  # noqa: PLC0415  (as above)
    from pipeline.model.effects.base import Owner  # noqa: PLC0415  (as above)

    method, effects = dict(config["method"]), dict(config["effects"])
    if not method["file"]:
        raise Problem("method=given: method.file is not set; name the calibration, in any format of docs/exports.md")
    if stated := [f"table.{key}" for key in OF_BENCH if config["table"].get(key)]:
        raise Problem(f"method=given: {stated[0]} is set, which a fit would estimate; nothing is fitted: set it null")
    file = campaign / method["file"].replace("{unit}", unit)
    try:
        found = read_any(file, method["format"], counts_of(config["sensor"]))
        digest = hashlib.sha256(file.read_bytes()).hexdigest()
    except PipelineError as error:
        raise Problem(f"method.file: {error}") from error
    given: dict[str, Any] = {"source": f"{file.name} ({found.name})", "sha256": digest, "notes": found.notes}
    for sensor in SENSORS:
        if method[sensor] != GIVEN:
            continue
        if effects[sensor]:
            raise Problem(
                f"effects.{sensor}: method=given takes the effects from its file; to fit effects, choose another method"
            )
        calibration = found.sensors.get(sensor)
        if calibration is None:
            given[sensor] = None
            continue
        own = [e for e in calibration.effects if owner_of(e) == Owner.SENSOR]
        effects[sensor] = [e.name for e in own]
        part = calibration.to_json() | {"stages": []}
        part["uncertain"] = calibration.covariance is not None
        part["of_the_bench"] = [e.name for e in calibration.effects if e not in own]
        given[sensor] = part
    return {"method": {**method, "given": given}, "effects": effects}
