"""A campaign: its directory, its units with their configurations, and the batches in which they are worked on."""

from __future__ import annotations

import csv
import json
import re
import shlex
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.config.campaign_file import as_list, read_campaign_file, split_run_settings
from pipeline.config.comparisons import resolve_comparisons
from pipeline.config.compose import CONFIGS, GROUPS, Composer, Problem, default_of_run, nearest, parse
from pipeline.config.user_effects import ONLY_FROM_THE_COMMAND_LINE, PYTHON
from pipeline.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

SHIPPED = CONFIGS.parent / "data"
UNIT_NAME = re.compile(r"[A-Za-z0-9._-]+")
FREE_COLUMNS = ("serial", "lot", "date")
SMALLEST_BATCH, LARGEST_BATCH = 10, 100


@dataclass(frozen=True)
class UnitRow:
    """One unit: its row of ``units.csv`` and its configuration."""

    name: str
    row: dict[str, str]
    config: dict[str, Any]


@dataclass(frozen=True)
class Campaign:
    """A campaign with everything resolved.

    Attributes
    ----------
    name : str
        Under which its results are found.
    directory : Path
    results : Path
        ``<results>/<name>``.
    units : dict of str to UnitRow
        In the order of ``units.csv``.
    batches : dict of str to list of str
        Units of one chain of stages, cut in the order of ``units.csv``.
    chains : dict of str to dict
        Batch and sensor to the ordered stages of its fit.
    compare : list
        What the campaign's page compares, resolved to groups of units.
    simulation : Path or None
        The description that the run makes the recordings from; None where they are recorded.
    settings : mapping
        What ``snakemake --config`` gave.
    page : str or None
        A page of its own that the campaign asks for, beside the campaign's.
    """

    name: str
    directory: Path
    results: Path
    units: dict[str, UnitRow]
    batches: dict[str, list[str]]
    chains: dict[str, dict[str, list[str]]] = field(default_factory=dict)
    compare: list[Any] = field(default_factory=list)
    simulation: Path | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    page: str | None = None

    @property
    def recorded(self) -> Path:
        """Where the recordings are: in the campaign's directory, or among the results of the run that makes them."""
        return self.directory if self.simulation is None else self.results.absolute() / "simulated"

    def command(self, unit: str) -> str:
        """Return the command that makes a unit's results again, with the settings of this run that concern it."""
        given = {k: v for k, v in self.settings.items() if k != "results" and v}
        own = given.get("unit_overrides", {}).get(unit)
        given = {k: v for k, v in given.items() if k != "unit_overrides"} | (
            {"unit_overrides": {unit: own}} if own else {}
        )
        words = [shlex.quote(f"{k}={v if isinstance(v, str) else json.dumps(v)}") for k, v in given.items()]
        return " ".join(["snakemake --cores 2", *(["--config"] * bool(words)), *words])

    def folder(self, unit: str) -> Path:
        """Return where a unit's recordings lie."""
        folder: str = self.units[unit].config["procedure"]["folder"]
        return self.recorded / folder

    def truth(self, unit: str) -> Path:
        """Return where the truth behind a unit's recordings is, if they were simulated."""
        return self.recorded / "truth" / f"{self.folder(unit).name}.json"


def load_campaign(settings: Mapping[str, Any]) -> Campaign:
    """Load and check a campaign.

    Parameters
    ----------
    settings : mapping
        What ``snakemake --config`` gave: ``campaign``, ``results``, ``overrides``, ``unit_overrides``,
        ``python_effects``.

    Raises
    ------
    ConfigurationError
        With one message for everything that is wrong.
    """
    valid = ("campaign", "results", "overrides", "unit_overrides", PYTHON)
    unknown = sorted(set(settings) - set(valid))
    if unknown:
        raise ConfigurationError(f"--config {unknown[0]}: unknown setting{nearest(unknown[0], valid)}")
    directory = find_campaign(str(settings.get("campaign", "demo")))
    rows = read_units(directory / "units.csv")
    own_file = read_campaign_file(directory / "campaign.yaml")
    from_command = as_list(settings.get("overrides", []), "overrides")
    per_unit = unit_overrides(settings.get("unit_overrides", {}), rows)
    of_run, from_command = split_run_settings([*own_file.of_run, *from_command])
    composer = Composer(directory, as_list(settings.get(PYTHON, []), PYTHON, "paths of Python files"))
    units: dict[str, UnitRow] = {}
    problems: dict[str, list[str]] = {}
    for name, row in rows.items():
        groups = [f"{g}={row[g]}" for g in GROUPS if row.get(g)]
        own = [o.strip() for o in row.get("overrides", "").split(";") if o.strip()]
        try:
            config = composer.unit(name, [*own_file.of_units, *groups, *own, *from_command, *per_unit.get(name, [])])
            units[name] = UnitRow(name, row, config)
        except Problem as problem:
            for line in str(problem).splitlines():
                problems.setdefault(line, []).append(name)
    if problems:
        raise ConfigurationError(_one_message(problems), str(directory / "units.csv"))
    batches, chains = cut_batches(units, batch_size(of_run))
    results = Path(str(settings.get("results", "results"))) / directory.name
    compare = resolve_comparisons(own_file.compare, units, str(directory / "campaign.yaml"))
    return Campaign(
        directory.name,
        directory,
        results,
        units,
        batches,
        chains,
        compare,
        own_file.simulation,
        settings,
        own_file.page,
    )


