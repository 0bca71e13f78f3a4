from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from table_turns import INTERVAL, Bench, ramped_rate, run_stages, settings
from unit_settings import filter_of, with_noise

from pipeline.core.errors import CannotCalibrateError, ConfigurationError, NotObservableError
from pipeline.core.records import SensorCalibration, StageResult, coverage_factor
from pipeline.core.records.calibration import Subtract, corrected
from pipeline.estimation.stages import fit_stage
from pipeline.physics.kinematics import earth_rate
from pipeline.physics.signal.filters import apply_filter

STAGES = ["bias", "orthogonality_and_misalignment", "scale_factor"]
BIAS = [-3.837, 0.003, 0.255]  # MPU6050 (1), Sudsanguan 2019, table 5.15
M = np.array([[1.017, 0.016, -0.019], [-0.013, 1.001, -0.005], [0.014, 0.005, 0.998]])  # acts on row vectors
K = np.linalg.solve(M.T, np.eye(3))


def calibrate(recordings: list, **options: bool | float) -> SensorCalibration:
    return run_stages("gyroscope", STAGES, recordings, settings(**options))


def values(calibration: SensorCalibration, stage: str) -> dict[str, float]:
    result = next(s for s in calibration.stages if s.name == stage)
    return {name: p.value for name, p in result.parameters.items()}


def printed_matrix(calibration: SensorCalibration) -> np.ndarray:
    found = values(calibration, "orthogonality_and_misalignment")
    return np.array([[found[f"M_{i}{j}"] for j in (1, 2, 3)] for i in (1, 2, 3)])


@pytest.mark.parametrize(
    "rates",
    [
        [60.0],
        [60.0, -60.0],
        [20.0, 60.0, 80.0, 100.0, 200.0],
        {"x": [20.0, -60.0], "y": [200.0], "z": [-100.0, 80.0, -60.0]},
    ],
    ids=["one_direction", "both_directions", "several_rates", "different_rates"],
)
def test_bias_and_matrix_are_recovered_exactly(rates: list[float] | dict[str, list[float]]) -> None:
    found = calibrate(Bench("gyroscope", BIAS, K).turns_at(rates))
    assert np.allclose(found.bias, BIAS, rtol=0, atol=1e-10)
    assert np.allclose(found.matrix, M.T, rtol=0, atol=1e-10)
    assert np.allclose(printed_matrix(found), M, rtol=0, atol=1e-10)
    assert found.stages[-1].residual_rms < 1e-9


@pytest.mark.parametrize("as_printed", [False, True])
def test_the_scale_factor_is_one_since_the_matrix_carries_it(as_printed: bool) -> None:  # noqa: FBT001
    bench = Bench("gyroscope", BIAS, K, white=0.05, wander_size=0.003)
    found = values(calibrate(bench.turns_at([60.0, -60.0]), as_printed=as_printed), "scale_factor")
    assert [found[f"S_{a}"] for a in "xyz"] == pytest.approx([1.0, 1.0, 1.0], abs=1e-12)


def test_printed_equation_3_50_differs_only_where_the_rates_differ() -> None:
    even = calibrate(Bench("gyroscope", BIAS, K).turns_at([60.0]), as_printed=True)
    assert np.allclose(even.matrix, M.T, atol=1e-10)
    rates = {"x": [20.0], "y": [60.0], "z": [200.0]}
    uneven = calibrate(Bench("gyroscope", BIAS, K).turns_at(rates), as_printed=True)
    I = np.diag([20.0, 60.0, 200.0])
    S = I @ K.T  # row i: mean reading of x, y, z while the table turns about axis i
    assert np.allclose(printed_matrix(uneven), I @ np.linalg.solve(S, np.eye(3)), atol=1e-9)
    assert not np.allclose(printed_matrix(uneven), M, atol=1e-2)


def test_the_correction_of_each_stage_is_that_of_row_vectors() -> None:
    recordings = Bench("gyroscope", BIAS, K).turns_at([60.0])
    found = calibrate(recordings)
    raw = recordings[1].gyroscope
    after_bias, after_matrix = (corrected(stage.correction, raw) for stage in found.stages[:2])
    assert np.allclose(after_bias, raw - BIAS, atol=1e-10)
    assert np.allclose(after_matrix, (raw - BIAS) @ M, atol=1e-9)


def test_the_bias_is_that_of_the_rests_and_not_of_the_turns() -> None:
    bench = Bench("gyroscope", BIAS, K)
    recordings = [
        replace(r, gyroscope=r.gyroscope + 0.5 * (np.abs(r.table_rate) > 1.0)[:, None])
        for r in bench.turns_at([60.0, -60.0])
    ]
    assert np.allclose(calibrate(recordings).bias, BIAS, atol=1e-10)


def test_a_static_recording_gives_the_bias_only_where_the_turns_hold_no_rest() -> None:
    bench = Bench("gyroscope", BIAS, K)
    with_rests = bench.turns_at([60.0])
    other = replace(
        with_rests[0],
        name="static",
        role="static",
        axis=None,
        table_angle=None,
        table_rate=None,
        gyroscope=np.tile(np.add(BIAS, 1.0), (with_rests[0].samples, 1)),
    )
    assert np.allclose(calibrate([*with_rests, other]).bias, BIAS, atol=1e-10)
    moving = [r.select(np.abs(r.table_rate) > 59.0) for r in with_rests]
    assert np.allclose(calibrate([*moving, other]).bias, np.add(BIAS, 1.0), atol=1e-10)
    with pytest.raises(NotObservableError, match="hold no rest"):
        calibrate(moving)


