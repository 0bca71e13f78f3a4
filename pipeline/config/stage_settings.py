"""Determine what makes Snakemake repeat a job: the settings that its stage reads, and the code that it runs.

A job reads its settings from one file, an input of its rule that is named after its content. A changed setting
therefore repeats exactly the stages that read it. ``common`` in the file holds the settings that all units of a batch
share. A digest of the code is a parameter of the rule, because Snakemake does not detect changes of the package.
"""

from __future__ import annotations

import hashlib
import json
import re
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from pipeline.config.schema import OF_BENCH
from pipeline.config.user_effects import effects_for
from pipeline.files import CONFIGS
from pipeline.history import digest
from pipeline.io.files import recording_files

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from pipeline.config.campaign import Campaign, UnitRow

PACKAGE = Path(__file__).resolve().parents[1]
CAMPAIGN = "campaign"  # cannot be a batch, because their names end in a number
EFFECTS = CONFIGS / "effect"  # read by pipeline.model.effects
# An import of the package, or of jinja2: module and names, or only a module. ``ast`` takes 0.5 s for all files.
IMPORT = re.compile(
    r"^[ \t]*(?:from (pipeline[\w.]*|jinja2) import (\([^)]*\)|.*)|import (pipeline[\w.]*))", re.MULTILINE
)
# Dotted keys that a stage reads; {sensor} is the sensor of the stage.
BOTH = ("accelerometer", "gyroscope")
NOISE = ("noise_density", "bias_wander", "wander_time_s")
BY_HAND = tuple(f"procedure.{key}" for key in ("holdout_every", "holdout_from", "faces", "turns"))
FIT_OF_TABLE = (
    "motion", "gravity_g", "latitude_deg", "azimuth_deg", "azimuth_of", "angle_accuracy_deg", "rate_accuracy",
    "orthogonality_deg",
    "wobble_deg", "levelling_deg", "gravity_accuracy_g", "azimuth_accuracy_deg", *OF_BENCH,
)  # fmt: skip
FIT_OF_SENSOR = (
    "full_scale", "counts_per_unit", *NOISE, "effects.bias_temperature", "effects.scale_factor_temperature",
    "effects.clock_rate", "repeatability_bias", "repeatability_scale_factor",
)  # fmt: skip
FIT = (
    *(f"table.{key}" for key in FIT_OF_TABLE),
    *(f"sensor.{{sensor}}.{key}" for key in FIT_OF_SENSOR),
    *(f"sensor.accelerometer.{key}" for key in (*NOISE, "cross_axis")),  # by hand, a gyroscope fit includes its fit
    "sensor.temperature_accuracy_degc", *BY_HAND, "method.{sensor}", "method.as_printed", "method.given",
    "uncertainty.monte_carlo",
)  # fmt: skip
# Effects that explain a deviation of table, clock or gyroscope: the checks of recordings read their limits.
LIMITS_OF_CHECKS = (
    "time_offset", "low_pass_lag", "clock_rate", "table_encoder_error", "table_rate_ripple", "table_backlash",
    "table_tilt", "table_axis_nonorthogonality", "g_sensitivity", "g_squared_sensitivity", "bias_drift",
    "bias_temperature", "warm_up",
)  # fmt: skip
INGEST_OF_TABLE = (
    "motion", "gravity_g", "latitude_deg", "azimuth_deg", "azimuth_of", "rate_accuracy", "sense", "zero_deg",
    "angle_accuracy_deg", "orthogonality_deg", "seat_deg",
)  # fmt: skip
INGEST_OF_SENSOR = (
    "axis_map", "full_scale", "bias", "scale_factor", "cross_axis", *NOISE,
    *(f"effects.{name}" for name in LIMITS_OF_CHECKS),
)  # fmt: skip
SENSORS_AND_TABLE = ("sensor", "table", *BY_HAND)
READS: dict[str, tuple[str, ...]] = {
    "ingest": (
        "ingest", "procedure.folder", "procedure.recordings", "procedure.mounting_tolerance_deg", "procedure.turns",
        "sensor.axis_map",
        *(f"table.{key}" for key in INGEST_OF_TABLE),
        *(f"sensor.{sensor}.{key}" for sensor in BOTH for key in INGEST_OF_SENSOR),
    ),
    "filter": ("filter", *(f"sensor.{sensor}.{key}" for sensor in BOTH for key in NOISE)),
    "fit": FIT,
    "effects": (*FIT, "effects.{sensor}", "sensor.{sensor}.effects"),
    "calibration": (
        "sensor.name", "sensor.axis_map", "sensor.accelerometer", "sensor.gyroscope", "table.name", "procedure.name",
        "method", "ingest.csv", "ingest.mcap", "config_sha256",
    ),
    "validate": (*SENSORS_AND_TABLE, "limits"),
    "diagnose": (*SENSORS_AND_TABLE, "effects", "method", "diagnosis"),
    "export": ("sensor", "table.gravity_g"),
    "report": (
        "sensor", "table", "procedure", "method", "filter", "ingest", "effects", "limits", "certificate",
        "config_sha256",
    ),
    "summary": tuple(f"sensor.{sensor}.{key}" for sensor in BOTH for key in ("bias", "scale_factor", "cross_axis")),
    "prior": SENSORS_AND_TABLE,
}  # fmt: skip
WITH_DIGEST = [stage for stage, keys in READS.items() if "config_sha256" in keys]


