"""Corrupt good units in many ways, calibrate them in one campaign, and count what came of them.

python tests/corruption/run.py --units 170 --seed 1 --out DIR [--good 20] [--cores 1] [--only u0031 ...] [--kind WORD]
"""

from __future__ import annotations

import argparse
import csv
import os
import shutil
import subprocess
import sys
from collections import Counter
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from all_ways import corrupted, single_ways
from good_bench import BASES, good_unit
from judged import OUTCOMES, SILENT, Judgement, judge, refused, shares_of
from unit_copy import TIME, Copy, NotApplicableError, write

from imu_research.figures import write_figures
from pipeline.app.config import load_campaign
from pipeline.core.errors import PipelineError

if TYPE_CHECKING:
    from collections.abc import Callable

ROOT = Path(__file__).parents[2]
LATEST_S = 2.0**63 / 1e9
COLUMNS = ("unit", "sensor", "table", "procedure", "method", "filter", "overrides")
CONFIGURED = ("settings", "axis map", "gravity stated", "two at once", "by hand")


def main() -> int:
    """Run it; exit code 1 with a silent error."""
    options = parsed()
    out = Path(options.out).resolve()
    shutil.rmtree(out, ignore_errors=True)
    copies = drawn(options)
    judgements = run(copies, out, partial(by_snakemake, cores=options.cores))
    text = report(judgements, options.seed)
    (out / "table.txt").write_text(text, encoding="utf-8")
    sys.stdout.write(text)
    write_figures(options.figures, shares_of(Counter(j.outcome for j in judgements if not j.harmless)))
    return int(any(j.outcome == SILENT for j in judgements))


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--units", type=int, default=170, help="corrupted units; the first go through all ways, class by class")
    words = "number of the first; beyond the ways, units are random, some changed twice"
    add("--start", type=int, default=0, help=words)
    add("--seed", type=int, default=1)
    add("--good", type=int, default=0, help="units that are not corrupted, beside them")
    add("--only", nargs="+", default=[], metavar="UNIT", help="only these units of the draw")
    add("--kind", default="", help="only classes with this word")
    add("--cores", type=int, default=1)
    add("--out", required=True, help="directory for the campaign, its results and the table; replaced")
    add("--figures", type=Path, help="file for the shares with their 95 % intervals")
    return parser.parse_args()


def drawn(options: argparse.Namespace) -> list[Copy]:
    ways = single_ways()
    copies = []
    for number in range(options.start, options.start + options.units):
        name = f"u{number:04d}"
        if options.only and name not in options.only:
            continue
        try:
            copy = _writable(corrupted(number, options.seed, ways))
        except NotApplicableError as reason:
            sys.stderr.write(f"{name}: {reason}\n")
            continue
        if options.kind in copy.kind:
            copies.append(copy)
    bases = list(BASES)
    for number in range(options.good):
        base, seed = bases[number % len(bases)], 900_000 + 1000 * options.seed + number
        copy = good_unit(base, seed, f"good{number:03d}", varied=number >= len(bases))
        copy.kind, copy.way, copy.harmless = "(not corrupted)", "good", True
        copies.append(copy)
    return copies


def _writable(copy: Copy) -> Copy:
    """Return a unit whose columns have the same length in each recording."""
    if any(len({len(v) for v in table.values()}) > 1 for table in copy.tables.values()):
        raise NotApplicableError(f"{copy.way} leaves columns of unequal length")
    if any(np.max(np.abs(table[TIME])) > LATEST_S for table in copy.tables.values()):
        raise NotApplicableError(f"{copy.way} leaves times that no 64-bit stamp in ns holds")
    return copy


def by_snakemake(campaign: Path, results: Path, cores: int = 1) -> None:
    """Calibrate a campaign by the real command."""
    settings = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    command = [Path(sys.executable).with_name("snakemake"), "--cores", cores, "--quiet", "all"]
    command += ["--config", f"campaign={campaign}", f"results={results}"]
    with (results.parent / "run.log").open("w", encoding="utf-8") as log:
        subprocess.run(
            [str(c) for c in command], cwd=ROOT, env={**os.environ, **settings}, stdout=log, stderr=log, check=False
        )


def run(copies: list[Copy], out: Path, calibrate: Callable[[Path, Path], object] = by_snakemake) -> list[Judgement]:
    """Write the campaign, calibrate it, and judge every unit."""
    campaign = out / "corrupted"
    judgements, rows, kept = [], [], []
    for copy in copies:
        row = {"unit": copy.name, **copy.row, "overrides": "; ".join(copy.overrides)}
        refusal = refusal_of(row, out / "one") if copy.kind in CONFIGURED else ""
        if refusal:
            judgements += refused(copy, refusal)
            continue
        write(copy, campaign / "raw" / copy.name)
        copy.tables.clear()  # they take memory, and are in files now
        vars(copy).pop("other", None)
        rows.append(row)
        kept.append(copy)
    sheet(campaign, rows)
    calibrate(campaign, out / "results")
    for copy in kept:
        judgements += judge(copy, out / "results" / "corrupted")
    return judgements


def sheet(campaign: Path, rows: list[dict[str, str]]) -> None:
    campaign.mkdir(parents=True, exist_ok=True)
    with (campaign / "units.csv").open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, COLUMNS, restval="")
        writer.writeheader()
        writer.writerows(rows)


def refusal_of(row: dict[str, str], folder: Path) -> str:
    """Return why a unit's configuration is refused, empty where it is not: such a unit would stop the whole run."""
    sheet(folder, [row])
    try:
        load_campaign({"campaign": str(folder)})
    except PipelineError as error:
        return error.message
    return ""


def report(judgements: list[Judgement], seed: int) -> str:
    """Return the table and the silent cases as text."""
    kinds = sorted({j.kind for j in judgements})
    width = max(len(k) for k in kinds) + 2
    lines = [f"{'class':<{width}}{'units':>6}" + "".join(f"{o:>10}" for o in OUTCOMES) + f"{'needless':>10}"]
    for kind in [*kinds, "all"]:
        chosen = [j for j in judgements if kind in (j.kind, "all")]
        count = Counter(j.outcome for j in chosen)
        needless = sum(j.needless for j in chosen)
        units = len({j.unit for j in chosen})
        lines.append(f"{kind:<{width}}{units:>6}" + "".join(f"{count[o]:>10}" for o in OUTCOMES) + f"{needless:>10}")
    lines += ["", "Counts are of sensors. needless: refused or doubtful though nothing that counts was changed.", ""]
    for outcome in (SILENT, "unseen", "marked"):
        found = [j for j in judgements if j.outcome == outcome]
        lines += [f"{outcome}: {len(found)} sensors of {len({j.unit for j in found})} units"]
        lines += [f"  seed {seed} {j.line}" for j in found]
    needless = [j for j in judgements if j.needless]
    lines += [f"needless: {len(needless)} sensors", *(f"  seed {seed} {j.line} {j.message[:160]}" for j in needless)]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    np.seterr(all="raise", under="ignore")
    sys.exit(main())
