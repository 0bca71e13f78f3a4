"""Compare the results of two versions of the code: ``python tests/golden/compare.py BEFORE AFTER``.

BEFORE and AFTER are results folders of the same campaigns (``results/`` or ``results/<campaign>``). Calibrations,
validations and diagnoses are compared value by value. Numbers agree within a relative difference of 1e-10; estimates
also agree within 1e-3 of their standard uncertainty. Text that only describes a result is not compared. The last line
has the smallest and the largest median over the units of the ratio of U, of all parameters of bias and matrix.
"""

from __future__ import annotations

import json
import sys
from itertools import chain
from pathlib import Path
from statistics import median
from typing import Any

FOLDERS = ("calibrations", "validations", "diagnoses")
TEXT = {
    "schema_version", "software", "config_sha256", "notes", "message", "reason", "next_experiment", "text", "words",
    "seconds",
}  # fmt: skip
RELATIVE = 1e-10
OF_UNCERTAINTY = 1e-3
COVERAGE = 2.0  # expanded uncertainty over standard uncertainty


def differences(before: Any, after: Any, at: str, uncertainty: float = 0.0) -> list[str]:
    """Return the places where two JSON values disagree."""
    if isinstance(before, dict) and isinstance(after, dict):
        found = [f"{at}: keys {sorted(before.keys() ^ after.keys())}"] if before.keys() != after.keys() else []
        expanded = before.get("expanded_uncertainty")
        for key in before.keys() & after.keys() - TEXT:
            u = expanded.get(key) if isinstance(expanded, dict) else expanded if key == "value" else None
            found += _with(before[key], after[key], f"{at}.{key}", u)
        return found
    if isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        return list(
            chain(*(differences(b, a, f"{at}[{i}]") for i, (b, a) in enumerate(zip(before, after, strict=True))))
        )
    numbers = all(isinstance(v, int | float) and not isinstance(v, bool) for v in (before, after))
    if numbers and abs(before - after) <= max(RELATIVE * abs(before), 1e-13, OF_UNCERTAINTY * uncertainty):
        return []
    return [] if before == after else [f"{at}: {_short(before)} -> {_short(after)}"]


def _with(before: Any, after: Any, at: str, expanded: Any) -> list[str]:
    """Compare estimates that have expanded uncertainties of the same shape."""
    if (
        isinstance(before, list)
        and isinstance(after, list)
        and isinstance(expanded, list)
        and len(before) == len(after)
    ):
        triples = zip(before, after, expanded, strict=True)
        return list(chain(*(_with(b, a, f"{at}[{i}]", u) for i, (b, a, u) in enumerate(triples))))
    return differences(before, after, at, expanded / COVERAGE if isinstance(expanded, int | float) else 0.0)


def _short(value: Any) -> str:
    return text if len(text := json.dumps(value)) < 90 else f"{text[:87]}..."


def uncertainty_ratios(before: Path, after: Path, files: list[Path]) -> dict[tuple[str, int], list[float]]:
    """Return U after over U before of each sensor and parameter (bias, then matrix by rows), of all units with both."""
    ratios: dict[tuple[str, int], list[float]] = {}
    for file in (f for f in files if f.parent.name == "calibrations" and (after / f).exists()):
        documents = [json.loads((folder / file).read_bytes()) for folder in (before, after)]
        for sensor in ("accelerometer", "gyroscope"):
            stated = [(document.get(sensor) or {}).get("expanded_uncertainty") for document in documents]
            if all(stated):
                flat = [[*U["bias"], *chain(*U["matrix"])] for U in stated]
                for number, (old, new) in enumerate(zip(*flat, strict=True)):
                    if old and new:
                        ratios.setdefault((sensor, number), []).append(new / old)
    return ratios


def main(before: Path, after: Path) -> int:
    """Print the differences by file; return 1 where there are any."""
    files = sorted(
        p.relative_to(before) for name in FOLDERS for p in before.glob(f"**/{name}/*.json") if "batches" not in p.parts
    )
    different = 0
    for file in files:
        if not (after / file).exists():
            found = ["missing"]
        elif (before / file).read_bytes() == (after / file).read_bytes():
            continue
        else:
            found = differences(json.loads((before / file).read_bytes()), json.loads((after / file).read_bytes()), "")
        different += bool(found)
        for line in found[:8]:
            print(f"{file} {line}")
        if len(found) > 8:
            print(f"{file} ... {len(found) - 8} more")
    print(f"{len(files)} files, {different} differ")
    if medians := [median(each) for each in uncertainty_ratios(before, after, files).values()]:
        print(f"U after / before, medians of {len(medians)} parameters: {min(medians):.4g} to {max(medians):.4g}")
    return int(different > 0 or not files)


if __name__ == "__main__":
    sys.exit(main(*map(Path, sys.argv[1:3])))
