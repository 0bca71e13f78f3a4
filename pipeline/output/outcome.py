"""Build the closing lines that a run prints to the terminal, and the commands that it proposes.

Commands are quoted for a POSIX shell: single quotes enclose a word that the shell would change, and YAML within it
uses double quotes.
"""

from __future__ import annotations

import csv
import json
import math
import re
import shlex
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from imu_logs.units import SENSOR_UNITS, SENSORS
from pipeline.core.errors import shortened
from pipeline.core.files import INSTALLED, JSON, read_json, text_of_cell
from pipeline.core.verdicts import (
    FAILED,
    KINDS,
    NOT_CONVERGED,
    READY,
    SETTING,
    WITH_THEM,
    Problem,
    RowState,
    Verdict,
    decided_words,
    largest_over_noise,
    problems,
    state_of,
)
from pipeline.output.history import difference, dropped, errors_of, of_units, read_history

Ways = Sequence[Sequence[str]]

ZERO_SETTING = re.compile(r"(?<=zero_deg=)-?[0-9.]+")
ALIKE_DEG = 0.1  # gravity shows a zero to some hundredths of a degree (docs/mounting.md, What is checked)
NAMED_PER_LINE = 5  # units that a line names, and lines of one kind
NAMED_MISSING = 10  # units with a missing effect that the last lines name
SMALLEST_CHANGE = 0.02  # relative change of an error that is reported
PLAIN_YAML_TEXT = re.compile(r"[A-Za-z_][A-Za-z0-9_.=/+-]*")  # texts that need no quotes in YAML, also within brackets
NOT_TEXT = {"true", "false", "yes", "no", "on", "off", "null", "y", "n"}  # words that YAML reads as another type
UNSET: tuple[Any, ...] = (None, "", [], {})  # values of settings that a command leaves out
EFFECTS_OVERRIDE = re.compile(r"effects\.(accelerometer|gyroscope)=(?:\[(.*)\]|.*)")
OPEN = "effects that the recordings leave open (explain names them)"
DEFAULT_RESULTS = "results"  # the default folder of results


class FoundMounting(NamedTuple):
    """Units whose mounting by gravity is not the stated one, and the settings that describe it in all of them.

    ``ways``: alternatives, each a list of overrides.
    """

    units: list[str]
    recordings: list[str]
    ways: list[list[str]]


def found_mountings(found: Iterable[tuple[str, Mapping[str, Ways]]]) -> list[FoundMounting]:
    """Group the units whose settings are equal, with zeros that agree; each zero is the mean of the group.

    ``found``: units, each with the settings of the notes on its recordings (``Note.settings``) by recording.
    """
    groups: list[tuple[FoundMounting, list[list[float]]]] = []  # with the zeros of each unit
    for unit, recordings in found:
        if not recordings:
            continue
        ways = [[*way] for way in next(iter(recordings.values()))]
        zeros = [float(text) for way in ways for setting in way for text in ZERO_SETTING.findall(setting)]
        plain = [[ZERO_SETTING.sub("", setting) for setting in way] for way in ways]
        for group, known in groups:
            near = all(abs(a - b) <= ALIKE_DEG for a, b in zip(zeros, known[0], strict=False))
            if near and (group.recordings, group.ways) == ([*recordings], plain):
                group.units.append(unit)
                known.append(zeros)
                break
        else:
            groups.append((FoundMounting([unit], [*recordings], plain), [zeros]))
    return [group._replace(ways=_with_zeros(group.ways, known)) for group, known in groups]


def _with_zeros(ways: Ways, zeros: Sequence[Sequence[float]]) -> list[list[str]]:
    """Return settings with the mean zeros of units, which were taken out in the order of the settings."""
    means = iter([math.fsum(values) / len(values) for values in zip(*zeros, strict=True)])
    return [[f"{s}{next(means):.2f}" if s.endswith("zero_deg=") else s for s in way] for way in ways]


def as_overrides(ways: Ways) -> str:
    """Return settings as the text of a file with overrides; the alternatives to the first are comments."""
    first_way, *others = ([f"  - {setting}" for setting in way] for way in ways)
    comments = [f"  # {line.strip()}" for way in others for line in ("or, in place of these:", *way)]
    return "\n".join(["overrides:", *first_way, *comments]) + "\n"


