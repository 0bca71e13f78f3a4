"""Load what the steps of a unit read from the files of earlier jobs, and write what they return."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.core.pack import INCOMPLETE_SUFFIX, Files, Pack
from pipeline.core.records import SENSORS, Fit, Noise, Recording, UnitRecordings, Validation, fit_from_json
from pipeline.ingest.arrow import from_parquet, to_parquet
from pipeline.unit import UnitFiles

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from pipeline.app.steps.batch import Job


def recordings_of(packs: Mapping[str, Pack], unit: str) -> list[Recording]:
    """Return the filtered recordings of a unit; without a filter, or before it, those of ingest."""
    name = f"{unit}.parquet"
    pack = packs["filter"] if "filter" in packs and name in packs["filter"] else packs["ingest"]
    return from_parquet(pack.read(name), str(pack.path))


class StoredUnit:
    """A unit of a job: what its steps read (``pipeline.unit.UnitState``), loaded from files."""

    validation = property(lambda self: self.document("validate"))
    diagnosis = property(lambda self: self.document("diagnose"))
    calibration = property(lambda self: self.document("calibration"))

    def __init__(self, job: Job, unit: str) -> None:
        self.job, self.unit = job, unit

    def document(self, stage: str) -> Any:  # noqa: ANN401  (a JSON document)
        """Return the document that an earlier stage wrote of the unit."""
        return self.job.inputs[stage].json(f"{self.unit}.json")

    @property
    def files(self) -> UnitFiles:
        """Files of the recordings."""
        directory = Path(self.job.run["directory"])
        folder = directory / self.job.units[self.unit].procedure.folder
        return UnitFiles(directory, folder, self.job.inputs.get("recordings"))

    @property
    def checked(self) -> list[Recording]:
        """Recordings as ingest returned them."""
        pack = self.job.inputs["ingest"]
        return from_parquet(pack.read(f"{self.unit}.parquet"), str(pack.path))

    @property
    def recordings(self) -> UnitRecordings:
        """Recordings as the filter returned them."""
        filtered = recordings_of(self.job.inputs, self.unit)
        found = self.job.inputs["filter"].json(f"{self.unit}.noise.json")
        noises = {sensor: data and Noise.from_json(data) for sensor, data in found.items()}
        return UnitRecordings(filtered, noises)

    @property
    def fits(self) -> dict[str, Fit]:
        """Fit of each sensor; in a job of the stage fit, that of the stage before."""
        if self.job.stage == "fit":
            sensor = self.job.run["sensor"]
            return {sensor: fit_from_json(sensor, self.document("previous"))} if "previous" in self.job.inputs else {}
        return {sensor: fit_from_json(sensor, self.document(sensor)) for sensor in SENSORS}

    @property
    def validated(self) -> Validation:
        """Errors on held-out motion."""
        return Validation.from_json(self.validation)

    @property
    def omissions(self) -> list[dict[str, Any]]:
        """Records of what the stages diagnose and export could not make."""
        name, packs = self.unit + INCOMPLETE_SUFFIX, (self.job.inputs[stage] for stage in ("diagnose", "export"))
        return [record for pack in packs if name in pack for record in pack.json(name)]


def _files_of_filter(unit: str, result: UnitRecordings) -> Files:
    """Write the recordings only where the filter changed them."""
    changed = any(recording.filter["name"] != "none" for recording in result.filtered)
    recordings = {f"{unit}.parquet": to_parquet(result.filtered)} if changed else {}
    noises = {sensor: noise and noise.to_json() for sensor, noise in result.noises.items()}
    return recordings | {f"{unit}.noise.json": noises}


# Step to the files of what it returned for a unit.
FILES: dict[str, Callable[[str, Any], Files]] = {
    "ingest": lambda unit, recordings: {f"{unit}.parquet": to_parquet(recordings)},
    "filter": _files_of_filter,
    "fit": lambda unit, fit: {f"{unit}.json": fit.to_json()},
    "validate": lambda unit, validated: {f"{unit}.json": validated.to_json()},
    "diagnose": lambda unit, found: (
        {f"{unit}.json": found.document}
        | found.effect_files
        | ({unit + INCOMPLETE_SUFFIX: found.omissions} if found.omissions else {})
    ),
    "calibration": lambda unit, document: {f"{unit}.json": document},
    "export": lambda unit, files: {f"{unit}/{file}": text for file, text in files.items()},
    "report": lambda _, files: files,
    "summary": lambda unit, document: {f"{unit}.json": document},
}
