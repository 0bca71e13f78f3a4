"""Charts: ticks at round values, and paths that lead through the values, read back number by number."""

from __future__ import annotations

import re
from base64 import b64decode

import numpy as np
import pytest

from pipeline.output.pages.chart import (
    LEFT,
    Area,
    Axis,
    Dots,
    Figure,
    Panel,
    SampleMarks,
    chart,
    log_ticks,
    round_ticks,
    tick_label,
)
from pipeline.output.pages.pages import measured, number, span, typeset

FIGURE = Figure("n", "t")


def values(ticks: list[tuple[float, str]]) -> list[float]:
    return [value for value, _ in ticks]


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0.0, 1.0, [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]),
        (-0.7, 1.1, [-0.5, 0.0, 0.5, 1.0]),
        (3.0, 4.2, [3.0, 3.25, 3.5, 3.75, 4.0]),
    ],
)
def test_ticks_are_round_values(low: float, high: float, expected: list[float]) -> None:
    assert values(round_ticks(low, high)) == pytest.approx(expected)


def test_an_axis_of_angles_is_divided_by_parts_of_a_turn() -> None:
    assert values(round_ticks(0.0, 360.0, 6, "angle")) == [45.0 * k for k in range(9)]
    assert values(round_ticks(-720.0, 720.0, 6, "angle"))[:2] == [-720.0, -540.0]


def test_ticks_of_counts_are_whole() -> None:
    assert round_ticks(0.94, 3.06, 6, "count") == [(1.0, "1"), (2.0, "2"), (3.0, "3")]
    assert values(round_ticks(0.6, 16.4, 6, "count")) == [5.0, 10.0, 15.0]


@pytest.mark.parametrize(
    ("value", "step", "text"),
    [(0.25, 0.25, "0.25"), (-0.5, 0.5, "−0.5"), (0.0, 1e-9, "0"), (1.5e-4, 5e-5, "1.5e−4"), (2e6, 1e6, "2e6")],
)
def test_a_tick_has_the_decimals_that_its_step_needs(value: float, step: float, text: str) -> None:
    assert tick_label(value, step) == text


def test_a_logarithmic_axis_has_at_least_two_ticks() -> None:
    assert values(log_ticks(0.001, 1.0)) == pytest.approx([0.001, 0.01, 0.1, 1.0])
    assert values(log_ticks(0.012, 0.06)) == pytest.approx([0.02, 0.05])
    narrow = values(log_ticks(1.05, 1.15))
    assert len(narrow) >= 2
    assert all(1.05 <= v <= 1.15 for v in narrow)


def test_an_axis_takes_its_ends_to_the_ends_of_the_panel() -> None:
    linear, decades = Axis(-1.0, 3.0, 50.0, 450.0), Axis(-2.0, 2.0, 0.0, 400.0, "log")
    assert [linear.pixels(v) for v in (-1.0, 1.0, 3.0)] == [50.0, 250.0, 450.0]
    assert linear.units(np.array([-9.0, 1.0, 9.0])).tolist() == [500, 2500, 4500]
    assert decades.pixels(1.0) == pytest.approx(200.0)
    assert decades.units(np.array([0.0, 0.01, 1.0, 1e9])).tolist() == [0, 0, 2000, 4000]


@pytest.mark.parametrize(
    ("array", "ends"), [(np.full(5, 2.0), (1.0, 3.0)), (np.zeros(5), (-0.5, 0.5)), (np.array([np.nan]), (0.0, 1.0))]
)
def test_a_constant_series_still_has_an_axis(array: np.ndarray, ends: tuple[float, float]) -> None:
    axis = Axis.over([array], 0.0, 1.0)
    assert (axis.low, axis.high) == ends


def test_a_measured_value_has_two_digits_of_its_uncertainty() -> None:
    assert measured(0.0312345, 0.00123) == "0.0312 ± 0.0012"
    assert measured(-12.3456, 3.7) == "−12.3 ± 3.7"
    assert measured(-1e-6, 0.00025) == "0.00000 ± 0.00025"
    assert span(0.00983, 0.0363) == "0.0098 to 0.0363"
    assert span(9.01e-8, 0.00155) == "at most 0.00155"
    assert span(3e-8, 4e-5) == "3.00e−08 to 4.00e−05"
    assert measured(0.5, None) == "0.50000"
    assert number(None) == number(float("nan")) == "–"


