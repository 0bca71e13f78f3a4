"""Load a campaign: its directory, its units with their configurations, its batches, and the comparisons of its page.

Each entry of ``compare`` in ``campaign.yaml`` is one comparison::

    - title: Stages against least squares
      where: {sensor: [mpu6050, stim300]}    # units of the comparison; default: all
      groups:                                # by name: a list of units, or columns and their values
        stages: {method: staged}
        least squares: {method: reference_least_squares}
      pairs: serial                          # units with equal values are one device; differences are within a device
      against: stages                        # the group that the others are compared with; default: the first
    - title: Rates
      by: [method, rate_dps]                 # a group for each value of a column, or combination of values
      sensors: accelerometer                 # default: both
      x: table_time                          # abscissa of the chart of errors: a column of numbers, or table_time
    - [U1, U2]                               # or {title, units}: a group for each unit

Columns are those of ``units.csv``, and the groups of the resolved configuration of each unit (sensor, table, procedure,
method, filter, ingest). With several columns in ``by``, the last one varies along a curve; each combination of the
others is a curve.
"""

from __future__ import annotations

import hashlib
import math
import os
import unicodedata
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from imu_logs.units import SENSORS
from pipeline.app.config.compose import Composer
from pipeline.app.config.layers import Layers, as_list, load_layers
from pipeline.app.config.options import GROUPS, PYTHON, RUN_SETTINGS, SettingProblem, mapping_of, nearest, parse
from pipeline.app.config.stage_settings import last_stage
from pipeline.core.errors import ConfigurationError, shortened
from pipeline.core.files import CONFIGS, JSON, SHIPPED, canonical_json
from pipeline.core.settings import RunSettings, Settings
from pipeline.unit import EFFECTS_STAGE

SheetRows = Mapping[str, Mapping[str, str]]  # unit to its cells by column

TAKE_OVER = "take_over"
SMALLEST_BATCH, LARGEST_BATCH = 25, 160  # units: a job takes some seconds, as its start does; a minute, to fill cores
COMPARISON_KEYS = ("title", "units", "groups", "by", "where", "pairs", "against", "x", "sensors")
TABLE_TIME = "table_time"
COMPARISON_FORM = "a list of units, or a mapping with units, groups or by"


@dataclass(frozen=True)
class UnitRow:
    """One unit: its row of ``units.csv``, its configuration, and its overrides (key to value)."""

    name: str
    row: dict[str, str]
    config: Settings
    overrides: dict[str, str] = field(default_factory=dict)

    @cached_property
    def config_sha256(self) -> str:
        """Digest of the configuration without the section ``certificate``, which results state."""
        content = {name: section for name, section in self.config.configuration.items() if name != "certificate"}
        return hashlib.sha256(canonical_json(content)).hexdigest()


