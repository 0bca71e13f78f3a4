"""The uncertainty budget of a fit to recordings on a table: noise, quantisation, and the table's stated accuracies."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.estimation.budget import combined, quantisation
from pipeline.estimation.table_inputs import table_contributions
from pipeline.records.calibration import UNITS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.estimation.serial_noise import SerialNoise
    from pipeline.estimation.table_inputs import Reference
    from pipeline.records import SensorCalibration
    from pipeline.records.budget import Contribution

TEMPERATURE = "the parameters hold at the temperature of these recordings; no accuracy of the thermometer is stated"
TIME_BASE = "the table logs angle and rate itself, so that a wrong clock changes neither"


def budgeted(
    calibration: SensorCalibration,
    reference: Reference,
    noise: SerialNoise,
    contributions: Sequence[Contribution],
    settings: Mapping[str, Any],
) -> SensorCalibration:
    """Return a calibration with its uncertainty budget.

    Parameters
    ----------
    calibration : SensorCalibration
    reference : Reference
    noise : SerialNoise
    contributions : sequence of Contribution
        Those of the readings' scatter.
    settings : mapping
        Section ``sensor``, for the size of a count.
    """
    sensor = calibration.sensor
    lines, missing = list(contributions), {"temperature": TEMPERATURE, "time base": TIME_BASE}
    sheet = (settings.get("sensor") or {}).get(sensor) or {}
    rounded = quantisation(noise, reference.fit, sheet.get("counts_per_unit"), UNITS[sensor])
    if isinstance(rounded, str):
        missing["quantisation"] = rounded
    else:
        lines.append(rounded)
    found, absent = table_contributions(reference)
    return combined(calibration, [*lines, *found], {**absent, **missing})
