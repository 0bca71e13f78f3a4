"""One quantity has one value wherever it is stated, and no page contradicts itself."""

import copy
import re
from pathlib import Path
from typing import Any

import pytest
from unit_settings import settings_of

from pipeline.app.commands.explain import explain
from pipeline.core.files import write_json
from pipeline.core.records import SENSORS
from pipeline.core.verdicts import decided_words, error_in_row, error_of, problems, state_of
from pipeline.evaluation import diagnosis as diagnosis_package
from pipeline.evaluation.diagnosis.words import in_words
from pipeline.output import pages as report_package
from pipeline.output.history import errors_of, of_units, record, unit_state
from pipeline.output.outcome import all_well, changes_of, counted, problem_words
from pipeline.output.pages import campaign_page
from pipeline.output.pages.certificate import model_state
from pipeline.output.pages.chart import Figure
from pipeline.output.pages.fleet import runs_data, times_of, with_history
from pipeline.output.pages.group_charts import Point, bars
from pipeline.output.pages.pages import MARK
from pipeline.output.pages.parameters import summary_row
from pipeline.output.pages.residual_section import limit_rows
from pipeline.output.pages.unit_page import render

from .conftest import SHEET, Unit, build_unit
from .test_pages import Text

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def known() -> Unit:
    """Return a unit with a known attitude, whose magnitude and vector have different errors over different floors."""
    unit = build_unit()
    part = unit.validation["accelerometer"]
    part["noise_floor"], part["vector_noise_floor"] = 0.003, 0.005
    part["steps"][0] |= {"rms_error": 0.0689, "vector_rms_error": 0.1172}
    part["steps"][-1] |= {"rms_error": 0.0031, "vector_rms_error": 0.0265}
    return unit


def test_the_error_has_one_value_on_page_index_summary_and_terminal(known: Unit, tmp_path: Path) -> None:
    words = {s: in_words(known.diagnosis[s], s) for s in SENSORS}
    page = render(*known.arguments, words=words)
    card = page[page.index("<h2>Accelerometer</h2>") :]
    big = Text(card[: card.index("</p>")]).text
    assert " 26.5 mg error , 5.30 × noise ; 117 before" in big
    visible = re.sub(r'<details class="part".*', "", page, flags=re.DOTALL)
    findings = re.findall(r'<p class="finding">(.*?)</p>', visible)
    assert "The error of the vector ends at 26.5 mg, 5.30 × noise" in " ".join(findings)
    assert not re.search(r"\b3\.1\d* mg|0\.0031\b", Text(visible[visible.index("<main") :]).text)
    row = summary_row("U1", known.calibration, known.validation, known.diagnosis, {})
    assert error_in_row(row, "accelerometer") == error_of(known.validation["accelerometer"])
    assert row["accelerometer_error_after"] == 0.0031  # columns of summary.csv keep their meaning
    index = Text(campaign_page.render("bench", [row], [])).text
    assert " 117 26.5 5.00 5.30 " in index
    for kind, document in (("validations", known.validation), ("calibrations", known.calibration)):
        write_json(tmp_path / kind / "U1.json", document)
    told = explain(tmp_path, {"U1": known.diagnosis | {"unit": "U1"}}, {})
    assert "The error of the vector on held-out motion is 0.0265 g, 5.3 times the noise floor." in told
    assert "0.0031 g" not in told


