"""Stage fit: one sensor, one stage of its method, on the result of the stage before it.

``pipeline.estimation.stages`` finds the module that does the work.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.errors import CannotCalibrateError
from pipeline.estimation.stages import fit_stage
from pipeline.estimation.uncertainty_budget import with_stated
from pipeline.files import read_json, write_json
from pipeline.io.parquet import load_recordings
from pipeline.records import SensorCalibration
from pipeline.stages.unit_files import load_noises

if TYPE_CHECKING:
    from pipeline.stages.batch import Job

NOT_LAST = "no"  # value of the option --last


def process_unit(job: Job, unit: str, settings: dict[str, Any]) -> None:
    """Fit the parameters of the stage; ``{"not_calibrated": reason}`` where the recordings cannot determine them."""
    sensor, stage, previous = (job.run[key] for key in ("sensor", "stage", "previous"))
    target = job.output / f"{unit}.json"
    before = read_json(Path(previous) / f"{unit}.json") if previous else None
    if before and "not_calibrated" in before:
        write_json(target, before)
        return
    fitted = SensorCalibration.from_json(sensor, before) if before else None
    recordings = load_recordings(job.inputs["filter"] / f"{unit}.parquet")
    noises = load_noises(job.inputs["filter"], unit)
    try:
        found = fit_stage(sensor, stage, recordings, fitted, settings | {"noise": noises})
        # not before the last stage, which would take it over and count it twice; a given calibration states its own
        if job.run["last"] != NOT_LAST and stage != "given":
            found = with_stated(found, recordings, settings)
        write_json(target, found.to_json())
    except CannotCalibrateError as reason:
        write_json(target, {"not_calibrated": reason.message})
