"""The arithmetic of a blind study, on truths and results made by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

from imu_research.figures import MeasuredFigure, clustered_share
from imu_research.study.page import by_signal, confusions, found_at, instead, of_shapes, page, table_of
from imu_research.study.result import ScoredCase, cases_of
from imu_research.study.scores import (
    answer_scores,
    exact,
    excess_gone,
    false_selections,
    family_scores,
    first_is_right,
    hard_to_replace,
    in_the_set,
    mean_excess_gone,
    not_silent,
    ratios,
    reliability,
    reliability_diagram,
)


def said(*selected: str, key: str = "single-00000", **more: Any) -> dict[str, Any]:
    quiet = {"verdict": "missing_effect", "plausible": True, "inflated": False, "not_observable": []}
    return {"key": key, "sensor": "gyroscope", "selected": list(selected), "look_alikes": {}, **quiet, **more}


def truth(*hidden: str, key: str = "single-00000", **more: Any) -> dict[str, Any]:
    case = {"model": "mpu6050", "sensor": "gyroscope", "procedure": "one_way", "left_out": [], "shape": ""}
    return {"key": key, "family": key.partition("-")[0], "hidden": {name: [1.0] for name in hidden}, **case, **more}


def case(*parts: dict[str, Any]) -> ScoredCase:
    """Return the case of a truth and a result; a later part replaces values of an earlier one."""
    return ScoredCase.from_json({key: value for part in parts for key, value in part.items()})


def test_a_look_alike_counts_only_where_its_share_is_declared_over_95_percent() -> None:
    for share, right in ((0.96, True), (0.94, False)):
        alike = {"time_offset": {"low_pass_lag": share}}
        assert first_is_right(case(truth("low_pass_lag"), said("time_offset", look_alikes=alike))) is right


def test_an_exact_set_has_nothing_more_and_nothing_less() -> None:
    assert exact(case(truth("a", "b"), said("b", "a")))
    assert not exact(case(truth("a", "b"), said("a")))
    assert not exact(case(truth("a"), said("a", "b")))
    assert exact(case(truth("a", "b"), said("c", "b", look_alikes={"c": {"a": 0.99}})))
    assert not exact(case(truth("a", "b"), said("b", look_alikes={"b": {"a": 0.99}})))


def test_a_false_selection_is_counted_once_a_unit_by_the_larger_gain_of_its_sensors() -> None:
    gains = [{"bias_drift": 11.0, "time_offset": 3.0}, {"bias_drift": 13.0, "g_sensitivity": 7.0}]
    null = {"rests": 0, "noise": "normal"}
    cases = [case(truth(**null), said(gains=each)) for each in gains]
    cases.append(case(truth(**null), said(key="null_normal-00001", gains={"warm_up": -9.0, "time_offset": -2.0})))
    slow, other = false_selections(cases)
    assert slow == ["on a table", "as the sensor file", "slow", 2, 1, 1, 1, 1, 0, 0, 0, 0, "0.000 to 84.19 %"]
    assert other == ["on a table", "as the sensor file", "other", 2, 1, 0, 0, 0, 0, 0, 0, 0, "0.000 to 84.19 %"]
    assert false_selections([case(truth(), said())]) == []  # 84.19 %: 1 - sqrt(0.025)


def test_another_effect_is_silent_unless_a_warning_is_said() -> None:
    assert not not_silent(case(truth(), said("b")))
    for warning in ({"verdict": "unexplained"}, {"plausible": False}, {"inflated": True}):
        assert not_silent(case(truth(), said("b", **warning)))
    assert not_silent(case(truth(), said()))


def test_what_another_effect_replaces_is_no_test_of_a_warning() -> None:
    removed = truth("a", key="removed-00000", left_out=["a"])
    for share, counts in ((0.96, False), (0.94, True)):
        whole = said("a", look_alikes={"a": {"b": share}})
        assert hard_to_replace(case(removed, said("b", whole=whole))) is counts
        scores = family_scores([case(removed, said("b", key=removed["key"], whole=whole))])
        assert [(s.value, s.total) for s in scores] == ([(0.0, 1)] if counts else [])
    assert not hard_to_replace(case(removed, said("b", whole=said("b"))))


def test_excess_is_counted_above_five_percent_of_the_floor() -> None:
    assert excess_gone(case(truth(), said(held_out={"before": 1.04, "after": 1.0, "floor": 1.0}))) is None
    assert excess_gone(case(truth(), said(held_out={"before": 2.0, "after": 1.1, "floor": 1.0}))) == pytest.approx(0.9)


def test_a_unit_in_which_nothing_is_selected_counts_with_all_of_its_excess() -> None:
    held = [{"before": 2.0, "after": after, "floor": 1.0} for after in (1.0, 2.0)]
    cases = [case(truth("a"), said(held_out=entry)) for entry in held]
    cases.append(case(truth(key="shape_band-00000", shape="band"), said(held_out=held[1])))
    mean = family_scores(cases)[-1]
    assert (mean.value, mean.total) == (0.5, 2)
    assert mean.name.endswith("(least 0%)")
    assert mean.interval == pytest.approx((0.5 - 0.98, 0.5 + 0.98))
    assert mean_excess_gone(cases[:1]) == []


def test_a_fault_is_a_miss() -> None:
    lines = [{"key": "single-00000", "error": "ValueError: x"}]
    score = family_scores(cases_of([truth("a")], lines))[0]
    assert (score.value, score.total, score.misses) == (0.0, 1, ("single-00000",))


def test_both_sensors_of_a_unit_count_where_nothing_is_hidden() -> None:
    null = truth(key="null_white-00003")
    doubted = {"sensor": "accelerometer", "verdict": "unexplained"}
    lines = [said(key=null["key"]), said("a", key=null["key"], **doubted)]
    selected, sure = family_scores(cases_of([null], lines))
    for score in (selected, sure):
        assert (score.value, score.total, score.misses) == (0.5, 2, ("null_white-00003 accelerometer",))
    assert "states no doubt" in sure.name


def test_tables_count_what_was_said() -> None:
    table = table_of(
        [
            case(truth("a"), said("b")),
            case(truth("a"), said("a")),
            case(truth("a", key="tiny-00000"), said()),
            case(truth("a", key="removed-00000", left_out=["a"]), said("c", plausible=False)),
        ]
    )
    assert confusions(table) == [["gyroscope", "`a`", "b", 1], ["gyroscope", "`a`", "nothing", 1]]
    assert instead(table) == [["gyroscope", "`a`", "c", "yes", 1]]
    assert found_at(table) == [["gyroscope", "`a`", "1 of 2", "", "0 of 1"]]


def test_units_in_which_every_effect_stands_out_are_counted_by_themselves() -> None:
    lefts = [({"a": 500.0, "b": 99.0}, ["a"]), ({"a": 500.0, "b": 100.0}, ["b", "a"])]
    keys = ["pairs-00000", "pairs-00001"]
    cases = [
        case(truth("a", "b", key=key, signal_left=left), said(*selected, key=key))
        for key, (left, selected) in zip(keys, lefts, strict=True)
    ]
    assert [(s.value, s.total) for s in family_scores(cases)] == [(0.5, 2), (1.0, 1)]
    assert by_signal(cases) == [
        ["60 to 100", 1, "0 %", "0 to 79 %"],
        ["100 to 200", 1, "100 %", "21 to 100 %"],
        ["500 and more", 2, "100 %", "34 to 100 %"],
    ]


def test_a_form_of_unknown_physics_is_unexplained_warned_of_silently_replaced_or_missed() -> None:
    held = {"before": 2.0, "after": 1.2, "floor": 1.0}
    ways = [said(verdict="unexplained"), said("a", inflated=True), said("a"), said("a"), said()]
    ways.append(said("a") | answer(("a",), ("b", "other_temperature")))
    shape = truth(key="shape_band-00000", shape="band")
    (row,) = of_shapes([case(shape, way, {"held_out": held}) for way in ways])
    assert row == ["shape band", 6, 1, 1, 1, 2, 1, "a (4)", "80 % (n = 6)"]


def test_the_page_has_the_figures_the_code_and_the_cases_that_miss() -> None:
    cases = [case(truth("g_sensitivity"), said("b", code="0123"))]
    text = page(cases, "python -m pipeline study DIR")
    assert "| one effect at the sensor file's size: named first | 1 | 0.0 % | 0.0 to 79.3 % | >= 98 % |" in text
    assert "code being `0123`." in text
    assert "| single-00000 | mpu6050 gyroscope one_way | g_sensitivity | b |" in text
    assert "False selections" not in text
    null = case(truth(key="null_hand_white-00000", rests=20, noise="white"), said(gains={"warm_up": 11.0}))
    found = page([*cases, null], "python -m pipeline study DIR")
    assert "| by hand | as the sensor file | slow | 1 | 1 | 1 | 1 | 0 |" in found
    assert "| mpu6050 | gyroscope | `g_sensitivity` | 0.1 | deg/s/g |" in text


def answer(*sets: tuple[str, ...], **more: Any) -> dict[str, Any]:
    each = [{"effects": list(names), "probability": 0.9 / len(sets)} for names in sets]
    return {"answer_set": each, "probability": {}, "upper_limit": {}, **more}


def test_the_truth_must_be_one_of_the_answers_by_its_own_name() -> None:
    pair = truth("b", "a") | said("a")
    assert in_the_set(case(pair, answer(("a",), ("a", "b"))))
    assert not in_the_set(case(pair, answer(("a",), ("b",)), {"look_alikes": {"a": {"b": 1.0}}}))
    assert in_the_set(case(truth("a", key="unseen-00000"), said(), answer(())))
    assert not in_the_set(case(truth(key="null_white-00000"), said(), answer(("a",))))
    keys = ["pairs-00000", "pairs-00001"]
    cases = [case(pair, answer(names), {"key": key}) for key, names in zip(keys, (("a", "b"), ("a",)), strict=True)]
    shares = {s.name: (s.value, s.total) for s in answer_scores(cases)}
    assert shares["truth in the 95 % answer set"] == (0.5, 2)
    assert shares["most probable answer: exactly the truth"] == (0.5, 2)


def test_probabilities_of_answers_and_of_whole_sets_are_compared_by_unit() -> None:
    cases = [case(truth(name), said(), answer(("a",), ())) for name in ("a", "a", "b")]
    (alone,) = reliability(cases, "single answers")
    assert (alone.value, alone.total, float(alone.name)) == (pytest.approx(2 / 6), 6, 0.45)
    (whole,) = reliability(cases, "answer sets")
    assert (whole.value, whole.total, float(whole.name), whole.missed) == (pytest.approx(2 / 3), 3, 0.9, False)


def test_by_hand_only_another_effect_counts_against_the_diagnosis() -> None:
    key, alike = "hand_ferraris-00000", {"look_alikes": {"b": {"a": 0.99}}}
    told = [said(key=key), said("a", key=key), said("b", key=key, **alike), said("b", key=key, look_alikes={"b": {}})]
    scores = {s.name: s for s in family_scores([case(truth("a", key=key), each) for each in told])}
    assert scores["by hand, faces and turns, one effect: no other named"].value == 0.75
    assert scores["by hand, one effect that the recordings can show: named first"].value == 0.5


def test_harm_is_a_held_out_error_that_an_offered_effect_raises() -> None:
    errors = [{"before": 1.0, "after": 1.2, "floor": 0.1, "raised": raised} for raised in (False, False, True)]
    cases = [case(truth("a"), said("a", held_out=each, offered=True)) for each in errors]
    cases.append(case(truth("a"), said("a", held_out=errors[2], offered=False)))
    scores = {s.name: s for s in family_scores(cases)}
    harm = scores["an effect is offered: it does not raise the held-out error"]
    assert (harm.value, harm.total, harm.missed) == (pytest.approx(2 / 3), 3, True)


def test_a_goal_is_missed_by_the_value_or_by_an_interval_that_does_not_contain_it() -> None:
    assert MeasuredFigure("", 0.979, 10, ">= 98 %", (0.9, 1.0)).missed
    assert not MeasuredFigure("", 0.98, 10, ">= 98 %", (0.9, 1.0)).missed
    assert MeasuredFigure("", 0.002, 10, "<= 0.1 %", (0.0, 1.0)).missed
    assert MeasuredFigure("", 0.5, 10, "contains 95 %", (0.4, 0.6)).missed
    assert not MeasuredFigure("", 37.0, 1, "<= 40", unit="ms").missed


def test_the_interval_of_a_clustered_share_is_that_of_the_units() -> None:
    """Units that are all right or all wrong: the interval of a mean of k zeros and ones, by Student's t."""
    inside = [np.full(5, value) for value in [True] * 30 + [False] * 10]
    (found,) = clustered_share("", inside)
    mean, each = 0.75, np.array([1.0] * 30 + [0.0] * 10)
    half = stats.t.ppf(0.995, 39) * each.std(ddof=1) / np.sqrt(40.0)
    assert found.interval == (pytest.approx(mean - half), pytest.approx(mean + half))
    assert (found.value, found.total) == (mean, 200)


