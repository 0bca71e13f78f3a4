"""The catalogue of physical effects: every module of this package that defines one is part of it.

There is no list to extend: ``catalogue()`` finds the modules on disk. Effects of a user's own are registered beside
them (``pipeline.model.user_effects`` makes them from formulas); they are known to this process alone.
"""

from __future__ import annotations

from contextlib import contextmanager
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from pipeline.model.effects.base import Effect

_registered: dict[str, Effect] = {}
_left_out: set[str] = set()


@cache
def built_in() -> dict[str, Effect]:
    """Return every built-in effect by name, in alphabetical order."""
    found: dict[str, Effect] = {}
    for file in sorted(Path(__file__).parent.glob("*.py")):
        if file.stem not in ("__init__", "base"):
            found[file.stem] = import_module(f"{__name__}.{file.stem}").EFFECT
    return found


def catalogue() -> dict[str, Effect]:
    """Return every effect by name: the built-in ones in alphabetical order, then the registered ones."""
    every = {**built_in(), **_registered}
    return {name: this for name, this in every.items() if name not in _left_out} if _left_out else every


@contextmanager
def leaving_out(names: Iterable[str]) -> Iterator[None]:
    """Take effects out of the catalogue for a while, as if nobody knew of them; for studies of the diagnosis."""
    fresh = set(names) - _left_out
    _left_out.update(fresh)
    try:
        yield
    finally:
        _left_out.difference_update(fresh)


def register(effect: Effect) -> None:
    """Add an effect of the user's own to the catalogue of this process; one of the same name is replaced.

    Raises
    ------
    ConfigurationError
        If a built-in effect has that name.
    """
    if effect.name in built_in():
        raise ConfigurationError(f"effect {effect.name}: a built-in effect is called so; give yours another name")
    _registered[effect.name] = effect


def forget(name: str) -> None:
    """Take one registered effect out of the catalogue again."""
    _registered.pop(name, None)


def forget_registered() -> None:
    """Take every registered effect out of the catalogue again."""
    _registered.clear()


@cache
def _in_setup(name: str) -> Effect | None:
    """Return ``<effect>@<setup>``, or None where the name is no such thing."""
    base, separator, setup = name.partition("@")
    if not separator or not setup:
        return None
    from pipeline.model.setups import OWN, in_setup  # noqa: PLC0415  (it needs this module's own)

    return in_setup(name, OWN.get(base) or effect(base))


def effect(name: str) -> Effect:
    """Return one effect by name; ``<effect>@<setup>`` is that of one setup (``pipeline.model.setups``).

    Raises
    ------
    ConfigurationError
        If there is none of that name.
    """
    found = _registered.get(name) or built_in().get(name) or _in_setup(name)
    if found is None:
        raise ConfigurationError(f"no effect is called {name!r}; known: {', '.join(catalogue())}")
    return found
