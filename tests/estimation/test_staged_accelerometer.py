from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from table_turns import Bench, run_stages, settings, specific_force, stepped_angle
from unit_settings import filter_of, with_noise

from pipeline.core.errors import CannotCalibrateError, ConfigurationError, NotObservableError
from pipeline.core.records import SensorCalibration, StageResult, coverage_factor
from pipeline.core.records.calibration import Subtract, TwoSided, corrected
from pipeline.estimation.stages import fit_stage
from pipeline.physics.signal.filters import apply_filter

STAGES = ["orthogonality", "misalignment", "bias", "scale_factor"]
BIAS = [0.049, -0.013, -0.127]  # MPU6050 (1), Sudsanguan 2019, table 5.2
SCALE = np.array([1.001, 0.994, 0.980])  # table 5.23, nonlinear least squares
MPU6050 = {"bias": BIAS, "K": np.diag(1.0 / SCALE), "white": 8e-4}
ASYMMETRY = np.array([0.003, -0.002, 0.001])


def calibrate(recordings: list, **options: bool | float) -> SensorCalibration:
    return run_stages("accelerometer", STAGES, recordings, settings(**options))


def values(calibration: SensorCalibration, stage: str) -> dict[str, float]:
    result = next(s for s in calibration.stages if s.name == stage)
    return {name: p.value for name, p in result.parameters.items()}


def rotation(degrees: tuple[float, float, float]) -> np.ndarray:
    """Small turns about x, then y, then z."""
    out = np.eye(3)
    for axis, angle in enumerate(np.radians(degrees)):
        j, k = (axis + 1) % 3, (axis + 2) % 3
        turn = np.eye(3)
        turn[[j, k], [j, k]] = np.cos(angle)
        turn[j, k], turn[k, j] = -np.sin(angle), np.sin(angle)
        out = turn @ out
    return out


@pytest.mark.parametrize("motion", ["stop_and_go", "continuous", "part_of_a_turn", "four_positions_and_more"])
def test_bias_scale_factors_and_their_asymmetry_are_recovered_exactly(motion: str) -> None:
    bench = Bench("accelerometer", BIAS, np.diag(1.0 / SCALE), c=ASYMMETRY)
    recordings = {
        "stop_and_go": bench.stop_and_go,
        "continuous": lambda: bench.continuous(5.0),
        "part_of_a_turn": lambda: bench.stop_and_go(5.0, start=-20.0, stop=280.0),
        "four_positions_and_more": lambda: bench.stop_and_go(45.0, 6.0),
    }[motion]()
    found = calibrate(recordings)
    assert np.allclose(found.bias, BIAS, rtol=0, atol=1e-10)
    assert np.allclose(found.matrix, np.diag(SCALE), rtol=0, atol=1e-10)
    assert found.effects[0].name == "scale_factor_asymmetry"
    assert list(found.effects[0].parameters) == ["c_x", "c_y", "c_z"]
    assert np.allclose(found.effects[0].values, ASYMMETRY, rtol=0, atol=1e-10)
    assert found.stages[-1].residual_rms < 1e-10


def test_each_stage_keeps_those_before_it_and_corrects_readings_up_to_itself() -> None:
    bench = Bench("accelerometer", BIAS, np.diag(1.0 / SCALE), c=ASYMMETRY)
    recordings = bench.stop_and_go()
    found = calibrate(recordings)
    assert [stage.name for stage in found.stages] == STAGES
    rms = [stage.residual_rms for stage in found.stages]
    assert rms[1] > 5 * rms[2] > 1000 * rms[3]
    truth = specific_force("x", recordings[0].table_angle)
    output = corrected(found.stages[-1].correction, recordings[0].accelerometer)
    assert np.allclose(output, truth, rtol=0, atol=1e-9)
    after_bias = corrected(found.stages[2].correction, recordings[0].accelerometer)
    assert np.allclose(after_bias.mean(axis=0), recordings[0].accelerometer.mean(axis=0) - BIAS, atol=1e-9)


def test_intermediate_stages_show_their_running_bias_and_matrix() -> None:
    recordings = Bench("accelerometer", BIAS, np.diag(1.0 / SCALE)).stop_and_go()
    before = run_stages("accelerometer", STAGES[:2], recordings, settings())
    after = run_stages("accelerometer", STAGES[:3], recordings, settings())
    assert np.all(before.bias == 0)
    assert np.allclose(before.matrix, np.eye(3))
    assert np.allclose(after.bias, BIAS, atol=1e-10)
    assert before.effects == after.effects == ()


