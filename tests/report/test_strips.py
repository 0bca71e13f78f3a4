"""Strip plots: the dots stand where value over limit is, and tell the unit and the value."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from scipy.linalg import polar
from unit_settings import settings_of

from pipeline.output.pages.campaign_page import ENDS, strips
from pipeline.output.pages.fleet import parameter_table
from pipeline.output.pages.parameters import unit_parameters
from pipeline.physics.statements import beyond_limits, limited

if TYPE_CHECKING:
    import pandas as pd

SHEET = {"bias": 0.08, "scale_factor": 0.03, "cross_axis": 0.02, "full_scale": 2.0}
SENSOR = settings_of(sensor={"accelerometer": SHEET}).sensor
NAMES = ["Bias x", "Bias y", "Bias z", *(f"Scale factor error {a}" for a in "xyz")]
NAMES += [f"Cross-axis sensitivity {axes}" for axes in ("xy", "xz", "yz")]


def campaign(count: int) -> tuple[list[dict[str, Any]], pd.DataFrame, np.ndarray]:
    """Return units with random biases and sensitivities, and the shares of the limits that follow."""
    rng = np.random.default_rng(3)
    rows, placed, shares = [], {}, []
    for i in range(count):
        bias, K = rng.normal(0.0, 0.06, 3), np.eye(3) + rng.normal(0.0, 0.01, (3, 3))
        part: dict[str, Any] = {"unit": "g", "bias": bias.tolist(), "matrix": np.linalg.inv(K).tolist(), "effects": []}
        part |= {"expanded_uncertainty": {"bias": [0.0] * 3, "matrix": [[0.0] * 3] * 3}}
        part |= {"beyond_limits": beyond_limits(limited("accelerometer", part, SENSOR.accelerometer))}
        rows.append({"unit": f"U{i}", "status": "ok", "sensor": "mpu6050", "method": "staged"})
        placed[f"U{i}"] = unit_parameters({"accelerometer": part, "gyroscope": None}, SENSOR)
        P = polar(K, side="left")[1]
        shares.append([*bias / 0.08, *(np.diag(P) - 1.0) / 0.03, *P[np.triu_indices(3, 1)] / 0.02])
    return rows, parameter_table(placed), np.array(shares)


def drawn(svg: str) -> list[tuple[str, int, str, float]]:
    """Return class, unit, row and share (%) of each dot, read from the coordinates."""
    low, high, start, stop = map(float, re.findall(r'<svg[^>]*data-scale="([^,]+),([^,]+),([^,]+),([^,]+)', svg)[0])
    heights = re.findall(r'class="panel" data-scale="([^,]+),([^,]+),([^,]+),([^,]+)', svg)[0]
    bottom, top, y_start, y_stop = map(float, heights)
    found = []
    for colour, path, units in re.findall(r'class="dots[^"]* (c\d)" d="([^"]+)" data-units="([^"]+)"', svg):
        x, y = np.cumsum(np.array(re.findall(r"[Mm](-?\d+) (-?\d+)", path), float), axis=0).T / 10.0
        row = bottom + (y - y_start) / (y_stop - y_start) * (top - bottom)
        share = low + (x - start) / (stop - start) * (high - low)
        names = [NAMES[9 - round(v)] for v in row]
        found += zip([colour] * len(x), map(int, units.split()), names, share, strict=True)
    return found


def test_each_dot_stands_at_its_share_of_the_limit_and_tells_its_value() -> None:
    rows, placed, shares = campaign(7)
    rows[2]["status"] = "failed"
    ((figure, texts),) = strips(rows, placed)  # no gyroscope
    dots = drawn(figure.svg)
    assert len(dots) == 6 * 9
    assert {unit for _, unit, _, _ in dots} == {1, 2, 4, 5, 6, 7}
    told = [text for of_colour in texts.values() for text in of_colour]
    for (colour, unit, name, share), text in zip(dots, told, strict=True):
        true = 100.0 * shares[unit - 1, NAMES.index(name)]
        assert share == pytest.approx(np.clip(true, -300.0, 300.0), abs=0.3)
        assert (colour == "c0") == (abs(true) > 100.0)
        assert text.startswith(f"{name}: ")
        value = float(re.findall(r"[\d.]+(?:e-\d+)?", text.split(": ")[1].replace("−", "-"))[0])
        limit = float(text.rpartition("±")[2])
        assert 100.0 * value / limit == pytest.approx(abs(true), rel=2e-3)
    (start,) = set(re.findall(r'data-scale="[^,]*,[^,]*,(\d+),[^"]*%"', figure.svg))
    assert int(start) > 6 * max(map(len, NAMES))  # px: the longest name is not cut
    beyond = (np.abs(np.delete(shares, 2, 0)) > 1.0).any(axis=1).sum()
    assert f"{beyond} of 6 units are outside the data sheet's limits" in figure.finding


def test_of_many_units_the_farthest_are_drawn() -> None:
    rows, placed, shares = campaign(200)
    dots = drawn(strips(rows, placed)[0][0].svg)
    for k, name in enumerate(NAMES):
        order = np.argsort(shares[:, k]) + 1
        assert {u for _, u, n, _ in dots if n == name} == {*order[:ENDS].tolist(), *order[-ENDS:].tolist()}


def test_two_siblings_are_not_drawn() -> None:
    assert strips(*campaign(2)[:2]) == []
