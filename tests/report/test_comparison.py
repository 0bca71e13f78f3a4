"""Comparisons of groups: their statistics against SciPy's tests and simulated chances, and what the page says."""

import math
from collections.abc import Iterable

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from pipeline.output.pages.campaign_page import render
from pipeline.output.pages.comparison import (
    adjusted,
    against_truth,
    compare,
    difference,
    finding,
    logarithms,
    mean_of,
    section,
    unit_figures,
)
from pipeline.output.pages.pages import number
from pipeline.output.pages.parameters import Parameter

from .conftest import build_unit


def quantities(values: Iterable[float], prefix: str = "U", u: float = math.nan) -> pd.DataFrame:
    found = [float(v) for v in values]
    return pd.DataFrame({"value": found, "u": u}, index=[f"{prefix}{i}" for i in range(len(found))])


def group(name: str, errors: Iterable[float]) -> pd.DataFrame:
    values = [float(e) for e in errors]
    figures = pd.DataFrame({"after": values, "u_after": None}, index=[f"{name}{i}" for i in range(len(values))])
    return logarithms(figures, "after")


def test_the_difference_of_two_groups_is_that_of_welchs_test() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.normal(3.0, 1.0, 9), rng.normal(2.0, 4.0, 5)
    ours = difference(quantities(a, "A"), quantities(b, "B"))
    theirs = stats.ttest_ind(a, b, equal_var=False)
    assert ours.significance == pytest.approx(theirs.statistic)
    assert ours.degrees_of_freedom == pytest.approx(theirs.df)
    assert ours.p_value == pytest.approx(theirs.pvalue)
    assert ours.interval == pytest.approx(theirs.confidence_interval(0.95))


def test_units_in_pairs_are_compared_within_their_pair() -> None:
    rng = np.random.default_rng(2)
    device = rng.normal(10.0, 5.0, 8)
    a, b = device + rng.normal(0.3, 0.1, 8), device + rng.normal(0.0, 0.1, 8)
    pairs = {f"{p}{i}": str(i) for p in "AB" for i in range(8)}
    ours = difference(quantities(a, "A"), quantities(b, "B"), pairs)
    theirs = stats.ttest_rel(a, b)
    assert ours.significance == pytest.approx(theirs.statistic)
    assert ours.p_value == pytest.approx(theirs.pvalue)


def test_single_units_are_told_apart_by_their_own_uncertainties() -> None:
    ours = difference(quantities([5.0], "A", 0.3), quantities([4.0], "B", 0.4))
    assert (ours.standard_uncertainty, ours.significance) == (pytest.approx(0.5), pytest.approx(2.0))
    assert ours.p_value == pytest.approx(2.0 * stats.norm.sf(2.0))
    unknown = difference(quantities([5.0], "A"), quantities([4.0], "B", 0.4))
    assert math.isnan(unknown.significance)
    assert math.isnan(unknown.p_value)


def test_p_values_of_several_groups_are_adjusted_from_the_smallest_on() -> None:
    # 4 x 0.005, 3 x 0.01, 2 x 0.03, and 0.04, which cannot fall below the one before it
    found = adjusted([0.01, 0.04, math.nan, 0.03, 0.005])
    assert found == pytest.approx([0.03, 0.06, math.nan, 0.06, 0.02], nan_ok=True)


def test_groups_of_equal_units_are_seldom_told_apart_and_different_ones_nearly_always() -> None:
    rng = np.random.default_rng(3)
    wrong = found = 0
    for _ in range(150):
        means = {"a": 0.0, "b": 0.0, "c": 0.0, "d": 4.0}
        groups = {n: group(n, np.exp(rng.normal(m, 1.0, 6))) for n, m in means.items()}
        told = {name: c.p_value < 0.05 for name, c in compare(groups, "a").items()}
        wrong += told["b"] or told["c"]
        found += told["d"]
    assert wrong / 150 < 0.05 + 3.0 * math.sqrt(0.05 * 0.95 / 150)
    assert found / 150 > 0.9


def test_the_uncertainty_of_a_held_out_error_is_its_scatter_over_simulated_noise() -> None:
    rng = np.random.default_rng(4)
    unit = build_unit(samples=300, held_out_samples=10)
    sigma, samples = 0.003, 400
    for left in (0.0, 0.002, 0.01):  # what the calibration leaves, beside the noise
        errors = np.sqrt(
            np.mean(
                (left * np.sign(np.arange(samples) % 2 - 0.5) + sigma * rng.standard_normal((2000, samples))) ** 2,
                axis=1,
            )
        )
        held_out = {"steps": [{"rms_error": float(np.mean(errors))}], "noise_floor": sigma, "samples": samples}
        (ours,) = unit_figures(unit.calibration, {"accelerometer": held_out}, None)
        assert ours["u_after"] == pytest.approx(np.std(errors), rel=0.08)


