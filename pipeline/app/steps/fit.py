"""Step fit: fit one stage of a method, by the module that ``pipeline.estimation.stages`` finds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from pipeline.checks.reference_scale import rate_error
from pipeline.core.errors import CannotCalibrateError
from pipeline.core.records import Fit, NotCalibrated, UnitRecordings
from pipeline.core.settings import Settings
from pipeline.estimation.stages import GIVEN, fit_stage
from pipeline.estimation.stated_lines import with_stated

if TYPE_CHECKING:
    from pipeline.app.steps.batch import Job


def fit_reads(job: Job, unit: str, settings: Settings) -> str:  # noqa: ARG001
    """Return the last stage of the fit of a unit."""
    return str(job.run["last"][unit])


def fit(
    recordings: UnitRecordings, fits: Mapping[str, Fit], settings: Settings, *, sensor: str, stage: str, last: bool
) -> Fit:
    """Fit one stage of a method to one sensor, on the result of the stage before it in ``fits``.

    ``last``: whether it is the last stage of the sensor. The result is ``NotCalibrated`` where the recordings cannot
    determine the parameters.
    """
    previous = fits.get(sensor)
    if isinstance(previous, NotCalibrated):
        return previous
    try:
        found = fit_stage(sensor, stage, recordings, previous, settings)
        if not last or stage == GIVEN:  # it would be counted twice; a given calibration states its own uncertainty
            return found
        off = rate_error(recordings.filtered, settings.table) if sensor == "gyroscope" else 0.0
        return with_stated(found, recordings, settings, off)
    except CannotCalibrateError as reason:
        return NotCalibrated(reason.message)
