"""Print a diagnosis in plain words, or the equation of a calibration with its numbers and a worked sample."""

from __future__ import annotations

import json
import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from pipeline.commands import parser_of
from pipeline.commands.convert import sensor_config
from pipeline.diagnosis.words import in_words
from pipeline.errors import InputError, MissingInputError
from pipeline.exports.conversion import explain_board, explain_calibration
from pipeline.exports.reading import counts_of, read_any
from pipeline.files import read_json
from pipeline.history import read_history
from pipeline.model.calibration_file import beyond_uncertainty, left_out, sentences
from pipeline.outcome import Finding, commands_of, lines_of, next_commands, read_summary, verdict_groups
from pipeline.pack import batches_of, is_published, read_published
from pipeline.records import SENSORS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

JSON = dict[str, Any]
EPILOG = """\
examples:
  python -m pipeline explain demo mpu6050-2-hidden                       what is missing, and the evidence
  python -m pipeline explain results/demo/calibrations/mpu6050-1.json    how the numbers are to be used
  python -m pipeline explain kalibr.yaml                                 the same of another program's calibration
"""


class Selection(NamedTuple):
    """Diagnoses and failures by unit, settings of the last run, folder of all results, and the campaign's in it."""

    diagnoses: dict[str, JSON]
    failures: dict[str, JSON]
    settings: JSON
    results: str
    folder: str


def main(argv: Sequence[str]) -> int:
    """Run ``python -m pipeline explain C [UNIT ...]``."""
    parser = parser_of("explain", __doc__, EPILOG, ("--sensor", "--results"))
    parser.add_argument(
        "campaign",
        metavar="WHAT",
        help="a campaign, the folder of its results, or a file: a diagnosis or a calibration",
    )
    parser.add_argument("units", metavar="UNIT", nargs="*", help="units of the campaign (default: all)")
    words = "format of a calibration, where name and content of the file are ambiguous"
    parser.add_argument("--from", dest="format", metavar="FORMAT", help=words)
    arguments = parser.parse_args(argv)
    file = Path(arguments.campaign)
    if is_published(file) and not _is_diagnosis(_json(file)):
        counts = counts_of(sensor_config(arguments.sensor))
        try:
            sys.stdout.write(explain_calibration(read_any(file, arguments.format, counts)))
        except InputError as error:
            raise InputError(f"is no diagnosis, and no calibration: {error.message}", error.file) from error
        return 0
    found = find(arguments.campaign, arguments.units, Path(arguments.results))
    folder = Path(found.results) / found.folder
    texts = []
    for unit, document in found.diagnoses.items():
        validation, calibration = (
            _json(folder / kind / f"{unit}.json") or {} for kind in ("validations", "calibrations")
        )
        texts.append(explain(unit, document, validation, found))
        texts[-1] += "".join(f"  {line}\n" for s in SENSORS for line in sentences(s, calibration.get(s)))
        texts[-1] += "".join(
            f"  U of the {s} does not include {source}: {reason}.\n"
            for s in SENSORS
            for source, reason in beyond_uncertainty(calibration.get(s))
        )
        lacks = [(s, (calibration.get(s) or {}).get("not_determined")) for s in SENSORS]
        texts[-1] += "".join(f"  {sensor.capitalize()}: {lack}.\n" for sensor, lack in lacks if lack)
        texts[-1] += "".join(f"  Left out: {line}.\n" for line in left_out(calibration.get("inputs")))
        texts[-1] += explain_board(calibration)
    texts += [_failed(unit, failure) for unit, failure in found.failures.items()]
    if len(texts) > 1:
        texts.insert(0, "\n".join(_summary(found)) + "\n")
    sys.stdout.write("\n".join(texts))
    return 0