def test_the_error_of_the_runs_is_the_one_of_page_and_index(known: Unit, tmp_path: Path) -> None:
    before = unit_state(known.calibration, known.validation, known.diagnosis, {})
    better = copy.deepcopy(known.validation)
    better["accelerometer"]["steps"][-1] |= {"rms_error": 0.003, "vector_rms_error": 0.0051}
    after = unit_state(known.calibration, better, known.diagnosis, {"effects.accelerometer": "[x]"})
    after["accelerometer"]["effects"] = ["quadratic_nonlinearity"]
    for state in (before, after):
        entries = record(tmp_path, {"U1": state}, {"campaign": "bench"})
    (line,) = changes_of(tmp_path, ["U1"])
    said = "held-out error of the vector 0.0265 -> 0.0051 g, 1.02 times the noise floor"
    assert line.startswith(f"U1, accelerometer: + quadratic_nonlinearity; {said}")
    page = with_history(MARK, of_units(entries)["U1"], times_of(entries))
    assert "the error of the vector falls from 0.0265 to 0.00510 g, 1.02 × the noise floor" in page
    (unit,) = (runs_data(entries, {}) or {})["units"]
    assert [state["accelerometer"][:2] for _, state in unit[1]] == [[0.0265, 0.005], [0.0051, 0.005]]
    of_version_before = copy.deepcopy(before)
    del of_version_before["accelerometer"]["vector_error"]
    kinds = [error.kind for error in errors_of([of_version_before, after], "accelerometer")]
    assert kinds == ["magnitude"] * 2


def test_the_figure_that_decided_a_verdict_is_the_one_that_is_said(known: Unit, tmp_path: Path) -> None:
    found = copy.deepcopy(known.diagnosis)
    found["gyroscope"] |= {"verdict": "unexplained", "selected": [], "residual_over_noise": 0.79}
    found["gyroscope"] |= {"decided_by": decided_words("scatter", 7.21), "unexplained": [], "suggested_effect": None}
    words = {s: in_words(found[s], s) for s in SENSORS}
    said = "No plausible effect of the catalogue explains the scatter of the moves of the gyroscope, 7.21 x noise."
    assert words["gyroscope"][0] == said
    page = Text(render(known.calibration, known.validation, found, [], known.settings, words=words)).text
    assert said.replace(" x ", " × ") in page
    row = summary_row("U1", known.calibration, known.validation, found, {}) | {"accelerometer_verdict": ""}
    assert row["gyroscope_decided_by"] == "scatter of the moves, 7.21 x noise"
    index = Text(campaign_page.render("bench", [row], [])).text
    assert "scatter of the moves, 7.21 × noise" in index
    write_json(tmp_path / "validations" / "U1.json", known.validation)
    assert said in explain(tmp_path, {"U1": found | {"unit": "U1"}}, {})
    (problem, *_) = problems([row, row | {"unit": "U2", "gyroscope_decided_by": decided_words("scatter", 9.0)}])
    assert problem_words(problem).endswith("gyroscope; scatter of the moves, 7.21 to 9 x noise")
    said_there = model_state(known.validation["gyroscope"], found["gyroscope"])["sentence"]
    assert "scatter of the moves, 7.21 x noise" in said_there
    (problem, *_) = problems([row | {"gyroscope_decided_by": decided_words("held_out")}])
    assert re.search(r"; held-out error \S+ x noise$", problem_words(problem))


@pytest.mark.parametrize(
    ("decided", "said"),
    [
        (("evidence", 57.3, "warm up, bias drift and hysteresis"), "hysteresis of the gyroscope, delta BIC 57."),
        (("dependence", None, "time, temperature and rate"), "on time, temperature and rate of the gyroscope."),
        (("held_out",), "the held-out error of the gyroscope."),
    ],
)
def test_what_is_not_explained_is_said_with_its_size(known: Unit, decided: tuple[Any, ...], said: str) -> None:
    found = known.diagnosis["gyroscope"] | {"verdict": "unexplained", "decided_by": decided_words(*decided)}
    first = in_words(found, "gyroscope")[0]
    assert first.startswith("No plausible effect of the catalogue explains the")
    assert first.endswith(said)


