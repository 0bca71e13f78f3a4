"""The uncertainty budget and the convergence of a fit on the page of a unit."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from pipeline.core.records import Convergence, SensorCalibration
from pipeline.estimation.table_errors import type_b
from pipeline.estimation.uncertainty_budget import combined, scatter_contribution
from pipeline.output.pages.pages import template
from pipeline.output.pages.unit_page import render

from .test_pages import Text

if TYPE_CHECKING:
    from .conftest import Unit


def with_budget(**changes: Any) -> dict[str, Any]:
    plain = SensorCalibration("gyroscope", convergence=Convergence(3e-12, 1.75, 12, 12))
    effect = np.zeros((12, 2))
    effect[3, 0], effect[7, 1] = 1.0, 1.0
    lines = [scatter_contribution(1e-8 * np.eye(12), 5.0), type_b("table rate", "normal", 3e-4, "1", effect)]
    return replace(combined(plain, lines, {"levelling": "table.levelling_deg is not stated"}), **changes).to_json()


def test_the_page_shows_every_contribution_the_degrees_of_freedom_and_what_is_left_out(unit: Unit) -> None:
    part = with_budget()
    text = Text(render({**unit.calibration, "gyroscope": part}, *unit.arguments[1:])).text
    for words in ("Uncertainty budget", "table rate", "levelling : table.levelling_deg is not stated", "repeatability"):
        assert words.replace(" :", ":") in text.replace(" :", ":")
    # two contributions, u, degrees of freedom 5 (1 + 9)^2, k, U; and those of a bias with 5 degrees of freedom
    assert "matrix xx 0.00010 0.00030 0.00032 500 1.96 0.00062" in text
    assert "bias x 0.00010 0 0.00010 5.00 2.57 0.00026 deg/s" in text


@pytest.mark.parametrize("converged", [True, False])
def test_the_page_says_whether_the_fit_converged_and_by_what_it_shows(unit: Unit, *, converged: bool) -> None:
    part = with_budget(converged=converged)
    sentence = str(template("budget.html").module.convergence(part)).partition(">")[2].partition("<")[0]
    page = render({**unit.calibration, "gyroscope": part}, *unit.arguments[1:])
    assert sentence in " ".join(Text(page).text.split())
    assert "the recordings determine all parameters (condition 1.75 in scaled columns; largest cosine" in sentence
    assert ("did not converge" in sentence) != converged
