"""Files of effects of the user's own: YAML with formulas, and Python where the user names it on the command line.

A YAML file is data from anybody: it is small, has no references within (anchors, aliases) and no tags beyond plain
values, and each key stands once. A Python file is code, and is run; nothing but the command line leads to one.
"""

from __future__ import annotations

import hashlib
import sys
from importlib.abc import ExecutionLoader
from importlib.util import decode_source
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import yaml

from pipeline.errors import ConfigurationError, MissingInputError, PipelineError
from pipeline.io.file_access import read_text
from pipeline.model.effects import built_in, register
from pipeline.model.effects.base import Effect
from pipeline.model.user_effects import FormulaEffect, effect_from

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

LARGEST_BYTES, DEEPEST = 16384, 8


def read_effect_files(files: Iterable[Path]) -> dict[str, FormulaEffect]:
    """Return the effects of YAML files, by name.

    Raises
    ------
    ConfigurationError
        With a line for each file that is not as it should be.
    """
    found: dict[str, FormulaEffect] = {}
    problems = []
    for file in files:
        try:
            found[file.stem] = read_effect_file(file)
        except ConfigurationError as error:
            problems.append(str(error))
    if problems:
        raise ConfigurationError("\n".join(problems))
    return found


def read_effect_file(file: Path) -> FormulaEffect:
    """Return the effect of one YAML file.

    Raises
    ------
    ConfigurationError
        If it is not as it should be, with its line.
    """
    return _effect_of_text(read_text(file, LARGEST_BYTES, "an effect"), file)


def load_python_effect(path: str | Path, sha256: str | None = None) -> Effect:
    """Run a Python file that the user has named, and return its ``EFFECT``.

    Parameters
    ----------
    path : str or Path
    sha256 : str, optional
        Of the content that is expected.

    Raises
    ------
    MissingInputError
        If there is no such file.
    ConfigurationError
        If it has another content, fails, or holds no effect of the file's name.
    """
    file = Path(path)
    if file.suffix != ".py" or not file.is_file():
        raise MissingInputError("there is no such Python file (.py) with an effect", str(file))
    content = file.read_bytes()
    digest = hashlib.sha256(content).hexdigest()
    if sha256 is not None and digest != sha256:
        raise ConfigurationError("the file has changed since the run began; start the run again", str(file))
    name = f"imu_calibration_user_effect_{file.stem}"
    module = ModuleType(name)
    module.__file__ = str(file)
    sys.modules[name] = module  # dataclasses and pickle look a class up there
    try:
        _ThisContent(file, content).exec_module(module)
    except PipelineError:
        raise
    except Exception as error:
        raise ConfigurationError(f"cannot be run: {type(error).__name__}: {error}", str(file)) from error
    return _checked(getattr(module, "EFFECT", None), file, digest)


class _ThisContent(ExecutionLoader):
    """Loads the very bytes that were hashed; no cache of compiled code is read or written."""

    def __init__(self, file: Path, content: bytes) -> None:
        self.file, self.content = file, content

    def get_source(self, fullname: str) -> str:
        del fullname
        return decode_source(self.content)

    def get_filename(self, fullname: str) -> str:
        del fullname
        return str(self.file)


def register_user_effects(part: Mapping[str, Any]) -> None:
    """Register the effects that a part of a configuration carries: ``formulas`` and ``python`` (paths and hashes).

    Raises
    ------
    ConfigurationError
        If one is not as it should be.
    """
    for definition in part.get("formulas", ()):
        register(effect_from(definition, f"effect {definition.get('name')} of the campaign"))
    for entry in part.get("python", ()):
        register(load_python_effect(entry["path"], entry["sha256"]))


def _checked(found: Any, file: Path, digest: str) -> Effect:  # noqa: ANN401  (whatever the file calls EFFECT)
    if not isinstance(found, Effect):
        raise ConfigurationError(
            "holds no effect: EFFECT = MyEffect() is expected, of a class derived from "
            "pipeline.model.effects.base.Effect (see docs/effects_of_your_own.md)",
            str(file),
        )
    wanted = ("name", "owner", "layout", "meaning", "excitation", "experiment", "source")
    lacking = [name for name in wanted if not hasattr(found, name)]
    if lacking:
        raise ConfigurationError(f"its EFFECT lacks {', '.join(lacking)}", str(file))
    if found.name != file.stem:
        raise ConfigurationError(
            f"its EFFECT is called {found.name!r}; give it the file's name, {file.stem}", str(file)
        )
    if found.name in built_in():
        raise ConfigurationError(f"a built-in effect is called {found.name}; give yours another name", str(file))
    found.definition = {"python": file.name, "sha256": digest, "owner": str(found.owner)}
    return found


def _effect_of_text(text: str, file: Path) -> FormulaEffect:
    given, lines = _read_yaml(text, str(file))
    if not isinstance(given, dict):
        raise ConfigurationError("an effect is expected: name, owner, sensors, meaning, terms", str(file))
    made = effect_from(given, str(file), lines)
    if made.name != file.stem:
        place = f"{file}:{lines.get(('name',), 1)}"
        raise ConfigurationError(f"the effect is called {made.name}, the file {file.stem}: give both one name", place)
    return made


def _read_yaml(text: str, where: str) -> tuple[Any, dict[tuple[str, ...], int]]:
    """Return the plain values of a YAML text, and the line of each key."""
    lines: dict[tuple[str, ...], int] = {}
    loader = yaml.SafeLoader(text)
    try:
        _refuse_all_but_plain(yaml.parse(text, Loader=yaml.SafeLoader), where)
        node = loader.get_single_node()
        value = None if node is None else _value(node, (), loader, lines, where)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = f"{where}:{mark.line + 1}" if mark else where
        raise ConfigurationError(f"is not YAML: {getattr(error, 'problem', None) or error}", place) from None
    except ValueError as error:
        raise ConfigurationError(f"holds a value that cannot be read: {error}", where) from None
    finally:
        loader.dispose()
    return value, lines


def _refuse_all_but_plain(events: Iterable[yaml.Event], where: str) -> None:
    """Refuse references, tags and nesting, before anything is built of them."""
    depth = 0
    for event in events:
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        found = [
            (getattr(event, "anchor", None), "anchors and aliases (& and *) have no place in an effect"),
            (getattr(event, "tag", None), "a tag (!) has no place in an effect"),
            (depth > DEEPEST, "is nested too deeply"),
        ]
        reason = next((reason for applies, reason in found if applies), None)
        if reason:
            line = event.start_mark.line + 1 if event.start_mark else 1
            raise ConfigurationError(reason, f"{where}:{line}")


def _value(
    node: yaml.Node, path: tuple[str, ...], loader: yaml.SafeLoader, lines: dict[tuple[str, ...], int], where: str
) -> Any:  # noqa: ANN401
    """Return what a node holds, and note the lines of its keys."""
    if isinstance(node, yaml.SequenceNode):
        return [_value(item, path, loader, lines, where) for item in node.value]
    if not isinstance(node, yaml.MappingNode):
        return loader.construct_object(node)
    out: dict[str, Any] = {}
    for key_node, item in node.value:
        key = str(key_node.value)
        line = key_node.start_mark.line + 1
        if key in out:
            raise ConfigurationError(f"{key} stands twice", f"{where}:{line}")
        lines[*path, key] = line
        out[key] = _value(item, (*path, key), loader, lines, where)
    return out
