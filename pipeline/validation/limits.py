"""Pass or fail of one sensor, by the limits that its configuration sets.

    held_out_rms_error, held_out_mean_abs_error, held_out_max_abs_error : of the last step
    bias         : largest |bias_i|, unit of the sensor
    scale_factor : largest |matrix_ii - 1|

A limit that is null is not checked; a figure that is not known does not pass.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pipeline.records import SensorCalibration


def check_limits(
    calibration: SensorCalibration, part: Mapping[str, Any], limits: Mapping[str, float | None] | None
) -> tuple[list[dict[str, Any]], bool | None]:
    """Return each limit beside its figure, and whether all are kept (None: there is no limit).

    Parameters
    ----------
    calibration : SensorCalibration
    part : mapping
        The sensor's validation.
    limits : mapping or None
        Name to limit.

    Raises
    ------
    ConfigurationError
        If a limit's name is unknown.
    """
    last = part["steps"][-1]
    ends = [abs(v) for v in (last["max_error"], last["min_error"]) if v is not None]
    figures = {
        "held_out_rms_error": last["rms_error"],
        "held_out_mean_abs_error": last["mean_abs_error"],
        "held_out_max_abs_error": max(ends, default=None),
        "bias": float(np.max(np.abs(calibration.bias))),
        "scale_factor": float(np.max(np.abs(np.diag(calibration.matrix) - 1.0))),
    }
    checks = []
    for name, limit in (limits or {}).items():
        if name not in figures:
            raise ConfigurationError(f"limits.{calibration.sensor}.{name} is unknown; known: {', '.join(figures)}")
        if limit is not None:
            value = figures[name]
            kept = value is not None and bool(value <= limit)
            checks.append({"name": name, "limit": float(limit), "value": value, "pass": kept})
    return checks, (all(c["pass"] for c in checks) if checks else None)
