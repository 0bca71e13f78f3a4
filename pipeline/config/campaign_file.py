"""``campaign.yaml``: what a campaign says of all its units, of the run, and of its page.

For example::

    overrides: [filter=rc_low_pass]   # Hydra overrides of every unit, and settings of the run
    models: {mpu6050: [filter=none]}  # of the units of a sensor model
    lots: {"12": [filter.order=2]}    # of the units of a production lot
    compare: [[U1, U2]]               # what the campaign's page compares; see pipeline.config.comparisons
    simulate: true                    # the run makes the recordings, from simulation.yaml beside this file
    page: thesis                      # the run makes this page too, beside the campaign's own

All of it is optional.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from pipeline.config.compose import RUN_SETTINGS, nearest
from pipeline.config.user_effects import ONLY_FROM_THE_COMMAND_LINE, PYTHON
from pipeline.errors import ConfigurationError
from pipeline.io.files import not_regular
from pipeline.io.yaml_file import read_yaml

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

KEYS = ("overrides", "models", "lots", "compare", "simulate", "page")
PAGES = ("thesis",)  # that a campaign may ask for: python -m pipeline PAGE page
SIMULATION = "simulation.yaml"


@dataclass(frozen=True)
class CampaignFile:
    """What ``campaign.yaml`` holds.

    Attributes
    ----------
    of_units, of_run : list of str
        Overrides of all units, and those that are settings of the run.
    models, lots : dict of str to list of str
        Overrides by sensor model, and by production lot.
    compare : list
        What the campaign's page compares, as it stands there.
    simulation : Path or None
        The description that the run makes the recordings from; None where they are recorded.
    page : str or None
        A page of its own that the campaign asks for, of ``PAGES``.
    """

    of_units: list[str] = field(default_factory=list)
    of_run: list[str] = field(default_factory=list)
    models: dict[str, list[str]] = field(default_factory=dict)
    lots: dict[str, list[str]] = field(default_factory=dict)
    compare: list[Any] = field(default_factory=list)
    simulation: Path | None = None
    page: str | None = None


def read_campaign_file(path: Path) -> CampaignFile:
    """Read ``campaign.yaml``; all of it is optional.

    Parameters
    ----------
    path : Path

    Raises
    ------
    ConfigurationError
        If it is not as it should be.
    """
    if not os.path.lexists(path):
        return CampaignFile()
    content = _mapping(path)
    run, units = split_run_settings(as_list(content.get("overrides", []), f"{path}: overrides"))
    compare = content.get("compare") or []
    if not isinstance(compare, list):
        raise ConfigurationError(f"compare: a list of comparisons is expected, got {compare!r}", str(path))
    models, lots = (_by_name(content, key, path) for key in ("models", "lots"))
    return CampaignFile(units, run, models, lots, compare, _simulation(content, path), _page(content, path))


def unknown_key(content: Mapping[Any, Any], known: Sequence[str]) -> None:
    """Refuse a key that is not known, with the nearest that is."""
    unknown = [str(k) for k in content if k not in known]
    if unknown:
        raise ConfigurationError(f"{unknown[0]}: unknown key{nearest(unknown[0], known)}")


def as_list(value: Any, where: str, what: str = "overrides KEY=VALUE") -> list[str]:  # noqa: ANN401  (the user's)
    """Return overrides as a list: a list of strings as it is, a plain string as one."""
    if isinstance(value, str):
        value = [value]
    if not isinstance(value, (list, tuple)) or not all(isinstance(v, str) for v in value):
        raise ConfigurationError(f"{where}: a list of {what} is expected, got {value!r}")
    return list(value)


def split_run_settings(overrides: Sequence[str]) -> tuple[list[str], list[str]]:
    """Split overrides into those of the run and those of units."""
    run = [o for o in overrides if o.lstrip("+").split("=")[0] in RUN_SETTINGS]
    return run, [o for o in overrides if o not in run]


def _mapping(path: Path) -> dict[str, Any]:
    content = read_yaml(path) or {}
    if not isinstance(content, dict):
        raise ConfigurationError("must be a mapping, for example 'overrides: [filter=rc_low_pass]'", str(path))
    if PYTHON in content:
        raise ConfigurationError(f"{PYTHON}: {ONLY_FROM_THE_COMMAND_LINE}", str(path))
    try:
        unknown_key(content, KEYS)
    except ConfigurationError as error:
        raise ConfigurationError(error.message, str(path)) from None
    return {str(k): v for k, v in content.items()}


def _by_name(content: Mapping[str, Any], key: str, path: Path) -> dict[str, list[str]]:
    """Return the overrides of each sensor model, or of each lot."""
    named = content.get(key) or {}
    if not isinstance(named, dict):
        raise ConfigurationError(f"{key}: names with a list of overrides each are expected, got {named!r}", str(path))
    found = {str(name): as_list(value, f"{path}: {key}, {name}") for name, value in named.items()}
    for name, overrides in found.items():
        run, _ = split_run_settings(overrides)
        if run:
            raise ConfigurationError(f"{key}, {name}: {run[0]} is a setting of the run, not of units", str(path))
    return found


def _simulation(content: Mapping[str, Any], path: Path) -> Path | None:
    """Return the description to simulate, where the campaign asks for it."""
    asked = content.get("simulate", False)
    if not isinstance(asked, bool):
        raise ConfigurationError(f"simulate: true or false is expected, got {asked!r}", str(path))
    if not asked:
        return None
    description = path.with_name(SIMULATION)
    if not os.path.lexists(description):
        raise ConfigurationError(f"simulate: true needs {SIMULATION} beside it, which does not exist", str(path))
    other = not_regular(description)
    if other:
        raise ConfigurationError(other, str(description))
    return description


def _page(content: Mapping[str, Any], path: Path) -> str | None:
    """Return the page that the campaign asks for beside its own."""
    page = content.get("page")
    if page is not None and page not in PAGES:
        raise ConfigurationError(f"page: {page!r} is not known{nearest(str(page), PAGES)}", str(path))
    return page