@dataclass(frozen=True)
class Campaign:
    """A campaign with all settings resolved."""

    name: str  # last part of its directory; its results are in ``<results>/<name>``
    directory: Path
    results: Path
    units: dict[str, UnitRow]  # in the order of ``units.csv``
    batches: dict[str, list[str]]  # units with equal stages, divided in the order of ``units.csv``
    chains: dict[str, dict[str, list[str]]]  # batch and sensor to the ordered stages of its fit
    compare: list[Any]  # comparisons on the campaign's page, resolved to groups of units
    simulation: Path | None  # description of the recordings that the run simulates; None for real recordings
    settings: Mapping[str, Any]  # of ``snakemake --config``
    page: str | None  # page in addition to the campaign's page
    combine: str | None = None  # "serial": units of one serial jointly; "lot": each unit with the prior of its lot
    publish_limit: int = 0  # largest number of units whose files are published one by one
    take_over: bool = False  # whether results of another campaign of the same name are moved aside

    @cached_property
    def boards(self) -> dict[str, list[str]]:
        """The units of each board in the order of the units table; the first is the reference."""
        return boards_of(self.units)

    @property
    def packed(self) -> bool:
        """Whether the files of the units are published in packs."""
        return len(self.units) > self.publish_limit

    @property
    def recorded(self) -> Path:
        """Folder of the recordings: the campaign's directory, or a folder of the results if they are simulated."""
        return self.directory if self.simulation is None else self.results.absolute() / "simulated"

    def run_settings(self, unit: str | None = None) -> dict[str, Any]:
        """Return the settings of ``--config`` that results depend on, with the ``unit_overrides`` of this unit only.

        A campaign that is part of the package is stated by its name, even if the user gave its path: equal runs then
        have equal settings.
        """
        ships = self.directory.parent == (SHIPPED / "data")
        stated: dict[str, Any] = {"campaign": self.name if ships else str(self.settings.get("campaign", self.name))}
        stated |= {k: v for k, v in self.settings.items() if k not in ("campaign", "results", TAKE_OVER) and v}
        if unit is not None and "unit_overrides" in stated:
            overrides = stated.pop("unit_overrides").get(unit)
            stated |= {"unit_overrides": {unit: overrides}} if overrides else {}
        return stated

    def folder(self, unit: str) -> Path:
        """Return the folder of the recordings of a unit."""
        return self.recorded / self.units[unit].config.procedure.folder

    def truth(self, unit: str) -> Path:
        """Return the file of the true parameters of a unit, which exists if its recordings were simulated."""
        return self.recorded / "truth" / f"{self.folder(unit).name}.json"


def load_campaign(settings: Mapping[str, Any]) -> Campaign:
    """Load and check a campaign; one ``ConfigurationError`` states all problems.

    ``settings``: those of ``snakemake --config``, as named below.
    """
    valid = ("campaign", "results", "overrides", "unit_overrides", TAKE_OVER, PYTHON)
    unknown = sorted(set(settings) - set(valid))
    if unknown:
        raise ConfigurationError(f"--config {unknown[0]}: unknown setting{nearest(unknown[0], valid)}")
    directory = find_campaign(str(settings.get("campaign", "demo")))
    for name in (str(directory), str(settings.get("results", ""))):
        if any(unicodedata.category(character) in ("Cc", "Cs") for character in name):
            raise ConfigurationError(f"{name!r}: a path without control characters, in UTF-8, is expected; rename it")
    composer, layers = read_layers(directory, settings)
    units: dict[str, UnitRow] = {}
    problems: dict[str, list[str]] = {}
    for name, row in layers.units_table.rows.items():
        try:
            texts = [text for _, text in layers.of(name)]
            overrides = {text.partition("=")[0].strip(): text.partition("=")[2].strip() for text in texts}
            units[name] = UnitRow(name, row, composer.unit(name, texts), overrides)
        except ConfigurationError as problem:
            for line in str(problem).splitlines():
                problems.setdefault(line, []).append(name)
    if problems:
        lines = [f"  unit {', '.join(shortened(names, 5))}: {text}" for text, names in problems.items()]
        raise ConfigurationError("the configuration is refused:\n" + "\n".join(lines), str(directory))
    _check_report_numbers(units, str(directory / "units.csv"))
    of_run = run_settings(layers.of_run)
    batches, chains = cut_batches(units, None if of_run.batch_size == "auto" else of_run.batch_size)
    batch_of = {unit: batch for batch, members in batches.items() for unit in members}
    split = [board for board, chips in boards_of(units).items() if len({batch_of[chip] for chip in chips}) > 1]
    if split:
        raise ConfigurationError(
            f"column board: the chips of {', '.join(shortened(split, 5))} are estimated together; "
            "expected consecutive rows with the same method",
            str(directory / "units.csv"),
        )
    results = Path(str(settings.get("results", "results"))) / directory.name
    compare = resolve_comparisons(layers.campaign.compare, units, str(directory / "campaign.yaml"))
    return Campaign(
        directory.name, directory, results, units, batches, chains, compare, layers.simulation, settings,
        layers.campaign.page, of_run.combine, of_run.publish_limit, _flag(settings.get(TAKE_OVER, False), TAKE_OVER),
    )  # fmt: skip


