"""The figures of a diagnosis stand where its numbers are: bars, gate, brackets, slopes, Allan deviation, harmonics."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from unit_settings import sheet_of

from pipeline.core.records import Recording
from pipeline.estimation.noise_identification import identify_noise
from pipeline.output.pages.chart import scaled
from pipeline.output.pages.held_out_section import allan, error_steps, remarks, term_rows
from pipeline.output.pages.pages import Scale, number
from pipeline.output.pages.residual_section import (
    _column_unit,
    added_variable,
    harmonic_noise,
    harmonics,
    ranking,
    residual_figures,
    residuals,
    unexplained,
)
from pipeline.output.pages.unit_page import render

from .conftest import SIGMA, Unit, build_unit, diagnosis_of

BAR = re.compile(r'class="bar c(\d)" d="M([\d.]+) ([\d.]+)H([\d.]+)')
LEVEL = re.compile(r'class="level" d="M([\d.]+) ')


@pytest.fixture(scope="module")
def unit() -> Unit:
    return build_unit()


def entry(effect: str, delta_bic: float, **more: Any) -> dict[str, Any]:
    return {"effect": effect, "delta_bic": delta_bic, "look_alikes": [], "plausible": True, **more}


def ranked() -> dict[str, Any]:
    alike = [{"effect": "scale_factor_asymmetry", "share": 0.94}]
    return {
        "selected": ["quadratic_nonlinearity"],
        "ranking": [
            entry("quadratic_nonlinearity", 2000.0, look_alikes=alike),
            entry("scale_factor_asymmetry", 200.0),
            entry("table_tilt", 5.0),
            entry("hysteresis", -30.0),
        ],
        "not_observable": [{"effect": "lever_arm", "reason": "the table turned too slowly"}],
    }


def test_bars_end_where_their_evidence_is_and_the_gate_stands_at_ten() -> None:
    figure = ranking("gyroscope", ranked())
    assert figure is not None
    bars = [(int(c), float(zero), float(end)) for c, zero, _, end in BAR.findall(figure.svg)]
    assert [c for c, _, _ in bars] == [2, 4, 3]  # selected, passes the gate, does not
    zero = bars[0][1]
    gate = float(LEVEL.search(figure.svg).group(1))  # type: ignore[union-attr]
    for (_, start, end), value in zip(bars, (2000.0, 200.0, 5.0), strict=True):
        assert start == zero
        assert (end - zero) / (gate - zero) == pytest.approx(float(scaled(value, "symlog")), abs=0.01)
    assert scaled([10.0, -5.0, -1000.0], "symlog").tolist() == [1.0, -0.5, -3.0]
    assert "1 more effect has less evidence" in figure.caption


def test_effects_that_cannot_be_seen_are_named_and_look_alikes_are_bracketed() -> None:
    figure = ranking("gyroscope", ranked())
    assert figure is not None
    assert "Not observable: lever arm;" in figure.caption
    assert figure.svg.count('class="bracket"') == 1
    assert ">94 %<" in figure.svg
    assert "Quadratic nonlinearity stands out: ΔBIC 2000" in figure.finding


def test_evidence_against_every_effect_is_drawn_to_the_left_of_zero() -> None:
    figure = ranking("gyroscope", {"ranking": [entry("hysteresis", -8.0), entry("warm_up", -50.0)]})
    assert figure is not None
    (_, zero, _, near), (_, _, _, far) = BAR.findall(figure.svg)
    assert float(far) < float(near) < float(zero)
    assert figure.finding == "No effect has evidence: the largest ΔBIC is −8.00"
    assert ranking("gyroscope", {"ranking": []}) is None


def added(value: float, off: float = 0.0) -> dict[str, Any]:
    x = np.linspace(-1.0, 1.0, 21)
    points = {"x": x.tolist(), "mean": (value * x + off * x**2).tolist(), "standard_error": [0.01] * 21}
    panel = {"axis": "y", "parameter": "G_yz", "unit": "deg/s/g", "value": value, "standard_uncertainty": 0.002}
    return {"pictures": {"added_variable": {"effect": "g_sensitivity", "unit": "deg/s", "panels": [panel | points]}}}


def test_the_line_of_an_added_variable_has_the_parameter_as_its_slope() -> None:
    figure = added_variable("gyroscope", added(0.4))
    assert figure is not None
    path = re.search(r'class="line c5 model" d="M(\d+) (\d+)l(-?\d+) (-?\d+)"', figure.svg)
    dots = re.search(r'class="dots large c1" d="M(\d+) (\d+)h0(.*?)"', figure.svg)
    assert path is not None
    assert dots is not None
    x, y, right, down = (int(v) for v in path.groups())
    steps = [tuple(map(int, s)) for s in re.findall(r"m(-?\d+) (-?\d+)h0", dots.group(3))]
    assert (int(dots.group(1)), int(dots.group(2))) == (x, y)
    assert (sum(s[0] for s in steps), sum(s[1] for s in steps)) == (right, down)
    assert "G_yz = 0.4000 ± 0.0040 deg/s/g, and the points follow the line" in figure.finding
    assert ", g<" in figure.svg  # deg/s over deg/s/g
    bent = added_variable("gyroscope", added(0.4, off=0.1))
    assert bent is not None
    assert "some points leave the line" in bent.finding
    assert added_variable("gyroscope", diagnosis_of("gyroscope")) is None


@pytest.mark.parametrize(
    ("parameter", "unit", "column"),
    [
        ("1/g", "g", "g^2"),
        ("1/(deg/s)^2", "deg/s", "(deg/s)^3"),
        ("deg/s/g^2", "deg/s", "g^2"),
        ("g/(deg/s)", "g", "deg/s"),
        ("g/degC", "g", "degC"),
        ("1", "deg/s", "deg/s"),
        ("g", "g", ""),
        ("m", "g", "g/m"),
    ],
)
def test_what_a_parameter_multiplies_has_the_unit_that_makes_a_reading(parameter: str, unit: str, column: str) -> None:
    assert _column_unit(parameter, unit) == column


def test_the_unexplained_is_drawn_with_its_shape_and_says_where_the_points_leave_it() -> None:
    x = np.linspace(20.0, 40.0, 30)
    step = np.where(x > 31.0, 0.004, 0.0)
    panels = [
        {"axis": a, "x": x.tolist(), "mean": m.tolist(), "standard_error": [1e-4] * 30, "curve_x": [20, 31, 31, 40]}
        for a, m in (("x", step), ("y", step * 2.0))
    ]
    panels = [p | {"curve": [0.0, 0.0, 0.004, 0.004]} for p in panels]
    shape = "a step at 31.0 degC of 4.0 mg on x"
    found = {"unexplained": [{"covariate": "temperature", "p_value": 1e-9, "shape": shape, "delta_bic": 90.0}]}
    for shown, follows in ((panels[:1], True), (panels, False)):
        pictures = [{"covariate": "temperature", "signal": "temperature", "unit": "g", "panels": shown}]
        (figure,) = unexplained("accelerometer", found | {"pictures": {"unexplained": pictures}})
        assert figure.finding == f"The residual depends on temperature: {shape}".replace("degC", "°C")
        assert "temperature, °C" in figure.svg
        assert figure.svg.count('class="line c5 model"') == len(shown)
        assert ("do not follow" not in figure.caption) is follows


def noise_at_rest(samples: int, sigma: float = 0.003, interval: float = 0.12) -> dict[str, Any]:
    time_ns = np.rint(np.arange(samples) * interval * 1e9).astype(np.int64)
    reading = sigma * np.random.default_rng(samples).standard_normal((samples, 3)) + [0.0, 0.0, 1.0]
    return identify_noise([Recording("static", "static", None, time_ns, accelerometer=reading)])["accelerometer"]


def test_the_words_beside_the_allan_deviation_say_what_was_found_and_whether_it_is_inflated() -> None:
    noise = noise_at_rest(900)
    sheet = sheet_of(noise_density=0.003 * np.sqrt(2 * 0.12), bias_wander=1e-4)
    wander = {"ratio": 0.3, "time_s": 50.0, "standard_deviation": 9e-4, "expected": 1e-4, "inflated": True}
    figure = allan("accelerometer", noise, sheet, wander)
    assert figure is not None
    density = np.sqrt(np.mean([part["terms"]["white"]["value"] ** 2 for part in noise["axes"].values()]))
    assert density == pytest.approx(0.003 * np.sqrt(0.12), rel=0.05)
    assert figure.finding == f"White noise N = {density:.5f} g/√Hz, as the sensor file states"
    assert "static, 108 s at rest, before any filter" in figure.caption
    assert (
        "needs a wander of 0.000900 g, correlation time 50.0 s, against 0.000100 expected: it is inflated"
        in figure.caption
    )
    assert [text for _, text in figure.legend[3:]] == ["sensor file"]
    assert figure.svg.count('class="band') == 3
    calm = allan("accelerometer", noise, sheet.replaced(noise_density=1e-3), wander | {"inflated": False})
    assert calm is not None
    assert "inflated" not in calm.caption
    assert "1.5 × the value of the sensor file" in calm.finding
    assert allan("accelerometer", noise_at_rest(50), sheet, wander) is None
    assert allan("accelerometer", None, sheet, wander) is None


def test_the_rows_of_the_noise_give_intervals_or_upper_limits_and_say_what_is_too_short() -> None:
    noise = noise_at_rest(900)
    rows = {row["name"]: row for row in term_rows(noise)}
    x = noise["axes"]["x"]["terms"]
    assert rows["white N"]["unit"] == "g/sqrt(Hz)"
    value, (low, high) = x["white"]["value"], x["white"]["interval"]
    assert rows["white N"]["axes"][0] == f"{number(value)} ({number(low)} to {number(high)})"
    assert rows["random walk K"]["axes"][0] == f"< {number(x['random_walk']['upper_limit'])}"
    assert any(
        line.startswith("x, y, z: bias instability and random walk: the recording is too") for line in remarks(noise)
    )
    assert remarks(noise_at_rest(50)) == [
        "Not identified: the rests hold 50 evenly sampled readings; 60 are needed: record static."
    ]


def test_noise_alone_stays_below_the_dashes_of_the_harmonics(unit: Unit) -> None:
    found = residuals(unit.fit, unit.recordings, unit.settings.table)[0]
    rng, sigma = np.random.default_rng(21), np.full(3, SIGMA["accelerometer"])
    level = harmonic_noise(found, sigma, np.zeros(3), 100.0)
    above = 0
    for _ in range(150):
        noise = sigma * rng.standard_normal(found.reading.shape)
        amplitudes = harmonics(replace(found, reading=found.predicted + noise))
        assert amplitudes is not None
        above += int(np.sum(amplitudes[1:13] > level[1:, None] / np.sinc(np.arange(1, 13) / 36.0)[:, None]))
    drawn = 150 * 12 * 3
    assert 0 < above < 4 * drawn / 1000


def test_the_covariate_that_matters_comes_first_and_says_its_size(unit: Unit) -> None:
    found = residuals(unit.fit, unit.recordings, unit.settings.table)
    rng, sigma = np.random.default_rng(6), SIGMA["accelerometer"]
    noise = {"white": [sigma] * 3, "wander": [1e-4] * 3, "correlation_time_s": 100.0}
    made = []
    for residual in found:
        angle = residual.motion.angle
        assert angle is not None
        error = sigma * rng.standard_normal(residual.reading.shape)
        error[:, 1] += 0.004 * np.sin(np.radians(6.0 * angle))  # no function of one force
        made.append(replace(residual, reading=residual.predicted + error))
    figures = residual_figures("accelerometer", made, noise)
    said = re.fullmatch(r"Not flat against angle: (\S+) g on y at (\S+) deg, (\S+) σ", figures[0].finding)
    assert said is not None
    size, at = (float(v.replace("−", "-")) for v in said.group(1, 2))
    assert size == pytest.approx(0.004 * np.sin(np.radians(6.0 * at)) * np.sinc(6.0 / 36.0), abs=8e-4)
    names = [re.search(r'id="accelerometer-residual-([\w-]+)-t"', f.svg) for f in figures]
    assert sum(m is not None and m.group(1).startswith("specific-force") for m in names) == 1
    none = [replace(r, reading=r.predicted + sigma * rng.standard_normal(r.reading.shape)) for r in found]
    flat = [
        f.finding.startswith("Flat") for f in residual_figures("accelerometer", none, noise) if "-residual-" in f.svg
    ]
    assert flat == [True] * 4


def test_a_harmonic_above_the_noise_is_named(unit: Unit) -> None:
    found = residuals(unit.fit, unit.recordings, unit.settings.table)
    findings = [f.finding for f in residual_figures("accelerometer", found, None)]
    assert any(re.match(r"accel_\w: 2 cycles a turn on \w, 0.00\d+ g, above the noise", f) for f in findings)


IN_G = Scale(1e-3, "mg")


def test_the_stairs_go_on_to_what_the_missing_effect_would_bring() -> None:
    steps = [
        {"name": "raw", "rms_error": 1.0, "vector_rms_error": 2.0},
        {"name": "calibrated", "rms_error": 0.1, "vector_rms_error": 0.2},
    ]
    held_out: dict[str, Any] = {"steps": steps, "noise_floor": 0.01, "vector_noise_floor": 0.02}
    held_out["noise"] = {"source": "static", "wander_source": "data_sheet", "correlation_time_source": "data_sheet"}
    found = diagnosis_of("accelerometer")
    found["ranking"][0] |= {"held_out_error_before": 0.19, "held_out_error_after": 0.021}
    found["held_out"] = {"error_before": 0.19, "error_after": 0.021, "floor": 0.02}
    figure = error_steps("accelerometer", held_out, found, IN_G, vector=True)
    assert figure is not None
    assert "+ quadratic nonlinearity, if added" in figure.svg
    assert "White noise by the static recording, bias wander by the sensor file" in figure.caption
    assert figure.finding == ("The error of the vector ends at 200 mg, 10.0 × noise; with the missing effects, at 21.0")
    by_hand = error_steps("accelerometer", held_out, found | {"held_out": None}, IN_G, vector=True)
    assert by_hand is not None
    assert by_hand.finding.endswith("; with the missing effects, at about 21")
    assert "+ quadratic nonlinearity, if added, about" in by_hand.svg
    magnitude = error_steps("accelerometer", held_out, found, IN_G, vector=False)
    assert magnitude is not None
    assert "if added" not in magnitude.svg  # the diagnosis tells the error of the vector
    found["ranking"][0]["held_out_error_before"] = 0.5
    other = error_steps("accelerometer", held_out, found, IN_G, vector=True)
    assert other is not None
    assert "if added" not in other.svg  # the method's calibration is not the diagnosis's base


def test_every_figure_of_the_page_says_its_finding(unit: Unit) -> None:
    page = render(*unit.arguments)
    figures = re.findall(r"<figure>.*?</figure>", page, re.DOTALL)
    assert len(figures) >= 15
    for figure in figures:
        finding = re.search(r'<p class="finding">(.+?)</p>', figure)
        assert finding is not None
        title = re.search(r"<title[^>]*>(.+?)</title>", figure)
        assert title is not None
        assert finding.group(1) in title.group(1)


@pytest.mark.parametrize(
    ("factor", "cause"), [(1.0, "as the sensor file states"), (6.0, "vibration at rest"), (0.1, "a filter")]
)
def test_white_noise_far_from_the_data_sheet_gets_a_likely_cause(factor: float, cause: str) -> None:
    noise = noise_at_rest(2000, factor * 1e-3 * np.sqrt(0.5 / 0.01), 0.01)
    figure = allan("accelerometer", noise, sheet_of(noise_density=1e-3), None)
    assert figure is not None
    assert cause in figure.finding
    assert ("filter" in figure.finding) == (factor < 1.0)