def test_limits_are_counted_where_the_effect_was_not_selected() -> None:
    limits = {"a": {"p": {"value": 1.5, "unit": "g"}}}
    low = {"a": {"p": {"value": 0.5, "unit": "g"}}}
    cases = [
        case(truth("a", key="limit_30-00000"), said(), answer((), upper_limit=each))
        for each in (limits, low, {}, limits)
    ]
    assert ratios(cases, "limit_30").tolist() == [1.5, 0.5, 1.5]
    assert [(s.value, s.total) for s in answer_scores(cases)] == [(pytest.approx(2 / 3), 3), (1.5, 3)]


def test_said_probabilities_are_compared_with_the_share_that_is_true() -> None:
    cases = [case(truth("a"), said(), answer((), probability={"a": p, "b": 0.02})) for p in (0.6, 0.6, 0.97)]
    cases += [case(truth("b"), said(), answer((), probability={"a": 0.6, "b": 0.02}))]
    found = [(float(b.name), b.value, b.total) for b in reliability(cases)]
    assert found == [(pytest.approx(0.02), 0.25, 4), (pytest.approx(0.6), pytest.approx(2 / 3), 3), (0.97, 1.0, 1)]
    assert reliability_diagram(cases).count("<svg xmlns=") == 1
    assert reliability_diagram([]) == ""