def config_sha256(config: Mapping[str, Any]) -> str:
    """Return the SHA-256 of the configuration of a unit as canonical JSON, without the section ``certificate``."""
    return hashlib.sha256(_canonical({k: v for k, v in config.items() if k != "certificate"})).hexdigest()


def select_settings(config: Mapping[str, Any], stage: str, sensor: str = "") -> dict[str, Any]:
    """Return the settings of a unit that a stage reads: a key of ``READS``, or a stage of the fit of a sensor."""
    settings: dict[str, Any] = {}
    paths = _paths(stage, sensor)
    mounted = config["table"].get("seat_deg") is not None or "mounting" in (config["effects"]["gyroscope"] or ())
    if stage == "effects" and sensor == "gyroscope" and mounted:  # gravity determines the mounting of the unit in
        paths = paths + _paths(stage, "accelerometer")  # each recording
    for *branch, leaf in paths:
        source: Any = config
        target = settings
        for step in branch:
            source = source[step]
            target = target.setdefault(step, {})
        if leaf in source or (branch[-1:] != ["effects"] and leaf != "given"):  # a sensor file limits some effects
            target[leaf] = source[leaf]
    return settings


def settings_of_unit(unit: UnitRow, stage: str, sensor: str = "") -> dict[str, Any]:
    """Return the settings of a unit that a stage reads, without those of its campaign."""
    digest = {"config_sha256": unit.config_sha256} if stage in WITH_DIGEST else {}
    settings = select_settings(unit.config | digest, stage, sensor)
    if stage == "report":
        settings["row"] = {c: unit.row[c] for c in ("serial", "lot", "date") if unit.row.get(c)}
    return settings


