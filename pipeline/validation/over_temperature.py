"""The residual of a calibration over the temperature of the sensor, where that was swept.

Errors of the magnitude after the last step are averaged in bins of the temperature: their mean shows what still depends
on it, their root mean square what noise adds.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.validation.error_breakdown import last_error_of_magnitude

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from pipeline.records import Recording, SensorCalibration
    from pipeline.validation.samples import Samples

WIDTH = 5.0  # degC of a bin; a bias that follows the temperature by 1 mg/degC (MPU-6050) changes by 5 mg within it
SWEPT = 2 * WIDTH  # degC: a range that fills two bins; a unit that warms up on the bench changes by less
FEWEST = 10  # samples of a bin that is shown


def is_swept(recordings: Iterable[Recording]) -> bool:
    """Return whether the temperature of the recordings may have been swept: it spans ``SWEPT`` in all of them."""
    warmth = [r.temperature[np.isfinite(r.temperature)] for r in recordings if r.temperature is not None]
    return bool(np.ptp(np.concatenate([np.zeros(0), *warmth])) >= SWEPT) if any(map(len, warmth)) else False


def residuals_over_temperature(
    calibration: SensorCalibration, samples: Sequence[Samples], other: SensorCalibration | None
) -> list[dict[str, Any]] | None:
    """Return the bins: ``temperature_degc`` (mean), ``mean_error, rms_error`` (g or deg/s) and ``samples`` of each.

    None where the temperature is not recorded, or its range is below ``SWEPT``.
    """
    temperatures, errors = [np.zeros(0)], [np.zeros(0)]
    for each in samples:
        error = last_error_of_magnitude(calibration, each, other)
        if error is None or each.temperature is None:
            return None
        known = each.known & np.isfinite(error) & np.isfinite(each.temperature)
        temperatures.append(each.temperature[known])
        errors.append(error[known])
    warmth, error = np.concatenate(temperatures), np.concatenate(errors)
    if len(warmth) == 0 or np.ptp(warmth) < SWEPT:
        return None
    place = np.floor(warmth / WIDTH)
    return [
        {
            "temperature_degc": float(warmth[here].mean()),
            "mean_error": float(error[here].mean()),
            "rms_error": float(np.sqrt(np.mean(error[here] ** 2))),
            "samples": int(here.sum()),
        }
        for number in np.unique(place)
        if (here := place == number).sum() >= FEWEST
    ]
