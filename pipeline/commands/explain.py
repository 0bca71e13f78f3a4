"""Print a diagnosis in plain words, or the equation of a calibration with its numbers and a worked sample."""

from __future__ import annotations

import json
import sys
import textwrap
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from pipeline.commands import parser_of
from pipeline.config.options import LARGEST_CONFIG
from pipeline.diagnosis.words import in_words
from pipeline.errors import ConfigurationError, InputError, MissingInputError
from pipeline.exports import formats
from pipeline.exports.conversion import board_lines, explain_calibration
from pipeline.exports.conversion import convert as write_converted
from pipeline.exports.reading import CALIBRATION, FoundCalibration, counts_of, format_of, read_any
from pipeline.files import CONFIGS, read_json
from pipeline.history import read_history
from pipeline.io.yaml_file import read_yaml
from pipeline.model.calibration_file import left_out, sentences
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
CONVERT = """\
The format of IN follows from its name and content, that of OUT from its name: kalibr.yaml, px4.params,
calibration.json ... What is written is read back and compared with IN; the terminal states what is lost. Formats in
counts, and those with noise densities, need --sensor where IN does not name the sensor.

examples:
  python -m pipeline convert results/demo/calibrations/mpu6050-1.json px4.params
  python -m pipeline convert my_kalibr.yaml calibration.json
  python -m pipeline convert rig_acc.calib out/d435i.json --to realsense
  python -m pipeline convert inav.txt kalibr.yaml --sensor mpu6050
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
        counts = counts_of(sheets_of(arguments.sensor))
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
        texts[-1] += "".join(f"  Left out: {line}.\n" for line in left_out(calibration.get("inputs")))
        texts[-1] += "".join(f"{line}\n" for line in board_lines(calibration)[1:])
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


def convert(argv: Sequence[str]) -> int:
    """Convert a calibration into the format of another program, and state what is lost."""
    known = textwrap.fill(f"formats: {', '.join([CALIBRATION, *formats()])}", 118)
    parser = parser_of("convert", convert.__doc__, f"{CONVERT}\n{known}\n", ("--sensor",))
    add = parser.add_argument
    add("source", type=Path, metavar="IN", help="a calibration in any of the formats")
    add("target", type=Path, metavar="OUT", help="the file to write")
    add("--from", dest="source_format", metavar="FORMAT", help="format of IN, where name and content are ambiguous")
    add("--to", dest="target_format", metavar="FORMAT", help="format of OUT, where its name is another")
    arguments = parser.parse_args(argv)
    found = read_any(arguments.source, arguments.source_format, counts_of(sheets_of(arguments.sensor)))
    sheets = sheets_of(arguments.sensor, found)
    name = format_of(arguments.target.name if arguments.target_format is None else arguments.target_format)
    if arguments.target.exists() and arguments.source.exists() and arguments.target.samefile(arguments.source):
        raise ConfigurationError("OUT is the file IN: choose another name", str(arguments.target))
    files, lost = write_converted(found, name, arguments.target, sheets)
    print(f"{arguments.source} ({found.name}): {' and '.join(found.sensors)}")
    for note in found.notes:
        print(f"  {note}")
    print(f"written: {', '.join(map(str, files))}")
    print("lost: nothing" if not lost else "lost:")
    for line in lost:
        print(f"  {line}")
    if name == CALIBRATION and found.document is None:
        stated = [s for s, c in found.sensors.items() if c.covariance is not None]
        print(f"uncertainty: {f'of the bias of the {stated}' if stated else 'none'} is known; zeros stand for it")
    return 0


def sheets_of(sensor: str | None, found: FoundCalibration | None = None) -> dict[str, Any]:
    """Return the parts of a sensor's configuration: of the one that is named, or that a calibration was made with."""
    name = sensor or (found.document or {}).get("sensor") if found else sensor
    file = CONFIGS / "sensor" / f"{name}.yaml"
    if name is None or (sensor is None and not file.is_file()):
        return {}
    if not file.is_file():
        known = ", ".join(sorted(path.stem for path in file.parent.glob("*.yaml")))
        raise ConfigurationError(f"--sensor {name}: no such sensor; known: {known}")
    content = read_yaml(file, LARGEST_CONFIG)
    return {s: content[s] for s in SENSORS if content.get(s)}