def test_local_gravity_is_what_the_scale_factor_is_referred_to() -> None:
    recordings = Bench("accelerometer", BIAS, np.diag(1.0 / SCALE), gravity=0.9976).stop_and_go()
    assert np.allclose(calibrate(recordings, gravity_g=0.9976).matrix, np.diag(SCALE), atol=1e-10)
    assert np.allclose(calibrate(recordings).matrix, np.diag(SCALE / 0.9976), atol=1e-10)


def test_the_excess_angles_are_those_between_the_sensitive_axes() -> None:
    alpha, beta, gamma = np.radians([0.3, -0.2, 0.5])  # y towards z, z towards x, x towards y
    K = np.array(
        [[np.cos(gamma), np.sin(gamma), 0], [0, np.cos(alpha), np.sin(alpha)], [np.sin(beta), 0, np.cos(beta)]]
    )
    found = values(calibrate(Bench("accelerometer", BIAS, K).stop_and_go()), "orthogonality")
    for name, angle in (("alpha", -0.3), ("beta", 0.2), ("gamma", -0.5)):
        assert found[f"{name}_P"] == pytest.approx(angle, abs=1e-9)
        assert found[f"{name}_N"] == pytest.approx(angle, abs=1e-9)
    expected = [1.0, np.cos(gamma), np.cos(alpha) * np.cos(beta)]
    for side in "PN":
        assert [found[f"O_{side}_{a}"] for a in "xyz"] == pytest.approx(expected, abs=1e-12)


def test_printed_equation_3_26_multiplies_x_too() -> None:
    alpha, beta, gamma = np.radians([5.0, 10.0, 15.0])
    K = np.array(
        [[np.cos(gamma), np.sin(gamma), 0], [0, np.cos(alpha), np.sin(alpha)], [np.sin(beta), 0, np.cos(beta)]]
    )
    recordings = Bench("accelerometer", [0, 0, 0], K).stop_and_go(5.0)
    found = values(run_stages("accelerometer", STAGES[:1], recordings, settings(as_printed=True)), "orthogonality")
    expected = [np.cos(beta) * np.cos(gamma), np.cos(alpha) * np.cos(gamma), np.cos(alpha) * np.cos(beta)]
    assert [found[f"O_P_{a}"] for a in "xyz"] == pytest.approx(expected, abs=1e-9)
    assert found["alpha_P"] == pytest.approx(-5.0, abs=1e-9)


def test_fitted_sinusoids_do_not_scatter_like_the_largest_samples() -> None:
    recordings = Bench("accelerometer", **MPU6050, seed=3).stop_and_go(1.0)
    fitted = values(calibrate(recordings), "orthogonality")
    printed = values(calibrate(recordings, as_printed=True), "orthogonality")
    angles = [f"{name}_{side}" for name in ("alpha", "beta", "gamma") for side in "PN"]
    assert max(abs(fitted[a]) for a in angles) < 0.01
    assert max(abs(printed[a]) for a in angles) > 1.0
    assert min(printed[f"O_{side}_{a}"] for side in "PN" for a in "xyz") < 0.9995


def test_a_mounting_of_one_and_a_half_degrees_gives_the_printed_misalignment() -> None:
    found = values(calibrate(Bench("accelerometer", BIAS, rotation((1.5, 1.5, 1.5))).stop_and_go()), "misalignment")
    assert round(found["M_P_x"], 3) == 0.998
    single = values(calibrate(Bench("accelerometer", BIAS, rotation((0.0, 0.0, 1.5))).stop_and_go()), "misalignment")
    assert single["alpha_P"] == pytest.approx(1.5, rel=2e-4)
    assert single["beta_P"] == pytest.approx(1.5, rel=2e-4)
    assert single["gamma_P"] == pytest.approx(0.0, abs=1e-6)
    assert single["M_P_x"] == single["M_N_z"] == pytest.approx(np.cos(np.radians(1.5)) ** 2, rel=1e-6)


def test_as_printed_the_bias_passes_for_misalignment() -> None:
    recordings = Bench("accelerometer", BIAS, np.eye(3)).stop_and_go()
    printed = values(calibrate(recordings, as_printed=True), "misalignment")
    for name, b in zip(("alpha", "beta", "gamma"), BIAS, strict=True):
        assert printed[f"{name}_P"] == pytest.approx(np.degrees(np.arcsin(b / (1 + b))), abs=1e-9)
        assert printed[f"{name}_N"] == pytest.approx(np.degrees(np.arcsin(b / (1 - b))), abs=1e-9)


