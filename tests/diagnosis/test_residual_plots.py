"""The pictures of a diagnosis show what was fitted: slopes are parameters, and points lie where noise lets them."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from bench_session import STOP_AND_GO, Session, record, values_of
from unit_settings import settings_of

from pipeline.core.records import Recording, SensorCalibration
from pipeline.estimation.gauss_markov import Blocks
from pipeline.estimation.noise import estimate_noise
from pipeline.evaluation.diagnosis.residual_dependence import Bins
from pipeline.simulation.description import shipped_settings
from tests.published import diagnose

SHEET = shipped_settings(sensor="mpu6050").sensor
TABLE = settings_of().table
HIDDEN = [
    ("gyroscope", "g_sensitivity"),
    ("accelerometer", "quadratic_nonlinearity"),
    ("accelerometer", "bias_temperature"),
    ("accelerometer", "time_offset"),
]
GEAR = {0: 0.004, 2: 0.003}  # amplitude of five cycles a turn on x and z, g


def diagnosed(sensor: str, recordings: list[Recording]) -> dict[str, Any]:
    noise = estimate_noise(sensor, recordings, SHEET.of(sensor))
    settings = settings_of(sensor=SHEET)
    return diagnose(SensorCalibration(sensor), recordings, noise, settings)


@cache
def with_hidden(sensor: str, name: str) -> tuple[dict[str, Any], tuple[float, ...]]:
    truth = values_of(sensor, name, np.random.default_rng(1))
    part = diagnosed(sensor, record(Session(1, STOP_AND_GO, {sensor: {name: truth}})))
    return part, tuple(truth)


def slope(panels: list[dict[str, Any]]) -> float:
    up = down = 0.0
    for panel in panels:
        x, mean, error = (np.array(panel[k]) for k in ("x", "mean", "standard_error"))
        up += float(np.sum(x * mean / error**2))
        down += float(np.sum(x * x / error**2))
    return up / down


@pytest.mark.parametrize(("sensor", "name"), HIDDEN)
def test_the_slope_of_the_added_variable_is_the_parameter_of_the_fit(sensor: str, name: str) -> None:
    part, truth = with_hidden(sensor, name)
    shown = part["pictures"]["added_variable"]
    fitted = part["ranking"][0]["parameters"]
    assert shown["effect"] == part["selected"][0] == name
    names = list(fitted)
    groups = {p["parameter"]: [q for q in shown["panels"] if q["parameter"] == p["parameter"]] for p in shown["panels"]}
    for parameter, panels in groups.items():
        assert panels[0]["value"] == fitted[parameter]["value"]
        drawn = slope(panels)
        assert drawn == pytest.approx(fitted[parameter]["value"], rel=0.005)
        assert abs(drawn - truth[names.index(parameter)]) < 5.0 * fitted[parameter]["standard_uncertainty"]


@pytest.mark.parametrize(("sensor", "name"), HIDDEN)
def test_the_points_of_the_added_variable_scatter_about_its_line_as_their_errors_say(sensor: str, name: str) -> None:
    part, _ = with_hidden(sensor, name)
    scatter = []
    for panel in part["pictures"]["added_variable"]["panels"]:
        x, mean, error = (np.array(panel[k]) for k in ("x", "mean", "standard_error"))
        assert 5 < len(x) <= 60
        scatter += (((mean - panel["value"] * x) / error) ** 2).tolist()
    expected = 1.0
    assert abs(np.mean(scatter) - expected) < 5.0 * np.sqrt(2.0 / len(scatter))


@cache
def with_gear() -> dict[str, Any]:
    recordings = []
    for recording in record(Session(3, STOP_AND_GO, {})):
        reading = recording.accelerometer
        if recording.table_angle is not None and reading is not None:
            reading = reading.copy()
            for axis, size in GEAR.items():
                reading[:, axis] += size * np.cos(np.radians(5.0 * recording.table_angle))
        recordings.append(replace(recording, accelerometer=reading))
    return diagnosed("accelerometer", recordings)


def test_what_is_unexplained_is_drawn_against_its_covariate_with_the_shape_that_was_hidden() -> None:
    part = with_gear()
    shown = part["pictures"]["unexplained"][0]
    assert shown["covariate"] == part["unexplained"][0]["covariate"] == "angle"
    panels = {p["axis"]: p for p in shown["panels"]}
    for axis, size in zip("xz", GEAR.values(), strict=True):
        curve = np.array(panels[axis]["curve"])
        assert (curve.max() - curve.min()) / 2.0 == pytest.approx(size, rel=0.05)
        x, mean, error = (np.array(panels[axis][k]) for k in ("x", "mean", "standard_error"))
        hidden = size * np.cos(np.radians(5.0 * x)) * np.sinc(5.0 / 40.0)
        assert np.mean(((mean - hidden) / error) ** 2) < 2.0
        assert np.mean((mean / error) ** 2) > 50.0
    flat = panels["y"]
    assert "curve" not in flat
    assert np.mean((np.array(flat["mean"]) / np.array(flat["standard_error"])) ** 2) < 2.0


def test_pictures_are_small_and_there_are_none_where_nothing_is_missing() -> None:
    for part in (with_gear(), *(with_hidden(*which)[0] for which in HIDDEN)):
        assert len(json.dumps(part["pictures"], allow_nan=False)) < 20_000
    nothing = diagnosed("gyroscope", record(Session(503)))
    assert nothing["pictures"] == {"added_variable": None, "unexplained": []}


def test_a_bin_holds_as_much_wander_as_its_cells_of_time_have_in_common() -> None:
    weight = np.ones(6)
    times = np.array([0.0, 100.0, 900.0])
    blocks = Blocks(np.array([0, 2, 4]), np.full(3, 2.0), times, np.zeros(3), np.array([0, 0, 1]))
    values = np.array([0.0, 1.0, 0.0, 2.0, 0.0, np.nan])
    bins = Bins(values, weight)
    np.testing.assert_allclose(bins.weight, [3.0, 1.0, 1.0])
    together = np.exp(-100.0 / 200.0)
    expected = [(3.0 + 2.0 * together) / 9.0, 1.0, 1.0]  # the third recording has a clock of its own
    np.testing.assert_allclose(bins.bias_of_means(blocks, blocks.covariance(200.0)), expected)
    np.testing.assert_allclose(bins.mean(np.array([1.0, 7.0, 3.0, 5.0, 5.0, 99.0])), [3.0, 7.0, 5.0])
