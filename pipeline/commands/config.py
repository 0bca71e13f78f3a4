"""Print a unit's resolved configuration with the origin of each value."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

import yaml

from pipeline.config.campaign import find_campaign
from pipeline.config.compose import Composer, Problem, nearest, parse
from pipeline.config.layers import load_layers
from pipeline.config.origins import trace
from pipeline.config.sheet import read_sheet
from pipeline.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.config.layers import Layer
    from pipeline.config.origins import Value

COLUMN = 56  # where the origins stand


def main(argv: Sequence[str]) -> int:
    """Run ``python -m pipeline config UNIT [OVERRIDE ...]``; what is printed is YAML."""
    parser = argparse.ArgumentParser(prog="python -m pipeline config", description=__doc__)
    parser.add_argument("unit", metavar="UNIT", help="a unit of units.csv")
    parser.add_argument("overrides", metavar="KEY=VALUE", nargs="*", help="as overrides= of snakemake --config")
    parser.add_argument("--campaign", default="demo", help="a campaign's name or directory (default: demo)")
    parser.add_argument("--python-effect", action="append", default=[], metavar="FILE", help="as python_effects=")
    arguments = parser.parse_args(argv)
    directory = find_campaign(arguments.campaign)
    composer = Composer(directory, arguments.python_effect)
    given = {"overrides": arguments.overrides}
    layers = load_layers(directory, given, read_sheet(directory / "units.csv"), composer.options["sensor"])
    if arguments.unit not in layers.sheet.rows:
        known = nearest(arguments.unit, layers.sheet.rows)
        raise ConfigurationError(f"no unit {arguments.unit!r}{known}", str(directory / "units.csv"))
    of_unit = layers.of(arguments.unit)
    try:
        values = trace(composer, arguments.unit, of_unit)
    except Problem as problem:
        raise ConfigurationError(f"unit {arguments.unit}: {problem}", str(directory / "units.csv")) from None
    print(f"# Unit {arguments.unit} of campaign {directory}")
    print("\n".join([*_told(of_unit), *_tree(values)]))
    return 0


def _told(layers: Sequence[Layer]) -> list[str]:
    """Return the overrides of the unit, and which of them come to nothing."""
    if not layers:
        return ["# No overrides: all values are defaults."]
    keys = [parse(text)[0] for _, text in layers]
    width = max(len(origin) for origin, _ in layers)
    lines = ["# Its overrides, weakest first:"]
    for i, (origin, text) in enumerate(layers):
        weaker = "   (a stronger one stands below)" if keys[i] in keys[i + 1 :] else ""
        lines.append(f"#   {origin:<{width}}  {text}{weaker}")
    return lines


def _tree(values: Sequence[Value]) -> list[str]:
    """Return the values as YAML, each with its origin as a comment."""
    lines: list[str] = []
    above: tuple[str, ...] = ()
    for value in values:
        *branch, leaf = value.key
        same = 0
        while same < min(len(branch), len(above)) and branch[same] == above[same]:
            same += 1
        lines += [f"{'  ' * depth}{branch[depth]}:" for depth in range(same, len(branch))]
        above = tuple(branch)
        said = f"{'  ' * len(branch)}{leaf}: {_written(value.value)}"
        lines.append(f"{said:<{COLUMN}} # {value.origin}")
    return lines


def _written(value: Any) -> str:  # noqa: ANN401  (any value of a configuration)
    text: str = yaml.safe_dump(value, default_flow_style=True, width=10_000, sort_keys=False)
    return text.removesuffix("\n").removesuffix("\n...")