def test_by_hand_the_angle_after_moves_is_said_first_with_how_many_judge_it(known: Unit, tmp_path: Path) -> None:
    validation, settings = copy.deepcopy(known.validation), settings_of(known.settings, table="hand")
    angles = {"mean_deg": {"before": 1.31, "after": 0.813}, "rms_deg": {"before": 1.6, "after": 0.955}}
    moves = {"reason": None, "moves": 2, **angles, "max_deg": {"before": 2.2, "after": 1.3}, "noise_floor_deg": 0.063}
    validation["gravity_direction"] = {**moves, "creeping_rests": 0, "largest_expected_rms_deg": 3.9}
    validation["gyroscope"] |= {"samples": 1, "held_out": True}
    found = copy.deepcopy(known.diagnosis)
    found["gyroscope"] |= {"verdict": "nothing_missing", "selected": [], "unexplained": [], "reason": ""}
    words = {s: in_words(found[s], s) for s in SENSORS}
    page = render(known.calibration, validation, found, [], settings, words=words)
    card = Text(page[page.index("<h2>Gyroscope</h2>") :]).text
    assert card.index("0.813 deg mean error after held-out moves, 12.9 × noise") < card.index("At rest")
    assert "Judged by 1 held-out rest and 2 held-out moves." in card
    assert "does not show that the calibration is good" in card
    row = summary_row("U1", known.calibration, validation, found, {})
    (far,) = [p for p in problems([row]) if p.kind == "far_above_noise" and "gyroscope" in p.what]
    assert problem_words(far).endswith("angle after held-out moves, 12.9 x noise")
    write_json(tmp_path / "validations" / "U1.json", validation)
    told = explain(tmp_path, {"U1": found | {"unit": "U1"}}, {})
    assert "Judged by 1 held-out rest." in told
    assert "The mean angle is 12.9 times that by noise alone" in told


def test_the_terminal_names_a_unit_once_and_an_action(known: Unit) -> None:
    row = summary_row("U1", known.calibration, known.validation, known.diagnosis, {})
    row |= {"accelerometer_verdict": "not_enough_data", "gyroscope_verdict": "unexplained", "pass": "False"}
    assert len(problems([row])) == 4
    assert [(p.kind, p.units) for p in problems([row], once=True)] == [("unexplained", ["U1"])]


def test_figures_of_the_readme_agree() -> None:
    readme = " ".join((ROOT / "README.md").read_text().split())
    stated = re.findall(r"(\d[\d.]*) deg/s, (\d[\d.]*) times the noise floor\b", readme)
    ((before, after),) = re.findall(r"error of the vector (\S+) -> (\S+) deg/s", readme)
    assert {stated[0], stated[1]} == {(before, stated[0][1])}
    assert stated[2][0] == after


def test_units_are_counted_once_by_their_most_urgent_problem() -> None:
    of_unit = {
        "status": "ok",
        "serial": "S",
        "accelerometer_verdict": "nothing_missing",
        "gyroscope_verdict": "nothing_missing",
    }
    missing = {"gyroscope_verdict": "missing_effect", "gyroscope_selected": "g_sensitivity"}
    far = {"gyroscope_error_after": 0.4, "gyroscope_noise_floor": 0.1}
    rows: list[dict[str, Any]] = [
        of_unit | {"unit": "a"},
        of_unit | {"unit": "b", "accelerometer_verdict": "unexplained"} | missing,
        of_unit | {"unit": "c"} | far,
        of_unit | {"unit": "d", "pass": "False"},
        of_unit | {"unit": "e", "incomplete": "diagnose/gyroscope: x", "gyroscope_verdict": "not_enough_data"},
        {"unit": "f", "serial": "S", "status": "failed"},
    ]
    kinds = [next(iter(state_of(row).kinds), "ready") for row in rows]
    assert kinds == ["ready", "missing_effect", "far_above_noise", "beyond_acceptance", "incomplete", "failed"]
    found = {p.kind: (p.what, p.units) for p in problems(rows)}
    assert found["missing_effect"] == ("gyroscope: g sensitivity", ["b"])
    assert found["unexplained"] == ("accelerometer", ["b"])
    assert "not_enough_data" not in found
    assert counted(rows).startswith("6 units: 1 ready, 1 not complete, 1 effect missing, 1 far above noise")
    page = campaign_page.render("bench", rows, [])
    assert [int(n) for n in re.findall(r"<b>(\d+)</b> [a-z ]+</abbr>", page)] == [1, 1, 1, 1, 1, 1]