def read_summary(results: Path) -> list[dict[str, str]]:
    """Return the rows of a campaign's ``summary.csv``."""
    with (results / "summary.csv").open(encoding="utf-8", newline="") as stream:
        rows = csv.DictReader(stream)
        return [{text_of_cell(key): text_of_cell(value or "") for key, value in row.items()} for row in rows]


def counts_of(rows: Sequence[Mapping[str, Any] | RowState]) -> dict[str, int]:
    """Return the number of units by their most urgent kind of problem, of those that are ready, and that failed."""
    counts = Counter(next(iter(state_of(row).kinds), READY) for row in rows)
    order = [READY, *(kind for kind in KINDS if kind not in (READY, FAILED)), FAILED]
    return {kind: counts[kind] for kind in order if counts[kind] or kind in (READY, FAILED)}


def counted(rows: Sequence[Mapping[str, Any] | RowState]) -> str:
    """Return the counts in words: ``10 units: 4 ready, 1 effect missing, 0 failed``."""
    kinds = ", ".join(f"{count} {KINDS[kind].name}" for kind, count in counts_of(rows).items())
    return f"{len(rows)} unit{'s' * (len(rows) != 1)}: {kinds}"


def all_well(rows: Sequence[Mapping[str, Any] | RowState]) -> str:
    """Return the sentence for a campaign whose units are all ready; empty for another one."""
    states = [*map(state_of, rows)]
    if not states or any(state.kinds for state in states):
        return ""
    ratios = [ratio for state in states if (ratio := largest_over_noise(state))]
    error = f", and the held-out error is at most {max(ratios):.3g} x noise" if ratios else ""
    who = f"All {len(rows)} units are" if len(rows) > 1 else "The unit is"
    return f"{who} ready: nothing that the recordings can show is missing{error}."


def beyond_limits_groups(rows: Sequence[Mapping[str, Any]]) -> list[tuple[str, list[str]]]:
    """Return the units with a parameter outside the data sheet's limit, by sensor; ``rows``: of ``summary.csv``."""
    by_sensor = [(s, [row["unit"] for row in rows if row.get(f"{s}_beyond_limits")]) for s in SENSORS]
    return [(f"{sensor}, a parameter outside the data sheet's limits", units) for sensor, units in by_sensor if units]


def place(verdict: str | None) -> int:
    """Return the index of a verdict in ``Verdict``; an unknown verdict comes last."""
    return [*Verdict, verdict].index(verdict)


def lines_of(groups: Iterable[tuple[str, Sequence[str]]]) -> list[str]:
    """Return a line for each group of units; it names the first units of a large group."""
    return [f"{what}: {', '.join(shortened(units, NAMED_PER_LINE))}" for what, units in groups]


def commands_of(part: Mapping[str, Any], sensor: str, unit: str, settings: Mapping[str, Any]) -> JSON:
    """Return the commands that add the effects which a diagnosis selected; ``{}`` if it selected none.

    ``add`` is for every run, ``once`` for one run. ``verb`` is "add", or "try" if the effects do not explain the whole
    residual. ``part``: the sensor's part of ``diagnoses/<unit>.json``.
    """
    if not part.get("override"):
        return {}
    effects = [f"{sensor}.{name}" for name in part["selected"]]
    verb = "add" if part["verdict"] == Verdict.MISSING_EFFECT else "try"
    them, once = "it" if len(effects) == 1 else "them", once_command(settings, unit, [part["override"]])
    return {"verb": f"{verb} {them}", "add": add_command(settings, unit, effects), "once": once}


def command_of(problem: Problem, settings: Mapping[str, Any]) -> str:
    """Return the command with which the user can continue: it adds, runs again, or shows the evidence."""
    units, overrides = problem.units, SETTING.findall(problem.step)
    if problem.kind == Verdict.MISSING_EFFECT:
        if len(units) == 1:
            return add_command(settings, units[0], problem.effects)
        names = {effect.partition(".")[2] for effect in problem.effects}
        others = [text for text in settings.get("overrides") or [] if not EFFECTS_OVERRIDE.fullmatch(text)]
        return _command("add", {**settings, "overrides": others}, ["--missing", *(names if len(names) == 1 else ())])
    if problem.kind == FAILED:
        return run_command(settings)
    if overrides and len(units) <= NAMED_PER_LINE:
        given = settings.get("unit_overrides") or {}
        of_units = {unit: [*given.get(unit, []), *overrides] for unit in sorted(units)}
        return run_command({**settings, "unit_overrides": {**given, **of_units}})
    return explain_command(settings, [units[0]])


