"""Functions take typed settings and objects; only modules that read or write documents take them as JSON."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import TYPE_CHECKING

import pipeline.settings
from pipeline.settings import Section

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path(pipeline.settings.__file__).parent
UNTYPED = ("Mapping[str, Any]", "dict[str, Any]", "JSON")
SECTIONS = {
    name for name, kind in vars(pipeline.settings).items() if isinstance(kind, type) and issubclass(kind, Section)
}
DOCUMENTS: dict[str, str] = {}


def functions() -> Iterator[tuple[str, ast.FunctionDef | ast.AsyncFunctionDef]]:
    for file in sorted(ROOT.rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                yield file.relative_to(ROOT).as_posix(), node


def parameters(function: ast.FunctionDef | ast.AsyncFunctionDef) -> Iterator[tuple[str, str]]:
    for each in (*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs):
        yield each.arg, "" if each.annotation is None else ast.unparse(each.annotation).strip("'\"")
