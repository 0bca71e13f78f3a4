from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from scipy.signal import lfilter
from unit_settings import filter_of, settings_of

from pipeline.core.records import (
    Coefficient,
    FittedEffect,
    Multiply,
    Noise,
    Recording,
    SensorCalibration,
    StageResult,
    Subtract,
)
from pipeline.physics.effects import effect
from pipeline.physics.kinematics import earth_rate, reference_motion
from pipeline.physics.measurement import compensate, predicted_reading
from pipeline.physics.signal.filters import apply_filter
from tests.published import validate

if TYPE_CHECKING:
    from pipeline.core.settings import Settings

DT = 0.05
SENSORS = ("accelerometer", "gyroscope")
SIGMA = {"accelerometer": 8e-4, "gyroscope": 0.02}
RC = filter_of("rc_low_pass", cutoff_hz=4.0, time_constant_s=None, zero_phase=False)
SETTINGS = settings_of(table={"gravity_g": 0.998}, procedure={"holdout_every": 3})


def held_out(n: int = 3000, *, calm: float = 0.0) -> Recording:
    """Random turns about all axes, at rest in the first ``calm`` seconds, as a table logs them."""
    time = DT * np.arange(n)
    gate = np.clip((time - calm) / 2.0, 0.0, 1.0) ** 3 if calm else np.ones(n)
    angles = gate * np.stack([40 * np.sin(0.7 * time), 60 * np.sin(0.43 * time + 1), 90 * np.sin(0.31 * time)])
    half = np.radians(angles) / 2.0
    q = np.zeros((n, 4))
    q[:, 0] = 1.0
    for axis, h in enumerate(half):
        turn = np.zeros((n, 4))
        turn[:, 0], turn[:, 1 + axis] = np.cos(h), np.sin(h)
        q = product(q, turn)
    recording = Recording("validation", "validation", None, np.arange(n) * round(DT * 1e9), table_attitude=q)
    motion = reference_motion(recording)
    rate = np.linalg.norm(motion.angular_rate, axis=1)
    rate[rate < 1e-9] = 0.0
    return replace(recording, table_rate=rate, temperature=25.0 + time / 20.0)


def product(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    w = p[:, :1] * q[:, :1] - np.sum(p[:, 1:] * q[:, 1:], axis=1, keepdims=True)
    return np.hstack([w, p[:, :1] * q[:, 1:] + q[:, :1] * p[:, 1:] + np.cross(p[:, 1:], q[:, 1:])])


def calibration(sensor: str, *effects: FittedEffect) -> SensorCalibration:
    rng = np.random.default_rng(7)
    bias = rng.uniform(-0.05, 0.05, 3) * (1.0 if sensor == "accelerometer" else 20.0)
    return SensorCalibration(sensor, bias=bias, matrix=np.eye(3) + rng.uniform(-0.03, 0.03, (3, 3)), effects=effects)


def fitted(name: str, sensor: str, size: float) -> FittedEffect:
    rng = np.random.default_rng(1)
    values = {p.name: Coefficient(size * rng.uniform(0.5, 1.0), p.unit, 0.0) for p in effect(name).parameters(sensor)}
    return FittedEffect(name, values)


def read(recording: Recording, noisy: float = 0.0, seed: int = 0, **sensors: SensorCalibration) -> Recording:
    """Let sensors read the recording's motion."""
    motion = reference_motion(recording, 0.998)
    rng = np.random.default_rng(seed)
    readings = {
        s: predicted_reading(c, motion) + noisy * SIGMA[s] * rng.standard_normal((recording.samples, 3))
        for s, c in sensors.items()
    }
    return replace(recording, **readings)


def noise_of(sensor: str, wander: float = 0.0) -> Noise:
    return Noise(np.full(3, SIGMA[sensor]), np.full(3, wander), 100.0, "static")


def step(part: dict[str, Any], name: str) -> dict[str, Any]:
    return next(s for s in part["steps"] if s["name"] == name)


@pytest.mark.parametrize("sensor", SENSORS)
def test_figures_are_the_literal_equations_of_the_thesis(sensor: str) -> None:
    c = calibration(sensor)
    recording = read(held_out(400), 1.0, **{sensor: c})
    part = validate(c, [recording], noise_of(sensor), SETTINGS)
    reading, motion = recording.reading(sensor), reference_motion(recording, 0.998)
    truth = motion.specific_force if sensor == "accelerometer" else motion.angular_rate
    before = None
    for name, corrected in (("raw", reading), ("calibrated", np.array([c.matrix @ (r - c.bias) for r in reading]))):
        errors = []
        for n, v in enumerate(corrected):
            expected = 0.998 if sensor == "accelerometer" else recording.table_rate[n]
            errors.append(np.sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2) - expected)
        mean = sum(abs(e) for e in errors) / len(errors)
        before = mean if before is None else before
        vector = np.sqrt(np.mean(np.sum((corrected - truth) ** 2, axis=1)))
        assert step(part, name) == {
            "name": name,
            "mean_abs_error": pytest.approx(mean, rel=1e-9),
            "sum_abs_error": pytest.approx(sum(abs(e) for e in errors), rel=1e-9),
            "max_error": pytest.approx(max(errors), rel=1e-9),
            "min_error": pytest.approx(min(errors), rel=1e-9),
            "rms_error": pytest.approx(np.sqrt(np.mean(np.square(errors))), rel=1e-9),
            "change_percent": pytest.approx(100.0 * (before - mean) / before, abs=1e-9),
            "vector_rms_error": pytest.approx(vector, rel=1e-9),
        }
    assert [s["name"] for s in part["steps"]] == ["raw", "calibrated"]
    assert part["unit"] == {"accelerometer": "g", "gyroscope": "deg/s"}[sensor]
    assert (part["samples"], part["held_out"], part["reason"]) == (400, True, None)
    json.dumps(part, allow_nan=False)