def test_the_error_against_the_truth_is_that_of_readings_without_noise_in_random_directions() -> None:
    rng = np.random.default_rng(5)
    unit = build_unit(samples=300, held_out_samples=10)
    part = unit.calibration["gyroscope"]
    truth = {"bias": [1.8, -0.9, 0.35], "matrix": (np.array(part["matrix"]) + rng.normal(0.0, 3e-3, (3, 3))).tolist()}
    direction = rng.standard_normal((200_000, 3))
    motion = 30.0 * direction / np.linalg.norm(direction, axis=1)[:, None]
    reading = truth["bias"] + motion @ np.linalg.solve(np.array(truth["matrix"]), np.eye(3)).T
    left = (reading - part["bias"]) @ np.array(part["matrix"]).T - motion
    held_out = {"steps": [{"rms_error": 1.0}], "reference_rms": 30.0}
    (ours,) = unit_figures(unit.calibration, {"gyroscope": held_out}, None)
    assert against_truth(ours, truth) == pytest.approx(np.sqrt(np.mean(np.sum(left**2, axis=1))), rel=3e-3)


def comparison(x: dict[str, object] | None = None) -> dict[str, object]:
    groups = [
        {"name": n, "series": "", "label": n, "units": [f"{n}{i}" for i in range(4)]}
        for n in ("slow", "fast <b>", "gone")
    ]
    return {"title": "Rates <i>", "groups": groups, "against": "slow", "pairs": None, "x": x, "sensors": ["gyroscope"]}


def figures() -> list[dict[str, object]]:
    return [
        {
            "unit": f"{name}{i}",
            "sensor": "gyroscope",
            "before": 1.5,
            "after": level + 0.0005 * i,
            "noise_floor": 0.009,
            "table_time": 720.0,
            "verdict": "nothing_missing",
            "parameters": {"bias x": Parameter("bias_x", 0.1 + level, "deg/s", 2e-3, 2.0)},
        }
        for name, level in (("slow", 0.010), ("fast <b>", 0.020))
        for i in range(4)
    ]


@pytest.mark.parametrize("x", [None, {"label": "table time, s", "values": None, "named": True}])
def test_the_page_tells_each_group_with_its_interval_and_its_difference(x: dict[str, object] | None) -> None:
    made = section(comparison(x), figures(), "c1")
    (sensor,) = made["sensors"]
    (after,) = sensor["measures"]
    slow, fast = after["rows"]
    assert (number(slow["compared"].mean), slow["table_time"]) == ("0.0107", pytest.approx(720.0))
    assert slow["verdicts"].to_dict() == {"nothing_missing": 4}
    logs = {n: np.log([level + 0.0005 * i for i in range(4)]) for n, level in (("slow", 0.010), ("fast", 0.020))}
    theirs = stats.ttest_ind(logs["fast"], logs["slow"], equal_var=False)
    low, high = (math.exp(v) for v in theirs.confidence_interval(0.95))
    change = math.exp(logs["fast"].mean() - logs["slow"].mean())
    assert fast["compared"].result == "larger"
    assert after["figure"].finding == "Smallest with slow: 0.0107 (0.00976 to 0.0118); all others are larger"
    assert sensor["parameters"]["rows"][1]["cells"][0]["value"] == "0.120"
    page = render("bench", [], [], [made])
    assert low < change < 2.0 < high  # one of them is more than twofold: all are written as factors
    assert f'>× {change:.2f}<br><small class="faint">× {low:.2f} to × {high:.2f}</small>' in page
    assert '<td class="keep">4 nothing missing</td>' in page
    assert "Rates &lt;i&gt;" in page
    assert "fast &lt;b&gt;" in page
    assert "<b>fast" not in page.replace("&lt;", "")


def test_a_finding_names_the_groups_that_are_not_told_apart_from_the_best() -> None:
    values = {"a": [1.0, 1.2, 1.1], "b": [1.1, 1.3, 1.15], "c": [5.0, 5.2, 5.1]}
    groups = {name: group(name, errors) for name, errors in values.items()}
    assert finding(groups, None) == "Smallest with a: 1.10 (0.875 to 1.38); not told apart from it: b"


def test_a_mean_of_nothing_is_nothing_and_of_one_its_own() -> None:
    assert math.isnan(mean_of([]).value)
    alone = mean_of([2.0], [0.1])
    assert alone.expanded_uncertainty == pytest.approx(0.1 * stats.norm.ppf(0.975))
