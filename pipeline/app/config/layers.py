"""Read ``units.csv``, and collect the overrides of each unit, weakest first, each with its origin.

    campaign.yaml < models < lots < devices/<name>.yaml < units.csv < overrides= < unit_overrides=

where

    models, lots : mappings in ``campaign.yaml``: name of a sensor config, or lot of ``units.csv``, to overrides
    devices      : folder with a file ``{overrides: [...]}`` for a serial or a unit of ``units.csv``; the file of a unit
                   has precedence over the file of its serial
    units.csv    : the columns that name a config of a group, then the column ``overrides``

``campaign.yaml``, with optional keys::

    overrides: [filter=rc_low_pass]   # Hydra overrides of every unit, and settings of the run
    models: {mpu6050: [filter=none]}  # of the units of a sensor model
    lots: {"12": [filter.order=2]}    # of the units of a production lot
    compare: [[U1, U2]]               # comparisons on the campaign's page; see pipeline.app.config.campaign
    simulate: true                    # the run simulates the recordings that simulation.yaml in this folder describes
    page: thesis                      # the run writes this page in addition to the campaign's page
"""

from __future__ import annotations

import csv
import difflib
import io
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from imu_logs.files import not_regular, read_text
from imu_logs.yaml_file import read_yaml
from pipeline.app.config.options import (
    GROUPS,
    ONLY_FROM_THE_COMMAND_LINE,
    PYTHON,
    RUN_SETTINGS,
    default_option,
    nearest,
    parse,
)
from pipeline.core.errors import ConfigurationError, shortened
from pipeline.ingest.files import wrong_name

CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]")  # all except tab and line ends
KNOWN_COLUMNS = ("unit", "overrides", *GROUPS, "serial", "lot", "date", "board")
SIMILARITY = 0.85  # of a misspelt name: overide 0.88, procedur 0.94; but material and serial: 0.71
MAX_SHEET_BYTES = 100_000_000  # a million units of 100 characters each
DEVICES_FOLDER = "devices"
BETWEEN_OVERRIDES = re.compile(r';(?=(?:[^"]*"[^"]*")*[^"]*$)')  # a semicolon outside double quotes
SIMULATION = "simulation.yaml"
LIST = "a list of overrides KEY=VALUE"
OneOrMore = BeforeValidator(lambda value: [value] if isinstance(value, str) else value or [])
Overrides = Annotated[list[str], OneOrMore, Field(description=LIST)]
ByName = Annotated[
    dict[Annotated[str, BeforeValidator(str)], Overrides],
    BeforeValidator(lambda value: value or {}),
    Field(description="a mapping of names to lists of overrides"),
]


class UnitsTable(NamedTuple):
    """The rows of ``units.csv``, in its order."""

    rows: dict[str, dict[str, str]]  # unit to its cells by column
    lines: dict[str, int]  # unit to the line of the file on which its row ends


def read_units_table(path: Path) -> UnitsTable:
    """Read ``units.csv``; one ``ConfigurationError`` states all invalid names, duplicates and ragged rows."""
    columns, rows = _table(path)
    if PYTHON in columns:
        raise ConfigurationError(f"column {PYTHON}: {ONLY_FROM_THE_COMMAND_LINE}", f"{path}:1")
    if "unit" not in columns:
        raise ConfigurationError(f"has no column 'unit'{_hint(columns)}", f"{path}:1")
    units: dict[str, dict[str, str]] = {}
    lines: dict[str, int] = {}
    by_lower_case: dict[str, str] = {}
    problems = [f"line 1: column {c!r} stands twice" for c in sorted({c for c in columns if columns.count(c) > 1})]
    problems += _misspelt(columns)
    for line, raw in rows:
        if None in raw or any(v is None for v in raw.values()):
            problems.append(f"line {line}: {len(columns)} columns expected, as in the header")
            continue
        row = {k: v.strip() for k, v in raw.items()}
        problems += [f"line {line}: column {k!r} holds a control character" for k in row if CONTROL.search(row[k])]
        name = row["unit"]
        problem = wrong_name(name)
        twin = by_lower_case.setdefault(name.casefold(), name)
        if problem:
            problems.append(f"line {line}: unit {name[:60]!r}: {problem}")
        elif name in units:
            problems.append(f"line {line}: unit {name!r} stands twice")
        elif twin != name:
            told = f"line {line}: units {twin!r} and {name!r} differ in upper and lower case only"
            problems.append(f"{told}; their files would be the same on disks that make no difference; rename one")
        else:
            units[name], lines[name] = row, line
    if not units and not problems:
        problems.append("has no units")
    if problems:
        raise ConfigurationError("; ".join(shortened(problems, 20)), str(path))
    return UnitsTable(units, lines)


def _table(path: Path) -> tuple[list[str], list[tuple[int, dict[str | Any, Any]]]]:
    """Return the columns, and each row with the number of its last line."""
    text = read_text(path, MAX_SHEET_BYTES, "a units table")
    reader = csv.DictReader(io.StringIO(text, newline=""), strict=True)
    try:
        columns = [c.strip() for c in reader.fieldnames or []]
        reader.fieldnames = columns
        return columns, [(reader.line_num, row) for row in reader]
    except csv.Error as error:
        raise ConfigurationError(f"cannot be read after line {reader.line_num}: {error}", str(path)) from error


