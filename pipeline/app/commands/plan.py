"""Predict which effects a procedure could find, before it is recorded."""

from __future__ import annotations

import argparse
import json
import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from textwrap import wrap
from typing import Any

from pipeline.app.commands import parser_of
from pipeline.app.plan import WIDTH, PlanGain, best_changes, helps_most, plan_of, plan_text
from pipeline.core.errors import ConfigurationError
from pipeline.physics.effects import read_effect_files, register
from pipeline.simulation.description import UnitDescription, add_recording_options, described, read_description

DESCRIPTION_FILE = "simulation.yaml"
EPILOG = """\
For each effect the plan states the smallest size that the diagnosis would find in half of the units, at the noise of
the sensor file; this size as a share of the limit in the sensor file; effects with a similar signal; and the size up
to which one of these would be named instead.

examples:
  python -m pipeline plan
  python -m pipeline plan --sensor stim300 --step 10 --dwell 2 --rate 20 60 100
  python -m pipeline plan --rate 60 --against "--both-directions"
  python -m pipeline plan --campaign data/demo --unit mpu6050-1
"""


def main(argv: Sequence[str]) -> int:
    """Run ``python -m pipeline plan``."""
    arguments = _parser().parse_args(_joined(argv))
    campaign: Path | None = arguments.campaign
    of_campaign = sorted((campaign / "effects").glob("*.yaml")) if campaign is not None else []
    for effect in read_effect_files([*of_campaign, *arguments.effects]).values():
        register(effect)
    first = unit_of(arguments, _described_unit(arguments))
    document = plan_of(first)
    second = plan_of(_other(arguments.against, arguments, first)) if arguments.against is not None else None
    gains = [] if second is not None or not arguments.extra else best_changes(first, document)
    if arguments.json:
        more = {"against": second} if second is not None else {"extra": [_of_gain(gain) for gain in gains]}
        print(json.dumps({**document, **more}, indent=1))
        return 0
    indent = " " * 5  # that of the second line of a proposal
    helps = [part for line in helps_most(gains) for part in wrap(line, WIDTH, subsequent_indent=indent) or [line]]
    print("\n".join([*plan_text(document, second), *(["", *helps] if helps else [])]))
    return 0


def _joined(argv: Sequence[str]) -> list[str]:
    """Join ``--against`` and its value by ``=``, because argparse refuses a separate value with a leading dash."""
    words: list[str] = []
    for argument in argv:
        if words and words[-1] == "--against":
            words[-1] = f"--against={argument}"
        else:
            words.append(argument)
    return words


def _parser() -> argparse.ArgumentParser:
    parser = parser_of("plan", __doc__, EPILOG, argument_default=argparse.SUPPRESS)
    add = parser.add_argument
    words = "take sensor, table and procedure from the description of a simulation"
    add("--from", dest="source", type=Path, default=None, metavar="FILE", help=words)
    add("--campaign", type=Path, default=None, metavar="DIR", help=f"likewise, by DIR/{DESCRIPTION_FILE}")
    add("--unit", default=None, metavar="NAME", help="a unit of the description (default: the first)")
    add("--effect", dest="effects", action="append", type=Path, default=[], metavar="FILE",
        help="an effect of your own (YAML); those of the campaign are always included")  # fmt: skip
    words = "compare with a second procedure: the options in which it differs, in quotes"
    add("--against", default=None, metavar="OPTIONS", help=words)
    add("--json", action="store_true", default=False, help="print the plan as JSON")
    add("--no-extra", dest="extra", action="store_false", default=True, help="do not propose additional recordings")
    add_recording_options(parser)
    return parser


def unit_of(arguments: argparse.Namespace, base: UnitDescription | None) -> UnitDescription:
    """Return the unit to plan: a description, if there is one, in which the options replace values."""
    options = described(vars(arguments))
    if base is None:
        return UnitDescription(unit="plan", **options)
    if "table" not in arguments and "procedure" not in arguments:
        del options["table"]
    course = {**base.course, **options.pop("course", {})}
    return replace(base, **options, course=course)


def _described_unit(arguments: argparse.Namespace) -> UnitDescription | None:
    """Return the unit of the description that the options name; None without a description."""
    source, campaign, name = arguments.source, arguments.campaign, arguments.unit
    if source is not None and campaign is not None:
        raise ConfigurationError("--from and --campaign both name a description; give one of them")
    if campaign is not None:
        source = campaign / DESCRIPTION_FILE
        if campaign.is_dir() and not source.is_file():
            problem = f"this campaign has no {DESCRIPTION_FILE}, so its procedure is unknown; give its sensor, table"
            raise ConfigurationError(f"{problem}, procedure and course as options", str(campaign))
    if source is None:
        if name is not None:
            raise ConfigurationError("--unit chooses a unit of a description; give one by --from or --campaign")
        return None
    units = {unit.unit: unit for unit in read_description(source).units}
    if name is not None and name not in units:
        raise ConfigurationError(f"no unit is called {name!r}; known: {', '.join(units)}", str(source))
    return units[name] if name is not None else next(iter(units.values()))


def _other(options: str, arguments: argparse.Namespace, first: UnitDescription) -> UnitDescription:
    """Return the second procedure: the first with changed options."""
    parser = argparse.ArgumentParser(prog="--against", argument_default=argparse.SUPPRESS, exit_on_error=False)
    add_recording_options(parser)
    try:
        given, unknown = parser.parse_known_args(shlex.split(options))
    except (argparse.ArgumentError, ValueError) as error:
        raise ConfigurationError(f"--against {options!r}: {error}") from None
    if unknown:
        raise ConfigurationError(f"--against {options!r}: {' '.join(unknown)} is not known; see plan --help")
    kept = {"table": first.table} if "table" in arguments and "procedure" not in given else {}
    return unit_of(argparse.Namespace(**{**kept, **vars(given)}), first)


def _of_gain(gain: PlanGain) -> dict[str, Any]:
    found = {"what": gain.change.what, "options": gain.change.options, "minutes": gain.minutes}
    return found | {"shows": list(gain.shown), "tells_apart": list(gain.distinguished), "size_factor": gain.factor}
