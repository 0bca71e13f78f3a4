"""The diagnosis names what is hidden, invents nothing, and says what it cannot see."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from bench_session import (
    CONTINUOUS,
    ONE_WAY,
    SIZE,
    STOP_AND_GO,
    THESIS,
    WANDER,
    WHITE,
    Course,
    Session,
    record,
    values_of,
)
from unit_settings import settings_of, with_noise

from pipeline.core.records import Answer, Dependence, Noise, Recording, SensorCalibration, SensorDiagnosis
from pipeline.core.verdicts import Verdict
from pipeline.estimation import reference_least_squares
from pipeline.estimation.effects import fit as fit_effects
from pipeline.estimation.noise import estimate_noise
from pipeline.estimation.observability import not_observable
from pipeline.estimation.observations import observe
from pipeline.estimation.selection import Selection, select
from pipeline.estimation.stages import StageInput
from pipeline.evaluation.diagnosis.findings import with_unknown
from pipeline.evaluation.diagnosis.words import in_words
from pipeline.physics.effects import effect_from, forget, register
from pipeline.physics.kinematics import table_motion
from pipeline.physics.signal.filters import apply_filter
from pipeline.simulation.description import shipped_settings
from tests.published import diagnose

if TYPE_CHECKING:
    from pipeline.core.settings import Settings

SHEET = shipped_settings(sensor="mpu6050").sensor
TABLE = settings_of().table
FIRST = [
    ("accelerometer", "bias_temperature"),
    ("accelerometer", "scale_factor_asymmetry"),
    ("accelerometer", "quadratic_nonlinearity"),
    ("accelerometer", "lever_arm"),
    ("accelerometer", "time_offset"),
    ("gyroscope", "bias_temperature"),
    ("gyroscope", "scale_factor_asymmetry"),
    ("gyroscope", "quadratic_nonlinearity"),
    ("gyroscope", "time_offset"),
    ("gyroscope", "g_sensitivity"),
]
KEYS = {
    "verdict",
    "residual_over_noise",
    "selected",
    "ranking",
    "probability",
    "answer_set",
    "upper_limit",
    "not_observable",
    "unexplained",
    "next_experiment",
    "override",
}
ENTRY = {
    "effect",
    "delta_bic",
    "p_value",
    "parameters",
    "explained_share",
    "held_out_error_before",
    "held_out_error_after",
    "look_alikes",
    "plausible",
}


def settings(sensor: str, configured: Any = ()) -> Settings:
    names = configured if isinstance(configured, str) else list(configured)
    return settings_of(sensor=SHEET, effects={sensor: names})


def diagnosed(sensor: str, recordings: list[Recording], configured: Any = ()) -> dict[str, Any]:
    noise = estimate_noise(sensor, recordings, SHEET.of(sensor))
    return diagnose(SensorCalibration(sensor), recordings, noise, settings(sensor, configured))


@cache
def hidden(sensor: str, *names: str, seed: int = 1, course: Course = STOP_AND_GO) -> list[Recording]:
    rng = np.random.default_rng(seed)
    effects = {name: values_of(sensor, name, rng) for name in names}
    return record(Session(seed, course, {sensor: effects}))


@cache
def named(sensor: str, *names: str) -> dict[str, Any]:
    return diagnosed(sensor, hidden(sensor, *names))


def reason_of(part: dict[str, Any], name: str) -> str:
    return next((e["reason"] for e in part["not_observable"] if e["effect"] == name), "observable")


@pytest.mark.parametrize(("sensor", "name"), FIRST)
def test_an_effect_of_data_sheet_size_is_named_alone_and_mended(sensor: str, name: str) -> None:
    part = named(sensor, name)
    assert part["selected"] == [name]
    assert part["verdict"] == "missing_effect"
    best = part["ranking"][0]
    assert best["effect"] == name
    assert best["plausible"]
    assert best["held_out_error_after"] < best["held_out_error_before"]
    mended = diagnosed(sensor, hidden(sensor, name), [name])
    assert mended["verdict"] == "nothing_missing"
    assert 0.85 < mended["residual_over_noise"] < 1.05 < part["residual_over_noise"]
    assert [name] in [answer["effects"] for answer in part["answer_set"]]
    assert part["probability"][name] > 0.02
    assert mended["answer_set"][0]["effects"] == []
    assert name not in {**mended["probability"], **mended["upper_limit"], **part["upper_limit"]}


@pytest.mark.parametrize("sensor", SIZE)
@pytest.mark.parametrize("wander", [1.0, 5.0])
def test_nothing_is_selected_where_nothing_is_hidden(sensor: str, wander: float) -> None:
    for seed in range(8):
        part = diagnosed(sensor, record(Session(seed + 500, wander=wander)))
        assert part["selected"] == [], (seed, part["ranking"][0])
        assert part["unexplained"] == []
        assert part["verdict"] == "nothing_missing"


def test_two_effects_are_named_together_each_with_its_share_and_held_out_error() -> None:
    part = diagnosed("accelerometer", hidden("accelerometer", "lever_arm", "cross_axis_nonlinearity"))
    assert part["selected"] == ["lever_arm", "cross_axis_nonlinearity"]
    assert part["override"] == "effects.accelerometer=[lever_arm,cross_axis_nonlinearity]"
    first, second = part["ranking"][:2]
    assert first["held_out_error_after"] == second["held_out_error_before"]
    assert second["held_out_error_after"] < second["held_out_error_before"] < first["held_out_error_before"]
    assert first["explained_share"] + second["explained_share"] == pytest.approx(1.0, abs=0.02)


def test_the_second_of_two_effects_is_named_beside_a_configured_one() -> None:
    recordings = hidden("gyroscope", "g_sensitivity", "scale_factor_asymmetry")
    part = diagnosed("gyroscope", recordings, ["g_sensitivity"])
    assert part["selected"] == ["scale_factor_asymmetry"]
    assert part["override"] == "effects.gyroscope=[g_sensitivity,scale_factor_asymmetry]"
    assert "g_sensitivity" not in {entry["effect"] for entry in part["ranking"]}


@pytest.mark.parametrize(("offset", "verdict"), [(0.007, "nothing_missing"), (0.05, "reference_in_doubt")])
def test_a_static_recording_may_face_another_way_and_no_more(offset: float, verdict: str) -> None:
    """Earth's rotation is 0.0042 deg/s; the bias of the turns holds an unknown part of it, and so does the rest."""
    away = np.array([0.0, 0.0, offset])
    recordings = [
        replace(r, gyroscope=r.gyroscope + away) if r.role == "static" and r.gyroscope is not None else r
        for r in record(Session(3, static=True, white=0.1, wander=0.1))
    ]
    method = {"method": {"gyroscope": "reference_least_squares"}}
    sheet = SHEET.gyroscope.replaced(bias_wander=3e-4, counts_per_unit=1e5)
    noise = estimate_noise("gyroscope", recordings, sheet)
    of_unit = settings_of(settings("gyroscope"), sensor=SHEET.replaced(gyroscope=sheet), **method)
    fitted = reference_least_squares.fit(StageInput("gyroscope", with_noise(recordings, of_unit), None, of_unit))
    found = diagnose(fitted, recordings, noise, of_unit)
    assert found["verdict"] == verdict, found["reason"]


