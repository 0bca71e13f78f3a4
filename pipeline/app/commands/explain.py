"""Print a diagnosis in words, or the equation of a calibration with its numbers and a worked example."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from shutil import get_terminal_size
from textwrap import wrap
from typing import Any

from pipeline.app.commands import parser_of
from pipeline.app.commands.convert import sensor_figures
from pipeline.app.results_folder import is_owner, read_owner
from pipeline.core.errors import InputError, MissingInputError
from pipeline.core.files import JSON, read_json
from pipeline.core.pack import batches_of, is_published, read_published
from pipeline.core.records import SENSORS
from pipeline.core.verdicts import (
    KINDS,
    MARK_ABOVE_FLOORS,
    MARK_AFTER_MOVES,
    NOT_CONVERGED,
    Problem,
    Verdict,
    error_of,
    moves_over_noise,
    problems,
    turn_errors,
)
from pipeline.evaluation.diagnosis.words import in_words, listed
from pipeline.evaluation.held_out.attitude import NO_HAND
from pipeline.output.exports.reading import counts_of, explain_board, explain_calibration, read_any
from pipeline.output.history import read_history
from pipeline.output.outcome import (
    all_well,
    beyond_limits_groups,
    command_of,
    commands_of,
    counted,
    explain_command,
    place,
    problem_words,
    ratio_words,
    read_summary,
)
from pipeline.output.pages.pages import template
from pipeline.physics.statements import beyond_uncertainty, beyond_words, frame_words, left_out, sentences

MOST_ROWS = 24  # of an overview: those of a terminal
MIN_TEXT_COLUMNS = 40  # columns, below which lines are not wrapped further
UPPER_LIMITS = "Upper limits"  # the sentence of ``in_words`` that --limits adds
COMMAND_STARTS = ("python -m pipeline ", "imu-calibration ", "snakemake ")
EPILOG = """\
examples:
  python -m pipeline explain demo                                        what to do, in at most 24 rows
  python -m pipeline explain demo mpu6050-2-hidden                       missing effects, and the evidence
  python -m pipeline explain results/demo/calibrations/mpu6050-1.json    how to use the numbers
  python -m pipeline explain kalibr.yaml                                 likewise for a calibration of another program