def test_as_printed_the_side_is_chosen_by_the_sign_of_the_biased_reading() -> None:
    recordings = Bench("accelerometer", BIAS, np.eye(3)).stop_and_go()
    for as_printed, switch_at in ((False, BIAS), (True, [0.0, 0.0, 0.0])):
        step = calibrate(recordings, as_printed=as_printed).stages[0].correction[0]
        assert np.allclose(step.switch_at, switch_at, atol=1e-9)


def test_as_printed_still_corrects_noise_free_readings_but_subtracts_the_level_reading_twice() -> None:
    recordings = Bench("accelerometer", BIAS, np.diag(1.0 / SCALE), c=ASYMMETRY).stop_and_go()
    found = calibrate(recordings, as_printed=True)
    kinds = [TwoSided, TwoSided, Subtract, Subtract, TwoSided]
    assert [type(step) for step in found.stages[-1].correction] == kinds
    assert found.stages[-1].residual_rms < 1e-4


def test_a_delaying_filter_moves_both_extremes_alike_and_leaves_orthogonality_alone() -> None:
    recordings = Bench("accelerometer", BIAS, np.diag(1.0 / SCALE)).continuous(10.0, stop=1080.0)
    late = [
        apply_filter(r, filter_of("rc_low_pass", cutoff_hz=None, time_constant_s=0.3, zero_phase=False))
        for r in recordings
    ]
    found = calibrate(late)
    angles = values(found, "orthogonality")
    assert late[0].filter["delay_s"] * 10.0 == pytest.approx(3.0)  # deg, by which each extreme is late
    assert max(abs(angles[f"{name}_P"]) for name in ("alpha", "beta", "gamma")) < 0.05
    k, phase = 0.12 / (0.12 + 0.3), np.radians(10.0) * 0.12
    gain = k / abs(1.0 - (1.0 - k) * np.exp(-1j * phase))  # eq. 3.14 at the frequency of the turn
    assert np.allclose(np.diag(found.matrix), SCALE / gain, rtol=5e-5)  # what the filter takes passes for scale


def test_a_rest_beside_a_turn_behind_a_delaying_filter_moves_neither_bias_nor_sides() -> None:
    bench = Bench("accelerometer", BIAS, np.diag(1.0 / SCALE))
    rate = np.concatenate([np.zeros(25), np.full(103, 30.0), np.zeros(25)])  # one turn and 10 deg, with its rests
    angle = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2.0 * 0.12)])
    late = [
        apply_filter(r, filter_of("rc_low_pass", cutoff_hz=None, time_constant_s=0.12, zero_phase=False))
        for r in (bench.turn(axis, angle, rate) for axis in "xyz")
    ]
    found = calibrate(late)
    assert np.allclose(found.bias, BIAS, atol=3e-4)  # the rests fitted with the turn move it by 0.011
    assert np.abs(found.effects[0].values).max() < 5e-4  # and feign 0.015


def test_what_shakes_a_moving_table_is_among_the_printed_extremes_and_not_in_fitted_rests() -> None:
    recordings = Bench("accelerometer", [0.0, 0.0, 0.0], np.eye(3)).stop_and_go(5.0, 1.2)
    shaken = [
        replace(r, accelerometer=r.accelerometer + 0.05 * (r.table_rate != 0.0)[:, None] * np.sign(r.accelerometer))
        for r in recordings
    ]
    assert np.allclose(np.diag(calibrate(shaken).matrix), 1.0, atol=1e-9)
    assert np.diag(calibrate(shaken, as_printed=True).matrix) == pytest.approx(np.full(3, 0.95), abs=0.01)


def test_stated_uncertainty_covers_the_truth() -> None:
    # 50 units, 9 parameters each, 95 % claimed; three standard deviations of 50 independent units are 0.09.
    rng = np.random.default_rng(7)
    hits = []
    for seed in range(50):
        K, bias, c = np.diag(rng.normal(1.0, 0.01, 3)), rng.normal(0, 0.05, 3), rng.normal(0, 0.003, 3)
        bench = Bench("accelerometer", bias, K, c=c, white=8e-4, wander_size=1e-4, seed=seed)
        found = run_stages("accelerometer", STAGES, bench.stop_and_go(20.0, 1.2), settings())
        estimate = np.concatenate([found.bias, np.diag(found.matrix), found.effects[0].values])
        u = np.sqrt(np.diag(found.covariance))[[0, 1, 2, 3, 7, 11, 12, 13, 14]]
        error = estimate - np.concatenate([bias, 1.0 / np.diag(K), c])
        hits.append(np.abs(error) <= coverage_factor(found.degrees_of_freedom) * u)
    assert 0.92 < np.mean(hits) < 0.985
    assert np.all(np.mean(hits, axis=0) > 0.86)


