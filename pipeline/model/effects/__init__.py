"""The catalogue of physical effects: every file of ``configs/effect/`` that ships is one.

``catalogue()`` finds the files. Effects of users have the same schema and are registered in the process that uses them.
"""

from __future__ import annotations

import json
from contextlib import contextmanager
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Any

from pipeline.errors import ConfigurationError
from pipeline.model.effects.files import built_in_files, effect_from, load_python_effect, read_effect_file
from pipeline.model.effects.sessions import OWN, in_session

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from pipeline.model.effects.base import Effect
    from pipeline.records import FittedEffect

_registered: dict[str, Effect] = {}
_left_out: set[str] = set()


def built_in() -> dict[str, Effect]:
    """Return every built-in effect by name, in alphabetical order."""
    return {name: _built_in(name) for name in built_in_files()}


def catalogue() -> dict[str, Effect]:
    """Return every effect by name: the built-in ones in alphabetical order, then the registered ones."""
    every = {**built_in(), **_registered}
    return {name: this for name, this in every.items() if name not in _left_out}


@cache
def bench_priors() -> dict[str, str]:
    """Return the effects of the bench, each with the table's setting that states its standard deviation."""
    return {name: this.prior for name, this in built_in().items() if this.prior}


def stated_priors(table: Mapping[str, Any]) -> dict[str, float]:
    """Return the effects of the bench whose standard deviation a table's config states, with that."""
    return {name: float(table[key]) for name, key in bench_priors().items() if table.get(key)}


@contextmanager
def leaving_out(names: Iterable[str]) -> Iterator[None]:
    """Take effects out of the catalogue within a ``with`` block, as unknown effects in studies of the diagnosis."""
    fresh = set(names) - _left_out
    _left_out.update(fresh)
    try:
        yield
    finally:
        _left_out.difference_update(fresh)


def register(effect: Effect) -> None:
    """Add a user's effect to the catalogue of this process; it replaces one of the same name.

    Raises
    ------
    ConfigurationError
        If a built-in effect has that name.
    """
    if effect.name in built_in_files():
        raise ConfigurationError(f"effect {effect.name}: a built-in effect is called so; give yours another name")
    _registered[effect.name] = effect


def register_user_effects(section: Mapping[str, Any]) -> None:
    """Register the effects that a job's configuration carries: ``formulas`` and ``python`` (paths and hashes).

    Raises
    ------
    ConfigurationError
        If one is not as it should be.
    """
    for definition in section.get("formulas", ()):
        register(effect_from(definition, f"effect {definition.get('name')} of the campaign"))
    for entry in section.get("python", ()):
        register(load_python_effect(entry["path"], entry["sha256"]))


def forget(*names: str) -> None:
    """Take registered effects out of the catalogue again; all of them where none is named."""
    for name in names or tuple(_registered):
        _registered.pop(name, None)


def effect(name: str) -> Effect:
    """Return one effect by name; ``<effect>@<setup>`` is that of one session (``pipeline.model.effects.sessions``).

    Raises
    ------
    ConfigurationError
        If there is none of that name.
    """
    if name in _registered:
        return _registered[name]
    if name in built_in_files():
        return _built_in(name)
    if not name.partition("@")[2]:
        raise ConfigurationError(f"no effect is called {name!r}; known: {', '.join(catalogue())}")
    return _in_session(name)


def effect_of(fitted: FittedEffect) -> Effect:
    """Return the effect that was fitted: from its own definition where it carries one, else from the catalogue.

    Raises
    ------
    ConfigurationError
        If it was defined in Python and the file has not been named, or has changed.
    """
    if fitted.definition is None:
        return effect(fitted.name)
    if "recordings" in fitted.definition:
        return effect(fitted.name).of_recordings(fitted.definition["recordings"])
    if "python" not in fitted.definition:
        return _defined(json.dumps(fitted.definition, sort_keys=True))
    found = _registered.get(fitted.name)
    if found is None or found.definition != fitted.definition:
        state = "is not loaded" if found is None else "has another content than the one that was fitted"
        raise ConfigurationError(
            f"the effect {fitted.name} was fitted with the Python file {fitted.definition['python']} (sha256 "
            f"{str(fitted.definition.get('sha256'))[:16]}...), which {state}; name that file: --python-effect FILE, or "
            "in Python load_calibration(path, python_effects=[FILE])"
        )
    return found


def owner_of(fitted: FittedEffect) -> str:
    """Return whose a fitted effect is; a Python file need not be loaded for that."""
    if fitted.definition and "owner" in fitted.definition:
        return str(fitted.definition["owner"])
    return effect_of(fitted).owner


@cache
def _built_in(name: str) -> Effect:
    return read_effect_file(built_in_files()[name], built_in=True)


@lru_cache(maxsize=256)
def _defined(definition: str) -> Effect:
    return effect_from(json.loads(definition), "a calibration's own definition")


@cache
def _in_session(name: str) -> Effect:
    base = name.partition("@")[0]
    return in_session(name, OWN.get(base) or effect(base))