def explain_command(settings: Mapping[str, Any], words: Sequence[str]) -> str:
    """Return the command that shows the evidence for some units, or with ``--all`` for every unit."""
    campaign = str(settings.get("campaign", "demo")).rstrip("/")
    return _command("explain", {"campaign": campaign, "results": settings.get("results")}, words)


def problem_words(problem: Problem, most: int = NAMED_PER_LINE) -> str:
    """Return a problem in one sentence: kind, units, sensors or effects, and how far the error is above the noise."""
    units = f"{len(problem.units)} units: " * (len(problem.units) > 1) + ", ".join(shortened(problem.units, most))
    return "; ".join(filter(None, [f"{KINDS[problem.kind].name}: {units}", problem.what, ratio_words(problem)]))


def ratio_words(problem: Problem) -> str:
    """Return what decided a verdict, or the range of error over noise: ``11 to 64 x noise``; empty if not known."""
    held_out = decided_words("held_out")
    if problem.decided not in ("", held_out) or not problem.ratios:
        return problem.decided
    low, high = (f"{ratio:.3g}" for ratio in problem.ratios)
    span = high if low == high else f"{low} to {high}"
    return f"{held_out} {span} x noise" if problem.decided else f"{span} x noise"


def outcome(results: Path, settings: Mapping[str, Any], *, of_this_run: bool) -> str:
    """Return the closing lines of a run, except those about failed units.

    ``of_this_run``: whether this run wrote the last entry of the history of the ``results``.
    """
    rows, settings = read_summary(results), {**settings, "results": str(results.parent)}
    lines = _reasons(results, [row["unit"] for row in rows])
    lines += lines_of(beyond_limits_groups(rows))
    lines += lines_of(_not_in_uncertainty(rows).items())
    for column, words in (("left_out", "left out"), ("incomplete", "not complete")):
        told = [f"{r['unit']}, {words}: {w}" for r in rows if (w := r.get(column))]
        lines += shortened(told, NAMED_PER_LINE, "units")
    entries = read_history(results) if of_this_run else []
    if entries:
        lines += shortened(_changes(entries), NAMED_PER_LINE, "sensors that changed")
        no_longer = [
            f"{unit}: this run no longer has {', '.join(effects)}, which run {run} had; to have it in every run:\n"
            f"  {add_command(settings, unit, effects)}"
            for (unit, run), effects in dropped(entries).items()
        ]
        lines += shortened(no_longer, NAMED_PER_LINE, "units that no longer have an effect")
    found = problems(rows, once=True)
    for problem in reversed(found):  # the most urgent next to the end
        if problem.kind not in (FAILED, Verdict.MISSING_EFFECT):
            lines += [problem_words(problem), f"  {command_of(problem, settings)}"]
    lines += [*_missing(found, settings), *filter(None, [all_well(rows)])]
    return "\n".join([*lines, f"{counted(rows)}; look at {results}/index.html"]) + "\n"


def _missing(found: Sequence[Problem], settings: Mapping[str, Any]) -> list[str]:
    """Return the lines before the last: each unit with a missing effect, or how many there are and what lists them."""
    missing = [problem for problem in found if problem.kind == Verdict.MISSING_EFFECT]
    units = {unit for problem in missing for unit in problem.units}
    if len(units) > NAMED_MISSING:
        return [
            f"effect missing: {len(units)} units; to list them:", f"  {explain_command(settings, ['--all'])}",
            "to add to each unit its missing effects:", f"  {_command('add', settings, ['--missing'])}",
        ]  # fmt: skip
    lines = [problem_words(problem, NAMED_MISSING) for problem in missing]
    commands = [command_of(missing[0], settings)] if len(missing) == 1 else []
    commands = commands or [_command("add", settings, ["--missing"])] * bool(missing)
    return lines + [f"  {command}" for command in commands]