def test_a_part_holds_every_field_and_is_json() -> None:
    part = json.loads(json.dumps(named("accelerometer", "quadratic_nonlinearity")))
    assert set(part) >= KEYS
    assert all(set(entry) == ENTRY for entry in part["ranking"])
    others = [entry["delta_bic"] for entry in part["ranking"] if entry["effect"] not in part["selected"]]
    assert others == sorted(others, reverse=True)
    assert len(others) > 10

    listed = {e["effect"] for e in part["ranking"]} | {e["effect"] for e in part["not_observable"]}
    assert {"warm_up", "table_tilt", "lever_arm", "low_pass_lag", "bias_drift"} <= listed


def test_squares_and_magnitudes_on_a_one_g_circle_are_printed_as_look_alikes() -> None:
    part = named("accelerometer", "quadratic_nonlinearity")
    alike = {a["effect"]: a["share"] for a in part["ranking"][0]["look_alikes"]}
    assert 0.9 < alike["scale_factor_asymmetry"] < 0.97
    assert "more than 1 g" in part["next_experiment"]


def test_asymmetry_of_a_gyroscope_that_turns_one_way_is_not_observable() -> None:
    part = diagnosed("gyroscope", hidden("gyroscope", "scale_factor_asymmetry", course=ONE_WAY))
    assert part["selected"] == []
    assert "one direction" in reason_of(part, "scale_factor_asymmetry")
    assert "other direction" in part["next_experiment"]