def test_printed_extremes_have_the_uncertainty_of_single_samples() -> None:
    errors, stated = [], []
    for seed in range(24):
        bench = Bench("accelerometer", BIAS, np.eye(3), white=8e-4, seed=seed)
        recordings = bench.stop_and_go(15.0, 1.2)
        found = run_stages("accelerometer", ["bias"], recordings, settings(as_printed=True))
        errors.append(found.bias - BIAS)
        stated.append(np.sqrt(np.diag(found.covariance)[:3]))
    assert 0.65 < np.sqrt(np.mean(np.square(stated)) / np.mean(np.square(errors))) < 1.4


def test_held_out_error_of_mpu6050_falls_by_more_than_85_percent() -> None:
    truth = {"bias": BIAS, "K": rotation((1.5, 1.5, 1.5)) @ np.diag(1.0 / SCALE), "white": 8e-4, "wander_size": 1e-4}
    bench = Bench("accelerometer", **truth, seed=1)
    found = calibrate(bench.stop_and_go(5.0, 1.2))
    attitudes = np.random.default_rng(5).standard_normal((10_250, 3))
    raw = bench.reading(attitudes / np.linalg.norm(attitudes, axis=1, keepdims=True))
    output = corrected(found.stages[-1].correction, raw)
    before, after = (np.mean(np.abs(np.linalg.norm(a, axis=1) - 1.0)) for a in (raw, output))
    assert before == pytest.approx(0.071, abs=0.003)
    assert 1.0 - after / before > 0.85


def test_clipped_and_stuck_samples_are_left_out() -> None:
    bench = Bench("accelerometer", BIAS, np.diag(1.0 / SCALE))
    recordings = []
    for recording in bench.stop_and_go():
        bad = np.zeros(recording.samples, np.uint16)
        bad[100:130], bad[200:230], bad[300:400] = 0b10, 0b100, 0b1
        reading = recording.accelerometer.copy()
        reading[(bad & 0b110) != 0] = 2.0
        recordings.append(replace(recording, accelerometer=reading, flags=bad))
    found = calibrate(recordings)
    assert np.allclose(found.bias, BIAS, atol=1e-10)
    clean = calibrate(Bench("accelerometer", BIAS, np.diag(1.0 / SCALE)).stop_and_go()).stages[-1].details
    left_out = found.stages[-1].details.samples_left_out - clean.samples_left_out
    assert 0 < left_out <= 180


def test_a_missing_turn_is_named() -> None:
    recordings = Bench("accelerometer", BIAS, np.eye(3)).stop_and_go(axes="xy")
    with pytest.raises(NotObservableError, match="turn about body axis z"):
        calibrate(recordings)


def test_a_turn_that_never_shows_the_other_side_is_not_enough() -> None:
    recordings = Bench("accelerometer", BIAS, np.eye(3)).stop_and_go(5.0, stop=85.0)
    with pytest.raises(NotObservableError, match="accelerometer y in the turn about x does not show a sinusoid"):
        calibrate(recordings)


def test_turns_without_a_table_log_cannot_be_calibrated_stage_by_stage() -> None:
    recordings = [replace(r, table_angle=None) for r in Bench("accelerometer", BIAS, np.eye(3)).stop_and_go()]
    with pytest.raises(CannotCalibrateError, match="table_angle_deg"):
        calibrate(recordings)


def test_a_recording_about_another_axis_than_it_says_is_refused() -> None:
    bench = Bench("accelerometer", BIAS, np.eye(3))
    recordings = [bench.turn(axis, *stepped_angle(5.0, 1.2)) for axis in "xyz"]
    recordings[0], recordings[1] = replace(recordings[0], axis="y"), replace(recordings[1], axis="x")
    with pytest.raises(NotObservableError):
        calibrate(recordings)


def test_a_stage_of_another_method_cannot_come_before() -> None:
    before = SensorCalibration("accelerometer", stages=(StageResult("reference_least_squares", {}),))
    with pytest.raises(ConfigurationError, match="cannot follow reference_least_squares: it does not honour bias"):
        fit_stage("accelerometer", "scale_factor", with_noise([], settings()), before, settings())


def test_the_result_survives_its_file() -> None:
    found = calibrate(Bench("accelerometer", **MPU6050).stop_and_go(15.0))
    back = SensorCalibration.from_json("accelerometer", found.to_json())
    assert back.covariance.shape == (15, 15)
    assert back.to_json() == found.to_json()
    off_diagonal = ~np.eye(3, dtype=bool)
    assert np.all(np.array(found.to_json()["expanded_uncertainty"]["matrix"])[off_diagonal] == 0)
