"""Determine what makes Snakemake repeat a job: the settings that its stage reads, and the code that it runs.

A job reads its settings from one file, an input of its rule that is named after its content. A changed setting
therefore repeats exactly the stages that read it. ``common`` in the file holds the settings that all units of a batch
share, ``code`` a digest of the code, because Snakemake does not detect changes of the package. (As a parameter of the
rule it would cost 0.3 s: for parameters Snakemake imports pandas.)
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from imu_logs.units import SENSORS
from pipeline.app.config.options import GIVEN, effects_for
from pipeline.app.steps import MODULES
from pipeline.core.files import EFFECTS_FOLDER, canonical_json, from_cache, state_of_files, to_cache
from pipeline.core.settings import OF_BENCH, Board, Settings, Stated, Unit
from pipeline.estimation.stages import stage_module
from pipeline.ingest.files import state_of_recordings
from pipeline.output.history import digest
from pipeline.unit import EFFECTS_STAGE, STEPS

if TYPE_CHECKING:
    from pipeline.app.config.campaign import Campaign, UnitRow

PACKAGE = Path(__file__).resolve().parents[2]
PACKAGES = ("pipeline", "imu_logs", "imu_research")  # beside each other, in a clone and in a wheel
CAMPAIGN = "campaign"  # cannot be a batch, because their names end in a number
# An import of the package, or of jinja2: module and names, or only a module. ``ast`` takes 0.5 s for all files.
IMPORT = re.compile(
    r"^[ \t]*(?:from ((?:pipeline|imu_)[\w.]*|jinja2) import (\([^)]*\)|.*)|import ((?:pipeline|imu_)[\w.]*))",
    re.MULTILINE,
)
DATA_FILE = re.compile(rb'"([\w-]+\.(?:json|yaml))"')
SECTIONS_OF_STAGES = {**{name: step.settings for name, step in STEPS.items()}, "prior": STEPS["validate"].settings}


def sections_of(stage: str, sensor: str, settings: Settings) -> tuple[str, ...]:
    """Return the sections that a stage reads: a key of ``SECTIONS_OF_STAGES``, or ``effects`` of a sensor's fit."""
    if stage != EFFECTS_STAGE:
        return SECTIONS_OF_STAGES[stage]
    mounted = settings.table.seat_deg is not None or "mounting" in settings.effects.gyroscope
    both = sensor == "gyroscope" and mounted  # gravity determines the mounting of the unit in each recording
    return (*SECTIONS_OF_STAGES["fit"], f"effects.{sensor}", *(["effects.accelerometer"] if both else []))


def last_stage(settings: Settings, sensor: str) -> str:
    """Return the last stage of a unit's fit; a batch has the stage ``effects`` where some of its units have it."""
    method, of_bench = settings.method, any(getattr(settings.table, key) for key in OF_BENCH)
    if method.of(sensor) != GIVEN and (of_bench or settings.effects.of(sensor)):
        return EFFECTS_STAGE
    return (method.stages.of(sensor) or [""])[-1]


def settings_of_unit(unit: UnitRow, stage: str, sensor: str, stated: Stated) -> dict[str, Any]:
    """Return the settings of a unit that a stage reads, as JSON values; ``stated``: what the run states about it."""
    sections = sections_of(stage, sensor, unit.config)
    settings = unit.config.replaced(stated=stated) if "stated" in sections else unit.config
    return settings.only(sections)


def _stated(unit: UnitRow, stage: str, run: Mapping[str, Any] | None = None, board: Board | None = None) -> Stated:
    """Return what calibration and page state about a unit; the calibration does not depend on its row and its run."""
    if stage != "report":
        return Stated(config_sha256=unit.config_sha256, board=board)
    row = {column: unit.row[column] for column in ("serial", "lot", "date") if unit.row.get(column)}
    return Stated(config_sha256=unit.config_sha256, row=row, run=dict(run or {}))


def settings_in_memory(unit: UnitRow, stage: str, sensor: str = "", run: Mapping[str, Any] | None = None) -> Settings:
    """Return the settings that a stage reads as its job reads them: keys, and with them recordings, are sorted."""
    content = settings_of_unit(unit, stage, sensor, _stated(unit, stage, run))
    return Settings.of_sections(as_job_reads(content))


def as_job_reads(value: Any) -> Any:  # noqa: ANN401  (any JSON value)
    """Return a value as a job reads it from its settings: keys, and with them terms of effects, are sorted."""
    return json.loads(canonical_json(value))


