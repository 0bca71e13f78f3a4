"""What a plan says of procedures: what they cannot show, what would help, and how long they take."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from pipeline.app.plan import best_changes, changes, helps_most, of_sensor, plan_of, simulate_procedure
from pipeline.core.errors import ConfigurationError
from pipeline.simulation.campaign import simulate_unit
from pipeline.simulation.description import UnitDescription

ONE_WAY = UnitDescription("U", course={"step_deg": 15.0, "validation_s": 0.0, "static_s": 60.0})
BOTH_WAYS = replace(ONE_WAY, course={**ONE_WAY.course, "both_directions": True})


@pytest.fixture(scope="module")
def one_way() -> dict[str, Any]:
    return plan_of(ONE_WAY)


def _reasons(part: dict[str, Any]) -> dict[str, str]:
    return {entry["effect"]: entry["reason"] for entry in part["not_observable"]}


def _sizes(part: dict[str, Any]) -> dict[str, float]:
    return {entry["effect"]: entry["smallest"] for entry in part["effects"]}


def test_stop_and_go_shows_no_lever_arm_and_no_delay() -> None:
    rehearsal = simulate_procedure(replace(ONE_WAY, course={**ONE_WAY.course, "step_deg": 1.0}))
    stops = [r for r in rehearsal.recordings if r.role != "gyroscope"]
    part = of_sensor("accelerometer", replace(rehearsal, recordings=stops))
    reasons = _reasons(part)
    moving = {"lever_arm", "inner_lever_arms", "time_offset", "low_pass_lag", "clock_rate", "rate_dependence"}
    assert all("never moved" in reasons[name] for name in moving)
    assert {"scale_factor_asymmetry", "quadratic_nonlinearity", "table_tilt", "hysteresis"} <= _sizes(part).keys()


def test_turns_in_one_direction_show_no_asymmetry_of_the_gyroscope(one_way: dict[str, Any]) -> None:
    reasons = _reasons(one_way["gyroscope"])
    assert "one direction" in reasons["scale_factor_asymmetry"]
    assert "one direction" in reasons["vibration_rectification"]
    assert "scale_factor_asymmetry" in _sizes(plan_of(BOTH_WAYS)["gyroscope"])


def test_an_effect_below_the_noise_even_at_its_limit_is_said_to_hide() -> None:
    reason = _reasons(plan_of(replace(ONE_WAY, sensor="stim300"))["gyroscope"])["cubic_nonlinearity"]
    assert reason.startswith("even at its limit of 2.5e-09 1/(deg/s)^2 it would be below the noise")


def test_the_other_direction_helps_most_where_turns_go_in_one(one_way: dict[str, Any]) -> None:
    gains = best_changes(ONE_WAY, one_way)
    best = gains[0]
    assert best.change.options == "--both-directions"
    assert "gyroscope.scale_factor_asymmetry" in best.shown
    assert 0.0 < best.minutes < 2.0
    lines = helps_most(gains)
    assert lines[1] == f"  1. make every turn in the other direction too (--both-directions): {best.minutes:+.1f} min"
    assert "shows scale_factor_asymmetry, vibration_rectification of the gyroscope" in lines[2]
    assert len(lines) == 7
    by_option = {gain.change.options: gain for gain in gains}
    assert 0.5**0.5 - 0.01 < by_option["--dwell 2"].factor < 1.0  # sizes fall by the root of the time at most
    assert "--both-directions" in [change.options for change in changes(ONE_WAY)]
    assert "--both-directions" not in [change.options for change in changes(BOTH_WAYS)]


def test_longer_rests_find_smaller_sizes_by_the_root_of_their_length_at_most(one_way: dict[str, Any]) -> None:
    longer = plan_of(replace(ONE_WAY, course={**ONE_WAY.course, "dwell_s": 2.0}))
    before, after = (_sizes(plan["accelerometer"]) for plan in (one_way, longer))
    for name in ("quadratic_nonlinearity", "hysteresis", "cross_axis_nonlinearity"):
        assert 0.5**0.5 - 0.01 < after[name] / before[name] < 0.95
    assert longer["minutes"] - one_way["minutes"] == pytest.approx(3 * 25 / 60.0, abs=0.05)


def test_the_time_is_that_of_the_simulated_session(one_way: dict[str, Any]) -> None:
    recordings, _ = simulate_unit(ONE_WAY, 1, 0)
    assert one_way["minutes"] == pytest.approx(max(r.time[-1] for r in recordings) / 60.0, abs=1e-3)
    assert one_way["samples"] == sum(r.samples for r in recordings)


def test_a_plan_does_not_change_from_one_time_to_the_next(one_way: dict[str, Any]) -> None:
    assert plan_of(ONE_WAY) == one_way


def test_a_table_without_a_log_is_said_to_hide_everything() -> None:
    plan = plan_of(replace(ONE_WAY, table="hand"))
    assert not plan["at_a_table"]
    assert "motion of a table" in plan["accelerometer"]["reason"]
    assert best_changes(ONE_WAY, plan) == []


def test_rates_beyond_the_full_scale_and_tables_without_encoders_are_noted() -> None:
    fast = plan_of(replace(ONE_WAY, table="mark2", course={**ONE_WAY.course, "rates_dps": [300.0]}))
    assert any("300 deg/s, is beyond the gyroscope's full scale of 250 deg/s" in text for text in fast["warnings"])
    assert any("angle errors of 0.3 deg read as 5.2 mg" in text for text in fast["warnings"])


@pytest.mark.parametrize(
    ("course", "message"),
    [
        ({"dwell_s": 0.0}, "dwell_s is 0.0; it must be greater than 0"),
        ({"rates_dps": [60.0, -1.0]}, "rates_dps.1 is -1.0; it must be greater than 0"),
        ({"rates_dps": []}, r"rates_dps is \[\]; tuple should have at least 1 item"),
        ({"static_s": -1.0}, "static_s is -1.0; it must be greater than or equal to 0"),
        ({"step_deg": 400.0}, "step_deg is 400.0; it must be less than or equal to 360"),
    ],
)
def test_a_course_that_cannot_be_run_is_refused(course: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        plan_of(replace(ONE_WAY, course=course))


def test_a_chamber_shows_the_effects_of_temperature() -> None:
    course = {"kinds": ["rest", "turn"], "soak_s": 600.0, "static_s": 30.0}
    without = UnitDescription("U", procedure="listed", table="hand", interval_s=0.1, course=course)
    chamber = replace(without, course={**course, "kinds": ["rest", "turn", "soak"]})
    plans = [of_sensor("gyroscope", simulate_procedure(unit), half_only=True) for unit in (without, chamber)]
    warming, soaked = map(_sizes, plans)
    assert {"bias_temperature_cubic", "temperature_lag"} <= soaked.keys() - warming.keys()
    assert soaked["bias_temperature"] < 0.1 * warming["bias_temperature"]  # 60 degC against the 5 of the warm-up
    assert {change.options for change in changes(chamber)} >= {"--soaks 2", "--dwell 10"}