"""


def main(argv: Sequence[str]) -> int:
    """Run ``python -m pipeline explain C [UNIT ...]``."""
    parser = parser_of("explain", __doc__, EPILOG, ("--sensor", "--results"))
    words = "a campaign, the folder of its results, or a file: a diagnosis or a calibration"
    parser.add_argument("campaign", metavar="WHAT", help=words)
    parser.add_argument("units", metavar="UNIT", nargs="*", help="units of the campaign (default: all)")
    words = "format of a calibration, if name and content of the file are ambiguous"
    parser.add_argument("--from", dest="format", metavar="FORMAT", help=words)
    parser.add_argument("--all", action="store_true", help="every unit of the campaign, and every unit of a problem")
    parser.add_argument("--limits", action="store_true", help="with the upper limits of effects that were not selected")
    arguments = parser.parse_intermixed_args(argv)
    file = Path(arguments.campaign)
    if is_published(file) and not _is_diagnosis(_json(file)):
        counts = counts_of(sensor_figures(arguments.sensor))
        try:
            sys.stdout.write(explain_calibration(read_any(file, arguments.format, counts)))
        except InputError as error:
            raise InputError(f"is no diagnosis, and no calibration: {error.message}", error.file) from error
        return 0
    of_campaign = not arguments.units and not is_published(file)
    read = arguments.all or not of_campaign
    width = max(get_terminal_size().columns, MIN_TEXT_COLUMNS)
    folder, diagnoses, failures = find(arguments.campaign, arguments.units, Path(arguments.results), read=read)
    if not read and not (folder / "summary.csv").is_file():
        _, diagnoses, _ = find(arguments.campaign, arguments.units, Path(arguments.results))
    if of_campaign:
        rows = summary_rows(folder, diagnoses, failures)
        sys.stdout.write(overview(folder, rows, width, whole=arguments.all))
        sys.stdout.write("\n" * arguments.all)
    if read:
        limits = arguments.limits or arguments.all
        sys.stdout.write(explain(folder, diagnoses, failures, limits=limits, width=width))
    return 0


def find(
    campaign: str, units: Sequence[str], results: Path, *, read: bool = True
) -> tuple[Path, dict[str, JSON], dict[str, JSON]]:
    """Return the folder of the results, and the diagnoses (empty without ``read``) and failures of the units.

    Raises ``MissingInputError`` if there are none.
    """
    path = Path(campaign)
    if is_published(path):
        folder, files, failures = path.parent.parent, {path.stem: path}, {}
    else:
        folders = [folder for folder in (path, results / path.name) if (folder / "diagnoses").is_dir()]
        if not folders:
            raise MissingInputError(f"no diagnoses in {path} or {results / path.name}; run the campaign first")
        folder = folders[0]
        if (path / "units.csv").exists() and read_owner(folder) and not is_owner(folder, path):
            from pipeline.app.config.owner import require_own_results  # noqa: PLC0415  (Hydra, where the path has changed)

            require_own_results(path.resolve(), results, {})
        failed = folder / "failures.json"
        failures = {failure["unit"]: failure for failure in (read_json(failed) if failed.is_file() else [])}
        files = {file.stem: file for file in sorted((folder / "diagnoses").glob("*.json"))}
        files |= {unit: folder / "diagnoses" / f"{unit}.json" for unit in batches_of(folder)}
        order = [row["unit"] for row in read_summary(folder)] if (folder / "summary.csv").is_file() else []
        files = {u: files[u] for u in dict.fromkeys([*order, *files]) if u in files and u not in failures}
    absent = [unit for unit in units if unit not in files and unit not in failures]
    if absent:
        known = ", ".join(sorted([*files, *failures])[:12])
        message = f"no diagnosis of unit {', '.join(absent)}; there are those of {known or 'no unit'}"
        raise MissingInputError(message, str(folder / "diagnoses"))
    wanted = [unit for unit in files if not units or unit in units]
    diagnoses = {unit: _json(files[unit]) if read else {} for unit in wanted}
    for unit, document in diagnoses.items():
        if read and not _is_diagnosis(document):
            raise InputError("is no diagnosis: it is damaged, or not of this product", str(files[unit]))
    return folder, diagnoses, {unit: f for unit, f in failures.items() if not units or unit in units}


def overview(folder: Path, rows: Sequence[Mapping[str, Any]], width: int, *, whole: bool = False) -> str:
    """Return the state of a campaign: a line and a command for each problem, in at most ``MOST_ROWS`` rows.

    ``rows``: of ``summary.csv``; ``whole``: every problem with every unit, in any number of rows.
    """
    settings, found = _settings(folder), problems(rows, once=not whole)
    head = [*filter(None, [f"{folder.name}, {counted(rows)}", all_well(rows)])]
    limits = [
        f"Outside the data sheet's limits: {what.partition(',')[0]} of {len(units)} unit{'s' * (len(units) != 1)}"
        + f" ({', '.join(units)})" * whole
        for what, units in beyond_limits_groups(rows)
    ]
    lines = _wrapped(head, width) + _wrapped(limits, width)
    for i, problem in enumerate(found):
        shown = problem_words(problem, len(problem.units)) if whole else _short(problem)
        step = [] if problem.kind == Verdict.MISSING_EFFECT else [f"  {problem.step}"]
        block = [*_wrapped([shown, *step], width), f"  {command_of(problem, settings)}"]
        if not whole and len(lines) + len(block) > MOST_ROWS - 2:
            everything = explain_command(settings, ["--all"])
            return "\n".join([*lines, f"{len(found) - i} more kinds of problems; to list all:", f"  {everything}", ""])
        lines += block
    return "\n".join([*lines, ""])


def _short(problem: Problem) -> str:
    """Return a problem in a short line: kind, number of units with the worst, sensors or effects, and ratio."""
    count, worst = len(problem.units), problem.units[0]
    units = worst if count == 1 else f"{count} units, worst {worst}"
    return "; ".join(filter(None, [f"{KINDS[problem.kind].name}: {units}", problem.what, ratio_words(problem)]))


def _settings(folder: Path) -> JSON:
    """Return the settings of the last run, and its folder of results."""
    entries = read_history(folder)
    stated = (entries[-1].get("settings") if entries else None) or {"campaign": folder.name}
    return {**stated, "results": str(folder.parent)}


def _wrapped(lines: Sequence[str], width: int) -> list[str]:
    """Return lines that fit the width; a command stays on one line, which a user copies."""
    found = []
    for line in lines:
        indent = line[: len(line) - len(line.lstrip())]
        if len(line) <= width or line.lstrip().startswith(COMMAND_STARTS):
            found.append(line)
        else:
            found += wrap(line, width, subsequent_indent=f"{indent}  ", break_long_words=False, break_on_hyphens=False)
    return found


def summary_rows(folder: Path, diagnoses: Mapping[str, JSON], failures: Mapping[str, JSON]) -> list[Mapping[str, Any]]:
    """Return the rows of ``summary.csv``; of results without one, what the diagnoses state."""
    if (folder / "summary.csv").is_file():
        rows = read_summary(folder)
        if {f"{s}_verdict" for s in SENSORS} & set(rows[0] if rows else ()):
            return [*rows]
    rows_: list[Mapping[str, Any]] = []
    for unit, document in diagnoses.items():
        row: JSON = {"unit": unit, "status": "ok"}
        for sensor in [s for s in SENSORS if document.get(s)]:
            part = document[sensor]
            row |= {f"{sensor}_verdict": part["verdict"], f"{sensor}_selected": ";".join(part["selected"])}
            row |= {f"{sensor}_next_step": part["next_experiment"], f"{sensor}_decided_by": part.get("decided_by")}
            row |= {"incomplete": f"diagnose/{sensor}: it failed"} if part.get("failed") else {}
        rows_.append(row)
    return [*rows_, *({"unit": unit, "status": "failed"} for unit in failures)]


def explain(
    folder: Path, diagnoses: dict[str, JSON], failures: dict[str, JSON], *, limits: bool = True, width: int = 10**6
) -> str:
    """Return the diagnoses as text, each with the error on held-out motion and the commands that add effects.

    ``limits``: with the upper limits of effects that were not selected.
    """
    settings = _settings(folder)
    units: list[JSON] = []
    for unit, document in diagnoses.items():
        validation, calibration = (_json(folder / of / f"{unit}.json") or {} for of in ("validations", "calibrations"))
        name = document.get("unit", unit)
        places = {s: place(part["verdict"]) if (part := document.get(s)) else len(Verdict) + 1 for s in SENSORS}
        ordered = sorted(SENSORS, key=places.__getitem__)  # first what can be added and what is in doubt
        words = {s: in_words(document.get(s), s) for s in ordered}
        words |= {s: [f"Not calibrated: {why}."] for s, why in (calibration.get("not_calibrated") or {}).items()}
        units.append({
            "name": name,
            "words": {s: [w for w in w_ if limits or not w.startswith(UPPER_LIMITS)] for s, w_ in words.items()},
            "hidden": not limits and any(w.startswith(UPPER_LIMITS) for w_ in words.values() for w in w_),
            "validation": validation,
            "errors": {s: error_of(validation.get(s)) for s in SENSORS},
            "verdicts": {s: (document.get(s) or {}).get("verdict") for s in SENSORS},
            "commands": {s: commands_of(document.get(s) or {}, s, name, settings) for s in SENSORS},
            "notes": [*_notes(calibration), *(f"Left out: {line}." for line in left_out(calibration.get("inputs")))],
            "board": explain_board(calibration),
            "moves": moves_over_noise(validation),
            "by_hand": (validation.get("gravity_direction") or {}).get("reason", NO_HAND) != NO_HAND,
        })  # fmt: skip
    units += [{"name": unit, "failure": failure} for unit, failure in failures.items()]
    marks = {"far": MARK_ABOVE_FLOORS, "far_after_moves": MARK_AFTER_MOVES}
    text: str = template("explain.txt").render(**marks, turn_errors=turn_errors, units=units)
    return "\n".join([*_wrapped(text.splitlines(), width), ""])


def _notes(calibration: JSON) -> list[str]:
    """Return what a calibration states of its sensors: each kind of remark of the one, then of the other."""
    parts = {s: calibration.get(s) or {} for s in SENSORS}
    notes = [line for s, part in parts.items() for line in sentences(s, part)]
    beyond = {s: beyond_words(part) for s, part in parts.items()}
    notes += [f"{s.capitalize()}, outside the data sheet's limits: {names}." for s, names in beyond.items() if names]
    outside: dict[tuple[str, str], list[str]] = {}  # both sensors together where source and reason are the same
    for s, part in parts.items():
        for each in beyond_uncertainty(part):
            outside.setdefault(each, []).append(f"the {s}")
    notes += [f"U of {listed(of)} does not include {what}: {why}." for (what, why), of in outside.items()]
    lacks: list[dict[str, str | None]] = [
        {s: frame_words(part) for s, part in parts.items()},
        {s: part.get("not_determined") for s, part in parts.items()},
        {s: "" if part.get("converged", True) else KINDS[NOT_CONVERGED].meaning for s, part in parts.items()},
    ]
    return notes + [f"{s.capitalize()}: {words}." for of_kind in lacks for s, words in of_kind.items() if words]


def _is_diagnosis(document: object) -> bool:
    """Return whether a document has parts of both sensors and, unlike a calibration, no status."""
    return isinstance(document, dict) and set(SENSORS) <= set(document) and "status" not in document


def _json(file: Path) -> Any:  # noqa: ANN401
    """Return the content of a JSON file; None if it does not exist or is not JSON."""
    try:
        return json.loads(read_published(file))
    except (OSError, ValueError):
        return None
