"""Run the blind study of the diagnosis: hide effects at random, diagnose them, count what is found."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.commands import parser_of
from pipeline.errors import ConfigurationError
from pipeline.run_progress import Countdown
from pipeline.study.cases import FAMILIES
from pipeline.study.page import DIAGRAM, page
from pipeline.study.run import RESULTS, TRUTH, read_lines, run_study
from pipeline.study.scores import (
    all_figures,
    cases_of,
    figures,
    in_the_catalogue,
    mean_excess_gone,
    numbers,
    reliability_diagram,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

EPILOG = f"""\
families: {", ".join(FAMILIES)}

The truth is written to DIR/truth.jsonl, which the diagnosis never reads; the diagnoses to DIR/results.jsonl. A case
with a result is not run again, so the same command continues an interrupted study; use a new directory after a
change of the code. A case takes one to three seconds.
"""


def main(argv: Sequence[str]) -> int:
    """Run ``python -m pipeline study DIR``."""
    parser = parser_of("study", __doc__, EPILOG)
    parser.add_argument("directory", type=Path, metavar="DIR", help="folder for the truth and the results")
    words = "families of cases, with commas; a first word (null, shape) means all families that begin with it; or all"
    parser.add_argument("--families", default="single,pairs,null_normal", help=words)
    parser.add_argument("--n", type=int, default=100, help="cases of each family (default: 100)")
    parser.add_argument("--seed", type=int, default=1, help="seed of all random numbers (default: 1)")
    parser.add_argument("--processes", type=int, default=1, help="processor cores (default: 1)")
    words = "write the study as a Markdown page, and its diagram to images/ beside it"
    parser.add_argument("--table", type=Path, metavar="FILE", help=words)
    arguments = parser.parse_args(argv)
    families = _families(arguments.families)
    countdown = Countdown(0)

    def progress(done: int, total: int) -> None:
        countdown.total = total
        countdown(done, f"{done} of {total} cases")

    run_study(
        arguments.directory, families, arguments.n, arguments.seed, processes=arguments.processes, progress=progress
    )
    countdown.end()
    cases = cases_of(read_lines(arguments.directory / TRUTH), read_lines(arguments.directory / RESULTS))
    for figure in [*all_figures(cases), *figures(cases)]:
        low, high = figure.interval
        print(
            f"{figure.name:<75} {figure.hits:>4} of {figure.total:<4} {100 * low:5.1f} to {100 * high:5.1f} %"
            f"  {figure.goal:<8} {' '.join(figure.misses[:8])}"
        )
    for each in numbers(cases):
        print(f"{each.name}: {each.value:.2g} (n = {each.total})  {each.goal}")
    mean = mean_excess_gone(in_the_catalogue(cases))
    if mean.total > 1:
        print(
            f"held-out excess that is gone: {100 * mean.value:.1f} % +- {196 * mean.error:.1f} %, "
            f"least {100 * mean.least:.0f} % (n = {mean.total})"
        )
    if arguments.table:
        command = f"python -m pipeline study DIR --families {arguments.families} --n {arguments.n}"
        diagram = arguments.table.parent / "images" / DIAGRAM
        diagram.parent.mkdir(exist_ok=True)
        diagram.write_text(reliability_diagram(cases), encoding="utf-8")
        arguments.table.write_text(page(cases, f"{command} --seed {arguments.seed}"), encoding="utf-8")
    return 0


def _families(text: str) -> list[str]:
    """Return the families that are asked for, each once."""
    found: list[str] = []
    for name in text.split(","):
        these = [f for f in FAMILIES if name in (f, "all")] or [f for f in FAMILIES if f.startswith(f"{name}_")]
        if not these:
            raise ConfigurationError(f"no family is called {name!r}; known: {', '.join(FAMILIES)}")
        found += [family for family in these if family not in found]
    return found
