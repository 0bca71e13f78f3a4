"""Read YAML files of users within limits of time and memory.

An alias (``*name``) repeats everything in its anchor, so that a few lines of nested aliases can represent 10^9 values.
Before any value is built, the events of the parser are counted:

    size = number of scalars, lists and mappings, each alias counted with the size of its anchor

Numbers, dates and repeated keys are read as Hydra reads them: ``1e-3`` is a number, a date stays a text, a repeated key
is refused.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml

from imu_logs.errors import ConfigurationError
from imu_logs.files import read_text

# A simulation.yaml with 10,000 units of 30 values each, which the largest fleet needs, stays below.
MAX_YAML_BYTES, MAX_YAML_VALUES, MAX_DEPTH = 10_000_000, 400_000, 50
FLOAT = re.compile(  # that of OmegaConf, which reads 1e3 as a number where YAML 1.1 has a text
    r"""^(?:
     [-+]?[0-9]+(?:_[0-9]+)*\.[0-9_]*(?:[eE][-+]?[0-9]+)?
    |[-+]?[0-9]+(?:_[0-9]+)*(?:[eE][-+]?[0-9]+)
    |\.[0-9]+(?:_[0-9]+)*(?:[eE][-+][0-9]+)?
    |[-+]?[0-9]+(?:_[0-9]+)*(?::[0-5]?[0-9])+\.[0-9_]*
    |[-+]?\.(?:inf|Inf|INF)
    |\.(?:nan|NaN|NAN))$""",
    re.VERBOSE,
)
NOT_AS_YAML = ("tag:yaml.org,2002:float", "tag:yaml.org,2002:timestamp")

_Base: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Loader(_Base):  # type: ignore[misc]
    """A safe loader that reads scalars as Hydra does, and refuses repeated keys."""

    yaml_implicit_resolvers = {  # noqa: RUF012  (PyYAML's own attribute)
        first: [(tag, how) for tag, how in resolvers if tag not in NOT_AS_YAML]
        for first, resolvers in _Base.yaml_implicit_resolvers.items()
    }

    def construct_mapping(self, node: yaml.Node, deep: bool = False) -> Any:  # noqa: ANN401, FBT001, FBT002
        """Build a mapping."""
        seen = set()
        for key, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            if key.tag != "tag:yaml.org,2002:merge" and key.value in seen:
                raise yaml.constructor.ConstructorError(None, None, f"{key.value!r} stands twice", key.start_mark)
            seen.add(key.value if isinstance(key.value, str) else id(key))
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver("tag:yaml.org,2002:float", FLOAT, list("-+0123456789."))


def read_yaml(path: Path, largest: int = MAX_YAML_VALUES) -> Any:  # noqa: ANN401  (whatever the file holds)
    """Read a YAML file of plain values, of at most the size ``largest``.

    Raises ``ConfigurationError`` if it is no regular file, cannot be read, is no YAML, or exceeds the limits.
    """
    return load_yaml(read_text(path, MAX_YAML_BYTES, "settings"), str(path), largest)


def load_yaml(text: str, where: str, largest: int = MAX_YAML_VALUES) -> Any:  # noqa: ANN401
    """Parse a YAML text; errors as of ``read_yaml``."""
    try:
        _check_size(yaml.parse(text, Loader=_Loader), where, largest)
        return yaml.load(text, _Loader)  # noqa: S506  (a safe loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = f"{where}:{mark.line + 1}" if mark else where
        reason = getattr(error, "problem", None) or " ".join(str(error).split())
        raise ConfigurationError(f"is not YAML: {reason}", place) from None
    except (ValueError, TypeError, RecursionError) as error:
        raise ConfigurationError(f"holds a value that cannot be read: {error}", where) from None


def _check_size(events: Iterable[yaml.Event], where: str, largest: int) -> None:
    """Raise ``ConfigurationError`` for aliases of too many values or within their anchor, and for too deep nesting."""
    known: dict[str, tuple[int, int]] = {}  # size and depth of each anchor that is complete
    above: list[tuple[str | None, int, int]] = []  # anchor, size before it, and depth of its siblings
    size = deepest = 0
    for event in events:
        line = event.start_mark.line + 1 if event.start_mark else 1
        added, depth = 0, 0
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in known:
                raise ConfigurationError(f"the alias *{event.anchor} has no anchor before it", f"{where}:{line}")
            added, depth = known[event.anchor]
        elif isinstance(event, yaml.ScalarEvent):
            added = 1
            if event.anchor:
                known[event.anchor] = (1, 0)
        elif isinstance(event, yaml.CollectionStartEvent):
            above.append((event.anchor, size, deepest))
            known.pop(event.anchor or "", None)
            added, deepest = 1, 0
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before, others = above.pop()
            if anchor:
                known[anchor] = (size - before, deepest + 1)
            depth, deepest = deepest + 1, others
        size, deepest = size + added, max(deepest, depth)
        _check_limits(size, largest, len(above) + deepest, f"{where}:{line}")


def _check_limits(size: int, largest: int, depth: int, place: str) -> None:
    if size > largest:
        raise ConfigurationError(
            f"holds more than {largest} values, each alias (*) counted with all that it stands for; use fewer aliases",
            place,
        )
    if depth > MAX_DEPTH:
        raise ConfigurationError(f"is nested more than {MAX_DEPTH} deep", place)
