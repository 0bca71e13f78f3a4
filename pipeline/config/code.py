"""A digest of the code that a stage runs.

Snakemake sees the shell command of a rule, not the package that it calls; so each rule has this digest as a parameter,
and a changed method reruns the stages that use it.
"""

from __future__ import annotations

import ast
import hashlib
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.files import CONFIGS

if TYPE_CHECKING:
    from collections.abc import Iterator

PACKAGE = Path(__file__).resolve().parents[1]
EFFECTS = CONFIGS / "effect"  # what pipeline.model.effects.files reads


@cache
def code_digest(module: str) -> str:
    """Return a digest of a module's source and of every module of the package that it imports, at any depth.

    A package counts with all that lies beside its ``__init__`` where it finds its modules on disk (exports), a module
    that imports jinja2 with the ``templates`` beside it, the effects with their files in ``configs/effect/``.

    Parameters
    ----------
    module : str
        For example ``pipeline.stages.ingest``.
    """
    digest = hashlib.sha256()
    for file in sorted(_closure(module)):
        digest.update(str(file.relative_to(PACKAGE.parent)).encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16]


@cache
def _closure(module: str) -> frozenset[Path]:
    seen: set[Path] = set()
    todo = [file for file in [_file_of(module)] if file]
    while todo:
        file = todo.pop()
        if file not in seen:
            seen.add(file)
            todo.extend(_imports(file))
    return frozenset(seen)


@cache
def _imports(file: Path) -> tuple[Path, ...]:
    if file.suffix != ".py":
        return ()
    source = file.read_bytes()
    found: list[Path | None] = []
    if file.name == "__init__.py" and b"import_module(" in source:
        found += [f for f in file.parent.rglob("*") if f.is_file() and f.suffix != ".pyc"]
    if file == PACKAGE / "model" / "effects" / "files.py":
        found += [*file.parent.glob("*.py")]  # classes that the files name
        found += [f for f in sorted(EFFECTS.glob("*.yaml")) if b"\nbuilt_in: true" in f.read_bytes()]
    for node in _statements(ast.parse(source).body):
        if isinstance(node, ast.Import):
            found += [_file_of(alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            found.append(_file_of(node.module))
            if node.module == "jinja2":
                found += (file.parent / "templates").glob("*")
            found += [_file_of(f"{node.module}.{alias.name}") for alias in node.names]
    return tuple(f for f in found if f)


def _statements(body: list[ast.stmt]) -> Iterator[ast.stmt]:
    """Yield statements and those within them; expressions, which are most of a tree, hold no import."""
    for node in body:
        yield node
        for field in ("body", "orelse", "finalbody"):
            yield from _statements(getattr(node, field, []))
        for part in (*getattr(node, "handlers", []), *getattr(node, "cases", [])):
            yield from _statements(part.body)


@cache
def _file_of(module: str) -> Path | None:
    if module != "pipeline" and not module.startswith("pipeline."):
        return None
    path = PACKAGE.joinpath(*module.split(".")[1:])
    for file in (path / "__init__.py", path.with_suffix(".py")):
        if file.is_file():
            return file
    return None
