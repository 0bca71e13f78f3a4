"""Print the resolved configuration of a unit with the origin of each value.

The origin of a value is its strongest override, or that of a branch above it; else the file of an option or
``configs/config.yaml``; else the default of the schema.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import takewhile
from typing import Any

import yaml

from pipeline.app.commands import parser_of
from pipeline.app.config.campaign import find_campaign, read_layers, require_unit
from pipeline.app.config.compose import Composer
from pipeline.app.config.layers import Layer
from pipeline.app.config.options import GROUPS, PYTHON, default_option, parse, read_option
from pipeline.core.errors import ConfigurationError
from pipeline.core.files import CONFIGS
from pipeline.core.settings import REQUIRED_FIGURES, range_settings

Key = tuple[str, ...]  # the path of a value
COLUMN = 56  # of the origins


def main(argv: Sequence[str]) -> int:
    """Run ``python -m pipeline config UNIT [OVERRIDE ...]``; the output is YAML."""
    parser = parser_of("config", __doc__)
    parser.add_argument("unit", metavar="UNIT", help="a unit of units.csv")
    parser.add_argument("overrides", metavar="KEY=VALUE", nargs="*", help="further settings, as in a run")
    parser.add_argument("--campaign", default="demo", help="a campaign's name or directory (default: demo)")
    parser.add_argument(
        "--python-effect", action="append", default=[], metavar="FILE", help="file of an effect in Python, as in a run"
    )
    arguments = parser.parse_intermixed_args(argv)
    directory, unit = find_campaign(arguments.campaign), arguments.unit
    composer, all_layers = read_layers(directory, {"overrides": arguments.overrides, PYTHON: arguments.python_effect})
    require_unit(unit, all_layers.units_table.rows, directory)
    layers = all_layers.of(unit)
    try:
        config = composer.unit(unit, [text for _, text in layers])
    except ConfigurationError as problem:
        raise ConfigurationError(f"unit {unit}: {problem}", str(directory / "units.csv")) from None
    print(f"# Unit {unit} of campaign {directory}")
    print("\n".join([*_overrides(layers), *_tree(config.configuration, _origins(composer, layers), composer)]))
    return 0


def _overrides(layers: Sequence[Layer]) -> list[str]:
    """Return lines with the overrides of the unit; a note marks those that a stronger override replaces."""
    if not layers:
        return ["# No overrides: all values are defaults."]
    keys = [parse(text)[0] for _, text in layers]
    width = max(len(origin) for origin, _ in layers)
    lines = ["# Its overrides, weakest first:"]
    for i, (origin, text) in enumerate(layers):
        weaker = "   (a stronger one stands below)" if keys[i] in keys[i + 1 :] else ""
        lines.append(f"#   {origin:<{width}}  {text}{weaker}")
    return lines


def _tree(config: Mapping[str, Any], origins: Mapping[Key, str], composer: Composer) -> list[str]:
    """Return the values as YAML, each with its origin as a comment."""
    lines: list[str] = []
    above: Key = ()
    for key, value in _leaves(config, ()):
        *branch, leaf = key
        same = sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], zip(branch, above, strict=False)))
        lines += [f"{'  ' * depth}{branch[depth]}:" for depth in range(same, len(branch))]
        above = tuple(branch)
        text: str = yaml.safe_dump(value, default_flow_style=True, width=10_000, sort_keys=False)
        line = f"{'  ' * len(branch)}{leaf}: {text.removesuffix(chr(10)).removesuffix(chr(10) + '...')}"
        lines.append(f"{line:<{COLUMN}} # {_origin(key, origins, config, composer)}")
    return lines


def _leaves(node: Mapping[str, Any], above: Key) -> Iterator[tuple[Key, Any]]:
    for key, value in node.items():
        if isinstance(value, dict) and value:
            yield from _leaves(value, (*above, str(key)))
        else:
            yield (*above, str(key)), value


def _origins(composer: Composer, layers: Sequence[Layer]) -> dict[Key, str]:
    """Return the origin of each key, or of a branch above it; the origin of an option has the key (group, "name")."""
    groups, _ = composer.split([text for _, text in layers])
    options = composer.complete(groups)
    procedure = options.get("procedure", default_option("procedure"))
    defaults_of = {
        "table": f"default of procedure {procedure}",
        "method": f"default of table {options['table']} with procedure {procedure}",
    }
    origins: dict[Key, str] = {}
    for group in GROUPS:
        option = options.get(group) or default_option(group)
        for key, value in _leaves(read_option(group, option, tuple(composer.searchpath)), (group,)):
            reference = f", {value}" if isinstance(value, str) and "${" in value else ""
            assumed = group == "sensor" and value is None and key[-1] in REQUIRED_FIGURES
            origins[key] = _file(composer, group, "generic" if assumed else option) + reference
        origins[group, "name"] = defaults_of.get(group, "default, configs/config.yaml")
    defaults = read_option("", "config", ())
    origins |= {key: "configs/config.yaml" for key, _ in _leaves(defaults, ()) if key[0] != "defaults"}
    sensor = read_option("sensor", options.get("sensor") or default_option("sensor"), tuple(composer.searchpath))
    for origin, text in layers:
        for name, value in range_settings(*parse(text), sensor):
            path = (name, "name") if name in GROUPS and isinstance(value, str) else tuple(name.split("."))
            origins = {k: o for k, o in origins.items() if k[: len(path)] != path} | {path: origin}
    return origins


def _file(composer: Composer, group: str, option: str) -> str:
    of_campaign = any((root / group / f"{option}.yaml").is_file() for root in composer.searchpath)
    return f"{'the campaign, ' if of_campaign else ''}{CONFIGS.name}/{group}/{option}.yaml"


def _origin(key: Key, origins: Mapping[Key, str], config: Mapping[str, Any], composer: Composer) -> str:
    if key == ("unit",):
        return "units.csv"
    if key[0] == "user_effects":
        return "effects of the campaign's own"
    if key[:2] == ("method", "stages"):
        return _file(composer, "method", config["method"][key[2]])
    origin = next((origins[key[:length]] for length in range(len(key), 0, -1) if key[:length] in origins), None)
    if origin is None and key[0] == "sensor" and key[2:3] == ("effects",):
        return "limits of the campaign's own effects"
    return origin or "not set anywhere: the default"
