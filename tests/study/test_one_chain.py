"""``calibrate_unit`` gives the published documents of a run in every digit, for all units of the shipped campaigns.

``nice python -m pytest -m study tests/study/test_one_chain.py`` takes some minutes for each large campaign (``-k demo``
chooses one). ``RESULTS=FOLDER`` compares with the results of runs that are there, instead of new ones.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import pipeline

ROOT = Path(__file__).parents[2]
CAMPAIGNS = sorted(sheet.parent.name for sheet in ROOT.glob("data/*/units.csv"))


@pytest.mark.study
@pytest.mark.parametrize("campaign", CAMPAIGNS)
def test_all_units_of_a_shipped_campaign(campaign: str, tmp_path: Path) -> None:
    results = Path(os.environ.get("RESULTS", tmp_path))
    if not (results / campaign / "summary.csv").is_file():
        command = [sys.executable, "-m", "snakemake", "--cores", "2", "--quiet", "-s", str(ROOT / "Snakefile")]
        subprocess.run([*command, "--config", f"campaign={campaign}", f"results={results}"], check=False)
    published = pipeline.load_campaign(results / campaign)
    different: list[str] = []
    for unit in published.units:
        theirs, ours = published.unit(unit), documents_of(campaign, unit, results)
        for kind, document in ours.items():
            different += [f"{unit} {kind}"] if document != getattr(theirs, kind) else []
    print(f"\n{campaign}: {len(published.units)} units compared, {len(different)} documents differ")  # noqa: T201
    assert different == []


def documents_of(campaign: str, unit: str, results: Path) -> dict[str, Any]:
    """Return the documents of a unit; of a unit that fails, the record of its failure."""
    try:
        found = pipeline.calibrate_unit(campaign, unit, results=results)
    except pipeline.PipelineError as error:
        return {"failure": {"code": error.code, "message": error.message, "file": error.file}}
    return {kind: json.loads(json.dumps(getattr(found, kind))) for kind in ("calibration", "validation", "diagnosis")}