def test_sentences_of_a_terminal_get_the_signs_of_print_and_keep_hyphens() -> None:
    said = "b_x = -0.1 +- 0.02 deg/s, p = 1e-12, G_xy = -3e-05 (delta BIC -8.9), on 2019-03-12, in warm-up 3-4"
    assert (
        typeset(said) == "b_x = −0.1 ± 0.02 deg/s, p = 1e−12, G_xy = −3e−05 (ΔBIC −8.9), on 2019-03-12, in warm-up 3-4"
    )


def points(path: str) -> list[tuple[int, int]]:
    """Follow a path of M, m, l and h0 and return where it comes by."""
    at, out = np.zeros(2, int), []
    for command, numbers in re.findall(r"([Mml])([-\d ]+)", path):
        for pair in np.array(numbers.split(), int).reshape(-1, 2):
            at = pair if command == "M" else at + pair
            out.append((int(at[0]), int(at[1])))
    return out


def drawn(svg: str, kind: str) -> list[str]:
    return re.findall(rf'<path class="{kind}[^"]*" d="([^"]*)"', svg)


@pytest.mark.parametrize("hole", [False, True])
def test_few_samples_are_dots_at_their_values(*, hole: bool) -> None:
    rng = np.random.default_rng(3)
    x, block = np.sort(rng.random(100)), rng.standard_normal((100, 3))
    if hole:
        block[7, 1] = np.nan
    svg = chart(FIGURE, "d", [Panel([SampleMarks(x, block)], "y", height=100, limits=(-5.0, 5.0))], "x").svg
    across, up = Axis(x[0], x[-1], LEFT, 406), Axis(-5.0, 5.0, 108, 8)
    for column, path in zip(block.T, drawn(svg, "dots"), strict=True):
        known = np.isfinite(column)
        assert points(path) == list(zip(across.units(x[known]).tolist(), up.units(column[known]).tolist(), strict=True))


@pytest.mark.parametrize("count", [1400, 1396])
def test_many_samples_are_ranges_whose_means_are_a_line(count: int) -> None:
    rng = np.random.default_rng(4)
    x, y = np.arange(count, dtype=float), rng.standard_normal(count)
    svg = chart(FIGURE, "d", [Panel([SampleMarks(x, y, mean=True)], "y", height=100, limits=(-5.0, 5.0))], "x").svg
    up = Axis(-5.0, 5.0, 108, 8)
    ((path,), (line,)) = drawn(svg, "strokes"), drawn(svg, "line")
    ranges = [(int(low), int(high)) for low, high in re.findall(r"M\d+ (\d+)V(\d+)", path)]
    buckets = np.split(y, range(10, count // 10 * 10, 10))  # the last takes the remainder
    low, high, mean = (up.units(np.array([f(b) for b in buckets])).tolist() for f in (np.min, np.max, np.mean))
    assert ranges == list(zip(low, high, strict=True))
    assert [at for _, at in points(line)] == mean


def test_an_interval_and_a_band_are_drawn_at_their_ends() -> None:
    at = np.array([1.0, 2.0])
    layers = [Area(-0.5, 0.5), Dots(at, at - 1.5, 0, at - 1.6, at - 1.4)]
    svg = chart(FIGURE, "d", [Panel(layers, "y", height=100, limits=(-1.0, 1.0))], "x").svg
    assert drawn(svg, "band") == ["M720 830l3340 0 0 -500 -3340 0z"]
    assert drawn(svg, "strokes") == ["M720 880V780M4060 380V280"]


def test_the_values_that_a_zoom_draws_end_at_the_limits_of_the_panel() -> None:
    x = np.linspace(0.0, 1.0, 2000)
    y = np.where(x < 0.5, 7.0, -0.5)  # beyond the limits, and a quarter above the lower one
    panel = Panel([SampleMarks(x, np.column_stack([y, y, y]))], "y", 100, limits=(-1.0, 1.0))
    drawn = str(chart(FIGURE, "n", [panel], "x").svg)
    curves = [np.frombuffer(b64decode(found), "<i2") for found in re.findall(r' data-full="([^"]+)"', drawn)]
    assert any(set(curve.tolist()) == {32767, -16384} for curve in curves)
