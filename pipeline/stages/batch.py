"""What every stage has in common: a batch of units, handled one after the other, each guarded by itself.

A unit that fails leaves ``<unit>.failed.json`` in the stage's folder; the stages after it pass it on, and the last rule
turns it into the exit code. Files are written to a temporary name and renamed; all are on the disk when the job ends.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import traceback
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.atomic import flushed_together, write_atomically
from pipeline.errors import DamagedFileError, PipelineError
from pipeline.json_text import json_text
from pipeline.locks import hold_as_job
from pipeline.written import keep_record

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

FAILED = ".failed.json"


@dataclass(frozen=True)
class Job:
    """One job: a stage on a batch.

    Attributes
    ----------
    stage : str
    units : dict of str to dict
        Unit to its part of the configuration.
    run : dict
        What the part says beside the units.
    inputs : dict of str to Path
        Folders of the stages before.
    output : Path
    results : Path
        Of the campaign.
    """

    stage: str
    units: dict[str, dict[str, Any]]
    run: dict[str, Any]
    inputs: dict[str, Path]
    output: Path
    results: Path


def parse_job(stage: str, argv: Sequence[str], inputs: Sequence[str], options: Sequence[str] = ()) -> Job:
    """Read a stage's command line: ``--config PART.json --output DIR``, a folder for each input, and options."""
    parser = argparse.ArgumentParser(prog=f"python -m pipeline {stage}", description=f"The stage {stage} on a batch.")
    parser.add_argument("--config", type=Path, required=True, help="the stage's part of the configuration (JSON)")
    parser.add_argument("--output", type=Path, required=True, help="folder or file to write")
    for name in inputs:
        parser.add_argument(f"--{name}", type=Path, required=True, help=f"folder of the stage {name}")
    for name in options:
        parser.add_argument(f"--{name}", default="", help=f"{name} of this stage")
    arguments = vars(parser.parse_args(argv))
    config = arguments.pop("config")
    hold_as_job(config.parent.parent)
    content = together(read_json(config))
    if "user_effects" in content:
        from pipeline.model.effect_files import register_user_effects  # noqa: PLC0415  (numpy, where there are any)

        register_user_effects(content["user_effects"])
    run = {k: v for k, v in content.items() if k != "units"} | {name: arguments[name] for name in options}
    folders = {name: arguments[name] for name in inputs}
    return Job(stage, content["units"], run, folders, arguments["output"], config.parent.parent)


def together(content: dict[str, Any]) -> dict[str, Any]:
    """Put into the part of each unit what stands in the file once for all of them."""
    content["units"] = {unit: _merged(content.get("common", {}), own) for unit, own in content.get("units", {}).items()}
    content.pop("common", None)
    return content


def _merged(common: dict[str, Any], own: dict[str, Any]) -> dict[str, Any]:
    below = {k: _merged(common[k], v) for k, v in own.items() if isinstance(v, dict) and k in common}
    return {**common, **own, **below}


def run_batch(
    job: Job,
    work: Callable[[str, dict[str, Any]], None],
    of_failed: Callable[[str, dict[str, Any], dict[str, Any]], None] | None = None,
) -> int:
    """Call ``work(unit, part)`` for each unit; a failure is recorded and the others go on.

    Parameters
    ----------
    job : Job
    work : callable
    of_failed : callable, optional
        Called with unit, part and failure for each unit that has failed, here or in a stage before.

    Returns
    -------
    int
        0: the job itself has succeeded; failures are in its output.
    """
    job.output.mkdir(parents=True, exist_ok=True)
    with flushed_together(job.output):
        for number, (unit, part) in enumerate(job.units.items(), 1):
            print(f"{job.stage}: {unit} ({number} of {len(job.units)})", file=sys.stderr, flush=True)
            earlier = [f for f in (folder / f"{unit}{FAILED}" for folder in job.inputs.values()) if f.is_file()]
            if earlier:
                shutil.copyfile(earlier[0], job.output / f"{unit}{FAILED}")
            else:
                _run_unit(job, unit, part, work)
            failed = job.output / f"{unit}{FAILED}"
            if of_failed and failed.is_file():
                of_failed(unit, part, read_json(failed))
    note_written(job, job.output)
    return 0


def note_written(job: Job, output: Path, names: Sequence[str] = ("",)) -> None:
    """Keep a record of what a job wrote, so that the next run sees what was changed since."""
    if output.is_relative_to(job.results):
        below = output.relative_to(job.results).as_posix()
        keep_record(job.results, below.removeprefix("."), job.run.get("again", 0), names)


def _run_unit(job: Job, unit: str, part: dict[str, Any], work: Callable[[str, dict[str, Any]], None]) -> None:
    try:
        work(unit, part)
    except DamagedFileError as error:
        with suppress(OSError):
            os.utime(str(error.file))  # the next run sees that the file is not as it was written
        _record_failure(job, unit, error.code, error.message, error.file)
    except PipelineError as error:
        _record_failure(job, unit, error.code, error.message, error.file)
    except OSError as error:
        if error.filename is None or Path(str(error.filename)).is_relative_to(job.output):
            raise  # a full disk or a folder that cannot be written is the run's trouble, not the unit's
        _record_failure(job, unit, "bad_input", error.strerror or str(error), str(error.filename))
    except Exception as error:  # noqa: BLE001  (one unit's bug never stops the others; its traceback is kept)
        traceback.print_exc()
        _record_failure(job, unit, "internal_error", f"{type(error).__name__}: {error} (a bug; see the log)", None)


def _record_failure(job: Job, unit: str, code: str, message: str, file: str | None) -> None:
    for leftover in job.output.glob(f"{unit}.*"):
        if leftover.stem == unit and leftover.is_file():
            leftover.unlink()
    stage = "/".join([job.stage, *(str(job.run[k]) for k in ("sensor", "stage") if job.run.get(k))])
    failure = {"unit": unit, "stage": stage, "code": code, "message": message, "file": file}
    write_json(job.output / f"{unit}{FAILED}", failure)
    print(f"{stage}: {unit} FAILED: {message}", file=sys.stderr, flush=True)


def read_json(path: Path) -> Any:  # noqa: ANN401  (any JSON value)
    """Read a JSON file of a run.

    Raises
    ------
    DamagedFileError
        If it does not exist or is no JSON.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        reason = f"cannot be read, it is missing or damaged ({error}); the same command once more makes it again"
        raise DamagedFileError(reason, str(path)) from None


def write_json(path: Path, value: Any) -> None:  # noqa: ANN401
    """Write a JSON file; numbers that JSON cannot hold are refused, not written."""
    write_atomically(path, json_text(value) + "\n")