def find_campaign(name: str) -> Path:
    """Return the directory of a campaign: one that ships, by name, or any directory with a ``units.csv``."""
    for directory in (SHIPPED / name, Path(name)):
        if (directory / "units.csv").is_file():
            return directory.resolve()
    shipped = [d.parent.name for d in SHIPPED.glob("*/units.csv")]
    raise ConfigurationError(
        f"campaign {name!r}: neither data/{name} nor {name} holds a units.csv{nearest(name, shipped)}"
    )


def read_units(path: Path) -> dict[str, dict[str, str]]:
    """Read ``units.csv``: unit name to row; refuses bad names, duplicates and ragged rows, all in one message."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            reader = csv.DictReader(stream, strict=True)
            columns = [c.strip() for c in reader.fieldnames or []]
            reader.fieldnames = columns
            rows = [(reader.line_num, row) for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ConfigurationError(f"cannot be read: {error}", str(path)) from error
    if PYTHON in columns:
        raise ConfigurationError(f"column {PYTHON}: {ONLY_FROM_THE_COMMAND_LINE}", f"{path}:1")
    if "unit" not in columns:
        raise ConfigurationError(f"has no column 'unit'; its columns are {', '.join(columns) or 'none'}", f"{path}:1")
    found: dict[str, dict[str, str]] = {}
    problems = [f"line 1: column {c!r} stands twice" for c in sorted({c for c in columns if columns.count(c) > 1})]
    for line, raw in rows:
        if None in raw or any(v is None for v in raw.values()):
            problems.append(f"line {line}: {len(columns)} columns expected, as in the header")
            continue
        row = {k: v.strip() for k, v in raw.items()}
        name = row["unit"]
        if not UNIT_NAME.fullmatch(name) or name in (".", ".."):
            problems.append(f"line {line}: unit {name!r}: use letters, digits, '.', '_', '-'")
        elif name in found:
            problems.append(f"line {line}: unit {name!r} stands twice")
        else:
            found[name] = row
    if not found and not problems:
        problems.append("has no units")
    if problems:
        raise ConfigurationError("; ".join(problems), str(path))
    return found


def unit_overrides(value: Any, rows: Mapping[str, Any]) -> dict[str, list[str]]:  # noqa: ANN401
    """Check ``unit_overrides``: unit name to a list of overrides, of units that exist."""
    if not isinstance(value, dict):
        form = """'unit_overrides={U1: [filter.cutoff_hz=5, "effects.gyroscope=[g_sensitivity]"]}'"""
        raise ConfigurationError(f"unit_overrides: {form} is the form (lists within are quoted), got {value!r}")
    for name in value:
        if str(name) not in rows:
            raise ConfigurationError(f"unit_overrides: no unit {name!r} in units.csv{nearest(str(name), rows)}")
    return {str(name): as_list(v, f"unit_overrides of {name}") for name, v in value.items()}


def batch_size(overrides: Sequence[str]) -> int | None:
    """Return the batch size that the run's overrides ask for, None for ``auto``."""
    size = default_of_run("batch_size")
    for text in overrides:
        try:
            size = parse(text).value()
        except Problem as problem:
            raise ConfigurationError(str(problem)) from problem
    if size == "auto":
        return None
    if not isinstance(size, int) or isinstance(size, bool) or size < 1:
        raise ConfigurationError(f"batch_size={size}: auto or a whole number from 1 on is expected")
    return size


def cut_batches(
    units: Mapping[str, UnitRow], size: int | None
) -> tuple[dict[str, list[str]], dict[str, dict[str, list[str]]]]:
    """Cut units of one chain of stages into batches, in the order of the sheet.

    Appending units touches the last batch of their chain only. Whether effects are fitted does not cut batches anew:
    a batch has the stage if any of its units asks for it. Without a size, batches hold 10, 10, 20, 20, 40, 40, 80, 80
    and then 100 units: a bench runs side by side, and a fleet does not spend its time on starting jobs.
    """
    by_chain: dict[str, list[str]] = {}
    for name, unit in units.items():
        method = unit.config["method"]
        parts = dict.fromkeys([method["name"], method["accelerometer"], method["gyroscope"]])
        by_chain.setdefault("+".join(parts), []).append(name)
    batches: dict[str, list[str]] = {}
    chains: dict[str, dict[str, list[str]]] = {}
    for chain, names in by_chain.items():
        rest = names
        for number in count():
            now = size or min(SMALLEST_BATCH * 2 ** (number // 2), LARGEST_BATCH)
            batch = f"{chain}-{number + 1:04d}"
            batches[batch], rest = rest[:now], rest[now:]
            configs = [units[n].config for n in batches[batch]]
            chains[batch] = {
                sensor: configs[0]["method"]["stages"][sensor]
                + (["effects"] if any(c["effects"][sensor] for c in configs) else [])
                for sensor in ("accelerometer", "gyroscope")
            }
            if not rest:
                break
    return batches, chains


def _one_message(problems: Mapping[str, list[str]]) -> str:
    lines = []
    for text, names in problems.items():
        more = f" and {len(names) - 5} more" if len(names) > 5 else ""
        lines.append(f"  unit {', '.join(names[:5])}{more}: {text}")
    return "the configuration is refused:\n" + "\n".join(lines)