def test_lever_arm_delay_and_rate_effects_are_not_observable_in_stop_and_go_alone() -> None:
    stops = [r for r in hidden("accelerometer", course=THESIS) if r.role == "accelerometer"]
    part = diagnosed("accelerometer", stops)
    for name in ("lever_arm", "inner_lever_arms", "time_offset", "low_pass_lag", "rate_dependence"):
        assert "never moved" in reason_of(part, name), name
    assert reason_of(part, "table_tilt") == "observable"


def test_a_delay_is_found_by_the_ramps_of_a_rounded_log_and_not_without_them() -> None:
    """Angle and rate have one decimal; each ramp has some samples, whose log the steady turns do not resemble."""
    course = replace(ONE_WAY, rates_dps=(20.0, 50.0, 100.0, 200.0), accelerometer_rates_dps=(30.0,), validation_s=0.0)
    session = Session(2, course, {"gyroscope": {"time_offset": np.array([0.002])}}, interval=0.04)
    turns = [r for r in record(session) if r.role == "gyroscope"]
    rounded = [replace(r, table_angle=np.round(r.table_angle, 1), table_rate=np.round(r.table_rate, 1)) for r in turns]
    noise = Noise(np.full(3, WHITE["gyroscope"]), np.full(3, WANDER["gyroscope"]), 100.0, "rests")

    def selected(recordings: list[Recording], *, search: bool = True) -> Selection:
        return select(observe("gyroscope", recordings, TABLE), [], noise, SHEET.gyroscope, search=search)

    found = selected(rounded)
    assert found.names == ["time_offset"]
    assert found.fit.terms[-1].values == pytest.approx([0.002], abs=3e-5)
    assert "time_offset" not in not_observable(found, [])
    ramps = [np.abs(np.gradient(r.table_rate)) > 0.0 for r in rounded]
    steady = [replace(r, flags=(4 * ramp).astype(np.uint16)) for r, ramp in zip(rounded, ramps, strict=True)]  # stuck
    reasons = not_observable(selected(steady, search=False), [])
    assert all("no sample at which the rate changes" in reasons[name] for name in ("time_offset", "low_pass_lag"))


def test_effects_of_temperature_are_not_observable_without_one_or_at_a_steady_one() -> None:
    without = [replace(r, temperature=None) for r in hidden("gyroscope")]
    assert "hold no temperature" in reason_of(diagnosed("gyroscope", without), "bias_temperature")
    steady = [replace(r, temperature=np.full(r.samples, 31.0)) for r in hidden("gyroscope")]
    assert "changes by no more than" in reason_of(diagnosed("gyroscope", steady), "bias_temperature")


def test_effects_of_time_are_not_observable_where_each_recording_starts_at_zero() -> None:
    part = diagnosed("accelerometer", record(Session(2, clock_shared=False)))
    for name in ("warm_up", "bias_drift", "clock_rate"):
        assert "time between the recordings is not known" in reason_of(part, name)


def test_tilt_of_the_table_never_changes_a_rate() -> None:
    assert "does not change a rate" in reason_of(diagnosed("gyroscope", hidden("gyroscope")), "table_tilt")


@pytest.mark.parametrize(("factor", "offered"), [(2.0, True), (20.0, False)])
def test_an_effect_outside_the_data_sheet_is_implausible_and_far_outside_no_cause(
    factor: float, *, offered: bool
) -> None:
    arm = factor * SHEET.accelerometer.effects["lever_arm"]
    part = diagnosed(
        "accelerometer", record(Session(1, effects={"accelerometer": {"lever_arm": np.array([arm, 0.0, 0.0])}}))
    )
    assert part["selected"] == (["lever_arm"] if offered else [])
    assert [c["effect"] for c in part["candidates"]] == ([] if offered else ["lever_arm"])
    assert not part["ranking"][0]["plausible"]
    assert any("sensor file" in line for line in in_words(part, "accelerometer"))


