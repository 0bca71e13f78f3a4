"""Published files against the JSON Schemas that ship in ``pipeline/schemas``."""

import csv
import json
from pathlib import Path
from typing import Any

from jsonschema import Draft202012Validator

from .conftest import ROOT

FILES = {
    "calibration": "calibrations/*.json",
    "validation": "validations/*.json",
    "diagnosis": "diagnoses/*.json",
    "certificate": "certificates/*.json",
    "history": "history/*.json",
    "failures": "failures.json",
    "fleet": "fleet.json",
    "summary": "summary.csv",
}


def validator(name: str) -> Draft202012Validator:
    schema = json.loads((ROOT / "pipeline" / "schemas" / f"{name}.json").read_text())
    Draft202012Validator.check_schema(schema)
    return Draft202012Validator(schema)


def documents(path: Path) -> list[Any]:
    if path.suffix == ".csv":
        return list(csv.DictReader(path.read_text().splitlines()))
    return [json.loads(path.read_text())]


def violations(results: Path) -> list[str]:
    """Return what in the published files of a campaign is not as the schemas say; each schema must have a file."""
    found = []
    assert {f.stem for f in (ROOT / "pipeline" / "schemas").glob("*.json")} == set(FILES)
    for name, pattern in FILES.items():
        paths = sorted(results.glob(pattern))
        assert paths, pattern
        for path in paths:
            errors = [e for document in documents(path) for e in validator(name).iter_errors(document)]
            found += [f"{path.name}{e.json_path[1:]}: {e.message[:200]}" for e in errors]
    return found
