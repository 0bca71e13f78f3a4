"""Compare the results with those printed in the thesis, and judge its conclusions over many seeds."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.commands import parser_of
from pipeline.files import write_atomically

if TYPE_CHECKING:
    from collections.abc import Sequence

EPILOG = """\
page    what a run of the campaign does: compares the results in DIR with the printed figures of the campaign
seeds   simulates the campaign's recordings with every seed and writes FILE (data/thesis/seeds.csv is made by
        python -m pipeline thesis seeds --campaign data/thesis --output data/thesis/seeds.csv; 10 minutes)
"""


def main(argv: Sequence[str]) -> int:
    """Run ``python -m pipeline thesis page`` or ``seeds``."""
    parser = parser_of("thesis", __doc__, EPILOG)
    parser.add_argument("what", choices=("page", "seeds"))
    parser.add_argument(
        "--campaign",
        type=Path,
        required=True,
        metavar="DIR",
        help="campaign with simulation.yaml and the folder printed/",
    )
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
    from pipeline.thesis.page import render  # noqa: PLC0415  (the study needs no page)

    write_atomically(arguments.output, render(arguments.campaign, arguments.results))
    return 0


def _seeds(campaign: Path, count: int, processes: int, output: Path) -> None:
    from concurrent.futures import ProcessPoolExecutor  # noqa: PLC0415
    from functools import partial  # noqa: PLC0415

    from pipeline.thesis.seeds import sets_of, write_rows  # noqa: PLC0415  (the page needs none of the estimators)

    rows = []
    sets = sets_of(campaign)
    with ProcessPoolExecutor(processes) as pool:
        for name, found in zip(sets, pool.map(partial(_study, campaign, count), sets), strict=True):
            rows += found
            print(f"{name}: {len(found)} rows", file=sys.stderr, flush=True)
    write_rows(output, rows)


def _study(campaign: Path, count: int, name: str) -> list[dict[str, object]]:
    from pipeline.thesis.seeds import study  # noqa: PLC0415

    return list(study(campaign, [name], range(count)))
