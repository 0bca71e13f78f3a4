r"""References between settings: ``${group.key}`` in a value stands for the value of the setting of that name.

Nothing else is read within the braces. OmegaConf's resolvers, such as ``${oc.env:NAME}``, would put the environment of
whoever runs a campaign into its pages. A reference names a value or a list of values, and none that is a reference
itself: so what a file costs grows with its size. ``\${`` stands for the characters ``${``.
"""

from __future__ import annotations

import re
from typing import Any

from pipeline.errors import ConfigurationError

TOKEN = re.compile(r"(\\\$\{)|\$\{\s*([A-Za-z_]\w*(?:\.\w+)+)\s*\}|\$\{")
LONGEST = 10_000  # characters of a value with references; names and units are meant
FORM = "a reference is ${group.key}, for example ${sensor.accelerometer.counts_per_unit}"


def check_references(value: Any, where: str | None = None) -> None:  # noqa: ANN401  (any YAML value)
    """Refuse ``${...}`` that is more than the name of a setting, anywhere below a value.

    Raises
    ------
    ConfigurationError
        Naming the text.
    """
    if isinstance(value, dict):
        for key, below in value.items():
            check_references(key, where)
            check_references(below, where)
    elif isinstance(value, list):
        for below in value:
            check_references(below, where)
    elif isinstance(value, str) and any(not escaped and not name for escaped, name in TOKEN.findall(value)):
        raise ConfigurationError(f"{value[:200]!r}: {FORM}; resolvers such as ${{oc.env:NAME}} are not read", where)


def with_references(node: Any, root: dict[str, Any]) -> Any:  # noqa: ANN401  (dict, list or value)
    """Return a copy of a node in which each reference is replaced by what it names in the tree ``root``.

    Raises
    ------
    ConfigurationError
        If a reference names no setting, a group of settings, or a setting that is a reference too.
    """
    if isinstance(node, dict):
        return {key: with_references(below, root) for key, below in node.items()}
    if isinstance(node, list):
        return [with_references(below, root) for below in node]
    if not isinstance(node, str) or "${" not in node:
        return node
    check_references(node)
    whole = TOKEN.fullmatch(node)
    if whole and whole.group(2):
        return _named(whole.group(2), root, node)
    text, end = "", 0
    for token in TOKEN.finditer(node):
        text += node[end : token.start()] + ("${" if token.group(1) else str(_named(token.group(2), root, node)))
        end = token.end()
        if len(text) > LONGEST:
            raise ConfigurationError(f"{node[:200]!r}: has more than {LONGEST} characters with its references")
    return text + node[end:]


def _named(name: str, root: dict[str, Any], text: str) -> Any:  # noqa: ANN401
    found: Any = root
    for key in name.split("."):
        if not isinstance(found, dict) or key not in found:
            raise ConfigurationError(f"{text[:200]!r}: no setting is called {name}")
        found = found[key]
    values = found if isinstance(found, list) else [found]
    if any(isinstance(v, (dict, list)) or (isinstance(v, str) and "${" in v) for v in values):
        raise ConfigurationError(f"{text[:200]!r}: {name} is a group of settings or a reference; name one value")
    return found
