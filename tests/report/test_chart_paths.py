"""The paths of a chart, read back number by number."""

from __future__ import annotations

import re

import numpy as np
import pytest

from pipeline.report.axes import Scale
from pipeline.report.shapes import REACH, Samples, dots, draw, path, strokes
from pipeline.report.svg import Panel, chart


def _points(text: str) -> list[tuple[int, int]]:
    """Follow a path of M, m, l and h0 and return where it comes by."""
    at, out = np.zeros(2, int), []
    for command, numbers in re.findall(r"([Mml])([-\d ]+)", text):
        for pair in np.array(numbers.split(), int).reshape(-1, 2):
            at = pair if command == "M" else at + pair
            out.append((int(at[0]), int(at[1])))
    return out


def test_paths_and_dots_lead_through_their_points() -> None:
    x, y = np.random.default_rng(1).integers(0, REACH + 1, (2, 500))
    points = list(zip(x.tolist(), y.tolist(), strict=True))
    assert _points(path(x, y)) == points
    assert _points(dots(x, y)) == points
    assert dots(x, y).count("h0") == 500
    assert path(x[:1], y[:1]) == f"M{x[0]} {y[0]}h0"
    assert path(x[:0], y[:0]) == dots(x[:0], y[:0]) == ""


def test_strokes_are_upright_from_the_smallest_to_the_largest() -> None:
    x, low, high = np.random.default_rng(2).integers(0, REACH + 1, (3, 300))
    rows = zip(x.tolist(), low.tolist(), high.tolist(), strict=True)
    assert strokes(x, low, high) == "".join(f"M{a} {b}V{c}" for a, b, c in rows)


@pytest.mark.parametrize("mean", [False, True])
@pytest.mark.parametrize("hole", [False, True])
@pytest.mark.parametrize("count", [100, 2000])
def test_several_columns_of_samples_are_drawn_as_one_after_the_other(count: int, *, hole: bool, mean: bool) -> None:
    rng = np.random.default_rng(3)
    x, block = np.sort(rng.random(count)), rng.standard_normal((count, 3))
    if hole:
        block[7, 1] = np.nan
    axes = Scale(0.0, 1.0, 64, 406), Scale(-5.0, 5.0, 148, 8)
    apart = [draw(Samples(x, block[:, i], i + 1, mean), *axes) for i in range(3)]
    assert draw(Samples(x, block, 1, mean), *axes) == "".join(apart)


def test_a_chart_too_high_for_its_table_of_numbers_is_refused() -> None:
    panel = Panel([Samples(np.arange(9.0), np.arange(9.0))], "g", height=REACH // 10)
    with pytest.raises(ValueError, match="px high"):
        chart("a", "a", "a", [panel], "s")
