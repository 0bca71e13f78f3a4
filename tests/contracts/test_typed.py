"""Functions take typed settings and objects; only code that reads or writes documents takes JSON."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import TYPE_CHECKING

import pipeline.core.settings
from pipeline.core.settings import Section

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path(pipeline.core.settings.__file__).parents[1]
JSON = ("Mapping[str, Any]", "dict[str, Any]", "JSON")
SECTIONS = {
    n for n, kind in vars(pipeline.core.settings).items() if isinstance(kind, type) and issubclass(kind, Section)
}
# Modules and packages with functions that take JSON, by the reason.
TAKE_JSON = {
    "the configuration, effects, profiles and simulations as files state them, before they are checked": (
        "app/commands/config.py", "app/config/", "physics/effects/",
        "core/settings.py", "simulation/",
    ),
    "documents of a run: written, read, and shown on pages, by commands and in formats of other programs": (
        "app/commands/explain.py", "app/commands/noise.py", "evaluation/diagnosis/words.py", "output/exports/",
        "app/field_logs/stream.py", "output/history.py", "ingest/arrow.py", "app/one_unit.py",
        "ingest/files.py",
        "physics/compensation.py", "physics/statements.py",
        "output/outcome.py", "app/plan.py", "core/records/",
        "output/pages/", "app/results_folder.py", "app/steps/", "core/verdicts.py",
    ),
}  # fmt: skip

Function = ast.FunctionDef | ast.AsyncFunctionDef


def functions() -> Iterator[tuple[str, Function]]:
    for file in sorted(ROOT.rglob("*.py")):
        module = file.relative_to(ROOT).as_posix()
        found = ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        yield from ((module, node) for node in found if isinstance(node, Function))


def parameters(function: Function) -> dict[str, str]:
    """Return the annotation of each parameter, without quotes."""
    of = function.args
    each = [*of.posonlyargs, *of.args, *of.kwonlyargs]
    return {a.arg: ast.unparse(a.annotation).replace("'", "") if a.annotation else "" for a in each}


def test_only_modules_that_read_or_write_documents_take_json() -> None:
    taking = {
        module
        for module, function in functions()
        for annotation in parameters(function).values()
        if any(kind in annotation for kind in JSON)
    }
    allowed = tuple(place for places in TAKE_JSON.values() for place in places)
    assert sorted(module for module in taking if not module.startswith(allowed)) == []
    assert [place for place in allowed if not any(module.startswith(place) for module in taking)] == []


def test_settings_have_no_default_beside_their_own() -> None:
    """``settings.table.latitude_deg or {}`` hides what is not stated."""
    found = []
    for module, function in functions():
        typed = {name for name, annotation in parameters(function).items() if SECTIONS & set(annotation.split(" | "))}
        for node in ast.walk(function):
            if isinstance(node, ast.BoolOp) and isinstance(node.values[-1], ast.Dict) and not node.values[-1].keys:
                places = [value for value in node.values if isinstance(value, ast.Name | ast.Attribute)]
                names = {n.id for place in places for n in ast.walk(place) if isinstance(n, ast.Name)}
                found += [f"{module}:{node.lineno}"] if names & typed else []
    assert found == []


def test_settings_are_no_mappings() -> None:
    assert not [name for name in ("__getitem__", "get", "keys", "items") if hasattr(Section, name)]