def _check_report_numbers(units: Mapping[str, UnitRow], file: str) -> None:
    """Refuse one number for the calibration reports of several units."""
    reports: dict[str, list[str]] = {}
    for name, unit in units.items():
        if number := unit.config.certificate.number_of(name, unit.row.get("serial", "")):
            reports.setdefault(number, []).append(name)
    for number, names in reports.items():
        if len(names) > 1:
            raise ConfigurationError(
                f"certificate.number={number}: the reports of units {', '.join(shortened(names, 5))} have one number; "
                "write {unit} or {serial} in it, or state it for one unit in devices/<unit>.yaml",
                file,
            )


def _flag(value: Any, name: str) -> bool:  # noqa: ANN401  (the user's)
    if str(value).lower() not in ("true", "false"):
        raise ConfigurationError(f"{name}: true or false is expected, got {value!r}")
    return str(value).lower() == "true"


def read_layers(directory: Path, settings: Mapping[str, Any]) -> tuple[Composer, Layers]:
    """Read the options, the units table and the overrides of a campaign and of the command line."""
    composer = Composer(directory, as_list(settings.get(PYTHON, []), PYTHON, "a list of paths of Python files"))
    return composer, load_layers(directory, settings, composer.options["sensor"])


def find_campaign(name: str) -> Path:
    """Return the directory of a campaign: ``name`` is a campaign of the package, or a directory with ``units.csv``.

    ``./NAME`` is a directory, also where a campaign of the package has that name.
    """
    of_package = [] if "/" in name or os.sep in name else [SHIPPED / "data" / name]
    for directory in (*of_package, Path(name)):
        if os.path.lexists(directory / "units.csv"):
            return directory.resolve()
    shipped = [d.parent.name for d in SHIPPED.glob("data/*/units.csv")]
    raise ConfigurationError(
        f"campaign {name!r}: neither data/{name} nor {name} holds a units.csv{nearest(name, shipped)}"
    )


def require_unit(unit: str, units: Collection[str], directory: Path) -> None:
    """Raise ``ConfigurationError`` if a campaign has no such unit."""
    if unit not in units:
        raise ConfigurationError(f"no unit {unit!r}{nearest(str(unit), units)}", str(directory / "units.csv"))


def run_settings(overrides: Sequence[str]) -> RunSettings:
    """Return the settings of the run from its overrides, weakest first; raises ``ConfigurationError``."""
    settings = {name: value for name, value in mapping_of(CONFIGS / "config.yaml").items() if name in RUN_SETTINGS}
    try:
        settings |= dict(map(parse, overrides))
        return RunSettings.model_validate(settings)
    except ValidationError as error:
        name = str(error.errors()[0]["loc"][0])
        expected = RunSettings.model_fields[name].description
        raise ConfigurationError(f"{name}={settings[name]}: {expected} is expected") from None


