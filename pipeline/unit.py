"""Calibrate one unit: the chain of its steps, in memory or, one rule of the workflow for each, through files.

A step is a function of its inputs and of the settings that it reads. A run loads the inputs of a step from the files of
earlier jobs (``pipeline.app.steps.unit_files``), calls ``run_step``, and stores the result. ``run_steps`` calls all
steps of a unit in memory; ``pipeline.calibrate``, the commands, the study and the tests use it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from pipeline.core.pack import Pack
    from pipeline.core.records import Fit, Recording, UnitRecordings, Validation
    from pipeline.core.settings import Settings


EFFECTS_STAGE = "effects"  # of a fit, after the stages of its method
DOCUMENTS = ("calibration", "validation", "diagnosis")
BENCH_SECTIONS = ("sensor", "table", "procedure")


class Step(NamedTuple):
    """A step of the chain."""

    function: str  # module of pipeline.app.steps, and its function
    reads: tuple[str, ...]  # attributes of ``UnitState`` that the function takes, beside ``settings``
    settings: tuple[str, ...]  # sections of ``Settings`` that it reads; a change in another repeats no job
    returns: str  # attribute of ``UnitState`` that it returns; of ``fits``, the entry of one sensor


STEPS = {  # in the order of a run
    "ingest": Step("ingest.ingest", ("files",), (*BENCH_SECTIONS, "ingest"), "checked"),
    "filter": Step("ingest.filter_recordings", ("checked",), ("sensor", "filter"), "recordings"),
    # once for each stage of the method of each sensor; the stage ``effects`` reads the section ``effects``, too
    "fit": Step("fit.fit", ("recordings", "fits"), (*BENCH_SECTIONS, "method", "uncertainty"), "fits"),
    "validate": Step(
        "diagnose.validate_unit", ("unit", "recordings", "fits"), (*BENCH_SECTIONS, "limits"), "validated"
    ),
    "diagnose": Step(
        "diagnose.diagnose_unit",
        ("unit", "recordings", "fits", "validated"),
        (*BENCH_SECTIONS, "effects", "method", "diagnosis"),
        "diagnosed",
    ),
    "calibration": Step(
        "calibration.calibration_document",
        ("unit", "checked", "fits", "validated", "diagnosis"),
        (*BENCH_SECTIONS, "method", "ingest", "diagnosis", "stated"),
        "calibration",
    ),
    "export": Step("calibration.export", DOCUMENTS, ("sensor", "table"), "exports"),
    "report": Step(
        "report.report",
        ("recordings", *DOCUMENTS, "omissions"),
        (*BENCH_SECTIONS, "method", "filter", "ingest", "effects", "limits", "certificate", "stated"),
        "pages",
    ),
    "summary": Step("summary.summarise", DOCUMENTS, ("sensor", "stated"), "summary"),
}


@dataclass(frozen=True)
class UnitFiles:
    """The files of a unit's recordings."""

    directory: Path  # of the campaign: files in it are named by their path relative to it
    folder: Path  # of the unit
    archive: Pack | None = None  # of the stage collect, for a machine without access to these folders
    in_memory: Mapping[str, bytes] = field(default_factory=dict)  # canonical CSV by the name of its recording
    recordings: Sequence[Recording] = ()  # of a simulation, instead of files


@dataclass
class UnitState:
    """What the steps of a unit read and return; ``None`` before the step that returns it."""

    unit: str
    files: UnitFiles
    task: str = ""  # name of the current or last task
    checked: list[Recording] | None = None
    recordings: UnitRecordings | None = None
    fits: dict[str, Fit] = field(default_factory=dict)  # by sensor, after the last stage so far
    validated: Validation | None = None
    diagnosed: Any = None  # ``pipeline.app.steps.diagnose.Diagnosis``
    calibration: dict[str, Any] | None = None  # ``calibrations/<unit>.json``
    exports: dict[str, str] | None = None  # ``exports/<unit>/``: text by file
    pages: dict[str, Any] | None = None  # page and certificates, by their path below ``reports/``
    summary: dict[str, Any] | None = None

    @property
    def validation(self) -> dict[str, Any] | None:
        """``validations/<unit>.json``."""
        return None if self.validated is None else self.validated.to_json()

    @property
    def diagnosis(self) -> dict[str, Any] | None:
        """``diagnoses/<unit>.json``."""
        return None if self.diagnosed is None else dict(self.diagnosed.document)

    @property
    def omissions(self) -> list[dict[str, Any]]:
        """Records of what the diagnosis could not make."""
        return [] if self.diagnosed is None else list(self.diagnosed.omissions)


class Task(NamedTuple):
    """One call of a step; of a fit, the stage of a sensor's method, and whether it is the last."""

    step: str
    sensor: str = ""
    stage: str = ""
    last: bool = True

    @property
    def name(self) -> str:
        """Name of the task's output in a run, for example ``fit/gyroscope/bias``."""
        return "/".join(filter(None, (self.step, self.sensor, self.stage)))


def tasks_of(stages: Mapping[str, Sequence[str]], until: str = "diagnose", *, first: str = "ingest") -> Iterator[Task]:
    """Yield the tasks of a unit in their order, from the step ``first`` to ``until``.

    ``stages``: of the fit of each sensor.
    """
    steps = list(STEPS)
    for step in steps[steps.index(first) :]:
        if step == "fit":
            for sensor, names in stages.items():
                yield from (Task(step, sensor, name, name == names[-1]) for name in names)
        else:
            yield Task(step)
        if step == until:
            return


def run_step(task: Task, state: Any, settings: Settings) -> Any:  # noqa: ANN401  (each step has its types)
    """Call the function of a step with what it reads of ``state``, and return its result."""
    step = STEPS[task.step]
    module, _, function = step.function.rpartition(".")
    options = {"sensor": task.sensor, "stage": task.stage, "last": task.last} if task.sensor else {}
    inputs = {name: getattr(state, name) for name in step.reads}
    return getattr(import_module(f"pipeline.app.steps.{module}"), function)(**inputs, settings=settings, **options)


def run_steps(state: UnitState, tasks: Iterator[Task], settings_of: Callable[[Task], Settings]) -> UnitState:
    """Run the tasks of a unit in memory; ``settings_of`` returns the settings that a task reads."""
    for task in tasks:
        state.task = task.name
        made = run_step(task, state, settings_of(task))
        if task.sensor:
            state.fits = {**state.fits, task.sensor: made}
        else:
            setattr(state, STEPS[task.step].returns, made)
    return state


def run_checked(
    recordings: Sequence[Recording], stages: Mapping[str, Sequence[str]], settings: Settings, until: str = "fit"
) -> UnitState:
    """Run the steps from ``filter`` to ``until`` on recordings that are checked, or simulated without a fault.

    ``stages``: of the fit of each sensor. ``settings``: the sections that these steps read.
    """
    state = UnitState("unit", UnitFiles(Path(), Path()), checked=list(recordings))
    return run_steps(state, tasks_of(stages, until, first="filter"), lambda _: settings)
