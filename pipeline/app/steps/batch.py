"""Run a stage on a batch of units, one after the other; a unit that fails does not stop the others.

A job reads and writes one file for each stage, a ``pipeline.core.pack``. It contains ``<unit>.failed.json`` for a
failed unit. Later stages copy this member, and ``verdict`` sets the exit code from it.

A stage after the fit (``AFTER_FIT``) that fails for a unit does not fail the unit: its calibration is published. The
pack then contains what the function ``<stage>_without`` of the stage returns instead, and ``<unit>.incomplete.json``
with the cause. Page, summary and the last lines of the run state it.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

from pipeline.app.results_folder import hold_as_job, record_written, repetitions
from pipeline.app.steps import MODULES
from pipeline.core.errors import DamagedFileError, PipelineError, failure_of, is_of_run, omission
from pipeline.core.files import json_text, read_json, write_json
from pipeline.core.pack import FAILED_SUFFIX, INCOMPLETE_SUFFIX, Files, Pack, as_bytes, new_pack
from pipeline.core.settings import Settings, UserEffectFiles
from pipeline.unit import EFFECTS_STAGE, STEPS, Task, run_step

FITS = ("accelerometer", "gyroscope")
INPUTS: dict[str, tuple[str, ...]] = {  # stage: the stages whose packs it reads
    "collect": (),
    "ingest": (),
    "filter": ("ingest",),
    "fit": ("ingest", "filter"),
    "validate": ("ingest", "filter", *FITS),
    "diagnose": ("ingest", "filter", *FITS, "validate"),
    "calibration": ("ingest", *FITS, "validate", "diagnose"),
    "export": ("calibration", "validate", "diagnose"),
    "report": ("ingest", "filter", "calibration", "validate", "diagnose", "export"),
    "summary": ("calibration", "validate", "diagnose", "report"),
    "lots": (),
    "prior": ("ingest", "filter", "calibration", "validate", "diagnose", "report", "lots"),
    "gather": (),
}
OPTIONS = {"ingest": ("recordings",), "fit": ("sensor", "stage", "previous")}
AFTER_FIT = ("diagnose", "export", "report", "summary", "prior")  # a calibration does not depend on them
READ_BY_STAGES = ("ingest", "filter", "fit")  # alone: their JSON has no lines for a reader
INPUTS_OF = ".inputs"  # member of a pack: digest of a unit's inputs, and the names of its files
CPU_TIME = "s of CPU time"  # in the last line of a job's log
# settings by unit, of which ``<stage>_reads`` returns those of one, and how a pack is written
OF_OTHERS = ("again", "recordings", "last", "packed")


@dataclass(frozen=True)
class Job:
    """One stage for one batch."""

    stage: str
    units: dict[str, Settings]  # unit to its settings
    run: dict[str, Any]  # settings of the run, and the options of the command line
    inputs: dict[str, Pack]  # stage to its output
    output: Path  # file to write
    results: Path  # folder of the campaign's results
    content: dict[str, dict[str, Any]] = field(default_factory=dict)  # unit to its settings as JSON values

    @cached_property
    def members(self) -> dict[str, list[tuple[str, str]]]:
        """Return the members of the inputs by unit, with their stage; a name may fit several units."""
        found: dict[str, list[tuple[str, str]]] = {unit: [] for unit in self.units}
        for stage, pack in self.inputs.items():
            for name in (n for n in pack.names() if not n.endswith(INPUTS_OF)):
                folder, _, last = name.rpartition("/")
                units = {folder.partition("/")[0]}
                while last:
                    units.add(last)
                    last = last[: max(last.rfind("."), last.rfind("_"), 0)]
                for unit in units & found.keys():
                    found[unit].append((stage, name))
        return found

    def state_of_members(self, unit: str) -> list[list[str]]:
        """Return stage, name and digest of each file of a unit from earlier stages."""
        return [[stage, name, self.inputs[stage].digest(name)] for stage, name in self.members[unit]]


def main(stage: str, argv: Sequence[str]) -> int:
    """Run a step (``pipeline.unit.STEPS``) for each unit, or the function ``<stage>_batch(job)`` for all.

    A stage that is no step has ``<stage>_unit(job, unit, settings)``, which returns the files of the unit.
    ``<stage>_in_batch(job, unit, settings, made)``, if it exists, returns what a step made with what other units of the
    batch tell. ``<stage>_failed(job, unit, settings, failure)``, if it exists, returns the files of a unit that failed
    in this stage or before, and ``<stage>_without`` with the same arguments those that replace the files of a stage
    after the fit that failed. A unit whose settings, code and files of earlier stages are as in the last run is copied
    from there; ``<stage>_reads(job, unit, settings)``, if it exists, returns what else must be the same, or None where
    that is not known. The exit code is 0 even if units have failed: their failures are part of the output.
    """
    if stage == "verdict":
        return verdict(argv)
    start = time.process_time()
    module = import_module(f"pipeline.app.steps.{MODULES[stage]}")
    job = parse_job(stage, argv)
    from pipeline.app.steps import unit_files  # noqa: PLC0415  (numpy, for the jobs only)

    if hasattr(module, f"{stage}_batch"):
        getattr(module, f"{stage}_batch")(job)
        return 0
    edited = job.run.get("again", 0) != repetitions(job.results, _below(job, job.output))[0]
    last = None if edited else Pack(last_output(job.output))
    with new_pack(job.output, compressed=job.run.get("packed", True)) as add:
        for number, (unit, settings) in enumerate(job.units.items(), 1):
            print(f"{stage}: {unit} ({number} of {len(job.units)})", file=sys.stderr, flush=True)
            inputs = _inputs_of(module, job, unit, settings)
            files = _unchanged(last, unit, inputs) if inputs and last else {}
            if files:
                print(f"{stage}: {unit} unchanged, taken from the last run", file=sys.stderr, flush=True)
            else:
                files = _files_of(module, job, unit, settings)
            add(files)
            if inputs and not {unit + FAILED_SUFFIX, unit + INCOMPLETE_SUFFIX} & files.keys():
                add({unit + INPUTS_OF: as_bytes({"sha256": inputs, "files": [*files]})})
    last_output(job.output).unlink(missing_ok=True)
    with suppress(OSError):  # on a disk without links, the next run computes every unit
        last_output(job.output).hardlink_to(job.output)
    record_output(job, job.output)
    unit_files.RESULTS.written(Pack(job.output))
    print(f"{stage}: {time.process_time() - start:.3f} {CPU_TIME}", file=sys.stderr)
    return 0


def last_output(output: Path) -> Path:
    """Return the path of a link to the last output of a job; Snakemake deletes the output before it repeats the job."""
    return output.with_name(f".{output.name}.last")


def forget_last_outputs(results: Path) -> None:
    """Delete the links to the last outputs of jobs, so that every unit is computed again."""
    for last in (results / "batches").rglob(".*.last"):
        last.unlink()


def _inputs_of(module: ModuleType, job: Job, unit: str, settings: Settings) -> str:
    """Return a digest of all that the files of a unit depend on; empty if it is not known."""
    reads = getattr(module, f"{job.stage}_reads", lambda *_: "")
    run = {key: value for key, value in job.run.items() if key not in OF_OTHERS}
    try:
        others = reads(job, unit, settings)
        found = [run, job.content[unit], job.state_of_members(unit), others]
    except PipelineError:
        return ""
    return "" if others is None else hashlib.sha256(json_text(found, 0).encode()).hexdigest()


def _unchanged(last: Pack, unit: str, inputs: str) -> dict[str, bytes]:
    """Return the files of a unit from the last run; empty if there was none, or if its inputs have changed."""
    name = unit + INPUTS_OF
    try:
        found = last.json(name) if name in last else {}
        return {file: last.read(file) for file in found["files"]} if found.get("sha256") == inputs else {}
    except DamagedFileError:
        return {}


def parse_job(stage: str, argv: Sequence[str]) -> Job:
    """Parse a stage's command line: ``--config SETTINGS --output FILE``, a pack for each input, and options."""
    parser = argparse.ArgumentParser(prog=f"python -m pipeline {stage}", description=f"The stage {stage} on a batch.")
    parser.add_argument("--config", type=Path, required=True, help="the stage's settings (JSON)")
    parser.add_argument("--output", type=Path, required=True, help="file to write")
    for name in INPUTS[stage]:
        parser.add_argument(f"--{name}", type=Path, required=True, help=f"pack of the stage {name}")
    for name in OPTIONS.get(stage, ()):
        parser.add_argument(f"--{name}", default="", help=f"{name} of this stage")
    arguments = vars(parser.parse_args(argv))
    config: Path = arguments.pop("config")
    results = config.parent.parent
    hold_as_job(results)
    content = merge_common(read_json(config))
    if "user_effects" in content:
        from pipeline.physics.effects import register_user_effects  # noqa: PLC0415  (numpy, where there are any)

        register_user_effects(UserEffectFiles.model_validate(content["user_effects"]))
    of_units, output = content.pop("units"), arguments.pop("output")
    inputs = {name: Pack(arguments.pop(name)) for name in INPUTS[stage]}
    for name in ("recordings", "previous"):
        if path := arguments.pop(name, ""):
            inputs[name] = Pack(Path(path))
    units = {unit: Settings.of_sections(sections) for unit, sections in of_units.items()}
    return Job(stage, units, content | arguments, inputs, output, results, of_units)


