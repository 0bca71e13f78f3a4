"""Stage verdict: report the failed units and set the exit code of the run."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.files import read_json, write_json

if TYPE_CHECKING:
    from collections.abc import Sequence


def main(argv: Sequence[str]) -> int:
    """Return 1 and name every failed unit, or write the mark of a complete campaign."""
    parser = argparse.ArgumentParser(prog="python -m pipeline verdict", description=__doc__)
    parser.add_argument("--failures", type=Path, required=True, help="the failures that gather found")
    parser.add_argument("--results", type=Path, required=True, help="of the campaign, as the user names them")
    parser.add_argument("--output", type=Path, required=True, help="mark that is written where no unit has failed")
    arguments = parser.parse_args(argv)
    failures = read_json(arguments.failures)
    if not failures:
        write_json(arguments.output, {"failed": 0})
        return 0
    page, plural = arguments.results / "index.html", "s" * (len(failures) > 1)
    print(f"{len(failures)} unit{plural} failed (all others are done; see {page}):", file=sys.stderr)
    for f in failures:
        where = f"{f['file']}: " if f["file"] else ""
        print(f"  {f['unit']}: {where}{f['message']} [{f['code']} in {f['stage']}]", file=sys.stderr)
    return 1
