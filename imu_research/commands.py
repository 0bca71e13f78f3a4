"""Run the blind study of the diagnosis, and the comparison with the thesis."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from pipeline.app.commands import parser_of
from pipeline.core.errors import ConfigurationError
from pipeline.core.files import write_atomically

STUDY = """\
families: {}

The truth is written to DIR/truth.jsonl, which the diagnosis never reads, and the diagnoses to DIR/results.jsonl. The
same command continues an interrupted study, because a case with a result is not run again. Use a new directory after a
change of the code. A case takes one to three seconds.
"""
THESIS = """\
page    compares the results in DIR with the printed figures of the campaign, as a run of the campaign does
seeds   simulates the campaign's recordings with every seed and writes FILE (data/thesis/seeds.csv is made by
        python -m pipeline thesis seeds --campaign data/thesis --output data/thesis/seeds.csv; 10 minutes)
"""


def study(argv: Sequence[str]) -> int:
    """Run the blind study of the diagnosis: hide random effects, diagnose the units, and count correct answers."""
    from imu_research.figures import write_figures  # noqa: PLC0415
    from imu_research.study import page, run, scores  # noqa: PLC0415  (not needed for a comparison with the thesis)
    from imu_research.study.cases import FAMILIES  # noqa: PLC0415
    from imu_research.study.result import cases_of  # noqa: PLC0415
    from pipeline.app.run_progress import Countdown  # noqa: PLC0415

    parser = parser_of("study", study.__doc__, STUDY.format(", ".join(FAMILIES)))
    parser.add_argument("directory", type=Path, metavar="DIR", help="folder for the truth and the results")
    words = "families of cases, separated by commas; a first word (null, shape) selects all families with it; or all"
    parser.add_argument("--families", default="single,pairs,null_normal", help=words)
    parser.add_argument("--n", type=int, default=100, help="cases of each family (default: 100)")
    parser.add_argument("--seed", type=int, default=1, help="seed of all random numbers (default: 1)")
    parser.add_argument("--processes", type=int, default=1, help="processor cores (default: 1)")
    words = "write the study as a Markdown page, and its diagram to the folder images/ next to it"
    parser.add_argument("--table", type=Path, metavar="FILE", help=words)
    parser.add_argument("--figures", type=Path, metavar="FILE", help="write the scores as JSON")
    arguments = parser.parse_args(argv)
    families = _families(arguments.families, FAMILIES)
    countdown = Countdown(0)

    def progress(done: int, total: int) -> None:
        countdown.total = total
        countdown(done, f"{done} of {total} cases")

    run.run_study(
        arguments.directory, families, arguments.n, arguments.seed, processes=arguments.processes, progress=progress
    )
    countdown.end()
    cases = cases_of(*(run.read_lines(arguments.directory / name) for name in (run.TRUTH_FILE, run.RESULTS_FILE)))
    found = [*scores.accepted(cases), *scores.family_scores(cases), *scores.answer_scores(cases)]
    write_figures(arguments.figures, [*found, *scores.false_selection_rates(cases), *scores.stated_shares(cases)])
    for score in found:
        name, n, value, interval, goal = score.cells
        print(f"{name:<92} {n:>5} {value:>8} {interval:<16} {goal:<9} {' '.join(score.misses[:8])}".rstrip())
    if arguments.table:
        command = f"python -m pipeline study DIR --families {arguments.families} --n {arguments.n}"
        diagram = arguments.table.parent / "images" / page.DIAGRAM
        diagram.parent.mkdir(exist_ok=True)
        diagram.write_text(scores.reliability_diagram(cases), encoding="utf-8")
        arguments.table.write_text(page.page(cases, f"{command} --seed {arguments.seed}"), encoding="utf-8")
    return 0


def _families(text: str, known: Sequence[str]) -> list[str]:
    """Return the families that ``--families`` selects, each once."""
    families: list[str] = []
    for name in text.split(","):
        selected = [f for f in known if name in (f, "all")] or [f for f in known if f.startswith(f"{name}_")]
        if not selected:
            raise ConfigurationError(f"no family is called {name!r}; known: {', '.join(known)}")
        families += [family for family in selected if family not in families]
    return families


def thesis(argv: Sequence[str]) -> int:
    """Compare the results with the figures of the thesis, and test its conclusions over many seeds."""
    parser = parser_of("thesis", thesis.__doc__, THESIS)
    parser.add_argument("what", choices=("page", "seeds"))
    words = "campaign with simulation.yaml and the folder printed/"
    parser.add_argument("--campaign", type=Path, required=True, metavar="DIR", help=words)
    parser.add_argument("--results", type=Path, metavar="DIR", help="page: results of the campaign")
    parser.add_argument("--output", type=Path, required=True, metavar="FILE", help="file to write")
    parser.add_argument("--seeds", type=int, default=50, help="seeds: how many (default: 50)")
    parser.add_argument("--processes", type=int, default=1, help="processor cores (default: 1)")
    arguments = parser.parse_args(argv)
    if arguments.what == "seeds":
        _seeds(arguments.campaign, arguments.seeds, arguments.processes, arguments.output)
        return 0
    if arguments.results is None:
        parser.error("page needs --results DIR, of a run of the campaign")
    from imu_research.thesis.page import render  # noqa: PLC0415  (not needed for the study)

    write_atomically(arguments.output, render(arguments.campaign, arguments.results))
    return 0


def _seeds(campaign: Path, count: int, processes: int, output: Path) -> None:
    from concurrent.futures import ProcessPoolExecutor  # noqa: PLC0415
    from functools import partial  # noqa: PLC0415

    import pandas as pd  # noqa: PLC0415

    from imu_research.thesis.seeds import SEED_COLUMNS, sets_of, study_of  # noqa: PLC0415  (estimators: not for the page)

    rows = []
    sets = sets_of(campaign)
    with ProcessPoolExecutor(processes) as pool:
        for name, of_set in zip(sets, pool.map(partial(study_of, campaign, range(count)), sets), strict=True):
            rows += of_set
            print(f"{name}: {len(of_set)} rows", file=sys.stderr, flush=True)
    pd.DataFrame(rows, columns=SEED_COLUMNS).to_csv(output, index=False, float_format="%.5g", lineterminator="\n")