def as_job_reads(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings as read from the file of a job: keys, and with them recordings, are in alphabetical order."""
    found: dict[str, Any] = json.loads(_canonical(settings))
    return found


@cache
def _paths(stage: str, sensor: str) -> list[list[str]]:
    return [key.format(sensor=sensor).split(".") for key in READS.get(stage, FIT)]


class SettingsFile(NamedTuple):
    """The settings of a job, in a file that is named after its content."""

    name: str
    content: bytes


def settings_of_jobs(
    campaign: Campaign, again: Callable[[str], int] = lambda _: 0
) -> dict[str, dict[str, SettingsFile]]:
    """Return the settings of every job, by batch and output, such as ``fit/gyroscope/bias``.

    The settings of ``gather`` and ``lots`` are in the batch ``CAMPAIGN``. ``again`` returns the number of repetitions
    of an output (path below the results) because it was edited (``pipeline.results_folder``).
    """
    configs, sections = _sections(campaign)
    compared = sorted({unit for c in campaign.compare for g in c["groups"] for unit in g["units"]})
    summaries = {
        name: {
            "row": unit.row, "overrides": unit.overrides, "config": configs[name], "compared": name in compared,
            "lot_prior": campaign.combine == "lot",
        }
        for name, unit in campaign.units.items()
    }  # fmt: skip
    files: dict[str, dict[str, SettingsFile]] = {}
    for batch, units in campaign.batches.items():
        rows = [campaign.units[unit] for unit in units]
        fits = [(s, stage) for s in BOTH for stage in campaign.chains[batch][s]]
        outputs = {f"fit/{s}/{stage}": (stage if stage == "effects" else "fit", s) for s, stage in fits}
        outputs |= {stage: (stage, "") for stage in READS if stage not in ("fit", "effects", "prior")}
        outputs |= {"prior": ("prior", "")} if campaign.combine == "lot" else {}
        files[batch] = {
            output: _file(output, _content(campaign, rows, *stage, summaries), again(f"batches/{batch}/{output}.zip"))
            for output, stage in outputs.items()
        }
    of_gather = {
        "campaign": campaign.name,
        "batches": campaign.batches,
        "order": list(campaign.units),
        "run": campaign.run_settings(),
        "sections": sections,
        "compare": campaign.compare,
        "page": campaign.page,
        "combine": campaign.combine,
        "publish_limit": campaign.publish_limit,
        "truths": {unit: str(campaign.truth(unit)) for unit in compared},
    }
    files[CAMPAIGN] = {"gather": _file("gather", of_gather, again(""))}
    if campaign.combine == "lot":
        files[CAMPAIGN]["lots"] = _file("lots", {"batches": campaign.batches}, again("batches/lots.zip"))
    return files


def _file(output: str, content: dict[str, Any], again: int) -> SettingsFile:
    text = _canonical(content | ({"again": again} if again else {}))
    return SettingsFile(f"{output.replace('/', '-')}-{hashlib.sha256(text).hexdigest()[:16]}.json", text)


def _content(
    campaign: Campaign, rows: Sequence[UnitRow], stage: str, sensor: str, summaries: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the settings that a stage reads for the units of a batch; ``sensor``: of a stage of a fit."""
    settings = {row.name: settings_of_unit(row, stage, sensor) for row in rows}
    if stage == "report":
        for row in rows:
            settings[row.name] |= {"run": campaign.run_settings(row.name)}
    if stage == "summary":
        settings = {row.name: settings[row.name] | summaries[row.name] for row in rows}
    if stage == "calibration" and campaign.boards:
        for row in rows:
            board = row.row.get("board", "")
            if board in campaign.boards:
                settings[row.name] |= {"board": {"name": board, "chips": campaign.boards[board]}}
    content: dict[str, Any] = dict(zip(("common", "units"), in_common(settings), strict=True))
    content |= effects_for(stage, sensor, [r.config for r in rows])
    if stage in ("ingest", "report"):
        content["campaign"] = campaign.name
    if stage == "ingest":
        content |= {"directory": str(campaign.recorded), "recordings": _recordings(campaign, rows)}
    return content


def _recordings(campaign: Campaign, rows: Sequence[UnitRow]) -> str | None:
    """Return a digest of the names, sizes and times of the recordings; None if the run simulates them."""
    if campaign.simulation:
        return None
    digest = hashlib.sha256()
    for row in rows:
        files = recording_files(row.config["procedure"], row.config["ingest"], campaign.folder(row.name))
        for path in sorted({path for paths in files.values() for path in paths}):
            status = path.stat()
            digest.update(f"{path}\0{status.st_size}\0{status.st_mtime_ns}\0".encode())
    return digest.hexdigest()[:16]


def in_common(settings: Mapping[str, dict[str, Any]]) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """Split the settings of units into the settings that all share and the other settings of each unit.

    ``pipeline.stages.batch.merge_common`` merges them again.
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
        for section, content in unit.config.items():
            if section in ("unit", "certificate"):
                continue
            value = {k: v for k, v in content.items() if k != "folder"} if section == "procedure" else content
            if section == "procedure" or id(content) not in known:
                known[id(content)] = digest(value)
                values.setdefault(known[id(content)], value)
            digests[name][section] = known[id(content)]
    return digests, values


def _canonical(value: Any) -> bytes:  # noqa: ANN401  (any JSON value)
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


@cache
def code_digest(*modules: str) -> str:
    """Return a digest of the source of modules and of every module of the package that they import, at any depth.

    It includes all files of a package that imports its modules by name, the folder ``templates`` of a module that
    imports jinja2, and ``configs/effect/`` with the effects.
    """
    files = frozenset[Path]().union(*map(_closure, modules))
    if any(module.startswith("pipeline.stages.") for module in modules):
        files |= _closure("pipeline.stages.unit_files")  # loads and stores what the step reads and returns
    digest = hashlib.sha256()
    for file in sorted(files):
        digest.update(str(file.relative_to(PACKAGE.parent)).encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16]


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
    if file == PACKAGE / "model" / "effects" / "__init__.py":
        files += [f for f in sorted(EFFECTS.glob("*.yaml")) if b"\nbuilt_in: true" in f.read_bytes()]
    for module, names, whole in IMPORT.findall(source.decode()):
        if module == "jinja2":
            files += (file.parent / "templates").glob("*")
        files += [_file_of(module or whole), *(_file_of(f"{module}.{name}") for name in re.findall(r"\w+", names))]
    return tuple(f for f in files if f)


@cache
def _file_of(module: str) -> Path | None:
    if module != "pipeline" and not module.startswith("pipeline."):
        return None
    path = PACKAGE.joinpath(*module.split(".")[1:])
    for file in (path / "__init__.py", path.with_suffix(".py")):
        if file.is_file():
            return file
    return None