def test_earth_rotation_is_no_candidate_where_the_place_is_configured() -> None:
    recordings = hidden("gyroscope")
    configured = settings_of(settings("gyroscope"), table={"latitude_deg": 13.7, "azimuth_deg": 0.0})
    noise = estimate_noise("gyroscope", recordings, SHEET.gyroscope)
    part = diagnose(SensorCalibration("gyroscope"), recordings, noise, configured)
    named = {e["effect"] for e in part["ranking"]} | {e["effect"] for e in part["not_observable"]}
    assert "earth_rotation" not in named


def test_a_dependence_that_no_effect_has_is_reported_as_unexplained() -> None:
    recordings = [
        r
        if r.table_angle is None or r.accelerometer is None
        else replace(r, accelerometer=r.accelerometer + 0.004 * np.cos(np.radians(5.0 * r.table_angle))[:, None])
        for r in hidden("accelerometer")
    ]
    part = diagnosed("accelerometer", recordings)
    assert "angle" in {entry["covariate"] for entry in part["unexplained"]}
    assert part["verdict"] == "unexplained"
    assert part["selected"] == []
    assert sum(answer["probability"] for answer in part["answer_set"]) >= 0.95
    assert all(p <= 0.5 for name, p in part["probability"].items() if not name.startswith("other_"))


def test_answers_of_an_unexplained_sensor_may_be_imitations() -> None:
    found = SensorDiagnosis(
        Verdict.UNEXPLAINED,
        [],
        unexplained=[Dependence("temperature", 1e-9)],
        probability={"warm_up": 0.9, "other_angle": 0.3},
        answer_set=[Answer(["warm_up"], 0.6), Answer(["other_angle", "warm_up"], 0.3), Answer([], 0.06)],
    )
    halved = with_unknown(found)
    assert {tuple(a.effects): a.probability for a in halved.answer_set} == pytest.approx(
        {
            ("warm_up",): 0.3,
            ("other_temperature",): 0.33,
            ("other_angle", "warm_up"): 0.15,
            ("other_angle",): 0.15,
            (): 0.03,
        }
    )
    assert halved.probability == pytest.approx({"warm_up": 0.45, "other_angle": 0.3, "other_temperature": 0.33})


def test_a_table_far_off_its_log_is_unexplained_and_not_mended_with_whatever_fits_a_little() -> None:
    rng = np.random.default_rng(8)
    recordings = [
        replace(r, table_angle=r.table_angle + np.cumsum(rng.choice([0.0, 0.3, -0.3], r.samples, p=[0.9, 0.05, 0.05])))
        if r.role == "accelerometer" and r.table_angle is not None
        else r
        for r in hidden("accelerometer")
    ]
    part = diagnosed("accelerometer", recordings)
    assert part["residual_over_noise"] > 3
    assert part["verdict"] == "unexplained"
    assert "none is needed" not in part["next_experiment"]
    assert all(entry["explained_share"] > 0.02 for entry in part["ranking"][: len(part["selected"])])


def test_a_filter_of_the_thesis_leaves_nothing_to_explain_but_its_own_smoothing() -> None:
    verdicts = {"accelerometer": "left_by_method", "gyroscope": "nothing_missing"}  # of a rate, little is smoothed away
    settings_of_filter = settings_of(filter="rc_low_pass", **{"filter.cutoff_hz": 1.0}).filter
    for sensor in SIZE:
        filtered = [apply_filter(r, settings_of_filter) for r in record(Session(1, static=True))]
        part = diagnosed(sensor, filtered)
        assert part["verdict"] == verdicts[sensor]
        assert ("no filter" in part["next_experiment"]) == (sensor == "accelerometer")
        assert (part["selected"], part["unexplained"]) == ([], [])
        assert 0.8 < part["residual_over_noise"] < 1.1


def test_recordings_without_a_table_cannot_be_diagnosed_and_say_so() -> None:
    rests = [replace(r, role="rests", axis=None, table_angle=None) for r in hidden("accelerometer")]
    part = diagnosed("accelerometer", rests)
    assert part["verdict"] == "not_enough_data"
    assert "motion of a table" in reason_of(part, "bias_temperature")
    assert "motion of a table" in in_words(part, "accelerometer")[1]


