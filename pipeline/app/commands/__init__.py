"""The commands, each a function of ``argv`` (``pipeline.__main__.COMMANDS``), and the options that they share."""

from __future__ import annotations

import argparse
from typing import Any

OF_RANGE = "full scale of the accelerometer in g, then of the gyroscope in deg/s (default: from the sensor file)"
SHARED_OPTIONS: dict[str, dict[str, Any]] = {
    "--sensor": {"metavar": "NAME", "help": "sensor model, a name in configs/sensor: full scale, counts, noise"},
    "--range": {"type": float, "nargs": "+", "metavar": "RANGE", "help": OF_RANGE},
    "--ingest": {"metavar": "PROFILE", "help": "format of the log: a name in configs/ingest, or the file of a profile"},
    "--results": {"metavar": "DIR", "default": "results", "help": "folder of all results (default: results)"},
}


def parser_of(
    command: str,
    description: str | None,
    epilog: str = "",
    shared: tuple[str, ...] = (),
    **settings: Any,  # noqa: ANN401  (of argparse)
) -> argparse.ArgumentParser:
    """Return the parser of a command with some options of ``SHARED_OPTIONS``; line breaks of its texts are kept."""
    form = argparse.RawDescriptionHelpFormatter
    about = (description or "").partition("\n\n")[0]
    parser = argparse.ArgumentParser(
        f"python -m pipeline {command}", description=about, epilog=epilog, formatter_class=form, **settings
    )
    for option in shared:
        parser.add_argument(option, **SHARED_OPTIONS[option])
    return parser


def add_run_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of every command that runs a campaign."""
    parser.add_argument("--cores", default="2", metavar="N", help="processor cores of the run (default: 2)")
    parser.add_argument("--results", **SHARED_OPTIONS["--results"])
    words = "further settings of the run, as for snakemake --config"
    parser.add_argument("--config", nargs="+", default=[], metavar="KEY=VALUE", help=words)