def merge_common(content: dict[str, Any]) -> dict[str, Any]:
    """Merge the common settings into the settings of each unit.

    The order of keys, and with it of recordings, is alphabetical, whatever other units of the batch have in common.
    """
    common = content.pop("common", {})
    return content | {"units": {unit: _merged(common, own) for unit, own in content.get("units", {}).items()}}


def _merged(common: dict[str, Any], unit_settings: Mapping[str, Any]) -> dict[str, Any]:
    below = {k: _merged(common[k], v) for k, v in unit_settings.items() if isinstance(v, dict) and k in common}
    return dict(sorted({**common, **unit_settings, **below}.items()))


def record_output(job: Job, output: Path) -> None:
    """Record the output of a job, so that the next run detects edited files."""
    if output.is_relative_to(job.results):
        record_written(job.results, _below(job, output), job.run.get("again", 0))


def _below(job: Job, output: Path) -> str:
    """Return an output's path below the results; empty for the results themselves and outside of them."""
    return output.relative_to(job.results).as_posix().removeprefix(".") if output.is_relative_to(job.results) else ""


def _files_of(module: ModuleType, job: Job, unit: str, settings: Settings) -> dict[str, bytes]:
    """Return the files of a unit; for a unit that failed here or before, with the record of its failure."""
    name = unit + FAILED_SUFFIX
    stage = "/".join([job.stage, *(str(job.run[k]) for k in ("sensor", "stage") if job.run.get(k))])
    try:
        earlier = next((pack for pack in job.inputs.values() if name in pack), None)
        if not earlier:
            return _made_or_replaced(module, job, unit, settings, stage)
        failure = earlier.json(name)
    except Exception as error:
        if is_of_run(error):
            raise
        failure = failure_of(error, unit, stage)
        print(f"{stage}: {unit} FAILED: {failure['message']}", file=sys.stderr, flush=True)
    of_failed = getattr(module, f"{job.stage}_failed", None)
    return _encoded(job, {name: failure} | (of_failed(job, unit, settings, failure) if of_failed else {}))