@pytest.mark.parametrize("settings", [None, RC], ids=["unfiltered", "filtered"])
@pytest.mark.parametrize("sensor", SENSORS)
def test_noise_floor_is_the_error_that_noise_alone_leaves(sensor: str, settings: Settings | None) -> None:
    c, recording, wander = calibration(sensor), held_out(2000, calm=50.0), 0.5 * SIGMA[sensor]
    motion = reference_motion(recording, 0.998)
    truth = motion.specific_force if sensor == "accelerometer" else motion.angular_rate
    size = 0.998 if sensor == "accelerometer" else recording.table_rate
    squares, vectors = [], []
    phi = np.exp(-DT / 100.0)
    for seed in range(300):
        rng = np.random.default_rng(seed)
        drive = rng.standard_normal((2000, 3)) * np.sqrt(1 - phi**2)
        drive[0] = rng.standard_normal(3)
        noise = SIGMA[sensor] * rng.standard_normal((2000, 3)) + wander * lfilter([1.0], [1.0, -phi], drive, axis=0)
        if settings:
            blank = replace(recording, accelerometer=noise, table_attitude=None)
            noise = apply_filter(blank, settings).accelerometer
        after = truth + noise @ c.matrix.T
        squares.append(np.mean((np.linalg.norm(after, axis=1) - size) ** 2))
        vectors.append(np.mean(np.sum((after - truth) ** 2, axis=1)))
    log = read(recording, **{sensor: c})
    log = apply_filter(log, settings) if settings else log
    part = validate(c, [log], noise_of(sensor, wander), SETTINGS)
    spread = np.std(squares) / np.mean(squares) / np.sqrt(300) / 2.0
    assert spread < 0.013
    assert part["noise_floor"] == pytest.approx(np.sqrt(np.mean(squares)), rel=0.003 + 3.0 * spread)
    assert part["vector_noise_floor"] == pytest.approx(np.sqrt(np.mean(vectors)), rel=0.003 + 3.0 * spread)