def test_a_recording_without_a_rest_or_a_steady_turn_changes_nothing() -> None:
    bench = Bench("gyroscope", BIAS, K, white=0.05)
    recordings = bench.turns_at([60.0])
    rate = np.linspace(5.0, 60.0, 12)
    speeding_up = bench.turn("x", np.cumsum(rate) * INTERVAL, rate)
    stated = {"angle_accuracy_deg": 0.01, "rate_accuracy": 1e-4, "motion": "logged"}
    alone, both = (calibrate(each, **stated) for each in (recordings, [*recordings, speeding_up]))
    assert np.array_equal(alone.matrix, both.matrix)
    assert np.array_equal(alone.bias, both.bias)
    assert np.allclose(alone.covariance, both.covariance, rtol=1e-9, atol=0.0)


def test_earth_rotation_does_not_pass_for_bias_where_place_and_azimuth_are_known() -> None:
    earth = earth_rate(13.7, 30.0)
    recordings = Bench("gyroscope", BIAS, np.eye(3)).turns_at([60.0])
    seen = []
    for recording in recordings:
        turn = {"x": np.eye(3), "y": np.eye(3), "z": np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]])}[recording.axis]
        start = turn @ earth  # body x, y, z at table angle 0: about z body x points up, body z along level -x
        axis = "xyz".index(recording.axis)
        angle = np.radians(recording.table_angle)
        j, k = (axis + 1) % 3, (axis + 2) % 3
        body = np.tile(start, (recording.samples, 1))
        body[:, j] = np.cos(angle) * start[j] + np.sin(angle) * start[k]
        body[:, k] = -np.sin(angle) * start[j] + np.cos(angle) * start[k]
        seen.append(replace(recording, gyroscope=recording.gyroscope + body))
    with_place = calibrate(seen, latitude_deg=13.7, azimuth_deg=30.0)
    assert np.allclose(with_place.bias, BIAS, atol=1e-10)
    assert np.allclose(with_place.matrix, np.eye(3), atol=1e-10)
    assert np.max(np.abs(calibrate(seen).bias - BIAS)) > 1e-3


def test_stated_uncertainty_covers_the_truth() -> None:
    hits = []
    for seed in range(50):
        bench = Bench("gyroscope", BIAS, K, white=0.01, wander_size=0.003, seed=seed)
        found = run_stages("gyroscope", STAGES, bench.turns_at([100.0, -100.0]), settings())
        error = np.concatenate([found.bias - BIAS, (found.matrix - M.T).ravel()])
        u = np.sqrt(np.diag(found.covariance))
        hits.append(np.abs(error) <= coverage_factor(found.freedom) * u)
    assert 0.92 < np.mean(hits) < 0.985
    assert np.all(np.mean(hits, axis=0) > 0.86)


@pytest.mark.parametrize("zero_phase", [False, True])
def test_what_a_filter_still_holds_of_a_turn_is_no_rest(zero_phase: bool) -> None:  # noqa: FBT001
    applied = filter_of("rc_low_pass", cutoff_hz=1.0, time_constant_s=None, zero_phase=zero_phase)
    recordings = [apply_filter(r, applied) for r in Bench("gyroscope", BIAS, K).turns_at([200.0])]
    found = calibrate(recordings)
    assert np.allclose(found.bias, BIAS, atol=1e-4)
    assert np.allclose(found.matrix, M.T, atol=1e-5)


def test_without_a_table_log_the_gyroscope_cannot_be_calibrated_and_the_message_says_what_to_record() -> None:
    recordings = [replace(r, table_angle=None, table_rate=None) for r in Bench("gyroscope", BIAS, K).turns_at([60.0])]
    with pytest.raises(CannotCalibrateError, match="record turns about x, y and z with table_angle_deg"):
        calibrate(recordings)
    with pytest.raises(CannotCalibrateError, match="method=rests_and_moves calibrates it"):
        calibrate([replace(r, role="rests") for r in recordings])


def test_an_axis_that_was_not_turned_about_is_named() -> None:
    recordings = Bench("gyroscope", BIAS, K).turns_at({"x": [60.0], "z": [60.0]})
    bias_alone = run_stages("gyroscope", STAGES[:1], recordings, settings())
    assert np.allclose(bias_alone.bias, BIAS, atol=1e-10)
    with pytest.raises(NotObservableError, match="not turned steadily about y"):
        calibrate(recordings)


def test_a_stage_of_another_method_cannot_come_before() -> None:
    before = SensorCalibration("gyroscope", stages=(StageResult("bias", {}), StageResult("cholesky_lu", {})))
    with pytest.raises(ConfigurationError, match="cannot follow cholesky_lu: it does not honour matrix"):
        fit_stage("gyroscope", "scale_factor", with_noise([], settings()), before, settings())


def test_ramps_are_no_part_of_a_steady_turn() -> None:
    rate = ramped_rate([60.0])
    used = calibrate(Bench("gyroscope", BIAS, K).turns_at([60.0])).stages[0].details.samples_used
    steady_or_resting = int(np.sum((rate == 60.0) | (rate == 0.0)))
    assert 0.85 * 3 * steady_or_resting < used <= 3 * steady_or_resting


def test_a_stage_works_on_the_output_of_the_stage_before() -> None:
    recordings = Bench("gyroscope", BIAS, K).turns_at([60.0])
    before = run_stages("gyroscope", STAGES[:1], recordings, settings())
    shifted = Subtract(np.array(BIAS) + 0.5)
    given = replace(before, bias=before.bias + 0.5, stages=(replace(before.stages[0], correction=(shifted,)),))
    found = fit_stage("gyroscope", STAGES[1], with_noise(recordings, settings()), given, settings())
    assert found.bias == pytest.approx(np.array(BIAS) + 0.5, abs=1e-9)
    assert found.stages[-1].correction[0] is shifted
