"""Print a diagnosis in plain words."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.diagnosis.words import in_words
from pipeline.errors import InputError, MissingInputError
from pipeline.records import SENSORS

if TYPE_CHECKING:
    from collections.abc import Sequence


def main(argv: Sequence[str]) -> int:
    """Run ``python -m pipeline explain C [UNIT ...]``."""
    parser = argparse.ArgumentParser(prog="python -m pipeline explain", description=__doc__)
    parser.add_argument("campaign", metavar="C", help="a campaign's name or results folder, or one diagnosis (JSON)")
    parser.add_argument("units", metavar="UNIT", nargs="*", help="units to explain (default: all)")
    parser.add_argument("--results", type=Path, default=Path("results"), help="where results are (default: results)")
    arguments = parser.parse_args(argv)
    files = diagnoses(arguments.campaign, arguments.units, arguments.results)
    texts = [explain(_read(file), _validation(file)) for file in files]
    sys.stdout.write("\n".join(texts))
    return 0


def diagnoses(campaign: str, units: Sequence[str], results: Path) -> list[Path]:
    """Return the diagnosis files meant.

    Raises
    ------
    MissingInputError
        If there are none.
    """
    given = Path(campaign)
    if given.is_file():
        return [given]
    folders = [folder for folder in (given / "diagnoses", results / given.name / "diagnoses") if folder.is_dir()]
    if not folders:
        raise MissingInputError(f"no diagnoses in {given} or {results / given.name}; run the campaign first")
    files = [folders[0] / f"{u}.json" for u in units] if units else sorted(folders[0].glob("*.json"))
    absent = [f.stem for f in files if not f.is_file()]
    if absent:
        known = ", ".join(sorted(f.stem for f in folders[0].glob("*.json"))[:12])
        raise MissingInputError(
            f"no diagnosis of unit {', '.join(absent)}; there are those of {known}", str(folders[0])
        )
    return files


def explain(document: dict[str, Any], validation: dict[str, Any]) -> str:
    """Return a unit's diagnosis as text, with the error of its held-out motion where that is known."""
    lines = [f"{document.get('unit', 'unit')}"]
    for sensor in SENSORS:
        lines.append(f"  {sensor}")
        verdict, *rest = in_words(document.get(sensor), sensor)
        lines += [f"    {sentence}" for sentence in [verdict, *_held_out(validation.get(sensor)), *rest]]
    return "\n".join(lines) + "\n"


def _held_out(part: dict[str, Any] | None) -> list[str]:
    if not part or not part["steps"]:
        return []
    error, floor, unit = part["steps"][-1]["rms_error"], part["noise_floor"], part["unit"]
    ratio = f", {error / floor:.3g} times what noise alone leaves" if floor else ""
    return [f"As calibrated in this run, held-out motion errs by {error:.3g} {unit} rms of the magnitude{ratio}."]


def _validation(diagnosis: Path) -> dict[str, Any]:
    """Return ``validations/<unit>.json`` of the same results; nothing where there is none."""
    file = diagnosis.parent.parent / "validations" / diagnosis.name
    try:
        found: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError):
        return {}
    return found


def _read(file: Path) -> dict[str, Any]:
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise InputError(f"is no diagnosis: {error}", str(file)) from error
    if not isinstance(document, dict) or not set(SENSORS) <= set(document):
        raise InputError("is no diagnosis: it does not speak of accelerometer and gyroscope", str(file))
    return document
