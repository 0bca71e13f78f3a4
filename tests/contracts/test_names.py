"""A name has one meaning: classes and constants of modules that are not the same thing have different names."""

from __future__ import annotations

import ast
from collections import defaultdict
from pathlib import Path
from typing import TYPE_CHECKING

import pipeline

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path(pipeline.__file__).parents[1]
# Names that several modules define, with the same meaning in each.
SAME_MEANING = {
    "EPILOG": "the text below the options of a command",
    "FIT_STAGES": "declarations of the stages of a fit",
    "NAME": "of a stage of a fit",
    "STAGE_EQUATIONS": "of the thesis, by stage",
    "NEEDED_RECORDING": "what to record if the recordings show nothing",
    "SEED": "of random numbers",
    "LEFT": "margin of a chart, px",
    "RIGHT": "margin of a chart, px",
    "ROW": "height of a row of a chart, px",
    "WIDTH": "letters of a line of the terminal",
    "NODES": "of a quadrature",
    "WEIGHTS": "of a quadrature",
    "NUMBER": "pattern of a number in a text",
    "INTERVAL_S": "between simulated samples",
    "SETTLING_S": "after a movement, before a rest",
    "GAP_INTERVALS": "sampling intervals; a longer step of time is a gap",
    "MIN_VARIANCE_SAMPLES": "samples that a variance needs",
    "BUILT_IN": "how the file of a built-in effect states that it is one",
    "GIVEN": "the method of a given calibration",
    "SILENT": "no noise",
    "DESCRIPTION_FILE": "description of a simulation in a campaign",
    "TEMPLATES": "folder of the templates of a package",
    "MAX_TIMES_DATA_SHEET": "noise over that of the data sheet",
    "Positive": "a number above 0",
    "NonNegative": "a number from 0 on",
    "Result": "what a function returns, of any type",
}


def definitions() -> Iterator[tuple[str, str]]:
    """Yield name and module of each class and constant of a module; an alias of a type is a class."""
    for file in [*ROOT.glob("pipeline/**/*.py"), *ROOT.glob("imu_research/**/*.py")]:
        for node in ast.parse(file.read_text(encoding="utf-8")).body:
            targets = node.targets if isinstance(node, ast.Assign) else []
            targets = [node.target] if isinstance(node, ast.AnnAssign) else targets
            names = [n.id for target in targets for n in ast.walk(target) if isinstance(n, ast.Name)]
            names += [node.name] if isinstance(node, ast.ClassDef) else []
            yield from ((name, file.relative_to(ROOT).as_posix()) for name in names if name[0].isupper())


def test_a_name_of_several_modules_has_one_meaning() -> None:
    modules: dict[str, list[str]] = defaultdict(list)
    for name, module in definitions():
        modules[name].append(module)
    shared = {name: found for name, found in modules.items() if len(found) > 1}
    assert {name: found for name, found in shared.items() if name not in SAME_MEANING} == {}
    assert SAME_MEANING.keys() - shared.keys() == set()
