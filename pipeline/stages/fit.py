"""Stage of a fit: one sensor, one stage of its method, on the result of the stage before it.

The module ``pipeline.estimation.<sensor>.<stage>`` does the work; its name in a method's list is all that a new stage
needs.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.errors import CannotCalibrateError
from pipeline.estimation.stated import with_stated
from pipeline.io.parquet import load_recordings
from pipeline.records import SensorCalibration
from pipeline.stages.batch import parse_job, read_json, run_batch, write_json
from pipeline.stages.noises import load_noises

if TYPE_CHECKING:
    from collections.abc import Sequence


NOT_LAST = "no"


def main(argv: Sequence[str]) -> int:
    """Run the stage."""
    job = parse_job("fit", argv, ["filter"], ["sensor", "stage", "previous", "last"])
    sensor, stage = job.run["sensor"], job.run["stage"]
    module = import_module(f"pipeline.estimation.{sensor}.{stage}")
    if job.run["previous"]:
        job.inputs["previous"] = Path(job.run["previous"])

    def work(unit: str, part: dict[str, Any]) -> None:
        target = job.output / f"{unit}.json"
        before = read_json(job.inputs["previous"] / f"{unit}.json") if "previous" in job.inputs else None
        if before and "not_calibrated" in before:
            write_json(target, before)
            return
        previous = SensorCalibration.from_json(sensor, before) if before else None
        recordings = load_recordings(job.inputs["filter"] / f"{unit}.parquet")
        noises = load_noises(job.inputs["filter"], unit)
        try:
            found = module.fit(recordings, previous, part | {"noise": noises})
            if job.run["last"] != NOT_LAST:  # else the next stage would take it over, and it would count twice
                found = with_stated(found, recordings, part)
            write_json(target, found.to_json())
        except CannotCalibrateError as reason:
            write_json(target, {"not_calibrated": reason.message})

    return run_batch(job, work)
