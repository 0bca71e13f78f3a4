"""The commands that a page, a diagnosis and the end of a run give to the user, quoted for a POSIX shell.

One style: a word that the shell would change stands in single quotes; within it, YAML with double quotes where needed.
"""

from __future__ import annotations

import json
import re
import shlex
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

PLAIN = re.compile(r"[A-Za-z_][A-Za-z0-9_.=/+-]*")  # texts that YAML reads as they stand, within brackets too
NOT_TEXT = {"true", "false", "yes", "no", "on", "off", "null", "y", "n"}  # words that YAML reads as another type
EFFECTS = re.compile(r"effects\.(accelerometer|gyroscope)=\[(.*)\]")
CORES = "--cores 2"
RESULTS = "results"  # the default folder of results


def run_command(settings: Mapping[str, Any]) -> str:
    """Return the command of a run.

    Parameters
    ----------
    settings : mapping
        As given by ``--config``: ``campaign``, ``overrides``, ``unit_overrides``, ``results`` ...
    """
    words = [shlex.quote(f"{key}={_flow(value, top=True)}") for key, value in settings.items() if value]
    return " ".join(["snakemake", CORES, *(["--config"] * bool(words)), *words])


def add_command(settings: Mapping[str, Any], unit: str, effects: Sequence[str], results: str = RESULTS) -> str:
    """Return the command that adds effects to a unit's own settings and runs the campaign.

    Effects that ``unit_overrides`` gave the unit for one run are added with them, or the override would be stronger.

    Parameters
    ----------
    settings : mapping
        Of the run, as of ``run_command``.
    unit : str
    effects : sequence of str
        ``sensor.effect``.
    results : str
        Folder of the results of all campaigns.
    """
    of_units = dict(settings.get("unit_overrides") or {})
    kept, given = [], []
    for override in of_units.pop(unit, []):
        found = EFFECTS.fullmatch(override)
        if found:
            given += [f"{found[1]}.{name.strip()}" for name in found[2].split(",") if name.strip()]
        else:
            kept.append(override)
    rest = {k: v for k, v in settings.items() if k != "unit_overrides"}
    of_units |= {unit: kept} if kept else {}
    rest |= {"unit_overrides": of_units} if of_units else {}
    return _pipeline("add", rest, [unit, *dict.fromkeys([*given, *effects])], results)


def add_missing_command(settings: Mapping[str, Any], results: str = RESULTS) -> str:
    """Return the command that adds to each unit the effects that its diagnosis found to be missing."""
    return _pipeline("add", settings, ["--missing"], results)


def explain_command(settings: Mapping[str, Any], results: str = RESULTS) -> str:
    """Return the command that prints the diagnoses of a campaign."""
    return _pipeline("explain", {"campaign": settings.get("campaign", "demo")}, [], results)


def once_command(settings: Mapping[str, Any], unit: str, override: str, results: str = RESULTS) -> str:
    """Return the command that runs the campaign with one more override of a unit, for this run only."""
    given = dict(settings)
    own = {**given.pop("unit_overrides", {})}
    key = override.partition("=")[0]
    kept = [text for text in own.get(unit, []) if text.partition("=")[0] != key]
    given |= {"unit_overrides": own | {unit: [*kept, override]}}
    return run_command(given | ({"results": results} if results != RESULTS else {}))


def _pipeline(command: str, settings: Mapping[str, Any], words: Sequence[str], results: str) -> str:
    rest = dict(settings)
    campaign = str(rest.pop("campaign", "demo"))
    parts = ["python", "-m", "pipeline", command, campaign.rstrip("/") if command == "explain" else campaign, *words]
    parts += ["--results", results] * (results != RESULTS)
    given = [f"{key}={_flow(value, top=True)}" for key, value in rest.items() if value and key != "results"]
    return shlex.join([*parts, *(["--config"] * bool(given)), *given])


def _flow(value: Any, *, top: bool = False) -> str:  # noqa: ANN401  (what a command line may hold)
    """Return a value as YAML on one line."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_flow(str(k))}: {_flow(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_flow(v) for v in value) + "]"
    if isinstance(value, str) and (top or (PLAIN.fullmatch(value) and value.lower() not in NOT_TEXT)):
        return value
    return json.dumps(value, ensure_ascii=False)