def test_the_floor_of_vectors_is_the_trace_of_their_covariance() -> None:
    matrix, white = np.array([[1.0, 0.3, 0.0], [0.0, 1.0, 0.2], [0.0, 0.0, 1.0]]), np.array([1e-3, 3e-3, 9e-3])
    c = replace(calibration("accelerometer"), matrix=matrix)
    part = validate(c, [read(held_out(300), accelerometer=c)], Noise(white, np.zeros(3), 100.0, "static"), SETTINGS)
    assert part["vector_noise_floor"] ** 2 == pytest.approx(np.trace(matrix * white**2 @ matrix.T), rel=1e-9)


@pytest.mark.parametrize("sensor", SENSORS)
def test_a_perfect_calibration_leaves_the_floor(sensor: str) -> None:
    c, recording = calibration(sensor), held_out(2000, calm=30.0)
    ratios, vectors = [], []
    for seed in range(30):
        part = validate(c, [read(recording, 1.0, seed, **{sensor: c})], noise_of(sensor), SETTINGS)
        ratios.append(part["steps"][-1]["rms_error"] / part["noise_floor"])
        vectors.append(part["steps"][-1]["vector_rms_error"] / part["vector_noise_floor"])
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.01)
    assert np.mean(vectors) == pytest.approx(1.0, abs=0.005)


STATES = [
    ("accelerometer", "bias_temperature", 5e-3),
    ("accelerometer", "quadratic_nonlinearity", 5e-3),
    ("accelerometer", "lever_arm", 0.05),
    ("accelerometer", "table_tilt", 0.3),
    ("accelerometer", "time_offset", 0.02),
    ("gyroscope", "g_sensitivity", 0.1),
    ("gyroscope", "scale_factor_asymmetry", 3e-3),
    ("gyroscope", "time_offset", 0.02),
    ("gyroscope", "clock_rate", 1e-3),
    ("gyroscope", "earth_rotation", 4e-3),
]


@pytest.mark.parametrize(("sensor", "name", "size"), STATES)
def test_an_effect_explains_what_it_put_there(sensor: str, name: str, size: float) -> None:
    c = calibration(sensor, fitted(name, sensor, size))
    recording = read(held_out(1500), **{sensor: c})
    part = validate(c, [recording], noise_of(sensor), SETTINGS)
    assert [s["name"] for s in part["steps"]] == ["raw", "calibrated", f"+ {name}"]
    before, after = part["steps"][1:]
    assert after["vector_rms_error"] < 1e-6 * before["vector_rms_error"]
    if name != "earth_rotation":  # corrects the vector; the log's rate is that of the table alone
        assert after["rms_error"] <= 1e-5 * before["vector_rms_error"]


def test_effects_are_added_one_by_one_in_their_order() -> None:
    effects = (fitted("g_sensitivity", "gyroscope", 0.1), fitted("time_offset", "gyroscope", 0.02))
    c = calibration("gyroscope", *effects)
    part = validate(c, [read(held_out(1500), gyroscope=c)], noise_of("gyroscope"), SETTINGS)
    vectors = [s["vector_rms_error"] for s in part["steps"]]
    assert [s["name"] for s in part["steps"]] == ["raw", "calibrated", "+ g_sensitivity", "+ time_offset"]
    assert vectors[1] > vectors[2] > 1e3 * vectors[3]


@pytest.mark.parametrize(
    ("sensor", "name", "size"), [("accelerometer", "scale_factor_asymmetry", 5e-3), ("gyroscope", "g_sensitivity", 0.1)]
)
def test_effects_work_from_the_logs_own_signals_without_an_attitude(sensor: str, name: str, size: float) -> None:
    unit = {s: calibration(s) for s in SENSORS}
    unit[sensor] = calibration(sensor, fitted(name, sensor, size))
    recording = replace(read(held_out(1500), **unit), table_attitude=None)
    other = next(s for s in SENSORS if s != sensor)
    part = validate(unit[sensor], [recording], noise_of(sensor), SETTINGS, other=unit[other])
    assert part["steps"][-1]["rms_error"] < 1e-6 * part["steps"][-2]["rms_error"]
    assert part["steps"][-1]["vector_rms_error"] is None
    assert part["vector_noise_floor"] is None
    assert part["notes"] == []


