"""The catalogue of physical effects: every module of this package that defines one is part of it.

There is no list to extend: ``catalogue()`` finds the modules on disk.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.errors import ConfigurationError

if TYPE_CHECKING:
    from pipeline.model.effects.base import Effect


@cache
def catalogue() -> dict[str, Effect]:
    """Return every built-in effect by name, in alphabetical order."""
    found: dict[str, Effect] = {}
    for file in sorted(Path(__file__).parent.glob("*.py")):
        if file.stem not in ("__init__", "base"):
            found[file.stem] = import_module(f"{__name__}.{file.stem}").EFFECT
    return found


def effect(name: str) -> Effect:
    """Return one effect by name.

    Raises
    ------
    ConfigurationError
        If there is none of that name.
    """
    try:
        return catalogue()[name]
    except KeyError:
        raise ConfigurationError(f"no effect is called {name!r}; known: {', '.join(catalogue())}") from None
