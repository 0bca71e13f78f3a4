"""What a run found, in lines for the terminal: verdicts by sensor and effect, and the command to continue."""

from __future__ import annotations

import csv
import math
from typing import TYPE_CHECKING, Any, NamedTuple

from pipeline.command_lines import RESULTS, add_command, add_missing_command, explain_command, once_command
from pipeline.history import SENSORS, difference, dropped, of_units, read_history

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

UNITS = {"accelerometer": "g", "gyroscope": "deg/s"}
JSON = dict[str, Any]
ORDER = (
    "missing_effect", "reference_in_doubt", "unexplained", "floor_in_doubt", "left_by_method", "not_enough_data",
    "nothing_missing",
)  # fmt: skip
NAMED = 5  # units that a line names, and lines of one kind
SAME = 0.02  # relative change of an error, below which it is not told


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
    """Return units by the effect that they miss, and by each other verdict but ``nothing_missing``."""
    groups: dict[tuple[int, str], list[str]] = {}
    for unit, sensor, verdict, selected in findings:
        told = (
            [f"{effect} missing" for effect in selected] if verdict == "missing_effect" else [verdict.replace("_", " ")]
        )
        for what in told if verdict != "nothing_missing" else []:
            groups.setdefault((place(verdict), f"{sensor}, {what}"), []).append(unit)
    return [(what, units) for (_, what), units in sorted(groups.items())]


def place(verdict: str | None) -> int:
    """Return the place of a verdict: what can be added, then what is in doubt, in the order in which verdicts apply."""
    return ORDER.index(verdict) if verdict in ORDER else len(ORDER)


def verdict_lines(findings: Sequence[Finding]) -> list[str]:
    """Return ``verdict_groups`` as lines."""
    return [f"{what}: {_named(units)}" for what, units in verdict_groups(findings)]


def commands_of(
    part: Mapping[str, Any], sensor: str, unit: str, settings: Mapping[str, Any], results: str = RESULTS
) -> JSON:
    """Return the commands that add what a diagnosis selected: ``add`` for every run, ``once`` for one; else nothing.

    ``verb`` is what they are for: to add what is missing, or to try what does not explain all.

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
    verb = "add" if part["verdict"] == "missing_effect" else "try"
    return {
        "verb": f"{verb} {'it' if len(effects) == 1 else 'them'}",
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
    entries = read_history(results) if of_this_run else []
    if entries:
        lines += [*_changes(entries), *_dropped(entries, settings, str(results.parent))]
    lines += [f"{what}: {command}" for what, command in next_commands(findings, settings, str(results.parent))]
    return "\n".join(lines) + "\n"


def _changes(entries: Sequence[JSON]) -> list[str]:
    """Return a line for each sensor whose effects or error the last run has changed, the largest change first."""
    states = of_units(entries)
    found: list[tuple[float, str]] = []
    for unit in entries[-1]["units"]:
        if len(states[unit]) < 2 or not states[unit][-2][1]:
            continue
        before, after = (state for _, state in states[unit][-2:])
        change = difference(before, after)
        for sensor in SENSORS:
            parts = [state.get(sensor) or {} for state in (before, after)]
            errors = [float(part.get("error") or 0.0) for part in parts]
            words = ", ".join(change.words(sensor)).replace("\N{MINUS SIGN}", "-").replace("\N{RIGHTWARDS ARROW}", "->")
            if not all(errors):
                continue
            factor = abs(math.log(errors[1] / errors[0]))
            if factor < SAME and not change.added[sensor] and not change.removed[sensor]:
                continue
            floor = parts[1].get("floor")
            ratio = f", {errors[1] / floor:.3g} times the noise floor" if floor else ""
            told = f"held-out error {errors[0]:.3g} -> {errors[1]:.3g} {UNITS[sensor]}{ratio}"
            found.append((factor, f"{unit}, {sensor}: {words}; {told}"))
    lines = [line for _, line in sorted(found, key=lambda f: -f[0])]
    more = len(lines) - NAMED
    return [*lines[:NAMED], *([f"and {more} more sensors that changed"] * (more > 0))]


def _dropped(entries: Sequence[JSON], settings: Mapping[str, Any], results: str) -> list[str]:
    """Return a line for each unit whose effects an earlier run had and this one has not."""
    by_unit: dict[tuple[str, int], list[str]] = {}
    for unit, sensor, effect, run in dropped(entries):
        by_unit.setdefault((unit, run), []).append(f"{sensor}.{effect}")
    lines = [
        f"{unit}: this run no longer has {', '.join(effects)}, which run {run} had; "
        f"to have it in every run: {add_command(settings, unit, effects, results)}"
        for (unit, run), effects in by_unit.items()
    ]
    more = len(lines) - NAMED
    return [*lines[:NAMED], *([f"and {more} more units that no longer have an effect"] * (more > 0))]


def _named(units: Sequence[str]) -> str:
    more = f" and {len(units) - NAMED} more" if len(units) > NAMED else ""
    return ", ".join(units[:NAMED]) + more
