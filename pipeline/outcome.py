"""What a run found, in lines for the terminal: verdicts by sensor and effect, and the command to continue."""

from __future__ import annotations

import csv
from typing import TYPE_CHECKING, Any, NamedTuple

from pipeline.command_lines import RESULTS, add_command, add_missing_command, explain_command, once_command
from pipeline.history import SENSORS, dropped, of_units, read_history

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

UNITS = {"accelerometer": "g", "gyroscope": "deg/s"}
JSON = dict[str, Any]
NAMED = 5  # units that a line names


class Finding(NamedTuple):
    """The verdict on one sensor of a unit."""

    unit: str
    sensor: str
    verdict: str
    selected: Sequence[str]


def read_summary(results: Path) -> list[dict[str, str]]:
    """Return the rows of a campaign's ``summary.csv``."""
    with (results / "summary.csv").open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def findings_of(rows: Sequence[Mapping[str, Any]]) -> list[Finding]:
    """Return the verdicts in rows as of ``summary.csv``."""
    return [
        Finding(
            row["unit"],
            sensor,
            row[f"{sensor}_verdict"],
            [n for n in (row[f"{sensor}_selected"] or "").split(";") if n],
        )
        for row in rows
        for sensor in SENSORS
        if row.get(f"{sensor}_verdict")
    ]


def verdict_groups(findings: Sequence[Finding]) -> list[tuple[str, list[str]]]:
    """Return units by the effect that they miss, then by each other verdict but ``nothing_missing``."""
    missing: dict[str, list[str]] = {}
    others: dict[str, list[str]] = {}
    for unit, sensor, verdict, selected in findings:
        if verdict == "missing_effect":
            for effect in selected:
                missing.setdefault(f"{sensor}, {effect} missing", []).append(unit)
        elif verdict != "nothing_missing":
            others.setdefault(f"{sensor}, {verdict.replace('_', ' ')}", []).append(unit)
    return [*sorted(missing.items()), *sorted(others.items())]


def verdict_lines(findings: Sequence[Finding]) -> list[str]:
    """Return ``verdict_groups`` as lines."""
    return [f"{what}: {_named(units)}" for what, units in verdict_groups(findings)]


def commands_of(
    part: Mapping[str, Any], sensor: str, unit: str, settings: Mapping[str, Any], results: str = RESULTS
) -> JSON:
    """Return the commands that add what a diagnosis selected: ``add`` for every run, ``once`` for one; else nothing.

    Parameters
    ----------
    part : mapping
        The sensor's part of ``diagnoses/<unit>.json``.
    sensor, unit : str
    settings : mapping
        Of the run.
    results : str
        Folder of the results of all campaigns.
    """
    if not part.get("override"):
        return {}
    effects = [f"{sensor}.{name}" for name in part["selected"]]
    return {
        "add": add_command(settings, unit, effects, results),
        "once": once_command(settings, unit, part["override"], results),
    }


def next_commands(
    findings: Sequence[Finding], settings: Mapping[str, Any], results: str = RESULTS
) -> list[tuple[str, str]]:
    """Return the commands to continue with, each behind what it is for.

    Parameters
    ----------
    findings : sequence of Finding
    settings : mapping
        Of the run.
    results : str
        Folder of the results of all campaigns.
    """
    missing: dict[str, list[str]] = {}
    for unit, sensor, verdict, selected in findings:
        if verdict == "missing_effect":
            missing.setdefault(unit, []).extend(f"{sensor}.{effect}" for effect in selected)
    lines = []
    if len(missing) == 1:
        ((unit, effects),) = missing.items()
        lines.append(("to add what is missing", add_command(settings, unit, effects, results)))
    elif missing:
        lines.append(("to add to each what it misses", add_missing_command(settings, results)))
    if any(f.verdict != "nothing_missing" for f in findings):
        lines.append(("for the evidence", explain_command(settings, results)))
    return lines


def outcome(results: Path, settings: Mapping[str, Any], *, of_this_run: bool) -> str:
    """Return the last lines of a run but those of failed units.

    Parameters
    ----------
    results : Path
        Of the campaign.
    settings : mapping
        Of the run.
    of_this_run : bool
        Whether the last entry of the history is of this run.
    """
    rows = read_summary(results)
    calibrated = sum(row["status"] == "ok" for row in rows)
    failed = f", failed: {len(rows) - calibrated}" if calibrated < len(rows) else ""
    findings = findings_of(rows)
    lines = [f"units calibrated: {calibrated}{failed}; look at {results}/index.html", *verdict_lines(findings)]
    if of_this_run:
        lines += _dropped(results, settings)
    lines += [f"{what}: {command}" for what, command in next_commands(findings, settings, str(results.parent))]
    return "\n".join(lines) + "\n"


def _dropped(results: Path, settings: Mapping[str, Any]) -> list[str]:
    """Return a line for each unit whose effects an earlier run had and this one has not."""
    entries = read_history(results)
    states = of_units(entries)
    by_unit: dict[str, list[tuple[str, str]]] = {}
    for unit, sensor, effect, _ in dropped(entries):
        by_unit.setdefault(unit, []).append((sensor, effect))
    lines = []
    for unit, effects in list(by_unit.items())[:NAMED]:
        (run, before), (_, after) = states[unit][-2:]
        sensor = effects[0][0]
        errors = [state[sensor]["error"] for state in (before, after)]
        rise = f"; its held-out error: {errors[0]:.3g} -> {errors[1]:.3g} {UNITS[sensor]}" if None not in errors else ""
        names = [f"{s}.{e}" for s, e in effects]
        again = add_command(settings, unit, names, str(results.parent))
        lines.append(
            f"{unit}: this run no longer has {', '.join(names)}, which run {run} had{rise}; "
            f"to have it in every run: {again}"
        )
    more = len(by_unit) - NAMED
    return [*lines, *([f"and {more} more units that no longer have an effect"] * (more > 0))]


def _named(units: Sequence[str]) -> str:
    more = f" and {len(units) - NAMED} more" if len(units) > NAMED else ""
    return ", ".join(units[:NAMED]) + more
