"""Stage verdict: the campaign's failures, said once more, as the exit code of the run."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.stages.batch import read_json, write_json

if TYPE_CHECKING:
    from collections.abc import Sequence


def main(argv: Sequence[str]) -> int:
    """Return 1 and name every failed unit, or write the mark of a complete campaign."""
    parser = argparse.ArgumentParser(prog="python -m pipeline verdict", description=__doc__)
    parser.add_argument("--failures", type=Path, required=True, help="the failures that gather found")
    parser.add_argument("--results", type=Path, required=True, help="of the campaign, as a person calls them")
    parser.add_argument("--output", type=Path, help="mark that is written where no unit has failed")
    arguments = parser.parse_args(argv)
    failures = read_json(arguments.failures)
    if failures:
        page = arguments.results / "index.html"
        print(
            f"{len(failures)} unit{'s' * (len(failures) > 1)} failed (all others are done; see {page}):",
            file=sys.stderr,
        )
        for f in failures:
            where = f"{f['file']}: " if f["file"] else ""
            print(f"  {f['unit']}: {where}{f['message']} [{f['code']} in {f['stage']}]", file=sys.stderr)
        return 1
    if arguments.output:
        write_json(arguments.output, {"failed": 0})
    return 0