def test_an_effect_that_the_held_out_log_cannot_show_is_left_out_and_said() -> None:
    c = calibration("accelerometer", fitted("bias_temperature", "accelerometer", 1e-3))
    recording = replace(read(held_out(300), accelerometer=c), temperature=None)
    part = validate(c, [recording], noise_of("accelerometer"), SETTINGS)
    assert part["expected_rms_error"] is None
    assert part["notes"] == [
        "bias_temperature is left out: the held-out recording holds no temperature",
        "the expected error is not stated, because bias_temperature is left out of the held-out error",
    ]
    assert part["steps"][2]["rms_error"] == part["steps"][1]["rms_error"]


def test_an_effect_of_another_session_leaves_the_expected_error_as_it_is() -> None:
    plain = calibration("gyroscope")
    recording = replace(read(held_out(300), gyroscope=plain), table_attitude=None, setup="B")
    without = validate(plain, [recording], noise_of("gyroscope"), SETTINGS)
    for name in ("mounting", "table_axis_nonorthogonality"):
        parts = {
            session: validate(
                calibration("gyroscope", fitted(f"{name}@{session}", "gyroscope", 0.5)),
                [recording],
                noise_of("gyroscope"),
                SETTINGS,
            )
            for session in "AB"
        }
        assert parts["A"]["notes"] == []
        np.testing.assert_allclose(parts["A"]["expected_rms_error"], without["expected_rms_error"], rtol=0.02)
        assert parts["A"]["steps"][-1]["rms_error"] == without["steps"][-1]["rms_error"]
        assert parts["B"]["expected_rms_error"] is None
        assert f"because {name}@B is left out" in parts["B"]["notes"][1]


def test_a_tilt_of_the_table_leaves_the_magnitude_and_its_expected_error_as_they_are() -> None:
    plain = calibration("accelerometer")
    recording = replace(read(held_out(300), accelerometer=plain), table_attitude=None)
    noise = noise_of("accelerometer")
    without = validate(plain, [recording], noise, SETTINGS)
    tilted = validate(
        calibration("accelerometer", fitted("table_tilt", "accelerometer", 0.5)), [recording], noise, SETTINGS
    )
    assert tilted["notes"] == without["notes"]
    np.testing.assert_allclose(tilted["expected_rms_error"], without["expected_rms_error"], rtol=0.02)
    assert tilted["steps"][-1]["rms_error"] == without["steps"][-1]["rms_error"]


@pytest.mark.parametrize(("name", "size"), [("time_offset", 0.03), ("low_pass_lag", 0.03), ("clock_rate", 300.0)])
def test_timing_moves_the_rate_where_no_attitude_is_logged(name: str, size: float) -> None:
    c = calibration("gyroscope", fitted(name, "gyroscope", size))
    recording = replace(read(held_out(1500), 1.0, gyroscope=c), table_attitude=None)
    part = validate(c, [recording], noise_of("gyroscope"), SETTINGS)
    assert part["notes"] == []
    assert part["steps"][-2]["rms_error"] > 4.0 * part["noise_floor"]
    assert part["steps"][-1]["rms_error"] == pytest.approx(part["noise_floor"], rel=0.06)  # 3 / sqrt(2 n)


def test_stages_of_a_staged_fit_are_steps() -> None:
    c = calibration("accelerometer")
    half = (Subtract(c.bias),)
    full = (*half, Multiply(c.matrix))
    stages = (StageResult("bias", {}, None, half), StageResult("scale_factor", {}, None, full), StageResult("x", {}))
    recording = read(held_out(300), 1.0, accelerometer=c)
    part = validate(replace(c, stages=stages), [recording], noise_of("accelerometer"), SETTINGS)
    assert [s["name"] for s in part["steps"]] == ["raw", "stage:bias", "stage:scale_factor", "calibrated"]
    error = np.linalg.norm(recording.accelerometer - c.bias, axis=1) - 0.998
    assert step(part, "stage:bias")["mean_abs_error"] == pytest.approx(np.mean(np.abs(error)), rel=1e-12)
    assert step(part, "stage:scale_factor")["rms_error"] == pytest.approx(step(part, "calibrated")["rms_error"])


