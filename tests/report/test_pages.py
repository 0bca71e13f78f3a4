"""The pages: complete in themselves, true to the figures they are given, and safe against what users write."""

import base64
import copy
import csv
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.app.commands.explain import explain
from pipeline.app.steps.calibration import judged
from pipeline.core.files import write_json
from pipeline.core.settings import Certificate, Stated
from pipeline.core.verdicts import problems, state_of
from pipeline.output.outcome import counted, outcome, problem_words, read_summary
from pipeline.output.pages import campaign_page
from pipeline.output.pages.certificate import certificate, certificate_page
from pipeline.output.pages.chart import Figure, Panel, SampleMarks, chart
from pipeline.output.pages.fleet import parameter_table, write_summary
from pipeline.output.pages.parameters import SUMMARY_COLUMNS, summary_row, unit_parameters
from pipeline.output.pages.unit_page import render
from pipeline.simulation.description import shipped_settings

from .conftest import SHEET, Unit, build_unit

VOID = {
    "meta",
    "link",
    "br",
    "hr",
    "input",
    "img",
    "col",
    "path",
    "line",
    "rect",
    "circle",
    "polyline",
    "polygon",
    "use",
}


class Text(HTMLParser):
    """Collects headings, links and the text of a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.tags: list[str] = []
        self.words: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.links += [v or "" for k, v in attrs if k in ("href", "src")]

    def handle_data(self, data: str) -> None:
        self.words.append(data)

    @property
    def text(self) -> str:
        return re.sub(r"\s+", " ", " ".join(self.words))


@pytest.fixture(scope="module")
def unit() -> Unit:
    return build_unit()


@pytest.fixture(scope="module")
def page(unit: Unit) -> str:
    return render(*unit.arguments, words={"accelerometer": ["Quadratic nonlinearity is missing."], "gyroscope": []})


def test_the_unit_page_asks_no_other_host_for_anything(page: str) -> None:
    assert not re.search(r"""(?:src|href)=["']?https?:|url\(["']?https?:|@import""", page)
    assert not [link for link in Text(page).links if "//" in link]
    assert len(page.encode()) < 1_500_000


def test_the_unit_page_says_the_figures_it_was_given(page: str) -> None:
    text = Text(page).text
    for expected in (
        "5.27 mg error , 1.01 × noise ; 117 before",
        "Quadratic nonlinearity is missing.",
        "effects.accelerometer=[quadratic_nonlinearity]",
        "the table turned too slowly",
        "temperature (p = ",
        "N-GAP",
        "cdcdcd",
    ):
        assert expected in text


def test_every_picture_has_a_text_alternative(page: str) -> None:
    pictures = re.findall(r"<svg.*?</svg>", page, re.DOTALL)
    assert len(pictures) >= 10
    assert all(re.search(r"<title[ >]", p) and re.search(r"<desc[ >]", p) for p in pictures)


def test_what_users_write_is_escaped(unit: Unit) -> None:
    hostile = "<script>alert(1)</script>"
    table = unit.settings.table.replaced(name=hostile)
    settings = unit.settings.replaced(table=table, stated=Stated(row={"note": hostile}))
    calibration = unit.calibration | {"unit": hostile, "software": {hostile: "1"}}
    page = render(calibration, unit.validation, unit.diagnosis, unit.recordings, settings)
    assert hostile not in page
    failed = calibration | {"status": "failed", "error": {"code": "bad_input", "message": hostile, "file": hostile}}
    assert hostile not in render(failed, None, None, [], settings)
    assert hostile not in campaign_page.render(hostile, [], [{"unit": hostile, "message": hostile, "code": "x"}])


def test_a_failed_unit_gets_a_page_that_says_what_and_where(unit: Unit) -> None:
    error = {"code": "bad_input", "message": "'x' is no number", "file": "raw/U1/gyro_y.csv:41", "stage": "ingest"}
    failed = unit.calibration | {"status": "failed", "error": error, "accelerometer": None, "gyroscope": None}
    text = Text(render(failed, None, None, [], unit.settings)).text
    assert "This unit has no result" in text
    assert "gyro_y.csv:41" in text
    assert "'x' is no number" in text


def test_a_sensor_that_was_not_calibrated_is_named_with_the_reason(unit: Unit) -> None:
    calibration = unit.calibration | {"gyroscope": None, "not_calibrated": {"gyroscope": "no turns were recorded"}}
    page = render(calibration, unit.validation | {"gyroscope": None}, None, unit.recordings, unit.settings)
    assert "Not calibrated: no turns were recorded" in Text(page).text


def test_settings_that_state_a_mounting_by_gravity_stand_once_on_the_page(unit: Unit) -> None:
    way = ["table.sense=-1", "table.zero_deg=37.00"]
    detail = f"mounted otherwise than stated; if the bench is so, set {', '.join(way)}; used as found, body +z up"
    note = {"code": "N-FOUND", "count": 9, "first": 0, "last": 0, "detail": detail, "settings": [way]}
    inputs = [
        i | {"recording": name, "notes": [note]} for name, i in zip("ab", unit.calibration["inputs"], strict=False)
    ]
    page = render(unit.calibration | {"inputs": inputs}, None, None, [], unit.settings)
    assert "<code>overrides:\n  - table.sense=-1\n  - table.zero_deg=37.00\n</code>" in page
    text = Text(page).text
    assert text.count("table.zero_deg=37.00") == 1
    assert text.count("used as found, body +z up") == 2
    assert "Gravity shows another mounting than stated in a, b, and it is used as found" in text


def test_rests_that_were_left_out_are_listed_with_the_reason(unit: Unit) -> None:
    part = dict(unit.calibration["accelerometer"])
    rest = {"recording": "recording", "time_s": 47.52, "duration_s": 3.08, "reason": "it turned by 2.1 deg"}
    stages = [{**part["stages"][0], "details": {"rests_used": [rest | {"reason": ""}], "rests_left_out": [rest]}}]
    calibration = unit.calibration | {"accelerometer": part | {"stages": stages}}
    page = render(calibration, unit.validation, unit.diagnosis, [], unit.settings)
    assert "47.52 3.08 left out it turned by 2.1 deg" in Text(page).text


def rows(unit: Unit, n: int) -> list[dict[str, Any]]:
    sheet = {"serial": "S1", "lot": "L", "date": "2026-01-01", "colour": "red"}
    made = summary_row("U", unit.calibration, unit.validation, unit.diagnosis, sheet)
    return [made | {"unit": f"U{i}", "serial": f"S{i // 2}"} for i in range(n)]


def test_the_summary_has_the_columns_that_scripts_rely_on(unit: Unit, tmp_path: Path) -> None:
    write_summary(tmp_path / "summary.csv", rows(unit, 2))
    read = list(csv.DictReader((tmp_path / "summary.csv").read_text().splitlines()))
    assert tuple(read[0])[:8] == ("unit", "serial", "lot", "date", "status", "error", "sensor", "method")
    assert tuple(read[0]) == (*SUMMARY_COLUMNS, "colour")
    assert float(read[1]["accelerometer_error_after"]) == 0.0031
    assert read[1]["gyroscope_verdict"] == unit.diagnosis["gyroscope"]["verdict"]
    assert read[1]["colour"] == "red"


def test_the_campaign_page_names_failures_and_compares_units_of_one_serial(unit: Unit) -> None:
    failure = {"unit": "U9", "stage": "ingest", "code": "bad_input", "message": "no number", "file": "a.csv:3"}
    page = campaign_page.render("bench", rows(unit, 4), [failure])
    text = Text(page).text
    for expected in ("1 unit failed", "no number", "a.csv:3", "Serial S0", "kept in summary.csv: colour"):
        assert expected in text
    assert not [link for link in Text(page).links if "//" in link]


def test_what_the_limit_of_the_sensor_file_determines_alone_is_said(unit: Unit) -> None:
    convergence = {"cosine": 1e-9, "condition": 11.0, "rank": 8, "parameters": 9}
    lack = {"not_determined": "the rests do not determine misalignment_yx", "convergence": convergence}
    calibration = unit.calibration | {"accelerometer": {**unit.calibration["accelerometer"], **lack}}
    text = Text(render(calibration, unit.validation, unit.diagnosis, [], unit.settings)).text
    assert "Uncertainty: the rests do not determine misalignment_yx." in text
    assert "determine 8 of 9 parameters, the limit of the sensor file the others" in text


def test_parameters_beyond_the_data_sheet_are_shown_on_both_pages_and_in_the_summary(unit: Unit) -> None:
    entry = {"parameter": "scale_factor_x", "value": -0.5, "unit": "1", "limit": 0.03, "ratio": 16.7}
    entries = [{**entry, "likely_cause": "readings 0.5 times the truth"}]
    calibration = unit.calibration | {"gyroscope": {**unit.calibration["gyroscope"], "implausible": entries}}
    text = Text(render(calibration, unit.validation, unit.diagnosis, [], unit.settings)).text
    assert "Implausible for this model of gyroscope: scale factor x; scale factor x is -0.5, 16.7 times" in text
    assert "sensor.gyroscope.accept_implausible=true" in text
    row = summary_row("U", calibration, unit.validation, unit.diagnosis, {})
    assert (row["accelerometer_implausible"], row["gyroscope_implausible"]) == (None, "scale_factor_x")
    page = Text(campaign_page.render("bench", [row], []))
    assert "1 sensor with implausible parameters" in page.text
    assert "U , gyroscope: scale factor x" in page.text
    assert "outside the data sheet's limits" not in Text(campaign_page.render("bench", rows(unit, 2), [])).text


def test_a_fit_that_did_not_converge_and_one_that_is_worse_than_the_readings_are_not_ready(unit: Unit) -> None:
    stopped = unit.calibration | {"gyroscope": {**unit.calibration["gyroscope"], "converged": False}}
    row = summary_row("U", stopped, unit.validation, unit.diagnosis, {})
    assert "The fit did not converge" in Text(render(stopped, unit.validation, unit.diagnosis, [], unit.settings)).text
    assert (next(iter(state_of(row).kinds)), row["accelerometer_not_converged"]) == ("not_converged", None)
    assert counted([row]) == "1 unit: 0 ready, 1 not converged, 0 failed"
    reason = "the held-out error is 2.1 times that of the raw readings"
    harmful = unit.validation | {"gyroscope": {**unit.validation["gyroscope"], "worse_than_raw": reason}}
    absent = unit.calibration | {"gyroscope": None, "not_calibrated": {"gyroscope": reason}}
    row = summary_row("U", absent, harmful, unit.diagnosis, {})
    assert (next(iter(state_of(row).kinds)), row["gyroscope_worse_than_raw"]) == ("worse_than_raw", reason)
    assert "worse than raw: U; gyroscope" in problem_words(problems([row])[0])


def test_every_place_counts_the_same_units_beyond_the_sensor_files_limits(unit: Unit, tmp_path: Path) -> None:
    """Two of four units: one by its bias, one by a cross-axis sensitivity; one is turned on the table, one is sound."""
    sheet = unit.settings.sensor.accelerometer.replaced(bias=0.1, scale_factor=0.1, cross_axis=0.02)
    sensor = unit.settings.sensor.replaced(accelerometer=sheet)
    settings = unit.settings.replaced(sensor=sensor, certificate=Certificate(name="blank"))
    turned = np.array([[0.995, -0.0998749, 0.0], [0.0998749, 0.995, 0.0], [0.0, 0.0, 1.0]])
    skew = np.eye(3) + 0.06 * (np.eye(3)[[1, 0, 2]] - np.diag([0.0, 0.0, 1.0]))
    given = {"turned": (0.0, turned), "biased": (-0.25, np.eye(3)), "sound": (0.0, np.eye(3)), "skew": (0.0, skew)}
    folder, found, counted = tmp_path / "bench", {}, ["biased", "skew"]
    for name, (bias, matrix) in given.items():
        fit = {**unit.calibration["accelerometer"], "bias": [0.0, bias, 0.0], "matrix": matrix.tolist()}
        document = {**unit.calibration, "unit": name, "accelerometer": judged("accelerometer", fit, sheet)}
        found[name] = document
        for kind, of in (("calibrations", document), ("diagnoses", unit.diagnosis), ("validations", unit.validation)):
            write_json(folder / kind / f"{name}.json", {**of, "unit": name})
    words = {"biased": "bias y (250 %)", "skew": "cross axis xy (301 %)"}
    summaries = [summary_row(name, c, unit.validation, unit.diagnosis, {}) for name, c in found.items()]
    write_summary(folder / "summary.csv", summaries)
    read = read_summary(folder)
    assert [row["unit"] for row in read if row["accelerometer_beyond_limits"]] == counted
    fitted = parameter_table({name: unit_parameters(c, sensor) for name, c in found.items()})
    index = Text(campaign_page.render("bench", summaries, [], parameters=fitted)).text
    assert "Outside the data sheet's limits : accelerometer of 2 units ( biased , skew )" in index
    (chart_of_units, _), _ = campaign_page.strips(summaries, fitted)
    assert "2 of 4 units are outside the data sheet's limits; farthest: skew" in chart_of_units.finding
    told = outcome(folder, {}, of_this_run=False)
    assert "accelerometer, a parameter outside the data sheet's limits: biased, skew\n" in told
    for name, document in found.items():
        page = Text(render(document, unit.validation, unit.diagnosis, [], settings)).text
        report = certificate(document, unit.validation, settings, None)
        explained = explain(folder, {name: unit.diagnosis | {"unit": name}}, {})
        if name in counted:
            assert f"Outside the data sheet's limits : {words[name]}." in page.partition(": why")[0]
            assert page.count("outside it") == 1
            assert f"Accelerometer, outside the data sheet's limits: {words[name]}." in explained
            assert len(report["measurementResults"][0]["beyondLimits"]) == 1
            assert "Outside the data sheet's limits" in Text(certificate_page(name, report)).text
        else:
            assert "utside the data sheet's limits" not in page + explained + certificate_page(name, report)
            assert "outside it" not in page


def test_a_page_states_one_uncertainty_of_a_parameter(unit: Unit) -> None:
    of_stage = {"bias_x": {"value": 0.0431, "unit": "g", "standard_uncertainty": 0.0007}}
    stages = [{"name": "reference_least_squares", "parameters": of_stage, "residual_rms": 0.003}]
    part = {**unit.calibration["accelerometer"], "stages": stages}
    text = Text(render({**unit.calibration, "accelerometer": part}, *unit.arguments[1:])).text
    assert "bias_x = 0.043100 g" in text
    assert "bias_x = 0.0431 ±" not in text


def test_a_row_of_a_large_campaign_is_small(unit: Unit) -> None:
    size = {n: len(campaign_page.render("bench", rows(unit, n), [])) for n in (100, 200)}
    assert (size[200] - size[100]) / 100 < 1500


def test_a_chart_keeps_the_extremes_of_what_it_thins_out() -> None:
    x = np.arange(100_000.0)
    y = np.sin(x / 50)
    with_spike = np.where(x == 54_321, 7.0, y)
    drawn = [
        chart(Figure("n", "title"), "words", [Panel([SampleMarks(x, v, 0)], "y", height=100, limits=(-8, 8))], "x").svg
        for v in (y, with_spike)
    ]
    full = [re.findall(r' data-full="([^"]*)"', svg) for svg in drawn]
    assert max(len(svg) - sum(map(len, found)) for svg, found in zip(drawn, full, strict=True)) < 10_000
    samples = [np.frombuffer(base64.b64decode(found[1]), "<i2") for found in full]  # the first is x
    assert [len(values) for values in samples] == [20_000, 20_000]
    assert [round(int(values.max()) / 32767 * 8, 3) for values in samples] == [1.0, 7.0]
    stroke = re.compile(r"M[-\d.]+ ([-\d.]+)V([-\d.]+)")
    plain, spiked = ([min(map(float, ends)) for ends in stroke.findall(svg)] for svg in drawn)
    ((before, after),) = [pair for pair in zip(plain, spiked, strict=True) if pair[0] != pair[1]]
    assert before - after == pytest.approx(6.0 / 16.0 * 1000.0, rel=0.01)  # tenths of a pixel


def test_a_page_is_the_same_each_time(unit: Unit) -> None:
    assert render(*unit.arguments) == render(*unit.arguments)
    assert replace(unit).arguments == unit.arguments


@pytest.mark.parametrize(("times", "good"), [(2.0, True), (18.0, False)])
def test_nothing_missing_is_not_green_beside_an_error_far_above_the_noise(
    unit: Unit, times: float, *, good: bool
) -> None:
    validation, diagnosis = copy.deepcopy((unit.validation, unit.diagnosis))
    held_out = validation["gyroscope"]
    held_out["steps"][-1]["rms_error"] = times * held_out["noise_floor"]
    held_out["expected_rms_error"] = [0.0, 20.0 * held_out["noise_floor"]]
    diagnosis["gyroscope"] |= {"verdict": "nothing_missing", "selected": []}
    shown = render(unit.calibration, validation, diagnosis, unit.recordings, unit.settings)
    card = re.search(r'<div class="card ([^"]*)">\s*<h2>Gyroscope</h2>(.*?)</table>', shown, re.DOTALL)
    assert card is not None
    assert (card[1] == "good") == good
    assert ("does not show that the calibration is good" in card[2]) != good
    row = summary_row("U1", unit.calibration, validation, diagnosis, {})
    page = campaign_page.render("c", [row], [])
    assert ('<td class="good-text">nothing missing' in page) == good
    assert ('<td><b class="warn-text">far above noise</b></td>' in re.sub(r"(?=\n?<td|</tr>)", "</td>", page)) != good


def test_a_sensor_judged_on_the_samples_of_its_fit_is_marked_on_both_pages(unit: Unit) -> None:
    validation, settings = copy.deepcopy(unit.validation), shipped_settings(table="hand").replaced(stated=Stated())
    reason = "no held-out recording holds readings of the gyroscope; judged on the samples of the fit"
    validation["gyroscope"] |= {"held_out": False, "reason": reason, "samples": 13}
    page = render(unit.calibration, validation, unit.diagnosis, [], settings)
    card = re.search(r'<div class="card ([^"]*)">\s*<h2>Gyroscope</h2>(.*?)</table>', page, re.DOTALL)
    assert card is not None
    assert card[1] == "warn"
    assert f'<p class="warn-text"><b>Not checked on held-out motion</b>: {reason}.</p>' in card[2]
    assert "Errors on the samples of the fit, of the magnitude in mdeg/s over 13 rests" in Text(page).text
    assert "over 2,000 samples" in Text(render(*unit.arguments)).text
    row = summary_row("U1", unit.calibration, validation, unit.diagnosis, {})
    assert (row["gyroscope_not_held_out"], row["accelerometer_not_held_out"]) == (reason, None)
    text = Text(campaign_page.render("c", [row], [])).text
    assert "not held out U1" in text
    assert "nothing missing not held out" in text
    assert "not held out" not in Text(campaign_page.render("c", rows(unit, 2), [])).text


def test_nothing_missing_is_not_green_beside_a_more_probable_answer(unit: Unit) -> None:
    diagnosis = copy.deepcopy(unit.diagnosis)
    for effects, kind in (([], "good"), (["quadratic_nonlinearity"], "")):
        diagnosis["gyroscope"]["answer_set"] = [{"effects": effects, "probability": 0.69}]
        page = render(unit.calibration, unit.validation, diagnosis, [], unit.settings)
        assert f'<div class="card {kind}">\n<h2>Gyroscope</h2>' in page


def test_an_upper_limit_of_about_the_prior_excludes_no_effect(unit: Unit) -> None:
    diagnosis, limit = copy.deepcopy(unit.diagnosis), SHEET["effects"]["quadratic_nonlinearity"]
    for share, excluded in ((0.999, 0), (0.3, 1)):
        entry = {"K2_x": {"value": share * limit, "unit": "1/g"}}
        diagnosis["accelerometer"] |= {
            "upper_limit": {"quadratic_nonlinearity": entry},
            "probability": {"quadratic_nonlinearity": 0.06},
        }
        text = Text(render(unit.calibration, unit.validation, diagnosis, [], unit.settings)).text
        assert f"{excluded} of 1 effects that were not selected" in text
        assert (", not excluded" in text) == (not excluded)
