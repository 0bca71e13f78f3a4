"""No module imports itself through others, also not by an import inside a function.

Imports for type checkers alone do not count.
"""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import pipeline

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path(pipeline.__file__).parents[1]
PACKAGES = ("pipeline", "imu_logs", "imu_research")


@cache
def modules() -> dict[str, Path]:
    files = [file for package in PACKAGES for file in (ROOT / package).rglob("*.py")]
    found = {file: file.relative_to(ROOT).with_suffix("").parts for file in files}
    return {".".join(parts[:-1] if parts[-1] == "__init__" else parts): file for file, parts in found.items()}


def imports(node: ast.AST) -> Iterator[ast.Import | ast.ImportFrom]:
    """Yield the import statements below a node, without those under ``if TYPE_CHECKING``."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Import | ast.ImportFrom):
            yield child
        elif isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
            yield from (each for other in child.orelse for each in imports(other))
        else:
            yield from imports(child)


def imported(module: str) -> set[str]:
    """Return the modules that a module names in its imports; a package stands for its ``__init__``."""
    found = set()
    for statement in imports(ast.parse(modules()[module].read_text(encoding="utf-8"))):
        if isinstance(statement, ast.Import):
            names = {alias.name for alias in statement.names}
        else:
            inside = {f"{statement.module}.{alias.name}" for alias in statement.names}
            names = {name if name in modules() else str(statement.module) for name in inside}
        found |= names & modules().keys()
    return found - {module}


def circles() -> set[frozenset[str]]:
    """Return the sets of modules that reach each other (Tarjan, SIAM Journal on Computing 1, 1972)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found = set()

    def visit(module: str) -> None:
        index[module] = low[module] = len(index)
        stack.append(module)
        for other in sorted(imported(module)):
            if other not in index:
                visit(other)
            if other in stack:
                low[module] = min(low[module], low[other])
        if low[module] == index[module]:
            circle = frozenset(stack[stack.index(module) :])
            del stack[stack.index(module) :]
            found.update({circle} if len(circle) > 1 else ())

    for module in sorted(modules()):
        if module not in index:
            visit(module)
    return found


def test_no_module_imports_itself_through_others() -> None:
    assert sorted(map(sorted, circles())) == []