def test_two_sided_scale_factors_are_taken_off_without_an_attitude_as_the_compensation_does() -> None:
    c = calibration("gyroscope", fitted("scale_factor_asymmetry", "gyroscope", 3e-3))
    recording = replace(read(held_out(300), gyroscope=c), table_attitude=None)
    part = validate(c, [recording], noise_of("gyroscope"), SETTINGS)
    after = compensate(c, recording.gyroscope, reference_motion(held_out(300), 0.998))
    error = np.linalg.norm(after, axis=1) - recording.table_rate
    assert part["steps"][-1]["rms_error"] == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-6, abs=1e-12)


def test_the_reference_of_a_filtered_recording_is_late_by_the_filters_delay() -> None:
    c = calibration("gyroscope")
    recording = apply_filter(read(held_out(2000), gyroscope=c), RC)
    part = validate(c, [recording], noise_of("gyroscope"), SETTINGS)
    prompt = replace(recording, filter={**recording.filter, "delay_s": 0.0})
    unaware = validate(c, [prompt], noise_of("gyroscope"), SETTINGS)
    for name in ("rms_error", "vector_rms_error"):
        assert part["steps"][-1][name] < 0.1 * unaware["steps"][-1][name]


def test_the_rate_is_that_of_the_attitude_where_only_that_is_logged() -> None:
    c = calibration("gyroscope")
    recording = replace(read(held_out(1000), gyroscope=c), table_rate=None)
    assert validate(c, [recording], noise_of("gyroscope"), SETTINGS)["steps"][-1]["rms_error"] < 1e-9


def test_earths_rotation_is_in_the_reference_where_it_is_configured() -> None:
    settings = settings_of(SETTINGS, table={"gravity_g": 1.0, "latitude_deg": 13.7, "azimuth_deg": 30.0})
    c, recording = calibration("gyroscope"), held_out(1000, calm=10.0)
    motion = reference_motion(recording, 1.0, tuple(earth_rate(13.7, 30.0).tolist()))
    recording = replace(recording, gyroscope=predicted_reading(c, motion))
    part = validate(c, [recording], noise_of("gyroscope"), settings)
    assert part["steps"][-1]["rms_error"] < 1e-9
    assert part["steps"][-1]["vector_rms_error"] < 1e-9


def orientations(seed: int, count: int = 24, rest_s: float = 4.0) -> tuple[Recording, SensorCalibration]:
    """Hand-held rests with moves between them."""
    rng = np.random.default_rng(seed)
    c = calibration("accelerometer")
    directions = rng.standard_normal((count, 3))
    directions *= 0.998 / np.linalg.norm(directions, axis=1, keepdims=True)
    rest, move, pieces = round(rest_s / 0.01), 100, []
    for i, direction in enumerate(directions):
        pieces.append(np.tile(direction, (rest, 1)))
        following = directions[(i + 1) % count]
        ramp = np.linspace(0, 1, move)[:, None]
        shake = 0.3 * np.sin(np.linspace(0, 20, move))[:, None] * rng.standard_normal(3)
        pieces.append((1 - ramp) * direction + ramp * following + shake)
    truth = np.concatenate(pieces)
    reading = c.bias + truth @ np.linalg.inv(c.matrix).T + 8e-4 * rng.standard_normal(truth.shape)
    return Recording("recording", "rests", None, np.arange(len(truth)) * 10_000_000, accelerometer=reading), c


def test_every_third_rest_is_held_out_and_each_mean_is_one_sample() -> None:
    recording, c = orientations(0)
    part = validate(c, [recording], noise_of("accelerometer"), SETTINGS)
    assert (part["held_out"], part["samples"]) == (True, 8)
    assert part["vector_noise_floor"] is None
    assert part["steps"][0]["rms_error"] > 20 * part["steps"][-1]["rms_error"]