def _made_or_replaced(module: ModuleType, job: Job, unit: str, settings: Settings, stage: str) -> dict[str, bytes]:
    """Return the files that a stage makes of a unit; of a stage after the fit that fails, those that replace them."""
    try:
        return _encoded(job, _made(module, job, unit, settings))
    except Exception as error:
        if job.stage not in AFTER_FIT:
            raise
        record = omission(error, unit, stage)
        without = getattr(module, f"{job.stage}_without", None)
        instead = without(job, unit, settings, record) if without else {}
        return _encoded(job, {**instead, unit + INCOMPLETE_SUFFIX: [record]})


def _made(module: ModuleType, job: Job, unit: str, settings: Settings) -> Files:
    """Load what a step reads from the files of earlier stages, call it, and return what it made as files."""
    if job.stage not in STEPS:
        files: Files = getattr(module, f"{job.stage}_unit")(job, unit, settings)
        return files
    from pipeline.app.steps.unit_files import DOCUMENT_OF, FILES, RESULTS, StoredUnit  # noqa: PLC0415  (for the jobs only)

    stage, last = job.run.get("stage", ""), job.run.get("last", {}).get(unit, "")
    if stage == EFFECTS_STAGE != last:  # other units of the batch have effects
        return {f"{unit}.json": job.inputs["previous"].read(f"{unit}.json")}
    task = Task(job.stage, job.run.get("sensor", ""), stage, last=stage == last)
    made = run_step(task, StoredUnit(job, unit), settings)
    if of_batch := getattr(module, f"{job.stage}_in_batch", None):
        made = of_batch(job, unit, settings, made)
    RESULTS.made(unit, STEPS[job.stage].returns, made)
    files = FILES[job.stage](unit, made)
    RESULTS.made(unit, DOCUMENT_OF.get(job.stage, ""), files.get(f"{unit}.json"))
    return files


def _encoded(job: Job, files: Files) -> dict[str, bytes]:
    return {name: as_bytes(content, published=job.stage not in READ_BY_STAGES) for name, content in files.items()}


def verdict(argv: Sequence[str]) -> int:
    """Report the failed units, and return the exit code of the run.

    Without a failed unit it is 0, and the file that marks a complete campaign is written.
    """
    parser = argparse.ArgumentParser(prog="python -m pipeline verdict", description="Report the failed units.")
    parser.add_argument("--failures", type=Path, required=True, help="the failures that gather found")
    parser.add_argument("--results", type=Path, required=True, help="of the campaign, as the user names them")
    parser.add_argument("--output", type=Path, required=True, help="mark that is written where no unit has failed")
    arguments = parser.parse_args(argv)
    failures = read_json(arguments.failures)
    if not failures:
        write_json(arguments.output, {"failed": 0})
        return 0
    page, plural = arguments.results / "index.html", "s" * (len(failures) > 1)
    print(f"{len(failures)} unit{plural} failed (all others are done; see {page}):", file=sys.stderr)
    for f in failures:
        where = f"{f['file']}: " if f["file"] else ""
        print(f"  {f['unit']}: {where}{f['message']} [{f['code']} in {f['stage']}]", file=sys.stderr)
    return 1
