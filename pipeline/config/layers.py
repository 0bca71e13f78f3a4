"""The overrides of each unit, layer by layer, weakest first, each with the place that it comes from.

    campaign.yaml < models < lots < devices/<name>.yaml < units.csv < overrides= < unit_overrides=

where

    models, lots : keys of ``campaign.yaml``: the name of a sensor config, or a lot of ``units.csv``, to overrides
    devices      : folder of the campaign with a file ``{overrides: [...]}`` for a serial or a unit of ``units.csv``;
                   the file of a unit is stronger than that of its serial
    units.csv    : the columns that name a config of a group, then those of the column ``overrides``
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

from pipeline.config.campaign_file import as_list, split_run_settings, unknown_key
from pipeline.config.compose import GROUPS, Problem, default_option, nearest, parse
from pipeline.errors import ConfigurationError
from pipeline.io.yaml_file import read_yaml

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    from pipeline.config.campaign_file import CampaignFile
    from pipeline.config.sheet import Sheet

DEVICES = "devices"
BETWEEN_OVERRIDES = re.compile(r';(?=(?:[^"]*"[^"]*")*[^"]*$)')  # a semicolon outside double quotes


class Layer(NamedTuple):
    """One override and where it stands."""

    origin: str
    text: str


@dataclass(frozen=True)
class Layers:
    """Everything that overrides settings of units.

    Attributes
    ----------
    sheet : Sheet
    campaign : CampaignFile
    devices : dict of str to list of str
        Serial or unit to the overrides of its file.
    command : list of str
        ``overrides=`` of the command line.
    per_unit : dict of str to list of str
        ``unit_overrides=`` of the command line.
    """

    sheet: Sheet
    campaign: CampaignFile
    devices: dict[str, list[str]] = field(default_factory=dict)
    command: list[str] = field(default_factory=list)
    per_unit: dict[str, list[str]] = field(default_factory=dict)

    def of(self, unit: str) -> list[Layer]:
        """Return a unit's overrides, weakest first."""
        row, line = self.sheet.rows[unit], f"units.csv line {self.sheet.lines[unit]}"
        own = [o for o in map(str.strip, BETWEEN_OVERRIDES.split(row.get("overrides", ""))) if o]
        lot = row.get("lot", "")
        above = [
            *_from(f"campaign.yaml, lots, {lot}", self.campaign.lots.get(lot, ())),
            *(
                layer
                for name in dict.fromkeys([row.get("serial", ""), unit])
                for layer in _from(f"{DEVICES}/{name}.yaml", self.devices.get(name, ()))
            ),
            *(Layer(f"{line}, column {g}", f"{g}={row[g]}") for g in GROUPS if row.get(g)),
            *_from(f"{line}, column overrides", own),
            *_from("command line, overrides=", self.command),
            *_from("command line, unit_overrides=", self.per_unit.get(unit, ())),
        ]
        below = _from("campaign.yaml", self.campaign.of_units)
        if not self.campaign.models:
            return [*below, *above]
        model = self._model([*below, *above])
        return [*below, *_from(f"campaign.yaml, models, {model}", self.campaign.models.get(model, ())), *above]

    def _model(self, layers: Iterable[Layer]) -> str:
        """Return the sensor config that a unit ends up with."""
        chosen = [text.partition("=")[2].strip() for _, text in layers if text.partition("=")[0].strip() == "sensor"]
        return chosen[-1] if chosen else default_option("sensor")


def read_devices(directory: Path, sheet: Sheet) -> dict[str, list[str]]:
    """Read ``devices/*.yaml`` of a campaign: serial or unit to overrides.

    Raises
    ------
    ConfigurationError
        In one message, for each file that is not as it should be or concerns no unit.
    """
    files = sorted((directory / DEVICES).glob("*.yaml"))
    if not files:
        return {}
    known = set(sheet.rows) | {row["serial"] for row in sheet.rows.values() if row.get("serial")}
    found, problems = {}, []
    for file in files:
        try:
            found[file.stem] = _device(file, known)
        except ConfigurationError as error:
            problems.append(f"{error.file or file}: {error.message}")
    if problems:
        more = [f"and {len(problems) - 5} more files"] * (len(problems) > 5)
        raise ConfigurationError("the configuration is refused:\n  " + "\n  ".join([*problems[:5], *more]))
    return found


def check_models_and_lots(campaign: CampaignFile, sheet: Sheet, sensors: Iterable[str], file: str) -> None:
    """Refuse overrides of models and lots that do not exist, and models that choose another model.

    Raises
    ------
    ConfigurationError
    """
    lots = {row["lot"] for row in sheet.rows.values() if row.get("lot")}
    for key, named, known in (("models", campaign.models, set(sensors)), ("lots", campaign.lots, lots)):
        for name, overrides in named.items():
            if name not in known:
                what = "sensor config" if key == "models" else "lot of units.csv"
                raise ConfigurationError(f"{key}: no {what} is called {name!r}{nearest(name, known)}", file)
            if key == "models" and any(_key(o) == "sensor" for o in overrides):
                raise ConfigurationError(f"models, {name}: the overrides of a model cannot choose another", file)


def unit_overrides(value: Any, rows: Mapping[str, Any]) -> dict[str, list[str]]:  # noqa: ANN401
    """Check ``unit_overrides``: unit name to a list of overrides, of units that exist."""
    if not isinstance(value, dict):
        form = """'unit_overrides={U1: [filter.cutoff_hz=5, "effects.gyroscope=[g_sensitivity]"]}'"""
        raise ConfigurationError(f"unit_overrides: {form} is the form (lists within are quoted), got {value!r}")
    for name in value:
        if str(name) not in rows:
            raise ConfigurationError(f"unit_overrides: no unit {name!r} in units.csv{nearest(str(name), rows)}")
    return {str(name): as_list(v, f"unit_overrides of {name}") for name, v in value.items()}


def _from(origin: str, texts: Iterable[str]) -> list[Layer]:
    return [Layer(origin, text) for text in texts]


def _key(text: str) -> str:
    try:
        return parse(text)[0]
    except Problem as problem:
        raise ConfigurationError(str(problem)) from problem


def _device(file: Path, known: set[str]) -> list[str]:
    if file.stem not in known:
        raise ConfigurationError(f"no unit or serial {file.stem!r} in units.csv{nearest(file.stem, known)}")
    content = read_yaml(file) or {}
    if not isinstance(content, dict):
        raise ConfigurationError("a mapping is expected, for example 'overrides: [filter.cutoff_hz=5]'")
    unknown_key(content, ("overrides",))
    run, overrides = split_run_settings(as_list(content.get("overrides") or [], "overrides"))
    if run:
        raise ConfigurationError(f"{run[0]}: is a setting of the run, not of a device; set it in campaign.yaml")
    return overrides