def test_automatic_effects_are_fitted_and_the_diagnosis_tells_what_was_added() -> None:
    recordings = hidden("gyroscope", "g_sensitivity")
    calibration = fit_effects(
        StageInput(
            "gyroscope", with_noise(recordings, settings("gyroscope", "auto")), None, settings("gyroscope", "auto")
        )
    )
    assert [e.name for e in calibration.effects] == ["g_sensitivity"]
    noise = estimate_noise("gyroscope", recordings, SHEET.gyroscope)
    part = diagnose(calibration, recordings, noise, settings("gyroscope", "auto"))
    assert part["selected"] == ["g_sensitivity"]


def test_units_do_not_change_what_is_selected() -> None:
    recordings = hidden("accelerometer", "quadratic_nonlinearity", "table_tilt")
    scaled = [
        replace(r, accelerometer=None if r.accelerometer is None else 9.80665 * r.accelerometer) for r in recordings
    ]
    here = diagnosed("accelerometer", recordings)
    beyond = settings_of(settings("accelerometer"), **{"sensor.accelerometer.accept_implausible": True})
    noise = estimate_noise("accelerometer", scaled, SHEET.accelerometer)
    there = diagnose(SensorCalibration("accelerometer"), scaled, noise, beyond)
    assert there["selected"] == here["selected"] == ["quadratic_nonlinearity", "table_tilt"] or there[
        "selected"
    ] == here["selected"] == ["table_tilt", "quadratic_nonlinearity"]


def test_words_say_verdict_size_and_what_to_do() -> None:
    part = named("accelerometer", "quadratic_nonlinearity")
    text = "\n".join(in_words(part, "accelerometer"))
    assert "misses quadratic nonlinearity" in text
    assert "K2_x = " in text
    assert "held-out" in text
    assert part["override"] == "effects.accelerometer=[quadratic_nonlinearity]"
    assert in_words(None, "gyroscope") == ["The gyroscope was not calibrated, so there is nothing to diagnose."]


@pytest.mark.study
@pytest.mark.parametrize("sensor", SIZE)
@pytest.mark.parametrize("course", [STOP_AND_GO, CONTINUOUS, ONE_WAY])
def test_at_most_two_of_a_hundred_sessions_without_an_effect_invent_one(sensor: str, course: Course) -> None:
    invented = [
        (seed, part["selected"])
        for seed in range(100)
        if (part := diagnosed(sensor, record(Session(seed + 5000, course, wander=1.0 + 4.0 * (seed % 2)))))["selected"]
    ]
    assert len(invented) <= 2, invented


def test_an_effect_that_one_axis_does_not_show_is_diagnosed_by_the_others() -> None:
    definition = {"name": "of_force", "owner": "sensor", "sensors": ["gyroscope"], "meaning": "Scale factor by force."}
    register(effect_from({**definition, "terms": {"k": {"formula": "u * fz", "unit": "1/g"}}}, "of_force.yaml"))
    recordings = []
    for recording in record(Session(1, STOP_AND_GO, {})):
        motion = table_motion(recording, TABLE)
        if motion is not None and recording.gyroscope is not None:
            reading = recording.gyroscope + 0.01 * motion.angular_rate * motion.specific_force[:, 2:]
            recording = replace(recording, gyroscope=reading)  # noqa: PLW2901
        recordings.append(recording)
    try:
        part = diagnosed("gyroscope", recordings)
    finally:
        forget()
    assert part["selected"][:1] == ["of_force"]
    found = next(e for e in part["ranking"] if e["effect"] == "of_force")
    assert found["parameters"]["k_x"]["value"] == pytest.approx(0.01, rel=0.05)


@pytest.mark.study
@pytest.mark.parametrize(("sensor", "name"), [(s, n) for s in SIZE for n in SIZE[s]])
def test_each_effect_is_named_or_called_invisible_or_a_look_alike_of_what_is_named(sensor: str, name: str) -> None:
    for seed in range(3):
        part = diagnosed(sensor, hidden(sensor, name, seed=seed + 40, course=CONTINUOUS))
        alike = {a["effect"] for entry in part["ranking"][:1] for a in entry["look_alikes"]}
        assert (
            part["selected"] == [name]
            or reason_of(part, name) != "observable"
            or name in alike
            or (part["selected"] == [] and next(e for e in part["ranking"] if e["effect"] == name)["delta_bic"] < 10)
        )
