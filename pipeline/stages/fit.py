"""Stage fit: fit one stage of a method, by the module that ``pipeline.estimation.stages`` finds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.errors import CannotCalibrateError
from pipeline.estimation.stages import fit_stage
from pipeline.estimation.stated_lines import with_stated
from pipeline.records import SensorCalibration
from pipeline.stages.unit_files import load_noises, recordings_of

if TYPE_CHECKING:
    from pipeline.pack import Files
    from pipeline.stages.batch import Job

NOT_LAST = "no"  # value of the option --last


def fit_unit(job: Job, unit: str, settings: dict[str, Any]) -> Files:
    """Fit one stage of a method to one sensor, on the result of the stage before it.

    The result is ``{"not_calibrated": reason}`` where the recordings cannot determine the parameters.
    """
    sensor, stage, file = job.run["sensor"], job.run["stage"], f"{unit}.json"
    before = job.inputs["previous"].json(file) if "previous" in job.inputs else None
    if before and "not_calibrated" in before:
        return {file: before}
    fitted = SensorCalibration.from_json(sensor, before) if before else None
    recordings = recordings_of(job.inputs, unit)
    settings = settings | {"noise": load_noises(job.inputs["filter"], unit)}
    try:
        found = fit_stage(sensor, stage, recordings, fitted, settings)
        # only after the last stage, or it would be counted twice; a given calibration states its own uncertainty
        if job.run["last"] != NOT_LAST and stage != "given":
            found = with_stated(found, recordings, settings)
        return {file: found.to_json()}
    except CannotCalibrateError as reason:
        return {file: {"not_calibrated": reason.message}}
