"""The uncertainty budget of a fit to recordings on a table: noise, quantisation, and the table's stated accuracies."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from pipeline.estimation.budget import candidate_covariances, combined, quantisation
from pipeline.estimation.table_inputs import table_contributions
from pipeline.estimation.trials import Errors, beside_trials, trials_of
from pipeline.records import SENSOR_UNITS

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from pipeline.estimation.residual_noise import ResidualNoise
    from pipeline.estimation.table_inputs import Reference
    from pipeline.records import Contribution, SensorCalibration

    Values = NDArray[np.float64]

TEMPERATURE = "the parameters hold at the temperature of these recordings; no accuracy of the thermometer is stated"
TIME_BASE = "the table logs angle and rate itself, so that a wrong clock changes neither"


def budgeted(  # noqa: PLR0917  (what a fit on a table is)
    calibration: SensorCalibration,
    reference: Reference,
    noise: ResidualNoise,
    contributions: Sequence[Contribution],
    settings: Mapping[str, Any],
    results: Callable[[Values], Values],
) -> SensorCalibration:
    """Return a calibration with its uncertainty budget, and a Monte Carlo run beside it where that is asked for.

    Parameters
    ----------
    calibration : SensorCalibration
    reference : Reference
    noise : ResidualNoise
    contributions : sequence of Contribution
        Those of the readings' scatter.
    settings : mapping
        Sections ``sensor``, for the size of a count, and ``uncertainty``.
    results : callable
        (t, q) values of what the fit's map makes of the channels, one after the other, to (t, p) parameters.
    """
    sensor = calibration.sensor
    lines, missing = list(contributions), {"temperature": TEMPERATURE, "time base": TIME_BASE}
    sheet = (settings.get("sensor") or {}).get(sensor) or {}
    rounded = quantisation(noise, reference.fit, sheet.get("counts_per_unit"), SENSOR_UNITS[sensor])
    if isinstance(rounded, str):
        missing["quantisation"] = rounded
    else:
        lines.append(rounded)
    found, absent = table_contributions(reference)
    complete = combined(calibration, [*lines, *found], {**absent, **missing})
    trials = trials_of(settings)
    if not trials:
        return complete
    first = reference.fit.first()
    stated = table_contributions(replace(reference, fit=first))[0]
    again = quantisation(noise, first, sheet.get("counts_per_unit"), SENSOR_UNITS[sensor])
    stated += [] if isinstance(again, str) else [again]
    errors = Errors(noise.weight, candidate_covariances(noise, first), noise.spare, stated)
    return beside_trials(complete, errors.through(results), trials, contributions[1:])