def cut_batches(
    units: Mapping[str, UnitRow], size: int | None
) -> tuple[dict[str, list[str]], dict[str, dict[str, list[str]]]]:
    """Divide the units of each method into batches, in the order of the units table.

    Appended units change only the last batch of their method. A batch has the stage ``effects`` if any of its units
    fits effects, so a changed list of effects does not change the batches. Without a size, a batch is as large as all
    batches before it together, within 25 to 160 units: a few units then run in parallel, and the start of jobs takes a
    small share of the time of a fleet.
    """
    by_chain: dict[str, list[str]] = {}
    for name, unit in units.items():
        method = unit.config.method
        methods = [method.name, *(method.of(sensor) or f"no_{sensor}" for sensor in SENSORS)]
        by_chain.setdefault("+".join(dict.fromkeys(methods)), []).append(name)
    batches: dict[str, list[str]] = {}
    chains: dict[str, dict[str, list[str]]] = {}
    for chain, names in by_chain.items():
        start = number = 0
        while start < len(names):
            number += 1
            stop = start + (size or min(max(SMALLEST_BATCH, start), LARGEST_BATCH))
            while 0 < stop < len(names) and (board := units[names[stop]].row.get("board")):
                if board != units[names[stop - 1]].row.get("board"):
                    break
                stop += 1  # the chips of a board are in one batch
            batch = f"{chain}-{number:04d}"
            batches[batch] = names[start:stop]
            configs = [units[n].config for n in batches[batch]]
            stages = {sensor: list(configs[0].method.stages.of(sensor) or ()) for sensor in SENSORS}
            effects = {sensor: any(last_stage(c, sensor) == EFFECTS_STAGE for c in configs) for sensor in SENSORS}
            chains[batch] = {sensor: [*stages[sensor], *[EFFECTS_STAGE] * effects[sensor]] for sensor in SENSORS}
            start = stop
    return batches, chains


def boards_of(units: Mapping[str, UnitRow]) -> dict[str, list[str]]:
    """Return the units of each board that has more than one."""
    boards: dict[str, list[str]] = {}
    for name, unit in units.items():
        if unit.row.get("board"):
            boards.setdefault(unit.row["board"], []).append(name)
    return {board: chips for board, chips in boards.items() if len(chips) > 1}


def resolve_comparisons(entries: Sequence[Any], units: Mapping[str, UnitRow], file: str) -> list[JSON]:
    """Return the comparisons of ``campaign.yaml`` (``file``) with their units; raises one ``ConfigurationError``.

    Returns
    -------
    list of dict
        ``title``; ``groups``, each ``name, series, label, units``; ``sensors``; ``against``; ``pairs`` (unit to the
        value that identifies its device) or None; ``x`` (``label``; ``values`` by unit, None for the table time;
        ``named``: whether points are labelled with their names) or None.
    """
    rows = {name: unit.row | {g: getattr(unit.config, g).name for g in GROUPS} for name, unit in units.items()}
    comparisons, problems = [], []
    for number, entry in enumerate(entries, 1):
        try:
            comparisons.append(_comparison(entry, number, rows))
        except SettingProblem as problem:
            title = entry.get("title") if isinstance(entry, dict) else None
            problems.append(f"compare, {f'{title!r}' if title else f'entry {number}'}: {problem}")
    if problems:
        raise ConfigurationError("\n  ".join(problems), file)
    return comparisons


def _cell(rows: SheetRows, unit: str, column: str) -> str:
    if column not in rows[unit]:
        raise SettingProblem(f"units have no column {column!r}{nearest(column, rows[unit])}")
    return str(rows[unit][column])


def _select(rows: SheetRows, wanted: Any, among: Sequence[str]) -> list[str]:  # noqa: ANN401  (the user's)
    """Return the units of a list of names, or those whose columns have the values of a mapping."""
    if isinstance(wanted, dict):
        values = {str(c): _names(v) for c, v in wanted.items()}
        return [u for u in among if all(_cell(rows, u, column) in valid for column, valid in values.items())]
    if not isinstance(wanted, list):
        form = "columns and their values, for example {method: staged}"
        raise SettingProblem(f"a list of units is expected, or {form}, got {wanted!r}")
    for name in map(str, wanted):
        if name not in rows:
            raise SettingProblem(f"no unit {name!r} in units.csv{nearest(name, rows)}")
    return [str(n) for n in wanted]


