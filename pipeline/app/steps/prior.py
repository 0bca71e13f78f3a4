"""Stages lots and prior (``combine=lot``): compute the priors of all units, and apply them to each unit's files."""

from __future__ import annotations

from contextlib import suppress
from functools import lru_cache
from typing import Any

from pipeline.app.steps.batch import Job, record_output
from pipeline.app.steps.diagnose import held_out_errors
from pipeline.app.steps.summary import failed_files
from pipeline.app.steps.unit_files import StoredUnit
from pipeline.core.errors import DamagedFileError
from pipeline.core.pack import DOCUMENT_FOLDERS, STAGE_OF, Files, Pack, as_bytes, new_pack
from pipeline.core.records import SENSORS, Validation, fit_from_json
from pipeline.core.settings import Settings
from pipeline.output.exports import exports
from pipeline.output.pages.combined import UnitEstimate, UnitPrior, calibration_with_prior, priors_of, with_card

LOTS_FILE = "told.json"  # description of the lots for ``fleet.json``


def lots_batch(job: Job) -> None:
    """Write the priors of the units of each batch, from the estimates in the files of the stage summary."""
    batches, found = job.run["batches"], []
    for name, units in batches.items():
        summaries = Pack(job.output.parent / name / "summary.zip")
        for unit in units:
            with suppress(DamagedFileError):  # ``gather`` records the failure of the unit
                found += [UnitEstimate.read(e) for e in summaries.json(f"{unit}.json").get("estimates", ())]
    priors, lots = priors_of(found)
    with new_pack(job.output) as add:
        add({LOTS_FILE: as_bytes(lots)})
        for name, units in batches.items():
            priors_of_batch = {u: {s: priors[u, s]._asdict() for s in SENSORS if (u, s) in priors} for u in units}
            add({f"{name}.json": as_bytes(priors_of_batch)})
    record_output(job, job.output)


@lru_cache(maxsize=1)
def _of_batch(lots: Pack, batch: str) -> Any:  # noqa: ANN401  (a JSON document)
    return lots.json(f"{batch}.json")


def prior_reads(job: Job, unit: str, settings: Settings) -> Any:  # noqa: ANN401, ARG001  (a JSON document)
    """Return the priors of a unit."""
    return _of_batch(job.inputs["lots"], job.output.parent.name)[unit]


def prior_unit(job: Job, unit: str, settings: Settings) -> Files:
    """Return the files that the priors of a unit add or change, by paths relative to the results."""
    given = prior_reads(job, unit, settings)
    if not given:
        return {}
    priors = {sensor: UnitPrior.read(prior) for sensor, prior in given.items()}
    calibration, validation, diagnosis = (job.inputs[STAGE_OF[of]].json(f"{unit}.json") for of in DOCUMENT_FOLDERS)
    document = calibration_with_prior(calibration, priors)
    files: Files = {}
    if document:
        fits = {s: fit_from_json(s, document[s] or {"not_calibrated": ""}) for s in SENSORS}
        before = Validation.from_json(validation).sensors
        after = held_out_errors(StoredUnit(job, unit).recordings, fits, settings)
        for sensor in [s for s in priors if not priors[s].refused]:
            errors = {"without": before[sensor], "with": after[sensor]}
            rms = {k: part.steps[-1].rms_error if part and part.held_out else None for k, part in errors.items()}
            document["lot_prior"][sensor]["held_out_rms_error"] = rms
        files[f"combined/{unit}.json"] = document
        written = exports(document, settings, validation, diagnosis)
        files |= {f"exports/{unit}/{file}": text for file, text in written.items()}
    page = job.inputs["report"].read(f"{unit}.html").decode()
    files[f"reports/{unit}.html"] = with_card(page, calibration, document, priors)
    return {f"{unit}/{path}": content for path, content in files.items()}


def prior_failed(job: Job, unit: str, settings: Settings, failure: dict[str, Any]) -> Files:  # noqa: ARG001
    """Return the document and the page of a unit that fails in this stage."""
    earlier = f"{unit}.calibration.json" in job.inputs["report"]
    return {} if earlier else failed_files(job.inputs["calibration"], unit, failure)
