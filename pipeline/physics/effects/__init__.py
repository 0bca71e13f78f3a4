"""The catalogue of physical effects: one effect for each file of ``configs/effect/`` that is part of the package.

Effects of users have the same schema and are registered in the process that uses them. A YAML file is data: it is read
within size limits, and its formulas are parsed. A Python file is code and is run; only the command line can name one.
"""

from __future__ import annotations

import hashlib
import json
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import cache, lru_cache, partial
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import yaml

from imu_logs.files import read_text
from imu_logs.yaml_file import load_yaml
from pipeline.core.errors import ConfigurationError, MissingInputError, PipelineError
from pipeline.core.files import EFFECTS_FOLDER
from pipeline.core.records import Coefficient, FittedEffect, Values
from pipeline.core.settings import Table, UserEffectFiles
from pipeline.physics.effects.base import Effect
from pipeline.physics.effects.formula_effect import FormulaEffect, fitted_anyway, read_declaration
from pipeline.physics.effects.mounting import SETUP_EFFECTS, in_session

BUILT_IN = re.compile(r"^built_in: true", re.MULTILINE)
MAX_EFFECT_BYTES, MAX_EFFECT_VALUES = 16384, 1000  # of one file; the largest built-in one has 2 kB and 70 values
OF_PYTHON = ("name", "owner", "layout", "meaning", "excitation", "experiment", "source")
_registered: dict[str, Effect] = {}
_left_out: set[str] = set()


def built_in() -> dict[str, Effect]:
    """Return every built-in effect by name, in alphabetical order."""
    return {name: _built_in(name) for name in built_in_files()}


def catalogue() -> dict[str, Effect]:
    """Return every effect by name: the built-in ones in alphabetical order, then the registered ones."""
    every = {**built_in(), **_registered}
    return {name: kind for name, kind in every.items() if name not in _left_out}


@cache
def bench_priors() -> dict[str, str]:
    """Return, by effect of the bench, the setting of the table that states its standard deviation."""
    return {name: kind.prior for name, kind in built_in().items() if kind.prior}


def stated_priors(table: Table) -> dict[str, float]:
    """Return the standard deviation of each effect of the bench for which a table's config states one."""
    return {name: value for name, key in bench_priors().items() if (value := getattr(table, key))}


@contextmanager
def leaving_out(names: Iterable[str]) -> Iterator[None]:
    """Remove effects from the catalogue within a ``with`` block, to study the diagnosis of unknown effects."""
    fresh = set(names) - _left_out
    _left_out.update(fresh)
    try:
        yield
    finally:
        _left_out.difference_update(fresh)


def register(effect: Effect) -> None:
    """Add a user's effect to the catalogue of this process; it replaces one of the same name, which is not built in."""
    _registered[effect.name] = effect


def register_user_effects(files: UserEffectFiles) -> None:
    """Register the effects of a job's configuration; raise ``ConfigurationError`` if one is faulty."""
    for definition in files.formulas:
        register(effect_from(definition, f"effect {definition.get('name')} of the campaign"))
    for entry in files.python:
        register(load_python_effect(entry["path"], entry["sha256"]))


@contextmanager
def registered(files: UserEffectFiles) -> Iterator[None]:
    """Add the effects of a configuration to the catalogue within a ``with`` block (``register_user_effects``)."""
    before = dict(_registered)
    try:
        register_user_effects(files)
        yield
    finally:
        _registered.clear()
        _registered.update(before)


def forget(*names: str) -> None:
    """Remove registered effects from the catalogue; all of them where none is named."""
    for name in names or tuple(_registered):
        _registered.pop(name, None)


def fitted_effect(name: str, sensor: str, values: Values) -> FittedEffect:
    """Return an effect of the catalogue with its values, without an uncertainty."""
    named = zip(effect(name).parameters(sensor), values.tolist(), strict=True)
    return FittedEffect(name, {p.name: Coefficient(value, p.unit) for p, value in named})


def effect(name: str) -> Effect:
    """Return an effect by name; ``<effect>@<setup>`` acts in one session. ``ConfigurationError`` if there is none."""
    if name in _registered:
        return _registered[name]
    if name in built_in_files():
        return _built_in(name)
    if not name.partition("@")[2]:
        raise ConfigurationError(f"no effect is called {name!r}; known: {', '.join(catalogue())}")
    base = name.partition("@")[0]
    return in_session(name, SETUP_EFFECTS.get(base) or effect(base))


def effect_of(fitted: FittedEffect) -> Effect:
    """Return the effect that was fitted: from its stored definition where there is one, else from the catalogue.

    Raises ``ConfigurationError`` if it is defined in a Python file that was not named, or has changed.
    """
    if fitted.definition is None:
        return effect(fitted.name)
    if "recordings" in fitted.definition:
        return effect(fitted.name).of_recordings(dict.fromkeys(fitted.definition["recordings"], ""))
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
    """Return the owner of a fitted effect, without loading its Python file."""
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
def built_in_files() -> dict[str, Path]:
    """Return the file of each built-in effect, by name; a user's file in the same folder is none."""
    files = sorted(EFFECTS_FOLDER.glob("*.yaml"))
    return {f.stem: f for f in files if BUILT_IN.search(f.read_text(encoding="utf-8", errors="replace"))}