def _comparison(entry: Any, number: int, rows: SheetRows) -> JSON:  # noqa: ANN401  (the user's)
    entry = {"units": entry} if isinstance(entry, list) else entry
    if not isinstance(entry, dict):
        raise SettingProblem(f"{COMPARISON_FORM} is expected, got {entry!r}")
    unknown = [str(k) for k in entry if k not in COMPARISON_KEYS]
    if unknown:
        raise SettingProblem(f"{unknown[0]}: unknown key{nearest(unknown[0], COMPARISON_KEYS)}")
    groups = _groups(entry, rows)
    names, members = [g["name"] for g in groups], [u for g in groups for u in g["units"]]
    against = str(entry.get("against", names[0]))
    if against not in names:
        raise SettingProblem(f"against: no group is called {against!r}{nearest(against, names)}")
    sensors, pairs = _names(entry.get("sensors", list(SENSORS))), entry.get("pairs")
    if not set(sensors) <= set(SENSORS):
        raise SettingProblem(f"sensors: {' and '.join(SENSORS)} are known, got {', '.join(sensors)}")
    devices = {u: ", ".join(_cell(rows, u, c) for c in _names(pairs)) for u in members} if pairs else None
    x = _x(str(entry["x"]), members, _names(entry.get("by", [])), rows) if "x" in entry else None
    title = str(entry.get("title") or f"Comparison {number}")
    return {"title": title, "groups": groups, "sensors": sensors, "against": against, "pairs": devices, "x": x}


def _groups(entry: JSON, rows: SheetRows) -> list[JSON]:
    """Return the groups of an entry: at least two, none empty, without common units."""
    keys = [k for k in ("units", "groups", "by") if k in entry]
    if len(keys) != 1:
        raise SettingProblem(f"{COMPARISON_FORM} is expected, got {' and '.join(keys) or 'none of them'}")
    among, content = _select(rows, entry.get("where") or {}, list(rows)), entry[keys[0]]
    if keys[0] == "by":
        groups = _by(_names(content), str(entry.get("x", "")), among, rows)
    else:
        if keys[0] == "units":
            content = {unit: [unit] for unit in _select(rows, content, among)}
        if not isinstance(content, dict):
            raise SettingProblem(f"groups: a mapping of names to units or columns is expected, got {content!r}")
        units_of = {str(name): _select(rows, wanted, among) for name, wanted in content.items()}
        groups = [{"name": name, "series": "", "label": name, "units": units} for name, units in units_of.items()]
    group_of: dict[str, str] = {}
    for group in groups:
        if not group["units"]:
            raise SettingProblem(f"group {group['name']!r} is empty: no unit has these values")
        for unit in group["units"]:
            if unit in group_of:
                raise SettingProblem(f"unit {unit} is in {group_of[unit]!r} and in {group['name']!r}; it can be in one")
            group_of[unit] = group["name"]
    if len(groups) < 2:
        raise SettingProblem(f"two groups or more are expected, got {len(groups)}")
    return groups


def _by(names: list[str], x: str, among: list[str], rows: SheetRows) -> list[JSON]:
    """Return a group for each combination of values, in the order of the units table."""
    along = names.index(x) if x in names else len(names) - 1
    units_with: dict[tuple[str, ...], list[str]] = {}
    for unit in among:
        values = tuple(_cell(rows, unit, name) for name in names)
        if all(values):
            units_with.setdefault(values, []).append(unit)
    return [
        {"name": ", ".join(v), "series": ", ".join(v[:along] + v[along + 1 :]), "label": v[along], "units": units}
        for v, units in units_with.items()
    ]


def _x(column: str, members: list[str], by: list[str], rows: SheetRows) -> JSON:
    if column == TABLE_TIME:
        return {"label": "table time, s", "values": None, "named": True}
    values = {}
    for unit in members:
        text = _cell(rows, unit, column)
        try:
            values[unit] = float(text)
        except ValueError:
            values[unit] = math.nan
        if not math.isfinite(values[unit]):
            raise SettingProblem(f"x: unit {unit} has {text!r} in column {column!r}, which is no number")
    return {"label": column, "values": values, "named": column not in by}


def _names(value: Any) -> list[str]:  # noqa: ANN401  (the user's)
    """Return a value, or a list of values, as a list of texts."""
    values = value if isinstance(value, list) else [value]
    return [str(v) for v in values]
