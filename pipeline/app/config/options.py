r"""Read the options of Hydra groups, parse overrides, and resolve references.

A reference ``${group.key}`` in a value stands for the value of that setting, and ``\${`` for the characters ``${``.
OmegaConf does not resolve them: its resolvers, such as ``${oc.env:NAME}``, would write environment variables of the
user into the pages of a campaign, and it takes 64 ms to build a configuration. A reference names a value or a list of
values that is not a reference itself, so the time is proportional to the size of a file.
"""

from __future__ import annotations

import difflib
import re
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Any

from imu_logs.yaml_file import read_yaml
from pipeline.core.errors import ConfigurationError
from pipeline.core.files import CONFIGS
from pipeline.core.settings import RunSettings

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

GROUPS = ("sensor", "table", "procedure", "method", "filter", "ingest", "certificate")
RUN_SETTINGS = tuple(RunSettings.model_fields)
LARGEST_CONFIG = 10_000  # values of an option; the largest in configs/ has 160
NUMBER_OVERRIDE = re.compile(r"([a-z_][a-z_0-9]*(?:\.[A-Za-z_][A-Za-z_0-9]*)*)=(-?(?:0|[1-9][0-9]*)(\.[0-9]+)?)")
WORD_OVERRIDE = re.compile(
    r"([a-z_][a-z_0-9]*(?:\.[A-Za-z_][A-Za-z_0-9]*)*)=([A-Za-z_][A-Za-z_0-9./-]*)"
)  # a text or a path
NOT_TEXTS = ("null", "true", "false", "nan", "inf")
REFERENCE_TOKEN = re.compile(r"(\\\$\{)|\$\{\s*([A-Za-z_]\w*(?:\.\w+)+)\s*\}|\$\{")
MAX_REFERENCE_LENGTH = 10_000  # characters of a value with references, such as a name or a unit
REFERENCE_FORM = "a reference is ${group.key}, for example ${sensor.accelerometer.counts_per_unit}"


class SettingProblem(Exception):  # noqa: N818  (problems are collected, then raised as one ConfigurationError)
    """One error in a configuration."""


def nearest(name: str, known: Iterable[str]) -> str:
    """Return a hint with the nearest valid name, and with all valid names if they are at most 12."""
    known = sorted(known)
    close = difflib.get_close_matches(name, known, 1, 0.5)
    hint = f"; nearest: {close[0]}" if close else ""
    return f"{hint}; valid: {', '.join(known)}" if len(known) <= 12 else hint


@lru_cache(maxsize=100_000)
def parse(text: str) -> tuple[str, Any]:
    """Parse one Hydra override to its key and value.

    A plain number, word or path, the usual override of a single unit, is read without Hydra's parser, which takes
    0.6 ms, and 0.1 s at first. Raises ``SettingProblem`` if the text is not an override, or is a sweep or a deletion.
    """
    number, words = NUMBER_OVERRIDE.fullmatch(text), WORD_OVERRIDE.fullmatch(text)
    if number:
        key, value, fraction = number.groups()
        return key, float(value) if fraction else int(value)
    if words and words[2].lower() not in NOT_TEXTS:
        return words[1], words[2]
    from hydra.errors import HydraException, OverrideParseException  # noqa: PLC0415  (where it is needed)

    hint = "; write KEY=VALUE, for example filter.cutoff_hz=5"
    if text.startswith("["):
        raise SettingProblem(f'{text!r} is not a list of overrides; quote each one: \'overrides=["a=1","b=[x,y]"]\'')
    try:
        override = _hydras_parser().parse_override(text)
    except (OverrideParseException, HydraException) as error:
        raise SettingProblem(f"{text!r} is not a Hydra override ({str(error).splitlines()[0]}){hint}") from error
    if override.is_sweep_override() or override.is_delete():
        raise SettingProblem(
            f"{text!r} is a {'sweep' if override.is_sweep_override() else 'deletion'}; give one value{hint}"
        )
    return override.key_or_group, override.value()