def find(campaign: str, units: Sequence[str], results: Path) -> Selection:
    """Return the diagnoses and failures of the units; ``MissingInputError`` if there are none."""
    given = Path(campaign)
    if is_published(given):
        folder, files, failures = given.parent.parent, {given.stem: given}, {}
    else:
        folders = [folder for folder in (given, results / given.name) if (folder / "diagnoses").is_dir()]
        if not folders:
            raise MissingInputError(f"no diagnoses in {given} or {results / given.name}; run the campaign first")
        folder = folders[0]
        failed = folder / "failures.json"
        failures = {failure["unit"]: failure for failure in (read_json(failed) if failed.is_file() else [])}
        files = {file.stem: file for file in sorted((folder / "diagnoses").glob("*.json"))}
        files |= {unit: folder / "diagnoses" / f"{unit}.json" for unit in batches_of(folder)}
        order = [row["unit"] for row in read_summary(folder)] if (folder / "summary.csv").is_file() else []
        files = {u: files[u] for u in dict.fromkeys([*order, *files]) if u in files and u not in failures}
    absent = [unit for unit in units if unit not in files and unit not in failures]
    if absent:
        known = ", ".join(sorted([*files, *failures])[:12])
        raise MissingInputError(
            f"no diagnosis of unit {', '.join(absent)}; there are those of {known or 'no unit'}",
            str(folder / "diagnoses"),
        )
    diagnoses = {unit: _json(file) for unit, file in files.items() if not units or unit in units}
    for unit, document in diagnoses.items():
        if not _is_diagnosis(document):
            raise InputError("is no diagnosis: it is damaged, or not of this product", str(files[unit]))
    failures = {unit: failure for unit, failure in failures.items() if not units or unit in units}
    entries = read_history(folder)
    settings = (entries[-1].get("settings") if entries else None) or {"campaign": folder.name}
    return Selection(diagnoses, failures, settings, str(folder.parent), folder.name)


def explain(unit: str, document: JSON, validation: JSON, selection: Selection) -> str:
    """Return a unit's diagnosis as text, with the error of its held-out motion and the commands that add effects."""
    unit = document.get("unit", unit)
    lines = [unit]
    for sensor in SENSORS:
        part = document.get(sensor)
        lines.append(f"  {sensor}")
        verdict, *rest = in_words(part, sensor)
        lines += [f"    {sentence}" for sentence in [verdict, *_held_out(validation.get(sensor)), *rest]]
        commands = commands_of(part or {}, sensor, unit, selection.settings, selection.results)
        if commands:
            lines += [f"    To {commands['verb']}:", f"      {commands['add']}"]
            lines += [f"    To {commands['verb']} for one run only:", f"      {commands['once']}"]
    return "\n".join(lines) + "\n"


def _summary(found: Selection) -> list[str]:
    """Return the verdicts by sensor and effect, and how to continue."""
    findings = [
        Finding(unit, sensor, document[sensor]["verdict"], document[sensor]["selected"])
        for unit, document in found.diagnoses.items()
        for sensor in SENSORS
        if document.get(sensor)
    ]
    counts = Counter(finding.verdict.replace("_", " ") for finding in findings).most_common()
    counted = ", ".join(f"{count} {verdict}" for verdict, count in counts)
    lines = [f"{len(findings)} sensors of {len(found.diagnoses)} units: {counted}", *lines_of(verdict_groups(findings))]
    if found.failures:
        lines.append(f"failed: {', '.join(found.failures)}")
    continued = next_commands(findings, found.settings, found.results)[:-1]  # the last is this command
    return [*lines, *[f"{what}: {command}" for what, command in continued]]


def _failed(unit: str, failure: Mapping[str, Any]) -> str:
    where = f"{failure['file']}: " if failure.get("file") else ""
    return (
        f"{unit}\n  failed in stage {failure.get('stage')} ({failure.get('code')}), so there is no diagnosis:\n"
        f"    {where}{failure.get('message')}\n"
        "  Correct the file or the setting, then run the same command again.\n"
    )


def _held_out(part: JSON | None) -> list[str]:
    if not part or not part["steps"]:
        return []
    error, floor, unit = part["steps"][-1]["rms_error"], part["noise_floor"], part["unit"]
    ratio = f", {error / floor:.3g} times the noise floor" if floor else ""
    where = "held-out motion" if part.get("held_out", True) else "the samples of the fit"
    why = [f"Not judged on held-out motion: {part['reason']}."] if part.get("reason") else []
    notes = [f"Held-out error: {note}." for note in part.get("notes") or []]
    return [f"In this run, the rms error of the magnitude on {where} is {error:.3g} {unit}{ratio}.", *why, *notes]


def _is_diagnosis(document: object) -> bool:
    """Return whether a document holds both sensors, without the status that a calibration has."""
    return isinstance(document, dict) and set(SENSORS) <= set(document) and "status" not in document


def _json(file: Path) -> Any:  # noqa: ANN401
    """Return the content of a JSON file; None where it does not exist or is not JSON."""
    try:
        return json.loads(read_published(file))
    except (OSError, ValueError):
        return None
