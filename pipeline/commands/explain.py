"""Print a diagnosis in words, or the equation of a calibration with its numbers and a worked example."""

from __future__ import annotations

import json
import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.commands import parser_of
from pipeline.commands.convert import sensor_figures
from pipeline.diagnosis.words import in_words
from pipeline.errors import InputError, MissingInputError
from pipeline.exports.conversion import explain_board, explain_calibration
from pipeline.exports.reading import counts_of, read_any
from pipeline.files import read_json
from pipeline.history import read_history
from pipeline.model.calibration_file import beyond_uncertainty, beyond_words, frame_words, left_out, sentences
from pipeline.outcome import (
    DIAGNOSIS_FAILED,
    NOT_CONVERGED,
    Finding,
    commands_of,
    lines_of,
    next_commands,
    read_summary,
    verdict_groups,
)
from pipeline.pack import batches_of, is_published, read_published
from pipeline.records import SENSORS
from pipeline.report.held_out_section import MARK_ABOVE_FLOORS
from pipeline.report.pages import template
from pipeline.results_folder import is_owner, read_owner

if TYPE_CHECKING:
    from collections.abc import Sequence

JSON = dict[str, Any]
EPILOG = """\
examples:
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
    arguments = parser.parse_args(argv)
    file = Path(arguments.campaign)
    if is_published(file) and not _is_diagnosis(_json(file)):
        counts = counts_of(sensor_figures(arguments.sensor))
        try:
            sys.stdout.write(explain_calibration(read_any(file, arguments.format, counts)))
        except InputError as error:
            raise InputError(f"is no diagnosis, and no calibration: {error.message}", error.file) from error
        return 0
    sys.stdout.write(explain(*find(arguments.campaign, arguments.units, Path(arguments.results))))
    return 0


def find(campaign: str, units: Sequence[str], results: Path) -> tuple[Path, dict[str, JSON], dict[str, JSON]]:
    """Return the folder of the results, and the diagnoses and failures of the units.

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
            from pipeline.config.owner import require_own_results  # noqa: PLC0415  (Hydra, where the path has changed)

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
        raise MissingInputError(
            f"no diagnosis of unit {', '.join(absent)}; there are those of {known or 'no unit'}",
            str(folder / "diagnoses"),
        )
    diagnoses = {unit: _json(file) for unit, file in files.items() if not units or unit in units}
    for unit, document in diagnoses.items():
        if not _is_diagnosis(document):
            raise InputError("is no diagnosis: it is damaged, or not of this product", str(files[unit]))
    return folder, diagnoses, {unit: f for unit, f in failures.items() if not units or unit in units}


def explain(folder: Path, diagnoses: dict[str, JSON], failures: dict[str, JSON]) -> str:
    """Return the diagnoses as text, each with the error on held-out motion and the commands that add effects."""
    entries, results = read_history(folder), str(folder.parent)
    settings = (entries[-1].get("settings") if entries else None) or {"campaign": folder.name}
    units: list[JSON] = []
    for unit, document in diagnoses.items():
        validation, calibration = (
            _json(folder / kind / f"{unit}.json") or {} for kind in ("validations", "calibrations")
        )
        name = document.get("unit", unit)
        units.append({
            "name": name,
            "words": {s: in_words(document.get(s), s) for s in SENSORS},
            "validation": validation,
            "verdicts": {s: (document.get(s) or {}).get("verdict") for s in SENSORS},
            "commands": {s: commands_of(document.get(s) or {}, s, name, settings, results) for s in SENSORS},
            "notes": [
                *(line for s in SENSORS for line in sentences(s, calibration.get(s))),
                *(
                    f"{s.capitalize()}, beyond the sensor file's limits: {names}."
                    for s in SENSORS
                    if (names := beyond_words(calibration.get(s)))
                ),
                *(
                    f"U of the {s} does not include {source}: {reason}."
                    for s in SENSORS
                    for source, reason in beyond_uncertainty(calibration.get(s))
                ),
                *(f"{s.capitalize()}: {words}." for s in SENSORS if (words := frame_words(calibration.get(s)))),
                *(
                    f"{s.capitalize()}: {reason}."
                    for s in SENSORS
                    if (reason := (calibration.get(s) or {}).get("not_determined"))
                ),
                *(
                    f"{s.capitalize()}: {NOT_CONVERGED}."
                    for s in SENSORS
                    if not (calibration.get(s) or {}).get("converged", True)
                ),
                *(f"Left out: {line}." for line in left_out(calibration.get("inputs"))),
            ],
            "board": explain_board(calibration),
        })  # fmt: skip
    findings = [
        Finding(unit, sensor, DIAGNOSIS_FAILED if part.get("failed") else part["verdict"], part["selected"])
        for unit, document in diagnoses.items()
        for sensor in SENSORS
        if (part := document.get(sensor))
    ]
    counts = Counter(finding.verdict.replace("_", " ") for finding in findings).most_common()
    counted = ", ".join(f"{count} {verdict}" for verdict, count in counts)
    failed = [f"failed: {', '.join(failures)}"] if failures else []
    text: str = template("explain.txt").render(
        far=MARK_ABOVE_FLOORS,
        counted=f"{len(findings)} sensors of {len(diagnoses)} units: {counted}",
        groups=[*lines_of(verdict_groups(findings)), *failed],
        commands=next_commands(findings, settings, results)[:-1],  # the last is this command
        units=[*units, *({"name": unit, "failure": failure} for unit, failure in failures.items())],
    )
    return text


def _is_diagnosis(document: object) -> bool:
    """Return whether a document has parts of both sensors and, unlike a calibration, no status."""
    return isinstance(document, dict) and set(SENSORS) <= set(document) and "status" not in document


def _json(file: Path) -> Any:  # noqa: ANN401
    """Return the content of a JSON file; None if it does not exist or is not JSON."""
    try:
        return json.loads(read_published(file))
    except (OSError, ValueError):
        return None