def _hint(columns: list[str]) -> str:
    """Describe a header without a column ``unit``, and what to do."""
    for sign, name in ((";", "semicolons"), ("\t", "tabs")):
        if len(columns) < 2 and columns and "unit" in [c.strip() for c in columns[0].split(sign)]:
            text = f": its columns are separated by {name}, where commas are expected"
            return f"{text}; save it again as CSV with commas (quote a cell that holds a comma)"
    close = difflib.get_close_matches("unit", columns, 1, SIMILARITY)
    names = ", ".join(repr(c[:60])[1:-1] for c in columns[:20])
    return (f"; nearest: {close[0]}" if close else "") + f"; its columns are {names or 'none'}"


def _misspelt(columns: list[str]) -> list[str]:
    """Return a line for each misspelt column; a short name must differ from a known one by an s: plot is not lot."""
    problems = []
    for column in columns:
        near = difflib.get_close_matches(column.casefold(), KNOWN_COLUMNS, 1, SIMILARITY)
        is_near = near and (len(near[0]) > 4 or column.casefold() in (near[0], near[0] + "s"))
        if column not in KNOWN_COLUMNS and is_near:
            hint = f"nearest: {near[0]}; correct it, or rename a column of your own"
            problems.append(f"line 1: column {column!r} is not known; {hint}")
    return problems


class DeviceFile(BaseModel):
    """A file of ``devices/``. Error messages quote the description of a field."""

    model_config = ConfigDict(extra="forbid", strict=True)
    overrides: Overrides = []


class CampaignFile(DeviceFile):
    """``campaign.yaml``."""

    models: ByName = {}
    lots: ByName = {}
    compare: Annotated[list[Any], BeforeValidator(lambda v: v or []), Field(description="a list of comparisons")] = []
    simulate: bool = Field(default=False, description="true or false")
    page: Literal["thesis"] | None = Field(default=None, description="thesis (python -m pipeline thesis page)")


File = TypeVar("File", bound=DeviceFile)


class Layer(NamedTuple):
    """One override and its origin."""

    origin: str
    text: str


@dataclass(frozen=True)
class Layers:
    """All overrides of a campaign and of the command line."""

    units_table: UnitsTable
    campaign: CampaignFile  # without the settings of the run
    of_run: list[str]  # settings of the run, from ``campaign.yaml`` and the command line
    devices: dict[str, list[str]]  # serial or unit to the overrides of its file
    command: list[str]  # ``overrides=`` of the command line
    per_unit: dict[str, list[str]]  # ``unit_overrides=`` of the command line
    simulation: Path | None  # description of the recordings that the run simulates; None for real recordings

    def of(self, unit: str) -> list[Layer]:
        """Return the overrides of a unit, weakest first."""
        row, line = self.units_table.rows[unit], f"units.csv line {self.units_table.lines[unit]}"
        of_row = [o for o in map(str.strip, BETWEEN_OVERRIDES.split(row.get("overrides", ""))) if o]
        lot = row.get("lot", "")
        origins: dict[str, Sequence[str]] = {
            "campaign.yaml": self.campaign.overrides,
            f"campaign.yaml, lots, {lot}": self.campaign.lots.get(lot, ()),
            **{f"{DEVICES_FOLDER}/{name}.yaml": self.devices.get(name, ()) for name in (row.get("serial", ""), unit)},
            **{f"{line}, column {g}": [f"{g}={row[g]}"] for g in GROUPS if row.get(g)},
            f"{line}, column overrides": of_row,
            "command line, overrides=": self.command,
            "command line, unit_overrides=": self.per_unit.get(unit, ()),
        }
        found = [Layer(origin, text) for origin, texts in origins.items() for text in texts]
        if self.campaign.models:
            sensors = [text.partition("=")[2].strip() for _, text in found if key_of(text) == "sensor"]
            model = sensors[-1] if sensors else default_option("sensor")
            of_model = [Layer(f"campaign.yaml, models, {model}", o) for o in self.campaign.models.get(model, ())]
            place = len(self.campaign.overrides)
            found[place:place] = of_model
        return found


