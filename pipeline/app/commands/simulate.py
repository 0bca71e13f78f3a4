"""Write a campaign of simulated units with hidden physical effects."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from itertools import count
from pathlib import Path
from typing import Any

import yaml

from pipeline.app.commands import parser_of
from pipeline.app.plan import not_shown
from pipeline.app.results_folder import new_simulated, publish_simulated
from pipeline.app.run_progress import Countdown
from pipeline.core.errors import ConfigurationError
from pipeline.core.settings import assumed_figures
from pipeline.output.outcome import run_command
from pipeline.physics.effects import read_effect_files, register
from pipeline.simulation.campaign import write_campaign
from pipeline.simulation.description import (
    FORMATS,
    add_recording_options,
    described,
    description_from,
    read_description,
    shipped_settings,
)

DESCRIPTION_FILE = "simulation.yaml"
EPILOG = """\
The campaign follows from a description: DIR/simulation.yaml or --from FILE. With options, or without a description, it
follows from the options, and the command writes their description to DIR/simulation.yaml.

examples:
  python -m pipeline simulate data/fleet --units 100 --samples 10000 --seed 1
  python -m pipeline simulate /tmp/hidden --effect gyroscope.g_sensitivity --effect accelerometer.lever_arm=0.05,0,0.02
  python -m pipeline simulate /tmp/table --effect table_tilt=0.2 --both-directions --rate 20 60 100
  python -m pipeline simulate data/demo

An effect is hidden in one sensor (accelerometer.NAME) or in both (NAME). Without a size, each parameter is half of its
limit in the sensor file (or typical_share of the effect) times 0.7 to 1.3, with random signs. One number is the size of
every parameter, with random signs; several numbers are the values of the parameters. A warning names each effect that
the procedure cannot show, whatever its size (python -m pipeline plan); the campaign is written all the same.
NAME may be an effect of your own, DIR/effects/NAME.yaml (docs/effects_of_your_own.md).
In simulation.yaml a unit may also have a formula that is no effect of the campaign, to test the diagnosis:
  effects: {gyroscope.gear_mesh: {terms: {A: {formula: "cos(5 * radians(angle))", unit: deg/s}}, values: 0.03}}
The truth is written to DIR/truth/<unit>.json.
"""


def main(argv: Sequence[str]) -> int:
    """Run ``python -m pipeline simulate DIR``."""
    arguments = vars(_parser().parse_args(argv))
    directory: Path = arguments.pop("directory")
    source: Path | None = arguments.pop("source")
    quiet: bool = arguments.pop("quiet")
    sheet_only: bool = arguments.pop("sheet_only")
    replace: bool = arguments.pop("replace")
    if source is None and not arguments and (directory / DESCRIPTION_FILE).is_file():
        source = directory / DESCRIPTION_FILE
    if source is not None and arguments:
        given = ", ".join(f"--{name.replace('_', '-')}" for name in arguments)
        raise ConfigurationError(f"--from takes everything from the description; leave out {given} or --from")
    if source is not None:
        description = read_description(source)
    else:
        data = _described(argparse.Namespace(**arguments))
        description = description_from(data, "the options")
        directory.mkdir(parents=True, exist_ok=True)
        text = "# Read by: python -m pipeline simulate\n" + yaml.safe_dump(data, sort_keys=False)
        (directory / DESCRIPTION_FILE).write_text(text, encoding="utf-8")
    directory.mkdir(parents=True, exist_ok=True)
    folder = directory if source is None else source.parent
    for effect in read_effect_files(sorted((folder / "effects").glob("*.yaml"))).values():
        register(effect)
    total = len(description.units)
    countdown, done = Countdown(total), count(1)

    def print_unit(text: str) -> None:
        number = next(done)
        left = countdown.left(number)
        print(f"{text} ({number} of {total}{', ' * bool(left)}{left})", flush=True)

    for sensor in sorted({unit.sensor for unit in description.units}):
        assumed = assumed_figures(shipped_settings(sensor=sensor).sensor)
        print(f"note: {assumed}\n" if assumed else "", end="")
    hidden = [text.partition("=")[0] for text in arguments.get("effect", ())]
    for key, reason in (not_shown(description.units[0], hidden) if hidden else {}).items():
        print(f"warning: the recordings cannot show {key}: {reason}", file=sys.stderr)
    target = new_simulated(directory) if replace else directory
    write_campaign(description, target, (lambda _: None) if quiet else print_unit, sheet_only=sheet_only)
    if replace:
        publish_simulated(directory)
    print(f"then: {run_command({'campaign': str(directory)})}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = parser_of("simulate", __doc__, EPILOG, argument_default=argparse.SUPPRESS)
    add = parser.add_argument
    add("directory", type=Path, metavar="DIR", help="directory of the campaign; it is created if it does not exist")
    add("--from", dest="source", type=Path, default=None, metavar="FILE", help="description of the simulation (YAML)")
    add("--quiet", action="store_true", default=False, help="print no line for each unit")
    add("--sheet-only", action="store_true", default=False, help="write only units.csv; the run writes the recordings")
    # DIR is the folder ``simulated`` of results, and is replaced as a whole; files that no run wrote are kept.
    add("--replace", action="store_true", default=False, help=argparse.SUPPRESS)
    add("--units", type=int, metavar="N", help="number of units (default: 1)")
    add("--prefix", metavar="NAME", help="names of the units: NAME001, NAME002 ... (default: U)")
    add("--seed", type=int, help="seed of all random numbers (default: 0)")
    add("--format", choices=FORMATS, help="format of the recordings (default: csv)")
    add("--effect", action="append", metavar="[SENSOR.]NAME[=SIZE]", help="hide an effect; may be repeated")
    add_recording_options(parser)
    return parser


def _described(arguments: argparse.Namespace) -> dict[str, Any]:
    effects = dict(_effect(text) for text in getattr(arguments, "effect", ()))
    count, prefix = getattr(arguments, "units", 1), getattr(arguments, "prefix", "U")
    unit = {"unit": prefix if count > 1 else f"{prefix}001", "count": count, **described(vars(arguments))}
    if "format" in arguments:
        unit["format"] = arguments.format
    if effects:
        unit["effects"] = effects
    return {"seed": getattr(arguments, "seed", 0), "units": [unit]}


def _effect(text: str) -> tuple[str, Any]:
    """Split ``name``, ``name=0.1`` or ``name=0.1,0.2,0.3`` into name and size of an effect."""
    name, given, size = text.partition("=")
    if not given:
        return name, None
    try:
        values = [float(v) for v in size.split(",")]
    except ValueError:
        raise ConfigurationError(f"--effect {text}: after = a number, or several with commas, is expected") from None
    return name, values[0] if len(values) == 1 else values
