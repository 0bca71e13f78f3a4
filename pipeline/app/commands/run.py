"""Run a campaign: calibrate, validate and diagnose every unit, and write the pages."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Sequence

from pipeline.app.commands import add_run_options, parser_of
from pipeline.core.errors import ConfigurationError
from pipeline.core.files import SHIPPED
from pipeline.output.outcome import DEFAULT_RESULTS

EPILOG = """\
examples:
  imu-calibration run demo
  imu-calibration run my_bench method=staged filter=rc_low_pass --cores 4 --results /data/results
  imu-calibration run my_bench --config 'unit_overrides={U1: [filter.cutoff_hz=2]}'
  imu-calibration run my_bench -- --dry-run

Snakemake runs only stages whose inputs, settings or code have changed. Options after -- are passed on to Snakemake.
"""


def main(argv: Sequence[str]) -> int:
    """Run ``imu-calibration run CAMPAIGN [OVERRIDE ...]``; return the exit code of Snakemake."""
    parser = parser_of("run", __doc__, EPILOG)
    words = "directory of a campaign (./NAME in this one), or the name of a shipped campaign: demo, published"
    parser.add_argument("campaign", metavar="CAMPAIGN", help=words)
    parser.add_argument("overrides", metavar="KEY=VALUE", nargs="*", help="settings for every unit (Hydra overrides)")
    add_run_options(parser)
    words = "move results of another campaign of the same name to replaced-<date>/, and write those of this one"
    parser.add_argument("--take-over", action="store_true", help=words)
    end = list(argv).index("--") if "--" in argv else len(argv)
    arguments = parser.parse_args(argv[:end])
    config = list(arguments.config)
    if arguments.overrides:
        if any(word.startswith("overrides=") for word in config):
            raise ConfigurationError("overrides are given twice, as KEY=VALUE and by --config; give them once")
        config.append(f"overrides={json.dumps(arguments.overrides)}")
    config += ["take_over=true"] * arguments.take_over
    return run_snakemake(arguments, config, argv[end + 1 :])


def run_snakemake(arguments: argparse.Namespace, config: Sequence[str], options: Sequence[str] = ()) -> int:
    """Run a campaign with the shipped rules; return the exit code.

    ``arguments``: ``campaign`` and the options of ``add_run_options``; ``config``: settings KEY=VALUE; ``options``: of
    Snakemake.
    """
    settings = [f"campaign={arguments.campaign}", *config]
    settings += [f"results={arguments.results}"] * (arguments.results != DEFAULT_RESULTS)
    command = [sys.executable, "-m", "snakemake", "--cores", arguments.cores, "--snakefile", str(SHIPPED / "Snakefile")]
    return subprocess.run([*command, *options, "--config", *settings], check=False).returncode  # noqa: S603  (the user's own run)