def _reasons(results: Path, units: Sequence[str]) -> list[str]:
    """Return lines on the doubts that the published calibrations and validations of units state, by kind."""
    kinds: dict[str, dict[str, list[str]]] = {}
    for unit in units:
        files = [results / folder / f"{unit}.json" for folder in ("calibrations", "validations")]
        calibration, validation = (read_json(file) if file.is_file() else {} for file in files)
        for sensor in SENSORS:
            part = calibration.get(sensor) or {}
            lack = (calibration.get("not_calibrated") or {}).get(sensor)
            doubts = {
                "not_calibrated": lack and f"not calibrated: {lack}",
                "not_held_out": (validation.get(sensor) or {}).get("reason"),
                "not_determined": part.get("not_determined"),
                NOT_CONVERGED: None if part.get("converged", True) else KINDS[NOT_CONVERGED].meaning,
            }
            for kind, doubt in doubts.items():
                groups = kinds.setdefault(kind, {})
                if doubt:
                    groups.setdefault(f"{sensor}, {doubt}", []).append(unit)
    return [line for each in kinds.values() for line in shortened(lines_of(each.items()), NAMED_PER_LINE, "reasons")]


def _not_in_uncertainty(rows: Sequence[Mapping[str, str]]) -> dict[str, list[str]]:
    """Group the units by source of error that can exceed the expanded uncertainty U and is not part of it."""
    groups: dict[str, list[str]] = {}
    for sensor in SENSORS:
        for row in rows:
            for source in (row.get(f"{sensor}_not_in_uncertainty") or "").split("; "):
                said = OPEN if WITH_THEM in source and len(rows) > 1 else source
                if source:
                    groups.setdefault(f"{sensor}, U does not include {said}", []).append(row["unit"])
    return groups


def _changes(entries: Sequence[JSON]) -> list[str]:
    """Return a line for each sensor whose effects or error the last run changed, largest change first."""
    states = of_units(entries)
    lines: list[tuple[float, str]] = []
    for unit in entries[-1]["units"]:
        before, after = [{}, *(state for _, state in states[unit])][-2:]
        change = difference(before, after)
        for sensor in SENSORS:
            was, now = errors_of((before, after), sensor)
            if not was.after or not now.after:
                continue
            factor = abs(math.log(now.after / was.after))
            if factor < SMALLEST_CHANGE and not change.added[sensor] and not change.removed[sensor]:
                continue
            words = ", ".join(change.words(sensor)).replace("\N{MINUS SIGN}", "-").replace("\N{RIGHTWARDS ARROW}", "->")
            ratio = f", {now.ratio:.3g} times the noise floor" if now.ratio else ""
            line = f"held-out error of the {now.kind} {was.after:.3g} -> {now.after:.3g} {SENSOR_UNITS[sensor]}{ratio}"
            uncertainty = uncertainty_words(before[sensor], after[sensor], SENSOR_UNITS[sensor])
            line += f"\n  {uncertainty}" if uncertainty else ""
            lines.append((factor, f"{unit}, {sensor}: {words}; {line}"))
    return [line for _, line in sorted(lines, key=lambda entry: -entry[0])]


def changes_of(results: Path, units: Sequence[str]) -> list[str]:
    """Return what the last run changed in some units, as its last lines state it."""
    entries = read_history(results)
    lines = _changes(entries) if entries else []
    return [line for line in lines if line.partition(", ")[0] in units]


def uncertainty_words(before: JSON, after: JSON, unit: str) -> str:
    """Return in words how U of bias and matrix changed between two states of a sensor; empty without a change."""
    was, now = (state.get("uncertainty") or {} for state in (before, after))
    changes = [
        f"{key} {was[key] * scale:.2g} -> {now[key] * scale:.2g} {of}"
        for key, scale, of in (("bias", 1.0, unit), ("matrix", 100.0, "%"))
        if key in was and key in now and abs(now[key] - was[key]) > SMALLEST_CHANGE * was[key]
    ]
    return f"largest expanded uncertainty (95 %): {', '.join(changes)}" if changes else ""


