"""Where each value of a unit's resolved configuration comes from.

A value stands in the file of a group's option or in ``configs/config.yaml``, or the strongest override of it, or of a
branch above it, has set it; a key that stands nowhere has the schema's default.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from pipeline.config.compose import GROUPS, default_option, parse, read_option
from pipeline.files import CONFIGS

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from pipeline.config.compose import Composer
    from pipeline.config.layers import Layer

NOT_SET = "not set anywhere: the default"


@dataclass(frozen=True)
class Value:
    """One value of a configuration.

    Attributes
    ----------
    key : tuple of str
        Its path.
    value
    origin : str
    """

    key: tuple[str, ...]
    value: Any
    origin: str


def trace(composer: Composer, unit: str, layers: Sequence[Layer]) -> list[Value]:
    """Return every value of a unit's configuration with its origin; a group's ``name`` tells who chose the option.

    Parameters
    ----------
    composer : Composer
    unit : str
    layers : sequence of Layer
        Weakest first.

    Raises
    ------
    Problem
        If the configuration is refused.
    """
    texts = [text for _, text in layers]
    config = composer.unit(unit, texts)
    groups, _ = composer.split(texts)
    chosen = composer.complete(groups)
    origins: dict[tuple[str, ...], str] = {}
    for group in GROUPS:
        option = chosen.get(group) or default_option(group)
        for key, value in _leaves(read_option(group, option, tuple(composer.searchpath)), (group,)):
            reference = f", {value}" if isinstance(value, str) and "${" in value else ""
            origins[key] = _file(composer, group, option) + reference
        origins[group, "name"] = _chosen_by(group, groups, chosen)
    rest = read_option("", "config", ())
    origins |= {key: "configs/config.yaml" for key, _ in _leaves(rest, ()) if key[0] != "defaults"}
    for origin, text in layers:
        name, value = parse(text)
        path = (name, "name") if name in GROUPS and isinstance(value, str) else tuple(name.split("."))
        origins = {k: o for k, o in origins.items() if k[: len(path)] != path} | {path: origin}
    return [Value(key, value, _origin(key, origins, config, composer)) for key, value in _leaves(config, ())]


def _leaves(node: dict[str, Any], above: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    for key, value in node.items():
        if isinstance(value, dict) and value:
            yield from _leaves(value, (*above, str(key)))
        else:
            yield (*above, str(key)), value


def _file(composer: Composer, group: str, option: str) -> str:
    own = any((root / group / f"{option}.yaml").is_file() for root in composer.searchpath)
    return f"{'the campaign, ' if own else ''}{CONFIGS.name}/{group}/{option}.yaml"


def _chosen_by(group: str, groups: dict[str, str], chosen: dict[str, str]) -> str:
    """Return what chooses an option where no override does."""
    procedure = chosen.get("procedure", default_option("procedure"))
    if group == "table" and group not in groups:
        return f"default of procedure {procedure}"
    if group == "method" and group not in groups:
        return f"default of table {chosen['table']} with procedure {procedure}"
    return "default, configs/config.yaml"


def _origin(
    key: tuple[str, ...], origins: dict[tuple[str, ...], str], config: dict[str, Any], composer: Composer
) -> str:
    if key == ("unit",):
        return "units.csv"
    if key[0] == "user_effects":
        return "effects of the campaign's own"
    if key[:2] == ("method", "stages"):
        return _file(composer, "method", config["method"][key[2]])
    for length in range(len(key), 0, -1):
        if key[:length] in origins:
            return origins[key[:length]]
    if key[0] == "sensor" and key[2:3] == ("effects",):
        return "limits of the campaign's own effects"
    return NOT_SET
