"""The page of evidence is that of the stored figures, and the README states no others."""

from __future__ import annotations

import argparse
import csv
import hashlib
import importlib.util
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import yaml

from imu_research.figures import MeasuredFigure

if TYPE_CHECKING:
    from types import ModuleType

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "evidence.md"


def benchmark(name: str) -> ModuleType:
    specification = importlib.util.spec_from_file_location(name, ROOT / "benchmarks" / f"{name}.py")
    assert specification
    assert specification.loader
    module = importlib.util.module_from_spec(specification)
    sys.modules[name] = module  # dataclasses look it up
    specification.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def evidence() -> ModuleType:
    return benchmark("evidence")


def test_the_page_is_written_from_the_stored_figures(evidence: ModuleType) -> None:
    assert PAGE.read_text() == evidence.page(), "run python benchmarks/evidence.py page"
    assert sum(bool(re.search(r"\w", word)) for word in PAGE.read_text().split()) <= 1500


def test_holm_rejects_rows_one_by_one(evidence: ModuleType) -> None:
    # 3.1, 2.6 and 1 standard errors: p of 0.0019, 0.0093 and 0.32. Of three rows the levels are 1/3, 1/2 and 1 %.
    rows = [(0.95 + z * 0.004, z) for z in (1.0, 3.1, 2.6)]
    half = 2.5758 * 0.004
    figures = [MeasuredFigure(f"{z}", s, 900, "contains 95 %", (s - half, s + half)) for s, z in rows]
    assert [figure.missed for figure in figures] == [False, True, True]
    assert [figure.missed for figure in evidence.by_holm(figures)] == [False, True, False]
    assert [figure.missed for figure in evidence.by_holm(figures[1:])] == [True, True]


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


def test_sets_of_others_are_split_and_an_absent_one_is_named_with_source_and_hash(tmp_path: Path) -> None:
    real = benchmark("real_recordings")
    sources = yaml.safe_load((real.SETS / "sources.yaml").read_text())
    rows = list(csv.DictReader((real.SETS / "units.csv").read_text().splitlines()))
    assert [row["unit"] for row in rows] == list(sources)
    for unit, source in sources.items():
        sheet = list(csv.DictReader((real.SETS / "raw" / unit / "recordings.csv").read_text().splitlines()))
        assert {row["file"] for row in sheet} == {*source["files"], *(["other.csv"] if "split" in source else [])}
        digest = next(iter(source["files"].values()))[1]
        with pytest.raises(SystemExit, match=rf"clone {source['repository']} at {source['commit']} .*{digest}"):
            real.place(tmp_path, tmp_path, unit, source)
    text = b"x\n1\n2\n3\n4\n5\n"
    (tmp_path / "u").mkdir()
    (tmp_path / "u" / "a").write_bytes(text)
    (tmp_path / "raw" / "u").mkdir(parents=True)
    files = {"fit.csv": ["a", hashlib.sha256(text).hexdigest()]}
    real.place(tmp_path, tmp_path, "u", {"files": files, "split": 2, "header": 1})
    parts = [(tmp_path / "raw" / "u" / name).read_text().split() for name in ("fit.csv", "other.csv")]
    assert parts == [["x", "1", "2", "5"], ["x", "3", "4"]]


@pytest.mark.evidence
def test_a_tenth_of_everything_agrees_with_what_is_stored(
    evidence: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """All measures but those that need other programs, and costs, which have no share to compare."""
    of_cost = {"unit_cost", "fleet", "fleet_large", "fleet_mixed"}
    names = [name for name in evidence.measures() if name not in {"peers", "real"} | of_cost]
    monkeypatch.setattr(sys, "argv", ["evidence.py", "run", *names, "--share", "0.1"])
    assert evidence.main() == 0, capsys.readouterr().out