def load_layers(directory: Path, settings: Mapping[str, Any], sensors: Iterable[str]) -> Layers:
    """Read the overrides of a campaign and of the command line; ``ConfigurationError`` names the file and the key.

    ``settings``: of ``--config``; ``sensors``: names of the sensor configs.
    """
    units_table, path = read_units_table(directory / "units.csv"), directory / "campaign.yaml"
    file = _read(path, CampaignFile) if os.path.lexists(path) else CampaignFile()
    _check_models_and_lots(file, units_table, set(sensors), str(path))
    in_file, units = _split(file.overrides)
    on_command_line, command = _split(as_list(settings.get("overrides", []), "overrides"))
    simulation = path.with_name(SIMULATION) if file.simulate else None
    if simulation and not os.path.lexists(simulation):
        raise ConfigurationError(f"simulate: true needs {SIMULATION} in the same folder, which is absent", str(path))
    problem = not_regular(simulation) if simulation else None
    if problem:
        raise ConfigurationError(problem, str(simulation))
    per_unit = settings.get("unit_overrides", {})
    if not isinstance(per_unit, dict):
        form = """'unit_overrides={U1: [filter.cutoff_hz=5, "effects.gyroscope=[g_sensitivity]"]}'"""
        raise ConfigurationError(f"unit_overrides: {form} is the form (lists within are quoted), got {per_unit!r}")
    for name in (str(n) for n in per_unit if str(n) not in units_table.rows):
        raise ConfigurationError(f"unit_overrides: no unit {name!r} in units.csv{nearest(name, units_table.rows)}")
    of_units, of_run = file.model_copy(update={"overrides": units}), [*in_file, *on_command_line]
    devices = _read_devices(directory, units_table)
    stated = {str(name): as_list(v, f"unit_overrides of {name}") for name, v in per_unit.items()}
    return Layers(units_table, of_units, of_run, devices, command, stated, simulation)


def as_list(value: Any, where: str, what: str = LIST) -> list[str]:  # noqa: ANN401  (the user's)
    """Return a string, or a list of strings, as a list; raises ``ConfigurationError`` for other values."""
    if isinstance(value, str):
        value = [value]
    if not isinstance(value, (list, tuple)) or not all(isinstance(v, str) for v in value):
        raise ConfigurationError(f"{where}: {what} is expected, got {value!r}")
    return list(value)


def key_of(text: str) -> str:
    """Return the key of an override ``KEY=VALUE``."""
    return str(text).partition("=")[0].strip().lstrip("+")


def _split(overrides: Sequence[str]) -> tuple[list[str], list[str]]:
    """Split overrides into those of the run and those of units."""
    run = [o for o in overrides if key_of(o) in RUN_SETTINGS]
    return run, [o for o in overrides if o not in run]


def _read(path: Path, model: type[File]) -> File:
    content = read_yaml(path) or {}
    if not isinstance(content, dict):
        raise ConfigurationError("a mapping is expected, for example 'overrides: [filter=rc_low_pass]'", str(path))
    if PYTHON in content:
        raise ConfigurationError(f"{PYTHON}: {ONLY_FROM_THE_COMMAND_LINE}", str(path))
    try:
        return model.model_validate(content)
    except ValidationError as errors:
        error = errors.errors()[0]
    key, *below = error["loc"]
    if error["type"] == "extra_forbidden":
        raise ConfigurationError(f"{key}: unknown key{nearest(str(key), model.model_fields)}", str(path))
    value = content[key]
    if below and isinstance(value, dict):
        raise ConfigurationError(f"{key}, {below[0]}: {LIST} is expected, got {value.get(below[0])!r}", str(path))
    raise ConfigurationError(f"{key}: {model.model_fields[str(key)].description} is expected, got {value!r}", str(path))


def _read_devices(directory: Path, units_table: UnitsTable) -> dict[str, list[str]]:
    """Read ``devices/*.yaml``: serial or unit to overrides; one ``ConfigurationError`` names all invalid files."""
    known = set(units_table.rows) | {row["serial"] for row in units_table.rows.values() if row.get("serial")}
    devices, problems = {}, []
    for file in sorted((directory / DEVICES_FOLDER).glob("*.yaml")):
        if file.stem not in known:
            problems.append(f"{file}: no unit or serial {file.stem!r} in units.csv{nearest(file.stem, known)}")
            continue
        try:
            run, devices[file.stem] = _split(_read(file, DeviceFile).overrides)
        except ConfigurationError as error:
            problems.append(str(error))
            continue
        if run:
            problems.append(f"{file}: {run[0]}: is a setting of the run, not of a device; set it in campaign.yaml")
    if problems:
        raise ConfigurationError("the configuration is refused:\n  " + "\n  ".join(shortened(problems, 5, "files")))
    return devices


def _check_models_and_lots(campaign: CampaignFile, units_table: UnitsTable, sensors: set[str], file: str) -> None:
    """Refuse unknown models and lots, settings of the run, and overrides of a model that choose another model."""
    lots = {row["lot"] for row in units_table.rows.values() if row.get("lot")}
    for key, what, named, known in (
        ("models", "sensor config", campaign.models, sensors),
        ("lots", "lot of units.csv", campaign.lots, lots),
    ):
        for name, overrides in named.items():
            if name not in known:
                raise ConfigurationError(f"{key}: no {what} is called {name!r}{nearest(name, known)}", file)
            run, _ = _split(overrides)
            if run:
                raise ConfigurationError(f"{key}, {name}: {run[0]} is a setting of the run, not of units", file)
            if key == "models" and any(parse(o)[0] == "sensor" for o in overrides):
                raise ConfigurationError(f"models, {name}: the overrides of a model cannot choose another", file)
