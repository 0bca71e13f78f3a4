"""Load what the steps of a unit read from the files of earlier jobs, and write what they return.

A process that runs several jobs of a batch (``pipeline.app.steps.job_server``) keeps in memory what they return and
read. A job takes it from there if the pack of the earlier job has the members that it had then.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from pipeline.core.pack import INCOMPLETE_SUFFIX, Files, Pack
from pipeline.core.records import SENSORS, Fit, Noise, Recording, UnitRecordings, Validation, fit_from_json
from pipeline.ingest.arrow import from_parquet, to_parquet
from pipeline.unit import STEPS, UnitFiles

if TYPE_CHECKING:
    from pipeline.app.steps.batch import Job

Result = TypeVar("Result")
# Readings of the units that a process keeps. With 100 units of 10,000 samples (88 MB) it has 430 MB at the end, with
# what is computed of them; without them 130 MB. The rules state 1 GB.
MOST_KEPT_BYTES = 150_000_000
BYTES_OF_SAMPLE = 88  # time, two sensors, temperature, and the angle, rate or attitude of a table: 11 numbers
READ_LATER = {name for step in STEPS.values() for name in step.reads}
DOCUMENT_OF = {"validate": "validation", "diagnose": "diagnosis"}  # of stages that return an object


class ResultsInMemory:
    """What the jobs of this process have returned and read of the units of a batch.

    ``keeps``: whether anything is kept; not in a process of one job. Of units beyond ``MOST_KEPT_BYTES`` no recordings
    are kept.
    """

    def __init__(self) -> None:
        self.keeps = False
        self._readings: dict[str, int] = {}  # bytes of the units whose recordings are kept
        self._made: dict[tuple[str, str], Any] = {}  # of the job that runs, whose pack is not yet written
        self._of_packs: dict[tuple[str, str], dict[tuple[str, str], Any]] = {}

    def get(self, pack: Pack, unit: str, result: str, read: Callable[[], Result]) -> Result:
        """Return a result that a pack holds: as it is kept, else by ``read``."""
        if not self.keeps:
            return read()
        kept, key = self._of_packs.setdefault((str(pack.path), pack.state), {}), (unit, result)
        found: Result = kept[key] if key in kept else read()
        if self._may_keep(unit, found):
            kept[key] = found
        return found

    def made(self, unit: str, result: str, value: object) -> None:
        """Keep what the step of a job returned for a unit, up to the end of the job, if later steps read it."""
        if self.keeps and result in READ_LATER and self._may_keep(unit, value):
            self._made[unit, result] = value

    def written(self, pack: Pack) -> None:
        """Keep what was made as that of a pack, which the job has written."""
        if self.keeps:
            self._of_packs.setdefault((str(pack.path), pack.state), {}).update(self._made)
            self._made.clear()

    def _may_keep(self, unit: str, value: object) -> bool:
        recordings = value.filtered if isinstance(value, UnitRecordings) else value
        if unit not in self._readings and isinstance(recordings, list):
            size = sum(recording.samples for recording in recordings) * BYTES_OF_SAMPLE
            if sum(self._readings.values()) + size > MOST_KEPT_BYTES:
                return False
            self._readings[unit] = size
        return True


RESULTS = ResultsInMemory()


def recordings_of(packs: Mapping[str, Pack], unit: str) -> list[Recording]:
    """Return the filtered recordings of a unit; without a filter, or before it, those of ingest."""
    name = f"{unit}.parquet"
    pack = packs["filter"] if "filter" in packs and name in packs["filter"] else packs["ingest"]
    return from_parquet(pack.read(name), str(pack.path))


class StoredUnit:
    """A unit of a job: what its steps read (``pipeline.unit.UnitState``), kept in memory or loaded from files."""

    def __init__(self, job: Job, unit: str) -> None:
        self.job, self.unit = job, unit

    def document(self, stage: str) -> Any:  # noqa: ANN401  (a JSON document)
        """Return the document that an earlier stage wrote of the unit."""
        return self.job.inputs[stage].json(f"{self.unit}.json")

    def _kept(self, stage: str, result: str, read: Callable[[], Result]) -> Result:
        return RESULTS.get(self.job.inputs[stage], self.unit, result, read)

    @property
    def files(self) -> UnitFiles:
        """Files of the recordings."""
        directory = Path(self.job.run["directory"])
        folder = directory / self.job.units[self.unit].procedure.folder
        return UnitFiles(directory, folder, self.job.inputs.get("recordings"))

    @property
    def checked(self) -> list[Recording]:
        """Recordings as ingest returned them."""
        packs = {"ingest": self.job.inputs["ingest"]}
        return self._kept("ingest", "checked", lambda: recordings_of(packs, self.unit))

    @property
    def recordings(self) -> UnitRecordings:
        """Recordings as the filter returned them."""
        return self._kept("filter", "recordings", self._stored_recordings)

    def _stored_recordings(self) -> UnitRecordings:
        filtered = recordings_of(self.job.inputs, self.unit)
        found = self.job.inputs["filter"].json(f"{self.unit}.noise.json")
        noises = {sensor: data and Noise.from_json(data) for sensor, data in found.items()}
        return UnitRecordings(filtered, noises)

    @property
    def fits(self) -> dict[str, Fit]:
        """Fit of each sensor; in a job of the stage fit, that of the stage before."""
        if self.job.stage == "fit":
            sensor = self.job.run["sensor"]
            return {sensor: self._fit(sensor, "previous")} if "previous" in self.job.inputs else {}
        return {sensor: self._fit(sensor, sensor) for sensor in SENSORS}

    def _fit(self, sensor: str, stage: str) -> Fit:
        return self._kept(stage, "fits", lambda: fit_from_json(sensor, self.document(stage)))

    @property
    def validated(self) -> Validation:
        """Errors on held-out motion."""
        return self._kept("validate", "validated", lambda: Validation.from_json(self.document("validate")))

    @property
    def validation(self) -> dict[str, Any]:
        """The document of the stage validate."""
        return self._kept("validate", "validation", lambda: self.document("validate"))

    @property
    def diagnosis(self) -> dict[str, Any]:
        """The document of the stage diagnose."""
        return self._kept("diagnose", "diagnosis", lambda: self.document("diagnose"))

    @property
    def calibration(self) -> dict[str, Any]:
        """The document of the stage calibration."""
        return self._kept("calibration", "calibration", lambda: self.document("calibration"))

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
