"""Count the good units that are refused or wrongly doubted: units of the blind study's families, as it draws them.

    python tests/corruption/good_run.py --units 1000 --seed 5 --out good.jsonl [--cores 1]

Each goes through the steps of a run up to the diagnosis. Where nothing
is hidden, any verdict but ``nothing_missing`` is wrong; else only a doubt about reference or floor, and about the
reference only where no error of the table is hidden. A unit that is in the file is not run again.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

from imu_research.figures import wilson
from imu_research.study.cases import FAMILIES, draw
from imu_research.study.run import diagnose_case, read_lines
from pipeline.core.errors import PipelineError
from pipeline.core.records import SENSORS

if TYPE_CHECKING:
    from pipeline.unit import UnitState

DOUBTS = ("reference_in_doubt", "floor_in_doubt")


def judged(family: str, number: int, seed: int) -> dict[str, Any]:
    """Return what is said of one unit, by the steps of a run."""
    case = draw(family, number, seed)
    line: dict[str, Any] = {"family": family, "number": number, "seed": seed, "refused": None, "verdicts": {}}
    try:
        _, state = diagnose_case(case)
    except PipelineError as error:
        return line | {"refused": error.message}
    for sensor in SENSORS if case.kind == "null" else (case.sensor,):
        line["verdicts"][sensor] = said(state, sensor)
    return line


def said(state: UnitState, sensor: str) -> dict[str, Any]:
    """Return verdict and held-out error of a sensor."""
    held, found = state.validation[sensor], state.diagnosis[sensor]
    if found is None:
        return {"verdict": "refused", "message": state.fits[sensor].reason}
    out = {"verdict": found["verdict"], "selected": found["selected"], "error": held["steps"][-1]["rms_error"]}
    return out | {"floor": held["noise_floor"], "expected": held.get("expected_rms_error")}


def wrong(line: dict[str, Any]) -> str:
    """Return what is wrong about a unit; empty where nothing is."""
    if line["refused"]:
        return "refused: " + line["refused"]
    nothing_hidden = line["family"].startswith("null")
    hidden = draw(line["family"], line["number"], line["seed"]).hidden
    for sensor, one in line["verdicts"].items():
        if one["verdict"] == "reference_in_doubt" and any(name.startswith("table_") for name in hidden):
            continue  # the table does differ from its log
        if one["verdict"] in ("refused", *DOUBTS) or (nothing_hidden and one["verdict"] != "nothing_missing"):
            return f"{sensor}: {one}"
    return ""


def report(lines: list[dict[str, Any]]) -> str:
    """Return the count by family, with Wilson intervals, and each wrong unit."""
    by_family: dict[str, list[str]] = defaultdict(list)
    for line in lines:
        by_family[line["family"]].append(wrong(line))
    by_family["all"] = [wrong(line) for line in lines]
    out = [f"{'family':<24}{'units':>6}{'wrong':>7}  share, 95 % interval"]
    for family, found in by_family.items():
        count = sum(map(bool, found))
        low, high = wilson(count, len(found))
        out.append(f"{family:<24}{len(found):>6}{count:>7}  {count / len(found):.1%}, {low:.1%} to {high:.1%}")
    out += [f"{x['family']} {x['number']} seed {x['seed']}: {wrong(x)}" for x in lines if wrong(x)]
    return "\n".join(out) + "\n"


def main() -> int:
    """Run it; exit code 1 where over 1 % are wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--units", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--cores", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    lines = read_lines(options.out)
    done = {(x["family"], x["number"], x["seed"]) for x in lines}
    wanted = [(FAMILIES[k % len(FAMILIES)], k // len(FAMILIES), options.seed) for k in range(options.units)]
    wanted = [item for item in wanted if item not in done]
    with ProcessPoolExecutor(options.cores) as pool, options.out.open("a", encoding="utf-8") as stream:
        for line in pool.map(judged, *zip(*wanted, strict=True)) if wanted else ():
            stream.write(json.dumps(line) + "\n")
            stream.flush()
            lines.append(line)
    sys.stdout.write(report(lines))
    return int(sum(bool(wrong(x)) for x in lines) > 0.01 * len(lines))


if __name__ == "__main__":
    sys.exit(main())
