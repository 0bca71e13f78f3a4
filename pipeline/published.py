"""What a campaign publishes of a unit: files of its own, or members of the packs of its batch (``packs/<batch>/``).

Up to ``publish_limit`` units each unit has files of its own. Beyond it ``unpack`` publishes those that are asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

from pipeline.pack import Pack

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

PACKS = "packs"
STAGES = ("calibration", "validate", "diagnose", "export", "report")
FAILED = ".failed.json"
STAGE_OF = {"calibrations": "calibration", "validations": "validate", "diagnoses": "diagnose"}


class Batch:
    """The packs of a batch that hold what is published of its units."""

    def __init__(self, folder: Path) -> None:
        self.packs = {stage: Pack(folder / f"{stage}.zip") for stage in STAGES}

    def failure(self, unit: str) -> dict[str, Any] | None:
        """Return the record of the failure of a unit, None where it was calibrated."""
        report, name = self.packs["report"], f"{unit}{FAILED}"
        return cast("dict[str, Any]", report.json(name)) if name in report else None

    def document(self, folder: str, unit: str) -> Any:  # noqa: ANN401  (a JSON document)
        """Return ``<folder>/<unit>.json`` as it is published."""
        stage, name = STAGE_OF[folder], f"{unit}.json"
        if stage == "calibration" and self.failure(unit):
            stage, name = "report", f"{unit}.calibration.json"
        return self.packs[stage].json(name)

    def files(self, unit: str) -> Iterator[tuple[str, bytes]]:
        """Yield the path and the content of each file that is published of a unit."""
        report, export, diagnose = (self.packs[stage] for stage in ("report", "export", "diagnose"))
        yield f"reports/{unit}.html", report.read(f"{unit}.html")
        if self.failure(unit):
            yield f"calibrations/{unit}.json", report.read(f"{unit}.calibration.json")
            return
        for folder, stage in STAGE_OF.items():
            yield f"{folder}/{unit}.json", self.packs[stage].read(f"{unit}.json")
        for part in diagnose.json(f"{unit}.json").values():
            if isinstance(part, dict) and (name := part.get("suggested_file")):
                yield f"diagnoses/{name}", diagnose.read(name)
        for name in (f"certificates/{unit}.{kind}" for kind in ("json", "html", "xml")):
            if name in report:  # no .xml where what its schema demands was not stated
                yield name, report.read(name)
        for name in export.names():
            if name.startswith(f"{unit}/"):
                yield f"exports/{name}", export.read(name)


def batches_of(results: Path) -> dict[str, Batch]:
    """Return the batch of each unit whose files are in packs; none where every unit has files of its own."""
    found: dict[str, Batch] = {}
    for folder in sorted((results / PACKS).glob("*")):
        batch = Batch(folder)
        pages = [name for name in batch.packs["report"].names() if "/" not in name]
        found |= {name.removesuffix(".html"): batch for name in pages if name.endswith(".html")}
    return found