def read_effect_files(files: Iterable[Path]) -> dict[str, Effect]:
    """Read the effects of YAML files, by name; raise ``ConfigurationError`` with a line for each faulty file."""
    found: dict[str, Effect] = {}
    problems = []
    for file in files:
        try:
            found[file.stem] = read_effect_file(file)
        except ConfigurationError as error:
            problems.append(str(error))
    if problems:
        raise ConfigurationError("\n".join(problems))
    return found


def read_effect_file(file: Path, *, built_in: bool = False) -> Effect:
    """Read the effect of one YAML file; raise ``ConfigurationError`` with the faulty line."""
    text = read_text(file, MAX_EFFECT_BYTES, "an effect")
    given = load_yaml(text, str(file), MAX_EFFECT_VALUES)
    if not isinstance(given, dict):
        raise ConfigurationError("an effect is expected: name, owner, sensors, meaning, terms", str(file))
    lines = partial(_lines, text)
    made = effect_from(given, str(file), lines, built_in=built_in)
    if not built_in and isinstance(made, FormulaEffect):
        for term, what in fitted_anyway(made.declared).items():
            place = f"{file}:{lines().get(('terms', term), 1)}"
            raise ConfigurationError(f"terms.{term}: {what}", place)
    if made.name != file.stem:
        place = f"{file}:{lines().get(('name',), 1)}"
        raise ConfigurationError(f"the effect is called {made.name}, the file {file.stem}: give both one name", place)
    return made


def effect_from(
    definition: Mapping[str, Any],
    where: str,
    lines: Any = dict,  # noqa: ANN401  (a function that returns the line of each key)
    *,
    built_in: bool = False,
) -> Effect:
    """Return the effect that a definition describes; parameters and errors as of ``read_declaration``."""
    declared = read_declaration(dict(definition), where, lines, built_in=built_in)
    if built_in:
        if not declared.python:
            return FormulaEffect(declared)
        module, _, name = declared.python.partition(".")
        made: Effect = getattr(import_module(f"pipeline.physics.effects.{module}"), name)(declared)
        return made
    if declared.name in built_in_files():
        place = f"{where}:{line}" if (line := lines().get(("name",))) else where
        raise ConfigurationError(f"name: a built-in effect is called {declared.name}; choose another name", place)
    with_source = replace(declared, source=declared.source or f"the user's own, {where}")
    source = {**definition, "sensors": list(declared.sensors)}
    return FormulaEffect(with_source, source | ({"axes": list(declared.axes)} if "axes" in definition else {}))


def load_python_effect(path: str | Path, sha256: str | None = None) -> Effect:
    """Run a Python file that the user has named, and return its ``EFFECT``.

    ``sha256``: of the expected content. Raises ``MissingInputError`` if there is no such file, ``ConfigurationError``
    if its content differs, it fails, or it defines no effect of the file's name.
    """
    file = Path(path)
    if file.suffix != ".py" or not file.is_file():
        raise MissingInputError("there is no such Python file (.py) with an effect", str(file))
    content = file.read_bytes()
    digest = hashlib.sha256(content).hexdigest()
    if sha256 is not None and digest != sha256:
        raise ConfigurationError("the file has changed since the run began; start the run again", str(file))
    module = ModuleType(f"imu_calibration_user_effect_{file.stem}")
    sys.modules[module.__name__] = module  # dataclasses and pickle look a class up there
    try:
        exec(compile(content, str(file), "exec"), vars(module))  # noqa: S102  (exactly the content that was hashed)
    except PipelineError:
        raise
    except Exception as error:
        raise ConfigurationError(f"cannot be run: {type(error).__name__}: {error}", str(file)) from error
    found = getattr(module, "EFFECT", None)
    problem = _problem_of(found, file.stem)
    if not isinstance(found, Effect) or problem:
        raise ConfigurationError(problem, str(file))
    found.definition = {"python": file.name, "sha256": digest, "owner": str(found.owner)}
    return found


def _problem_of(found: object, name: str) -> str:
    """Return why the ``EFFECT`` of a Python file is unusable; empty if it is usable."""
    if not isinstance(found, Effect):
        text = "holds no effect: EFFECT = MyEffect() is expected"
        return f"{text}, of a class derived from pipeline.physics.effects.base.Effect (see docs/effects_of_your_own.md)"
    lacking = [attribute for attribute in OF_PYTHON if not hasattr(found, attribute)]
    if lacking:
        return f"its EFFECT lacks {', '.join(lacking)}"
    if found.name != name:
        return f"its EFFECT is called {found.name!r}; give it the file's name, {name}"
    if found.name in built_in_files():
        return f"a built-in effect is called {found.name}; choose another name"
    return ""


def _lines(text: str) -> dict[tuple[str, ...], int]:
    """Return the line of each key of a YAML text, by the path of keys to it."""
    found: dict[tuple[str, ...], int] = {}
    todo: list[tuple[tuple[str, ...], yaml.Node | None]] = [((), yaml.compose(text, yaml.SafeLoader))]
    for path, node in todo:  # the list grows while it is walked
        for key, value in node.value if isinstance(node, yaml.MappingNode) else ():
            found[*path, str(key.value)] = key.start_mark.line + 1
            todo.append(((*path, str(key.value)), value))
    return found