def test_a_campaign_whose_units_are_ready_says_so() -> None:
    row = {"unit": "U1", "serial": "S", "status": "ok", "accelerometer_verdict": "nothing_missing"}
    row |= {"accelerometer_error_after": 0.0103, "accelerometer_noise_floor": 0.01}
    said = "All 2 units are ready: nothing that the recordings can show is missing, and the held-out error is"
    assert f"{said} at most 1.03 × noise." in Text(campaign_page.render("bench", [row, row | {"unit": "U2"}], [])).text
    moved = row | {"unit": "U2", "gyroscope_verdict": "nothing_missing", "gyroscope_moves_over_noise": 1.71}
    assert all_well([row, moved]) == f"{said} at most 1.71 x noise."
    assert f"{said} at most 1.71 × noise." in Text(campaign_page.render("bench", [row, moved], [])).text


def test_a_unit_far_above_noise_by_its_moves_is_said_to_be_so_in_one_way() -> None:
    row = {"unit": "U1", "serial": "S", "status": "ok", "gyroscope_verdict": "nothing_missing"}
    row |= {"gyroscope_error_before": 1.0, "gyroscope_error_after": 0.0131, "gyroscope_noise_floor": 0.01}
    page = campaign_page.render("bench", [row | {"gyroscope_moves_over_noise": 12.9}], [])
    text = Text(page).text
    assert "Gyroscope: 1 of 1 units far above noise; angle after held-out moves, 12.9 × noise in U1" in text
    assert "above 3 × noise;" not in text
    other = row | {"unit": "U2", "gyroscope_error_after": 0.04}
    (problem,) = problems([row | {"gyroscope_moves_over_noise": 12.9}, other])
    assert problem_words(problem) == "far above noise: 2 units: U1, U2; gyroscope; 4 to 12.9 x noise"
    for far, shown in ((True, page), (False, campaign_page.render("bench", [row], []))):
        (of_unit,) = re.findall(r'<tr><th scope="row">[^\n]*U1.*?</tr>', shown.partition('id="all"')[2], re.DOTALL)
        assert ("nothing missing" in of_unit, "good-text" in of_unit) == (not far, not far)
        assert of_unit.count("far above noise") == 2 * far  # state, and verdict of the gyroscope


def test_every_problem_has_a_next_step_and_a_command(known: Unit) -> None:
    row = summary_row("U1", known.calibration, known.validation, known.diagnosis, {})
    for verdict in ("reference_in_doubt", "unexplained", "floor_in_doubt", "left_by_method", "not_enough_data"):
        for step in ("", "calibrate with a method (method=reference_least_squares) and no filter (filter=none)"):
            given = row | {"accelerometer_verdict": verdict, "accelerometer_next_step": step, "gyroscope_verdict": None}
            page = campaign_page.render("bench", [given], [])
            lines = re.findall(r'<tr><th scope="row" class="\w+-text"><abbr.*?</tr>', page, re.DOTALL)
            assert lines
            assert all(len(Text(line).text.split()) > 8 and "<pre" in line for line in lines)
            if step:
                assert "[method=reference_least_squares, filter=none]" in Text(page).text


@pytest.mark.parametrize(("units", "named"), [(40, True), (41, False)])
def test_up_to_40_units_have_a_row_of_their_own_in_the_overview(units: int, *, named: bool) -> None:
    rows: list[dict[str, Any]] = [
        {"unit": f"U{i:02}", "status": "ok", "gyroscope_verdict": "nothing_missing" if i else "unexplained",
         "gyroscope_error_before": 1.0, "gyroscope_error_after": 0.01 * (units - i), "gyroscope_noise_floor": 0.1}
        for i in range(units)
    ]  # fmt: skip
    drawn = campaign_page.overview_chart("gyroscope", rows)
    assert drawn is not None
    figure, _ = drawn
    far = sum(0.1 * (units - i) > 3.0 for i in range(units))
    assert figure.finding.startswith(f"Gyroscope: {far} of {units} units above 3 × noise; {0.1 * units:.2f} × in U00")
    rows_of_names = re.findall(r">(U\d\d)</text>", figure.svg)
    assert rows_of_names == ([f"U{i:02}" for i in reversed(range(units))] if named else [])
    assert ("units" in (re.search(r"data-scale=\"[^\"]*,(\w+)\"", figure.svg.split("panel")[1]) or [""])[0]) != named