def run_command(settings: Mapping[str, Any]) -> str:
    """Return the command of a run with settings of ``--config``: ``snakemake`` where its rules are, else ``run``."""
    if not Path("Snakefile").is_file():
        return _command("run", settings, [])
    return shlex.join(["snakemake", "--cores", "2", *_config(settings)])


def apply_command(settings: Mapping[str, Any], unit: str) -> str:
    """Return the command that compensates a log with the calibration of a unit, for the default folder of results."""
    campaign = str(settings.get("campaign", "demo")).rstrip("/").rpartition("/")[2]
    file = f"{DEFAULT_RESULTS}/{campaign}/calibrations/{unit}.json"
    return shlex.join([*_program(), "apply", "--calibration", file, "LOG.csv", "-o", "LOG_calibrated.csv"])


def add_command(settings: Mapping[str, Any], unit: str, effects: Sequence[str]) -> str:
    """Return the command that adds effects (``sensor.effect``) to the file of a unit and runs the campaign.

    It also adds the effects that ``unit_overrides`` sets for this run, because that override has precedence. Where
    ``overrides`` sets those of all units, the file has no effect: then it is ``once_command`` with the unit's effects.
    """
    of_units = dict(settings.get("unit_overrides") or {})
    own, sensors = of_units.pop(unit, []), {effect.partition(".")[0] for effect in effects}
    wanted, of_all = _effects_of(own), _effects_of(settings.get("overrides") or ())
    stronger = bool(sensors & of_all.keys())
    if stronger:
        wanted = of_all | wanted
    for sensor, _, name in (effect.partition(".") for effect in effects):
        wanted[sensor] = [*dict.fromkeys([*wanted.get(sensor, ()), name])]
    if stronger:
        return once_command(settings, unit, [f"effects.{s}=[{','.join(wanted[s])}]" for s in sorted(sensors)])
    others = [override for override in own if not EFFECTS_OVERRIDE.fullmatch(override)]
    of_units |= {unit: others} if others else {}
    named = [f"{sensor}.{name}" for sensor, names in wanted.items() for name in names]
    return _command("add", {**settings, "unit_overrides": of_units}, [unit, *named])


def _effects_of(overrides: Iterable[str]) -> dict[str, list[str]]:
    """Return the effects that overrides set, by sensor; none for ``auto``."""
    found = [match for text in overrides if (match := EFFECTS_OVERRIDE.fullmatch(text))]
    return {m[1]: [name.strip() for name in (m[2] or "").split(",") if name.strip()] for m in found}


def once_command(settings: Mapping[str, Any], unit: str, overrides: Sequence[str]) -> str:
    """Return the command that runs the campaign once with further overrides of a unit."""
    of_units, keys = settings.get("unit_overrides") or {}, {override.partition("=")[0] for override in overrides}
    others = [text for text in of_units.get(unit, []) if text.partition("=")[0] not in keys]
    return run_command({**settings, "unit_overrides": {**of_units, unit: [*others, *overrides]}})


def _command(command: str, settings: Mapping[str, Any], words: Sequence[str]) -> str:
    results = str(settings.get("results") or DEFAULT_RESULTS)
    folder = ["--results", results] if results != DEFAULT_RESULTS else []
    rest = {key: value for key, value in settings.items() if key not in ("campaign", "results")}
    return shlex.join([*_program(), command, str(settings.get("campaign", "demo")), *words, *folder, *_config(rest)])


def _program() -> list[str]:
    return ["imu-calibration"] if INSTALLED else ["python", "-m", "pipeline"]


def _config(settings: Mapping[str, Any]) -> list[str]:
    results = settings.get("results")
    stated = {k: v for k, v in settings.items() if v not in UNSET and k != "results"}
    stated |= {"results": results} if results and results != DEFAULT_RESULTS else {}
    pairs = [f"{key}={_flow(value, top=True)}" for key, value in stated.items()]
    return ["--config", *pairs] if pairs else []


def _flow(value: Any, *, top: bool = False) -> str:  # noqa: ANN401  (any YAML value)
    """Return a value as YAML on one line."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_flow(str(k))}: {_flow(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_flow(v) for v in value) + "]"
    if isinstance(value, str) and (top or (PLAIN_YAML_TEXT.fullmatch(value) and value.lower() not in NOT_TEXT)):
        return value
    return json.dumps(value, ensure_ascii=False)
