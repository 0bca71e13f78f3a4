"""Verdicts are written in one module; all others name the enumeration."""

import ast
import re
from pathlib import Path

import pipeline
from pipeline.core.verdicts import Verdict, css_class

PACKAGE = Path(pipeline.__file__).parent
ALSO_A_KEY = {Verdict.UNEXPLAINED}  # key of a diagnosis, kind of a chart


def test_no_other_module_or_template_writes_a_verdict() -> None:
    names = set(Verdict) - ALSO_A_KEY
    found = [
        (file.name, node.value)
        for file in PACKAGE.rglob("*.py")
        if file.name != "verdicts.py"
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and node.value in names
    ]
    quoted = re.compile("[\"'](" + "|".join(names) + ")[\"']")
    found += [(f.name, m[1]) for f in PACKAGE.rglob("templates/*") for m in quoted.finditer(f.read_text())]
    assert found == []


def test_a_sensor_without_a_verdict_has_no_class() -> None:
    assert [css_class(v) for v in (None, "", "nothing_missing", "unexplained")] == ["", "", "good", "warn"]