class SettingsFile(NamedTuple):
    """The settings of a job, in a file that is named after its content."""

    name: str
    content: bytes


def settings_of_jobs(
    campaign: Campaign, again: Callable[[str], int] = lambda _: 0
) -> dict[str, dict[str, SettingsFile]]:
    """Return the settings of every job, by batch and output, such as ``fit/gyroscope/bias``.

    The settings of ``gather`` and ``lots`` are in the batch ``CAMPAIGN``. ``again`` returns the number of repetitions
    of an output (path below the results) because it was edited (``pipeline.app.results_folder``).
    """
    configs, sections = _sections(campaign)
    compared = sorted({unit for c in campaign.compare for g in c["groups"] for unit in g["units"]})
    summaries = {
        name: Stated(
            row=unit.row, overrides=unit.overrides, sections=configs[name], compared=name in compared,
            lot_prior=campaign.combine == "lot",
        )
        for name, unit in campaign.units.items()
    }  # fmt: skip
    files: dict[str, dict[str, SettingsFile]] = {}
    for batch, units in campaign.batches.items():
        rows = [campaign.units[unit] for unit in units]
        fits = [(s, stage) for s in SENSORS for stage in campaign.chains[batch][s]]
        outputs = {f"fit/{s}/{stage}": (stage if stage == EFFECTS_STAGE else "fit", s) for s, stage in fits}
        outputs |= {stage: (stage, "") for stage in SECTIONS_OF_STAGES if stage not in ("fit", "prior")}
        outputs |= {"prior": ("prior", "")} if campaign.combine == "lot" else {}
        files[batch] = {
            output: _file(output, _content(campaign, rows, *stage, summaries), again(f"batches/{batch}/{output}.zip"))
            for output, stage in outputs.items()
        }
    of_gather = {name: getattr(campaign, name) for name in ("batches", "compare", "page", "combine", "packed")}
    of_gather |= {"campaign": campaign.name, "order": list(campaign.units), "run": campaign.run_settings()}
    of_gather |= {"sections": sections, "truths": {unit: str(campaign.truth(unit)) for unit in compared}}
    files[CAMPAIGN] = {"gather": _file("gather", of_gather, again(""))}
    if campaign.combine == "lot":
        files[CAMPAIGN]["lots"] = _file("lots", {"batches": campaign.batches}, again("batches/lots.zip"))
    return files


def _file(output: str, content: dict[str, Any], again: int) -> SettingsFile:
    step, *fit = output.split("/")
    modules = [f"pipeline.app.steps.{MODULES[step]}", *([stage_module(*fit)] if fit else ())]
    code = "".join(map(code_digest, modules))
    text = canonical_json(content | {"code": code} | ({"again": again} if again else {}))
    return SettingsFile(f"{output.replace('/', '-')}-{hashlib.sha256(text).hexdigest()[:16]}.json", text)


def _content(
    campaign: Campaign, rows: Sequence[UnitRow], stage: str, sensor: str, summaries: Mapping[str, Stated]
) -> dict[str, Any]:
    """Return the settings that a stage reads for the units of a batch; ``sensor``: of a stage of a fit."""
    settings = {}
    for row in rows:
        chips = campaign.boards.get(row.row.get("board", ""))
        board = Board(name=row.row["board"], chips=chips) if chips and stage == "calibration" else None
        run = campaign.run_settings(row.name) if stage == "report" else None
        stated = summaries[row.name] if stage == "summary" else _stated(row, stage, run, board)
        settings[row.name] = settings_of_unit(row, stage, sensor, stated)
    content: dict[str, Any] = dict(zip(("common", "units"), in_common(settings), strict=True))
    content["packed"] = campaign.packed
    content |= effects_for(stage, sensor, [r.config for r in rows])
    if sensor:
        content["last"] = {row.name: last_stage(row.config, sensor) for row in rows}
    if stage in ("ingest", "report"):
        content["campaign"] = campaign.name
    if stage == "ingest":
        content |= {"directory": str(campaign.recorded), "recordings": None}  # None: the run simulates them
        if not campaign.simulation:
            content["recordings"] = {
                r.name: state_of_recordings(r.config.procedure, r.config.ingest, campaign.folder(r.name)) for r in rows
            }
    return content