def test_floor_of_rests_is_that_of_their_means() -> None:
    parts = [validate(c, [r], noise_of("accelerometer"), SETTINGS) for r, c in (orientations(s) for s in range(12))]
    rms = np.sqrt(np.mean([p["steps"][-1]["rms_error"] ** 2 for p in parts]))
    floor = np.sqrt(np.mean([p["noise_floor"] ** 2 for p in parts]))
    assert rms == pytest.approx(floor, rel=3.0 / np.sqrt(2 * 8 * 12))
    assert floor < 8e-4 / np.sqrt(250)


def test_samples_of_the_fit_are_judged_where_nothing_is_held_out_and_that_is_said() -> None:
    c = calibration("accelerometer")
    turn = replace(read(held_out(300), 1.0, accelerometer=c), role="accelerometer", name="accel_x")
    part = validate(c, [turn], noise_of("accelerometer"), SETTINGS)
    assert part["held_out"] is False
    assert "no held-out recording" in part["reason"]
    assert part["samples"] == 300


def test_without_any_reference_the_figures_are_null_and_the_reason_is_given() -> None:
    c = calibration("gyroscope")
    bare = replace(held_out(100), gyroscope=np.zeros((100, 3)), table_attitude=None, table_rate=None)
    part = validate(c, [bare], noise_of("gyroscope"), SETTINGS)
    assert (part["samples"], part["held_out"], part["noise_floor"]) == (0, False, None)
    assert [s["name"] for s in part["steps"]] == ["raw", "calibrated"]
    assert part["steps"][0]["rms_error"] is None
    json.dumps(part, allow_nan=False)


def test_missing_readings_do_not_count() -> None:
    c = calibration("accelerometer")
    recording = read(held_out(300), 1.0, accelerometer=c)
    recording.accelerometer[50:60] = np.nan
    part = validate(c, [recording], noise_of("accelerometer"), SETTINGS)
    assert part["samples"] == 290
    json.dumps(part, allow_nan=False)


def test_limits_become_pass_or_fail() -> None:
    c = calibration("accelerometer")
    recording = read(held_out(300), 1.0, accelerometer=c)
    limits = {"held_out_rms_error": 0.002, "bias": 0.06, "scale_factor": None}
    loose = validate(c, [recording], noise_of("accelerometer"), settings_of(SETTINGS, limits={"accelerometer": limits}))
    assert loose["pass"] is True
    assert [row["name"] for row in loose["limits"]] == ["held_out_rms_error", "bias"]
    limits = {**limits, "scale_factor": 1e-5, "held_out_max_abs_error": 1.0}
    tight = validate(c, [recording], noise_of("accelerometer"), settings_of(SETTINGS, limits={"accelerometer": limits}))
    assert tight["pass"] is False
    assert {row["name"]: row["pass"] for row in tight["limits"]} == {
        "held_out_rms_error": True, "bias": True, "scale_factor": False, "held_out_max_abs_error": True,
    }  # fmt: skip
    assert validate(c, [recording], noise_of("accelerometer"), SETTINGS)["pass"] is None


@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_the_limit_of_the_largest_error_concerns_both_signs(factor: float) -> None:
    c = calibration("accelerometer")
    recording = read(held_out(300), accelerometer=c)
    assert recording.accelerometer is not None
    recording.accelerometer[150] *= factor
    limits = {"accelerometer": {"held_out_max_abs_error": 0.05}}
    part = validate(c, [recording], noise_of("accelerometer"), settings_of(SETTINGS, limits=limits))
    assert part["pass"] is False
    assert part["limits"][0]["value"] == pytest.approx(0.1, rel=0.1)


