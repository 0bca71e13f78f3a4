"""Publish the files of units of a large campaign, whose files are in packs.

Beyond ``publish_limit`` units a campaign publishes no files for each unit (docs/fleet.md). This command adds them for
those that are asked for; later runs keep them.

  python -m pipeline unpack my_fleet U0123 U0124
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.errors import MissingInputError
from pipeline.files import flushed_together, write_atomically
from pipeline.history import read_history
from pipeline.pack import batches_of
from pipeline.report.pages import linked
from pipeline.results_folder import PUBLISHED, record_written, repetitions, take_run
from pipeline.stages.gather import publish_histories

if TYPE_CHECKING:
    from collections.abc import Sequence


def main(argv: Sequence[str]) -> int:
    """Publish the files of the units."""
    parser = argparse.ArgumentParser(
        prog="python -m pipeline unpack", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("campaign", metavar="C", type=Path, help="a campaign, or its results")
    parser.add_argument("units", metavar="UNIT", nargs="+", help="units whose files are published")
    parser.add_argument("--results", type=Path, default=Path("results"), help="where results are (default: results)")
    arguments = parser.parse_args(argv)
    given, units = arguments.campaign, arguments.units
    results = given if (given / "summary.csv").is_file() else arguments.results / given.name
    batches = batches_of(results)
    if not batches:
        raise MissingInputError("holds no packs: run the campaign first, or its units have files already", str(results))
    if absent := [unit for unit in units if unit not in batches]:
        raise MissingInputError(
            f"no unit {', '.join(absent)}; there are {', '.join(sorted(batches)[:12])}", str(results)
        )
    take_run(results)
    again, _ = repetitions(results, "")
    with flushed_together(results):
        for unit in units:
            for name, content in batches[unit].files(unit):
                write_atomically(results / name, content)
        publish_histories(results, read_history(results), units)
        index = results / "index.html"
        write_atomically(index, linked(index.read_text(encoding="utf-8"), units))
    record_written(results, "", again, PUBLISHED)
    print("\n".join(str(results / "reports" / f"{unit}.html") for unit in units))
    return 0