def test_nothing_to_distinguish_is_proposed_beside_an_experiment_that_is_not_needed() -> None:
    part = {"verdict": "nothing_missing", "residual_over_noise": 1.0, "selected": [], "ranking": [], "unexplained": [],
            "not_observable": [], "answer_set": [{"effects": [], "probability": 0.93}],
            "to_distinguish": "nothing (0.93) from bias drift (0.01): return to the first pose"}  # fmt: skip
    none = "none is needed: nothing that these recordings can show is missing"
    assert not [w for w in in_words(part | {"next_experiment": none}, "gyroscope") if w.startswith("To distinguish")]
    assert [w for w in in_words(part | {"next_experiment": "x"}, "gyroscope") if w.startswith("To distinguish")]


@pytest.mark.parametrize(("p", "said"), [(1e-115, "p < 1e-12"), (0.0, "p < 1e-12"), (2.3e-7, "p = 2.3e-07")])
def test_a_small_p_value_is_a_bound_on_page_and_terminal(known: Unit, p: float, said: str) -> None:
    diagnosis = copy.deepcopy(known.diagnosis)
    diagnosis["gyroscope"] |= {"unexplained": [{"covariate": "time", "p_value": p}], "selected": []}
    words = {s: in_words(diagnosis[s], s) for s in SENSORS}
    assert f"depends on time ({said})" in " ".join(words["gyroscope"])
    page = Text(render(known.calibration, known.validation, diagnosis, [], known.settings, words=words)).text
    shown = re.findall(r"time \((p [=<] [^)]+)\)", page)
    assert len(set(shown)) == 1


def test_an_effect_of_the_answer_set_is_not_excluded(known: Unit) -> None:
    limit = SHEET["effects"]["quadratic_nonlinearity"]
    found = {"upper_limit": {"quadratic_nonlinearity": {"K2_x": {"value": 0.1 * limit, "unit": "1/g"}}}}
    sheet = known.settings.sensor.accelerometer
    for effects, excluded in (([], True), (["quadratic_nonlinearity"], False)):
        answers = [{"effects": [], "probability": 0.9}, {"effects": effects, "probability": 0.06}]
        (row,) = limit_rows("accelerometer", found | {"answer_set": answers}, sheet)
        assert row["excluded"] is excluded


def test_the_label_of_a_tick_is_at_its_line() -> None:
    figure = bars(
        Figure("n", "f"), [Point("a", 30.0), Point("b", 4.0)], "delta BIC", levels={"10": 10.0}, kind="symlog"
    )
    lines = [float(x) for x in re.findall(r"M([\d.]+) \d+v14", re.findall(r'class="grid" d="([^"]*)"', figure.svg)[0])]
    (label,) = re.findall(r'<text x="([\d.]+)" y="[\d.]+" class="m">0</text>', figure.svg)
    assert float(label) in lines


def test_values_on_a_logarithmic_axis_are_dots() -> None:
    drawn = [bars(Figure("n", "f"), [Point("a", 30.0)], "error", kind=kind).svg for kind in ("log", "symlog")]
    assert ["mean-dot" in svg for svg in drawn] == [True, False]
    assert ['class="bar' in svg for svg in drawn] == [False, True]


def test_no_sentence_of_a_page_is_written_in_markdown() -> None:
    folders = [Path(module.__file__ or "").parent / "templates" for module in (diagnosis_package, report_package)]
    texts = [file.read_text(encoding="utf-8") for folder in folders for file in folder.glob("*.txt")]
    assert len(texts) >= 4
    assert not [mark for text in texts for mark in re.findall(r"`[^`]+`|\*\*[^*]+\*\*|\]\(", text)]
