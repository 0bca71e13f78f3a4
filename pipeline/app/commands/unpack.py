"""Publish the files of units of a large campaign, whose files are in packs."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

from pipeline.app.commands import parser_of
from pipeline.app.config.campaign import find_campaign
from pipeline.app.config.owner import require_own_results
from pipeline.app.results_folder import (
    NEW_FOLDER,
    BusyError,
    finish_publishing,
    is_as_written,
    jobs_running,
    publish,
    repetitions,
    take_run,
)
from pipeline.app.steps.gather import publish_histories
from pipeline.core.errors import ConfigurationError, MissingInputError
from pipeline.core.files import flushed_together, write_atomically
from pipeline.core.pack import PACKS, batches_of
from pipeline.output.history import read_history
from pipeline.output.pages.pages import linked

EPILOG = """\
Above publish_limit units a run publishes no files of single units (docs/fleet.md). This command publishes them for the
named units; later runs keep them.

  python -m pipeline unpack my_fleet U0123 U0124
"""


def main(argv: Sequence[str]) -> int:
    """Run ``python -m pipeline unpack C UNIT ...``."""
    parser = parser_of("unpack", __doc__, EPILOG, ("--results",))
    parser.add_argument("campaign", metavar="C", type=Path, help="a campaign, or its results")
    parser.add_argument("units", metavar="UNIT", nargs="+", help="units whose files are published")
    arguments = parser.parse_intermixed_args(argv)
    campaign, units = arguments.campaign, arguments.units
    results = campaign if (campaign / "summary.csv").is_file() else _results_of(campaign, Path(arguments.results))
    if not any((results / PACKS).glob("*/*")):
        raise MissingInputError("holds no packs: run the campaign first, or its units have files already", str(results))
    take_run(results)
    if jobs_running(results):
        raise BusyError("jobs of a killed run are still running; wait until they have ended", str(results))
    finish_publishing(results)
    batches = batches_of(results)
    if absent := [unit for unit in units if unit not in batches]:
        raise MissingInputError(f"no unit {', '.join(absent)}; known: {', '.join(sorted(batches)[:12])}", str(results))
    again, new, index = repetitions(results, "")[0], results / NEW_FOLDER, results / "index.html"
    shutil.rmtree(new, ignore_errors=True)
    paths = []
    with flushed_together(results):
        for unit in units:
            for name, content in batches[unit].files(unit):
                write_atomically(new / name, content)
                paths.append(name)
        publish_histories(new, read_history(results), units)
        if is_as_written(results, index.name):
            write_atomically(new / index.name, linked(index.read_text(encoding="utf-8"), units))
            paths.append(index.name)
        else:
            print(f"note: {index} was changed or deleted, so it gets no links to these units until the next run")
    publish(new, results, again=again, paths=paths)
    print("\n".join(str(results / "reports" / f"{unit}.html") for unit in units))
    return 0


def _results_of(campaign: Path, results: Path) -> Path:
    """Return the folder of a campaign's results; where there is no such campaign, its name says whose are meant."""
    try:
        directory = find_campaign(str(campaign))
    except ConfigurationError:
        return results / campaign.name
    require_own_results(directory, results, {})
    return results / directory.name
