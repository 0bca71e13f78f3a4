"""The diagnosis without a table: rests and moves name what is hidden, invent nothing, and say what they cannot see."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hand_session import WARM, Unit, hand_held
from hand_simulator import Hand, draw
from unit_settings import settings_of, with_noise

from pipeline.estimation.accelerometer import nonlinear_least_squares
from pipeline.estimation.noise import estimate_noise
from pipeline.estimation.stages import StageInput
from pipeline.evaluation.diagnosis.words import in_words
from pipeline.physics.effects import effect_from, forget, register
from tests.published import diagnose, validate

NAMED = [
    ("mpu6050", "accelerometer", "scale_factor_asymmetry"),
    ("mpu6050", "accelerometer", "quadratic_nonlinearity"),
    ("mpu6050", "accelerometer", "cubic_nonlinearity"),
    ("mpu6050", "accelerometer", "cross_axis_nonlinearity"),
    ("mpu6050", "accelerometer", "bias_temperature"),
    ("mpu6050", "accelerometer", "scale_factor_temperature"),
    ("stim300", "accelerometer", "bias_temperature"),
]


def reasons(part: dict[str, Any]) -> dict[str, str]:
    return {e["effect"]: e["reason"] for e in part["not_observable"]}


@cache
def of_quadratic() -> dict[str, Any]:
    unit = hand_held("mpu6050", 11, {"accelerometer.quadratic_nonlinearity": None})
    return unit.diagnosed("accelerometer")


def with_readings(unit: Unit, change: Any) -> Unit:
    """Return a unit whose accelerometer reads more, a function of the time."""
    first, *others = unit.recordings
    assert first.accelerometer is not None
    return replace(unit, recordings=[replace(first, accelerometer=first.accelerometer + change(first.time)), *others])


@pytest.mark.parametrize(("model", "sensor", "name"), NAMED)
def test_an_effect_of_data_sheet_size_is_named_alone_and_mended(model: str, sensor: str, name: str) -> None:
    unit = hand_held(
        model, 11, {f"{sensor}.{name}": None}, temperature=WARM if "temperature" in name else None, holdout_every=3
    )
    before = unit.calibrated(sensor)
    part = unit.diagnosed(sensor, calibration=before)
    assert part["verdict"] == "missing_effect"
    assert part["selected"] == [name]
    assert part["override"] == f"effects.{sensor}=[{name}]"
    assert [name] in [answer["effects"] for answer in part["answer_set"]]
    assert name not in part["upper_limit"]
    best = part["ranking"][0]
    assert best["effect"] == name
    assert best["plausible"]
    assert best["delta_bic"] > 10.0
    assert best["explained_share"] > 0.8
    assert best["held_out_error_after"] < best["held_out_error_before"]
    mended = unit.diagnosed(sensor, [name], before)
    assert mended["selected"] == []
    assert [] in [answer["effects"] for answer in mended["answer_set"]]
    assert name not in mended["probability"]
    assert mended["residual_over_noise"] < 1.5 < part["residual_over_noise"]


@pytest.mark.parametrize("model", ["mpu6050", "stim300"])
def test_nothing_is_selected_where_nothing_is_hidden(model: str) -> None:
    ratios = []
    for seed in range(10):
        part = hand_held(model, 500 + seed).diagnosed("accelerometer")
        assert part["selected"] == [], (seed, part["ranking"][0])
        assert part["unexplained"] == [], seed
        ratios.append(part["residual_over_noise"])
    assert 0.85 < np.mean(ratios) < 1.1


def test_nothing_is_selected_of_a_gyroscope_without_effects() -> None:
    for seed in range(2):
        part = hand_held("mpu6050", 600 + seed).diagnosed("gyroscope")
        assert (part["selected"], part["unexplained"], part["verdict"]) == ([], [], "nothing_missing"), seed


def test_rests_that_scatter_are_told_but_no_effect_is_blamed() -> None:
    rng = np.random.default_rng(8)

    def tremor(time: np.ndarray) -> np.ndarray:
        block = (time // 3.0).astype(int)
        return 1e-3 * rng.standard_normal((block.max() + 1, 3))[block]

    part = with_readings(hand_held("mpu6050", 12), tremor).diagnosed("accelerometer")
    assert part["selected"] == []
    assert part["verdict"] == "nothing_missing"
    assert part["residual_over_noise"] > 2.0
    assert "firmly" in part["next_experiment"]


def test_a_bias_that_follows_time_in_no_way_of_the_catalogue_is_unexplained() -> None:
    def swing(time: np.ndarray) -> np.ndarray:
        return 0.02 * np.sin(2.0 * np.pi * time[:, None] / 300.0 + np.array([0.0, 1.0, 2.0]))

    part = with_readings(hand_held("mpu6050", 13, holdout_every=0), swing).diagnosed("accelerometer")
    told = [entry["covariate"] for entry in part["unexplained"]]
    assert "time" in told
    assert part["verdict"] == "unexplained"
    assert part["selected"] == []


def test_effects_of_a_table_and_of_motion_are_not_observable_each_with_its_reason() -> None:
    told = reasons(hand_held("mpu6050", 14).diagnosed("accelerometer"))
    for name in ("table_tilt", "table_encoder_error", "time_offset", "low_pass_lag", "clock_rate"):
        assert told[name] == "there is no table"
    assert told["hysteresis"] == "by hand the direction of the last move before a rest is not logged"
    for name in ("rate_dependence", "vibration_rectification", "inner_lever_arms"):
        assert told[name] == "at rest nothing moves, and it adds nothing"
    assert "are unknown" in told["lever_arm"]
    gyroscope = reasons(hand_held("mpu6050", 14).diagnosed("gyroscope"))
    assert "heading" in gyroscope["earth_rotation"]
    assert "g_sensitivity" not in gyroscope


def test_a_small_effect_is_not_called_absent() -> None:
    part = hand_held("stim300", 15).diagnosed("accelerometer")
    told = reasons(part)
    assert "would hide in the scatter of 40 rests" in told["scale_factor_temperature"]
    assert "scale_factor_temperature" not in {entry["effect"] for entry in part["ranking"]}


def test_without_a_temperature_nothing_is_said_of_it() -> None:
    unit = hand_held("mpu6050", 16)
    bare = replace(unit, recordings=[replace(r, temperature=None) for r in unit.recordings])
    part = bare.diagnosed("accelerometer")
    assert reasons(part)["bias_temperature"] == "the recordings hold no temperature"
    assert "bias temperature" in part["next_experiment"]


def test_six_positions_are_not_enough_and_the_advice_says_what_is() -> None:
    unit = hand_held("mpu6050", 17, procedure="six_positions", holdout_every=0)
    part = unit.diagnosed("accelerometer")
    assert part["verdict"] == "not_enough_data"
    assert part["residual_over_noise"] is None  # six rests, six parameters
    assert part["ranking"] == []
    assert "6 rests are too few" in reasons(part)["quadratic_nonlinearity"]
    assert "record 40 rests" in part["next_experiment"]
    noise = estimate_noise("accelerometer", unit.recordings, unit.settings.sensor.accelerometer)
    judged = validate(unit.calibrated("accelerometer"), unit.recordings, noise, unit.settings)
    assert judged["reason"].endswith("through its 6 rests exactly, so that their error does not test it: record more")
    assert all(step["rms_error"] is None for step in judged["steps"])
    unit = replace(unit, settings=settings_of(unit.settings, procedure={"faces": {"accuracy_deg": 1.0}}))
    assert "in addition to those on the six faces" in unit.diagnosed("accelerometer")["next_experiment"]


def test_twenty_four_orientations_select_nothing_where_nothing_is_hidden() -> None:
    for seed in range(5):
        part = hand_held("mpu6050", 700 + seed, procedure="orientations_24").diagnosed("accelerometer")
        assert part["selected"] == [], seed


def test_what_looks_alike_on_a_one_g_sphere_is_printed() -> None:
    part = of_quadratic()
    alike = {a["effect"]: a["share"] for a in part["ranking"][0]["look_alikes"]}
    assert 0.85 < alike["scale_factor_asymmetry"] < 1.0
    assert "scale factor asymmetry" in part["next_experiment"]


def test_the_added_variable_has_the_slope_that_was_fitted_a_point_a_rest() -> None:
    part = of_quadratic()
    for panel in part["pictures"]["added_variable"]["panels"]:
        x, y = np.array(panel["x"]), np.array(panel["mean"])
        assert len(x) == 40
        assert x @ y / (x @ x) == pytest.approx(panel["value"], rel=0.02)


def test_a_part_is_json_and_is_told_in_words() -> None:
    part = of_quadratic()
    text = " ".join(in_words(json.loads(json.dumps(part)), "accelerometer"))
    assert "misses quadratic nonlinearity" in text
    assert "there is no table" in text
    assert "What is missing, with 95 % probability: quadratic nonlinearity" in text
    doubted = " ".join(in_words(part | {"verdict": "unexplained"}, "accelerometer"))
    assert doubted.startswith("No plausible effect of the catalogue explains")
    assert "What is missing" not in doubted


def test_a_drift_that_a_short_recording_hides_is_given_the_time_that_shows_it() -> None:
    """Drifts of half the limit: 2 of 16 are found in 11 minutes, 8 of 16 in 16, and 12 of 16 in 19."""
    drawn = draw(Hand(rests=20), 1)
    noise = estimate_noise("accelerometer", [drawn.recording], drawn.settings.sensor.accelerometer)
    calibration = nonlinear_least_squares.fit(
        StageInput("accelerometer", with_noise([drawn.recording], drawn.settings), None, drawn.settings)
    )
    found = diagnose(calibration, [drawn.recording], noise, drawn.settings)["not_observable"]
    (reason,) = [entry["reason"] for entry in found if entry["effect"] == "bias_drift"]
    (minutes,) = re.findall(r"within (\d+) min", reason)
    assert 11.0 < float(minutes) < 19.0


@pytest.mark.parametrize(("sensor", "change"), [("gyroscope", 0.1), ("accelerometer", 0.01)])
def test_a_static_recording_of_another_switching_on_is_in_doubt(sensor: str, change: float) -> None:
    unit = hand_held("mpu6050", 3)
    by_hand = {"gyroscope": "rests_and_moves", "accelerometer": "nonlinear_least_squares"}
    unit = replace(unit, settings=settings_of(unit.settings, method=by_hand))
    moves, static = unit.recordings
    shifted = replace(static, **{sensor: static.reading(sensor) + change})
    other = replace(unit, recordings=[moves, shifted])
    same, after = unit.diagnosed(sensor), other.diagnosed(sensor)
    assert same["verdict"] == "nothing_missing"
    assert after["verdict"] == "reference_in_doubt"
    assert "times of switching on" in after["reason"]
    assert "in the session of the other recordings" in after["next_experiment"]


def test_by_hand_a_formula_that_gravity_makes_constant_is_not_observable() -> None:
    definition = {"name": "of_length", "owner": "sensor", "sensors": ["accelerometer", "gyroscope"], "meaning": "Mine.",
                  "terms": {"c": {"formula": "fx * fx + fy * fy + fz * fz", "unit": "1"}}}  # fmt: skip
    register(effect_from(definition, "of_length.yaml"))
    unit = hand_held("mpu6050", 11, interval_s=0.02)
    for sensor in ("accelerometer", "gyroscope"):
        assert "bias and matrix explain all that it would add" in reasons(unit.diagnosed(sensor))["of_length"]
    forget()