def in_common(settings: Mapping[str, dict[str, Any]]) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """Split the settings of units into the settings that all share and the other settings of each unit.

    ``pipeline.app.steps.batch.merge_common`` merges them again.
    """
    if len(settings) < 2:
        return {}, dict(settings)
    first, *others = settings.values()
    shared: dict[str, Any] = {}
    specific = {unit: dict(each) for unit, each in settings.items()}
    for key, value in first.items():
        if all(key in each and each[key] == value for each in others):
            shared[key] = value
            for each in specific.values():
                del each[key]
        elif all(isinstance(each.get(key), dict) for each in settings.values()):
            shared[key], below = in_common({unit: each[key] for unit, each in settings.items()})
            for unit, each in specific.items():
                each[key] = below[unit]
    return shared, specific


def _sections(campaign: Campaign) -> tuple[dict[str, dict[str, str]], dict[str, Any]]:
    """Return the digests of the sections of the configuration of each unit, and the sections by digest."""
    known: dict[int, str] = {}  # digest by the id of a section; units share sections that no override changes
    values: dict[str, Any] = {}
    digests: dict[str, dict[str, str]] = {}
    for name, unit in campaign.units.items():
        digests[name] = {}
        for section in [*(s for s in Unit.model_fields if s != "certificate"), "user_effects"]:
            content = getattr(unit.config, section)
            if content is None:
                continue
            value = content.json_value
            value = {k: v for k, v in value.items() if k != "folder"} if section == "procedure" else value
            if section == "procedure" or id(content) not in known:
                known[id(content)] = digest(value)
                values.setdefault(known[id(content)], value)
            digests[name][section] = known[id(content)]
    return digests, values


@cache
def code_digest(*modules: str) -> str:
    """Return a digest of the source of modules and of every module of the packages that they import, at any depth.

    It includes all files of a package that imports its modules by name, the folder ``templates`` of a module that
    imports jinja2, files of data beside a module that names them, and ``configs/effect/`` with the effects.
    """
    name, state = "-".join(("code", *modules)), _state_of_sources()
    if (known := from_cache(name, state)) is not None:
        return str(known)
    files = frozenset[Path]().union(*map(_closure, modules))
    if any(module.startswith("pipeline.app.steps.") for module in modules):
        files |= _closure("pipeline.app.steps.unit_files")  # loads and stores what the step reads and returns
    digest = hashlib.sha256()
    for file in sorted(files):
        digest.update(str(file.relative_to(PACKAGE.parent)).encode() + b"\0" + file.read_bytes())
    to_cache(name, state, digest.hexdigest()[:16])
    return digest.hexdigest()[:16]


@cache
def _state_of_sources() -> str:
    folders = (*(PACKAGE.parent / package for package in PACKAGES), EFFECTS_FOLDER)
    return state_of_files(f for folder in folders for f in folder.rglob("*") if f.suffix and f.suffix != ".pyc")


@cache
def _closure(module: str) -> frozenset[Path]:
    seen: set[Path] = set()
    todo = [file for file in [_file_of(module)] if file]
    while todo:
        file = todo.pop()
        if file not in seen:
            seen.add(file)
            todo.extend(_imports(file))
    return frozenset(seen)


@cache
def _imports(file: Path) -> tuple[Path, ...]:
    if file.suffix != ".py":
        return ()
    source = file.read_bytes()
    files: list[Path | None] = []
    if file.name == "__init__.py" and b"import_module(" in source:
        files += [f for f in file.parent.rglob("*") if f.is_file() and f.suffix != ".pyc"]
    if file == PACKAGE / "physics" / "effects" / "__init__.py":
        files += [f for f in sorted(EFFECTS_FOLDER.glob("*.yaml")) if b"\nbuilt_in: true" in f.read_bytes()]
    files += [f for name in DATA_FILE.findall(source) if (f := file.parent / name.decode()).is_file()]
    for module, names, whole in IMPORT.findall(source.decode()):
        if module == "jinja2":
            files += (file.parent / "templates").glob("*")
        files += [_file_of(module or whole), *(_file_of(f"{module}.{name}") for name in re.findall(r"\w+", names))]
    return tuple(f for f in files if f)


@cache
def _file_of(module: str) -> Path | None:
    if module.partition(".")[0] not in PACKAGES:
        return None
    path = PACKAGE.parent.joinpath(*module.split("."))
    for file in (path / "__init__.py", path.with_suffix(".py")):
        if file.is_file():
            return file
    return None