def test_missing_readings_are_not_in_the_floor() -> None:
    c = calibration("gyroscope")
    whole = read(held_out(1500), 1.0, gyroscope=c)
    assert whole.gyroscope is not None
    assert whole.table_rate is not None
    fast = np.abs(whole.table_rate) > np.median(np.abs(whole.table_rate))
    holed = replace(whole, gyroscope=np.where(fast[:, None], np.nan, whole.gyroscope))
    part, slow = (validate(c, [r], noise_of("gyroscope"), SETTINGS) for r in (holed, whole.select(~fast)))
    assert part["samples"] == slow["samples"] == np.count_nonzero(~fast)
    for figure in ("noise_floor", "vector_noise_floor"):
        assert part[figure] == pytest.approx(slow[figure], rel=1e-3)
    assert np.all(np.isfinite(part["expected_rms_error"]))


def test_earths_rotation_without_attitude_is_told_and_allowed_for() -> None:
    c = calibration("gyroscope")
    log = replace(read(held_out(1500), 1.0, gyroscope=c), table_attitude=None)
    placed = settings_of(SETTINGS, table={"latitude_deg": 50.0, "azimuth_deg": 0.0})
    plain, part = (validate(c, [log], noise_of("gyroscope"), s) for s in (SETTINGS, placed))
    assert plain["notes"] == []
    assert "Earth's rotation is left out" in part["notes"][0]
    assert part["expected_rms_error"][1] == pytest.approx(plain["expected_rms_error"][1] + 15.041 / 3600.0, rel=1e-4)


@pytest.mark.parametrize("sensor", SENSORS)
def test_a_calibration_that_does_harm_is_told_from_one_that_does_not(sensor: str) -> None:
    c = calibration(sensor)
    recording = read(held_out(1500), 1.0, **{sensor: c})
    assert validate(c, [recording], noise_of(sensor), SETTINGS)["worse_than_raw"] is None
    foreign = replace(c, bias=-c.bias)
    told = validate(foreign, [recording], noise_of(sensor), SETTINGS)["worse_than_raw"]
    assert "makes held-out motion worse" in told
    ideal = SensorCalibration(sensor)
    quiet = read(held_out(1500), 1.0, **{sensor: ideal})
    nearly = replace(ideal, matrix=ideal.matrix * (1.0 + 1e-6))
    assert validate(nearly, [quiet], noise_of(sensor), SETTINGS)["worse_than_raw"] is None


def about_one_axis(direction: np.ndarray, *, other: float = 0.0) -> Recording:
    """Motion about a fixed axis by an encoder of 0.01 deg; ``other`` deg/s about a second axis are not logged."""
    time = 0.01 * np.arange(6000)
    angle = 50.0 * np.sin(1.7 * time) + 20.0 * np.sin(3.1 * time)
    rate = 85.0 * np.cos(1.7 * time) + 62.0 * np.cos(3.1 * time)
    across = np.cross(direction, [0.0, 0.0, 1.0])
    true = rate[:, None] * direction + other * np.sin(0.9 * time)[:, None] * across / np.linalg.norm(across)
    cal = calibration("gyroscope")
    noise = np.random.default_rng(5).normal(0.0, 0.03, (6000, 3))
    reading = cal.bias + true @ np.linalg.inv(cal.matrix).T + noise
    stamps = np.arange(6000) * 10_000_000
    logged = np.rint(angle / 0.01) * 0.01
    return Recording("validation", "validation", None, stamps, gyroscope=reading, table_angle=logged)


def test_an_angle_about_one_fixed_axis_judges_the_gyroscope() -> None:
    direction = np.array([2.0, -1.0, 2.0]) / 3.0
    noise = Noise(np.full(3, 0.03), np.zeros(3), 100.0, "static")
    part = validate(calibration("gyroscope"), [about_one_axis(direction)], noise, SETTINGS)
    assert part["held_out"]
    assert part["steps"][-1]["rms_error"] == pytest.approx(part["noise_floor"], rel=0.15)
    assert part["noise_floor"] < 2.0 * 0.03


def test_the_angle_of_one_axis_does_not_judge_a_motion_about_two() -> None:
    direction = np.array([2.0, -1.0, 2.0]) / 3.0
    noise = Noise(np.full(3, 0.03), np.zeros(3), 100.0, "static")
    part = validate(calibration("gyroscope"), [about_one_axis(direction, other=20.0)], noise, SETTINGS)
    assert not part["held_out"]
