"""``pipeline.load_campaign``: the tables hold what the files hold, and the notebook of the docs runs."""

from __future__ import annotations

import ast
import json
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

import pipeline
from pipeline.core.errors import InputError, MissingInputError
from pipeline.core.records import Recording
from pipeline.estimation.noise_identification import identify_noise
from pipeline.output.outcome import read_summary
from pipeline.output.pages.fleet import write_summary
from pipeline.output.pages.parameters import summary_row

from .conftest import Unit, build_unit

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def unit() -> Unit:
    return build_unit()


@pytest.fixture(scope="module")
def results(unit: Unit, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Publish a campaign of one calibrated and one failed unit."""
    folder = tmp_path_factory.mktemp("bench") / "results" / "demo"
    error = {"code": "bad_input", "message": "'x' is no number", "file": "a.csv:3"}
    failed = {"unit": "007", "status": "failed", "error": error, "accelerometer": None, "gyroscope": None}
    for name, document in (
        ("calibrations/U1", unit.calibration), ("validations/U1", unit.validation), ("diagnoses/U1", unit.diagnosis),
        ("calibrations/007", failed),
    ):  # fmt: skip
        (folder / f"{name}.json").parent.mkdir(parents=True, exist_ok=True)
        (folder / f"{name}.json").write_text(json.dumps(document))
    rows = [summary_row("U1", *unit.arguments[:3], {"date": "2026-01-01", "colour": "red"})]
    write_summary(folder / "summary.csv", [*rows, summary_row("007", failed, None, None, {})])
    return folder


def test_each_table_holds_the_values_of_the_files(unit: Unit, results: Path) -> None:
    campaign = pipeline.load_campaign(results)
    assert repr(campaign) == "<campaign demo: 2 units, 1 failed>"
    assert campaign.units == ["U1", "007"]  # a name of digits stays text
    assert campaign.summary["pass"].tolist() == [False, False]
    parameters = campaign.parameters.set_index(["unit", "sensor", "parameter"])
    bias = parameters.loc["U1", "gyroscope", "bias_x"]
    part = unit.calibration["gyroscope"]
    assert (bias["value"], bias["value_unit"]) == (part["bias"][0], "deg/s")
    assert bias["expanded_uncertainty"] == part["expanded_uncertainty"]["bias"][0]
    assert bias["coverage_factor"] == part["coverage_factor"]["bias"][0]
    errors = campaign.errors.query("sensor == 'accelerometer'")
    assert errors["step"].tolist() == [s["name"] for s in unit.validation["accelerometer"]["steps"]]
    assert set(errors["unit"]) == {"U1"}
    assert errors["rms_error"].tolist() == [s["rms_error"] for s in unit.validation["accelerometer"]["steps"]]
    verdicts = campaign.diagnosis.set_index("sensor")["verdict"]
    assert verdicts.to_dict() == {s: part["verdict"] for s, part in unit.diagnosis.items()}
    assert campaign.effects.query("selected")["effect"].tolist() == ["quadratic_nonlinearity"]


def test_no_cell_of_the_summary_is_a_formula_and_each_is_read_as_it_was(unit: Unit, tmp_path: Path) -> None:
    """LibreOffice and Excel run =cmd|'/C calc'!A0 and DDE links; a negative number stays one."""
    texts = [
        "=cmd|'/C calc'!A0",
        "+1+1",
        "@SUM(A1)",
        "\t=1",
        "-2+3",
        "-b",
        "'=quoted",
        "''@twice",
        "'plain",
        "\uff1dwide",
    ]
    kept = ["-5", "+4.5e-3", "-.5", "L-1", "a=b", "7"]
    folder, given = tmp_path / "demo", [*texts, *kept]
    sheets = [{"serial": s, "lot": s, "depth": str(-1.5 * i), "=head": s} for i, s in enumerate(given)]
    write_summary(
        folder / "summary.csv", [summary_row(f"U{i}", *unit.arguments[:3], row) for i, row in enumerate(sheets)]
    )
    raw = pd.read_csv(folder / "summary.csv", dtype=str, keep_default_na=False)
    starts = [cell for column in raw for cell in (column, *raw[column]) if cell[:1] in {*"=+-@\t\r\n\uff1d"} - {""}]
    assert {cell for cell in starts if not cell.replace("e-3", "").lstrip("+-").replace(".", "").isdigit()} == set()
    assert raw["serial"].tolist()[len(texts) :] == kept
    campaign, rows = pipeline.load_campaign(folder), read_summary(folder)
    for column in ("serial", "lot", "=head"):
        assert campaign.summary[column].tolist() == given
        assert [row[column] for row in rows] == given
    assert campaign.summary["depth"].tolist() == [-1.5 * i for i in range(len(given))]


def test_the_table_of_the_noise_has_a_row_for_each_term(unit: Unit, results: Path, tmp_path: Path) -> None:
    readings = np.random.default_rng(1).normal(0.0, 0.01, (500, 3))
    rest = Recording("static", "static", None, np.arange(500) * 10_000_000, accelerometer=readings)
    noise = identify_noise([rest])
    shutil.copytree(results, tmp_path / "demo")
    (tmp_path / "demo" / "calibrations" / "U1.json").write_text(json.dumps(unit.calibration | {"noise": noise}))
    table = pipeline.load_campaign(tmp_path / "demo").noise
    assert set(table["sensor"]) == {"accelerometer"}
    rows = table.set_index(["axis", "term"])
    terms = noise["accelerometer"]["axes"]["y"]["terms"]
    white = rows.loc["y", "white"]
    assert [white["value"], white["low"], white["high"]] == [terms["white"]["value"], *terms["white"]["interval"]]
    assert white["value_unit"] == "g/sqrt(Hz)"
    assert rows.loc["y", "random_walk"]["upper_limit"] == terms["random_walk"]["upper_limit"]
    assert "too short" in rows.loc["y", "random_walk"]["reason"]


def test_one_unit_is_its_documents_and_a_failed_one_names_its_cause(unit: Unit, results: Path) -> None:
    campaign = pipeline.load_campaign(str(results))
    assert campaign.unit("U1").diagnosis == unit.diagnosis
    assert repr(campaign.unit("U1")) == "<unit U1: accelerometer missing_effect, gyroscope nothing_missing>"
    assert campaign.unit("007").validation is None
    assert repr(campaign.unit("007")) == "<unit 007: failed, bad_input: 'x' is no number>"


def test_what_does_not_exist_is_refused_with_what_does(results: Path) -> None:
    with pytest.raises(MissingInputError, match=r"dem: .*there are .*results/demo"):
        pipeline.load_campaign(results.with_name("dem"))
    with pytest.raises(InputError, match="'U2'; there are U1"):
        pipeline.load_campaign(results).unit("U2")


def run_cell(source: str, names: dict[str, Any]) -> Any:
    """Execute a cell as a notebook does and return the value of its last expression."""
    body = ast.parse(source).body
    last = body.pop() if isinstance(body[-1], ast.Expr) else None
    exec(compile(ast.Module(body, []), "cell", "exec"), names)  # noqa: S102  (our own notebook)
    return eval(compile(ast.Expression(last.value), "cell", "eval"), names) if last else None  # noqa: S307


def test_the_notebook_runs_and_gives_what_it_shows(results: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the runs' results, which are others here, it shows the columns."""
    work = results.parents[1]
    for name in ("configs", "data"):
        (work / name).symlink_to(ROOT / name)
    monkeypatch.chdir(work)
    drawn: list[Any] = []
    for name, attributes in {
        "plots": {"plot": lambda data, **how: drawn.append((how["kind"], len(data)))},
        "IPython": {},
        "IPython.display": {"IFrame": lambda page, **_: drawn.append(Path(page).read_text(encoding="utf-8"))},
    }.items():
        monkeypatch.setitem(sys.modules, name, SimpleNamespace(__name__=name, __spec__=None, **attributes))
    names: dict[str, Any] = {}
    cells = json.loads((ROOT / "docs" / "notebook.ipynb").read_text())["cells"]
    frames = shown = 0
    for cell in (c for c in cells if c["cell_type"] == "code"):
        with pd.option_context("plotting.backend", "plots"):
            value = run_cell("".join(cell["source"]), names)
        text = "".join(cell["outputs"][0]["data"]["text/plain"]) if cell["outputs"] else ""
        if isinstance(value, pd.DataFrame):
            assert all(str(column) in text for column in value.columns)
            assert len(value) > 0
            frames += 1
        elif "results" not in names and text:
            assert repr(value) == text
            shown += 1
    assert (frames, shown) == (6, 2)
    (kind, points), page = drawn
    assert (kind, points) == ("scatter", len(names["log"]))
    assert "<svg" in page
    assert str(names["results"]) == "<campaign demo: 2 units, 1 failed>"
