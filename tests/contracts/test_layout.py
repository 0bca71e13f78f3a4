"""The layout of the packages: rooms, the floors that they stand on, and the imports between them.

A room is a package or module directly in ``pipeline/``, or another top-level folder of Python. A room stands one floor
above the highest room that it imports.
"""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
FOLDERS = ("pipeline", "imu_calibration", "imu_logs", "imu_research", "benchmarks")


def modules() -> dict[str, Path]:
    """Return each module and its file."""
    files = [file for folder in FOLDERS for file in sorted((ROOT / folder).rglob("*.py"))]
    return {".".join(f.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): f for f in files}


@cache
def imports() -> dict[str, frozenset[str]]:
    """Return the modules of the repository that each module imports, also inside functions and for annotations."""
    known, found = modules(), {}
    for module, file in known.items():
        names: set[str] = set()
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                names |= {f"{node.module}.{alias.name}" for alias in node.names} | {node.module}
        found[module] = frozenset(_most_exact(names & known.keys())) - {module}
    return found


def _most_exact(names: set[str]) -> set[str]:
    """Leave out a package of which only a module is imported."""
    return {name for name in names if not any(other.startswith(f"{name}.") for other in names)}


def room(module: str) -> str:
    folder, _, inside = module.partition(".")
    return f"pipeline.{inside.partition('.')[0]}" if folder == "pipeline" else folder


@cache
def arrows() -> frozenset[tuple[str, str]]:
    """Return the pairs of rooms of which the first imports the second."""
    pairs = {(room(module), room(other)) for module, others in imports().items() for other in others}
    return frozenset((one, other) for one, other in pairs if one != other)


def floors() -> dict[str, int]:
    """Return the floor of each room, from 1."""
    found: dict[str, int] = {}
    left = {room(module) for module in modules()}
    while left:
        stand = {one for one in left if not any(start == one and other in left for start, other in arrows())}
        assert stand, f"rooms that import each other in a circle are among {sorted(left)}"
        below = {one: [found[other] for start, other in arrows() if start == one] for one in stand}
        found |= {one: 1 + max(below[one], default=0) for one in stand}
        left -= stand
    return found


def test_rooms_floors_and_arrows_stay_few() -> None:
    found = floors()
    assert len(found) <= 20
    assert len(arrows()) <= 90
    assert max(found.values()) <= 10
    own = {one: floor for one, floor in found.items() if one.startswith("pipeline.")}
    assert len(own) <= 12
    assert max(own.values()) - min(own.values()) < 7


def test_no_module_is_too_long_to_read() -> None:
    lengths = {name: len(file.read_text(encoding="utf-8").splitlines()) for name, file in modules().items()}
    assert {name: lines for name, lines in lengths.items() if lines > 600} == {}


def test_the_rooms_have_a_face_that_says_what_they_do() -> None:
    rooms = [ROOT / "pipeline" / one.partition(".")[2] for one in floors() if one.startswith("pipeline.")]
    for folder in (folder for folder in rooms if folder.is_dir()):
        text = ast.get_docstring(ast.parse((folder / "__init__.py").read_text(encoding="utf-8")))
        assert text, folder
        assert text.splitlines()[0].endswith("."), folder


def test_constants_stand_before_functions_and_classes() -> None:
    """Except for those that use a class or a function of their module."""
    late = []
    for module, file in modules().items():
        body, defined = ast.parse(file.read_text(encoding="utf-8")).body, set()
        for node in body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                defined.add(node.name)
            elif isinstance(node, ast.Assign | ast.AnnAssign) and defined and module.startswith("pipeline"):
                names = {each.id for each in ast.walk(node) if isinstance(each, ast.Name)}
                targets = {each.id for each in ast.walk(node) if isinstance(each, ast.Name) and each.id not in defined}
                late += [] if names & defined else [f"{module}:{node.lineno}"]
                defined |= targets if names & defined else set()
    assert late == []
