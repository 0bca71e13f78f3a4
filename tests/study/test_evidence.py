"""The page of evidence is that of the stored figures, and the README states no others."""

from __future__ import annotations

import argparse
import importlib.util
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from imu_research.figures import MeasuredFigure

if TYPE_CHECKING:
    from types import ModuleType

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "evidence.md"


@pytest.fixture(scope="module")
def evidence() -> ModuleType:
    specification = importlib.util.spec_from_file_location("evidence", ROOT / "benchmarks" / "evidence.py")
    assert specification
    assert specification.loader
    module = importlib.util.module_from_spec(specification)
    sys.modules["evidence"] = module  # dataclasses look it up
    specification.loader.exec_module(module)
    return module


def test_the_page_is_written_from_the_stored_figures(evidence: ModuleType) -> None:
    assert PAGE.read_text() == evidence.page(), "run python benchmarks/evidence.py page"
    assert sum(bool(re.search(r"\w", word)) for word in PAGE.read_text().split()) <= 1500


def test_the_readme_states_no_other_figures() -> None:
    page = " ".join(PAGE.read_text().replace("**", "").split())
    text = " ".join((ROOT / "README.md").read_text().split())
    begin = text.index("In the [blind study](docs/evidence.md)")
    stated = re.findall(r"([\d,]+) of ([\d,]*\d)", text[begin : begin + 900])
    assert len(stated) >= 5
    for hits, total in stated:
        assert re.search(rf"(?<![\d,]){hits} of {total}(?![\d,])", page), (hits, total)
    for error in re.findall(r"([\d.]+) (?:mg|deg/s) -> ([\d.]+) (?:mg|deg/s)", text):
        for value in error:
            assert re.search(rf"\| {re.escape(value.rstrip('0'))}0* ", page), value


def test_each_stored_figure_has_its_command_date_and_commit(evidence: ModuleType) -> None:
    for name, measure in evidence.measures().items():
        stored = evidence.Stored.of(name)
        assert stored.command == measure.shown
        assert re.fullmatch(r"20\d\d-\d\d-\d\d [0-9a-f]{8}", f"{stored.date} {stored.commit}")
        assert stored.figures


def test_a_part_that_contradicts_the_stored_share_is_named(evidence: ModuleType) -> None:
    def of(*figures: MeasuredFigure) -> object:
        return evidence.Stored("", "", "", list(figures))

    whole = of(MeasuredFigure("a", 0.99, 1000, "", (0.98, 1.0)), MeasuredFigure("b", 30.0, 1, unit="ms"))
    agrees = of(MeasuredFigure("a", 0.95, 20, "", (0.8, 1.0)), MeasuredFigure("b", 60.0, 1, unit="ms"))
    differs = of(MeasuredFigure("a", 0.5, 20, "", (0.3, 0.7)))
    assert evidence.outside(whole, agrees) == []
    assert evidence.outside(whole, differs) == ["a: stored 0.9900, now 0.5000 of 20"]


def test_a_command_that_writes_no_figures_ends_with_its_message(evidence: ModuleType) -> None:
    options = argparse.Namespace(share=1.0, cores=1)
    with pytest.raises(SystemExit, match=r"wrote no figures:\nno recording"):
        evidence.measured(evidence.Measure("python -c \"print('no recording')\""), options)


@pytest.mark.evidence
def test_a_tenth_of_everything_agrees_with_what_is_stored(
    evidence: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """All measures but those that need other programs."""
    names = [name for name in evidence.measures() if name not in {"peers", "real"}]
    monkeypatch.setattr(sys, "argv", ["evidence.py", "run", *names, "--share", "0.1"])
    assert evidence.main() == 0, capsys.readouterr().out
