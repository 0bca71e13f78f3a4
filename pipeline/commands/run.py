"""Run a campaign: calibrate, validate and diagnose every unit, and write the pages."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from typing import TYPE_CHECKING

from pipeline.errors import ConfigurationError
from pipeline.files import SHIPPED
from pipeline.outcome import RESULTS

if TYPE_CHECKING:
    from collections.abc import Sequence

EPILOG = """\
examples:
  imu-calibration run demo
  imu-calibration run my_bench method=staged filter=rc_low_pass --cores 4 --results /data/results
  imu-calibration run my_bench --config 'unit_overrides={U1: [filter.cutoff_hz=2]}'
  imu-calibration run my_bench -- --dry-run

The rules are Snakemake's: what is up to date is not computed again. Options after -- go to Snakemake as they are.
"""


def main(argv: Sequence[str]) -> int:
    """Run ``imu-calibration run CAMPAIGN [OVERRIDE ...]``; the exit code is that of the run."""
    parser = argparse.ArgumentParser(
        prog="imu-calibration run",
        description=__doc__,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("campaign", metavar="CAMPAIGN", help="a campaign's directory, or demo")
    parser.add_argument("overrides", metavar="KEY=VALUE", nargs="*", help="Hydra overrides for every unit")
    add_run_options(parser)
    at = list(argv).index("--") if "--" in argv else len(argv)
    arguments = parser.parse_args(argv[:at])
    config = list(arguments.config)
    if arguments.overrides:
        if any(word.startswith("overrides=") for word in config):
            raise ConfigurationError("overrides are given twice, as KEY=VALUE and by --config; give them once")
        config.append(f"overrides={json.dumps(arguments.overrides)}")
    return run_snakemake(arguments, config, argv[at + 1 :])


def add_run_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that every command which runs a campaign has."""
    parser.add_argument("--cores", default="2", metavar="N", help="of the run (2)")
    parser.add_argument("--results", default=RESULTS, metavar="DIR", help="where results go (results)")
    parser.add_argument(
        "--config", nargs="+", default=[], metavar="KEY=VALUE", help="further settings of the run, as for snakemake"
    )


def run_snakemake(arguments: argparse.Namespace, config: Sequence[str], options: Sequence[str] = ()) -> int:
    """Run a campaign with the shipped rules, settings KEY=VALUE and options of Snakemake; return the exit code.

    ``arguments`` holds ``campaign`` and what ``add_run_options`` adds.
    """
    settings = [f"campaign={arguments.campaign}", *config]
    settings += [f"results={arguments.results}"] * (arguments.results != RESULTS)
    command = [sys.executable, "-m", "snakemake", "--cores", arguments.cores, "--snakefile", str(SHIPPED / "Snakefile")]
    return subprocess.run([*command, *options, "--config", *settings], check=False).returncode  # noqa: S603  (the user's own run)
