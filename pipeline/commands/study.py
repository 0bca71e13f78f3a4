"""Run the blind study of the diagnosis: hide effects at random, diagnose, count."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.errors import ConfigurationError
from pipeline.study.cases import FAMILIES
from pipeline.study.figures import all_figures, joined, mean_excess_gone
from pipeline.study.page import page
from pipeline.study.run import RESULTS, TRUTH, read_lines, run_study

if TYPE_CHECKING:
    from collections.abc import Sequence

EPILOG = f"""\
families: {", ".join(FAMILIES)}

The truth goes to DIR/truth.jsonl, which the diagnosis never reads, what it says to DIR/results.jsonl. A case that is
there is not run again, so the same command goes on where it was interrupted. A case takes about a second.
"""


def main(argv: Sequence[str]) -> int:
    """Run ``python -m pipeline study DIR``."""
    parser = argparse.ArgumentParser(
        prog="python -m pipeline study",
        description=__doc__,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("directory", type=Path, metavar="DIR", help="where truth and results go")
    parser.add_argument("--families", default="single,pairs,null_normal", help="with commas, or all")
    parser.add_argument("--n", type=int, default=100, help="cases of each family (100)")
    parser.add_argument("--seed", type=int, default=1, help="every random number follows from it (1)")
    parser.add_argument("--processes", type=int, default=1, help="cores to use (1)")
    parser.add_argument("--table", type=Path, metavar="FILE", help="write the study as a Markdown page")
    arguments = parser.parse_args(argv)
    families = list(FAMILIES) if arguments.families == "all" else arguments.families.split(",")
    unknown = sorted(set(families) - set(FAMILIES))
    if unknown:
        raise ConfigurationError(f"no family is called {', '.join(unknown)}; known: {', '.join(FAMILIES)}")
    run_study(
        arguments.directory, families, arguments.n, arguments.seed, processes=arguments.processes, progress=_progress
    )
    cases = joined(read_lines(arguments.directory / TRUTH), read_lines(arguments.directory / RESULTS))
    for figure in all_figures(cases):
        low, high = figure.interval
        print(
            f"{figure.name:<75} {figure.hits:>4} of {figure.total:<4} {100 * low:5.1f} to {100 * high:5.1f} %"
            f"  {figure.goal:<8} {' '.join(figure.misses[:8])}"
        )
    mean, error, count = mean_excess_gone(cases)
    if count > 1:
        print(f"held-out excess that is gone: {100 * mean:.1f} % +- {196 * error:.1f} % (n = {count})")
    if arguments.table:
        command = f"python -m pipeline study DIR --families {arguments.families} --n {arguments.n}"
        arguments.table.write_text(page(cases, f"{command} --seed {arguments.seed}"), encoding="utf-8")
    return 0


def _progress(done: int, total: int) -> None:
    if done % 10 == 0 or done == total:
        print(f"\r{done} of {total}", end="\n" if done == total else "", file=sys.stderr, flush=True)
