"""Runs a stage on a batch of units, one after the other; a unit that fails does not stop the others.

A failed unit leaves ``<unit>.failed.json`` in the stage's folder. The stages after it copy the file, and ``verdict``
turns it into the exit code. All files are complete or absent, and on the disk when the job ends.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import traceback
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.errors import DamagedFileError, PipelineError
from pipeline.files import flushed_together, read_json, write_json
from pipeline.results_folder import hold_as_job, record_written

if TYPE_CHECKING:
    from collections.abc import Sequence
    from types import ModuleType

FAILED = ".failed.json"
FITS = ("accelerometer", "gyroscope")
INPUTS: dict[str, tuple[str, ...]] = {  # stage: the stages whose folders it reads
    "ingest": (),
    "filter": ("ingest",),
    "fit": ("filter",),
    "validate": ("filter", *FITS),
    "diagnose": ("filter", *FITS, "validate"),
    "calibration": ("ingest", *FITS, "validate"),
    "export": ("calibration", "validate", "diagnose"),
    "report": ("filter", "calibration", "validate", "diagnose", "export"),
    "gather": (),
}
OPTIONS = {"fit": ("sensor", "stage", "previous", "last")}


@dataclass(frozen=True)
class Job:
    """A stage on a batch.

    Attributes
    ----------
    units : dict of str to dict
        Unit to its settings.
    run : dict
        Settings that are not a unit's, and the options of the command line.
    inputs : dict of str to Path
        Stage to its folder.
    output : Path
        Folder, or file, to write.
    results : Path
        Of the campaign.
    """

    stage: str
    units: dict[str, dict[str, Any]]
    run: dict[str, Any]
    inputs: dict[str, Path]
    output: Path
    results: Path


def main(stage: str, argv: Sequence[str]) -> int:
    """Run a stage: ``process_unit(job, unit, settings)`` of its module for each unit, or its ``process_batch(job)``.

    A module may have ``process_failed(job, unit, settings, failure)`` for units that failed, here or in a stage before.
    Returns 0 even if units have failed: their failures are part of the output.
    """
    module = import_module(f"pipeline.stages.{stage}")
    job = parse_job(stage, argv)
    if hasattr(module, "process_batch"):
        module.process_batch(job)
        return 0
    job.output.mkdir(parents=True, exist_ok=True)
    with flushed_together(job.output):
        for number, (unit, settings) in enumerate(job.units.items(), 1):
            print(f"{stage}: {unit} ({number} of {len(job.units)})", file=sys.stderr, flush=True)
            failed = job.output / f"{unit}{FAILED}"
            earlier = [f for f in (folder / failed.name for folder in job.inputs.values()) if f.is_file()]
            if earlier:
                shutil.copyfile(earlier[0], failed)
            else:
                _run_unit(module, job, unit, settings)
            if hasattr(module, "process_failed") and failed.is_file():
                module.process_failed(job, unit, settings, read_json(failed))
    record_output(job, job.output)
    return 0


def parse_job(stage: str, argv: Sequence[str]) -> Job:
    """Read a stage's command line: ``--config SETTINGS.json --output DIR``, a folder for each input, and options."""
    parser = argparse.ArgumentParser(prog=f"python -m pipeline {stage}", description=f"The stage {stage} on a batch.")
    parser.add_argument("--config", type=Path, required=True, help="the stage's settings (JSON)")
    parser.add_argument("--output", type=Path, required=True, help="folder or file to write")
    for name in INPUTS[stage]:
        parser.add_argument(f"--{name}", type=Path, required=True, help=f"folder of the stage {name}")
    for name in OPTIONS.get(stage, ()):
        parser.add_argument(f"--{name}", default="", help=f"{name} of this stage")
    arguments = vars(parser.parse_args(argv))
    config: Path = arguments.pop("config")
    results = config.parent.parent
    hold_as_job(results)
    content = merge_common(read_json(config))
    if "user_effects" in content:
        from pipeline.model.effects import register_user_effects  # noqa: PLC0415  (numpy, where there are any)

        register_user_effects(content["user_effects"])
    units, output = content.pop("units"), arguments.pop("output")
    inputs = {name: arguments.pop(name) for name in INPUTS[stage]}
    return Job(stage, units, content | arguments, inputs, output, results)


def merge_common(content: dict[str, Any]) -> dict[str, Any]:
    """Merge the common settings into each unit's."""
    content["units"] = {unit: _merged(content.get("common", {}), own) for unit, own in content.get("units", {}).items()}
    content.pop("common", None)
    return content


def _merged(common: dict[str, Any], own: dict[str, Any]) -> dict[str, Any]:
    below = {k: _merged(common[k], v) for k, v in own.items() if isinstance(v, dict) and k in common}
    return {**common, **own, **below}


def record_output(job: Job, output: Path, names: Sequence[str] = ("",)) -> None:
    """Record what a job wrote, so that the next run detects edited files."""
    if output.is_relative_to(job.results):
        below = output.relative_to(job.results).as_posix()
        record_written(job.results, below.removeprefix("."), job.run.get("again", 0), names)


def failure_of(error: Exception, unit: str, stage: str) -> dict[str, Any]:
    """Return the record of a unit's failure; an exception that is no user error is a bug, its traceback is printed."""
    code, message, file = "internal_error", f"{type(error).__name__}: {error} (a bug; see the log)", None
    if isinstance(error, PipelineError):
        code, message, file = error.code, error.message, error.file
    elif isinstance(error, OSError) and error.filename is not None:
        code, message, file = "bad_input", error.strerror or str(error), str(error.filename)
    else:
        traceback.print_exc()
    return {"unit": unit, "stage": stage, "code": code, "message": message, "file": file}


def _run_unit(module: ModuleType, job: Job, unit: str, settings: dict[str, Any]) -> None:
    try:
        module.process_unit(job, unit, settings)
    except Exception as error:
        if isinstance(error, OSError):
            name = error.filename
            if name is None or Path(str(name)).is_relative_to(job.output):
                raise  # a full disk or a folder that cannot be written concerns the run, not the unit
        if isinstance(error, DamagedFileError):
            with suppress(OSError):
                os.utime(str(error.file))  # the next run sees that the file is not as it was written
        for leftover in job.output.glob(f"{unit}.*"):
            if leftover.stem == unit and leftover.is_file():
                leftover.unlink()
        stage = "/".join([job.stage, *(str(job.run[k]) for k in ("sensor", "stage") if job.run.get(k))])
        failure = failure_of(error, unit, stage)
        write_json(job.output / f"{unit}{FAILED}", failure)
        print(f"{stage}: {unit} FAILED: {failure['message']}", file=sys.stderr, flush=True)