@cache
def _hydras_parser() -> Any:  # noqa: ANN401  (hydra's types need its import)
    from hydra.core.override_parser.overrides_parser import OverridesParser  # noqa: PLC0415  (as above)

    return OverridesParser.create()


@cache
def read_option(group: str, option: str, searchpath: tuple[Path, ...], *_: object) -> dict[str, Any]:
    """Return the content of the file of an option; ``{}`` if the file does not exist.

    The other arguments are those that change with the files in these folders.
    """
    for root in (*searchpath, CONFIGS):
        file = root / group / f"{option}.yaml"
        if file.is_file():
            return {str(k): v for k, v in mapping_of(file).items()}
    return {}


def mapping_of(file: Path) -> dict[Any, Any]:
    """Read the file of an option; raises ``ConfigurationError`` if it is not a mapping or contains a resolver."""
    content = read_yaml(file, LARGEST_CONFIG)
    if not isinstance(content, dict):
        raise ConfigurationError("a mapping of settings is expected", str(file))
    check_references(content, str(file))
    return content


@cache
def default_option(group: str) -> str:
    """Return the default option of a group."""
    for entry in mapping_of(CONFIGS / "config.yaml")["defaults"]:
        if not isinstance(entry, str) and group in entry:
            return str(entry[group])
    raise KeyError(group)


def check_references(value: Any, where: str | None = None) -> None:  # noqa: ANN401  (any YAML value)
    """Raise ``ConfigurationError`` if a value contains ``${...}`` with more than the name of a setting."""
    if isinstance(value, dict):
        for key, below in value.items():
            check_references(key, where)
            check_references(below, where)
    elif isinstance(value, list):
        for below in value:
            check_references(below, where)
    elif isinstance(value, str) and any(not escaped and not name for escaped, name in REFERENCE_TOKEN.findall(value)):
        raise ConfigurationError(
            f"{value[:200]!r}: {REFERENCE_FORM}; resolvers such as ${{oc.env:NAME}} are not read", where
        )


def with_references(node: Any, root: dict[str, Any]) -> Any:  # noqa: ANN401  (dict, list or value)
    """Return a copy of a node in which the value from the tree ``root`` replaces each reference.

    Raises ``ConfigurationError`` if a reference names no setting, a group of settings, or another reference.
    """
    if isinstance(node, dict):
        return {with_references(key, root): with_references(below, root) for key, below in node.items()}
    if isinstance(node, list):
        return [with_references(below, root) for below in node]
    if not isinstance(node, str) or "${" not in node:
        return node
    check_references(node)
    whole = REFERENCE_TOKEN.fullmatch(node)
    if whole and whole.group(2):
        return _value_of(whole.group(2), root, node)
    text, end = "", 0
    for token in REFERENCE_TOKEN.finditer(node):
        value = None if token.group(1) else _value_of(token.group(2), root, node)
        if not token.group(1) and value is None:
            raise ConfigurationError(f"{node[:200]!r}: {token.group(2)} is null; set it")
        text += node[end : token.start()] + ("${" if token.group(1) else str(value))
        end = token.end()
        if len(text) > MAX_REFERENCE_LENGTH:
            raise ConfigurationError(
                f"{node[:200]!r}: has more than {MAX_REFERENCE_LENGTH} characters with its references"
            )
    return text + node[end:]


def _value_of(name: str, root: dict[str, Any], text: str) -> Any:  # noqa: ANN401
    value: Any = root
    for key in name.split("."):
        if not isinstance(value, dict) or key not in value:
            raise ConfigurationError(f"{text[:200]!r}: no setting is called {name}")
        value = value[key]
    values = value if isinstance(value, list) else [value]
    if any(isinstance(v, (dict, list)) or (isinstance(v, str) and "${" in v) for v in values):
        raise ConfigurationError(f"{text[:200]!r}: {name} is a group of settings or a reference; name one value")
    return value
